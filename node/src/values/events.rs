// SPDX-License-Identifier: MIT OR Apache-2.0
//! `/parameter_events`: each change of a parameter of any node.

use super::value::ParameterValue;
use std::sync::Arc;

/// The effects of one change on parameters.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Changes<'v> {
    pub(crate) new: &'v [(String, ParameterValue)],
    pub(crate) changed: &'v [(String, ParameterValue)],
    pub(crate) deleted: &'v [(String, ParameterValue)],
}

/// A node's changes, published by its context.
pub(crate) struct ParameterEvents {
    node: String,
    topic: Option<Arc<EventTopic>>,
}

impl ParameterEvents {
    pub(crate) fn new(node: String, topic: Arc<EventTopic>) -> ParameterEvents {
        ParameterEvents { node, topic: Some(topic) }
    }

    /// For tests of what needs no topic.
    #[cfg(all(test, feature = "rcl_interfaces"))]
    pub(crate) fn nowhere() -> ParameterEvents {
        ParameterEvents { node: String::new(), topic: None }
    }

    /// Whether there is a subscription: if not, nothing needs to be prepared for [`publish`](Self::publish).
    pub(crate) fn are_wanted(&self) -> bool {
        self.topic.as_ref().is_some_and(|topic| topic.is_wanted())
    }

    pub(crate) fn publish(&self, changes: &Changes<'_>) {
        let Changes { new, changed, deleted } = changes;
        let is_empty = [new, changed, deleted].iter().all(|values| values.is_empty());
        if let Some(topic) = self.topic.as_ref().filter(|_| !is_empty) {
            topic.publish(&self.node, changes);
        }
    }
}

#[cfg(feature = "rcl_interfaces")]
pub(crate) use topic::EventTopic;

#[cfg(feature = "rcl_interfaces")]
mod topic {
    use crate::Qos;
    use crate::values::events::Changes;
    use crate::values::value::ParameterValue;
    use std::sync::{Mutex, PoisonError};
    use tautline_ros_msgs::builtin_interfaces::msg::Time;
    use tautline_ros_msgs::rcl_interfaces::msg::{Parameter, ParameterEvent};
    use tautline_transport::{Claim, Limits, Participant, Publisher, TransportError};

    /// A context's publisher, created with the first change.
    pub(crate) struct EventTopic {
        participant: Participant,
        /// Created once: after a failure it is not tried again.
        publisher: Mutex<Option<Opened>>,
    }

    type Opened = Result<Publisher<ParameterEvent>, TransportError>;

    fn messages(values: &[(String, ParameterValue)]) -> Vec<Parameter> {
        let message =
            |(name, value): &(String, ParameterValue)| Parameter { name: name.clone(), value: value.into() };
        values.iter().map(message).collect()
    }

    impl EventTopic {
        pub(crate) fn new(participant: Participant) -> EventTopic {
            EventTopic { participant, publisher: Mutex::new(None) }
        }

        /// Whether there is a subscription. Creates the publisher, if there is none, so that others discover it before its first message.
        pub(super) fn is_wanted(&self) -> bool {
            let mut publisher = self.publisher.lock().unwrap_or_else(PoisonError::into_inner);
            self.opened(&mut publisher).is_some_and(|publisher| publisher.subscription_count() != 0)
        }

        /// Publishes a change. A failure is only logged: the change is made in any case.
        pub(super) fn publish(&self, node: &str, changes: &Changes<'_>) {
            let mut publisher = self.publisher.lock().unwrap_or_else(PoisonError::into_inner);
            let publisher =
                self.opened(&mut publisher).filter(|publisher| publisher.subscription_count() != 0);
            let Some(publisher) = publisher else { return };
            let now = tautline_rt::clock::wall_ns();
            let event = ParameterEvent {
                stamp: Time { sec: (now / 1_000_000_000) as i32, nanosec: (now % 1_000_000_000) as u32 },
                node: node.to_owned(),
                new_parameters: messages(changes.new),
                changed_parameters: messages(changes.changed),
                deleted_parameters: messages(changes.deleted),
            };
            if let Err(error) = publisher.publish(&event) {
                tracing::warn!("/parameter_events: {error}");
            }
        }

        fn opened<'p>(&self, publisher: &'p mut Option<Opened>) -> Option<&'p Publisher<ParameterEvent>> {
            let opened = publisher.get_or_insert_with(|| {
                self.open().inspect_err(|error| tracing::warn!("/parameter_events is not published: {error}"))
            });
            opened.as_ref().ok()
        }

        fn open(&self) -> Result<Publisher<ParameterEvent>, TransportError> {
            let qos = Qos::parameter_events();
            let limits = Limits { claim: Claim::OnUse, ..Limits::default() };
            self.participant.create_publisher("/parameter_events", qos, limits)
        }
    }
}

#[cfg(not(feature = "rcl_interfaces"))]
pub(crate) struct EventTopic;

#[cfg(not(feature = "rcl_interfaces"))]
impl EventTopic {
    pub(crate) fn new(_participant: tautline_transport::Participant) -> EventTopic {
        EventTopic
    }

    fn is_wanted(&self) -> bool {
        false
    }

    fn publish(&self, _node: &str, _changes: &Changes<'_>) {}
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! `/parameter_events`: each change of a parameter of any node.

use super::ParameterValue;
use std::sync::Arc;
use tautline_transport::Participant;

/// What became of parameters.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Change {
    New,
    Changed,
    Deleted,
}

/// A node's changes, published by its context.
pub(crate) struct ParameterEvents {
    node: String,
    topic: Arc<EventTopic>,
}

impl ParameterEvents {
    pub(crate) fn new(node: String, topic: Arc<EventTopic>) -> ParameterEvents {
        ParameterEvents { node, topic }
    }

    pub(crate) fn publish(&self, change: Change, values: &[(String, ParameterValue)]) {
        if !values.is_empty() {
            self.topic.publish(&self.node, change, values);
        }
    }
}

#[cfg(feature = "rcl_interfaces")]
pub(crate) use topic::EventTopic;

#[cfg(feature = "rcl_interfaces")]
mod topic {
    use super::{Change, ParameterValue, Participant};
    use crate::QosProfile;
    use std::sync::{Mutex, PoisonError};
    use tautline_ros_msgs::builtin_interfaces::msg::Time;
    use tautline_ros_msgs::rcl_interfaces::msg::{Parameter, ParameterEvent};
    use tautline_transport::{Limits, Publisher, TransportError};

    /// A context's publisher, made with the first change.
    pub(crate) struct EventTopic {
        participant: Participant,
        publisher: Mutex<Option<Publisher<ParameterEvent>>>,
    }

    impl EventTopic {
        pub(crate) fn new(participant: Participant) -> EventTopic {
            EventTopic { participant, publisher: Mutex::new(None) }
        }

        /// A change is made whether it can be published or not.
        pub(super) fn publish(&self, node: &str, change: Change, values: &[(String, ParameterValue)]) {
            let mut publisher = self.publisher.lock().unwrap_or_else(PoisonError::into_inner);
            if publisher.is_none() {
                match self.open() {
                    Ok(opened) => *publisher = Some(opened),
                    Err(error) => return tracing::warn!("/parameter_events: {error}"),
                }
            }
            let values =
                values.iter().map(|(name, value)| Parameter { name: name.clone(), value: value.into() });
            let now = tautline_rt::clock::wall_ns();
            let stamp = Time { sec: (now / 1_000_000_000) as i32, nanosec: (now % 1_000_000_000) as u32 };
            let mut event = ParameterEvent { stamp, node: node.to_owned(), ..Default::default() };
            match change {
                Change::New => event.new_parameters = values.collect(),
                Change::Changed => event.changed_parameters = values.collect(),
                Change::Deleted => event.deleted_parameters = values.collect(),
            }
            if let Some(Err(error)) = publisher.as_ref().map(|publisher| publisher.publish(&event)) {
                tracing::warn!("/parameter_events: {error}");
            }
        }

        fn open(&self) -> Result<Publisher<ParameterEvent>, TransportError> {
            let qos = QosProfile::parameter_events().to_transport();
            self.participant.create_publisher("/parameter_events", qos, Limits::default())
        }
    }
}

#[cfg(not(feature = "rcl_interfaces"))]
pub(crate) struct EventTopic;

#[cfg(not(feature = "rcl_interfaces"))]
impl EventTopic {
    pub(crate) fn new(_participant: Participant) -> EventTopic {
        EventTopic
    }

    fn publish(&self, _node: &str, _change: Change, _values: &[(String, ParameterValue)]) {}
}

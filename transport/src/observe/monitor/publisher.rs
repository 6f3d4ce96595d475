// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::observe::monitor::{Changes, EndpointTracker, Events, IncompatibleQos, IncompatibleType, Matched};
use crate::qos::{Liveliness, Qos};
use crate::topic::publisher::RawPublisher;
use crate::topic::writer::core::PublisherCore;
use std::sync::Arc;
use std::time::Duration;
use tautline_doorbell::{Activity, ActivityKind, Slot};

/// Reports changes of a publisher's matches. See [`RawPublisher::monitor`].
pub struct PublisherMonitor {
    core: Arc<PublisherCore>,
    endpoints: EndpointTracker,
    _events: Events,
}

/// What has changed since a publisher's monitor last checked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PublisherChanges {
    /// Subscriptions appeared or disappeared.
    pub matched: Option<Matched>,
    /// Subscriptions appeared that request what the publisher does not offer.
    pub incompatible_qos: Option<IncompatibleQos>,
    /// Subscriptions of another type appeared.
    pub incompatible_type: Option<IncompatibleType>,
}

impl RawPublisher {
    /// A monitor that reports changes of this publisher's subscriptions when `events` is rung. A publisher has one monitor at a
    /// time: a second one replaces the first.
    ///
    /// # Real-time
    /// Setup only.
    pub fn monitor(&self, events: &Slot) -> PublisherMonitor {
        let core = self.core().clone();
        // Set before the list is read, so that changes in between ring.
        let _events = Events::new(&core.slot, events);
        PublisherMonitor { endpoints: EndpointTracker::new(core.monitor()), core, _events }
    }
}

impl PublisherMonitor {
    /// What has changed since the last call; the first time, compared with an empty state.
    ///
    /// # Real-time
    /// One load if nothing has changed; otherwise O(subscriptions), and allocates if there are more than ever before. No
    /// syscall.
    pub fn changes(&mut self) -> PublisherChanges {
        let Changes { matched, incompatible_qos, incompatible_type, .. } = self.endpoints.update();
        PublisherChanges { matched, incompatible_qos, incompatible_type }
    }

    /// Whether the publisher has ended.
    pub fn has_ended(&self) -> bool {
        self.core.slot.is_retired()
    }

    /// The quality of service that the publisher offers.
    pub fn qos(&self) -> &Qos {
        &self.core.qos
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.core.topic.name
    }

    /// When the publisher last published, and its deadline; recorded only if it has a deadline.
    pub fn deadline(&self) -> Option<(Activity, Duration)> {
        Some((self.core.slot.activity(ActivityKind::Sample), self.qos().deadline?))
    }

    /// When the publisher last asserted its liveliness, and its lease, if its liveliness is manual.
    pub fn lease(&self) -> Option<(Activity, Duration)> {
        let lease = self
            .qos()
            .liveliness_lease_duration
            .filter(|_| self.qos().liveliness == Liveliness::ManualByTopic);
        Some((self.core.slot.activity(ActivityKind::Liveliness), lease?))
    }
}

tautline_rt::debug_fields!(PublisherMonitor, |this| topic = this.topic());

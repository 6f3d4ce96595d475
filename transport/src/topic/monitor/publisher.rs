// SPDX-License-Identifier: MIT OR Apache-2.0

use super::{Changes, EndpointTracker, Events, IncompatibleQos, IncompatibleType, Matched};
use crate::qos::{Liveliness, Qos};
use crate::topic::publisher::RawPublisher;
use crate::topic::publisher::core::PublisherCore;
use std::sync::Arc;
use std::time::Duration;
use tautline_doorbell::{Activity, ActivityKind, Slot};

/// Tells what becomes of a publisher's matches. See [`RawPublisher::monitor`].
pub struct PublisherMonitor {
    core: Arc<PublisherCore>,
    endpoints: EndpointTracker,
    _events: Events,
}

/// What changed since a publisher's monitor last looked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PublisherChanges {
    /// Subscriptions came or went.
    pub matched: Option<Matched>,
    /// Subscriptions came that request what the publisher does not offer.
    pub incompatible_qos: Option<IncompatibleQos>,
    /// Subscriptions of another type came.
    pub incompatible_type: Option<IncompatibleType>,
}

impl RawPublisher {
    /// What tells of this publisher's subscriptions, when `events` is rung. There is one at a time: a second one takes the first
    /// one's place.
    ///
    /// # Real-time
    /// Setup only.
    pub fn monitor(&self, events: &Slot) -> PublisherMonitor {
        let core = self.core().clone();
        // Before the list: what changes meanwhile rings.
        let _events = Events::new(&core.slot, events);
        PublisherMonitor { endpoints: EndpointTracker::new(core.monitor()), core, _events }
    }
}

impl PublisherMonitor {
    /// What changed. The first time: since there was nothing.
    ///
    /// # Real-time
    /// One load if nothing changed; else O(subscriptions), and allocates if there are more than ever before. No syscall.
    pub fn look(&mut self) -> PublisherChanges {
        let Changes { matched, incompatible_qos, incompatible_type, .. } = self.endpoints.update();
        PublisherChanges { matched, incompatible_qos, incompatible_type }
    }

    /// Whether the publisher has gone.
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

    /// When the publisher last published; kept only if it has a deadline, which it has to keep.
    pub fn deadline(&self) -> Option<(Activity, Duration)> {
        Some((self.core.slot.activity(ActivityKind::Sample), self.qos().deadline?))
    }

    /// When it last showed that it is alive, and its lease, if it has to.
    pub fn lease(&self) -> Option<(Activity, Duration)> {
        let lease = self
            .qos()
            .liveliness_lease_duration
            .filter(|_| self.qos().liveliness == Liveliness::ManualByTopic);
        Some((self.core.slot.activity(ActivityKind::Liveliness), lease?))
    }
}

impl std::fmt::Debug for PublisherMonitor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PublisherMonitor").field("topic", &self.topic()).finish_non_exhaustive()
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0

use super::remote::RemoteEnds;
use super::{Ends, IncompatibleQos, Matched, Watched};
use crate::doorbell::{Pulse, PulseOf, Slot};
use crate::header::Gid;
use crate::nodes::EndpointKind;
use crate::ports;
use crate::publisher::RawPublisher;
use crate::qos::{Liveliness, Qos};
use std::time::Duration;

/// Tells what becomes of a publisher's matches. See [`RawPublisher::monitor`].
pub struct PublisherMonitor {
    watched: Watched,
    ends: Ends<u128, ()>,
    remote: RemoteEnds,
}

/// What changed since a publisher's monitor last looked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PublisherChanges {
    /// Subscriptions came or went.
    pub matched: Option<Matched>,
    /// Subscriptions came that request what the publisher does not offer.
    pub incompatible_qos: Option<IncompatibleQos>,
}

impl RawPublisher {
    /// What tells of this publisher's subscriptions, when `events` is rung. There is one at a time: a second one takes the first
    /// one's place.
    ///
    /// # Real-time
    /// Setup only.
    pub fn monitor(&self, events: &Slot) -> PublisherMonitor {
        let (topic, slot, address) = self.place();
        let ends = Ends::new(topic.limits.subscribers);
        let watched = Watched::new(topic, slot, address, events);
        let remote = RemoteEnds::watch(self.shared(), topic, EndpointKind::Subscription, events);
        PublisherMonitor { watched, ends, remote }
    }
}

impl PublisherMonitor {
    /// What changed. The first time: since there was nothing.
    ///
    /// # Real-time
    /// O(1), no allocation, if the topic's participants have not changed; else O(subscriptions), and iceoryx2's list allocates. No
    /// syscall.
    pub fn look(&mut self) -> PublisherChanges {
        // Not the one or the other: each is looked at.
        if !(self.watched.has_changed() | self.remote.have_changed()) {
            return PublisherChanges::default();
        }
        let Watched { topic, address, .. } = &self.watched;
        let remote = self.remote.look();
        let (matched, incompatible_qos) = self.ends.update(
            |each| {
                ports::each_subscription(&topic.factory, |port| {
                    if !port.address.is_relay {
                        each(port.id, address.incompatibility(&port.address), ());
                    }
                });
                // They get what the gateway sends on, whatever they request.
                remote.iter().for_each(|Gid(id)| each(u128::from_le_bytes(*id), None, ()));
            },
            |_, ()| {},
        );
        PublisherChanges { matched, incompatible_qos }
    }

    /// Whether the publisher has gone.
    pub fn has_ended(&self) -> bool {
        self.watched.slot.is_retired()
    }

    /// The quality of service that the publisher offers.
    pub fn qos(&self) -> &Qos {
        &self.watched.address.qos
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.watched.topic.name
    }

    /// When the publisher last published; kept only if it has a deadline, which it has to keep.
    pub fn deadline(&self) -> Option<(Pulse, Duration)> {
        Some((self.watched.slot.pulse(PulseOf::Sample), self.qos().deadline?))
    }

    /// When it last showed that it is alive, and its lease, if it has to.
    pub fn lease(&self) -> Option<(Pulse, Duration)> {
        let lease = self
            .qos()
            .liveliness_lease_duration
            .filter(|_| self.qos().liveliness == Liveliness::ManualByTopic);
        Some((self.watched.slot.pulse(PulseOf::Liveliness), lease?))
    }
}

impl std::fmt::Debug for PublisherMonitor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PublisherMonitor").field("topic", &self.topic()).finish_non_exhaustive()
    }
}

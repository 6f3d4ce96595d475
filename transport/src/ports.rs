// SPDX-License-Identifier: MIT OR Apache-2.0
//! Listing the ports of a topic, and reaching the doorbells of those in other processes.

use crate::address::{Address, Role};
use crate::doorbell::{Arena, ArenaId, Doorbell};
use crate::header::Gid;
use crate::topic::Topic;
use iceoryx2::prelude::CallbackProgression;
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

/// One subscription of a topic.
pub(crate) struct SubscriptionPort {
    pub(crate) id: u128,
    pub(crate) address: Address,
    pub(crate) depth: usize,
}

/// One publisher of a topic.
pub(crate) struct PublisherPort {
    pub(crate) gid: Gid,
    pub(crate) address: Address,
}

/// The subscriptions that can be rung (not keepers, not ports of other iceoryx2 programs).
pub(crate) fn subscriptions(factory: &crate::topic::Factory) -> Vec<SubscriptionPort> {
    let mut found = Vec::new();
    use iceoryx2::prelude::PortFactory;
    factory.dynamic_config().list_subscribers(|details| {
        if let Some(address) = Address::parse(details.subscriber_name.as_str())
            && address.role == Role::Subscription
        {
            let id = details.subscriber_id.value();
            found.push(SubscriptionPort { id, address, depth: details.buffer_size });
        }
        CallbackProgression::Continue
    });
    found
}

/// The publishers of a topic that are Tautline's.
pub(crate) fn publishers(topic: &Topic) -> Vec<PublisherPort> {
    let mut found = Vec::new();
    use iceoryx2::prelude::PortFactory;
    topic.factory.dynamic_config().list_publishers(|details| {
        if let Some(address) = Address::parse(details.publisher_name.as_str()) {
            found.push(PublisherPort { gid: gid(details.publisher_id.value()), address });
        }
        CallbackProgression::Continue
    });
    found
}

/// A publisher's gid is its iceoryx2 id, which is unique on the system.
pub(crate) fn gid(publisher_id: u128) -> Gid {
    Gid(publisher_id.to_le_bytes())
}

/// A number that changes when the topic's ports change.
pub(crate) fn fingerprint(topic: &Topic) -> u64 {
    let mut hasher = DefaultHasher::new();
    for port in publishers(topic) {
        port.gid.hash(&mut hasher);
    }
    for port in subscriptions(&topic.factory) {
        port.id.hash(&mut hasher);
    }
    hasher.finish()
}

/// An arena, of this process or of another.
#[derive(Clone)]
pub(crate) enum Reached {
    Own(Arc<Doorbell>),
    Peer(Arc<Arena>),
}

impl Reached {
    /// Maps the arena `id` unless it is this process's own. `None` if its owner has gone.
    pub(crate) fn reach(domain: u32, own: &Arc<Doorbell>, id: ArenaId) -> Option<Self> {
        if own.arena().id() == id {
            return Some(Reached::Own(own.clone()));
        }
        Arena::open(domain, id).ok().map(|arena| Reached::Peer(Arc::new(arena)))
    }

    pub(crate) fn arena(&self) -> &Arena {
        match self {
            Reached::Own(doorbell) => doorbell.arena(),
            Reached::Peer(arena) => arena,
        }
    }
}

/// Tells every publisher of the topic that its participants changed; `call_janitors` also asks those that keep samples
/// for late joiners to serve them.
pub(crate) fn announce(domain: u32, own: &Arc<Doorbell>, topic: &Topic, call_janitors: bool) {
    for port in publishers(topic) {
        let Some(reached) = Reached::reach(domain, own, port.address.arena) else { continue };
        reached.arena().advance_epoch(port.address.slot);
        // It may wait for room in a queue that has gone.
        reached.arena().bell().ring(port.address.slot);
        if call_janitors && port.address.role == Role::TransientPublisher {
            reached.arena().call_janitor();
        }
    }
}

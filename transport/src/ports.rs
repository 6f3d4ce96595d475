// SPDX-License-Identifier: MIT OR Apache-2.0
//! Listing the ports of a topic, and reaching the doorbells of those in other processes.

use crate::address::{Address, Role};
use crate::doorbell::{Arena, ArenaId, Doorbell};
use crate::error::TransportError;
use crate::header::Gid;
use crate::topic::{Factory, Topic};
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};
use std::io::ErrorKind;
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
pub(crate) fn subscriptions(factory: &Factory) -> Vec<SubscriptionPort> {
    let mut found = Vec::new();
    each_subscription(factory, |port| found.push(port));
    found
}

/// As [`subscriptions`]; only iceoryx2 allocates.
pub(crate) fn each_subscription(factory: &Factory, mut each: impl FnMut(SubscriptionPort)) {
    factory.dynamic_config().list_subscribers(|details| {
        if let Some(address) = Address::parse(details.subscriber_name.as_str())
            && address.role == Role::Subscription
        {
            let id = details.subscriber_id.value();
            each(SubscriptionPort { id, address, depth: details.buffer_size });
        }
        CallbackProgression::Continue
    });
}

/// The publishers of a topic that are Tautline's.
pub(crate) fn publishers(topic: &Topic) -> Vec<PublisherPort> {
    let mut found = Vec::new();
    each_publisher(&topic.factory, |port| found.push(port));
    found
}

/// As [`publishers`]; only iceoryx2 allocates.
pub(crate) fn each_publisher(factory: &Factory, mut each: impl FnMut(PublisherPort)) {
    factory.dynamic_config().list_publishers(|details| {
        if let Some(address) = Address::parse(details.publisher_name.as_str()) {
            each(PublisherPort { gid: gid(details.publisher_id.value()), address });
        }
        CallbackProgression::Continue
    });
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
    ///
    /// # Errors
    /// It is there and cannot be mapped: see [`may_pass`].
    pub(crate) fn reach(
        domain: u32,
        own: &Arc<Doorbell>,
        id: ArenaId,
    ) -> Result<Option<Self>, TransportError> {
        if own.arena().id() == id {
            return Ok(Some(Reached::Own(own.clone())));
        }
        match Arena::open(domain, id) {
            Ok(arena) => Ok(Some(Reached::Peer(Arc::new(arena)))),
            Err(TransportError::Arena { source, .. }) if source.kind() == ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// As [`reach`](Self::reach), where what is told is found out by the other one's janitor as well, only later.
    pub(crate) fn reach_at_best(domain: u32, own: &Arc<Doorbell>, id: ArenaId) -> Option<Self> {
        Self::reach(domain, own, id).ok().flatten()
    }

    pub(crate) fn arena(&self) -> &Arena {
        match self {
            Reached::Own(doorbell) => doorbell.arena(),
            Reached::Peer(arena) => arena,
        }
    }
}

/// Whether an arena that cannot be mapped now may be mappable later: the system said no, at its limit of open files for one. What
/// it is and whose does not change.
pub(crate) fn may_pass(error: &TransportError) -> bool {
    matches!(error, TransportError::Arena { source, .. } if source.raw_os_error().is_some())
}

/// Tells every publisher of the topic that its participants changed; `call_janitors` also asks those that keep samples
/// for late joiners to serve them.
pub(crate) fn announce(domain: u32, own: &Arc<Doorbell>, topic: &Topic, call_janitors: bool) {
    for port in publishers(topic) {
        let Some(reached) = Reached::reach_at_best(domain, own, port.address.arena) else { continue };
        reached.arena().advance_epoch(port.address.slot);
        // It may wait for room in a queue that has gone.
        reached.arena().bell().ring(port.address.slot);
        if call_janitors && port.address.role == Role::TransientPublisher {
            reached.arena().call_janitor();
        }
    }
}

/// Tells every subscription of the topic that a publisher came or went.
pub(crate) fn announce_publisher(domain: u32, own: &Arc<Doorbell>, topic: &Topic) {
    for port in subscriptions(&topic.factory) {
        let Some(reached) = Reached::reach_at_best(domain, own, port.address.arena) else { continue };
        reached.arena().advance_epoch(port.address.slot);
        // It connects when it next takes: better now than when the first sample is there.
        reached.arena().bell().ring(port.address.slot);
    }
}

/// Says once, where an end of a topic is made, which others it does not fit.
pub(crate) fn warn_of_incompatible(topic: &Topic, address: &Address) {
    let warn = |other: &Address, here: &str, there: &str| {
        if let Some(policy) = address.incompatibility(other) {
            tracing::warn!(
                "topic '{}': this {here} and a {there} of the topic get nothing from each other: what is offered does not \
                 meet the {policy} that is requested (docs/qos.md)",
                topic.name
            );
        }
    };
    match address.role {
        Role::Subscription => {
            publishers(topic).iter().for_each(|port| warn(&port.address, "subscription", "publisher"));
        }
        _ => subscriptions(&topic.factory)
            .iter()
            .for_each(|port| warn(&port.address, "publisher", "subscription")),
    }
}

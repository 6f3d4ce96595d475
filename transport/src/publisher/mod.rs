// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishers: loan, write in place, publish.

mod hot;
mod peers;

pub use hot::{Loan, Unpublished};

use crate::address::{Address, Role};
use crate::doorbell::{Slot, slot_flags};
use crate::error::TransportError;
use crate::header::Gid;
use crate::history::Keeper;
use crate::janitor::Watch;
use crate::participant::Shared;
use crate::ports;
use crate::qos::{Durability, History, Limits, Qos};
use crate::topic::{IoxPublisher, Topic};
use iceoryx2::prelude::BackpressureStrategy;
use peers::Peers;
use std::cell::RefCell;
use std::marker::PhantomData;
use std::sync::Arc;
use tautline_msgs::{Message, Plain};

/// Publishes messages of type `T` on one topic.
///
/// May be moved to another thread, and is used by one at a time.
pub struct Publisher<T> {
    port: IoxPublisher,
    peers: RefCell<Peers>,
    keep_all: bool,
    gid: Gid,
    qos: Qos,
    slot: Slot,
    topic: Arc<Topic>,
    shared: Arc<Shared>,
    _message: PhantomData<T>,
}

// SAFETY: the port shares an `Rc` with its loans only, and every Loan borrows the Publisher: while one is alive the
// Publisher cannot be moved. (A loan that was forgotten never touches the `Rc` again.) The rest is Send; the Publisher
// is not Sync, through the port and the RefCell.
unsafe impl<T> Send for Publisher<T> {}

impl<T: Message + Plain> Publisher<T> {
    pub(crate) fn create(
        shared: Arc<Shared>,
        topic: &str,
        qos: Qos,
        limits: Limits,
    ) -> Result<Self, TransportError> {
        let topic = Arc::new(Topic::open_for::<T>(&shared.node, topic, qos, limits, false)?);
        let transient = qos.durability == Durability::TransientLocal;
        let slot = shared.doorbell.claim()?;
        let role = if transient { Role::TransientPublisher } else { Role::Publisher };
        if transient {
            slot.set_flags(slot_flags::TRANSIENT_LOCAL);
        }
        let address = Address { role, arena: shared.doorbell.arena().id(), slot: slot.index() };
        let port = topic
            .factory
            .publisher_builder()
            .name(&address.to_port_name())
            .initial_max_slice_len(size_of::<T>().max(1))
            .max_loaned_samples(limits.loans)
            // A full queue overwrites its oldest sample; should that ever fail, nothing may spin in publish().
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .set_degradation_handler(topic.warn_of_degradation())
            .create()
            .map_err(|error| create_error(&topic, error))?;
        let gid = ports::gid(port.id().value());
        if transient {
            let keeper = Keeper::new(shared.domain, &shared.doorbell, &topic, gid, qos.depth, slot.index())?;
            shared.janitor.keep(slot.index(), keeper);
        }
        let fingerprint = ports::fingerprint(&topic);
        let watch = Watch {
            topic: topic.clone(),
            slot: slot.index(),
            is_publisher: true,
            fingerprint,
            epoch: slot.epoch(),
            ring_at_ns: None,
        };
        shared.janitor.watch(watch);
        let peers = Peers::new(shared.domain, topic.limits.subscribers);
        let keep_all = qos.history == History::KeepAll;
        let publisher = Publisher {
            port,
            peers: RefCell::new(peers),
            keep_all,
            gid,
            qos,
            slot,
            topic,
            shared,
            _message: PhantomData,
        };
        let mut peers = publisher.peers.borrow_mut();
        peers.refresh(&publisher.topic, &publisher.slot, gid);
        // Subscriptions connect when they next take: better now than when the first sample is there.
        peers.ring();
        drop(peers);
        Ok(publisher)
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.topic.name
    }

    /// The quality of service that was asked for.
    pub fn qos(&self) -> Qos {
        self.qos
    }

    /// This publisher's identifier.
    pub fn gid(&self) -> Gid {
        self.gid
    }

    /// The topic's limits, as its first opener set them.
    pub fn limits(&self) -> Limits {
        self.topic.limits
    }

    /// Number of subscriptions that the next sample goes to.
    ///
    /// # Real-time
    /// Wait-free if the topic's ports have not changed; else allocates and maps memory.
    pub fn subscription_count(&self) -> usize {
        let mut peers = self.peers.borrow_mut();
        peers.refresh_if_changed(&self.topic, &self.slot, self.gid);
        peers.len()
    }
}

impl<T> std::fmt::Debug for Publisher<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Publisher")
            .field("topic", &self.topic.name)
            .field("gid", &self.gid)
            .finish_non_exhaustive()
    }
}

impl<T> Drop for Publisher<T> {
    fn drop(&mut self) {
        self.shared.janitor.forget(self.slot.index());
        self.peers.borrow().end(self.gid);
    }
}

fn create_error(topic: &Topic, error: iceoryx2::port::publisher::PublisherCreateError) -> TransportError {
    use iceoryx2::port::publisher::PublisherCreateError as Iceoryx;
    let Limits { publishers, .. } = topic.limits;
    match error {
        Iceoryx::ExceedsMaxSupportedPublishers => TransportError::Limit {
            topic: topic.name.clone(),
            limit: "publishers",
            existing: publishers,
            requested: publishers + 1,
        },
        other => topic.iceoryx_error("creating a publisher", other),
    }
}

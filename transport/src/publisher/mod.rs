// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishers of bytes: loan, write in place, publish. What is above knows the type.

mod gate;
mod hot;
mod peers;

pub use gate::Gate;
pub use hot::{RawLoan, Unpublished};

use crate::address::{Address, Role};
use crate::doorbell::{Flags, PulseOf, Slot};
use crate::error::TransportError;
use crate::graph::Presence;
use crate::header::{Gid, NEVER};
use crate::history::Keeper;
use crate::janitor::Watch;
use crate::memory;
use crate::nodes::{EndpointKind, TopicEndpoint};
use crate::participant::{Participant, Shared};
use crate::ports;
use crate::qos::{Durability, History, Limits, Liveliness, Qos, nanoseconds};
use crate::topic::{IoxPublisher, Topic, padded};
use crate::topic_type::TopicType;
use futures::StreamExt;
use peers::Peers;
use std::cell::{Cell, RefCell};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tautline_rt::clock::monotonic_ns;

/// Publishes bodies of CDR on one topic, of whatever type. What is written is not looked at.
///
/// May be moved to another thread, and is used by one at a time.
pub struct RawPublisher {
    port: IoxPublisher,
    peers: RefCell<Peers>,
    keep_all: bool,
    gate: Option<Gate>,
    /// Whether it has to show that it is alive.
    is_manual: bool,
    /// `u64::MAX` without one.
    lifespan_ns: u64,
    gid: Gid,
    trace: tautline_trace::Object,
    qos: Qos,
    /// The longest payload that fits without a larger segment.
    capacity_bytes: Cell<usize>,
    counters: Arc<PublisherCounters>,
    address: Address,
    slot: Arc<Slot>,
    topic: Arc<Topic>,
    // After the port, which they announce the end of.
    _departure: Departure,
    _presence: Presence,
    shared: Arc<Shared>,
}

/// Tells subscriptions that the publisher's port, dropped just before this, has gone.
struct Departure {
    topic: Arc<Topic>,
    shared: Arc<Shared>,
}

impl Drop for Departure {
    fn drop(&mut self) {
        ports::announce_publisher(self.shared.domain, &self.shared.doorbell, &self.topic);
    }
}

/// What happened to one publisher's memory, readable from any thread.
#[derive(Debug, Default)]
pub struct PublisherCounters {
    growths: AtomicU64,
    silenced: AtomicU64,
}

impl PublisherCounters {
    /// How often a message was longer than any before and than `Limits::message_bytes`, so that a larger segment had to be
    /// made: allocations and system calls in a loan. 0 is what a real-time publisher should read.
    pub fn growths(&self) -> u64 {
        self.growths.load(Ordering::Relaxed)
    }

    /// Messages that were not sent because the publisher's [`Gate`] was shut.
    pub fn silenced(&self) -> u64 {
        self.silenced.load(Ordering::Relaxed)
    }
}

// SAFETY: the port shares an `Rc` with its loans only, and every RawLoan borrows the RawPublisher: while one is alive the
// RawPublisher cannot be moved. (A loan that was forgotten never touches the `Rc` again.) The rest is Send; the
// RawPublisher is not Sync, through the port and the RefCell.
unsafe impl Send for RawPublisher {}

impl RawPublisher {
    pub(crate) fn create(
        participant: &Participant,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
        is_relay: bool,
    ) -> Result<Self, TransportError> {
        let shared = participant.shared.clone();
        let topic = Arc::new(Topic::open(&shared.node, topic, topic_type, qos, limits, false)?);
        let transient = qos.durability == Durability::TransientLocal;
        let slot = Arc::new(shared.doorbell.claim()?);
        let role = if transient { Role::TransientPublisher } else { Role::Publisher };
        if transient {
            slot.flags().set(Flags::TRANSIENT_LOCAL);
        }
        let address =
            Address { role, arena: shared.doorbell.arena().id(), slot: slot.index(), qos, is_relay };
        let port = topic
            .publisher_port(&topic.factory, &address.to_port_name(), topic.limits)
            .map_err(|error| create_error(&topic, error))?;
        let gid = ports::gid(port.id().value());
        let owner = participant.own(gid)?;
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
            finished: None,
            is_warned: false,
        };
        shared.janitor.watch(watch);
        ports::warn_of_incompatible(&topic, &address);
        let peers = Peers::new(shared.domain, address, topic.limits.subscribers);
        let keep_all = qos.history == History::KeepAll;
        slot.note(PulseOf::Liveliness, monotonic_ns());
        let publisher = RawPublisher {
            port,
            peers: RefCell::new(peers),
            keep_all,
            gate: None,
            is_manual: qos.liveliness == Liveliness::ManualByTopic,
            lifespan_ns: qos.lifespan.map_or(NEVER, nanoseconds),
            gid,
            trace: tautline_trace::publisher_init(&topic.name, qos.depth, gid.words()),
            qos,
            capacity_bytes: Cell::new(padded(topic.limits.message_bytes)),
            counters: Arc::default(),
            address,
            slot,
            _departure: Departure { topic: topic.clone(), shared: shared.clone() },
            topic,
            _presence: Presence::new(&shared.graph, owner),
            shared,
        };
        publisher.peers.borrow_mut().refresh(&publisher.topic, &publisher.slot, gid);
        publisher.announce();
        Ok(publisher)
    }

    /// The same, silent while `gate` is shut: publishing then succeeds, and is counted, but nothing is sent.
    #[must_use]
    pub fn with_gate(mut self, gate: Gate) -> Self {
        self.gate = Some(gate);
        self
    }

    /// What its monitor watches.
    pub(crate) fn place(&self) -> (&Arc<Topic>, &Arc<Slot>, Address) {
        (&self.topic, &self.slot, self.address)
    }

    pub(crate) fn shared(&self) -> &Shared {
        &self.shared
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

    /// The topic's limits, as its first opener set them, and this publisher's own `loans` and `message_bytes`, which are a fixed
    /// size if the type has one.
    pub fn limits(&self) -> Limits {
        self.topic.limits
    }

    /// What is known of the topic's type.
    pub fn topic_type(&self) -> &TopicType {
        &self.topic.topic_type
    }

    /// Whether every subscription there is has taken all that was sent, as far as it is known.
    pub(crate) fn is_taken(&self) -> bool {
        let mut peers = self.peers.borrow_mut();
        peers.refresh_if_changed(&self.topic, &self.slot, self.gid);
        let sent = peers.sequence_number;
        // Acquire: pairs with the Release in the subscription's tracker.
        let taken = |link: &crate::doorbell::Link| link.taken.0.load(crate::sync::Ordering::Acquire) >= sent;
        peers.matched.iter().filter_map(|matched| matched.link()).all(taken)
    }

    /// How many samples were sent.
    pub(crate) fn sent(&self) -> u64 {
        self.peers.borrow().sequence_number
    }

    /// Tells the topic's subscriptions once more that this publisher has come.
    pub(crate) fn announce(&self) {
        ports::announce_publisher(self.shared.domain, &self.shared.doorbell, &self.topic);
    }

    /// Its slot, which is rung when the topic's ports change.
    pub(crate) fn slot(&self) -> &Slot {
        &self.slot
    }

    pub(crate) fn factory(&self) -> &crate::topic::Factory {
        &self.topic.factory
    }

    /// The counters, to be read from any thread.
    pub fn counters(&self) -> Arc<PublisherCounters> {
        self.counters.clone()
    }

    /// A loan of `payload_bytes`, more than this publisher's samples held, made iceoryx2 take a larger segment.
    #[cold]
    fn note_growth(&self, payload_bytes: usize) {
        let (before, after) = (self.capacity_bytes.get(), memory::grown_payload(payload_bytes));
        self.capacity_bytes.set(after);
        if self.counters.growths.fetch_add(1, Ordering::Relaxed) == 0 {
            tracing::warn!(
                "topic '{}': a message of {payload_bytes} bytes does not fit into this publisher's samples of {before}, which \
                 take {after} from now on: that took a new segment, which is not real-time; set `Limits::message_bytes` to \
                 the largest message (said once; `PublisherCounters::growths` counts)",
                self.topic.name
            );
        }
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

    /// Waits until the topic has a subscription, on this host or on one that a gateway tells of. The future borrows nothing of
    /// the publisher, looks when the graph changes and not otherwise, and allocates: it is not for callbacks with deadlines.
    ///
    /// # Errors
    /// [`TransportError::Janitor`] if the thread that looks at the graph, one for all of a participant, cannot be started. The
    /// future's: [`TransportError`] if the domain's topics cannot be listed.
    pub fn wait_for_subscriptions(
        &self,
    ) -> Result<impl Future<Output = Result<(), TransportError>> + Send + use<>, TransportError> {
        let participant = Participant { shared: self.shared.clone(), node: None };
        let topic = self.topic().to_owned();
        // Before the first look: nothing that happens after it is missed.
        let mut events = participant.graph_events()?;
        Ok(async move {
            let is_wanted =
                |end: &TopicEndpoint| end.kind == EndpointKind::Subscription && end.topic == topic;
            while !participant.graph()?.endpoints.iter().any(is_wanted) {
                // It does not end: the participant is alive.
                events.next().await;
            }
            Ok(())
        })
    }
}

impl AsRef<RawPublisher> for RawPublisher {
    fn as_ref(&self) -> &RawPublisher {
        self
    }
}

impl std::fmt::Debug for RawPublisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RawPublisher")
            .field("topic", &self.topic.name)
            .field("gid", &self.gid)
            .finish_non_exhaustive()
    }
}

impl Drop for RawPublisher {
    fn drop(&mut self) {
        self.shared.janitor.forget(self.slot.index());
        self.peers.get_mut().end(self.gid);
        self.slot.retire();
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Subscriptions to bytes: take a sample and read it in place, or poll for one from a task. What is above knows the type.

mod hot;
mod tracker;

pub(crate) use hot::Patience;
pub use hot::RawSample;

use crate::address::{Address, Role};
use crate::doorbell::{Flags, Joined, Slot, ThreadBell};
use crate::error::TransportError;
use crate::graph::Presence;
use crate::header::Gid;
use crate::history::Catch;
use crate::janitor::Watch;
use crate::lending::{Shelf, Sole};
use crate::participant::{Participant, Shared};
use crate::ports;
use crate::qos::{Durability, History, Limits, Qos};
use crate::topic::{IoxSample, IoxSubscriber, Topic};
use crate::topic_type::TopicType;
use std::cell::{Cell, RefCell};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tracker::Tracker;

/// Receives bodies of CDR from one topic, of whatever type. A stream of [`RawSample`]s, or
/// [`try_take`](RawSubscription::try_take).
///
/// May be moved to another thread, and is used by one at a time. Its samples may be dropped anywhere; their memory goes
/// back to the publisher when this subscription next takes.
pub struct RawSubscription {
    // Dropped in this order.
    port: Sole<IoxSubscriber>,
    shelf: Shelf<IoxSample>,
    state: RefCell<State>,
    /// What the polls before found.
    run: Cell<Run>,
    /// The callback thread that publishers wake.
    thread: RefCell<Option<Joined>>,
    address: Address,
    departure: Departure,
    _presence: Presence,
    counters: Arc<Counters>,
    trace: tautline_trace::Object,
    qos: Qos,
}

/// How polls go.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Run {
    /// The last one found nothing: publishers ring.
    Waiting,
    /// It found a sample.
    Took,
    /// Those before it did, too: publishers need not ring.
    Draining,
}

struct State {
    /// The epoch of the topic's ports up to which publishers that ended were noted.
    epoch: u32,
    tracker: Tracker,
    catch: Option<Catch>,
    /// What is taken next is of this publisher: doorbells of publishers that wait for room.
    waiters: hot::Waiters,
    /// Publishers that were there before this subscription and do not offer what it requests: what they sent it before they
    /// knew of it is none of its. Later ones say so in their link.
    incompatible: Vec<Gid>,
}

/// What happened to the messages of one subscription, readable from any thread.
#[derive(Debug, Default)]
pub struct Counters {
    received: AtomicU64,
    lost: AtomicU64,
    invalid: AtomicU64,
    refused: AtomicU64,
    expired: AtomicU64,
    max_queue: AtomicU64,
}

impl Counters {
    /// Messages taken.
    pub fn received(&self) -> u64 {
        self.received.load(Ordering::Relaxed)
    }

    /// Messages that were overwritten before they were taken, or whose publisher was gone before this subscription could
    /// connect to it: what is missing in the sequence numbers of each publisher. Exact from the moment at which the
    /// publisher knows of the subscription, as long as no more than 64 publishers end between two takes.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Samples thrown away because their bytes are not a valid message.
    pub fn invalid(&self) -> u64 {
        self.invalid.load(Ordering::Relaxed)
    }

    /// Polls of the stream that found it unable to take: too many samples held, or a publisher's memory out of reach.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Messages not delivered because they were older than their publisher's lifespan when they were to be taken.
    pub fn expired(&self) -> u64 {
        self.expired.load(Ordering::Relaxed)
    }

    /// Most messages of one publisher that waited at once, in samples, seen when taking; at most the depth.
    pub fn max_queue(&self) -> u64 {
        self.max_queue.load(Ordering::Relaxed)
    }
}

impl RawSubscription {
    pub(crate) fn create(
        participant: &Participant,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
        is_relay: bool,
    ) -> Result<Self, TransportError> {
        let shared = participant.shared.clone();
        let topic = Arc::new(Topic::open(&shared.node, topic, topic_type, qos, limits, true)?);
        let transient = qos.durability == Durability::TransientLocal;
        let limit = topic.limits.subscribers;
        let existing = ports::subscriptions(&topic.factory).len();
        if existing >= limit {
            return Err(too_many(&topic, limit));
        }
        let slot = Arc::new(shared.doorbell.claim_with_links()?);
        let flag = |set: bool, flag: u32| if set { flag } else { 0 };
        slot.flags().set(
            flag(qos.history == History::KeepAll, Flags::KEEP_ALL)
                | flag(qos.deadline.is_some(), Flags::DEADLINE),
        );
        let (role, arena) = (Role::Subscription, shared.doorbell.arena().id());
        let address = Address { role, arena, slot: slot.index(), qos, is_relay };
        let port = topic
            .factory
            .subscriber_builder()
            .name(&address.to_port_name())
            .buffer_size(qos.depth)
            .set_degradation_handler(topic.warn_of_degradation())
            .create()
            .map_err(|error| create_error(&topic, error))?;
        let owner = participant.own(ports::gid(port.id().value()))?;
        let opened = if transient { Catch::open(&topic, address, qos.depth)? } else { None };
        let (catch, finished) = opened.unzip();
        // Publishers learn of the new queue; what they sent before that is found by the first take.
        ports::announce(shared.domain, &shared.doorbell, &topic, catch.is_some());
        ports::warn_of_incompatible(&topic, &address);
        let fingerprint = ports::fingerprint(&topic);
        let ring_at_ns = catch.as_ref().map(Catch::give_up_ns);
        // Not the present one: a publisher may have come and gone already.
        let epoch = slot.epoch().wrapping_sub(1);
        let watch = Watch {
            topic: topic.clone(),
            slot: slot.index(),
            is_publisher: false,
            fingerprint,
            epoch,
            ring_at_ns,
            finished,
            is_warned: false,
        };
        shared.janitor.watch(watch);
        let waiters = hot::Waiters::new(shared.domain, topic.limits.publishers);
        let presence = Presence::new(&shared.graph, owner);
        let incompatible = incompatible(&topic, &address);
        Ok(RawSubscription {
            port: Sole::new(port),
            shelf: Shelf::new(topic.limits.held),
            run: Cell::new(Run::Waiting),
            thread: RefCell::new(None),
            state: RefCell::new(State { epoch, tracker: Tracker::new(), catch, waiters, incompatible }),
            trace: tautline_trace::subscription_init(&topic.name, qos.depth),
            address,
            departure: Departure { slot, topic, shared },
            _presence: presence,
            counters: Arc::default(),
            qos,
        })
    }

    /// What its monitor watches.
    pub(crate) fn place(&self) -> (&Arc<Topic>, &Arc<Slot>, Address) {
        (&self.departure.topic, &self.departure.slot, self.address)
    }

    pub(crate) fn shared(&self) -> &Shared {
        &self.departure.shared
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.departure.topic.name
    }

    /// The quality of service that was asked for.
    pub fn qos(&self) -> Qos {
        self.qos
    }

    /// The topic's limits, as its first opener set them.
    pub fn limits(&self) -> Limits {
        self.departure.topic.limits
    }

    /// What is known of the topic's type.
    pub fn topic_type(&self) -> &TopicType {
        &self.departure.topic.topic_type
    }

    /// A number that moves when the topic's ports change.
    pub(crate) fn ports_epoch(&self) -> u32 {
        self.departure.slot.epoch()
    }

    /// The counters, to be read from any thread.
    pub fn counters(&self) -> Arc<Counters> {
        self.counters.clone()
    }

    /// What trace events call this subscription.
    pub fn trace_id(&self) -> tautline_trace::ObjectId {
        self.trace.id()
    }

    /// Number of publishers of the topic that offer what this subscription requests.
    pub fn publisher_count(&self) -> usize {
        let mut count = 0;
        ports::each_publisher(&self.departure.topic.factory, |port| {
            count += usize::from(self.address.incompatibility(&port.address).is_none());
        });
        count
    }

    /// The topic's publishers.
    pub(crate) fn publisher_gids(&self) -> Vec<Gid> {
        ports::publishers(&self.departure.topic).iter().map(|port| port.gid).collect()
    }

    /// Says which callback thread publishers wake, instead of the sampler: that which polls this subscription from now on, and
    /// sleeps on `bell` alone. `None`: the sampler again. The caller looks into the queue after this.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions of the thread); no allocation; no syscall. If the bell's 63 places are taken, or if it is another
    /// participant's, the sampler is rung as before.
    pub fn wake_thread(&self, bell: Option<&Arc<ThreadBell>>) {
        let mut thread = self.thread.borrow_mut();
        // Left before it is joined anew: both set the route.
        *thread = None;
        *thread = bell.and_then(|bell| bell.join(&self.departure.slot));
    }

    /// Says whether this subscription polls by itself, without a doorbell (a busy-polling callback).
    pub fn set_quiet(&self, quiet: bool) {
        self.departure.slot.flags().put(Flags::QUIET, quiet);
    }
}

impl AsRef<RawSubscription> for RawSubscription {
    fn as_ref(&self) -> &RawSubscription {
        self
    }
}

/// Tells publishers that the subscription's port, dropped just before this, has gone.
struct Departure {
    slot: Arc<Slot>,
    topic: Arc<Topic>,
    shared: Arc<Shared>,
}

impl Drop for Departure {
    fn drop(&mut self) {
        self.shared.janitor.forget(self.slot.index());
        ports::announce(self.shared.domain, &self.shared.doorbell, &self.topic, false);
        self.slot.retire();
    }
}

/// The publishers that do not offer what is requested at `address`.
fn incompatible(topic: &Topic, address: &Address) -> Vec<Gid> {
    let mut found = Vec::new();
    ports::each_publisher(&topic.factory, |port| {
        if address.incompatibility(&port.address).is_some() {
            found.push(port.gid);
        }
    });
    found
}

fn too_many(topic: &Topic, limit: usize) -> TransportError {
    TransportError::Limit {
        topic: topic.name.clone(),
        limit: "subscribers",
        existing: limit,
        requested: limit + 1,
    }
}

fn create_error(topic: &Topic, error: iceoryx2::port::subscriber::SubscriberCreateError) -> TransportError {
    use iceoryx2::port::subscriber::SubscriberCreateError as Iceoryx;
    match error {
        Iceoryx::ExceedsMaxSupportedSubscribers => too_many(topic, topic.limits.subscribers),
        other => topic.iceoryx_error("creating a subscription", other),
    }
}

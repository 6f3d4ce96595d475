// SPDX-License-Identifier: MIT OR Apache-2.0
//! Untyped subscriptions: take a sample and read it in place, or poll for one from a task. The layer above knows the type.

pub(crate) mod hot;

use crate::error::TransportError;
use crate::graph::own::NodeEntry;
use crate::graph::topic_type::TopicType;
use crate::memory::header::Gid;
use crate::qos::{Limits, Qos};
use crate::topic::declaration::Topic;
use crate::topic::endpoints::MatchedCount;
use crate::topic::participant::{Participant, ParticipantState};
use crate::topic::reader::borrowed::BorrowTable;
use crate::topic::reader::core::{SubscriptionCore, SubscriptionRole};
use crate::topic::reader::receiver::{BorrowedChunk, TakeState};
use std::cell::{Cell, RefCell};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::task::Waker;
use tautline_doorbell::{BellRoute, Slot, ThreadBell};

/// Receives CDR bodies of any type from one topic. A stream of [`RawSample`](crate::RawSample)s, or
/// [`try_take`](RawSubscription::try_take).
///
/// May be moved between threads, but only one thread uses it at a time. Its samples may be dropped in any thread; their
/// memory returns to the publisher at this subscription's next take.
pub struct RawSubscription {
    // Dropped in this order.
    take_state: RefCell<TakeState>,
    borrowed: BorrowTable<BorrowedChunk>,
    /// The result of the previous polls.
    poll_state: Cell<PollState>,
    /// The callback thread that publishers wake.
    thread: RefCell<Option<BellRoute>>,
    trace: tautline_trace::Object,
    counters: Arc<SubscriptionCounters>,
    registration: Registration,
    /// Its node, which exists at least as long.
    _node: Option<Arc<NodeEntry>>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum PollState {
    /// The last poll found nothing: publishers ring.
    Waiting,
    /// The last poll found a sample.
    Took,
    /// The polls before it found samples, too: publishers need not ring.
    Draining,
}

/// Counters of one subscription's messages, readable from any thread.
#[derive(Debug, Default)]
pub struct SubscriptionCounters {
    received: AtomicU64,
    lost: AtomicU64,
    invalid: AtomicU64,
    refused: AtomicU64,
    expired: AtomicU64,
    max_queue: AtomicU64,
}

impl SubscriptionCounters {
    /// Messages taken.
    pub fn received(&self) -> u64 {
        self.received.load(Ordering::Relaxed)
    }

    /// Messages that were overwritten before they were taken: the gaps in the numbers of each publisher.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Samples dropped because their bytes are not a valid message.
    pub fn invalid(&self) -> u64 {
        self.invalid.load(Ordering::Relaxed)
    }

    /// Polls of the stream, and calls of `try_take_valid`, that were refused because too many samples were held.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Messages not delivered because they were older than their publisher's lifespan at take.
    pub fn expired(&self) -> u64 {
        self.expired.load(Ordering::Relaxed)
    }

    /// Maximum number of queued messages of one publisher, as seen at a take; at most the depth.
    pub fn max_queue(&self) -> u64 {
        self.max_queue.load(Ordering::Relaxed)
    }
}

impl Participant {
    /// Creates a subscription to the bytes of `topic`, a fully qualified name. What is published from now on is queued.
    ///
    /// # Real-time
    /// As [`create_subscription`](Self::create_subscription).
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_raw_subscription(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        RawSubscription::create(self, topic, topic_type, qos, limits, SubscriptionRole::default())
    }

    /// Like [`create_raw_subscription`](Self::create_raw_subscription), for messages to be relayed: it gets the messages of
    /// every publisher, whatever the publisher offers.
    ///
    /// # Real-time
    /// As [`create_subscription`](Self::create_subscription).
    ///
    /// # Errors
    /// As [`create_raw_subscription`](Self::create_raw_subscription).
    pub fn create_relay_subscription(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        let role = SubscriptionRole { is_relay: true, ..SubscriptionRole::default() };
        RawSubscription::create(self, topic, topic_type, qos, limits, role)
    }

    /// An observer: a subscription for tools. It gets the messages of every publisher on this host, whatever the publisher offers, and the
    /// samples kept for late joiners, at most `depth` of each. It is invisible: it appears in no count, list or event, matches nothing,
    /// makes no gateway fetch messages, and no publisher waits for it. It is not rung, so [take](RawSubscription::try_take) from it at
    /// intervals.
    ///
    /// Its cost for each publisher: a queue of `depth`, into which the publishing thread puts each sample, and memory for
    /// `limits.held` samples, plus memory for `depth` samples if `depth` is greater than that of every subscription.
    ///
    /// # Real-time
    /// As [`create_subscription`](Self::create_subscription).
    ///
    /// # Errors
    /// As [`create_raw_subscription`](Self::create_raw_subscription).
    pub fn create_observer(
        &self,
        topic: &str,
        topic_type: &TopicType,
        depth: usize,
        limits: Limits,
    ) -> Result<RawSubscription, TransportError> {
        let role = SubscriptionRole { is_observer: true, ..SubscriptionRole::default() };
        let qos = Qos::keep_last(depth).best_effort().transient_local();
        RawSubscription::create(self, topic, topic_type, qos, limits, role)
    }
}

impl RawSubscription {
    pub(crate) fn create(
        participant: &Participant,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
        role: SubscriptionRole,
    ) -> Result<Self, TransportError> {
        let state = participant.state.clone();
        state.domain.check_process()?;
        let topic = Topic::check(topic, topic_type, qos, limits)?;
        let slot = Arc::new(state.doorbell.claim()?);
        slot.flags().set_deadline(qos.deadline.is_some());
        slot.flags().set_quiet(role.is_observer);
        let gid = Gid::of(state.memory.id(), role.number.unwrap_or_else(|| state.record.number()));
        let trace = tautline_trace::subscription_init(&topic.name, qos.depth);
        let (core, take_state) = SubscriptionCore::create(gid, topic, qos, limits, role, slot);
        let returned = LastSampleGuard { core: Arc::downgrade(&core), participant: state.clone() };
        let subscription = RawSubscription {
            take_state: RefCell::new(take_state),
            borrowed: BorrowTable::new(limits.held, returned),
            poll_state: Cell::new(PollState::Waiting),
            thread: RefCell::new(None),
            trace,
            counters: Arc::default(),
            registration: Registration { core: core.clone(), participant: state.clone() },
            _node: participant.node.clone(),
        };
        state.matcher.add_subscription(&core, participant.node.as_deref())?;
        participant.adopt(&core.slot);
        Ok(subscription)
    }

    pub(crate) fn core(&self) -> &Arc<SubscriptionCore> {
        &self.registration.core
    }

    fn slot(&self) -> &Slot {
        &self.registration.core.slot
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.core().topic.name
    }

    /// This subscription's identifier.
    pub fn gid(&self) -> Gid {
        self.core().gid
    }

    /// The requested quality of service.
    pub fn qos(&self) -> Qos {
        self.core().qos
    }

    /// This subscription's limits.
    pub fn limits(&self) -> Limits {
        self.core().limits
    }

    /// What this subscription knows about the topic's type.
    pub fn topic_type(&self) -> &TopicType {
        &self.core().topic.topic_type
    }

    /// The counters, to be read from any thread.
    pub fn counters(&self) -> Arc<SubscriptionCounters> {
        self.counters.clone()
    }

    /// Resets [`max_queue`](SubscriptionCounters::max_queue): what was queued until now does not count.
    pub fn forget_max_queue(&self) {
        self.counters.max_queue.store(0, Ordering::Relaxed);
    }

    /// This subscription's id in trace events.
    pub fn trace_id(&self) -> tautline_trace::ObjectId {
        self.trace.id()
    }

    /// Number of matching publishers on this host, including those of a gateway or bridge.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn publisher_count(&self) -> usize {
        self.core().matched.here.load(Ordering::Acquire)
    }

    /// The number of matching publishers on all hosts, readable from any thread.
    pub fn matched(&self) -> MatchedCount {
        MatchedCount(self.core().matched.clone())
    }

    /// Whether its node has ended: no more samples arrive.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn has_ended(&self) -> bool {
        self.slot().is_retired()
    }

    /// Sets which callback thread publishers wake instead of the sampler: the thread that polls this subscription from now on,
    /// and sleeps only on `bell`. `None`: the sampler again. Check the queue after this call.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions of the thread); no allocation; no syscall. If all 63 bits of the bell are in use, or if it
    /// belongs to another participant, the sampler is rung as before. Returns whether publishers wake that thread.
    pub fn wake_thread(&self, bell: Option<&Arc<ThreadBell>>) -> bool {
        let mut thread = self.thread.borrow_mut();
        // The former route ends before the new one begins: both set it.
        *thread = None;
        *thread = bell.and_then(|bell| bell.route(self.slot()));
        thread.is_some()
    }

    /// Registers a waker that is woken, once, when a sample arrives, by the thread that drains the doorbell: for a subscription that
    /// is not [polled](Self::poll_take). Check the queue after this call.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn wake_once(&self, waker: &Waker) {
        self.slot().waker().register(waker);
    }

    /// Sets whether publishers of this participant leave this subscription unrung, because the thread that publishes with one of them
    /// [checks the queue](Self::waiting) afterwards. Publishers of other participants ring as before. Check the queue after
    /// each change.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn set_own_look(&self, is_looked: bool) {
        self.slot().flags().set_own_look(is_looked);
    }

    /// Sets whether this subscription is polled without a doorbell (by a busy-polling callback). If it no longer is, its
    /// doorbell is rung once, for samples that arrived meanwhile.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake.
    pub fn set_quiet(&self, is_quiet: bool) {
        self.slot().flags().set_quiet(is_quiet);
        if !is_quiet {
            self.slot().ring();
        }
    }
}

impl AsRef<RawSubscription> for RawSubscription {
    fn as_ref(&self) -> &RawSubscription {
        self
    }
}

/// Removes the subscription from the matcher when it is dropped.
struct Registration {
    core: Arc<SubscriptionCore>,
    participant: Arc<ParticipantState>,
}

impl Drop for Registration {
    fn drop(&mut self) {
        self.core.slot.retire();
        self.participant.matcher.remove_subscription(&self.core);
    }
}

/// Dropped when the subscription and its last sample have gone, by whichever thread that is.
struct LastSampleGuard {
    core: Weak<SubscriptionCore>,
    participant: Arc<ParticipantState>,
}

impl Drop for LastSampleGuard {
    /// # Real-time
    /// Wait-free; one futex wake. If the participant was dropped before, it ends here: that waits for its threads.
    fn drop(&mut self) {
        if let Some(core) = self.core.upgrade() {
            core.is_returned.store(true, Ordering::Release);
            self.participant.call_janitor();
        }
    }
}

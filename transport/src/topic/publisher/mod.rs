// SPDX-License-Identifier: MIT OR Apache-2.0
//! Untyped publishers: loan, write in place, publish. The layer above knows the type.

pub(crate) mod claimer;
pub(crate) mod counters;
pub(crate) mod gate;
pub(crate) mod hot;

use crate::error::TransportError;
use crate::graph::entities::{EndpointKind, TopicEndpoint};
use crate::graph::own::NodeEntry;
use crate::graph::topic_type::TopicType;
use crate::memory::header::{Gid, NEVER};
use crate::memory::sizes::{padded, sample_bytes};
use crate::qos::{History, Limits, Liveliness, Qos};
use crate::topic::declaration::Topic;
use crate::topic::endpoints::MatchedCount;
use crate::topic::participant::{Participant, ParticipantState};
use crate::topic::publisher::claimer::{Claiming, MemoryClaimer};
use crate::topic::publisher::counters::PublisherCounters;
use crate::topic::publisher::gate::Gate;
use crate::topic::writer::core::{PublisherCore, PublisherRole};
use crate::topic::writer::sender::PublishState;
use futures::StreamExt;
use std::cell::{Cell, RefCell};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use tautline_doorbell::{ActivityKind, Slot};
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_rt::fork::ProcessMark;

/// Publishes CDR bodies of any type on one topic. The bodies are not inspected.
///
/// May be moved between threads, but only one thread uses it at a time.
pub struct RawPublisher {
    core: Arc<PublisherCore>,
    publish_state: RefCell<PublishState>,
    /// The number of loans in use.
    loaned: Cell<usize>,
    keep_all: bool,
    gate: Option<Gate>,
    /// Whether its liveliness is manual.
    is_manual: bool,
    /// `u64::MAX` without a lifespan.
    lifespan_ns: u64,
    trace: tautline_trace::Object,
    /// The length of the longest body that it sends.
    most_bytes: usize,
    counters: Arc<PublisherCounters>,
    participant: Arc<ParticipantState>,
    process: ProcessMark,
    /// Its node, which exists at least as long.
    _node: Option<Arc<NodeEntry>>,
}

impl Participant {
    /// Creates a publisher of bytes of `topic`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: no shared memory, an invalid QoS.
    pub fn create_raw_publisher(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawPublisher, TransportError> {
        RawPublisher::create(self, topic, topic_type, qos, limits, PublisherRole::default())
    }

    /// Like [`create_raw_publisher`](Self::create_raw_publisher), for relayed messages: every subscription gets them, whatever
    /// it requests. With [`Claim::Ahead`](crate::Claim::Ahead) at most 1 MiB is claimed ahead, because nobody has stated how long the
    /// messages are; more is claimed on use, or before that by a [`MemoryClaimer`](crate::MemoryClaimer).
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`create_raw_publisher`](Self::create_raw_publisher).
    pub fn create_relay_publisher(
        &self,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<RawPublisher, TransportError> {
        let role = PublisherRole { is_relay: true, ..PublisherRole::default() };
        RawPublisher::create(self, topic, topic_type, qos, limits, role)
    }
}

impl RawPublisher {
    pub(crate) fn create(
        participant: &Participant,
        topic: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
        role: PublisherRole,
    ) -> Result<Self, TransportError> {
        let state = participant.state.clone();
        state.domain.check_process()?;
        let topic = Topic::check(topic, topic_type, qos, limits)?;
        let slot = Arc::new(state.doorbell.claim()?);
        slot.note(ActivityKind::Liveliness, monotonic_ns());
        let gid = Gid::of(state.memory.id(), role.number.unwrap_or_else(|| state.record.number()));
        let trace = tautline_trace::publisher_init(&topic.name, qos.depth, gid.words());
        let home = (&state.memory, &state.record);
        let (core, publish_state) = PublisherCore::create(home, gid, topic, qos, limits, role, slot)?;
        state.matcher.add_publisher(&core, participant.node.as_deref())?;
        participant.adopt(&core.slot);
        let fixed_bytes = core.topic.topic_type.body_bytes;
        let stated_bytes = fixed_bytes.unwrap_or(limits.message_bytes);
        let may_grow = limits.may_grow && fixed_bytes.is_none();
        let most_bytes = if may_grow { Limits::MAX_MESSAGE_BYTES } else { padded(stated_bytes) };
        Ok(RawPublisher {
            publish_state: RefCell::new(publish_state),
            loaned: Cell::new(0),
            keep_all: qos.history == History::KeepAll,
            gate: None,
            is_manual: qos.liveliness == Liveliness::ManualByTopic,
            lifespan_ns: qos.lifespan.map_or(NEVER, nanoseconds),
            trace,
            most_bytes,
            counters: Arc::default(),
            core,
            participant: state,
            process: ProcessMark::new(),
            _node: participant.node.clone(),
        })
    }

    /// The same publisher, silent while `gate` is closed: publishing then succeeds, and is counted, but
    /// nothing is sent.
    #[must_use = "it returns the changed publisher"]
    pub fn with_gate(mut self, gate: Gate) -> Self {
        self.gate = Some(gate);
        self
    }

    /// A handle that claims this publisher's memory in another thread; see [`has_memory`](Self::has_memory).
    pub fn claimer(&self) -> MemoryClaimer {
        let (core, counters) = (self.core.clone(), self.counters.clone());
        MemoryClaimer { core, counters, participant: self.participant.clone() }
    }

    fn claiming(&self) -> Claiming<'_> {
        let (core, counters, participant) = (&self.core, &self.counters, &self.participant);
        Claiming { core, counters, participant, is_publishing: true }
    }

    /// The setup part, for the publisher's monitor.
    pub(crate) fn core(&self) -> &Arc<PublisherCore> {
        &self.core
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.core.topic.name
    }

    /// The offered quality of service.
    pub fn qos(&self) -> Qos {
        self.core.qos
    }

    /// This publisher's identifier.
    pub fn gid(&self) -> Gid {
        self.core.gid
    }

    pub(crate) fn trace_id(&self) -> tautline_trace::ObjectId {
        self.trace.id()
    }

    /// This publisher's limits; `message_bytes` is the type's size if that is fixed.
    pub fn limits(&self) -> Limits {
        let fixed = self.core.topic.topic_type.body_bytes;
        let limits = self.core.limits;
        let (message_bytes, may_grow) =
            (fixed.unwrap_or(limits.message_bytes), limits.may_grow && fixed.is_none());
        Limits { message_bytes, may_grow, ..limits }
    }

    /// What this publisher knows about the topic's type.
    pub fn topic_type(&self) -> &TopicType {
        &self.core.topic.topic_type
    }

    /// The number of samples sent.
    pub fn sent(&self) -> u64 {
        self.core.published.load(Ordering::Acquire)
    }

    /// Its slot, which is rung when the topic's ports change.
    pub(crate) fn slot(&self) -> &Slot {
        &self.core.slot
    }

    /// The counters, to be read from any thread.
    pub fn counters(&self) -> Arc<PublisherCounters> {
        self.counters.clone()
    }

    /// Warns, the first time, that a message did not fit into a sample.
    #[cold]
    fn warn_of_growth(&self, len_bytes: usize, before: usize, after: usize) {
        let is_first = before == sample_bytes(self.core.limits.message_bytes);
        if is_first {
            tracing::warn!(
                "{}: a message of {len_bytes} bytes does not fit into this publisher's samples of {before}, which \
                 take {after} from now on: that took a new segment, which is not real-time; set `Limits::message_bytes` to \
                 the largest message (said once; `PublisherCounters::growths` counts)",
                self.core.topic.named()
            );
        }
    }

    /// Number of matching subscriptions on this host. Remote subscriptions that a gateway represents are not
    /// counted.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn subscription_count(&self) -> usize {
        self.core.matched.here.load(Ordering::Acquire)
    }

    /// The number of matching subscriptions on all hosts, readable from any thread.
    pub fn matched(&self) -> MatchedCount {
        MatchedCount(self.core.matched.clone())
    }

    /// Waits until the topic has a subscription, on this host or on a host that a gateway announces. The future borrows
    /// nothing from the publisher. It checks only when the graph changes, and allocates: it is not for callbacks with
    /// deadlines.
    ///
    /// # Errors
    /// [`TransportError::Thread`] if the thread that watches the graph, one per participant, cannot be started. Errors of the
    /// future: those of [`Participant::graph`].
    pub fn wait_for_subscriptions(
        &self,
    ) -> Result<impl Future<Output = Result<(), TransportError>> + Send + use<>, TransportError> {
        let participant = self.participant.clone();
        let topic = self.topic().to_owned();
        // Before the first check of the graph, so that no later change is missed.
        let mut events = participant.graph_events()?;
        Ok(async move {
            let is_wanted =
                |end: &Arc<TopicEndpoint>| end.kind == EndpointKind::Subscription && end.topic == topic;
            while !participant.graph()?.endpoints.iter().any(is_wanted) {
                // The stream does not end: the participant is alive.
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

tautline_rt::debug_fields!(RawPublisher, |this| topic = this.topic(), gid = this.gid());

impl Drop for RawPublisher {
    fn drop(&mut self) {
        self.core.slot.retire();
        self.participant.matcher.remove_publisher(&self.core);
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn what_is_returned_at_once_is_taken_back_over_the_next_loans() {
        crate::tests::isolated();
        let participant = Participant::new(7).unwrap();
        // Of small samples several at a time, of long ones with each loan.
        for (bytes, loans) in [(64, 8), (4096, 1)] {
            let (topic, text) = (format!("/burst{bytes}"), TopicType::new("test_msgs/msg/Text"));
            let (limits, qos) = (Limits { held: 1, loans: 1, ..Limits::default() }, Qos::keep_last(20));
            let text = text.with_body_bytes(bytes);
            let publisher = participant.create_raw_publisher(&topic, &text, qos, limits).unwrap();
            let subscription = participant.create_raw_subscription(&topic, &text, qos, limits).unwrap();
            let out = || {
                let publish_state = publisher.publish_state.borrow();
                let senders = publish_state.table().live();
                senders.map(|sender| sender.samples_out()).sum::<u32>()
            };
            (0..20).for_each(|_| publisher.publish(&vec![1; bytes]).unwrap());
            assert_eq!(out(), 20);
            while subscription.try_take().unwrap().is_some() {}
            for turn in 1..=20 / loans {
                (0..loans).for_each(|_| drop(publisher.loan(bytes).unwrap()));
                assert_eq!(out(), 20_u32.saturating_sub(2 * loans * turn), "{bytes} bytes, {turn}");
            }
        }
    }

    #[test]
    fn a_burst_rings_once_and_so_does_who_publishes_again_before_the_sampler_ran() {
        crate::tests::isolated();
        let participant = Participant::new(7).unwrap();
        let (text, qos) = (TopicType::new("test_msgs/msg/Text"), Qos::keep_last(20));
        let limits = Limits::default();
        let publisher = participant.create_raw_publisher("/bursts", &text, qos, limits).unwrap();
        let subscription = participant.create_raw_subscription("/bursts", &text, qos, limits).unwrap();
        let bodies = [[1_u8; 8], [2; 8], [3; 8]];
        let many = || publisher.publish_many(bodies.iter().map(|body| &body[..])).unwrap();
        let wakes = |meanwhile: &dyn Fn()| {
            let arena = participant.state.doorbell.arena();
            arena.count_wakes(tautline_doorbell::Sleeper::Sampler, meanwhile)
        };
        assert_eq!(wakes(&|| assert_eq!(many(), 3)), 1);
        assert_eq!(wakes(&|| bodies.iter().for_each(|body| publisher.publish(body).unwrap())), 1);
        assert_eq!(wakes(&|| assert_eq!(publisher.publish_many([]), Ok(0))), 0);
        let taken = std::iter::from_fn(|| subscription.try_take().unwrap().map(|sample| sample.body()[0]));
        assert_eq!(taken.collect::<Vec<_>>(), [1, 2, 3, 1, 2, 3]);
    }

    #[test]
    fn what_a_burst_has_queued_before_a_panic_is_rung_for() {
        crate::tests::isolated();
        let participant = Participant::new(7).unwrap();
        let (text, qos) = (TopicType::new("test_msgs/msg/Text"), Qos::keep_last(20));
        let limits = Limits::default();
        let publisher = participant.create_raw_publisher("/panics", &text, qos, limits).unwrap();
        let _subscription = participant.create_raw_subscription("/panics", &text, qos, limits).unwrap();
        let wakes =
            participant.state.doorbell.arena().count_wakes(tautline_doorbell::Sleeper::Sampler, || {
                let bodies = (0..2).map(|n| if n == 0 { &[1_u8; 8][..] } else { panic!("of the caller's") });
                let burst = std::panic::AssertUnwindSafe(|| publisher.publish_many(bodies));
                assert!(std::panic::catch_unwind(burst).is_err());
            });
        assert_eq!((wakes, publisher.sent()), (1, 1));
        assert_eq!(publisher.publish_many([&[2_u8; 8][..]]), Ok(1), "it goes on");
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! From shared memory to the network: one thread takes the samples of all topics and puts them on Zenoh.
//!
//! It never waits long for the network: on a busy link a sample is dropped, and the receiver counts the gap in sequence numbers.
//! Two kinds of samples may wait longer, each in its own thread: large ones, whose fragments fill the link's queue, and those of
//! publishers that are transient local, or reliable and keep all. If too many of these wait, no more are taken from shared memory: the
//! topic's queue there loses its oldest samples, which are counted, or, if both endpoints keep all, its publisher has to wait. Other
//! local publishers are not affected.

use crate::rules::{BULK_BYTES, Rule, Urgency, urgency_of};
use crate::wire::{Attachment, ENCAPSULATION, Token, TopicKey, WireQos, endpoint_gid};
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::{
    EarlyLimits, Egress, FarWriter, Last, Outbound, OutboundSample, Relay, RelayError, TopicCounters, Worker,
};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{CoreSet, Policy, Realtime, RtError, ThreadBuilder};
use tautline_transport::{
    Durability, Gid, History, MessageInfo, Participant, RawSample, Reliability, TracedSample, TracedSender,
};
use zenoh::bytes::ZBytes;
use zenoh::internal::buffers::{ZBuf, ZSlice, ZSliceBuffer};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::sample::Locality;
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig};

/// Bodies of at least this size go to Zenoh without a copy; smaller ones are copied behind their header.
const IN_PLACE_BYTES: usize = 4096;
/// Number of waiting bytes from which on a [`Queue`] has no room.
const MOST_WAITING_BYTES: usize = 16 << 20;
/// Memory of a sample in a [`Queue`] besides its body.
const OVERHEAD_BYTES: usize = 1024;
/// Period of heartbeats, as in rmw_zenoh.
const HEARTBEAT: Duration = Duration::from_millis(500);

/// The gateway's own threads: those that send, and those that follow changes. The budget applies to all of them, because floods of
/// samples, requests or tokens keep them busy.
pub(crate) const THREADS: [&str; 6] =
    ["gw-out", "gw-wait", "gw-bulk", "gw-services", "gw-control", "gw-watch"];

/// The threads that send; dropping this ends them.
pub(crate) type Outgoing = Relay<Network>;

pub(crate) fn start(
    participant: &Participant,
    policy: Policy,
    realtime: Realtime,
    cores: Option<CoreSet>,
) -> Result<Outgoing, RelayError> {
    let thread = |name| ThreadBuilder { cores, ..ThreadBuilder::new(name) }.policy(policy).realtime(realtime);
    let (patient, bulk) = (Queue::start(thread(THREADS[1]))?, Queue::start(thread(THREADS[2]))?);
    Relay::start(participant, thread(THREADS[0]), Network { patient, bulk })
}

/// The identity of an outgoing publisher.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Identity {
    pub(crate) wire_gid: Gid,
    /// Quality of service.
    pub(crate) qos: WireQos,
}

/// Mirrors a publisher on the network.
pub(crate) struct Writer {
    /// Shared with senders and waiting samples, as long as there are any.
    pub(crate) identity: Arc<Identity>,
    session: Session,
    key: TopicKey,
    /// Tokens of the publisher and its node, which have ended, until its last samples are sent.
    tokens: RefCell<Vec<(Token, Arc<LivelinessToken>)>>,
    /// A publisher, declared when the writer's samples are first needed: while it exists, Zenoh knows the key's subscribers.
    scout: OnceLock<(Option<Publisher<'static>>, Cell<Search>)>,
}

/// Time-out for Zenoh to find subscribers; a token may announce one that never subscribes.
const FIND_TIME: Duration = Duration::from_secs(1);

/// A search for subscribers.
#[derive(Clone, Copy)]
struct Search {
    since: Instant,
    has_found: bool,
}

impl Search {
    fn at(since: Instant) -> Self {
        Search { since, has_found: false }
    }

    /// Whether it is over. If those that it found have ended, as after the loss of a link, it starts anew.
    fn is_over(&mut self, are_there: bool, now: Instant) -> bool {
        if self.has_found && !are_there {
            *self = Search::at(now);
        }
        self.has_found = are_there;
        are_there || now.saturating_duration_since(self.since) >= FIND_TIME
    }
}

impl Writer {
    pub(crate) fn new(identity: Identity, session: &Session, key: TopicKey) -> Self {
        let (identity, session) = (Arc::new(identity), session.clone());
        Writer { identity, session, key, tokens: RefCell::default(), scout: OnceLock::new() }
    }

    /// Holds a withdrawn token of its publisher, or then of that one's node, until this is dropped: other hosts take the samples of announced
    /// publishers.
    pub(crate) fn hold(&self, token: &Token, declared: &Arc<LivelinessToken>) {
        let mut tokens = self.tokens.borrow_mut();
        let is_publishers = token.endpoint.is_some() && endpoint_gid(token) == self.identity.wire_gid;
        let is_nodes =
            token.endpoint.is_none() && tokens.iter().any(|(held, _)| held.node_id == token.node_id);
        tokens.extend((is_publishers || is_nodes).then(|| (token.clone(), declared.clone())));
    }

    fn scout(&self) -> (Option<Publisher<'static>>, Cell<Search>) {
        let scout = self.session.declare_publisher(self.key.to_string());
        let scout = scout.allowed_destination(Locality::Remote).wait();
        // The sender logs this failure.
        (scout.ok(), Cell::new(Search::at(Instant::now())))
    }
}

impl FarWriter for Writer {
    /// Whether Zenoh has found subscribers. Declaring a publisher makes Zenoh look for subscribers of the key; samples that are put
    /// before it has found them are lost. Always true for a transient-local publisher: late joiners request its kept samples.
    fn is_matched(&self) -> bool {
        if is_keeping(&self.identity) {
            return true;
        }
        let (scout, search) = self.scout.get_or_init(|| self.scout());
        let is_found =
            |scout: &Publisher<'_>| !scout.matching_status().wait().is_ok_and(|found| !found.matching());
        let mut now = search.get();
        let is_over = now.is_over(scout.as_ref().is_none_or(is_found), Instant::now());
        search.set(now);
        is_over
    }

    /// False while samples may still be taken or wait for the link.
    fn is_settled(&self) -> bool {
        Arc::strong_count(&self.identity) == 1
    }
}

/// Puts samples on Zenoh.
pub(crate) struct Network {
    patient: Queue,
    bulk: Queue,
}

impl Egress for Network {
    type Key = tautline_relay::TopicKey;
    type Topic = Outbound;
    type Sender = NetworkSender;

    // Samples are held until the control thread has discovered their publisher.
    const EARLY: EarlyLimits = EarlyLimits { samples: 1000, bytes: 16 << 20, time: Duration::from_secs(2) };

    fn has_room(&self, sender: &NetworkSender) -> bool {
        self.queue(sender).is_none_or(Queue::has_room)
    }

    fn pass(&mut self, topic: &mut Outbound, sender: &mut NetworkSender, sample: OutboundSample) {
        let (info, len_bytes) = (sample.info(), sample.body().len());
        if !sender.last.admits(&sample) {
            return;
        }
        if !topic.limiter.admits(monotonic_ns()) {
            return topic.counters.dropped("rate limit");
        }
        sender.settle(len_bytes);
        let traced = sender.traced.sample(sample.port(), info.sequence_number);
        let payload = match sample {
            // Samples that are sent later are copied, because a subscription may hold only few samples.
            OutboundSample::Now(sample) if !sender.may_wait() && len_bytes >= IN_PLACE_BYTES => {
                in_place(sample)
            }
            sample => copied(sample.body()),
        };
        self.put(sender, payload, &info, len_bytes, traced, &topic.counters);
    }

    fn dropped(topic: &Outbound) {
        topic.counters.dropped("publisher not announced yet");
    }

    fn lost(topic: &Outbound, samples: u64) {
        topic.counters.lost(samples);
    }
}

impl Network {
    /// The queue in which samples of this publisher wait, if they may wait.
    fn queue(&self, sender: &NetworkSender) -> Option<&Queue> {
        match (sender.may_wait(), sender.is_bulk) {
            (true, _) => Some(&self.patient),
            (false, true) => Some(&self.bulk),
            (false, false) => None,
        }
    }

    fn put(
        &self,
        sender: &NetworkSender,
        payload: ZBytes,
        info: &MessageInfo,
        len_bytes: usize,
        traced: TracedSample,
        counters: &Arc<TopicCounters>,
    ) {
        let attachment = sender.attachment(info);
        let publisher = &sender.publisher;
        let Some(queue) = self.queue(sender) else {
            return count(counters, publisher.put(payload, &attachment, traced), len_bytes, &attachment);
        };
        let (publisher, counters, _writer) = (publisher.clone(), counters.clone(), sender.writer.clone());
        queue.push(QueuedSample { publisher, payload, attachment, len_bytes, traced, counters, _writer });
    }
}

/// A local publisher's counterpart on the network.
pub(crate) struct NetworkSender {
    session: Session,
    key: TopicKey,
    writer: Arc<Identity>,
    publisher: Arc<AnyPublisher>,
    urgency: Urgency,
    /// Whether the priority is a guess, because no rule sets it and no sample has come.
    is_guess: bool,
    /// Whether a large sample has come: all later samples use the same queue, to stay in order.
    is_bulk: bool,
    last: Last,
    traced: TracedSender,
}

enum AnyPublisher {
    Plain(Publisher<'static>),
    /// Transient local.
    Keeping(AdvancedPublisher<'static>),
}

impl NetworkSender {
    pub(crate) fn declare(
        session: &Session,
        key: &TopicKey,
        writer: &Arc<Identity>,
        rules: &[Rule],
    ) -> zenoh::Result<Self> {
        let rule = urgency_of(rules, &key.topic);
        let urgency = rule.unwrap_or_else(|| Urgency::by_size(crate::rules::SMALL_BYTES + 1));
        let (is_guess, is_bulk) = (rule.is_none(), false);
        let publisher = Arc::new(declare(session, key, writer, urgency, is_bulk)?);
        let (session, key, writer, last) = (session.clone(), key.clone(), writer.clone(), Last::default());
        let traced = TracedSender::new(&key.topic, writer.wire_gid);
        Ok(NetworkSender { session, key, writer, publisher, urgency, is_guess, is_bulk, last, traced })
    }

    /// Adapts the priority to the size of samples.
    fn settle(&mut self, bytes: usize) {
        let is_bulk = self.is_bulk || bytes >= BULK_BYTES;
        let guessed = std::mem::take(&mut self.is_guess);
        let urgency = if guessed { Urgency::by_size(bytes) } else { self.urgency };
        // Kept samples belong to one publisher, which cannot be replaced.
        if (urgency, is_bulk) != (self.urgency, self.is_bulk) && !is_keeping(&self.writer) {
            // The new publisher exists before the old one ends, so that subscribers stay matched.
            match declare(&self.session, &self.key, &self.writer, urgency, is_bulk) {
                Ok(publisher) => (self.publisher, self.urgency) = (Arc::new(publisher), urgency),
                Err(error) => tracing::warn!("topic '{}' keeps its priority: {error}", self.key.topic),
            }
        }
        self.is_bulk = is_bulk;
    }

    fn may_wait(&self) -> bool {
        let qos = &self.writer.qos;
        is_keeping(&self.writer)
            || (qos.reliability == Reliability::Reliable && qos.history == History::KeepAll)
    }

    fn attachment(&self, info: &MessageInfo) -> Attachment {
        Attachment {
            sequence_number: i64::try_from(info.sequence_number).unwrap_or(i64::MAX),
            source_timestamp_ns: info.source_timestamp_ns,
            gid: self.writer.wire_gid,
        }
    }
}

fn is_keeping(writer: &Identity) -> bool {
    writer.qos.durability == Durability::TransientLocal
}

fn declare(
    session: &Session,
    key: &TopicKey,
    writer: &Identity,
    urgency: Urgency,
    is_bulk: bool,
) -> zenoh::Result<AnyPublisher> {
    let qos = &writer.qos;
    let is_reliable = qos.reliability == Reliability::Reliable;
    // Block where a thread of its own puts the samples: drops then happen in the topic's queue, which counts them, and a message
    // that Zenoh drops between fragments can block its priority's queue (1.10.2).
    let congestion = match (is_reliable, qos.history) {
        (true, History::KeepAll) => CongestionControl::Block,
        _ if is_bulk || is_keeping(writer) => CongestionControl::Block,
        _ => CongestionControl::Drop,
    };
    let reliability =
        if is_reliable { zenoh::qos::Reliability::Reliable } else { zenoh::qos::Reliability::BestEffort };
    let publisher = session
        .declare_publisher(key.to_string())
        .congestion_control(congestion)
        .reliability(reliability)
        .priority(urgency.priority)
        .express(urgency.express)
        .allowed_destination(Locality::Remote);
    if !is_keeping(writer) {
        return Ok(AnyPublisher::Plain(publisher.wait()?));
    }
    let depth = usize::try_from(qos.depth).unwrap_or(usize::MAX).max(1);
    let keeping = publisher.cache(CacheConfig::default().max_samples(depth)).publisher_detection();
    // Best-effort samples are numbered, too: a receiver whose clock is behind replaces time stamps, so that it would take new samples
    // for another publisher's, and deliver kept ones after them.
    let numbered = MissDetectionConfig::default();
    let numbered = if is_reliable { numbered.sporadic_heartbeat(HEARTBEAT) } else { numbered };
    let keeping = keeping.sample_miss_detection(numbered);
    Ok(AnyPublisher::Keeping(keeping.wait()?))
}

impl AnyPublisher {
    fn put(&self, payload: ZBytes, attachment: &Attachment, traced: TracedSample) -> zenoh::Result<()> {
        traced.record();
        let attachment = attachment.encode();
        match self {
            AnyPublisher::Plain(publisher) => publisher.put(payload).attachment(attachment).wait(),
            AnyPublisher::Keeping(publisher) => publisher.put(payload).attachment(attachment).wait(),
        }
    }
}

/// A queue of samples that may wait, and the thread that sends them. Dropping it sends the waiting samples.
struct Queue {
    worker: Worker<QueuedSample>,
    waiting_bytes: Arc<AtomicUsize>,
}

impl Queue {
    fn start(thread: ThreadBuilder) -> Result<Self, RtError> {
        let waiting_bytes = Arc::<AtomicUsize>::default();
        let left = waiting_bytes.clone();
        // Nothing wakes the thread but its samples, and the end of them.
        let worker = Worker::start(thread, || {}, move |samples| send_waiting(&samples, &left))?;
        Ok(Queue { worker, waiting_bytes })
    }

    fn has_room(&self) -> bool {
        self.waiting_bytes.load(Ordering::Relaxed) < MOST_WAITING_BYTES
    }

    /// Never refuses: the caller checks [`has_room`](Self::has_room) before it takes samples from shared memory.
    fn push(&self, sample: QueuedSample) {
        self.waiting_bytes.fetch_add(sample.waiting_bytes(), Ordering::Relaxed);
        self.worker.send(sample);
    }
}

/// A sample that may wait for its link.
struct QueuedSample {
    publisher: Arc<AnyPublisher>,
    payload: ZBytes,
    attachment: Attachment,
    len_bytes: usize,
    traced: TracedSample,
    counters: Arc<TopicCounters>,
    _writer: Arc<Identity>,
}

impl QueuedSample {
    fn waiting_bytes(&self) -> usize {
        self.len_bytes + OVERHEAD_BYTES
    }
}

fn send_waiting(samples: &mpsc::Receiver<QueuedSample>, waiting_bytes: &AtomicUsize) {
    while let Ok(sample) = samples.recv() {
        // The sample that is being sent does not count, so that the next large one is queued by the time it is sent.
        waiting_bytes.fetch_sub(sample.waiting_bytes(), Ordering::Relaxed);
        let QueuedSample { publisher, payload, attachment, len_bytes, traced, counters, _writer } = sample;
        count(&counters, publisher.put(payload, &attachment, traced), len_bytes, &attachment);
    }
}

fn count(counters: &TopicCounters, outcome: zenoh::Result<()>, len_bytes: usize, attachment: &Attachment) {
    match outcome {
        Ok(()) => counters.passed(len_bytes, attachment.source_timestamp_ns),
        Err(_) => counters.dropped("refused by Zenoh"),
    }
}

/// The encapsulation and a copy of the body, in one slice.
fn copied(body: &[u8]) -> ZBytes {
    let mut payload = Vec::with_capacity(ENCAPSULATION.len() + body.len());
    payload.extend_from_slice(&ENCAPSULATION);
    payload.extend_from_slice(body);
    payload.into()
}

/// The message in shared memory, without a copy: Zenoh copies it into packets before `put` returns, then drops it.
fn in_place(sample: RawSample) -> ZBytes {
    ZBuf::from(ZSlice::from(Serialized(sample))).into()
}

#[derive(Debug)]
struct Serialized(RawSample);

impl ZSliceBuffer for Serialized {
    fn as_slice(&self) -> &[u8] {
        self.0.serialized().unwrap_or_default()
    }

    fn as_any(&self) -> &dyn Any {
        self
    }

    fn as_any_mut(&mut self) -> &mut dyn Any {
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Those of another host end with the link, and its token may be back before they are.
    #[test]
    fn subscribers_that_have_ended_are_searched_again() {
        let start = Instant::now();
        let mut search = Search::at(start);
        assert!(!search.is_over(false, start) && search.is_over(true, start));
        let later = start + 100 * FIND_TIME;
        assert!(search.is_over(true, later) && !search.is_over(false, later));
        assert!(!search.is_over(false, later + FIND_TIME / 2));
        assert!(search.is_over(false, later + FIND_TIME), "none subscribes");
        // What was never found is not searched for ever.
        assert!(search.is_over(false, later + FIND_TIME));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! From shared memory to the network: one thread takes the samples of all topics and puts them on Zenoh.
//!
//! It waits on the doorbell as a sampler does. What it takes never waits for the network for long: on a link that is
//! busy a sample is dropped, and its number missed at the other end. Two kinds of samples may wait longer, and have a
//! thread each to do so: large ones, whose fragments fill the link's queue, and those of publishers that keep samples for
//! late joiners or are reliable and keep all. When too many of these wait, they are dropped too, and counted. A local
//! publisher never notices any of it.

use crate::mirror::Writer;
use crate::rules::{BULK_BYTES, Rule, Urgency, ruled};
use crate::stats::Counters;
use crate::wire::{Attachment, ENCAPSULATION, TopicKey};
use futures::task::{ArcWake, waker};
use std::any::Any;
use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{CoreSet, JoinHandle, Policy, Realtime, RtError, ThreadBuilder};
use tautline_transport::{
    Durability, Gid, History, MessageInfo, Participant, RawSample, RawSubscription, Reliability, SamplerSeat,
    Slot,
};
use zenoh::bytes::ZBytes;
use zenoh::internal::buffers::{ZBuf, ZSlice, ZSliceBuffer};
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::sample::Locality;
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig};

/// Samples taken of one topic before the next topic has its turn.
const TURN: usize = 16;
/// Bodies from this on go to Zenoh as they lie in shared memory; smaller ones are copied behind their header.
const IN_PLACE_BYTES: usize = 4096;
/// Samples that wait for a link, of publishers that keep samples for late joiners or are reliable and keep all.
const WAITING_SAMPLES: usize = 256;
/// Large samples that wait for their turn.
const WAITING_BULK: usize = 8;
/// Samples of publishers that have just appeared, per topic, until the control thread has seen them.
const EARLY_SAMPLES: usize = 64;
const EARLY_BYTES: usize = 4 << 20;
const EARLY_TIME: Duration = Duration::from_secs(2);
/// As rmw_zenoh's.
const HEARTBEAT: Duration = Duration::from_millis(500);

/// The gateway's own threads: those that send, and those that hear of changes. A flood, of samples or of tokens, keeps
/// them busy; so the budget is for all of them.
pub(crate) const THREADS: [&str; 5] = ["gw-out", "gw-wait", "gw-bulk", "gw-control", "gw-watch"];

/// What the control thread tells the one that sends.
#[expect(clippy::large_enum_variant, reason = "few, and only when something is set up")]
enum Command {
    /// Also of a topic that is being taken: by this subscription from now on.
    Start(TopicKey, RawSubscription, Arc<Counters>),
    Open(TopicKey, Gid, Sender),
    Close(TopicKey, Gid),
    Stop(TopicKey),
}

/// The threads that send; dropping it ends them.
pub(crate) struct Outgoing {
    commands: Option<mpsc::Sender<Command>>,
    stop: Arc<AtomicBool>,
    waker: Arc<Waker>,
    own_ports: Arc<Mutex<HashSet<Gid>>>,
    threads: Vec<JoinHandle<()>>,
}

impl Outgoing {
    pub(crate) fn start(
        participant: &Participant,
        policy: Policy,
        realtime: Realtime,
        cores: Option<CoreSet>,
    ) -> Result<Self, OutgoingError> {
        let seat = participant.doorbell().claim_sampler()?;
        let bell = participant.claim_slot()?;
        let waker = Arc::new(Waker { bell, is_draining: AtomicBool::new(false) });
        let (commands, received) = mpsc::channel();
        let (stop, own_ports) = (Arc::new(AtomicBool::new(false)), Arc::default());
        let thread =
            |name| ThreadBuilder { cores, ..ThreadBuilder::new(name) }.policy(policy).realtime(realtime);
        let (patient, patient_samples) = mpsc::sync_channel(WAITING_SAMPLES);
        let (bulk, bulk_samples) = mpsc::sync_channel(WAITING_BULK);
        let waiting = Queues { patient, bulk };
        let wait = thread(THREADS[1]).spawn(move || move || send_waiting(&patient_samples))?;
        let large = thread(THREADS[2]).spawn(move || move || send_waiting(&bulk_samples))?;
        let sending = {
            let (stop, own_ports, waker) = (stop.clone(), Arc::clone(&own_ports), waker.clone());
            let routes = HashMap::new();
            thread(THREADS[0]).spawn(move || {
                move || Loop { seat, commands: received, stop, waker, own_ports, waiting, routes }.run()
            })?
        };
        Ok(Outgoing { commands: Some(commands), stop, waker, own_ports, threads: vec![sending, wait, large] })
    }

    /// Takes this topic's samples from now on.
    pub(crate) fn start_topic(&self, key: TopicKey, subscription: RawSubscription, counters: Arc<Counters>) {
        self.tell(Command::Start(key, subscription, counters));
    }

    pub(crate) fn open(&self, key: TopicKey, local: Gid, sender: Sender) {
        self.tell(Command::Open(key, local, sender));
    }

    pub(crate) fn close(&self, key: TopicKey, local: Gid) {
        self.tell(Command::Close(key, local));
    }

    pub(crate) fn stop_topic(&self, key: TopicKey) {
        self.tell(Command::Stop(key));
    }

    /// Ports of this gateway: what comes through them came from the network and does not go back.
    pub(crate) fn own_ports(&self) -> &Arc<Mutex<HashSet<Gid>>> {
        &self.own_ports
    }

    fn tell(&self, command: Command) {
        if let Some(commands) = &self.commands {
            let _ = commands.send(command);
            self.waker.bell.ring();
        }
    }
}

impl Drop for Outgoing {
    fn drop(&mut self) {
        self.commands = None;
        self.stop.store(true, Ordering::Release);
        self.waker.bell.ring();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

/// Why the threads did not start.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OutgoingError {
    #[error(transparent)]
    Transport(#[from] tautline_transport::TransportError),
    #[error(transparent)]
    Rt(#[from] RtError),
}

/// A local publisher's counterpart on the network.
pub(crate) struct Sender {
    session: Session,
    key: TopicKey,
    writer: Writer,
    publisher: Arc<AnyPublisher>,
    urgency: Urgency,
    /// Whether that is a guess, which the first sample's size decides.
    is_guess: bool,
    /// Whether a large sample has come: all later ones follow it, to keep their order.
    is_bulk: bool,
    /// The last sample's number at its port: a subscription that takes over sees some again.
    last: u64,
}

enum AnyPublisher {
    Plain(Publisher<'static>),
    /// Keeps samples for late joiners.
    Keeping(AdvancedPublisher<'static>),
}

impl Sender {
    /// Declares the publisher. `body_bytes` is the size of its bodies, if that is fixed.
    pub(crate) fn declare(
        session: &Session,
        key: &TopicKey,
        writer: &Writer,
        rules: &[Rule],
        body_bytes: Option<usize>,
    ) -> zenoh::Result<Self> {
        let rule = ruled(rules, &key.topic);
        let urgency =
            rule.unwrap_or_else(|| Urgency::by_size(body_bytes.unwrap_or(crate::rules::SMALL_BYTES + 1)));
        let is_bulk = body_bytes.is_some_and(|bytes| bytes >= BULK_BYTES);
        let publisher = Arc::new(declare(session, key, writer, urgency, is_bulk)?);
        let is_guess = rule.is_none() && body_bytes.is_none();
        let (session, key, writer) = (session.clone(), key.clone(), writer.clone());
        Ok(Sender { session, key, writer, publisher, urgency, is_guess, is_bulk, last: 0 })
    }

    /// Samples tell how large they are.
    fn settle(&mut self, bytes: usize) {
        let is_bulk = self.is_bulk || bytes >= BULK_BYTES;
        let guessed = std::mem::take(&mut self.is_guess);
        let urgency = if guessed { Urgency::by_size(bytes) } else { self.urgency };
        // What is kept for late joiners belongs to one publisher, which cannot be changed.
        if (urgency, is_bulk) != (self.urgency, self.is_bulk) && !is_keeping(&self.writer) {
            // The new one is there before the old one goes, so that those who listen stay known.
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

fn is_keeping(writer: &Writer) -> bool {
    writer.qos.durability == Durability::TransientLocal
}

fn declare(
    session: &Session,
    key: &TopicKey,
    writer: &Writer,
    urgency: Urgency,
    is_bulk: bool,
) -> zenoh::Result<AnyPublisher> {
    let qos = &writer.qos;
    let is_reliable = qos.reliability == Reliability::Reliable;
    // Where a thread of its own may wait, its queue is where samples are dropped: there they are counted, and a message
    // that Zenoh gives up in the middle of its fragments can leave the priority's queue blocked (1.10.2).
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
    let mut keeping = publisher.cache(CacheConfig::default().max_samples(depth)).publisher_detection();
    if is_reliable {
        keeping = keeping.sample_miss_detection(MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT));
    }
    Ok(AnyPublisher::Keeping(keeping.wait()?))
}

impl AnyPublisher {
    fn put(&self, payload: ZBytes, attachment: &Attachment) -> zenoh::Result<()> {
        let attachment = attachment.encode();
        match self {
            AnyPublisher::Plain(publisher) => publisher.put(payload).attachment(attachment).wait(),
            AnyPublisher::Keeping(publisher) => publisher.put(payload).attachment(attachment).wait(),
        }
    }
}

/// To the threads that may wait.
struct Queues {
    patient: mpsc::SyncSender<Waiting>,
    bulk: mpsc::SyncSender<Waiting>,
}

/// A sample that may wait for its link.
struct Waiting {
    publisher: Arc<AnyPublisher>,
    payload: ZBytes,
    attachment: Attachment,
    len_bytes: usize,
    counters: Arc<Counters>,
}

fn send_waiting(samples: &mpsc::Receiver<Waiting>) {
    while let Ok(Waiting { publisher, payload, attachment, len_bytes, counters }) = samples.recv() {
        sent(&counters, publisher.put(payload, &attachment), len_bytes, &attachment);
    }
}

fn sent(counters: &Counters, outcome: zenoh::Result<()>, len_bytes: usize, attachment: &Attachment) {
    match outcome {
        Ok(()) => counters.passed(len_bytes, attachment.source_timestamp_ns),
        Err(_) => counters.dropped("refused by Zenoh"),
    }
}

/// A topic whose samples are taken.
struct Route {
    subscription: RawSubscription,
    counters: Arc<Counters>,
    senders: HashMap<Gid, Sender>,
    early: VecDeque<Early>,
    early_bytes: usize,
    /// Samples that the subscription has said are lost.
    lost: u64,
    flag: Arc<Flag>,
}

/// A sample whose publisher is not known yet.
struct Early {
    port: Gid,
    number: u64,
    info: MessageInfo,
    body: Vec<u8>,
    since: Instant,
}

/// Set when a topic's subscription was rung, or may take again since a sample was given back.
struct Flag {
    is_set: AtomicBool,
    waker: Arc<Waker>,
}

/// What ends the sleep of the thread that sends.
struct Waker {
    bell: Slot,
    /// Whether that thread takes rings just now, and will look at the flags after that: it need not be rung.
    is_draining: AtomicBool,
}

impl ArcWake for Flag {
    fn wake_by_ref(flag: &Arc<Self>) {
        // In one total order with the thread's own two steps in `Loop::run`: either it sees the flag, or it is rung.
        flag.is_set.store(true, Ordering::SeqCst);
        if !flag.waker.is_draining.load(Ordering::SeqCst) {
            flag.waker.bell.ring();
        }
    }
}

struct Loop {
    seat: SamplerSeat,
    commands: mpsc::Receiver<Command>,
    stop: Arc<AtomicBool>,
    waker: Arc<Waker>,
    own_ports: Arc<Mutex<HashSet<Gid>>>,
    waiting: Queues,
    routes: HashMap<TopicKey, Route>,
}

impl Loop {
    fn run(mut self) {
        // For samples of publishers that never became known, and for what a subscription counts by itself.
        const LOOK: Duration = Duration::from_millis(500);
        let mut next_look = Instant::now() + LOOK;
        while !self.stop.load(Ordering::Acquire) {
            self.waker.is_draining.store(true, Ordering::SeqCst);
            self.seat.drain(|_| {});
            self.waker.is_draining.store(false, Ordering::SeqCst);
            while let Ok(command) = self.commands.try_recv() {
                self.obey(command);
            }
            let own_ports = &self.own_ports;
            let mut is_busy = false;
            for route in self.routes.values_mut() {
                if route.flag.is_set.swap(false, Ordering::SeqCst) {
                    is_busy |= route.serve(&self.waiting, own_ports);
                }
            }
            if Instant::now() >= next_look {
                next_look = Instant::now() + LOOK;
                self.routes.values_mut().for_each(Route::look);
            }
            if !is_busy {
                self.seat.sleep(Some(monotonic_ns() + LOOK.as_nanos() as u64));
            }
        }
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Start(key, subscription, counters) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    // The new one has been there for a while: first what came before, then what came to both once.
                    route.serve_all(&self.waiting, &self.own_ports);
                    route.look();
                    (route.subscription, route.lost) = (subscription, 0);
                    return route.flag.is_set.store(true, Ordering::SeqCst);
                }
                let flag = Arc::new(Flag { is_set: AtomicBool::new(true), waker: self.waker.clone() });
                let (senders, early) = (HashMap::new(), VecDeque::new());
                let route = Route { subscription, counters, senders, early, early_bytes: 0, lost: 0, flag };
                self.routes.insert(key, route);
            }
            Command::Open(key, local, sender) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    route.open(local, sender, &self.waiting);
                }
            }
            Command::Close(key, local) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    // What it published before it went.
                    route.serve_all(&self.waiting, &self.own_ports);
                    route.senders.remove(&local);
                }
            }
            Command::Stop(key) => {
                if let Some(mut route) = self.routes.remove(&key) {
                    route.serve_all(&self.waiting, &self.own_ports);
                }
            }
        }
    }
}

impl Route {
    /// Takes and sends what is there, at most a turn of it. Says whether there may be more.
    fn serve(&mut self, waiting: &Queues, own_ports: &Mutex<HashSet<Gid>>) -> bool {
        let waker = waker(self.flag.clone());
        let mut context = Context::from_waker(&waker);
        for _ in 0..TURN {
            match self.subscription.poll_take(&mut context) {
                Poll::Ready(sample) => self.send(sample, waiting, own_ports),
                Poll::Pending => return false,
            }
        }
        self.flag.is_set.store(true, Ordering::SeqCst);
        true
    }

    /// Bounded, for a publisher could be faster than this.
    fn serve_all(&mut self, waiting: &Queues, own_ports: &Mutex<HashSet<Gid>>) {
        for _ in 0..64 {
            if !self.serve(waiting, own_ports) {
                break;
            }
        }
    }

    fn send(&mut self, sample: RawSample, waiting: &Queues, own_ports: &Mutex<HashSet<Gid>>) {
        let port = sample.port_gid();
        let number = sample.port_sequence_number();
        let Some(sender) = self.senders.get_mut(&port) else {
            if !own_ports.lock().unwrap_or_else(PoisonError::into_inner).contains(&port) {
                self.keep_early(port, &sample);
            }
            return;
        };
        if number <= sender.last {
            return;
        }
        sender.last = number;
        let (info, len_bytes) = (sample.info(), sample.body().len());
        sender.settle(len_bytes);
        // What may outlive the put is copied: a subscription can lend few samples.
        let may_stay = sender.may_wait();
        let payload =
            if may_stay || len_bytes < IN_PLACE_BYTES { copied(sample.body()) } else { in_place(sample) };
        put(sender, payload, &info, len_bytes, waiting, &self.counters);
    }

    fn keep_early(&mut self, port: Gid, sample: &RawSample) {
        let (body, number) = (sample.body(), sample.port_sequence_number());
        if self.early.iter().any(|early| early.port == port && early.number >= number) {
            return;
        }
        if self.early.len() >= EARLY_SAMPLES || self.early_bytes + body.len() > EARLY_BYTES {
            return self.counters.dropped("publisher not announced yet");
        }
        self.early_bytes += body.len();
        let (info, body) = (sample.info(), body.to_vec());
        self.early.push_back(Early { port, number, info, body, since: Instant::now() });
    }

    /// A publisher is known: what it sent before goes first.
    fn open(&mut self, local: Gid, mut sender: Sender, waiting: &Queues) {
        for early in std::mem::take(&mut self.early) {
            if early.port == local {
                self.early_bytes -= early.body.len();
                sender.settle(early.body.len());
                sender.last = early.number;
                let payload = copied(&early.body);
                put(&sender, payload, &early.info, early.body.len(), waiting, &self.counters);
            } else {
                self.early.push_back(early);
            }
        }
        self.senders.insert(local, sender);
    }

    fn look(&mut self) {
        let (counters, bytes) = (&self.counters, &mut self.early_bytes);
        self.early.retain(|early| {
            let stays = early.since.elapsed() < EARLY_TIME;
            if !stays {
                *bytes -= early.body.len();
                counters.dropped("publisher not announced yet");
            }
            stays
        });
        let lost = self.subscription.counters().lost();
        self.counters.lost(lost - self.lost);
        self.lost = lost;
    }
}

fn put(
    sender: &Sender,
    payload: ZBytes,
    info: &MessageInfo,
    len_bytes: usize,
    waiting: &Queues,
    counters: &Arc<Counters>,
) {
    let attachment = sender.attachment(info);
    let publisher = &sender.publisher;
    let queue = match (sender.may_wait(), sender.is_bulk) {
        (true, _) => &waiting.patient,
        (false, true) => &waiting.bulk,
        (false, false) => return sent(counters, publisher.put(payload, &attachment), len_bytes, &attachment),
    };
    let (publisher, counters) = (publisher.clone(), counters.clone());
    if let Err(refused) = queue.try_send(Waiting { publisher, payload, attachment, len_bytes, counters }) {
        let (mpsc::TrySendError::Full(sample) | mpsc::TrySendError::Disconnected(sample)) = refused;
        sample.counters.dropped("too many samples wait for the link");
    }
}

/// The encapsulation and a copy of the body, in one piece.
fn copied(body: &[u8]) -> ZBytes {
    let mut payload = Vec::with_capacity(ENCAPSULATION.len() + body.len());
    payload.extend_from_slice(&ENCAPSULATION);
    payload.extend_from_slice(body);
    payload.into()
}

/// The encapsulation and the body where it lies: Zenoh copies it into its packets before `put` returns, and then lets
/// go of it.
fn in_place(sample: RawSample) -> ZBytes {
    let mut payload = ZBuf::default();
    payload.push_zslice(ZSlice::from(ENCAPSULATION));
    payload.push_zslice(ZSlice::from(Body(sample)));
    payload.into()
}

#[derive(Debug)]
struct Body(RawSample);

impl ZSliceBuffer for Body {
    fn as_slice(&self) -> &[u8] {
        self.0.body()
    }

    fn as_any(&self) -> &dyn Any {
        self
    }

    fn as_any_mut(&mut self) -> &mut dyn Any {
        self
    }
}

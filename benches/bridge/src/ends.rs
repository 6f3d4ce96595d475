// SPDX-License-Identifier: MIT OR Apache-2.0
//! The processes that publish and subscribe, on either side.

use futures::StreamExt;
use futures::executor::LocalPool;
use futures::task::{ArcWake, LocalSpawnExt, waker};
use r2r::std_msgs::msg::UInt64;
use r2r::{Context, Node, QosProfile};
use serde::{Deserialize, Serialize};
use std::cell::RefCell;
use std::io::BufRead;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::task::Poll;
use std::time::{Duration, Instant};
use tautline_harness::{Distribution, Result};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{Limits, Participant, Qos, RawPublisher, RawSubscription, TopicType};

/// Messages that a queue holds: five seconds of the default rate. What found no room in Fast DDS's shared memory is sent again after its
/// heartbeat of 3 s, if it is kept until then.
const DEPTH: usize = 5000;
/// Of a topic, that can be told apart.
pub const MAX_MESSAGES: u32 = 1 << 20;
const TYPE: &str = "std_msgs/msg/UInt64";
/// How long what is under way may take to arrive.
const LAST: Duration = Duration::from_secs(10);

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Side {
    Ros,
    Tautline,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Role {
    Publisher,
    Subscriber,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Job {
    pub side: Side,
    pub role: Role,
    pub topics: usize,
    pub rate: u32,
    /// Of each topic.
    pub messages: u32,
    pub domain: u32,
    /// When the run began.
    pub epoch_ns: u64,
}

/// What a process says: a line of JSON.
#[derive(Serialize, Deserialize)]
pub enum Line {
    /// It has its endpoints.
    Ready,
    /// All subscriptions are matched with a publisher.
    Matched,
    Published,
    Received(Received),
}

/// What a subscriber got.
#[derive(Serialize, Deserialize)]
pub struct Received {
    /// Of messages in order, none twice: how often each occurred.
    pub latencies_ns: Vec<(u64, u64)>,
    /// That came again, or after a later one of the same topic.
    pub disordered: u64,
}

impl Line {
    fn say(&self) -> Result {
        println!("{}", serde_json::to_string(self)?);
        Ok(())
    }
}

impl Job {
    fn names(&self) -> impl Iterator<Item = String> {
        (0..self.topics).map(|number| format!("/bench/t{number}"))
    }

    fn expected(&self) -> u64 {
        self.topics as u64 * u64::from(self.messages)
    }
}

pub fn run(job: &str) -> Result {
    let job: Job = serde_json::from_str(job)?;
    match (job.side, job.role) {
        (Side::Ros, Role::Publisher) => publish_in_ros(&job),
        (Side::Ros, Role::Subscriber) => subscribe_in_ros(&job),
        (Side::Tautline, Role::Publisher) => publish_in_tautline(&job),
        (Side::Tautline, Role::Subscriber) => subscribe_in_tautline(&job),
    }
}

/// A message: its number within its topic, and when it was published, since the run began.
struct Stamp {
    number: u32,
    published_ns: u64,
}

impl Stamp {
    const NUMBER_BITS: u32 = MAX_MESSAGES.trailing_zeros();

    fn now(number: u32, epoch_ns: u64) -> Self {
        Stamp { number, published_ns: monotonic_ns() - epoch_ns }
    }

    fn to_u64(&self) -> u64 {
        self.published_ns << Self::NUMBER_BITS | u64::from(self.number)
    }

    fn from_u64(stamp: u64) -> Self {
        let number = (stamp & u64::from(MAX_MESSAGES - 1)) as u32;
        Stamp { number, published_ns: stamp >> Self::NUMBER_BITS }
    }
}

/// What has arrived, from the stamp in each message.
struct Log {
    epoch_ns: u64,
    expected: u64,
    latencies: Distribution,
    /// Of each topic, the number after the highest that has arrived.
    next: Vec<u32>,
    disordered: u64,
}

impl Log {
    fn new(job: &Job) -> Self {
        let (latencies, next) = (Distribution::new(), vec![0; job.topics]);
        Log { epoch_ns: job.epoch_ns, expected: job.expected(), latencies, next, disordered: 0 }
    }

    /// A message counts if it comes after all before it: one that comes twice is none more.
    fn note(&mut self, topic: usize, stamp: u64) {
        let stamp = Stamp::from_u64(stamp);
        let latency_ns = (monotonic_ns() - self.epoch_ns).saturating_sub(stamp.published_ns);
        if stamp.number < self.next[topic] {
            self.disordered += 1;
            return;
        }
        self.next[topic] = stamp.number + 1;
        self.latencies.record(latency_ns.max(1));
    }

    fn is_complete(&self) -> bool {
        self.latencies.len() >= self.expected
    }

    fn say(&self) -> Result {
        let (latencies_ns, disordered) = (self.latencies.counts(), self.disordered);
        Line::Received(Received { latencies_ns, disordered }).say()
    }
}

/// Whether the parent has said that it is over.
fn told_to_end() -> mpsc::Receiver<()> {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let _ = std::io::stdin().lock().lines().next();
        let _ = sender.send(());
    });
    receiver
}

/// Ends when all has arrived, or some time after the parent has said that nothing more is sent.
struct Patience {
    told: mpsc::Receiver<()>,
    since: Option<Instant>,
}

impl Patience {
    fn new() -> Self {
        Patience { told: told_to_end(), since: None }
    }

    fn is_over(&mut self, is_complete: bool) -> bool {
        if self.since.is_none() && self.told.try_recv().is_ok() {
            self.since = Some(Instant::now());
        }
        self.since.is_some_and(|since| is_complete || since.elapsed() > LAST)
    }
}

fn subscribe_in_ros(job: &Job) -> Result {
    let mut node = Node::create(Context::create()?, "bench_subscriber", "")?;
    let mut pool = LocalPool::new();
    let log = Rc::new(RefCell::new(Log::new(job)));
    for (topic, name) in job.names().enumerate() {
        let messages = node.subscribe::<UInt64>(&name, QosProfile::default().keep_last(DEPTH))?;
        let log = log.clone();
        pool.spawner().spawn_local(messages.for_each(move |message| {
            log.borrow_mut().note(topic, message.data);
            std::future::ready(())
        }))?;
    }
    Line::Ready.say()?;
    let mut patience = Patience::new();
    while !patience.is_over(log.borrow().is_complete()) {
        node.spin_once(Duration::from_millis(10));
        pool.run_until_stalled();
    }
    log.borrow().say()
}

fn publish_in_ros(job: &Job) -> Result {
    let mut node = Node::create(Context::create()?, "bench_publisher", "")?;
    let qos = || QosProfile::default().keep_last(DEPTH);
    let publishers: Vec<_> = job
        .names()
        .map(|name| node.create_publisher::<UInt64>(&name, qos()))
        .collect::<std::result::Result<_, _>>()?;
    Line::Ready.say()?;
    // r2r's subscriber, and the bridge.
    for publisher in &publishers {
        while publisher.get_inter_process_subscription_count()? < 2 {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    Line::Matched.say()?;
    publish(job, |topic, stamp| Ok(publishers[topic].publish(&UInt64 { data: stamp.to_u64() })?))
}

fn publish_in_tautline(job: &Job) -> Result {
    let participant = Participant::new(job.domain)?;
    let publish_one = |name: String| {
        participant.create_raw_publisher(&name, &TopicType::new(TYPE), Qos::keep_last(DEPTH), limits())
    };
    let publishers: Vec<RawPublisher> =
        job.names().map(publish_one).collect::<std::result::Result<_, _>>()?;
    Line::Ready.say()?;
    // Tautline's subscriber, and the bridge.
    for publisher in &publishers {
        while publisher.subscription_count() < 2 {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    Line::Matched.say()?;
    publish(job, |topic, stamp| Ok(publishers[topic].publish(&stamp.to_u64().to_le_bytes())?))
}

fn limits() -> Limits {
    Limits { message_bytes: 64, ..Limits::default() }
}

/// The topics take turns, evenly.
fn publish(job: &Job, mut publish_one: impl FnMut(usize, Stamp) -> Result) -> Result {
    let _ = std::io::stdin().lock().lines().next();
    let interval_ns = 1_000_000_000 / (u64::from(job.rate) * job.topics as u64);
    let mut next_ns = monotonic_ns();
    for number in 0..job.messages {
        for topic in 0..job.topics {
            sleep_until_monotonic(next_ns);
            publish_one(topic, Stamp::now(number, job.epoch_ns))?;
            next_ns += interval_ns;
        }
    }
    Line::Published.say()?;
    // What it kept may still be asked for.
    let _ = std::io::stdin().lock().lines().next();
    Ok(())
}

struct Flag(AtomicBool);

impl ArcWake for Flag {
    fn wake_by_ref(flag: &Arc<Self>) {
        flag.0.store(true, Ordering::Release);
    }
}

fn subscribe_in_tautline(job: &Job) -> Result {
    let participant = Participant::new(job.domain)?;
    let seat = participant.doorbell().claim_sampler()?;
    let subscribe = |name: String| {
        participant.create_raw_subscription(&name, &TopicType::new(TYPE), Qos::keep_last(DEPTH), limits())
    };
    let all: Vec<RawSubscription> = job.names().map(subscribe).collect::<std::result::Result<_, _>>()?;
    let flags: Vec<_> = all.iter().map(|_| Arc::new(Flag(AtomicBool::new(true)))).collect();
    let mut log = Log::new(job);
    Line::Ready.say()?;
    let mut patience = Patience::new();
    while !patience.is_over(log.is_complete()) {
        seat.drain(|_| {});
        for (topic, (subscription, flag)) in all.iter().zip(&flags).enumerate() {
            if !flag.0.swap(false, Ordering::AcqRel) {
                continue;
            }
            let waker = waker(flag.clone());
            let mut context = std::task::Context::from_waker(&waker);
            while let Poll::Ready(Some(sample)) = subscription.poll_take(&mut context) {
                let stamp = sample.body().get(..8).and_then(|stamp| stamp.try_into().ok());
                log.note(topic, u64::from_le_bytes(stamp.ok_or("a message without a stamp")?));
            }
        }
        seat.sleep(Some(monotonic_ns() + 10_000_000));
    }
    log.say()
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! From ROS to shared memory: one thread waits for all subscriptions and takes from each until it is empty.
//!
//! So there is one queue, the RMW's, and its depth is the QoS's: between it and the loan is no channel that could
//! overflow. A message is taken into a buffer of rmw's, checked there, and copied once, into a loan.

use crate::mirror::InKey;
use crate::outgoing::ENCAPSULATION;
use crate::rate::Limiter;
use crate::rcl::{
    Context, GuardCondition, RclError, RosMessageInfo, RosSubscription, SerializedMessage, WaitSet, Waitable,
};
use crate::ros_graph::NAME_TIME;
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::{Counters, Numbers};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{JoinHandle, RtError, ThreadBuilder, ThreadInfo};
use tautline_schema::{DynamicMessage, Endian, Schema};
use tautline_transport::{Gid, LoanError, MessageInfo, PublishError, RawPublisher};

/// Messages taken of one topic before the next topic has its turn.
const TURN: usize = 64;
/// Messages of publishers that are not known yet, and how long they are waited for: longer than it takes to give up the name of
/// a publisher's node, and the next look at the graph.
const EARLY_MESSAGES: usize = 1000;
const EARLY_BYTES: usize = 64 << 20;
const EARLY_TIME: Duration = NAME_TIME.saturating_add(Duration::from_secs(3));
/// How often it is looked whether something has waited long enough.
const LOOK: Duration = Duration::from_secs(1);

/// How long a subscription is kept beside the one that replaces it: publishers have found that by then, which they tell nobody.
const RENEWAL_TIME: Duration = Duration::from_secs(3);

/// A topic and class that come in.
pub(crate) struct Inlet {
    pub(crate) subscription: RosSubscription,
    pub(crate) port: Port,
    pub(crate) schema: Arc<Schema>,
    pub(crate) counters: Arc<Counters>,
    pub(crate) limiter: Limiter,
    pub(crate) senders: Senders,
}

/// What messages come through here.
pub(crate) enum Port {
    /// There is nobody who sends.
    None,
    /// Through the one that the key has: what it keeps for late joiners stays.
    Same,
    New(Box<RawPublisher>),
}

/// Whose messages a subscription passes on: it may match others, which a subscription of their class takes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Senders {
    wanted: BTreeSet<Gid>,
    /// Of other classes, and of bridges.
    others: BTreeSet<Gid>,
}

/// What a message's publisher is to a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sender {
    Wanted,
    Other,
    /// Not known yet: its message waits.
    Unknown,
}

impl Senders {
    /// Of all publishers of the topic that are `known`, `publishers` are those of the class. Without a port for them their
    /// messages wait.
    pub(crate) fn of(known: &BTreeSet<Gid>, publishers: &BTreeSet<Gid>, has_port: bool) -> Self {
        Senders {
            wanted: if has_port { publishers.clone() } else { BTreeSet::new() },
            others: known.difference(publishers).copied().collect(),
        }
    }

    fn find(&self, gid: &Gid) -> Sender {
        match (self.wanted.contains(gid), self.others.contains(gid)) {
            (true, _) => Sender::Wanted,
            (_, true) => Sender::Other,
            _ => Sender::Unknown,
        }
    }
}

enum Command {
    Start(InKey, Box<Inlet>),
    Change(InKey, Senders, Limiter, Option<Box<RawPublisher>>),
    Stop(InKey),
}

/// The thread that takes from ROS; dropping it ends it.
pub(crate) struct Incoming {
    commands: Option<mpsc::Sender<Command>>,
    guard: Arc<GuardCondition>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Why the thread did not start.
#[derive(Debug, thiserror::Error)]
pub(crate) enum IncomingError {
    #[error(transparent)]
    Rt(#[from] RtError),
    #[error(transparent)]
    Rcl(#[from] RclError),
}

impl Incoming {
    pub(crate) fn start(context: &Arc<Context>, thread: ThreadBuilder) -> Result<Self, IncomingError> {
        let guard = GuardCondition::new(context)?;
        let stop = Arc::new(AtomicBool::new(false));
        let (commands, received) = mpsc::channel();
        let (wait_set, buffer) = (WaitSet::new(context)?, SerializedMessage::new()?);
        let thread = {
            let (stop, guard) = (stop.clone(), guard.clone());
            let routes = Vec::new();
            thread.spawn(move || {
                move || Loop { commands: received, stop, guard, wait_set, buffer, routes }.run()
            })?
        };
        Ok(Incoming { commands: Some(commands), guard, stop, thread: Some(thread) })
    }

    /// The thread, as it was read back.
    pub(crate) fn info(&self) -> Option<&ThreadInfo> {
        self.thread.as_ref().map(JoinHandle::info)
    }

    /// Takes from now on; in place of what the key had.
    pub(crate) fn open(&self, key: InKey, inlet: Inlet) {
        self.tell(Command::Start(key, Box::new(inlet)));
    }

    /// With a `port` if there was none.
    pub(crate) fn change(&self, key: InKey, senders: Senders, limiter: Limiter, port: Option<RawPublisher>) {
        self.tell(Command::Change(key, senders, limiter, port.map(Box::new)));
    }

    pub(crate) fn close(&self, key: InKey) {
        self.tell(Command::Stop(key));
    }

    fn tell(&self, command: Command) {
        if let Some(commands) = &self.commands {
            let _ = commands.send(command);
            self.guard.trigger();
        }
    }
}

impl Drop for Incoming {
    fn drop(&mut self) {
        self.commands = None;
        self.stop.store(true, Ordering::Release);
        self.guard.trigger();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Loop {
    commands: mpsc::Receiver<Command>,
    stop: Arc<AtomicBool>,
    guard: Arc<GuardCondition>,
    wait_set: WaitSet,
    buffer: SerializedMessage,
    routes: Vec<(InKey, Route)>,
}

struct Route {
    inlet: Box<Inlet>,
    /// Subscriptions before this one, the oldest first, and until when they are taken from: who keeps nothing for late joiners
    /// does not send to the new one before they have found each other.
    previous: Vec<(RosSubscription, Instant)>,
    numbers: Numbers,
    early: Vec<Early>,
    early_bytes: usize,
    /// Whether a turn ended before the queue was empty.
    has_more: bool,
}

/// A message of a publisher that is not known yet.
struct Early {
    bytes: Vec<u8>,
    info: RosMessageInfo,
    since: Instant,
}

impl Loop {
    fn run(mut self) {
        while !self.stop.load(Ordering::Acquire) {
            while let Ok(command) = self.commands.try_recv() {
                self.obey(command);
            }
            let is_busy = self.routes.iter().any(|(_, route)| route.has_more);
            let is_waiting =
                self.routes.iter().any(|(_, route)| !route.early.is_empty() || !route.previous.is_empty());
            let timeout = match (is_busy, is_waiting) {
                (true, _) => Some(Duration::ZERO),
                (_, true) => Some(LOOK),
                _ => None,
            };
            let subscriptions = self.routes.iter().flat_map(|(_, route)| route.subscriptions());
            let all: Vec<_> =
                subscriptions.map(Waitable::Subscription).chain([Waitable::Guard(&self.guard)]).collect();
            let mut ready = match self.wait_set.wait(&all, timeout) {
                Ok(ready) => ready.iter(),
                Err(error) => {
                    // What was said once is enough; a thread of this priority must not spin.
                    tracing::error!("nothing comes from ROS: {error}");
                    std::thread::sleep(Duration::from_secs(1));
                    continue;
                }
            };
            for (_, route) in &mut self.routes {
                let is_ready =
                    ready.by_ref().take(route.subscriptions().count()).fold(false, |any, one| any | one);
                if is_ready || route.has_more {
                    route.serve(&mut self.buffer);
                }
                route.look();
            }
        }
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Start(key, inlet) => {
                let mut route = Route::new(inlet);
                if let Some(old) = self.end(&key) {
                    route.take_over(old, key.class.is_kept);
                }
                route.settle();
                self.routes.push((key, route));
            }
            Command::Change(key, senders, limiter, port) => {
                if let Some((_, route)) = self.routes.iter_mut().find(|(other, _)| *other == key) {
                    if limiter.period_ns() != route.inlet.limiter.period_ns() {
                        route.inlet.limiter = limiter;
                    }
                    if let Some(port) = port {
                        route.inlet.port = Port::New(port);
                    }
                    route.inlet.senders = senders;
                    route.settle();
                }
            }
            Command::Stop(key) => drop(self.end(&key)),
        }
    }

    /// What arrived before still goes through, or is left over.
    fn end(&mut self, key: &InKey) -> Option<Route> {
        let at = self.routes.iter().position(|(other, _)| other == key)?;
        let (_, mut route) = self.routes.swap_remove(at);
        // Bounded, for a publisher could be faster than this.
        for _ in 0..64 {
            route.serve(&mut self.buffer);
            if !route.has_more {
                break;
            }
        }
        Some(route)
    }
}

impl Route {
    fn new(inlet: Box<Inlet>) -> Self {
        Route {
            inlet,
            previous: Vec::new(),
            numbers: Numbers::default(),
            early: Vec::new(),
            early_bytes: 0,
            has_more: true,
        }
    }

    /// In the order in which they are taken from.
    fn subscriptions(&self) -> impl Iterator<Item = &RosSubscription> {
        self.previous.iter().map(|(subscription, _)| subscription).chain([&self.inlet.subscription])
    }

    /// Goes on where the other ended: both may get the same, which its numbers tell. But what a new port is to keep for late
    /// joiners must come through it, so who listens already gets it once more.
    fn take_over(&mut self, old: Route, is_kept: bool) {
        let is_same_port = matches!(self.inlet.port, Port::Same);
        if is_same_port {
            self.inlet.port = old.inlet.port;
        }
        if is_same_port || !is_kept {
            self.numbers = old.numbers;
        }
        if !is_kept {
            self.previous = old.previous;
            self.previous.push((old.inlet.subscription, Instant::now() + RENEWAL_TIME));
        }
        self.early = old.early;
    }

    /// Takes and passes on what is there, at most a turn of it.
    fn serve(&mut self, buffer: &mut SerializedMessage) {
        for _ in 0..TURN {
            match self.take(buffer) {
                Ok(Some(info)) => self.receive(buffer.bytes(), info),
                Ok(None) => return self.has_more = false,
                Err(error) => {
                    self.inlet.counters.dropped(error.reason);
                    return self.has_more = false;
                }
            }
        }
        self.has_more = true;
    }

    /// From previous subscriptions first: what the new one has follows on it. What both get is told by its number; of an RMW that
    /// gives none, both copies are passed on.
    fn take(&mut self, buffer: &mut SerializedMessage) -> Result<Option<RosMessageInfo>, RclError> {
        for (previous, _) in &mut self.previous {
            if let Some(info) = previous.take(buffer)? {
                return Ok(Some(info));
            }
        }
        self.inlet.subscription.take(buffer)
    }

    fn receive(&mut self, bytes: &[u8], info: RosMessageInfo) {
        match self.inlet.senders.find(&info.gid) {
            _ if info.is_own => {}
            Sender::Wanted => self.pass(bytes, info),
            Sender::Other => {}
            Sender::Unknown => self.keep_early(bytes, info),
        }
    }

    fn pass(&mut self, bytes: &[u8], info: RosMessageInfo) {
        if let Some(number) = info.sequence_number {
            let Some(missing) = self.numbers.missing(info.gid, number) else { return };
            self.inlet.counters.lost(missing);
        }
        match self.inlet.pass(bytes, info) {
            Ok(len_bytes) => self.inlet.counters.passed(len_bytes, info.source_timestamp_ns),
            Err(reason) => self.inlet.counters.dropped(reason),
        }
    }

    fn keep_early(&mut self, bytes: &[u8], info: RosMessageInfo) {
        if self.early.len() >= EARLY_MESSAGES || self.early_bytes + bytes.len() > EARLY_BYTES {
            return self.inlet.counters.dropped(Dropped::Unknown);
        }
        self.early_bytes += bytes.len();
        self.early.push(Early { bytes: bytes.to_vec(), info, since: Instant::now() });
    }

    /// The senders changed: what waited for that goes on, in order.
    fn settle(&mut self) {
        self.early_bytes = 0;
        for early in std::mem::take(&mut self.early) {
            match self.inlet.senders.find(&early.info.gid) {
                Sender::Wanted => self.pass(&early.bytes, early.info),
                Sender::Other => {}
                Sender::Unknown => {
                    self.early_bytes += early.bytes.len();
                    self.early.push(early);
                }
            }
        }
        let wanted = &self.inlet.senders.wanted;
        self.numbers.forget(|gid| !wanted.contains(gid));
    }

    /// What has waited long enough goes.
    fn look(&mut self) {
        // Not before it was empty.
        if !self.has_more {
            self.previous.retain(|(_, until)| Instant::now() < *until);
        }
        if self.early.first().is_some_and(|early| early.since.elapsed() >= EARLY_TIME) {
            let (counters, bytes) = (&self.inlet.counters, &mut self.early_bytes);
            self.early.retain(|early| {
                let stays = early.since.elapsed() < EARLY_TIME;
                if !stays {
                    *bytes -= early.bytes.len();
                    counters.dropped(Dropped::Unknown);
                }
                stays
            });
        }
    }
}

/// Why a message from ROS was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
enum Dropped {
    #[error("rate limit")]
    Rate,
    #[error("publisher not known yet")]
    Unknown,
    #[error("shorter than its encapsulation")]
    Short,
    #[error("big endian, which is not converted")]
    BigEndian,
    #[error("encapsulated as XCDR2 or as a parameter list, not as XCDR1")]
    Encapsulation,
    #[error("not a message of its type")]
    Invalid,
    #[error(transparent)]
    Loan(#[from] LoanError),
    #[error("{0}")]
    Publish(PublishError),
}

/// The body, if it is one that can be read in place.
fn body(bytes: &[u8]) -> Result<&[u8], Dropped> {
    // The last two bytes are options, which say how much padding follows.
    match bytes {
        [kind, encoding, _, _, body @ ..] if [*kind, *encoding] == ENCAPSULATION[..2] => Ok(body),
        [0, 0, _, _, ..] => Err(Dropped::BigEndian),
        [_, _, _, _, ..] => Err(Dropped::Encapsulation),
        _ => Err(Dropped::Short),
    }
}

impl Inlet {
    /// Checks a message and publishes it here. Returns its length.
    fn pass(&mut self, bytes: &[u8], info: RosMessageInfo) -> Result<usize, Dropped> {
        let Port::New(port) = &self.port else { return Err(Dropped::Unknown) };
        let source = MessageInfo {
            sequence_number: info.sequence_number.unwrap_or(0),
            source_timestamp_ns: info.source_timestamp_ns,
            released_ns: 0,
            publisher_gid: info.gid,
        };
        port.traced().received(&source);
        if !self.limiter.admits(monotonic_ns()) {
            return Err(Dropped::Rate);
        }
        let body = body(bytes)?;
        let trailing =
            DynamicMessage::validate(&self.schema, body, Endian::Little).map_err(|_| Dropped::Invalid)?;
        // What follows the last field is nobody's.
        let body = body.get(..body.len().saturating_sub(trailing)).unwrap_or_default();
        let mut loan = port.loan(body.len())?;
        loan.copy_from_slice(body);
        loan.publish_as(source).map_err(|unpublished| Dropped::Publish(unpublished.into()))?;
        Ok(body.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_is_of_another_class_is_not_waited_for() {
        let [wanted, other, new] = [1, 2, 3].map(|id| Gid([id; 16]));
        let publishers = BTreeSet::from([wanted]);
        let found = |known: &[Gid], has_port| {
            let senders = Senders::of(&known.iter().copied().collect(), &publishers, has_port);
            [wanted, other, new].map(|gid| senders.find(&gid))
        };
        assert_eq!(found(&[wanted, other], true), [Sender::Wanted, Sender::Other, Sender::Unknown]);
        assert_eq!(found(&[wanted, other, new], true), [Sender::Wanted, Sender::Other, Sender::Other]);
        // Whose port could not be made: its messages wait for the next try.
        assert_eq!(found(&[wanted, other], false), [Sender::Unknown, Sender::Other, Sender::Unknown]);
    }

    #[test]
    fn what_is_no_xcdr1_is_refused_with_its_reason() {
        assert_eq!(body(&[0, 1, 0, 3, 7]), Ok(&[7][..]));
        assert_eq!(body(&[0, 1, 0, 0]), Ok(&[][..]));
        assert_eq!(body(&[0, 0, 0, 0, 7]), Err(Dropped::BigEndian));
        for kind in [2, 3, 6, 7, 8, 9, 10, 11] {
            assert_eq!(body(&[0, kind, 0, 0, 7]), Err(Dropped::Encapsulation));
        }
        assert_eq!(body(&[1, 1, 0, 0]), Err(Dropped::Encapsulation));
        for len in 0..4 {
            assert_eq!(body(&[0, 1, 0, 0][..len]), Err(Dropped::Short));
        }
    }
}

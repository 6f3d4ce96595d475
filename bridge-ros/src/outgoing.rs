// SPDX-License-Identifier: MIT OR Apache-2.0
//! From shared memory to ROS: one thread takes the samples of all topics and publishes them.
//!
//! It waits on the doorbell as a sampler does. A body is copied once, from shared memory behind the encapsulation in a
//! buffer of rmw's, which ROS then has. A local publisher notices nothing of it.

use crate::mirror::TopicKey;
use crate::rate::Limiter;
use crate::rcl::{RclError, RosPublisher, SerializedMessage};
use crate::stats::Counters;
use futures::task::{ArcWake, waker};
use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{JoinHandle, RtError, ThreadBuilder, ThreadInfo};
use tautline_transport::{Gid, Participant, RawSample, RawSubscription, SamplerSeat, Slot, TransportError};

/// Samples taken of one topic before the next topic has its turn.
const TURN: usize = 16;
/// XCDR1, little endian.
pub(crate) const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];
/// Samples of publishers whose counterpart in ROS is not there yet, per topic.
const EARLY_SAMPLES: usize = 1000;
const EARLY_BYTES: usize = 64 << 20;
const EARLY_TIME: Duration = Duration::from_secs(3);

/// What the control thread tells the one that publishes.
enum Command {
    /// Also of a topic that is being taken: by this subscription from now on.
    Start(TopicKey, Box<RawSubscription>, Arc<Counters>, Limiter),
    Open(TopicKey, Gid, Writer),
    Close(TopicKey, Gid),
    Stop(TopicKey),
}

/// The thread that publishes in ROS; dropping it ends it.
pub(crate) struct Outgoing {
    commands: Option<mpsc::Sender<Command>>,
    stop: Arc<AtomicBool>,
    waker: Arc<Waker>,
    relays: Relays,
    thread: Option<JoinHandle<()>>,
}

/// Ports of bridges and gateways, this one's too: what comes through them does not go on.
pub(crate) type Relays = Arc<Mutex<HashSet<Gid>>>;

/// Why the thread did not start.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OutgoingError {
    #[error(transparent)]
    Transport(#[from] TransportError),
    #[error(transparent)]
    Rt(#[from] RtError),
    #[error(transparent)]
    Rcl(#[from] RclError),
}

impl Outgoing {
    pub(crate) fn start(participant: &Participant, thread: ThreadBuilder) -> Result<Self, OutgoingError> {
        let seat = participant.doorbell().claim_sampler()?;
        let bell = participant.claim_slot()?;
        let waker = Arc::new(Waker { bell, is_draining: AtomicBool::new(false) });
        let (commands, received) = mpsc::channel();
        let (stop, relays) = (Arc::new(AtomicBool::new(false)), Relays::default());
        let buffer = SerializedMessage::new()?;
        let thread = {
            let (stop, relays, waker) = (stop.clone(), relays.clone(), waker.clone());
            let routes = HashMap::new();
            thread.spawn(move || {
                move || Loop { seat, commands: received, stop, waker, relays, routes, buffer }.run()
            })?
        };
        Ok(Outgoing { commands: Some(commands), stop, waker, relays, thread: Some(thread) })
    }

    /// The thread, as it was read back.
    pub(crate) fn info(&self) -> Option<&ThreadInfo> {
        self.thread.as_ref().map(JoinHandle::info)
    }

    /// Takes this topic's samples from now on.
    pub(crate) fn start_topic(
        &self,
        key: TopicKey,
        subscription: RawSubscription,
        counters: Arc<Counters>,
        limiter: Limiter,
    ) {
        self.tell(Command::Start(key, Box::new(subscription), counters, limiter));
    }

    /// What the publisher `gid` sends goes through `writer`.
    pub(crate) fn open(&self, key: TopicKey, gid: Gid, writer: Writer) {
        self.tell(Command::Open(key, gid, writer));
    }

    pub(crate) fn close(&self, key: TopicKey, gid: Gid) {
        self.tell(Command::Close(key, gid));
    }

    pub(crate) fn stop_topic(&self, key: TopicKey) {
        self.tell(Command::Stop(key));
    }

    pub(crate) fn relays(&self) -> &Relays {
        &self.relays
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
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A topic whose samples are taken.
struct Route {
    subscription: Box<RawSubscription>,
    counters: Arc<Counters>,
    limiter: Limiter,
    writers: HashMap<Gid, Writer>,
    early: VecDeque<Early>,
    early_bytes: usize,
    /// Samples that the subscription has said are lost.
    lost: u64,
    flag: Arc<Flag>,
}

/// A publisher in ROS that stands for one here.
#[derive(Clone)]
pub(crate) struct Writer {
    pub(crate) publisher: Arc<RosPublisher>,
    pub(crate) last: Last,
}

/// The last sample's number at its port: a subscription that takes over, or begins anew and gets what is kept, sees some again.
/// It lives as long as the publisher in ROS, which has them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Last(Arc<AtomicU64>);

impl Last {
    /// Whether it is new; it is not from now on.
    fn admits(&self, number: u64) -> bool {
        self.0.fetch_max(number, Ordering::Relaxed) < number
    }
}

/// A sample whose publisher has no counterpart in ROS yet.
struct Early {
    port: Gid,
    number: u64,
    body: Vec<u8>,
    since: Instant,
}

/// Set when a topic's subscription was rung, or may take again since a sample was given back.
struct Flag {
    is_set: AtomicBool,
    waker: Arc<Waker>,
}

/// What ends the sleep of the thread that publishes.
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
    relays: Relays,
    routes: HashMap<TopicKey, Route>,
    buffer: SerializedMessage,
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
            let mut is_busy = false;
            for route in self.routes.values_mut() {
                if route.flag.is_set.swap(false, Ordering::SeqCst) {
                    is_busy |= route.serve(&self.relays, &mut self.buffer);
                }
            }
            if Instant::now() >= next_look {
                next_look = Instant::now() + LOOK;
                self.routes.values_mut().for_each(|route| route.look(&self.relays));
            }
            if !is_busy {
                self.seat.sleep(Some(monotonic_ns() + LOOK.as_nanos() as u64));
            }
        }
    }

    fn obey(&mut self, command: Command) {
        let (relays, buffer) = (&self.relays, &mut self.buffer);
        match command {
            Command::Start(key, subscription, counters, limiter) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    // The new one has been there for a while: first what came before, then what came to both once.
                    route.serve_all(relays, buffer);
                    route.look(relays);
                    (route.subscription, route.limiter, route.lost) = (subscription, limiter, 0);
                    return route.flag.is_set.store(true, Ordering::SeqCst);
                }
                let flag = Arc::new(Flag { is_set: AtomicBool::new(true), waker: self.waker.clone() });
                let (writers, early) = (HashMap::new(), VecDeque::new());
                let route =
                    Route { subscription, counters, limiter, writers, early, early_bytes: 0, lost: 0, flag };
                self.routes.insert(key, route);
            }
            Command::Open(key, gid, writer) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    route.open(gid, writer, buffer);
                }
            }
            Command::Close(key, gid) => {
                if let Some(route) = self.routes.get_mut(&key) {
                    // What it published before it went.
                    route.serve_all(relays, buffer);
                    route.writers.remove(&gid);
                }
            }
            Command::Stop(key) => {
                if let Some(mut route) = self.routes.remove(&key) {
                    route.serve_all(relays, buffer);
                    route.look(relays);
                    route.early.iter().for_each(|_| route.counters.dropped(NO_COUNTERPART));
                }
            }
        }
    }
}

impl Route {
    /// Takes and publishes what is there, at most a turn of it. Says whether there may be more.
    fn serve(&mut self, relays: &Relays, buffer: &mut SerializedMessage) -> bool {
        let waker = waker(self.flag.clone());
        let mut context = Context::from_waker(&waker);
        for _ in 0..TURN {
            match self.subscription.poll_take(&mut context) {
                Poll::Ready(sample) => self.pass(&sample, relays, buffer),
                Poll::Pending => return false,
            }
        }
        self.flag.is_set.store(true, Ordering::SeqCst);
        true
    }

    /// All that was there: bounded by what fits in, for a publisher could be faster than this.
    fn serve_all(&mut self, relays: &Relays, buffer: &mut SerializedMessage) {
        // And one publisher that has gone.
        let publishers = self.subscription.publisher_count() + 1;
        for _ in 0..turns(self.subscription.qos().depth, publishers) {
            if !self.serve(relays, buffer) {
                break;
            }
        }
    }

    fn pass(&mut self, sample: &RawSample, relays: &Relays, buffer: &mut SerializedMessage) {
        let (port, number) = (sample.port_gid(), sample.port_sequence_number());
        let Some(writer) = self.writers.get(&port) else {
            if !relays.lock().unwrap_or_else(PoisonError::into_inner).contains(&port) {
                self.keep_early(port, sample);
            }
            return;
        };
        if writer.last.admits(number) {
            publish(&writer.publisher, sample.body(), buffer, &self.counters, &mut self.limiter);
        }
    }

    fn keep_early(&mut self, port: Gid, sample: &RawSample) {
        let (body, number) = (sample.body(), sample.port_sequence_number());
        if self.early.iter().rev().any(|early| early.port == port && early.number >= number) {
            return;
        }
        if self.early.len() >= EARLY_SAMPLES || self.early_bytes + body.len() > EARLY_BYTES {
            return self.counters.dropped(NO_COUNTERPART);
        }
        self.early_bytes += body.len();
        self.early.push_back(Early { port, number, body: body.to_vec(), since: Instant::now() });
    }

    /// A publisher has its counterpart: what it sent before goes first.
    fn open(&mut self, gid: Gid, writer: Writer, buffer: &mut SerializedMessage) {
        for early in std::mem::take(&mut self.early) {
            if early.port == gid {
                self.early_bytes -= early.body.len();
                if writer.last.admits(early.number) {
                    publish(&writer.publisher, &early.body, buffer, &self.counters, &mut self.limiter);
                }
            } else {
                self.early.push_back(early);
            }
        }
        self.writers.insert(gid, writer);
    }

    fn look(&mut self, relays: &Relays) {
        let (counters, bytes) = (&self.counters, &mut self.early_bytes);
        if !self.early.is_empty() {
            let relays = relays.lock().unwrap_or_else(PoisonError::into_inner);
            self.early.retain(|early| {
                let is_relay = relays.contains(&early.port);
                let is_late = early.since.elapsed() >= EARLY_TIME;
                if is_late && !is_relay {
                    counters.dropped(NO_COUNTERPART);
                }
                if is_late || is_relay {
                    *bytes -= early.body.len();
                }
                !is_late && !is_relay
            });
        }
        let lost = self.subscription.counters().lost();
        self.counters.lost(lost - self.lost);
        self.lost = lost;
    }
}

/// Turns that empty a queue as deep as this for each of so many publishers.
fn turns(depth: usize, publishers: usize) -> usize {
    depth.saturating_mul(publishers).div_ceil(TURN) + 1
}

const NO_COUNTERPART: &str = "publisher not in ROS yet";

fn publish(
    publisher: &RosPublisher,
    body: &[u8],
    buffer: &mut SerializedMessage,
    counters: &Counters,
    limiter: &mut Limiter,
) {
    if !limiter.admits(monotonic_ns()) {
        return counters.dropped("rate limit");
    }
    match buffer.assign(&ENCAPSULATION, body).and_then(|()| publisher.publish(buffer)) {
        Ok(()) => counters.passed(body.len()),
        Err(error) => counters.dropped(error.reason),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_publisher_in_ros_has_does_not_come_again() {
        let last = Last::default();
        assert!([1, 2, 5].into_iter().all(|number| last.admits(number)));
        // Taken up again, by a subscription that gets what is kept.
        let again = last.clone();
        assert!(![2, 5].into_iter().any(|number| again.admits(number)));
        assert!(again.admits(6) && !last.admits(6));
    }

    #[test]
    fn a_queue_is_emptied_however_deep() {
        for (depth, publishers) in [(1, 1), (100, 1), (1000, 3), (65_536, 8)] {
            assert!(turns(depth, publishers) * TURN >= depth * publishers);
        }
    }
}

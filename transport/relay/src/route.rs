// SPDX-License-Identifier: MIT OR Apache-2.0
//! One topic's way: from its subscription, and from what waited, to the counterparts of its publishers.

use crate::limiter::Limiter;
use crate::relay::PassedOver;
use crate::stats::TopicCounters;
use crate::waker::Flag;
use std::collections::{HashMap, HashSet, VecDeque};
use std::hash::Hash;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};
use tautline_rt::PiGuard;
use tautline_transport::{Gid, MessageInfo, RawSample, RawSubscription};

/// Where samples go. It is the relay's thread that calls it.
pub trait Egress: Send + 'static {
    /// Names a topic.
    type Key: Eq + Hash + Send;
    /// What is kept for a topic: its counters.
    type Topic: Send;
    /// A local publisher's counterpart.
    type Sender: Send;

    /// How much waits for a counterpart.
    const EARLY: EarlyLimits;

    /// Passes a sample on. When another subscription or another port takes over, samples come a second time: see [`Last`].
    fn pass(&mut self, topic: &mut Self::Topic, sender: &mut Self::Sender, sample: Taken);

    /// A sample's publisher did not get a counterpart in time, or too many samples wait.
    fn dropped(topic: &Self::Topic);

    /// So many samples more were overwritten before they were taken.
    fn lost(topic: &Self::Topic, samples: u64);
}

/// What is kept for a topic of a mirror.
pub struct Outbound {
    /// What goes through, and what does not.
    pub counters: Arc<TopicCounters>,
    /// How often.
    pub limiter: Limiter,
}

/// Samples of publishers whose counterpart is not known yet: so many wait per topic.
#[derive(Clone, Copy, Debug)]
pub struct EarlyLimits {
    /// Their number.
    pub samples: usize,
    /// Their bodies together.
    pub bytes: usize,
    /// Each of them so long.
    pub time: Duration,
}

/// A sample that was taken.
pub enum Taken {
    /// As it lies in shared memory.
    Now(RawSample),
    /// It waited for its publisher's counterpart.
    Early(Early),
}

/// A copy of a sample that waits.
pub struct Early {
    port: Gid,
    number: u64,
    info: MessageInfo,
    body: Vec<u8>,
    since: Instant,
}

impl Taken {
    /// The port that it came through, and its number there, from 1.
    pub fn port(&self) -> (Gid, u64) {
        match self {
            Taken::Now(sample) => (sample.port_gid(), sample.port_sequence_number()),
            Taken::Early(early) => (early.port, early.number),
        }
    }

    /// What its header says.
    pub fn info(&self) -> MessageInfo {
        match self {
            Taken::Now(sample) => sample.info(),
            Taken::Early(early) => early.info,
        }
    }

    /// The message, without encapsulation.
    pub fn body(&self) -> &[u8] {
        match self {
            Taken::Now(sample) => sample.body(),
            Taken::Early(early) => &early.body,
        }
    }
}

/// The last sample of a publisher that was passed on: what has been is told by it.
#[derive(Clone, Debug, Default)]
pub struct Last {
    port: Gid,
    number: u64,
    /// By the publisher's own count, which not everybody tells: 0.
    source: u64,
    /// What came through former ports.
    former: u64,
}

impl Last {
    /// Whether it has not been passed on; it has from now on. Numbers of a port grow, and a port that takes over from another one may
    /// begin with what came through that one.
    pub fn admits(&mut self, sample: &Taken) -> bool {
        let (port, number) = sample.port();
        self.admits_numbers(port, number, sample.info().sequence_number)
    }

    fn admits_numbers(&mut self, port: Gid, number: u64, source: u64) -> bool {
        if port != self.port {
            (self.port, self.number, self.former) = (port, 0, self.source);
        }
        let is_new = number > self.number && (source == 0 || source > self.former);
        if is_new {
            (self.number, self.source) = (number, self.source.max(source));
        }
        is_new
    }
}

/// Whose samples are passed on.
pub(crate) struct Sources {
    /// The relay's own participant: what comes through its ports came from elsewhere.
    pub(crate) own: u64,
    pub(crate) passed_over: PassedOver,
}

/// Samples taken of one topic before the next topic has its turn.
const TURN: usize = 16;

pub(crate) struct Route<O: Egress> {
    subscription: Box<RawSubscription>,
    topic: O::Topic,
    senders: HashMap<Gid, O::Sender>,
    early: VecDeque<Early>,
    early_bytes: usize,
    /// Samples that the subscription has said are lost.
    lost: u64,
    flag: Arc<Flag>,
}

impl Sources {
    fn are_passed_over(&self) -> PiGuard<'_, HashSet<Gid>> {
        self.passed_over.lock()
    }
}

impl<O: Egress> Route<O> {
    pub(crate) fn new(subscription: Box<RawSubscription>, topic: O::Topic, thread: Waker) -> Self {
        let (senders, early) = (HashMap::new(), VecDeque::new());
        Route { subscription, topic, senders, early, early_bytes: 0, lost: 0, flag: Flag::new(thread) }
    }

    /// Takes by another subscription from now on.
    pub(crate) fn change(
        &mut self,
        subscription: Box<RawSubscription>,
        topic: O::Topic,
        sources: &Sources,
        egress: &mut O,
    ) {
        // The new one has been there for a while: first what came before, then what came to both once.
        self.serve_all(sources, egress);
        self.look(sources);
        (self.subscription, self.topic, self.lost) = (subscription, topic, 0);
        self.flag.set();
    }

    /// Passes on what is there if there may be something, at most a turn of it. Says whether there may be more.
    pub(crate) fn serve_if_rung(&mut self, sources: &Sources, egress: &mut O) -> bool {
        self.flag.take() && self.serve(sources, egress)
    }

    fn serve(&mut self, sources: &Sources, egress: &mut O) -> bool {
        let waker = self.flag.waker();
        let mut context = Context::from_waker(&waker);
        for _ in 0..TURN {
            match self.subscription.poll_take(&mut context) {
                Poll::Ready(sample) => self.pass(sample, sources, egress),
                Poll::Pending => return false,
            }
        }
        self.flag.set();
        true
    }

    /// All that was there: bounded by what fits in, for a publisher could be faster than this.
    fn serve_all(&mut self, sources: &Sources, egress: &mut O) {
        // Those that are there, those that have gone and are not closed yet, and one that nobody heard of.
        let publishers = self.subscription.publisher_count() + self.senders.len() + 1;
        for _ in 0..turns(self.subscription.qos().depth, publishers) {
            // After a turn of samples that were passed over it is woken at once for what is behind them.
            if !self.serve(sources, egress) && !self.flag.take() {
                break;
            }
        }
    }

    fn pass(&mut self, sample: RawSample, sources: &Sources, egress: &mut O) {
        if sample.port_gid().participant() == sources.own {
            return;
        }
        let publisher = sample.info().publisher_gid;
        match self.senders.get_mut(&publisher) {
            Some(sender) => egress.pass(&mut self.topic, sender, Taken::Now(sample)),
            None if sources.are_passed_over().contains(&publisher) => {}
            None => self.keep_early(&sample),
        }
    }

    fn keep_early(&mut self, sample: &RawSample) {
        let (body, port, number) = (sample.body(), sample.port_gid(), sample.port_sequence_number());
        if self.early.iter().rev().any(|early| early.port == port && early.number >= number) {
            return;
        }
        if self.early.len() >= O::EARLY.samples || self.early_bytes + body.len() > O::EARLY.bytes {
            return O::dropped(&self.topic);
        }
        self.early_bytes += body.len();
        let (info, body) = (sample.info(), body.to_vec());
        self.early.push_back(Early { port, number, info, body, since: Instant::now() });
    }

    /// A publisher has its counterpart: what it sent before goes first.
    pub(crate) fn open(&mut self, gid: Gid, mut sender: O::Sender, egress: &mut O) {
        for early in std::mem::take(&mut self.early) {
            if early.info.publisher_gid == gid {
                self.early_bytes -= early.body.len();
                egress.pass(&mut self.topic, &mut sender, Taken::Early(early));
            } else {
                self.early.push_back(early);
            }
        }
        self.senders.insert(gid, sender);
    }

    /// A publisher has gone: what it published before goes first.
    pub(crate) fn close(&mut self, gid: Gid, sources: &Sources, egress: &mut O) {
        self.serve_all(sources, egress);
        self.senders.remove(&gid);
    }

    /// The last that is done.
    pub(crate) fn end(mut self, sources: &Sources, egress: &mut O) {
        self.serve_all(sources, egress);
        self.look(sources);
        self.early.iter().for_each(|_| O::dropped(&self.topic));
    }

    /// For samples of publishers that never became known, and for what a subscription counts by itself.
    pub(crate) fn look(&mut self, sources: &Sources) {
        let (topic, bytes) = (&self.topic, &mut self.early_bytes);
        if !self.early.is_empty() {
            let passed_over = sources.are_passed_over();
            self.early.retain(|early| {
                let is_passed_over = passed_over.contains(&early.info.publisher_gid);
                let is_late = early.since.elapsed() >= O::EARLY.time;
                if is_late && !is_passed_over {
                    O::dropped(topic);
                }
                if is_late || is_passed_over {
                    *bytes -= early.body.len();
                }
                !is_late && !is_passed_over
            });
        }
        let lost = self.subscription.counters().lost();
        O::lost(&self.topic, lost - self.lost);
        self.lost = lost;
    }
}

/// Turns that empty a queue as deep as this for each of so many publishers.
fn turns(depth: usize, publishers: usize) -> usize {
    depth.saturating_mul(publishers).div_ceil(TURN) + 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_passed_on_does_not_come_again() {
        let [one, other] = [1, 2].map(|id| Gid([id; 16]));
        let mut last = Last::default();
        let mut admits = |port, number, source| last.admits_numbers(port, number, source);
        assert!([1, 2, 5].into_iter().all(|number| admits(one, number, number)));
        assert!(![2, 5].into_iter().any(|number| admits(one, number, number)), "another subscription");
        // Another port, which begins with what it keeps, in its own numbers.
        assert!(![(1, 4), (2, 5)].into_iter().any(|(number, source)| admits(other, number, source)));
        assert!(
            admits(other, 3, 6) && admits(other, 4, 8) && admits(other, 5, 7),
            "in whatever order they came"
        );
        // Where nobody counts for the publisher, its port does.
        assert!(admits(one, 1, 0) && admits(one, 2, 0) && !admits(one, 2, 0));
    }

    #[test]
    fn a_queue_is_emptied_however_deep() {
        for (depth, publishers) in [(1, 1), (100, 1), (1000, 3), (65_536, 8)] {
            assert!(turns(depth, publishers) * TURN >= depth * publishers);
        }
    }
}

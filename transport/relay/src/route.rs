// SPDX-License-Identifier: MIT OR Apache-2.0
//! The path of one topic: from its subscription, and from held samples, to the counterparts of its publishers.

use crate::limiter::Limiter;
use crate::stats::TopicCounters;
use crate::waker::Flag;
use crate::writers::SETTLE_TIME;
use std::collections::{HashMap, HashSet, VecDeque};
use std::hash::Hash;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};
use tautline_rt::PiMutex;
use tautline_transport::{Gid, MessageInfo, RawSample, RawSubscription};

/// Forwards samples. Called by the relay's thread.
pub trait Egress: Send + 'static {
    /// Identifies a topic.
    type Key: Eq + Hash + Send;
    /// State of a topic: its counters.
    type Topic: Send;
    /// The counterpart of a local publisher.
    type Sender: Send;

    /// Limits of samples held for a counterpart.
    const EARLY: EarlyLimits;

    /// Whether another sample of this counterpart can be forwarded. If not, the topic's samples stay in its subscription's queue.
    fn has_room(&self, sender: &Self::Sender) -> bool {
        let _ = sender;
        true
    }

    /// Forwards a sample. After a change of the subscription or port, samples are repeated: see [`Last`].
    fn pass(&mut self, topic: &mut Self::Topic, sender: &mut Self::Sender, sample: OutboundSample);

    /// Counts a dropped sample: its publisher got no counterpart in time, or too many samples were held.
    fn dropped(topic: &Self::Topic);

    /// Counts `samples` more that were overwritten before they were taken.
    fn lost(topic: &Self::Topic, samples: u64);
}

/// State of a topic of a mirror.
pub struct Outbound {
    /// Counters.
    pub counters: Arc<TopicCounters>,
    /// The rate limit.
    pub limiter: Limiter,
}

/// Limits, per topic, of samples held for publishers without a counterpart.
#[derive(Clone, Copy, Debug)]
pub struct EarlyLimits {
    /// Maximum number of samples.
    pub samples: usize,
    /// Maximum of the total bytes of their bodies.
    pub bytes: usize,
    /// Time-out of each sample.
    pub time: Duration,
}

/// A sample to forward.
pub enum OutboundSample {
    /// Still in shared memory.
    Now(RawSample),
    /// A copy, held for its publisher's counterpart.
    Early(Early),
}

/// A held copy of a sample.
pub struct Early {
    port: Gid,
    number: u64,
    info: MessageInfo,
    body: Vec<u8>,
    since: Instant,
}

impl OutboundSample {
    /// Its port, and its sequence number there, from 1.
    pub fn port(&self) -> (Gid, u64) {
        match self {
            OutboundSample::Now(sample) => (sample.port_gid(), sample.port_sequence_number()),
            OutboundSample::Early(early) => (early.port, early.number),
        }
    }

    /// The message info of its header.
    pub fn info(&self) -> MessageInfo {
        match self {
            OutboundSample::Now(sample) => sample.info(),
            OutboundSample::Early(early) => early.info,
        }
    }

    /// The message, without encapsulation.
    pub fn body(&self) -> &[u8] {
        match self {
            OutboundSample::Now(sample) => sample.body(),
            OutboundSample::Early(early) => &early.body,
        }
    }

    /// The message with its encapsulation, if it is in shared memory.
    pub fn serialized(&self) -> Option<&[u8]> {
        match self {
            OutboundSample::Now(sample) => sample.serialized(),
            OutboundSample::Early(_) => None,
        }
    }
}

/// The last forwarded sample of a publisher, to recognize duplicates.
#[derive(Clone, Debug, Default)]
pub struct Last {
    port: Gid,
    number: u64,
    /// The publisher's own sequence number; 0 if it has none.
    source: u64,
    /// The last number from earlier ports.
    former: u64,
}

impl Last {
    /// Whether the sample is new; records it as forwarded. The numbers of a port increase; a port that replaces another may repeat samples.
    pub fn admits(&mut self, sample: &OutboundSample) -> bool {
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

/// Publishers whose samples are not forwarded, because another relay carries them.
pub type PassedOver = Arc<PiMutex<HashSet<Gid>>>;

/// Decides which samples are forwarded.
pub(crate) struct Sources {
    /// The relay's own participant: samples from its ports came from the far side.
    pub(crate) own: u64,
    pub(crate) passed_over: PassedOver,
}

/// Samples taken from one topic before the next topic's turn.
const TURN: usize = 16;

pub(crate) struct TopicRoute<O: Egress> {
    /// The present subscription, after former ones that still have samples.
    subscriptions: VecDeque<TopicSubscription>,
    topic: O::Topic,
    senders: HashMap<Gid, O::Sender>,
    /// Ended publishers, each with the time of its end: their senders stay until all samples are taken.
    ended: Vec<(Gid, Instant)>,
    early: VecDeque<Early>,
    early_bytes: usize,
    flag: Arc<Flag>,
}

struct TopicSubscription {
    subscription: Box<RawSubscription>,
    /// Losses that the subscription has reported so far.
    lost: u64,
    /// The time at which another one took its place, or its topic ended, and how many samples are still taken at most: those that had come
    /// by then.
    replaced: Option<(Instant, u64)>,
}

impl TopicSubscription {
    fn new(subscription: Box<RawSubscription>) -> Self {
        TopicSubscription { subscription, lost: 0, replaced: None }
    }

    /// Its losses since the last call.
    fn new_losses(&mut self) -> u64 {
        let lost = self.subscription.counters().lost();
        lost - std::mem::replace(&mut self.lost, lost)
    }

    /// Notes that a sample was taken.
    fn note_taken(&mut self) {
        if let Some((_, left)) = &mut self.replaced {
            *left = left.saturating_sub(1);
        }
    }

    /// The number of samples that are still taken from it; `None`: it is the present one.
    fn left(&self) -> Option<u64> {
        self.replaced.map(|(_, left)| left.min(self.subscription.waiting()))
    }

    /// Whether no more samples are taken from it.
    fn is_over(&self) -> bool {
        self.left() == Some(0) || self.replaced.is_some_and(|(since, _)| since.elapsed() >= SETTLE_TIME)
    }
}

/// The outcome of a topic's turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Served {
    All,
    /// A sender has no room for samples.
    Blocked,
    /// There may be more samples.
    Some,
}

impl<O: Egress> TopicRoute<O> {
    pub(crate) fn new(subscription: Box<RawSubscription>, topic: O::Topic, thread: Waker) -> Self {
        let (senders, ended, early) = Default::default();
        let subscriptions = VecDeque::from([TopicSubscription::new(subscription)]);
        TopicRoute { subscriptions, topic, senders, ended, early, early_bytes: 0, flag: Flag::new(thread) }
    }

    /// Takes from another subscription from now on.
    pub(crate) fn change(&mut self, subscription: Box<RawSubscription>, topic: O::Topic) {
        // Both have existed for a while: the old one's samples come first, and duplicates from the new one are dropped.
        self.end();
        self.subscriptions.push_back(TopicSubscription::new(subscription));
        self.topic = topic;
    }

    /// If the flag is set, forwards at most one turn of samples.
    pub(crate) fn serve_if_rung(&mut self, sources: &Sources, egress: &mut O) -> Served {
        if !self.flag.take() {
            return Served::All;
        }
        if !self.senders.values().all(|sender| egress.has_room(sender)) {
            self.flag.set();
            return Served::Blocked;
        }
        if self.serve(sources, egress) { Served::Some } else { Served::All }
    }

    /// Forwards at most one turn of samples. Returns whether there may be more.
    fn serve(&mut self, sources: &Sources, egress: &mut O) -> bool {
        let waker = self.flag.waker();
        let mut context = Context::from_waker(&waker);
        for _ in 0..TURN {
            self.drop_over();
            let Some(taken) = self.subscriptions.front_mut() else { return false };
            match taken.subscription.poll_take(&mut context) {
                Poll::Ready(Some(sample)) => {
                    taken.note_taken();
                    self.pass(sample, sources, egress);
                }
                // Samples may wait until others are returned, which sets the flag.
                Poll::Ready(None) | Poll::Pending if !self.drop_over() => {
                    self.drop_ended();
                    return false;
                }
                Poll::Ready(None) | Poll::Pending => {}
            }
        }
        self.flag.set();
        true
    }

    /// Drops the first subscription, if it is over. Returns whether it was.
    fn drop_over(&mut self) -> bool {
        let is_over = self.subscriptions.front().is_some_and(TopicSubscription::is_over);
        if is_over && let Some(mut over) = self.subscriptions.pop_front() {
            O::lost(&self.topic, over.new_losses() + over.left().unwrap_or(0));
        }
        is_over
    }

    /// Drops the senders of ended publishers, once no samples wait or the time is over.
    fn drop_ended(&mut self) {
        if self.ended.is_empty() {
            return;
        }
        let is_empty = self.subscriptions.iter().all(|taken| taken.subscription.waiting() == 0);
        let senders = &mut self.senders;
        self.ended.retain(|(gid, since)| {
            let stays = !is_empty && since.elapsed() < SETTLE_TIME;
            if !stays {
                senders.remove(gid);
            }
            stays
        });
    }

    fn pass(&mut self, sample: RawSample, sources: &Sources, egress: &mut O) {
        if sample.port_gid().participant() == sources.own {
            return;
        }
        let publisher = sample.info().publisher_gid;
        match self.senders.get_mut(&publisher) {
            Some(sender) => egress.pass(&mut self.topic, sender, OutboundSample::Now(sample)),
            None if sources.passed_over.lock().contains(&publisher) => {}
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

    /// Adds the counterpart of a publisher, and first forwards the publisher's held samples.
    pub(crate) fn open(&mut self, gid: Gid, mut sender: O::Sender, egress: &mut O) {
        self.ended.retain(|(ended, _)| *ended != gid);
        for early in std::mem::take(&mut self.early) {
            if early.info.publisher_gid == gid {
                self.early_bytes -= early.body.len();
                egress.pass(&mut self.topic, &mut sender, OutboundSample::Early(early));
            } else {
                self.early.push_back(early);
            }
        }
        self.senders.insert(gid, sender);
    }

    /// Removes the counterpart of an ended publisher after its queued samples.
    pub(crate) fn close(&mut self, gid: Gid) {
        self.ended.push((gid, Instant::now()));
        self.flag.set();
    }

    /// Forwards the queued samples, and takes no others.
    pub(crate) fn end(&mut self) {
        if let Some(last) = self.subscriptions.back_mut() {
            // Publishers have turns: meanwhile others' newer samples are taken, too.
            let publishers = self.senders.len().max(1) as u64;
            last.replaced = Some((Instant::now(), last.subscription.waiting().saturating_mul(publishers)));
        }
        self.flag.set();
    }

    /// Whether it has [ended](Self::end) and forwarded the queued samples. What it holds is then dropped.
    pub(crate) fn is_over(&mut self, sources: &Sources) -> bool {
        while self.drop_over() {}
        let is_over = self.subscriptions.is_empty();
        if is_over {
            self.refresh(sources);
            self.early.drain(..).for_each(|_| O::dropped(&self.topic));
        }
        is_over
    }

    /// Drops held samples after the time-out, and reads the losses of subscriptions.
    pub(crate) fn refresh(&mut self, sources: &Sources) {
        let (topic, bytes) = (&self.topic, &mut self.early_bytes);
        if !self.early.is_empty() {
            let passed_over = sources.passed_over.lock();
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
        O::lost(&self.topic, self.subscriptions.iter_mut().map(TopicSubscription::new_losses).sum());
        self.drop_ended();
    }
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
        // Another port, which begins with its kept samples, numbered anew.
        assert!(![(1, 4), (2, 5)].into_iter().any(|(number, source)| admits(other, number, source)));
        assert!(admits(other, 3, 6) && admits(other, 4, 8) && admits(other, 5, 7), "in any order");
        // Without the publisher's numbers, the port's count.
        assert!(admits(one, 1, 0) && admits(one, 2, 0) && !admits(one, 2, 0));
    }
}

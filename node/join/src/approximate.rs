// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stamps that are close to each other.

use crate::policy::{Arrival, Policy, nanos};
use std::collections::VecDeque;
use std::time::Duration;

/// Sets of messages whose stamps are close: message_filters' `ApproximateTime`, with the same sets.
///
/// A set has one message of each input, and no two sets cross. The latest of the oldest waiting messages is the *pivot*. The next set
/// is, of all sets that contain the pivot, the one whose stamps are closest together. A set is delivered when no later message can make
/// a better one: at the latest when each input has sent a message later than the pivot.
///
/// A message that arrives out of order in its input is refused.
///
/// # Real-time
/// For each new message, and each set, at most two steps per waiting message, linear in the number of inputs; no allocation.
#[derive(Clone, Debug)]
pub struct ApproximateTime {
    queue_size: usize,
    max_interval_ns: i64,
    age_penalty: f64,
    lower_bounds_ns: [i64; crate::MAX_INPUTS],
    channels: Vec<Channel>,
    candidate: Option<Candidate>,
}

/// The stamps of one input's waiting messages. Those before `next` were examined for the current candidate, whose message is the first.
#[derive(Clone, Debug, Default)]
struct Channel {
    stamps: VecDeque<i64>,
    next: usize,
    /// A message was dropped that may have belonged to the next set, so its successor must not be the pivot.
    has_dropped: bool,
    newest_ns: Option<i64>,
}

/// The best set with the pivot so far: the first messages of all channels.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    start_ns: i64,
    end_ns: i64,
    pivot: usize,
    pivot_ns: i64,
}

impl ApproximateTime {
    /// At most `queue_size` messages of each input wait; a further message replaces the oldest one.
    #[must_use = "give it to a Synchronizer"]
    pub fn new(queue_size: usize) -> Self {
        ApproximateTime {
            queue_size,
            max_interval_ns: i64::MAX,
            age_penalty: 0.1,
            lower_bounds_ns: [0; crate::MAX_INPUTS],
            channels: Vec::new(),
            candidate: None,
        }
    }

    /// The maximum distance between the stamps of a set (message_filters: `setMaxIntervalDuration`, in Python `slop`). No limit by
    /// default.
    #[must_use = "it returns the changed policy"]
    pub fn max_interval(self, interval: Duration) -> Self {
        ApproximateTime { max_interval_ns: nanos(interval), ..self }
    }

    /// How much closer together a later set must be to be preferred, as a fraction of how much later it is (`setAgePenalty`).
    /// 0.1 by default; a negative value or NaN counts as 0.
    #[must_use = "it returns the changed policy"]
    pub fn age_penalty(self, penalty: f64) -> Self {
        ApproximateTime { age_penalty: penalty.max(0.0), ..self }
    }

    /// Guarantees that the stamps of input `input` (from 0) are at least `bound` apart (`setInterMessageLowerBound`). Sets are then
    /// delivered earlier. Messages that violate this are counted. An input that does not exist is ignored.
    #[must_use = "it returns the changed policy"]
    pub fn inter_message_lower_bound(mut self, input: usize, bound: Duration) -> Self {
        if let Some(slot) = self.lower_bounds_ns.get_mut(input) {
            *slot = nanos(bound);
        }
        self
    }

    /// Whether a set that ends and starts later than the candidate by these times is no better: the loss at the end, increased by the
    /// age penalty, is at least the gain at the start.
    fn is_no_better(&self, later_end_ns: i64, later_start_ns: i64) -> bool {
        // Differences of stamps are exact in an f64 up to 104 days.
        later_end_ns as f64 * (1.0 + self.age_penalty) >= later_start_ns as f64
    }

    /// The set of each channel's oldest message that was not examined: the first and last of their stamps, each with its channel.
    /// `None`: not every channel has such a message.
    fn fronts(&self) -> Option<[(i64, usize); 2]> {
        span(self.channels.iter().map(|channel| channel.stamps.get(channel.next).copied()))
    }

    /// Makes all messages unexamined.
    fn rewind(&mut self) {
        self.channels.iter_mut().for_each(|channel| channel.next = 0);
    }

    /// Whether no later message can make a better set with this pivot: continues the search with messages that arrive as early as
    /// they can.
    fn is_proven(&self, candidate: &Candidate) -> bool {
        let mut ahead = [0; crate::MAX_INPUTS];
        loop {
            let expected =
                self.channels.iter().zip(self.lower_bounds_ns).zip(ahead).map(|((channel, bound), ahead)| {
                    let there = channel.stamps.get(channel.next + ahead).copied();
                    let next =
                        channel.newest_ns.map_or(candidate.pivot_ns, |newest| newest.saturating_add(bound));
                    Some(there.unwrap_or(next.max(candidate.pivot_ns)))
                });
            let Some([(start, first), (end, _)]) = span(expected) else { return false };
            let later_end = end.saturating_sub(candidate.end_ns);
            if self.is_no_better(later_end, candidate.pivot_ns.saturating_sub(candidate.start_ns)) {
                return true;
            }
            if !self.is_no_better(later_end, start.saturating_sub(candidate.start_ns)) {
                return false;
            }
            // A set that starts before the pivot consists of waiting messages: the loop ends with these.
            ahead[first] += 1;
        }
    }
}

impl Policy for ApproximateTime {
    fn queue_size(&self) -> usize {
        self.queue_size
    }

    fn start(&mut self, inputs: usize) {
        // One more: the arriving message, until the policy has decided.
        let stamps = || VecDeque::with_capacity(self.queue_size.saturating_add(1));
        self.channels = (0..inputs).map(|_| Channel { stamps: stamps(), ..Channel::default() }).collect();
        self.candidate = None;
    }

    fn arrived(&mut self, input: usize, stamp_ns: i64) -> Arrival {
        let Some(channel) = self.channels.get_mut(input) else { return Arrival::Refuse };
        let since = channel.newest_ns.map(|newest| stamp_ns.saturating_sub(newest));
        if since.is_some_and(|since| since < 0) {
            return Arrival::Refuse;
        }
        channel.newest_ns = Some(stamp_ns);
        let place = channel.stamps.len();
        channel.stamps.push_back(stamp_ns);
        if since.is_some_and(|since| since < self.lower_bounds_ns[input]) {
            return Arrival::WaitTooClose(place);
        }
        Arrival::Wait(place)
    }

    fn decide(&mut self, drop: &mut dyn FnMut(usize)) -> bool {
        loop {
            while let Some([(start_ns, first), (end_ns, last)]) = self.fronts() {
                for (i, channel) in self.channels.iter_mut().enumerate() {
                    // The messages of the other channels are earlier than the last one, as were those that they dropped.
                    channel.has_dropped &= i == last;
                }
                let candidate = match self.candidate {
                    None => {
                        let too_far = end_ns.saturating_sub(start_ns) > self.max_interval_ns;
                        if too_far || self.channels[last].has_dropped {
                            self.channels[first].stamps.pop_front();
                            drop(first);
                            continue;
                        }
                        Candidate { start_ns, end_ns, pivot: last, pivot_ns: end_ns }
                    }
                    Some(best) => {
                        let (later_end, later_start) =
                            (end_ns.saturating_sub(best.end_ns), start_ns.saturating_sub(best.start_ns));
                        if self.is_no_better(later_end, later_start) {
                            best
                        } else {
                            Candidate { start_ns, end_ns, ..best }
                        }
                    }
                };
                if self.candidate.is_none_or(|best| best.start_ns != candidate.start_ns) {
                    // The examined messages are too early for any later set.
                    for (i, channel) in self.channels.iter_mut().enumerate() {
                        for _ in 0..std::mem::take(&mut channel.next) {
                            channel.stamps.pop_front();
                            drop(i);
                        }
                    }
                }
                self.candidate = Some(candidate);
                self.channels[first].next += 1;
                let later_end = end_ns.saturating_sub(candidate.end_ns);
                let pivot_start = candidate.pivot_ns.saturating_sub(candidate.start_ns);
                let is_best = first == candidate.pivot
                    || self.is_no_better(later_end, pivot_start)
                    || self.fronts().is_none() && self.is_proven(&candidate);
                if is_best {
                    self.candidate = None;
                    self.rewind();
                    self.channels.iter_mut().for_each(|channel| {
                        channel.stamps.pop_front();
                    });
                    return true;
                }
            }
            let full = |channel: &Channel| channel.stamps.len() > self.queue_size;
            let Some(full) = self.channels.iter().position(full) else { return false };
            self.rewind();
            self.channels[full].stamps.pop_front();
            self.channels[full].has_dropped = true;
            drop(full);
            // The candidate may have lost a message; the waiting messages may contain another one.
            self.candidate = None;
        }
    }

    fn clear(&mut self) {
        self.candidate = None;
        for channel in &mut self.channels {
            channel.stamps.clear();
            (channel.next, channel.has_dropped, channel.newest_ns) = (0, false, None);
        }
    }
}

/// The first and the last of some stamps, each with its place; of equal ones the first starts and the last ends, as in message_filters.
fn span(stamps: impl Iterator<Item = Option<i64>>) -> Option<[(i64, usize); 2]> {
    let mut span: Option<[(i64, usize); 2]> = None;
    for (i, stamp) in stamps.enumerate() {
        let stamp = stamp?;
        let [first, last] = span.get_or_insert([(stamp, i); 2]);
        if stamp < first.0 {
            *first = (stamp, i);
        }
        if stamp >= last.0 {
            *last = (stamp, i);
        }
    }
    span
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stamps that are within a tolerance of the oldest.

use super::{Arrival, Policy, nanos};
use std::collections::VecDeque;
use std::time::Duration;

/// Sets of messages whose stamps are at most a tolerance apart: message_filters' `ApproximateEpsilonTime`, with its sets.
///
/// Once a message of each input waits, the oldest ones of all are a set if none is more than `epsilon` later than the first of them.
/// Otherwise the first is dropped, together with those that are within `epsilon` of it, and so on. So a set is passed on with its last
/// message, where [`ApproximateTime`](super::ApproximateTime) waits for later ones; but sets are not the closest that there are, and of
/// three or more inputs none may come although stamps lie close enough.
///
/// A message of an input that comes out of order is refused.
///
/// # Real-time
/// For each message that comes, and each set, at most one step for each message that waits, linear in the number of inputs; no allocation.
#[derive(Clone, Debug)]
pub struct ApproximateEpsilonTime {
    queue_size: usize,
    epsilon_ns: i64,
    channels: Vec<Channel>,
}

/// The stamps of one input's messages that wait.
#[derive(Clone, Debug)]
struct Channel {
    stamps: VecDeque<i64>,
    newest_ns: i64,
}

impl ApproximateEpsilonTime {
    /// The stamps of a set lie at most `epsilon` apart. At most `queue_size` messages of each input wait; the oldest is dropped for one
    /// more.
    #[must_use = "give it to a Synchronizer"]
    pub fn new(queue_size: usize, epsilon: Duration) -> Self {
        ApproximateEpsilonTime { queue_size, epsilon_ns: nanos(epsilon), channels: Vec::new() }
    }

    /// The oldest stamp, if a message of each input waits.
    fn oldest(&self) -> Option<i64> {
        let mut oldest = i64::MAX;
        for channel in &self.channels {
            oldest = oldest.min(*channel.stamps.front()?);
        }
        Some(oldest)
    }
}

impl Policy for ApproximateEpsilonTime {
    fn queue_size(&self) -> usize {
        self.queue_size
    }

    fn start(&mut self, inputs: usize) {
        // One more, until it is decided.
        let stamps = || VecDeque::with_capacity(self.queue_size.saturating_add(1));
        self.channels = (0..inputs).map(|_| Channel { stamps: stamps(), newest_ns: i64::MIN }).collect();
    }

    fn arrived(&mut self, input: usize, stamp_ns: i64) -> Arrival {
        let channel = self.channels.get_mut(input).filter(|channel| stamp_ns >= channel.newest_ns);
        let Some(channel) = channel else { return Arrival::Refuse };
        channel.newest_ns = stamp_ns;
        channel.stamps.push_back(stamp_ns);
        Arrival::Wait(channel.stamps.len() - 1)
    }

    fn decide(&mut self, drop: &mut dyn FnMut(usize)) -> bool {
        while let Some(oldest) = self.oldest() {
            let last = oldest.saturating_add(self.epsilon_ns);
            let is_near = |channel: &Channel| channel.stamps.front().is_some_and(|stamp| *stamp <= last);
            let is_set = self.channels.iter().all(is_near);
            for (i, channel) in self.channels.iter_mut().enumerate().filter(|(_, channel)| is_near(channel)) {
                channel.stamps.pop_front();
                if !is_set {
                    drop(i);
                }
            }
            if is_set {
                return true;
            }
        }
        for (i, channel) in self.channels.iter_mut().enumerate() {
            if channel.stamps.len() > self.queue_size {
                channel.stamps.pop_front();
                drop(i);
            }
        }
        false
    }

    fn clear(&mut self) {
        for channel in &mut self.channels {
            channel.stamps.clear();
            channel.newest_ns = i64::MIN;
        }
    }
}

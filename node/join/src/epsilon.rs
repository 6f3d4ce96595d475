// SPDX-License-Identifier: MIT OR Apache-2.0
//! Sets of stamps within a tolerance of the oldest one.

use crate::policy::{Arrival, Policy, nanos};
use std::collections::VecDeque;
use std::time::Duration;

/// Sets of messages whose stamps are at most a tolerance apart: message_filters' `ApproximateEpsilonTime`, with the same
/// sets.
///
/// When a message of each input waits, the oldest message of every input form a set if none is more than `epsilon` later than the first
/// of them. Otherwise the first is dropped, together with those within `epsilon` of it, and so on. So a set is delivered with its last
/// message, whereas [`ApproximateTime`](crate::ApproximateTime) waits for later messages. But the sets are not the closest possible
/// ones, and with three or more inputs there may be no set although stamps are close enough.
///
/// A message that arrives out of order in its input is refused.
///
/// # Real-time
/// For each new message, and each set, at most one step per waiting message, linear in the number of inputs; no allocation.
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
    /// The stamps of a set are at most `epsilon` apart. At most `queue_size` messages of each input wait; a further message replaces
    /// the oldest one.
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
        // One more: the arriving message, until the policy has decided.
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

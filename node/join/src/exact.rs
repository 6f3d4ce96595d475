// SPDX-License-Identifier: MIT OR Apache-2.0
//! Stamps that are equal.

use crate::policy::{Arrival, Policy};
use std::collections::VecDeque;

/// Sets of messages with the same stamp: message_filters' `ExactTime` and `TimeSynchronizer`.
///
/// A set is delivered with its last message; older messages are dropped then. At most `queue_size` different stamps wait; a further
/// stamp replaces the oldest one. Messages of one input may arrive out of order. A message is refused if its input already has a
/// waiting message with the same stamp, or if it is not later than the last set.
///
/// # Real-time
/// For each message at most one step per waiting message; no allocation.
#[derive(Clone, Debug)]
pub struct ExactTime {
    queue_size: usize,
    /// By input, in ascending order.
    channels: Vec<VecDeque<i64>>,
    /// The stamp that arrived last, until it is handled.
    fresh: Option<i64>,
    last_set: Option<i64>,
}

impl ExactTime {
    /// At most `queue_size` different stamps wait.
    #[must_use = "give it to a Synchronizer"]
    pub fn new(queue_size: usize) -> Self {
        ExactTime { queue_size, channels: Vec::new(), fresh: None, last_set: None }
    }

    /// The oldest waiting stamp, and the number of different waiting stamps.
    fn oldest(&self) -> (i64, usize) {
        let mut at = [0; crate::MAX_INPUTS];
        let (mut oldest, mut count) = (i64::MAX, 0);
        loop {
            let fronts = self.channels.iter().zip(at).filter_map(|(channel, at)| channel.get(at));
            let Some(&next) = fronts.min() else { return (oldest, count) };
            (oldest, count) = (oldest.min(next), count + 1);
            for (channel, at) in self.channels.iter().zip(&mut at) {
                *at += usize::from(channel.get(*at) == Some(&next));
            }
        }
    }
}

impl Policy for ExactTime {
    fn queue_size(&self) -> usize {
        self.queue_size
    }

    fn start(&mut self, inputs: usize) {
        // One more: the arriving message, until the policy has decided.
        let stamps = || VecDeque::with_capacity(self.queue_size.saturating_add(1));
        (self.channels, self.fresh, self.last_set) = ((0..inputs).map(|_| stamps()).collect(), None, None);
    }

    fn arrived(&mut self, input: usize, stamp_ns: i64) -> Arrival {
        let Some(channel) = self.channels.get_mut(input) else { return Arrival::Refuse };
        if self.last_set.is_some_and(|last| stamp_ns <= last) {
            return Arrival::Refuse;
        }
        match channel.binary_search(&stamp_ns) {
            Ok(_) => Arrival::Refuse,
            Err(place) => {
                channel.insert(place, stamp_ns);
                self.fresh = Some(stamp_ns);
                Arrival::Wait(place)
            }
        }
    }

    fn decide(&mut self, drop: &mut dyn FnMut(usize)) -> bool {
        let Some(stamp) = self.fresh.take() else { return false };
        let is_set = self.channels.iter().all(|channel| channel.binary_search(&stamp).is_ok());
        if is_set {
            for (i, channel) in self.channels.iter_mut().enumerate() {
                while channel.pop_front().is_some_and(|front| front < stamp) {
                    drop(i);
                }
            }
            self.last_set = Some(stamp);
            return true;
        }
        let waiting: usize = self.channels.iter().map(VecDeque::len).sum();
        if waiting > self.queue_size {
            let (oldest, count) = self.oldest();
            if count > self.queue_size {
                for (i, channel) in self.channels.iter_mut().enumerate() {
                    if channel.front() == Some(&oldest) {
                        channel.pop_front();
                        drop(i);
                    }
                }
            }
        }
        false
    }

    fn clear(&mut self) {
        self.channels.iter_mut().for_each(VecDeque::clear);
        (self.fresh, self.last_set) = (None, None);
    }
}

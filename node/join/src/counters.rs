// SPDX-License-Identifier: MIT OR Apache-2.0

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Counters of a join's items, readable from any thread.
#[derive(Debug)]
pub struct JoinCounters {
    sets: AtomicU64,
    resets: AtomicU64,
    inputs: Box<[InputCounters]>,
}

/// Counters of one input's items.
#[derive(Debug, Default)]
pub struct InputCounters {
    pub(crate) received: AtomicU64,
    pub(crate) dropped: AtomicU64,
    pub(crate) refused: AtomicU64,
    pub(crate) too_close: AtomicU64,
}

impl JoinCounters {
    pub(crate) fn new(inputs: usize) -> Self {
        let inputs = (0..inputs).map(|_| InputCounters::default()).collect();
        JoinCounters { sets: AtomicU64::new(0), resets: AtomicU64::new(0), inputs }
    }

    /// Sets that were delivered.
    pub fn sets(&self) -> u64 {
        self.sets.load(Relaxed)
    }

    /// How often time jumped back, so that all waiting items were dropped.
    pub fn resets(&self) -> u64 {
        self.resets.load(Relaxed)
    }

    /// By input, in the order in which they were given.
    pub fn inputs(&self) -> &[InputCounters] {
        &self.inputs
    }

    pub(crate) fn passed_on(&self) {
        self.sets.fetch_add(1, Relaxed);
    }

    pub(crate) fn reset(&self) {
        self.resets.fetch_add(1, Relaxed);
    }

    pub(crate) fn of(&self, input: usize, which: fn(&InputCounters) -> &AtomicU64) {
        if let Some(input) = self.inputs.get(input) {
            which(input).fetch_add(1, Relaxed);
        }
    }
}

impl InputCounters {
    /// Items that were taken from the input.
    pub fn received(&self) -> u64 {
        self.received.load(Relaxed)
    }

    /// Items that were kept and then dropped without having been in a set: because others matched better, a newer one replaced them,
    /// the queue was full, or time jumped back.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Relaxed)
    }

    /// Items that were not kept: out of order, or with a repeated stamp.
    pub fn refused(&self) -> u64 {
        self.refused.load(Relaxed)
    }

    /// Items that followed the previous one sooner than [`ApproximateTime::inter_message_lower_bound`](crate::ApproximateTime)
    /// states: a set may have been delivered although a better one was possible.
    pub fn too_close(&self) -> u64 {
        self.too_close.load(Relaxed)
    }
}

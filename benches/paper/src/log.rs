// SPDX-License-Identifier: MIT OR Apache-2.0

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use crate::{Job, Topic};

/// Where a callback writes its response times: memory that is there before it starts. One writer, any readers.
pub struct Log {
    entries: Box<[AtomicU64]>,
    count: AtomicUsize,
}

impl Log {
    pub fn new(job: &Job, topic: &Topic) -> Self {
        // A value that is not zero touches the memory.
        let entries = (0..job.releases(topic)).map(|_| AtomicU64::new(u64::MAX)).collect();
        Log { entries, count: AtomicUsize::new(0) }
    }

    /// Adds a response time; beyond the room nothing is kept.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn note(&self, latency_ns: u64) {
        let index = self.count.load(Ordering::Relaxed);
        if let Some(entry) = self.entries.get(index) {
            entry.store(latency_ns, Ordering::Relaxed);
            // Pairs with the Acquire in `len`.
            self.count.store(index + 1, Ordering::Release);
        }
    }

    pub fn len(&self) -> usize {
        self.count.load(Ordering::Acquire)
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn latencies_ns(&self) -> Vec<u64> {
        self.entries[..self.len()].iter().map(|entry| entry.load(Ordering::Relaxed)).collect()
    }
}

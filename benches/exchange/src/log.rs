// SPDX-License-Identifier: MIT OR Apache-2.0

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

/// Where a callback writes times down: memory that is there before it starts. One writer, any readers.
#[derive(Debug)]
pub struct Log {
    entries: Box<[AtomicU64]>,
    count: AtomicUsize,
}

impl Log {
    /// With room for so many times.
    pub fn new(capacity: usize) -> Self {
        // A value that is not zero touches the memory.
        let entries = (0..capacity).map(|_| AtomicU64::new(u64::MAX)).collect();
        Log { entries, count: AtomicUsize::new(0) }
    }

    /// Adds a time; beyond the room nothing is kept.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn note(&self, time_ns: u64) {
        let index = self.count.load(Ordering::Relaxed);
        if let Some(entry) = self.entries.get(index) {
            entry.store(time_ns, Ordering::Relaxed);
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

    /// In the order in which they were added.
    pub fn to_vec(&self) -> Vec<u64> {
        self.entries[..self.len()].iter().map(|entry| entry.load(Ordering::Relaxed)).collect()
    }
}

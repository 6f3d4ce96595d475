// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a publisher counts besides its samples.

use std::sync::atomic::{AtomicU64, Ordering};

/// Counters of one publisher, readable from any thread.
#[derive(Debug, Default)]
pub struct PublisherCounters {
    pub(super) growths: AtomicU64,
    pub(super) silenced: AtomicU64,
}

impl PublisherCounters {
    /// How often a new segment was created, with allocations and system calls in a loan: because a message was longer than
    /// `Limits::message_bytes` and all messages before, or needed a sample that was not claimed ahead. For a real-time
    /// publisher this should be 0.
    pub fn growths(&self) -> u64 {
        self.growths.load(Ordering::Relaxed)
    }

    /// Messages that were not sent because the publisher's [`Gate`](crate::Gate) was closed.
    pub fn silenced(&self) -> u64 {
        self.silenced.load(Ordering::Relaxed)
    }
}

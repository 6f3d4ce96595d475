// SPDX-License-Identifier: MIT OR Apache-2.0

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Lets publishers send, or silences them. Several publishers may share one gate. A clone is the same gate.
#[derive(Clone, Debug, Default)]
pub struct Gate {
    is_open: Arc<AtomicBool>,
}

impl Gate {
    /// A closed gate.
    pub fn new() -> Self {
        Gate::default()
    }

    /// Opens or closes it. Messages that are being published at that moment may still be sent.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn set_open(&self, is_open: bool) {
        self.is_open.store(is_open, Ordering::Release);
    }

    /// Whether publishers may send.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn is_open(&self) -> bool {
        self.is_open.load(Ordering::Acquire)
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Lets publishers send, or keeps them silent: many may have the same one. A clone is the same gate.
#[derive(Clone, Debug, Default)]
pub struct Gate {
    is_open: Arc<AtomicBool>,
}

impl Gate {
    /// A gate that is shut.
    pub fn new() -> Self {
        Gate::default()
    }

    /// Opens or shuts it. What is being published meanwhile may still be sent.
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

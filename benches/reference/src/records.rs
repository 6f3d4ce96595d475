// SPDX-License-Identifier: MIT OR Apache-2.0
//! What callbacks write down as they run: memory that is there before they start.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tautline_exchange::Log;

use crate::graph::CALLBACKS;

/// The part of a run that counts, on the monotonic clock.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    pub begin_ns: u64,
    pub end_ns: u64,
}

impl Window {
    pub fn contains(&self, instant_ns: u64) -> bool {
        (self.begin_ns..self.end_ns).contains(&instant_ns)
    }

    pub fn length(&self) -> Duration {
        Duration::from_nanos(self.end_ns - self.begin_ns)
    }
}

/// Of all callbacks, by their index in [`CALLBACKS`]. Each number has one writer.
#[derive(Debug)]
pub struct Records {
    pub window: Window,
    runs: Box<[AtomicU64]>,
    dropped: Box<[AtomicU64]>,
    pub(crate) hot_path_ns: Log,
    pub(crate) both_lidars_ns: Log,
    pub(crate) planner_starts_ns: Log,
}

impl Records {
    /// Room for what happens in `window`.
    pub fn new(window: Window) -> Records {
        let zeroes = || CALLBACKS.iter().map(|_| AtomicU64::new(0)).collect();
        let (runs, dropped) = (zeroes(), zeroes());
        // Twice what is expected: lidars and planner have 100 ms.
        let series = || Log::new(window.length().as_millis() as usize / 50 + 16);
        let (hot_path_ns, both_lidars_ns, planner_starts_ns) = (series(), series(), series());
        Records { window, runs, dropped, hot_path_ns, both_lidars_ns, planner_starts_ns }
    }

    pub(crate) fn note_run(&self, index: usize, dropped: u32) {
        self.runs[index].fetch_add(1, Ordering::Relaxed);
        self.dropped[index].fetch_add(dropped.into(), Ordering::Relaxed);
    }

    pub(crate) fn counts(&self, index: usize) -> (u64, u64) {
        (self.runs[index].load(Ordering::Relaxed), self.dropped[index].load(Ordering::Relaxed))
    }
}

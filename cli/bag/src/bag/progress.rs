// SPDX-License-Identifier: MIT OR Apache-2.0
//! The progress of verbs that read whole bags.

use indicatif::ProgressBar;
use std::path::Path;
use std::time::{Duration, Instant};

/// Progress on a terminal, shown after two seconds.
pub struct Progress {
    bar: ProgressBar,
    start: Instant,
}

impl Progress {
    pub fn new(is_json: bool) -> Self {
        let bar = if is_json { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
        Progress { bar, start: Instant::now() }
    }

    pub fn say(&self, path: &Path) {
        self.bar.set_message(format!("reading {}", path.display()));
        self.tick();
    }

    pub fn tick(&self) {
        if self.start.elapsed() > Duration::from_secs(2) {
            self.bar.tick();
        }
    }

    pub fn end(&self) {
        self.bar.finish_and_clear();
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Times of several kinds, which a process measures and tells the bench.

use crate::Result;
use crate::job::{Said, say_and_stay};
use tautline_harness::Distribution;
use tautline_rt::clock::monotonic_ns;

/// Times by what they are of, in the order in which they were first measured.
#[derive(Default)]
pub struct Stopwatch(Vec<(String, Distribution)>);

impl Stopwatch {
    /// Does it, and notes how long it took.
    pub fn time<T>(&mut self, what: &str, work: impl FnOnce() -> T) -> T {
        let start_ns = monotonic_ns();
        let result = work();
        self.note(what, monotonic_ns() - start_ns);
        result
    }

    pub fn note(&mut self, what: &str, time_ns: u64) {
        let index = self.0.iter().position(|(other, _)| other == what).unwrap_or_else(|| {
            self.0.push((what.to_owned(), Distribution::new()));
            self.0.len() - 1
        });
        self.0[index].1.record(time_ns);
    }

    /// Tells the bench, and waits until it ends this process.
    pub fn say_and_stay(self) -> Result<()> {
        let counts = |(what, times): (String, Distribution)| (what, times.counts());
        say_and_stay(&Said::Times(self.0.into_iter().map(counts).collect()))
    }
}

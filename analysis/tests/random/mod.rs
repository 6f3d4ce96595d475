// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random task sets, shared by the tests that compare against another opinion.
use std::time::Duration;

use rand::{RngExt, rngs::StdRng};
use tautline_analysis::Task;

/// A fresh seed, printed; set `SEED` to repeat a run.
pub fn seed() -> u64 {
    let seed = std::env::var("SEED").ok().and_then(|s| s.parse().ok()).unwrap_or_else(rand::random);
    println!("repeat with SEED={seed}");
    seed
}

/// One to six tasks of a few nanoseconds, loads from light to somewhat more than the core, priorities that collide,
/// some jitter (up to twice the period) and some blocking.
pub fn tasks(rng: &mut StdRng) -> Vec<Task> {
    let ns = Duration::from_nanos;
    let count = rng.random_range(1..=6);
    let load = rng.random_range(0.1..1.2);
    let (with_jitter, with_blocking) = (rng.random_bool(0.5), rng.random_bool(0.5));
    let task = |i: u64| {
        let period = rng.random_range(2..=200);
        let wcet = (period as f64 * load * rng.random_range(0.0..2.0) / count as f64).round().max(1.0);
        let mut task = Task::new(format!("task{i}"), ns(period), ns(wcet as u64), rng.random_range(1..=8));
        if with_jitter && rng.random_bool(0.5) {
            task = task.jitter(ns(rng.random_range(1..=2 * period)));
        }
        if with_blocking && rng.random_bool(0.5) {
            task = task.blocking(ns(rng.random_range(1..=50)));
        }
        task
    };
    (0..count).map(task).collect()
}

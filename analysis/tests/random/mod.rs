// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random task sets, shared by the tests that compare against another opinion.
use std::time::Duration;

use rand::{RngExt, rngs::StdRng};
use tautline_analysis::Task;

/// One to six tasks of a few nanoseconds, loads from light to somewhat more than the core, priorities that collide,
/// some jitter (up to twice the period) and some blocking.
#[allow(dead_code)] // not every test draws from both
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

/// Two to twenty tasks with a utilisation of 0.3 to 0.99, spread as UUniFast does (Bini & Buttazzo 2005); periods of 10 to
/// 10,000, jitter up to the period in half of the sets.
#[allow(dead_code)] // not every test draws from both
pub fn large(rng: &mut StdRng) -> Vec<Task> {
    loop {
        let tasks = large_once(rng);
        let utilisation: f64 = tasks.iter().map(|task| task.wcet_ns as f64 / task.period_ns as f64).sum();
        // A wcet is rounded up to 1: just below full load, a busy period may take millions of steps.
        if utilisation <= 0.99 {
            return tasks;
        }
    }
}

fn large_once(rng: &mut StdRng) -> Vec<Task> {
    let count = rng.random_range(2..=20_u32);
    let mut left: f64 = rng.random_range(0.3..0.99);
    let with_jitter = rng.random_bool(0.5);
    let mut share = |i: u32, rng: &mut StdRng| {
        let rest = if i + 1 == count {
            0.0
        } else {
            left * rng.random::<f64>().powf(1.0 / f64::from(count - i - 1))
        };
        std::mem::replace(&mut left, rest) - rest
    };
    let task = |i| {
        let period = 10_f64.powf(rng.random_range(1.0..4.0)).round();
        let wcet = (period * share(i, rng)).floor().max(1.0);
        let ns = |time: f64| Duration::from_nanos(time as u64);
        let mut task = Task::new(format!("task{i}"), ns(period), ns(wcet), rng.random_range(1..=30));
        if with_jitter && rng.random_bool(0.5) {
            task = task.jitter(ns(period * rng.random::<f64>()));
        }
        task
    };
    (0..count).map(task).collect()
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! By how much execution times and overheads may grow before a deadline is missed.
//!
//! All bounds of this crate grow with every execution time and overhead, so a search by halving finds the limit.
use crate::Task;
use crate::system::{Callback, Core, System};

/// Factors are counted in thousandths.
const UNIT: u64 = 1_000;

/// No factor above this many thousandths is looked for.
const LIMIT: u64 = 1_000 * UNIT;

/// The largest factor, in thousandths and at most 1,000,000, for which `schedulable` holds, provided that it holds for
/// all smaller ones. 0 if it holds for none.
pub fn largest_factor(mut schedulable: impl FnMut(u64) -> bool) -> u64 {
    let (mut good, mut bad) = (0, UNIT);
    while schedulable(bad) {
        if bad >= LIMIT {
            return LIMIT;
        }
        (good, bad) = (bad, (bad * 2).min(LIMIT));
    }
    while bad - good > 1 {
        let middle = good + (bad - good) / 2;
        if schedulable(middle) { good = middle } else { bad = middle }
    }
    good
}

/// By how many thousandths all execution times together may be multiplied: the critical scaling factor.
///
/// ```
/// use std::time::Duration;
/// use tautline_analysis::system::{Callback, Core, System};
/// use tautline_analysis::{Task, sensitivity};
/// let ms = Duration::from_millis;
/// let set = [(10, 2, 20), (20, 4, 19), (50, 5, 18), (100, 15, 17), (200, 50, 16)];
/// let callback = |(t, c, priority)| Callback::new(Task::new("topic", ms(t), ms(c), priority), 0);
/// let callbacks = set.map(callback).to_vec();
/// let system = System { cores: vec![Core::default()], callbacks, ..System::default() };
/// assert_eq!(sensitivity::load(&system), 1_111);
/// ```
pub fn load(system: &System) -> u64 {
    largest_factor(|factor| {
        let callbacks = system.callbacks.iter();
        let scaled = callbacks.map(|c| crate::system::Callback { task: scale(&c.task, factor), ..c.clone() });
        holds(&System { callbacks: scaled.collect(), ..system.clone() })
    })
}

/// By how many thousandths the execution times of these callbacks may be multiplied, the others unchanged. 0 if one of
/// them does not exist.
pub fn wcet(system: &System, callbacks: &[usize]) -> u64 {
    if callbacks.iter().any(|i| *i >= system.callbacks.len()) {
        return 0;
    }
    let mut scaled = system.clone();
    largest_factor(|factor| {
        callbacks.iter().for_each(|i| scaled.callbacks[*i].task = scale(&system.callbacks[*i].task, factor));
        holds(&scaled)
    })
}

/// By how many thousandths all overheads together may be multiplied; the limit of 1,000,000 if there are none.
pub fn overhead(system: &System) -> u64 {
    largest_factor(|factor| {
        let mut scaled = system.clone();
        for Core { overheads, .. } in &mut scaled.cores {
            for time in
                [&mut overheads.context_switch_ns, &mut overheads.per_message_ns, &mut overheads.tick_ns]
            {
                *time = times(*time, factor);
            }
        }
        scaled.relays.iter_mut().for_each(|relay| relay.cost_ns = times(relay.cost_ns, factor));
        for Callback { task, .. } in &mut scaled.callbacks {
            task.message_overhead_ns = task.message_overhead_ns.map(|ns| times(ns, factor));
            task.executor_overhead_ns = times(task.executor_overhead_ns, factor);
        }
        holds(&scaled)
    })
}

fn holds(system: &System) -> bool {
    system.analyse().is_ok_and(|report| report.schedulable())
}

fn scale(task: &Task, factor: u64) -> Task {
    let wcet_ns = times(task.wcet_ns, factor).max(1);
    let non_preemptive_ns =
        if task.non_preemptive_ns == task.wcet_ns { wcet_ns } else { task.non_preemptive_ns.min(wcet_ns) };
    Task { wcet_ns, non_preemptive_ns, bcet_ns: task.bcet_ns.min(wcet_ns), ..task.clone() }
}

/// Rounded up; too long for the analysis if it does not fit.
fn times(ns: u64, factor: u64) -> u64 {
    u64::try_from((u128::from(ns) * u128::from(factor)).div_ceil(UNIT.into())).unwrap_or(u64::MAX)
}

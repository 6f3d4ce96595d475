// SPDX-License-Identifier: MIT OR Apache-2.0
//! By how much execution times and overheads may grow before a deadline is missed.
//!
//! All bounds of this crate grow with every execution time and overhead, so a search by halving finds the limit. In a large system it ends
//! early: all of its limits together cost as much as twenty checks, and each of them is then a lower bound.
use std::ops::Range;

use crate::Task;
use crate::level::Effort;
use crate::system::{Callback, Core, FEW, LIMIT, System, UNIT};

/// The largest factor, in thousandths and at most 1,000,000, for which `schedulable` holds, provided that it holds for
/// all smaller ones. 0 if it holds for none. From 2,000 on, it is up to one in a thousand too low.
pub fn largest_factor(mut schedulable: impl FnMut(u64) -> bool) -> u64 {
    let (mut good, mut bad, mut step) = (0, UNIT, 2);
    while schedulable(bad) {
        if bad >= LIMIT {
            return LIMIT;
        }
        (good, bad, step) = (bad, (bad * step).min(LIMIT), step * 2);
    }
    while bad - good > (good / UNIT).max(1) {
        let middle = if bad > 4 * good && good > 0 { (good * bad).isqrt() } else { good + (bad - good) / 2 };
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
    search(system, |factor| {
        let callbacks = system.callbacks.iter();
        let scaled = callbacks.map(|c| crate::system::Callback { task: scale(&c.task, factor), ..c.clone() });
        System { callbacks: scaled.collect(), ..system.clone() }
    })
}

/// By how many thousandths at least the execution times of each of these callbacks, given as their tasks, may be multiplied, the others
/// unchanged: for all callbacks together this costs about as much as two searches for one, and may find less than [`wcet`]. `None` if a
/// deadline is missed already. On a core with a thread that [lowers itself](Task::lowered_to), each callback costs as much as a search for it alone.
pub fn wcet_of_each(system: &System, callbacks: &[Range<usize>]) -> Option<Vec<u64>> {
    let slack = system.slack()?;
    let factor = |callback| {
        let grown = system.grown(callback);
        match system.lowers_itself_beside(&grown) {
            true => search(system, |factor| {
                let mut scaled = system.clone();
                grown
                    .iter()
                    .for_each(|i| scaled.callbacks[*i].task = scale(&system.callbacks[*i].task, factor));
                scaled
            }),
            false => slack.factor(system, &grown),
        }
    };
    Some(callbacks.iter().map(factor).collect())
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
        scaled.holds(&Effort::until_late(u64::MAX))
    })
}

/// By how many thousandths all overheads together may be multiplied; the limit of 1,000,000 if there are none.
pub fn overhead(system: &System) -> u64 {
    search(system, |factor| {
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
        scaled
    })
}

fn scale(task: &Task, factor: u64) -> Task {
    let wcet_ns = times(task.wcet_ns, factor).max(1);
    let non_preemptive_ns =
        if task.non_preemptive_ns == task.wcet_ns { wcet_ns } else { task.non_preemptive_ns.min(wcet_ns) };
    Task { wcet_ns, non_preemptive_ns, bcet_ns: task.bcet_ns.min(wcet_ns), ..task.clone() }
}

/// The largest factor with which no deadline is missed, in about as many steps as six analyses. Near the limit an analysis takes very many:
/// one that takes too many counts as a deadline missed.
fn search(system: &System, scaled: impl Fn(u64) -> System) -> u64 {
    if scaled(LIMIT) == *system {
        return LIMIT;
    }
    let once = system.steps();
    let (mut left, most) =
        (once.saturating_mul(6).saturating_add(5 * FEW), once.saturating_mul(2).saturating_add(FEW));
    largest_factor(|factor| {
        let effort = Effort::until_late(left.min(most));
        let holds = scaled(factor).holds(&effort);
        left = left.saturating_sub(effort.steps());
        holds
    })
}

/// Multiplies a time, rounded up; a result that does not fit is too long for the analysis.
fn times(ns: u64, factor: u64) -> u64 {
    u64::try_from((u128::from(ns) * u128::from(factor)).div_ceil(UNIT.into())).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::SystemFile;
    use crate::level::STEPS;
    use std::cell::RefCell;
    use std::fmt::Write;

    /// A thousand callbacks on two cores, in chains: some have far to go, and some miss their deadlines.
    #[test]
    fn all_limits_cost_no_more_than_twenty_checks() {
        for (length, cost_us) in [(1, 150), (10, 100), (1_000, 1)] {
            let mut text = "[hosts.h]\ncores = 2\n[overheads]\nper_message = \"10ns\"\n".to_owned();
            text += "[nodes.n]\ncore = 0\n[nodes.m]\ncore = 1\n";
            for i in 0..1_000 {
                let trigger = match i % length {
                    0 => format!("period = \"{}ms\"", 100 + i / length),
                    _ => format!("topic = \"t{}\"", i - 1),
                };
                let (node, priority) = (["n", "m"][i % 2], 1 + i % 80);
                writeln!(
                    text,
                    "[callbacks.c{i}]\nnode = \"{node}\"\n{trigger}\nwcet = \"{cost_us}us\"\npublishes = \"t{i}\"\n\
                     deadline = \"1s\"\npriority = {priority}\nshares_priority = true"
                )
                .unwrap();
            }
            let file = SystemFile::parse(&text).unwrap();
            let (system, tasks) = (
                file.system(),
                file.callbacks().iter().map(|callback| callback.tasks.clone()).collect::<Vec<_>>(),
            );
            let steps = |run: &dyn Fn()| {
                let before = STEPS.get();
                run();
                STEPS.get() - before
            };
            let check = steps(&|| drop(file.check()));
            let free = file.system_without_overheads();
            let found = RefCell::default();
            let limits = steps(&|| {
                let each = wcet_of_each(system, &tasks).map(|each| each[0]);
                found.replace((load(system), load(&free), overhead(system), each));
            });
            println!("chains of {length}: {check} steps, {limits} for the limits {:?}", found.borrow());
            assert!(limits <= 20 * check.max(FEW));
        }
    }
}

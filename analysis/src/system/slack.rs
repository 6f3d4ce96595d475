// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much longer callbacks may take, found for all of them at once.
//!
//! Each task k is blocked for X_k more, as long as all deadlines are still met. Its longest busy window is then W_k. If the jobs of another task
//! that are released within W_k take no more than X_k longer together, k ends no later than with X_k, whatever they delay on their way: each
//! window up to W_k has less work. So k's response is no longer, nor is the jitter of what it triggers. The windows of a single analysis
//! thus show how much longer the jobs of any one callback may take.
use std::collections::HashMap;
use std::ops::Range;

use super::chains;
use super::fixpoint::{self, Solved};
use super::model::{Callback, System};
use crate::level::{Core, Effort};
use crate::{Hold, Release, Response, Task};

/// Factors are counted in thousandths.
pub(crate) const UNIT: u64 = 1_000;

/// No factor above this many thousandths is looked for.
pub(crate) const LIMIT: u64 = 1_000 * UNIT;

/// This many steps take no time worth saving.
pub(crate) const FEW: u64 = 20_000;

/// The room of a task is found to 1 part in 256, by this many halvings.
const HALVINGS: u32 = 8;

/// The additional blocking that all tasks can have, and the solution with it.
pub(crate) struct Slack {
    blocking_ns: Vec<u64>,
    solved: Solved,
}

impl System {
    /// How many steps its analysis takes.
    pub(crate) fn steps(&self) -> u64 {
        let effort = Effort::unlimited();
        // A system without a meaning is refused at once.
        let _ = fixpoint::solve(self, &effort);
        effort.steps()
    }

    /// Whether every callback and every chain meets its deadline.
    pub(crate) fn holds(&self, effort: &Effort) -> bool {
        self.met(effort).is_some()
    }

    /// Returns the solution, if every callback and every chain meets its deadline.
    fn met(&self, effort: &Effort) -> Option<Solved> {
        let solved = fixpoint::solve(self, effort).ok()?;
        let meets = |chain| chains::bound(self, chain, &solved).is_ok_and(|bound| bound.met);
        (solved.outcomes.iter().all(Result::is_ok) && self.chains.iter().all(meets)).then_some(solved)
    }

    /// Returns the slack; `None` if a deadline is missed.
    pub(crate) fn slack(&self) -> Option<Slack> {
        let effort = Effort::until_late(u64::MAX);
        let solved = self.met(&effort)?;
        // Near the limit, to find out may take much longer than to find that there is none.
        let most = effort.steps().saturating_mul(2).saturating_add(FEW);
        let threads = self.threads();
        // Of each thread, at the first of its tasks: the blocking that fits, and the blocking that is too much.
        let mut bounds = vec![(0, u64::MAX); threads.len()];
        for ((callback, outcome), thread) in self.callbacks.iter().zip(&solved.outcomes).zip(&threads) {
            let room_ns =
                outcome.as_ref().map_or(0, |response| response.deadline_ns - callback.counted_ns(response));
            bounds[*thread].1 = room_ns.min(bounds[*thread].1);
        }
        // With the jitter that is known, no thread's blocking affects another.
        for _ in 0..HALVINGS {
            let middle: Vec<u64> = bounds.iter().map(|(good, bad)| good + (bad - good) / 2).collect();
            let blocking_ns: Vec<u64> = threads.iter().map(|thread| middle[*thread]).collect();
            let mut fits = vec![true; threads.len()];
            for (fit, thread) in self.fit(&solved, &blocking_ns).zip(&threads) {
                fits[*thread] &= fit;
            }
            for ((bound, middle), fits) in bounds.iter_mut().zip(middle).zip(fits) {
                if fits { bound.0 = middle } else { bound.1 = middle }
            }
        }
        // The blocking makes responses, and so jitter, longer.
        for halved in 0..HALVINGS {
            let blocking_ns: Vec<u64> = threads.iter().map(|thread| bounds[*thread].0 >> halved).collect();
            let callbacks = self.callbacks.iter().zip(&blocking_ns);
            let callbacks = callbacks.map(|(c, ns)| Callback { task: blocked(&c.task, *ns), ..c.clone() });
            let held_up = System { callbacks: callbacks.collect(), ..self.clone() };
            // Without that blocking, jitter is not followed as far.
            let is_endless =
                |(task, callback): (&Task, &Callback)| fixpoint::is_endless(task, callback.task.blocking_ns);
            let found = held_up.met(&Effort::until_late(most));
            let found = found.filter(|solved| !solved.tasks.iter().zip(&self.callbacks).any(is_endless));
            if let Some(solved) = found {
                return Some(Slack { blocking_ns, solved });
            }
        }
        Some(Slack { blocking_ns: vec![0; threads.len()], solved })
    }

    /// The thread of each callback, as the index of its first.
    fn threads(&self) -> Vec<usize> {
        let mut firsts = HashMap::new();
        let thread = |(i, callback): (usize, &Callback)| match callback.task.group {
            Some(group) => *firsts.entry((callback.core, group.id)).or_insert(i),
            None => i,
        };
        self.callbacks.iter().enumerate().map(thread).collect()
    }

    /// Whether each task meets its deadline if it is blocked for `blocking_ns` more, with the releases found before.
    fn fit(&self, solved: &Solved, blocking_ns: &[u64]) -> impl Iterator<Item = bool> {
        let mut fits = vec![false; self.callbacks.len()];
        for (number, core) in self.cores.iter().enumerate() {
            let members: Vec<usize> = (0..fits.len()).filter(|i| self.callbacks[*i].core == number).collect();
            let tasks: Vec<Task> =
                members.iter().map(|i| blocked(&solved.tasks[*i], blocking_ns[*i])).collect();
            let relays = &solved.relays[number];
            let first = |i: &usize| Some(solved.firsts[*i]?.first(&solved.tasks));
            let firsts: Vec<_> = members.iter().map(first).collect();
            let Ok(analysed) = Core::beside(&tasks, &firsts, &core.overheads, relays, core.stall_ns) else {
                continue;
            };
            let effort = Effort::until_late(u64::MAX);
            let analysed = analysed.with_effort(&effort);
            for (place, &i) in members.iter().enumerate() {
                let response = Response::of(&analysed, &tasks[place], place);
                fits[i] = response.is_ok_and(|response| self.callbacks[i].meets(&response));
            }
        }
        fits.into_iter()
    }
}

/// Blocks a task for `ns` more. If it has a reservation, that is also work of its own: its runtime may not be enough for more.
fn blocked(task: &Task, ns: u64) -> Task {
    let mut task = task.clone();
    task.blocking_ns = task.blocking_ns.saturating_add(ns);
    if task.reservation.is_some() {
        task.wcet_ns = task.wcet_ns.saturating_add(ns);
    }
    task
}

impl System {
    /// The tasks of a callback, with their copies on other cores.
    pub(crate) fn grown(&self, callback: &Range<usize>) -> Vec<usize> {
        let is_grown = |i: &usize| {
            callback.contains(i) || self.callbacks[*i].copy_of.is_some_and(|own| callback.contains(&own))
        };
        (0..self.callbacks.len()).filter(is_grown).collect()
    }

    /// Whether a thread that lowers itself is on a core of these tasks. One job then counts in several windows of a bound, for which there is no
    /// slack in common.
    pub(crate) fn lowers_itself_beside(&self, tasks: &[usize]) -> bool {
        let is_beside = |callback: &Callback| tasks.iter().any(|i| self.callbacks[*i].core == callback.core);
        self.callbacks.iter().any(|of| of.task.lowest() < of.task.priority && is_beside(of))
    }
}

impl Slack {
    /// A factor in thousandths, for the tasks of one callback together, with which no deadline is missed.
    pub(crate) fn factor(&self, system: &System, grown: &[usize]) -> u64 {
        let affected =
            |k: &usize| grown.iter().any(|j| system.callbacks[*j].core == system.callbacks[*k].core);
        let of_tasks = (0..system.callbacks.len()).filter(affected).map(|k| {
            let longer = |j: usize| self.releases(system, j, k);
            // Less 1 for what stays free.
            self.largest(
                system,
                grown,
                system.callbacks[k].core,
                self.blocking_ns[k].saturating_sub(1),
                longer,
            )
        });
        let of_throttling = system.cores.iter().enumerate().filter_map(|(number, core)| {
            let window_ns = core.overheads.throttling?.period_ns.saturating_add(core.stall_ns);
            let spare_ns = Some(self.solved.spare_ns[number]).filter(|spare_ns| *spare_ns < u64::MAX)?;
            let longer = |j: usize| match self.solved.tasks[j].reservation {
                Some(_) => 0,
                None => self.delaying(j).most_within(window_ns),
            };
            Some(self.largest(system, grown, number, spare_ns, longer))
        });
        of_tasks.chain(of_throttling).min().unwrap_or(0)
    }

    /// Returns the factor at which the `jobs` of those `grown` tasks that are on a core take at most `room_ns` longer, each rounded up.
    fn largest(
        &self,
        system: &System,
        grown: &[usize],
        core: usize,
        room_ns: u64,
        jobs: impl Fn(usize) -> u64,
    ) -> u64 {
        let (mut count, mut cost_ns) = (0_u64, 0_u128);
        for &j in grown.iter().filter(|j| system.callbacks[**j].core == core) {
            let jobs = jobs(j);
            count = count.saturating_add(jobs);
            cost_ns += u128::from(jobs) * u128::from(system.callbacks[j].task.wcet_ns);
        }
        if cost_ns == 0 {
            return LIMIT;
        }
        let more = u128::from(room_ns.saturating_sub(count)) * u128::from(UNIT) / cost_ns;
        u64::try_from(more).map_or(LIMIT, |more| more.saturating_add(UNIT).min(LIMIT))
    }

    /// How many jobs of j may make a busy window of k longer.
    fn releases(&self, system: &System, j: usize, k: usize) -> u64 {
        let Ok(response) = &self.solved.outcomes[k] else { return u64::MAX };
        let (own, other) = (&self.solved.tasks[k], &self.solved.tasks[j]);
        let is_own = j == k || (own.group.is_some() && own.group == other.group);
        if is_own {
            // Beside what is released, a window may begin with a job of each timer, and a timer's has two rounds.
            let has_timer = own.rank.is_timer() || other.rank.is_timer();
            let released = other.release().min_distance(0).most_within(response.busy_ns);
            return released.saturating_add(has_timer.into());
        }
        if other.reservation.is_some() {
            return 0;
        }
        if other.priority >= own.priority {
            return self.delaying(j).most_within(response.busy_ns);
        }
        let is_section = other.non_preemptive_ns >= system.callbacks[j].task.wcet_ns;
        match (is_section, own.reservation) {
            (false, _) => 0,
            (true, None) => 1,
            // A section may begin whenever the task waits.
            (true, Some(_)) => u64::MAX,
        }
    }

    /// Returns the releases by which a task takes time from others.
    fn delaying(&self, j: usize) -> Release {
        let task = &self.solved.tasks[j];
        match task.hold {
            Hold::Suspended { deferred: true } => Release::periodic(task.period_ns).jitter(task.period_ns),
            _ => task.release().min_distance(0),
        }
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Response times and jitter, repeated until they agree.
use super::System;
use super::join::{self, JoinBound, Timing};
use crate::{AnalysisError, Response, Task, level};

/// Ends the search where chains that delay each other let jitter grow for ever.
const MAX_ROUNDS: u32 = 1_000;

/// No jitter of more periods, and times for which the task is blocked, is followed further: as many messages would have to be queued.
const MAX_JITTER_PERIODS: u64 = 100;

pub(super) type Outcomes = Vec<Result<Response, AnalysisError>>;

/// All that is found.
pub(super) struct Solved {
    /// Of each callback.
    pub outcomes: Outcomes,
    /// Of each callback that is a join with a bound.
    pub joins: Vec<Option<JoinBound>>,
    /// How the releases of each callback lie to the first of those that trigger it.
    pub timings: Vec<Timing>,
    /// Whether each core may be throttled.
    pub throttled: Vec<bool>,
    pub rounds: u32,
}

pub(super) fn solve(system: &System) -> Result<Solved, AnalysisError> {
    let order = upstream_first(system)?;
    for callback in &system.callbacks {
        if let Some(join) = &callback.join {
            join::validate(system, join, &callback.task.name)?;
        }
    }
    let mut tasks: Vec<Task> = system.callbacks.iter().map(|callback| callback.task.clone()).collect();
    for &i in &order {
        if let Some((source, transfer)) = system.callbacks[i].trigger {
            (tasks[i].period_ns, tasks[i].distances) =
                (tasks[source].period_ns, tasks[source].distances.clone());
            // The least jitter there can be: what the trigger itself has, and the network adds.
            let network_ns = transfer.most_ns.saturating_sub(transfer.least_ns);
            tasks[i].jitter_ns = tasks[source].jitter_ns.saturating_add(network_ns);
            // Messages of one callback are at least one execution apart, but the network may bunch them.
            let apart = if network_ns == 0 { tasks[source].bcet_ns } else { 0 };
            tasks[i].min_distance_ns = tasks[i].min_distance_ns.max(apart).min(tasks[i].period_ns);
        } else if let Some(join) = &system.callbacks[i].join {
            // The jitter follows with the first round.
            let (release, ..) = join::solve(join, &tasks, &vec![Timing::default(); tasks.len()], |_| 0);
            tasks[i] = tasks[i].clone().released(release.jitter(0));
        }
    }
    let members: Vec<Vec<usize>> = (0..system.cores.len())
        .map(|core| (0..tasks.len()).filter(|i| system.callbacks[*i].core == core).collect())
        .collect();
    let unknown = |task: &Task| Err(AnalysisError::Overflow { task: task.name.clone() });
    let mut outcomes: Outcomes = tasks.iter().map(unknown).collect();
    let mut throttled = vec![false; members.len()];
    let mut dirty = vec![true; members.len()];
    let mut rounds = 0;
    loop {
        rounds += 1;
        for core in 0..members.len() {
            if std::mem::take(&mut dirty[core]) {
                throttled[core] |= analyse_core(system, core, &members[core], &tasks, &mut outcomes)?;
            }
        }
        let (grown, timings, mut joins) = pass_on(system, &order, &mut tasks, &outcomes);
        let endless = |i: &usize| {
            let Task { jitter_ns, period_ns, blocking_ns, .. } = tasks[*i];
            jitter_ns / MAX_JITTER_PERIODS > period_ns.saturating_add(blocking_ns)
        };
        if grown.is_empty() || rounds == MAX_ROUNDS || grown.iter().any(endless) {
            grown.into_iter().for_each(|i| outcomes[i] = Err(diverges(&tasks[i], &outcomes[i], rounds)));
            without_bound(system, &order, &mut outcomes);
            joins
                .iter_mut()
                .zip(&outcomes)
                .filter(|(_, outcome)| outcome.is_err())
                .for_each(|(join, _)| *join = None);
            return Ok(Solved { outcomes, joins, timings, throttled, rounds });
        }
        grown.iter().for_each(|i| dirty[system.callbacks[*i].core] = true);
    }
}

fn analyse_core(
    system: &System,
    core: usize,
    members: &[usize],
    tasks: &[Task],
    outcomes: &mut Outcomes,
) -> Result<bool, AnalysisError> {
    let local: Vec<Task> = members.iter().map(|i| tasks[*i].clone()).collect();
    let analysed = level::Core::new(&local, &system.cores[core].overheads)?;
    for (place, &i) in members.iter().enumerate() {
        outcomes[i] = Response::of(&analysed, &local[place], place);
    }
    Ok(analysed.throttled())
}

/// Gives triggered callbacks the jitter of their triggers; returns those whose jitter grew, and how all lie to each other.
fn pass_on(
    system: &System,
    order: &[usize],
    tasks: &mut [Task],
    outcomes: &Outcomes,
) -> (Vec<usize>, Vec<Timing>, Vec<Option<JoinBound>>) {
    let mut grown = Vec::new();
    let mut timings = vec![Timing::default(); tasks.len()];
    let mut joins = vec![None; tasks.len()];
    for &i in order {
        let callback = &system.callbacks[i];
        let before_ns = tasks[i].jitter_ns;
        if let Some((source, transfer)) = callback.trigger {
            let response = outcomes[source].as_ref();
            if let Ok(response) = response {
                let network = transfer.most_ns.saturating_sub(transfer.least_ns);
                let jitter =
                    response.response_ns.saturating_sub(tasks[source].bcet_ns).saturating_add(network);
                tasks[i].jitter_ns = jitter.max(before_ns);
            }
            let is_first = !system.callbacks[source].is_triggered();
            let stamped_ns = response.ok().filter(|_| is_first).map(|response| response.response_ns);
            timings[i] = timings[source].passed_on(&tasks[source], &tasks[i], transfer.least_ns, stamped_ns);
        } else if let Some(join) = &callback.join {
            let response_ns = |i: usize| outcomes[i].as_ref().map_or(0, |response| response.from_arrival_ns);
            let of_thread = |input: usize| response_ns(input).max(response_ns(i));
            let (release, timing, bound) = join::solve(join, tasks, &timings, of_thread);
            tasks[i].jitter_ns = release.jitter_ns.max(before_ns);
            (timings[i], joins[i]) = (timing, Some(bound));
        } else {
            timings[i] = Timing::of_own(&tasks[i]);
        }
        if tasks[i].jitter_ns > before_ns {
            grown.push(i);
        }
    }
    (grown, timings, joins)
}

fn diverges(task: &Task, outcome: &Result<Response, AnalysisError>, rounds: u32) -> AnalysisError {
    AnalysisError::Diverges {
        task: task.name.clone(),
        jitter_ns: task.jitter_ns,
        priority: task.priority,
        utilisation: outcome.as_ref().map_or(1.0, |response| response.level_utilisation),
        rounds,
    }
}

/// Takes their bounds from all callbacks that something without a bound triggers or delays.
fn without_bound(system: &System, order: &[usize], outcomes: &mut Outcomes) {
    loop {
        let mut changed = false;
        for &i in order {
            let callback = &system.callbacks[i];
            let source = callback.predecessors().iter().copied().find(|source| outcomes[*source].is_err());
            let cause = match (source, &outcomes[i]) {
                (Some(source), _) => source,
                (_, Err(AnalysisError::Diverges { .. })) if callback.is_triggered() => i,
                _ => continue,
            };
            // Its releases are not known, so neither is what it takes from its level and those below.
            let (core, priority) = (system.callbacks[i].core, system.callbacks[i].task.priority);
            let cause = system.callbacks[cause].task.name.clone();
            for (outcome, callback) in outcomes.iter_mut().zip(&system.callbacks) {
                if outcome.is_ok() && callback.core == core && callback.task.priority <= priority {
                    let task = callback.task.name.clone();
                    *outcome = Err(AnalysisError::Upstream { task, cause: cause.clone() });
                    changed = true;
                }
            }
        }
        if !changed {
            return;
        }
    }
}

/// All callbacks, triggers before what they trigger.
fn upstream_first(system: &System) -> Result<Vec<usize>, AnalysisError> {
    let count = system.callbacks.len();
    for callback in &system.callbacks {
        let name = || callback.task.name.clone();
        if callback.core >= system.cores.len() {
            let (index, count) = (callback.core, system.cores.len());
            return Err(AnalysisError::BadReference { name: name(), what: "core", index, count });
        }
        if let Some(&index) = callback.predecessors().iter().find(|index| **index >= count) {
            return Err(AnalysisError::BadReference { name: name(), what: "task", index, count });
        }
    }
    let mut order = Vec::with_capacity(count);
    let mut placed = vec![false; count];
    for start in 0..count {
        // The way down to here, each with how many of its predecessors were looked at.
        let mut path = vec![(start, 0)];
        while let Some((i, looked_at)) = path.last_mut().filter(|(i, _)| !placed[*i]) {
            let i = *i;
            let Some(&next) = system.callbacks[i].predecessors().get(*looked_at) else {
                placed[i] = true;
                order.push(i);
                path.pop();
                continue;
            };
            *looked_at += 1;
            if let Some(from) = path.iter().position(|(seen, _)| *seen == next) {
                let name = |(i, _): &(usize, usize)| format!("`{}`", system.callbacks[*i].task.name);
                let tasks = path[from..].iter().rev().map(name).collect::<Vec<_>>().join(", ");
                return Err(AnalysisError::Cycle { tasks });
            }
            if !placed[next] {
                path.push((next, 0));
            }
        }
    }
    Ok(order)
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Response times and jitter, repeated until they agree.
use super::System;
use crate::{AnalysisError, Response, Task, level};

/// Ends the search where chains that delay each other let jitter grow for ever.
const MAX_ROUNDS: u32 = 1_000;

/// No jitter of more periods is followed further: as many messages would have to be queued.
const MAX_JITTER_PERIODS: u64 = 100;

pub(super) type Outcomes = Vec<Result<Response, AnalysisError>>;

/// The outcome of each callback, whether each core may be throttled, and the rounds it took.
pub(super) fn solve(system: &System) -> Result<(Outcomes, Vec<bool>, u32), AnalysisError> {
    let order = upstream_first(system)?;
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
        }
    }
    let members: Vec<Vec<usize>> = (0..system.cores.len())
        .map(|core| (0..tasks.len()).filter(|i| system.callbacks[*i].core == core).collect())
        .collect();
    let unknown = |task: &Task| Err(AnalysisError::Overflow { task: task.name.clone() });
    let mut outcomes: Outcomes = tasks.iter().map(unknown).collect();
    let mut throttled = vec![false; members.len()];
    let mut dirty = vec![true; members.len()];
    let mut round = 0;
    loop {
        round += 1;
        for core in 0..members.len() {
            if std::mem::take(&mut dirty[core]) {
                throttled[core] |= analyse_core(system, core, &members[core], &tasks, &mut outcomes)?;
            }
        }
        let grown = pass_on(system, &order, &mut tasks, &outcomes);
        let endless = |i: &usize| tasks[*i].jitter_ns / MAX_JITTER_PERIODS > tasks[*i].period_ns;
        if grown.is_empty() || round == MAX_ROUNDS || grown.iter().any(endless) {
            grown.into_iter().for_each(|i| outcomes[i] = Err(diverges(&tasks[i], &outcomes[i], round)));
            without_bound(system, &order, &mut outcomes);
            return Ok((outcomes, throttled, round));
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

/// Gives triggered callbacks the jitter of their triggers; returns those whose jitter grew.
fn pass_on(system: &System, order: &[usize], tasks: &mut [Task], outcomes: &Outcomes) -> Vec<usize> {
    let mut grown = Vec::new();
    for &i in order {
        let Some((source, transfer)) = system.callbacks[i].trigger else { continue };
        let Ok(response) = &outcomes[source] else { continue };
        let network = transfer.most_ns.saturating_sub(transfer.least_ns);
        let jitter = response.response_ns.saturating_sub(tasks[source].bcet_ns).saturating_add(network);
        if jitter > tasks[i].jitter_ns {
            tasks[i].jitter_ns = jitter;
            grown.push(i);
        }
    }
    grown
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
            let Some((source, _)) = system.callbacks[i].trigger else { continue };
            let cause = match (&outcomes[source], &outcomes[i]) {
                (Err(_), _) => source,
                (_, Err(AnalysisError::Diverges { .. })) => i,
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
        if let Some((index, _)) = callback.trigger.filter(|(index, _)| *index >= count) {
            return Err(AnalysisError::BadReference { name: name(), what: "task", index, count });
        }
    }
    let mut order = Vec::with_capacity(count);
    let mut placed = vec![false; count];
    for start in 0..count {
        let mut path = Vec::new();
        let mut next = Some(start);
        while let Some(i) = next.filter(|i| !placed[*i]) {
            if let Some(from) = path.iter().position(|seen| *seen == i) {
                let name = |i: &usize| format!("`{}`", system.callbacks[*i].task.name);
                let tasks = path[from..].iter().rev().map(name).collect::<Vec<_>>().join(", ");
                return Err(AnalysisError::Cycle { tasks });
            }
            path.push(i);
            next = system.callbacks[i].trigger.map(|(source, _)| source);
        }
        for i in path.into_iter().rev() {
            placed[i] = true;
            order.push(i);
        }
    }
    Ok(order)
}

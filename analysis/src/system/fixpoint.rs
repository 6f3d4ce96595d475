// SPDX-License-Identifier: MIT OR Apache-2.0
//! Response times and jitter, repeated until they agree.
use std::cmp::Ordering;

use super::join::{self, JoinBound, Timing};
use super::model::{System, Transfer};
use crate::error::Unbounded;
use crate::level::{self, Effort, First};
use crate::{AnalysisError, Order, Release, Response, Task};

/// Ends the search where chains that delay each other let jitter grow for ever.
const MAX_ROUNDS: u32 = 1_000;

/// Jitter beyond this many times the period and the blocking of a task is not followed: as many messages would have to be queued.
const MAX_JITTER_PERIODS: u64 = 100;

pub(super) type Outcomes = Vec<Result<Response, AnalysisError>>;

pub(super) struct Solved {
    /// The bound of each callback.
    pub outcomes: Outcomes,
    /// The bound of each callback that is a join and has one.
    pub joins: Vec<Option<JoinBound>>,
    /// How the releases of each callback lie to those of the first callback that leads to it.
    pub timings: Vec<Timing>,
    /// Whether each core may be throttled.
    pub throttled: Vec<bool>,
    /// How much more work a period of each core's throttling may have before it throttles.
    pub spare_ns: Vec<u64>,
    /// The callbacks, with the releases that they inherit.
    pub tasks: Vec<Task>,
    /// For each callback that others of its core lead to, the first of these.
    pub firsts: Vec<Option<Lead>>,
    /// The releases and the cost of the relays on each core.
    pub relays: Vec<Vec<(Release, u64)>>,
    pub rounds: u32,
}

/// Bounds all callbacks. With [`Effort::until_late`], the first that is late or has no bound ends the search with an error of any kind.
pub(super) fn solve(system: &System, effort: &Effort) -> Result<Solved, AnalysisError> {
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
            tasks[i].unordered |= tasks[source].unordered || network_ns > 0;
        } else if let Some(join) = &system.callbacks[i].join {
            // The jitter follows with the first round.
            let (release, ..) =
                join::solve(join, &tasks, &vec![Timing::default(); tasks.len()], |_| 0, false);
            tasks[i] = tasks[i].clone().released(release.jitter(0));
        }
    }
    let firsts = firsts(system, &tasks, &order);
    let members: Vec<Vec<usize>> = (0..system.cores.len())
        .map(|core| (0..tasks.len()).filter(|i| system.callbacks[*i].core == core).collect())
        .collect();
    let unknown = |task: &Task| Err(AnalysisError::Overflow { task: task.name.clone() });
    let mut outcomes: Outcomes = tasks.iter().map(unknown).collect();
    let (mut throttled, mut spare_ns) = (vec![false; members.len()], vec![u64::MAX; members.len()]);
    let mut relays = relayed(system, &firsts, &tasks, &outcomes);
    let mut dirty = vec![true; members.len()];
    let mut rounds = 0;
    loop {
        rounds += 1;
        for core in 0..members.len() {
            if std::mem::take(&mut dirty[core]) {
                let local: Vec<Task> = members[core].iter().map(|i| tasks[*i].clone()).collect();
                let super::model::Core { overheads, stall_ns } = &system.cores[core];
                let first: Vec<_> = members[core].iter().map(|i| Some(firsts[*i]?.first(&tasks))).collect();
                let analysed = level::Core::beside(&local, &first, overheads, &relays[core], *stall_ns)?;
                let analysed = analysed.with_effort(effort);
                for (place, &i) in members[core].iter().enumerate() {
                    // Jitter only grows: a callback without a bound gets none later.
                    if rounds == 1 || outcomes[i].is_ok() {
                        outcomes[i] = Response::of(&analysed, &local[place], place);
                    }
                    if effort.is_until_late()
                        && !system.callbacks[i].meets(outcomes[i].as_ref().map_err(Clone::clone)?)
                    {
                        return Err(AnalysisError::NoSlack {
                            task: local[place].name.clone(),
                            priority: local[place].priority,
                        });
                    }
                }
                throttled[core] |= analysed.throttled();
                spare_ns[core] = if throttled[core] { u64::MAX } else { analysed.spare_ns() };
            }
        }
        copies(system, &mut outcomes);
        let (grown, timings, mut joins) = pass_on(system, &order, &firsts, &mut tasks, &outcomes);
        let endless = |i: &usize| is_endless(&tasks[*i], tasks[*i].blocking_ns);
        let now = relayed(system, &firsts, &tasks, &outcomes);
        let is_still = grown.is_empty() && now == relays;
        if is_still || rounds == MAX_ROUNDS || grown.iter().any(endless) {
            let relayed = system.relays.iter().filter(|_| now != relays).filter_map(|relay| relay.source);
            relayed.for_each(|(i, _)| outcomes[i] = Err(diverges(&tasks[i], &outcomes[i], rounds)));
            grown.into_iter().for_each(|i| outcomes[i] = Err(diverges(&tasks[i], &outcomes[i], rounds)));
            by_executor(system, &mut outcomes);
            without_bound(system, &order, &mut outcomes);
            joins
                .iter_mut()
                .zip(&outcomes)
                .filter(|(_, outcome)| outcome.is_err())
                .for_each(|(join, _)| *join = None);
            return Ok(Solved {
                outcomes,
                joins,
                timings,
                throttled,
                spare_ns,
                tasks,
                firsts,
                relays,
                rounds,
            });
        }
        grown.iter().for_each(|i| dirty[system.callbacks[*i].core] = true);
        dirty
            .iter_mut()
            .zip(relays.iter().zip(&now))
            .for_each(|(dirty, (before, now))| *dirty |= before != now);
        relays = now;
    }
}

/// Whether a task's jitter is too long to be followed further, if it is blocked for `blocking_ns`.
pub(super) fn is_endless(task: &Task, blocking_ns: u64) -> bool {
    task.jitter_ns / MAX_JITTER_PERIODS > task.period_ns.saturating_add(blocking_ns)
}

/// The first of the callbacks that lead to a callback of their core, where each is in every level that the next is in.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lead {
    first: usize,
    /// How much later the callback's own nominal release is; `None` after a join.
    lag_ns: Option<u64>,
    /// How many messages the joins on the way may keep.
    kept: u64,
}

impl Lead {
    /// Returns the first task, with the releases that are known.
    pub fn first(self, tasks: &[Task]) -> First {
        let task = &tasks[self.first];
        let mut release = task.release();
        if self.kept > 0 {
            let more_ns = task.period_ns.saturating_mul(self.kept);
            release = release.min_distance(0).jitter(task.jitter_ns.saturating_add(more_ns));
        }
        First { release, lag_ns: self.lag_ns }
    }
}

/// Returns the lead of each callback, if it has one.
fn firsts(system: &System, tasks: &[Task], order: &[usize]) -> Vec<Option<Lead>> {
    let mut leads: Vec<Option<Lead>> = vec![None; tasks.len()];
    for &i in order {
        let (to, task) = (&system.callbacks[i], &tasks[i]);
        // A core may stand still again when what leads to a callback has caught up, and the callback has not.
        if system.cores[to.core].stall_ns > 0 {
            continue;
        }
        if let Some((source, Transfer::LOCAL)) = to.trigger {
            let from = &tasks[source];
            let is_ranked = from.group.is_some_and(|group| group.order == Order::Priority);
            let is_above = match from.priority.cmp(&task.priority) {
                // What triggers it may wait for what is below.
                _ if from.lowered_to.is_some() || task.lowered_to.is_some() => false,
                // A busy window of a rank may begin with jobs of timers that were released before it.
                Ordering::Equal if is_ranked => {
                    from.group == task.group && from.rank >= task.rank && !from.rank.is_timer()
                }
                order => order.is_ge(),
            };
            if system.callbacks[source].core == to.core && is_above && !from.is_held() && !task.is_held() {
                let lead = leads[source].unwrap_or(Lead { first: source, lag_ns: Some(0), kept: 0 });
                let lag_ns = lead.lag_ns.map(|lag_ns| lag_ns.saturating_add(from.bcet_ns));
                leads[i] = Some(Lead { lag_ns, ..lead });
            }
        } else if let Some(join) = to.join.as_ref().filter(|join| join.matching.is_newest()) {
            // It needs a new message of each input, and one may be there already. What was not taken yet is part of the level's work.
            let is_single = |input: &usize| join.ports.iter().filter(|port| *port == input).count() == 1;
            let takers = join.inputs.iter().zip(&join.ports).filter(|(_, input)| is_single(input));
            let slowest = takers.map(|(taker, _)| *taker).max_by_key(|taker| tasks[*taker].period_ns);
            let lead =
                slowest.and_then(|taker| leads[taker]).filter(|lead| tasks[lead.first].distances.is_none());
            leads[i] = lead.map(|lead| Lead { lag_ns: None, kept: lead.kept + 1, ..lead });
        }
    }
    leads
}

/// Gives triggered callbacks the jitter of their triggers; returns those whose jitter grew, all timings, and the bounds of joins.
fn pass_on(
    system: &System,
    order: &[usize],
    firsts: &[Option<Lead>],
    tasks: &mut [Task],
    outcomes: &Outcomes,
) -> (Vec<usize>, Vec<Timing>, Vec<Option<JoinBound>>) {
    let mut grown = Vec::new();
    let mut timings = vec![Timing::default(); tasks.len()];
    let mut joins = vec![None; tasks.len()];
    // Callbacks whose messages may come arbitrarily late.
    let mut held = vec![false; tasks.len()];
    for &i in order {
        let callback = &system.callbacks[i];
        let before_ns = tasks[i].jitter_ns;
        held[i] = callback.predecessors().iter().any(|source| held[*source] || tasks[*source].is_held());
        if let Some((source, transfer)) = callback.trigger {
            let response = outcomes[source].as_ref();
            if let Ok(response) = response {
                let network = transfer.most_ns.saturating_sub(transfer.least_ns);
                let jitter =
                    late_ns(system, firsts, tasks, outcomes, source, response).saturating_add(network);
                tasks[i].jitter_ns = jitter.max(before_ns);
            }
            let is_first = !system.callbacks[source].is_triggered();
            let stamped_ns = response.ok().filter(|_| is_first).map(|response| response.response_ns);
            timings[i] = timings[source].passed_on(&tasks[source], &tasks[i], transfer.least_ns, stamped_ns);
        } else if let Some(join) = &callback.join {
            let response_ns = |i: usize| outcomes[i].as_ref().map_or(0, |response| response.from_arrival_ns);
            let of_thread = |input: usize| response_ns(input).max(response_ns(i));
            let (release, timing, bound) = join::solve(join, tasks, &timings, of_thread, held[i]);
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

/// Returns how late a callback may publish, after the nominal release, as far as rates go.
fn late_ns(
    system: &System,
    firsts: &[Option<Lead>],
    tasks: &[Task],
    outcomes: &Outcomes,
    source: usize,
    response: &Response,
) -> u64 {
    let task = &tasks[source];
    // It is later by as much as its own jitter has grown since it was analysed.
    let more_ns = task.jitter_ns.saturating_sub(response.jitter_ns);
    let latest_ns = firsts[source].map_or(u64::MAX, |lead| lead.first(tasks).latest_ns(response.busy_ns));
    let late_ns = response.response_ns.saturating_add(more_ns).min(latest_ns).saturating_sub(task.bcet_ns);
    if !task.is_held() {
        return late_ns;
    }
    // All streams of its queue count.
    let shares = |i: usize| {
        i == source
            || (task.group.is_some()
                && system.callbacks[i].core == system.callbacks[source].core
                && tasks[i].group == task.group)
    };
    let queued = |i: usize| {
        outcomes[i].as_ref().ok().and_then(|found| found.queue_capacity().ok()).unwrap_or(1) as u64
    };
    let depth = task.depth.unwrap_or_else(|| (0..tasks.len()).filter(|i| shares(*i)).map(queued).sum());
    late_ns.max(task.jitter_ns.saturating_add(task.release().nominal_span(depth.saturating_add(1))))
}

/// Returns the releases and the cost of the relays on each core.
fn relayed(
    system: &System,
    firsts: &[Option<Lead>],
    tasks: &[Task],
    outcomes: &Outcomes,
) -> Vec<Vec<(Release, u64)>> {
    let mut relays = vec![Vec::new(); system.cores.len()];
    for relay in &system.relays {
        let mut release = relay.release.clone();
        if let Some((source, transfer)) = relay.source {
            let late_ns = match &outcomes[source] {
                Ok(response) => late_ns(system, firsts, tasks, outcomes, source, response),
                Err(_) => tasks[source].jitter_ns,
            };
            let network_ns = transfer.most_ns.saturating_sub(transfer.least_ns);
            release = tasks[source].release().min_distance(0).jitter(late_ns.saturating_add(network_ns));
        }
        relays[relay.core].push((release, relay.cost_ns));
    }
    relays
}

/// Gives a callback that may run on any core the worst of its bounds on each.
fn copies(system: &System, outcomes: &mut Outcomes) {
    for i in 0..outcomes.len() {
        let Some(own) = system.callbacks[i].copy_of else { continue };
        let worst = match (&outcomes[own], &outcomes[i]) {
            (Ok(own), Ok(copy)) => Ok(own.clone().or_worse(copy)),
            (Err(error), _) | (_, Err(error)) => Err(error.clone()),
        };
        outcomes[own] = worst;
    }
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

/// Removes the bounds of the callbacks to which their executors give none.
fn by_executor(system: &System, outcomes: &mut Outcomes) {
    for (outcome, callback) in outcomes.iter_mut().zip(&system.callbacks) {
        // Divergence and overload reach further.
        if let (Some(reason), true) = (callback.unbounded, outcome.is_ok()) {
            *outcome = Err(AnalysisError::ByExecutor { task: callback.task.name.clone(), reason });
        }
    }
}

/// Removes the bounds of all callbacks that a callback without a bound triggers or delays.
fn without_bound(system: &System, order: &[usize], outcomes: &mut Outcomes) {
    // Of each core, the priority up to which callbacks have no bound, and the cause.
    let mut lost: Vec<Option<(u8, usize)>> = vec![None; system.cores.len()];
    loop {
        let mut changed = false;
        for relay in &system.relays {
            let Some((source, _)) = relay.source.filter(|(source, _)| outcomes[*source].is_err()) else {
                continue;
            };
            changed |= lost[relay.core].is_none_or(|(priority, _)| priority < u8::MAX);
            lost[relay.core] = Some((u8::MAX, source));
        }
        for &i in order {
            let callback = &system.callbacks[i];
            let source = callback.predecessors().iter().copied().find(|source| outcomes[*source].is_err());
            let cause = match (source, &outcomes[i]) {
                (Some(source), _) => source,
                (_, Err(AnalysisError::Diverges { .. })) => i,
                // What its threads use to poll is not known.
                (_, Err(AnalysisError::ByExecutor { reason: Unbounded::MultiThreaded, .. })) => i,
                _ => continue,
            };
            // Its releases are not known, so neither is the time that it takes from its level and those below.
            let (core, task) = (callback.core, &callback.task);
            let overheads = &system.cores[core].overheads;
            // All levels of the core, if its messages or its time may stop all.
            let is_late = !matches!(outcomes[cause], Err(AnalysisError::ByExecutor { .. })) || cause != i;
            let stops_all = (is_late && task.per_message_ns(overheads) > 0) || overheads.throttling.is_some();
            let priority = if stops_all { u8::MAX } else { task.priority };
            if lost[core].is_none_or(|(lost, _)| lost < priority) {
                lost[core] = Some((priority, cause));
                changed = true;
            }
        }
        // A thread that lowers itself, and has no bound there, delays all up to its ceiling.
        for callback in &system.callbacks {
            let (task, lost) = (&callback.task, &mut lost[callback.core]);
            if let Some((priority, _)) = lost.as_mut().filter(|(lost, _)| task.lowest() <= *lost)
                && *priority < task.priority
            {
                *priority = task.priority;
                changed = true;
            }
        }
        if !changed {
            return;
        }
        for (outcome, callback) in outcomes.iter_mut().zip(&system.callbacks) {
            let Some((_, cause)) = lost[callback.core].filter(|(lost, _)| callback.task.priority <= *lost)
            else {
                continue;
            };
            if outcome.is_ok() {
                let (task, cause) = (callback.task.name.clone(), system.callbacks[cause].task.name.clone());
                *outcome = Err(AnalysisError::Upstream { task, cause });
            }
        }
        copies(system, outcomes);
    }
}

/// Returns all callbacks, each after those that trigger it.
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
    let (mut placed, mut on_path) = (vec![false; count], vec![false; count]);
    for start in 0..count {
        if placed[start] {
            continue;
        }
        on_path[start] = true;
        // The path to this callback, each with the number of its predecessors that were visited.
        let mut path = vec![(start, 0)];
        while let Some((i, looked_at)) = path.last_mut().filter(|(i, _)| !placed[*i]) {
            let i = *i;
            let Some(&next) = system.callbacks[i].predecessors().get(*looked_at) else {
                (placed[i], on_path[i]) = (true, false);
                order.push(i);
                path.pop();
                continue;
            };
            *looked_at += 1;
            if on_path[next] {
                let from = path.iter().position(|(seen, _)| *seen == next).unwrap_or(0);
                let name = |(i, _): &(usize, usize)| format!("`{}`", system.callbacks[*i].task.name);
                let tasks = path[from..].iter().rev().map(name).collect::<Vec<_>>().join(", ");
                return Err(AnalysisError::Cycle { tasks });
            }
            if !placed[next] {
                on_path[next] = true;
                path.push((next, 0));
            }
        }
    }
    Ok(order)
}

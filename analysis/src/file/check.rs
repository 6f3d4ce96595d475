// SPDX-License-Identifier: MIT OR Apache-2.0
//! The verdict on a system file.
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use super::content::{CallbackEntry, Client, JoinPolicy, MOST_DEPTH, OverrunPolicy, SystemFile};
use crate::system::{Chain, ChainBound, Core, SystemReport};
use crate::{AnalysisError, Overheads, Release, Reservation, Task, Throttling, utilisation};

/// What the analysis of a [`SystemFile`] found.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct CheckedSystem {
    /// Whether every callback and every chain meets its deadline, overheads included.
    pub schedulable: bool,
    /// The callbacks, in the order of the file.
    pub callbacks: Vec<CheckedCallback>,
    /// The chains, in the order of the file.
    pub chains: Vec<CheckedChain>,
    /// The cores that run something.
    pub cores: Vec<CheckedCore>,
    /// Hints for the user: why something has no bound, and which assumptions are at risk.
    pub warnings: Vec<String>,
}

/// A callback and its bounds.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CheckedCallback {
    /// Where it runs.
    pub entry: CallbackEntry,
    /// Its host.
    pub host: String,
    /// Its core's number there.
    pub core: usize,
    /// Shortest time between two releases, jitter aside.
    pub period_ns: u64,
    /// Its execution time.
    pub wcet_ns: u64,
    /// What the analysis charges for one job: the execution time, two context switches, what its executor uses, and the work per
    /// message, part of which is done in the callback's thread. A job that uses more breaks the bounds.
    pub charged_ns: u64,
    /// The release pattern that the analysis assumes for each of its streams of messages, or for its timer.
    pub releases: Vec<Release>,
    /// Response time on a machine without overheads; `None` without a bound.
    pub response_ns: Option<u64>,
    /// Response time with overheads, from the arrival of the message, or from the nominal release of a period.
    pub response_overhead_ns: Option<u64>,
    /// The release jitter that the response contains; 0 if it counts from the arrival.
    pub jitter_ns: u64,
    /// Whether the response is within the deadline.
    pub met: bool,
    /// The queue depth at which no message is lost, even if hosts stall; `None` without a bound.
    pub capacity: Option<usize>,
    /// The same on hosts that never stall.
    pub capacity_without_stall: Option<usize>,
    /// Its join, if it waits for several topics and has a bound.
    pub join: Option<CheckedJoin>,
}

/// The bounds of a callback that waits for several topics.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CheckedJoin {
    /// The largest distance of the stamps in a set, in nanoseconds: 0 for equal stamps; `None`: the newest of
    /// each topic.
    pub window_ns: Option<u64>,
    /// The queue size of the synchronizer: how many messages of a topic it has to keep so that it drops none that may be
    /// needed.
    pub queue_size: usize,
    /// The topics, each with the longest time that a message of a set waits for the set's last message, in
    /// nanoseconds; `None` without a bound.
    pub inputs: Vec<(String, Option<u64>)>,
}

/// A chain and its bounds, overheads included.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct CheckedChain {
    /// Its name.
    pub name: String,
    /// See [`ChainBound::latency_ns`](crate::system::ChainBound::latency_ns); `None` without a bound.
    pub latency_ns: Option<u64>,
    /// See [`ChainBound::reaction_ns`](crate::system::ChainBound::reaction_ns).
    pub reaction_ns: Option<u64>,
    /// See [`ChainBound::age_ns`](crate::system::ChainBound::age_ns).
    pub age_ns: Option<u64>,
    /// Its deadline.
    pub deadline_ns: u64,
    /// Whether the latency is within the deadline.
    pub met: bool,
    /// Its callbacks, by their index in the file, if each triggers the next by a message on one host: no message then takes longer than
    /// the sum of their longest responses. Otherwise `None`.
    pub stages: Option<Vec<usize>>,
}

/// A core and what it runs.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct CheckedCore {
    /// Its host.
    pub host: String,
    /// Its number there.
    pub number: usize,
    /// Share of the core that callbacks and their messages need; 1.0 is the whole core.
    pub utilisation: f64,
    /// Its tasks, with the periods and jitter they inherit.
    pub tasks: Vec<Task>,
    /// The overheads of the machine there.
    pub overheads: Overheads,
    /// Longest time for which it may stall.
    pub stall_ns: u64,
}

impl CheckedSystem {
    /// The hosts that may stall, each with its longest stall in nanoseconds; none if no queue has to be
    /// deeper because of a stall.
    pub fn stalls(&self) -> Vec<(&str, u64)> {
        if self.callbacks.iter().all(|callback| callback.capacity == callback.capacity_without_stall) {
            return Vec::new();
        }
        let stalled = self.cores.iter().filter(|core| core.stall_ns > 0);
        let mut hosts: Vec<_> = stalled.map(|core| (core.host.as_str(), core.stall_ns)).collect();
        hosts.sort_unstable();
        hosts.dedup_by_key(|host| host.0);
        hosts
    }
}

pub(super) fn check(file: &SystemFile) -> CheckedSystem {
    let free = file.system_without_overheads().analyse();
    let free = free.ok();
    let stalled = file.system_with_stalls().map(|system| system.analyse());
    let stalled = stalled.map(|stalled| stalled.unwrap_or_else(|error| without_bounds(file, &error)));
    let mut system = file.system.clone();
    if let Some(stalled) = &stalled {
        // Queues are this deep also when nothing stalls, and as many messages may be published late.
        for entry in &file.callbacks {
            let depth = capacity(file, entry, stalled).map_or(u64::MAX, |depth| depth as u64);
            let tasks = &mut system.callbacks[entry.tasks.clone()];
            tasks.iter_mut().for_each(|callback| callback.task.depth = callback.task.depth.or(Some(depth)));
        }
    }
    let report = match system.analyse() {
        Ok(report) => report,
        Err(error) => return refused(file, &error),
    };
    let queues = stalled.as_ref().unwrap_or(&report);
    let callback = |entry: &CallbackEntry| checked_callback(file, entry, &report, queues, free.as_ref());
    let callbacks: Vec<_> = file.callbacks.iter().map(callback).collect();
    let chains: Vec<_> = (0..file.system.chains.len()).map(|i| checked_chain(file, i, &report)).collect();
    let cores = cores(file, &report);
    let faults: Vec<String> = above_samplers(file, &callbacks)
        .chain(split_nodes(&callbacks))
        .chain(endless_waits(&callbacks))
        .chain(endless_queues(&callbacks))
        .collect();
    let schedulable = faults.is_empty() && callbacks.iter().all(|c| c.met) && chains.iter().all(|c| c.met);
    let warnings = warnings(file, &report, &callbacks, faults);
    CheckedSystem { schedulable, callbacks, chains, cores, warnings }
}

/// Returns the result for a system that is refused. A file without problems is refused only for times that do not fit the arithmetic.
fn refused(file: &SystemFile, error: &AnalysisError) -> CheckedSystem {
    let empty = without_bounds(file, error);
    let callback = |entry: &CallbackEntry| checked_callback(file, entry, &empty, &empty, None);
    let callbacks = file.callbacks.iter().map(callback).collect();
    let chains = (0..file.system.chains.len()).map(|i| checked_chain(file, i, &empty)).collect();
    let (cores, warnings) = (cores(file, &empty), vec![error.to_string()]);
    CheckedSystem { schedulable: false, callbacks, chains, cores, warnings }
}

fn without_bounds(file: &SystemFile, error: &AnalysisError) -> SystemReport {
    SystemReport {
        callbacks: file.system.callbacks.iter().map(|_| Err(error.clone())).collect(),
        chains: file.system.chains.iter().map(|_| Err(error.clone())).collect(),
        joins: vec![None; file.system.callbacks.len()],
        throttled: vec![false; file.cores.len()],
        rounds: 0,
    }
}

/// Whether its jobs may have to wait for the next period of their reservation.
fn waits(report: &SystemReport, entry: &CallbackEntry) -> bool {
    let waits = |i: usize| report.callbacks[i].as_ref().is_ok_and(|response| response.waits_for_reservation);
    entry.tasks.clone().any(waits)
}

/// Returns the longest response of its streams: from the arrival of a message of the file, else from the nominal release.
fn response(file: &SystemFile, entry: &CallbackEntry, report: &SystemReport) -> Option<u64> {
    let of_stream = |i: usize| {
        let response = report.callbacks[i].as_ref().ok()?;
        let triggered = file.system.callbacks[i].is_triggered();
        Some(if triggered { response.from_arrival_ns } else { response.response_ns })
    };
    entry.tasks.clone().map(of_stream).try_fold(0, |longest, response| Some(longest.max(response?)))
}

/// Returns the tasks that take its messages; of a join, without the task that runs when all messages are there.
fn takers(entry: &CallbackEntry) -> Range<usize> {
    entry.tasks.start + usize::from(entry.joins)..entry.tasks.end
}

fn capacity(file: &SystemFile, entry: &CallbackEntry, report: &SystemReport) -> Option<usize> {
    // One queue, or one for each topic of a join.
    let join = file.system.callbacks[entry.tasks.start].join.as_ref();
    let mut sums = vec![Some(0_usize); join.map_or(1, |_| entry.topics.len())];
    for (at, i) in takers(entry).enumerate() {
        let capacity = report.callbacks[i].as_ref().ok()?.queue_capacity().ok();
        let sum = &mut sums[join.map_or(0, |join| join.ports[at])];
        *sum = sum.and_then(|sum| sum.checked_add(capacity?));
    }
    sums.into_iter().try_fold(0, |most: usize, next| Some(most.max(next?)))
}

/// `queues` is the report that sizes them: with stalls, if there are any.
fn checked_callback(
    file: &SystemFile,
    entry: &CallbackEntry,
    report: &SystemReport,
    queues: &SystemReport,
    free: Option<&SystemReport>,
) -> CheckedCallback {
    let response_overhead_ns = response(file, entry, report);
    let tasks = &file.system.callbacks[entry.tasks.clone()];
    let overheads = &file.system.cores[entry.core].overheads;
    let charged = |task: &Task| task.charged_ns(overheads).saturating_add(task.per_message_ns(overheads));
    let release = |i: usize| {
        let task = &file.system.callbacks[i].task;
        match &report.callbacks[i] {
            Ok(response) => task.release().jitter(response.jitter_ns),
            Err(_) => task.release(),
        }
    };
    let join = |of: &SystemReport| of.joins[entry.tasks.start].clone();
    CheckedCallback {
        host: file.cores[entry.core].host.clone(),
        core: file.cores[entry.core].number,
        period_ns: tasks.iter().map(|callback| callback.task.period_ns).min().unwrap_or(0),
        wcet_ns: tasks.first().map_or(0, |callback| callback.task.wcet_ns),
        charged_ns: tasks.first().map_or(0, |callback| charged(&callback.task)),
        releases: takers(entry).map(release).collect(),
        response_ns: free.and_then(|free| response(file, entry, free)),
        response_overhead_ns,
        jitter_ns: tasks.iter().filter(|c| !c.is_triggered()).map(|c| c.task.jitter_ns).max().unwrap_or(0),
        met: response_overhead_ns.is_some_and(|response| response <= entry.deadline_ns),
        capacity: capacity(file, entry, queues),
        capacity_without_stall: capacity(file, entry, report),
        join: join(report).zip(join(queues)).map(|(join, queues)| CheckedJoin {
            window_ns: entry.window_ns,
            queue_size: usize::try_from(queues.queue_size).unwrap_or(usize::MAX),
            inputs: inputs(file, entry, &join.wait_ns),
        }),
        entry: entry.clone(),
    }
}

/// The topics of a join, each with the longest wait of any of its publishers' messages.
fn inputs(file: &SystemFile, entry: &CallbackEntry, wait_ns: &[u64]) -> Vec<(String, Option<u64>)> {
    let ports = file.system.callbacks[entry.tasks.start].join.iter().flat_map(|join| &join.ports);
    let mut inputs: Vec<_> = entry.topics.iter().map(|topic| (topic.clone(), Some(0))).collect();
    for (port, wait_ns) in ports.zip(wait_ns) {
        let longest = &mut inputs[*port].1;
        *longest = longest.filter(|_| *wait_ns < u64::MAX).map(|longest| longest.max(*wait_ns));
    }
    inputs
}

fn checked_chain(file: &SystemFile, index: usize, report: &SystemReport) -> CheckedChain {
    let chain = &file.system.chains[index];
    let found = report.chains[index].as_ref().ok();
    let latency_ns = found.map(|bound: &ChainBound| bound.latency_ns);
    CheckedChain {
        name: chain.name.clone(),
        latency_ns,
        reaction_ns: found.and_then(|bound| bound.reaction_ns),
        age_ns: found.map(|bound| bound.age_ns),
        deadline_ns: chain.deadline_ns,
        met: latency_ns.is_some_and(|latency| latency <= chain.deadline_ns),
        stages: stages(file, chain),
    }
}

/// The callbacks that all ways of a chain pass, if nothing but their responses is on them.
fn stages(file: &SystemFile, chain: &Chain) -> Option<Vec<usize>> {
    let [part] = &chain.parts[..] else { return None };
    let of_task = |task: &usize| {
        let after = file.callbacks.partition_point(|entry| entry.tasks.start <= *task);
        after.checked_sub(1).filter(|at| file.callbacks[*at].tasks.contains(task))
    };
    let host = |task: usize| &file.cores[file.system.callbacks[task].core].host;
    let follows = |pair: &[usize]| {
        let trigger = file.system.callbacks[pair[1]].trigger;
        trigger.is_some_and(|(source, _)| source == pair[0]) && host(pair[0]) == host(pair[1])
    };
    let mut found = part.ways.iter().map(|way| {
        let all: Option<Vec<usize>> = way.iter().map(of_task).collect();
        all.filter(|_| way.windows(2).all(follows))
    });
    let first = found.next()??;
    found.all(|other| other.as_ref() == Some(&first)).then_some(first)
}

fn cores(file: &SystemFile, report: &SystemReport) -> Vec<CheckedCore> {
    let core = |(index, entry): (usize, &super::content::CoreEntry)| {
        let members = file.system.callbacks.iter().zip(&report.callbacks).filter(|(c, _)| c.core == index);
        let tasks: Vec<Task> = members
            .map(|(callback, outcome)| {
                let jitter_ns =
                    outcome.as_ref().map_or(callback.task.jitter_ns, |response| response.jitter_ns);
                Task { jitter_ns, ..callback.task.clone() }
            })
            .collect();
        let overheads = file.system.cores[index].overheads;
        let costs = |task: &Task| {
            if let Some(Reservation { runtime_ns, period_ns }) = task.reservation {
                return Task { wcet_ns: runtime_ns, period_ns, ..task.clone() };
            }
            let wcet_ns = task.charged_ns(&overheads).saturating_add(task.per_message_ns(&overheads));
            Task { wcet_ns, ..task.clone() }
        };
        let relays = file.system.relays.iter().filter(|relay| relay.core == index).map(|relay| {
            let period_ns = relay
                .source
                .map_or(relay.release.period_ns, |(i, _)| file.system.callbacks[i].task.period_ns);
            relay.cost_ns as f64 / period_ns.max(1) as f64
        });
        let relayed: f64 = relays.sum();
        let ticks = match overheads.tick_period_ns {
            0 => 0.0,
            period => overheads.tick_ns as f64 / period as f64,
        };
        let utilisation = utilisation(&tasks.iter().map(costs).collect::<Vec<_>>()) + ticks + relayed;
        let (host, stall_ns) = (entry.host.clone(), entry.stall_ns);
        CheckedCore { host, number: entry.number, utilisation, tasks, overheads, stall_ns }
    };
    file.cores.iter().enumerate().map(core).filter(|core| !core.tasks.is_empty()).collect()
}

/// Returns why callbacks have no bound: causes first, then their consequences, at most 10 of each.
fn unbounded(report: &SystemReport) -> Vec<String> {
    const MOST: usize = 10;
    let errors = report.callbacks.iter().filter_map(|outcome| outcome.as_ref().err());
    let (consequences, causes): (Vec<_>, Vec<_>) =
        errors.partition(|error| matches!(error, AnalysisError::Upstream { .. }));
    let mut warnings: Vec<String> = Vec::new();
    for errors in [causes, consequences] {
        warnings.extend(errors.iter().take(MOST).map(ToString::to_string));
        if errors.len() > MOST {
            warnings.push(format!("{} more callbacks have no bound for like reasons", errors.len() - MOST));
        }
    }
    warnings
}

/// A warning for each priority that several threads of a core have.
fn shared_priorities(callbacks: &[CheckedCallback]) -> impl Iterator<Item = String> {
    let mut levels: BTreeMap<(usize, u8), BTreeMap<&str, &CheckedCallback>> = BTreeMap::new();
    for callback in callbacks.iter().filter(|callback| callback.entry.reservation.is_none()) {
        let entry = &callback.entry;
        levels
            .entry((entry.core, entry.running_priority()))
            .or_default()
            .entry(&entry.thread)
            .or_insert(callback);
    }
    levels.into_iter().filter(|(_, threads)| threads.len() > 1).map(|((_, priority), threads)| {
        let mut callbacks = threads.values();
        let (first, second) = (callbacks.next(), callbacks.next());
        let name = |callback: Option<&&CheckedCallback>| callback.map_or("", |c| c.entry.name.as_str()).to_owned();
        let more = if threads.len() > 2 { format!(" ({} in all)", threads.len()) } else { String::new() };
        format!(
            "callbacks `{}` and `{}`{more} share priority {priority} on core {}: each is taken to wait for the others",
            name(first),
            name(second),
            first.map_or(0, |callback| callback.core)
        )
    })
}

/// A warning for each join that may never pass on the messages that it got.
fn starved(file: &SystemFile, report: &SystemReport) -> impl Iterator<Item = String> {
    file.callbacks.iter().filter_map(|entry| {
        let join = report.joins[entry.tasks.start].as_ref().filter(|join| join.reflected_ns.is_none())?;
        let far = join.starved_by.first().and_then(|(far, _)| entry.topics.get(*far));
        let window_ns = join.starved_by.iter().map(|(_, gap_ns)| *gap_ns).max();
        let ms = |ns: u64| ns as f64 / 1e6;
        let name = &entry.name;
        Some(match (entry.policy, far) {
            (JoinPolicy::LatestTime, Some(far)) => format!(
                "callback `{name}` runs at the pace of the fastest of its topics, but messages of `{far}` may come as close as those of the \
                 fastest are apart, with their jitter and the time that it takes to take them, so that it is not known which that is, and \
                 nothing bounds how long a message waits to be reflected; lower the jitter or the response times of both, or let the one that sets the pace be its `topic`, and put the others into `reads`"
            ),
            (_, Some(far)) => format!(
                "callback `{name}` runs only if stamps lie within {} ms, but messages of `{far}` may lie further apart than that: unless \
                 something keeps the topics in step, it may never run, and nothing bounds how long a message waits to be \
                 reflected; make the `window` as long as the time between two messages of all topics but the slowest, {} ms",
                ms(entry.window_ns.unwrap_or(0)),
                ms(window_ns.unwrap_or(0))
            ),
            (_, None) => format!(
                "callback `{name}` drops what is near a message that is too early, and with three topics or more that may belong to the \
                 next set: nothing bounds how long a message waits to be reflected; leave out its `policy`"
            ),
        })
    })
}

/// A warning for each node whose one sampler serves several cores.
fn split_nodes(callbacks: &[CheckedCallback]) -> impl Iterator<Item = String> {
    let mut nodes: BTreeMap<&str, BTreeSet<usize>> = BTreeMap::new();
    // A node of ROS has no sampler: its publishers wake its threads.
    for callback in callbacks.iter().filter(|callback| callback.entry.client == Client::Tautline) {
        nodes.entry(&callback.entry.node).or_default().insert(callback.core);
    }
    nodes.into_iter().filter(|(_, cores)| cores.len() > 1).map(|(node, cores)| {
        let cores = cores.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        format!(
            "node `{node}` has callbacks on cores {cores} but one sampler, whose work is charged to the core of each \
             callback: the bounds hold only if nothing delays the sampler on its own core; split the node"
        )
    })
}

/// A fault of each input of a join for which nothing bounds the wait.
fn endless_waits(callbacks: &[CheckedCallback]) -> impl Iterator<Item = String> {
    callbacks.iter().flat_map(|callback| {
        let inputs = callback.join.iter().flat_map(|join| &join.inputs).filter(|(_, wait_ns)| wait_ns.is_none());
        inputs.map(|(topic, _)| {
            let name = &callback.entry.name;
            format!("callback `{name}`: nothing bounds how long a message of `{topic}` waits; shorten the periods or the jitter of its topics")
        })
    })
}

/// A fault of each callback whose queue no topic can have, so that its node does not start.
fn endless_queues(callbacks: &[CheckedCallback]) -> impl Iterator<Item = String> {
    callbacks.iter().filter_map(|callback| {
        let (CallbackEntry { name, client, topics, depth, .. }, capacity) = (&callback.entry, callback.capacity?);
        let is_computed = *client == Client::Tautline && !topics.is_empty() && depth.is_none();
        (is_computed && capacity as u64 > MOST_DEPTH).then(|| {
            format!(
                "callback `{name}` needs a queue of {capacity}, but a topic has at most {MOST_DEPTH}: lower the rate of its topics, its \
                 response time, or the `stall` of its hosts, or state the `depth`"
            )
        })
    })
}

/// A fault of each callback for which a sampler waits.
fn above_samplers(file: &SystemFile, callbacks: &[CheckedCallback]) -> impl Iterator<Item = String> {
    callbacks.iter().filter_map(|callback| {
        let (entry, sampler) = (&callback.entry, file.cores[callback.entry.core].sampler_priority);
        (entry.reservation.is_none() && entry.running_priority() >= sampler).then(|| {
            format!(
                "callback `{}` has priority {}, not below the sampler's {sampler}: messages of other callbacks wait for it, and no \
                 bound holds; lower it",
                entry.name,
                entry.running_priority()
            )
        })
    })
}

fn warnings(
    file: &SystemFile,
    report: &SystemReport,
    callbacks: &[CheckedCallback],
    faults: Vec<String>,
) -> Vec<String> {
    let mut warnings = file.warnings.clone();
    warnings.extend(faults);
    warnings.extend(unbounded(report));
    let own = |error: &&AnalysisError| matches!(error, AnalysisError::Overwritten { .. });
    warnings.extend(
        report.chains.iter().filter_map(|chain| chain.as_ref().err()).filter(own).map(ToString::to_string),
    );
    for callback in callbacks {
        let (name, entry) = (&callback.entry.name, &callback.entry);
        if let (Some(depth), Some(capacity)) = (entry.depth, callback.capacity)
            && depth < capacity as u64
        {
            warnings.push(format!(
                "callback `{name}` needs a queue of {capacity}, but its topic keeps {depth}: messages may be \
                 overwritten; set `depth = \"auto\"`, or {capacity}"
            ));
        }
        if callback.capacity.is_none() && callback.capacity_without_stall.is_some() {
            warnings.push(format!(
                "callback `{name}` has no capacity: nothing bounds how long the system needs to catch up after a stall; lower the \
                 `stall` of its hosts, lower the load, or state the `depth` of its topics"
            ));
        }
    }
    let bunched = |callback: &&CheckedCallback| {
        let bunches = |release: &Release| release.jitter_ns >= release.period_ns;
        callback.entry.overrun == OverrunPolicy::Suspend && callback.releases.iter().any(bunches)
    };
    for callback in callbacks.iter().filter(bunched) {
        warnings.push(format!(
            "callback `{}` is suspended when it overruns, but may be released later than a period: then it may take more from others \
             than was given to it; say `overrun = \"demote\"`",
            callback.entry.name
        ));
    }
    for callback in callbacks.iter().filter(|callback| waits(report, &callback.entry)) {
        let Some(Reservation { runtime_ns, period_ns }) = callback.entry.reservation else { continue };
        let us = |ns: u64| ns as f64 / 1e3;
        warnings.push(format!(
            "callback `{}` may find its reservation used up, and its bound contains the {} us until the next one: raise `runtime` \
             further above the {} us that a job takes, or shorten the reservation's `period`",
            callback.entry.name,
            us(period_ns - runtime_ns),
            us(callback.charged_ns)
        ));
    }
    warnings.extend(starved(file, report));
    warnings.extend(shared_priorities(callbacks));
    for ((entry, core), throttled) in file.cores.iter().zip(&file.system.cores).zip(&report.throttled) {
        if let (true, Some(Throttling { runtime_ns, period_ns })) = (*throttled, core.overheads.throttling) {
            warnings.push(format!(
                "host `{}`, core {}: real-time work may exceed {} ms in {} ms, where the kernel pauses it; the bounds \
                 contain the pauses (kernel.sched_rt_runtime_us = -1 removes them; since Linux 6.12, 0 in \
                 /sys/kernel/debug/sched/fair_server/cpu{}/runtime)",
                entry.host,
                entry.number,
                runtime_ns / 1_000_000,
                period_ns / 1_000_000,
                entry.number
            ));
        }
    }
    let held = |callback: &&CheckedCallback| {
        let mut tasks = file.system.callbacks[callback.entry.tasks.clone()].iter();
        callback.entry.overrun != OverrunPolicy::Tell && tasks.all(|of| of.task.executor_overhead_ns == 0)
    };
    if let Some(callback) = callbacks.iter().find(held) {
        warnings.push(format!(
            "callback `{}` is held to its budget, by a timer whose cost the file does not state: add `demotion = \"...\"` \
             to [overheads], what it takes for each job and how late it may be",
            callback.entry.name
        ));
    }
    for (client, name) in [(Client::Rclcpp, "rclcpp"), (Client::Rclpy, "rclpy")] {
        let costs_nothing = |callback: &&CheckedCallback| {
            let mut tasks = file.system.callbacks[callback.entry.tasks.clone()].iter();
            callback.entry.client == client && tasks.all(|of| of.task.executor_overhead_ns == 0)
        };
        if let Some(callback) = callbacks.iter().find(costs_nothing) {
            warnings.push(format!(
                "callback `{}` is run by an executor of {name}, whose cost the file does not state: its bound holds for one \
                 that costs nothing; add `{name} = \"...\"` to [overheads]; `taut report --overheads` measures it",
                callback.entry.name
            ));
        }
    }
    let free = |core: &Core| core.overheads.per_message_ns == 0 && core.overheads.context_switch_ns == 0;
    if file.system.cores.iter().all(free) {
        warnings.push(
            "the file states no [overheads]: the bounds hold on a machine that costs nothing; `taut demo` measures \
             them"
                .into(),
        );
    }
    let mut seen = BTreeSet::new();
    warnings.retain(|warning| seen.insert(warning.clone()));
    warnings
}

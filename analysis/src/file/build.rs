// SPDX-License-Identifier: MIT OR Apache-2.0
//! From the file's sections to a system that can be analysed.
use std::collections::{BTreeSet, HashSet};
use std::time::Duration;

use super::content::{
    CallbackEntry, Client, CoreEntry, Executor, JoinPolicy, OverrunPolicy, SystemFile, ThreadPriority,
    TopicEntry, WakeUp,
};
use super::declared::{Costs, Declared};
use super::graph::Graph;
use super::locks;
use super::paths;
use super::places::{self, Place};
use super::priorities::{self, Thread};
use super::problem::{Collector, Problems};
use super::reader::{self, At, Section};
use super::reservations;
use super::sections;
use super::streams::{First, Source, Streams};
use super::version;
use super::wake;
use crate::system::{Callback, Chain, Core, Matching, Part, Relay, System, Transfer, Unbounded};
use crate::{AnalysisError, Hold, Order, Overheads, Rank, Release, Task, Throttling};

pub(super) fn build(text: &str) -> Result<SystemFile, Problems> {
    let problems = Collector::new(text);
    let table = reader::parse(&problems, text, "`wcet = \"1.5ms\"` below `[callbacks.scan]`")?;
    let mut root = Section::root(&table, &problems);
    // In another version all keys may mean something else: only the version is reported.
    version::check(&mut root);
    problems.check()?;
    let file = sections::read(root);
    let (cores, places) = places::resolve(&file, &problems);
    let graph = Graph::new(&file);
    graph.check(&places, &problems);
    let threads = priorities::threads(&file, &places, &problems);
    locks::check(&file, &places, &problems);
    paths::check(&graph, &problems);
    problems.check()?;
    let streams = graph.streams(&problems);
    problems.check()?;
    hold(&file, &places, &streams, &problems);
    orders(&file, &places, &threads, &problems);
    reservations::check(&file, &places, &streams, &problems);
    wake::check(&file, &places, &problems);
    meet(&file, &streams, &problems);
    problems.check()?;
    // Without problems every callback has a place.
    let places: Vec<Place> = places.into_iter().flatten().collect();
    let mut owner = vec![0; file.callbacks.len()];
    for (t, thread) in threads.iter().enumerate() {
        thread.callbacks.iter().for_each(|i| owner[*i] = t);
    }
    let wake_ups = wake::choose(&file, &places, &threads);
    let built =
        Builder { file: &file, graph: &graph, cores, places, streams, threads, owner, wake_ups }.build();
    built.map_err(|message| {
        problems.at(0).add(message);
        problems.take()
    })
}

struct Builder<'f> {
    file: &'f Declared,
    graph: &'f Graph<'f>,
    cores: Vec<(usize, usize)>,
    places: Vec<Place>,
    streams: Streams,
    threads: Vec<Thread>,
    /// The thread of each callback.
    owner: Vec<usize>,
    /// Who wakes each thread.
    wake_ups: Vec<WakeUp>,
}

impl Builder<'_> {
    fn build(mut self) -> Result<SystemFile, String> {
        let mut callbacks: Vec<Callback> = Vec::new();
        for i in 0..self.file.callbacks.len() {
            let tasks = self.streams.tasks(i);
            if self.streams.is_join(i) {
                let declared = &self.file.callbacks[i];
                let window_ns = declared.window.as_ref().map(|window| window.value);
                let matching = match (declared.policy(), window_ns) {
                    (JoinPolicy::LatestTime, _) => Matching::LatestTime,
                    (_, None) if self.file.nodes[self.places[i].node].client == Client::Tautline => {
                        Matching::Newest
                    }
                    (_, None) => Matching::NewestTaken,
                    (_, Some(0)) => Matching::Exact,
                    (JoinPolicy::ByWindow, Some(window_ns)) => Matching::Approximate { window_ns },
                    (JoinPolicy::ApproximateEpsilonTime, Some(window_ns)) => {
                        Matching::ApproximateEpsilon { window_ns }
                    }
                };
                let inputs = (tasks.start + 1..tasks.end).collect();
                let ports = self.streams.topics(i).to_vec();
                let mut joined = self.callback(i, Source::All).joining_ports(inputs, ports, matching);
                joined.task.repeats = !matching.is_newest();
                callbacks.push(joined);
            }
            for (&source, topic) in self.streams.sources(i).iter().zip(self.streams.topics(i)) {
                let mut callback = self.callback(i, source);
                if self.streams.is_join(i) {
                    callback.task.name += &self.taken(i, source, *topic);
                }
                callbacks.push(callback);
            }
        }
        let own = callbacks.len();
        let relays = self.relays(&callbacks);
        let cores: Vec<CoreEntry> =
            self.cores.iter().map(|(host, number)| self.core_entry(*host, *number)).collect();
        for (i, declared) in
            self.file.callbacks.iter().enumerate().filter(|(_, callback)| callback.floats.is_some())
        {
            reservations::copy(&declared.name, self.streams.tasks(i).start, &cores, &mut callbacks);
        }
        let owner = self.owner.clone();
        let overheads: Vec<_> = self.cores.iter().map(|(host, _)| self.overheads(*host)).collect();
        // Sets inherited periods, for policies and default deadlines: triggers may come after the callbacks that they trigger.
        let mut system = System { callbacks, ..System::default() };
        for (i, period_ns) in system.periods_ns().into_iter().enumerate() {
            system.callbacks[i].task.period_ns = period_ns;
        }
        let mut callbacks = system.callbacks;
        for (i, declared) in self.file.callbacks.iter().enumerate() {
            let tasks = &mut callbacks[self.streams.tasks(i)];
            let shortest = tasks.iter().map(|callback| callback.task.period_ns).min().unwrap_or(u64::MAX);
            let deadline = declared.deadline.as_ref().map_or(shortest, |deadline| deadline.value);
            tasks.iter_mut().for_each(|callback| callback.task.deadline_ns = deadline);
        }
        for i in own..callbacks.len() {
            if let Some(of) = callbacks[i].copy_of {
                callbacks[i].task.deadline_ns = callbacks[of].task.deadline_ns;
            }
        }
        let task_owner: Vec<usize> = (0..owner.len())
            .flat_map(|i| std::iter::repeat_n(owner[i], self.streams.tasks(i).len()))
            .collect();
        // No priority is chosen for the copies of a reservation on other cores.
        let is_own = |i: &usize| *i < own;
        let mut warnings = Vec::new();
        for (core, overheads) in overheads.iter().enumerate() {
            let members: Vec<usize> =
                (0..callbacks.len()).filter(is_own).filter(|i| callbacks[*i].core == core).collect();
            let tasks: Vec<Task> = members.iter().map(|i| callbacks[*i].task.clone()).collect();
            let owners: Vec<usize> = members.iter().map(|i| task_owner[*i]).collect();
            let copies = callbacks[own..].iter().filter(|callback| callback.core == core);
            let copies: Vec<Task> = copies.map(|callback| callback.task.clone()).collect();
            let (host, number) = self.cores[core];
            let title = format!("host `{}`, core {number}", self.file.hosts[host].name);
            // A callback that is not below its sampler has no bound.
            let highest = self.file.highest.min(self.file.hosts[host].sampler_priority.saturating_sub(1));
            let chosen = priorities::choose(
                self.file,
                &mut self.threads,
                &tasks,
                &owners,
                &copies,
                overheads,
                highest,
            );
            let refused = |error| match error {
                AnalysisError::TooFewPriorities { levels, highest } => format!(
                    "{title}: {levels} priorities are needed but only {highest} are free: raise `priorities.highest`, which is 99 at most, \
                     and the `sampler_priority` above it, or let callbacks share threads"
                ),
                error => format!("{title}: {error}"),
            };
            warnings.extend(chosen.map_err(refused)?.map(|warning| format!("{title}: {warning}")));
            members.iter().zip(owners).for_each(|(i, owner)| {
                callbacks[*i].task.priority = self.threads[owner].priority.unwrap_or(1);
            });
        }
        let chains = self.file.chains.iter().map(|declared| self.chain(declared, &callbacks));
        let chains = chains.collect::<Result<Vec<_>, _>>()?;
        let entries = (0..self.file.callbacks.len()).map(|i| self.entry(i, &callbacks, owner[i])).collect();
        let system_cores = overheads.into_iter().map(|overheads| Core { overheads, stall_ns: 0 }).collect();
        let mut system = System { cores: system_cores, callbacks, relays, chains };
        let locks = locks::of(self.file, &self.streams);
        locks::block(&locks, &mut system);
        Ok(SystemFile {
            locks,
            fingerprint: 0,
            callbacks: entries,
            topics: self.topics(),
            cores,
            warnings,
            system,
        })
    }

    fn callback(&self, index: usize, source: Source) -> Callback {
        let declared = &self.file.callbacks[index];
        let ns = |time: &Option<super::reader::At<u64>>| time.as_ref().map_or(0, |time| time.value);
        let mut task =
            Task::new(declared.name.clone(), Duration::ZERO, Duration::from_nanos(ns(&declared.wcet)), 1);
        (task.bcet_ns, task.non_preemptive_ns) = (ns(&declared.bcet), ns(&declared.non_preemptive));
        task.deadline_ns = ns(&declared.deadline);
        let takes = self.streams.is_join(index) && source != Source::All;
        if takes {
            // It only stores a message: `take`, or else the least that the analysis accepts, without overheads.
            task.wcet_ns = ns(&declared.take).max(1);
            (task.bcet_ns, task.non_preemptive_ns) = (0, task.non_preemptive_ns.min(task.wcet_ns));
        }
        let place = self.places[index];
        let mut trigger = None;
        let (period, jitter, distance) = match source {
            Source::Period => (ns(&declared.period), ns(&declared.jitter), ns(&declared.min_distance)),
            Source::Outside(topic) => {
                let topic = &self.file.topics[topic];
                (ns(&topic.period), topic.jitter, ns(&topic.min_distance))
            }
            Source::Stream(publisher, stream) => {
                let network = self.places[publisher].host != place.host;
                trigger = Some((self.streams.outputs(publisher).start + stream, self.transfer(network)));
                (1, 0, 0)
            }
            // Its releases follow from its inputs.
            Source::All => (1, 0, 0),
        };
        let costs = self.costs(place.host);
        let executor = match self.file.nodes[place.node].client {
            Client::Tautline => None,
            Client::Rclcpp => costs.rclcpp,
            Client::Rclpy => costs.rclpy,
        };
        // The enforcement of its budget also takes place in its thread.
        let held = costs.demotion.filter(|_| declared.holds().is_some());
        task.executor_overhead_ns = executor.unwrap_or(0).saturating_add(held.unwrap_or(0));
        task = task.released(Release::periodic(period).jitter(jitter).min_distance(distance));
        task.hold = match declared.overrun.as_ref().map_or(OverrunPolicy::Tell, |overrun| overrun.value) {
            OverrunPolicy::Tell => Hold::Nothing,
            OverrunPolicy::Demote | OverrunPolicy::End => Hold::Demoted { section_ns: 0 },
            // Releases that are whole periods apart leave nothing of a budget for later.
            OverrunPolicy::Suspend => Hold::Suspended { deferred: source != Source::Period || jitter > 0 },
        };
        let depth = |topic: &str| Some(self.graph.declared.get(topic)?.depth.as_ref()?.value);
        task.depth = match source {
            Source::Period => Some(1),
            _ => declared.topics.iter().try_fold(0, |sum: u64, topic| sum.checked_add(depth(&topic.value)?)),
        };
        task.reservation = declared.reservation.as_ref().map(|reservation| reservation.value);
        let thread = self.owner[index];
        // A callback of several streams takes their messages in any order.
        if self.threads[thread].group.is_some() || self.streams.tasks(index).len() > 1 {
            let order =
                self.threads[thread].group.map_or(crate::Order::Any, |group| self.order(thread, group));
            task = task.group(u32::try_from(thread).unwrap_or(u32::MAX), order);
            if order == Order::Priority {
                let timer = Rank::Timer { is_first: self.runs_timers_first(thread) };
                task = task.rank(self.rank(index, thread).map_or(timer, Rank::Of));
                task.lowered_to = self.lowered_to(index, thread);
            }
        }
        let unbounded = self.unbounded(index, thread);
        Callback { trigger, unbounded, ..Callback::new(task, place.core) }
    }

    /// Why the executor of a callback gives it no bound.
    fn unbounded(&self, index: usize, thread: usize) -> Option<Unbounded> {
        let is_ranked = self.threads[thread].group.is_some_and(|group| self.file.groups[group].is_ranked());
        match self.file.nodes[self.places[index].node].executor() {
            Executor::MultiThreaded => Some(Unbounded::MultiThreaded),
            Executor::Events => Some(Unbounded::Events),
            Executor::StaticSingleThreaded if is_ranked && self.file.callbacks[index].topics.is_empty() => {
                Some(Unbounded::TimerAfterMessages)
            }
            Executor::StaticSingleThreaded | Executor::SingleThreaded => None,
        }
    }

    /// Returns the suffix of the name of a task that takes messages for a join: its topic, and its publisher if there are several.
    fn taken(&self, index: usize, source: Source, topic: usize) -> String {
        let name = &self.file.callbacks[index].topics[topic].value;
        let several = self.streams.topics(index).iter().filter(|of| **of == topic).count() > 1;
        match source {
            Source::Stream(publisher, _) if several => {
                format!(" ({name} of {})", self.file.callbacks[publisher].name)
            }
            _ => format!(" ({name})"),
        }
    }

    /// The rank of a callback in a thread that runs the highest first; a timer has none.
    fn rank(&self, index: usize, thread: usize) -> Option<u8> {
        let callback = &self.file.callbacks[index];
        let group = self.threads[thread].group.map(|group| &self.file.groups[group])?;
        callback.priority.as_ref().map(|priority| priority.value).filter(|_| group.is_ranked())
    }

    /// The lowest priority at which a thread that has those of its callbacks runs one of them. A timer after a message in a round has the
    /// message's.
    fn lowered_to(&self, index: usize, thread: usize) -> Option<u8> {
        let Thread { group, callbacks, priority, .. } = &self.threads[thread];
        group.filter(|group| self.file.groups[*group].has_priority_of_callback())?;
        let executor = self.file.nodes[self.places[index].node].executor();
        let is_first = executor != Executor::StaticSingleThreaded && self.runs_timers_first(thread);
        let lowest = || callbacks.iter().filter_map(|i| self.rank(*i, thread)).min();
        self.rank(index, thread).or_else(|| if is_first { *priority } else { lowest() })
    }

    /// Whether each round of a ROS executor begins with the timers: rclpy's goes through its nodes one after the other.
    fn runs_timers_first(&self, thread: usize) -> bool {
        let nodes: BTreeSet<usize> =
            self.threads[thread].callbacks.iter().map(|i| self.places[*i].node).collect();
        nodes.len() == 1 || nodes.iter().all(|node| self.file.nodes[*node].client == Client::Rclcpp)
    }

    /// Returns a group's order. ROS 2's executors poll in rounds, unless the RMW sorts, and a join drains its queues: neither keeps one.
    fn order(&self, thread: usize, group: usize) -> Order {
        let first = self.threads[thread].callbacks[0];
        let joins = self.threads[thread].callbacks.iter().any(|i| self.streams.is_join(*i));
        match &self.file.groups[group].order {
            Some(At { value: Order::Priority, .. }) => Order::Priority,
            _ if joins || self.file.nodes[self.places[first].node].client != Client::Tautline => Order::Any,
            Some(order) => order.value,
            None => Order::Fifo,
        }
    }

    /// The gateway's work: once for each message that leaves a host, on its publisher's core, and once for each that comes, on each core that
    /// takes or reads it.
    fn relays(&self, callbacks: &[Callback]) -> Vec<Relay> {
        let mut relays = Vec::new();
        let mut seen = HashSet::new();
        let mut add = |i: usize, topic: &str, source: Option<(usize, Transfer)>, release: Release| {
            let Place { host, core, .. } = self.places[i];
            let cost_ns = self.costs(host).gateway.unwrap_or(0);
            let way = source.map(|(task, transfer)| (task, transfer.most_ns));
            if cost_ns > 0 && seen.insert((core, topic.to_owned(), way)) {
                relays.push(Relay { core, source, release, cost_ns });
            }
        };
        let none = Release::periodic(1);
        let remote = |topic: &str| self.graph.declared.get(topic).copied().filter(|topic| topic.remote);
        for (i, callback) in self.file.callbacks.iter().enumerate() {
            for topic in callback.publishes.iter().filter(|topic| remote(&topic.value).is_some()) {
                for task in self.streams.outputs(i) {
                    add(i, &topic.value, Some((task, Transfer::LOCAL)), none.clone());
                }
            }
            for topic in callback.topics.iter().chain(&callback.reads) {
                let Some(declared) = remote(&topic.value) else { continue };
                let Some(publishers) = self.graph.publishers.get(topic.value.as_str()) else {
                    let period = Release::periodic(declared.period.as_ref().map_or(1, |period| period.value));
                    add(i, &topic.value, None, period.jitter(declared.jitter));
                    continue;
                };
                for &from in publishers.iter().filter(|from| self.places[**from].host != self.places[i].host)
                {
                    for task in self.streams.outputs(from) {
                        add(i, &topic.value, Some((task, self.transfer(true))), none.clone());
                    }
                }
            }
        }
        debug_assert!(relays.iter().all(|relay| relay.source.is_none_or(|(task, _)| task < callbacks.len())));
        relays
    }

    fn transfer(&self, network: bool) -> Transfer {
        let (least_ns, most_ns) = self.file.network.filter(|_| network).unwrap_or((0, 0));
        Transfer { least_ns, most_ns }
    }

    /// The host's costs, and the file's where it states none.
    fn costs(&self, host: usize) -> Costs {
        let (own, all) = (self.file.hosts[host].costs, self.file.costs);
        Costs {
            context_switch: own.context_switch.or(all.context_switch),
            per_message: own.per_message.or(all.per_message),
            gateway: own.gateway.or(all.gateway),
            rclcpp: own.rclcpp.or(all.rclcpp),
            rclpy: own.rclpy.or(all.rclpy),
            demotion: own.demotion.or(all.demotion),
            tick: own.tick.or(all.tick),
            throttling: own.throttling.or(all.throttling),
        }
    }

    fn overheads(&self, host: usize) -> Overheads {
        let costs = self.costs(host);
        let (tick_period_ns, tick_ns) = costs.tick.unwrap_or((0, 0));
        Overheads {
            context_switch_ns: costs.context_switch.unwrap_or(0),
            per_message_ns: costs.per_message.unwrap_or(0),
            tick_period_ns,
            tick_ns,
            throttling: costs.throttling.map(|(period_ns, runtime_ns)| Throttling { runtime_ns, period_ns }),
        }
    }

    fn chain(&self, declared: &super::declared::Chain, callbacks: &[Callback]) -> Result<Chain, String> {
        let stages = paths::resolve(self.file, declared);
        let host = |i: usize| self.places[i].host;
        let mut parts: Vec<Part> = Vec::new();
        let mut from: Option<usize> = None;
        for ways in paths::parts(&declared.name, &stages, &self.streams, callbacks)? {
            let at = stages[from.map_or(0, |from| from + 1)];
            let read = from.map(|from| stages[from]);
            let transfer = read.map_or(Transfer::LOCAL, |before| self.transfer(host(before) != host(at)));
            let overwritten_by = read.and_then(|before| self.overwritten_by(before, at, &parts));
            from = Some(from.map_or(ways.callbacks - 1, |from| from + ways.callbacks));
            parts.push(Part { ways: ways.tasks, transfer, overwritten_by });
        }
        let (name, deadline_ns) = (declared.name.clone(), declared.deadline.unwrap_or(u64::MAX));
        Ok(Chain { name, parts, deadline_ns })
    }

    /// Returns another writer of what `reader` reads of the chain so far; `None` if it can read that from a topic without another writer.
    fn overwritten_by(&self, before: usize, reader: usize, parts: &[Part]) -> Option<String> {
        let part = parts.last()?;
        // The tasks that pass on an event of the way's first task. In a later part, all that the first stage does reflects what it read.
        let carries = |first: usize| -> Vec<usize> {
            let ways = part.ways.iter().filter(|way| parts.len() > 1 || way[0] == first);
            ways.filter_map(|way| way.last().copied()).collect()
        };
        let firsts: BTreeSet<usize> = part.ways.iter().map(|way| way[0]).collect();
        let other = |topic: &str| {
            let writers = self.graph.publishers.get(topic).into_iter().flatten();
            let outputs =
                writers.flat_map(|writer| self.streams.outputs(*writer).map(move |task| (*writer, task)));
            let outputs: Vec<(usize, usize)> = outputs.collect();
            let lost = firsts.iter().find_map(|first| {
                let carries = carries(*first);
                outputs.iter().find(|(_, task)| !carries.contains(task))
            });
            lost.map(|(writer, _)| match *writer == before {
                true => format!(
                    "{}` for another trigger of `{}",
                    self.file.callbacks[*writer].name, self.file.callbacks[*writer].name
                ),
                false => self.file.callbacks[*writer].name.clone(),
            })
        };
        let reads = |topic: &&str| self.file.callbacks[reader].reads.iter().any(|read| read.value == **topic);
        let topics =
            self.file.callbacks[before].publishes.iter().map(|topic| topic.value.as_str()).filter(reads);
        topics.map(other).reduce(|a, b| a.and(b)).flatten()
    }

    fn core_entry(&self, host: usize, number: usize) -> CoreEntry {
        let host = &self.file.hosts[host];
        CoreEntry {
            host: host.name.clone(),
            number,
            sampler_priority: host.sampler_priority,
            stall_ns: host.stall,
            refuses_unlisted: host.refuses_unlisted,
        }
    }

    /// The topics that the file declares, then those that are only published.
    fn topics(&self) -> Vec<TopicEntry> {
        let declared = self.file.topics.iter().map(|topic| TopicEntry {
            name: topic.name.clone(),
            type_name: topic.type_name.clone(),
            depth: topic.depth.as_ref().map(|depth| depth.value),
            is_auto: topic.is_auto,
            remote: topic.remote,
            priority: topic.priority,
            express: topic.express,
        });
        let mut topics: Vec<_> = declared.collect();
        let mut known: HashSet<&str> = self.file.topics.iter().map(|topic| topic.name.as_str()).collect();
        for name in self.file.callbacks.iter().flat_map(|callback| &callback.publishes) {
            if known.insert(name.value.as_str()) {
                topics.push(TopicEntry {
                    name: name.value.clone(),
                    type_name: None,
                    depth: None,
                    is_auto: false,
                    remote: false,
                    priority: None,
                    express: false,
                });
            }
        }
        topics
    }

    fn entry(&self, index: usize, callbacks: &[Callback], thread: usize) -> CallbackEntry {
        let declared = &self.file.callbacks[index];
        let tasks = self.streams.tasks(index);
        let depths =
            declared.topics.iter().filter_map(|t| self.graph.declared.get(t.value.as_str())?.depth.as_ref());
        let priority = self.threads[thread].priority.unwrap_or(1);
        let thread_priority =
            self.threads[thread].group.map(|group| self.file.groups[group].thread_priority());
        let members = self.threads[thread].callbacks.iter().map(|i| self.streams.tasks(*i).start);
        let lowest = members.map(|task| callbacks[task].task.lowest()).min();
        CallbackEntry {
            name: declared.name.clone(),
            node: self.file.nodes[self.places[index].node].name.clone(),
            client: self.file.nodes[self.places[index].node].client,
            executor: self.file.nodes[self.places[index].node].executor(),
            thread: format!("cb:{}", self.threads[thread].name),
            group: self.threads[thread].group.map(|group| self.file.groups[group].name.clone()),
            core: self.places[index].core,
            priority,
            thread_priority: thread_priority.unwrap_or_default(),
            lowest_priority: lowest.unwrap_or(priority),
            wake_up: self.wake_ups[thread],
            rank: self.rank(index, thread),
            topics: declared.topics.iter().map(|topic| topic.value.clone()).collect(),
            publishes: declared.publishes.iter().map(|topic| topic.value.clone()).collect(),
            depth: depths.map(|depth| depth.value).min(),
            deadline_ns: callbacks[tasks.start].task.deadline_ns,
            input_max: declared.input_max,
            window_ns: declared.all.and_then(|_| Some(declared.window.as_ref()?.value)),
            joins: declared.all.is_some(),
            policy: declared.policy(),
            overrun: declared.overrun.as_ref().map_or(OverrunPolicy::Tell, |overrun| overrun.value),
            reservation: declared.reservation.as_ref().map(|reservation| reservation.value),
            floats: declared.floats.is_some(),
            tasks,
        }
    }
}

/// Checks that the budgets which the file wants to be enforced can be.
fn hold(file: &Declared, places: &[Option<Place>], streams: &Streams, problems: &Collector) {
    for (i, (callback, place)) in file.callbacks.iter().zip(places).enumerate() {
        let Some(overrun) = callback.overrun.as_ref().filter(|_| callback.holds().is_some()) else {
            continue;
        };
        let problem = |what: &str| {
            let (name, policy) = (&callback.name, overrun.value.as_str());
            problems
                .at(overrun.at)
                .add(format!("callback `{name}` has `overrun = \"{policy}\"`, but {what}"));
        };
        if callback.group.is_some() {
            problem(
                "shares its thread, whose other callbacks it would take with it: give it a thread of its own, or leave out `overrun`",
            );
        }
        let is_of_ros = place.is_some_and(|place| file.nodes[place.node].client != Client::Tautline);
        if is_of_ros && overrun.value != OverrunPolicy::Demote {
            problem(
                "is run by an executor of ROS 2's, which can neither sleep nor end in a callback: say \"demote\" or \"tell\"",
            );
        }
        if place.is_some_and(|place| file.nodes[place.node].executor() == Executor::Events) {
            problem(
                "is run by an EventsExecutor, where rmw_tautline sees no end of a callback: use a SingleThreadedExecutor, or leave out `overrun`",
            );
        }
        if is_of_ros && callback.topics.is_empty() {
            problem("is a timer of ROS 2's, which rmw_tautline does not see: leave out `overrun`");
        }
        if callback.non_preemptive.as_ref().is_some_and(|section| section.value > 0) {
            problem("has a `non_preemptive` section, which nothing stops: leave out one of them");
        }
        if overrun.value != OverrunPolicy::Suspend {
            continue;
        }
        if !callback.locks.is_empty() {
            problem(
                "takes locks, for which others would wait while it sleeps: say \"demote\", or leave out `locks`",
            );
        }
        if streams.tasks(i).len() > 1 {
            problem("is released in several ways, which have no common period: say \"demote\"");
        }
    }
}

/// Checks the orders of groups. ROS 2's executors take ready callbacks in rounds, or the RMW shows them only the highest priority.
fn orders(file: &Declared, places: &[Option<Place>], threads: &[Thread], problems: &Collector) {
    for thread in threads {
        let Some(group) = thread.group.map(|group| &file.groups[group]) else { continue };
        let ros = places[thread.callbacks[0]]
            .is_some_and(|place| file.nodes[place.node].client != Client::Tautline);
        let executor = places[thread.callbacks[0]]
            .map_or(Executor::SingleThreaded, |place| file.nodes[place.node].executor());
        let name = &group.name;
        match &group.order {
            Some(At { value: Order::Fifo, at }) if ros => problems.at(*at).add(format!(
                "group `{name}` is run by an executor of ROS 2's, which is not first in, first out: leave out its \
                 `order`"
            )),
            Some(At { value: Order::Priority, at }) if !ros => problems.at(*at).add(format!(
                "group `{name}` is run by Tautline, where each callback with a priority has a thread: leave out \
                 `order`, or the group"
            )),
            Some(At { value: Order::Priority, at })
                if matches!(executor, Executor::MultiThreaded | Executor::Events) =>
            {
                problems.at(*at).add(format!(
                    "group `{name}` has `order = \"priority\"`, which a node's `executor = \"{}\"` does not keep: leave out its `order`, or \
                     use a SingleThreadedExecutor",
                    executor.as_str()
                ));
            }
            Some(At { value: Order::Priority, at })
                if group.priority.is_none() && !group.has_priority_of_callback() =>
            {
                problems.at(*at).add(format!(
                    "group `{name}` orders its callbacks by their priorities: give it a `priority`, too, that of its \
                     thread, or `thread_priority = \"callback\"`"
                ));
            }
            _ => {}
        }
        if let Some(At { value: ThreadPriority::Callback, at }) = group.thread_priority {
            let has_message = thread.callbacks.iter().any(|i| !file.callbacks[*i].topics.is_empty());
            match &group.priority {
                _ if !group.is_ranked() => problems.at(at).add(format!(
                    "group `{name}` has `thread_priority = \"callback\"`, which needs `order = \"priority\"`: add \
                     that, or leave out `thread_priority`"
                )),
                Some(priority) => problems.at(priority.at).add(format!(
                    "group `{name}` has a `priority`, but with `thread_priority = \"callback\"` its thread has those of its \
                     callbacks: leave out one of them"
                )),
                None if !has_message => problems.at(at).add(format!(
                    "group `{name}` has `thread_priority = \"callback\"`, but only timers, which have no priority of their \
                     own: give the group a `priority` instead"
                )),
                None => {}
            }
        }
        for callback in thread.callbacks.iter().map(|i| &file.callbacks[*i]).filter(|_| group.is_ranked()) {
            let of = &callback.name;
            match &callback.priority {
                Some(priority) if callback.topics.is_empty() => problems.at(priority.at).add(format!(
                    "callback `{of}` is a timer, which the executor of group `{name}` runs after its next wait, whatever \
                     is reported: leave out its `priority`"
                )),
                None if !callback.topics.is_empty() => problems.at(callback.at).add(format!(
                    "callback `{of}` of group `{name}` has no `priority`, by which the group's callbacks are ordered{}: add \
                     one, 1 (lowest) to 99",
                    if group.has_priority_of_callback() { ", and which its thread then has" } else { "" }
                )),
                _ => {}
            }
        }
    }
}

/// Checks that messages which are to be matched by their stamps can be.
fn meet(file: &Declared, streams: &Streams, problems: &Collector) {
    let period = |first: &First| match first {
        First::Callback(i) | First::Join(i) => file.callbacks[*i].period.as_ref().map(|period| period.value),
        First::Topic(i) => file.topics[*i].period.as_ref().map(|period| period.value),
    };
    for (i, callback) in file.callbacks.iter().enumerate() {
        if callback.all.is_none() {
            continue;
        }
        let name = &callback.name;
        let shared = callback.topics.iter().enumerate().find_map(|(at, topic)| {
            let ways = streams.topics(i).iter().filter(|of| **of == at).count();
            (ways > 1).then_some((topic, ways))
        });
        if callback.policy() == JoinPolicy::LatestTime {
            let periods = streams.sources(i).iter().map(|source| period(&streams.first(i, *source)));
            paced(
                callback,
                shared.map(|(topic, _)| topic.value.as_str()),
                &periods.collect::<Vec<_>>(),
                problems,
            );
        }
        let Some(window) = &callback.window else { continue };
        if let (0, Some((topic, ways))) = (window.value, shared) {
            problems.at(window.at).add(format!(
                "callback `{name}` waits for equal stamps, but `{}` reaches it in {ways} ways, whose stamps have no \
                 equal in the other topics: give each publisher a topic of its own, or make the `window` as long as \
                 stamps may lie apart",
                topic.value
            ));
            continue;
        }
        let firsts: Vec<First> = streams
            .sources(i)
            .iter()
            .map(|source| stamped_by(file, streams, streams.first(i, *source)))
            .collect();
        let topics = streams.topics(i).iter().map(|topic| &callback.topics[*topic]);
        let joins = firsts.iter().zip(topics).find(|(first, _)| matches!(first, First::Join(_)));
        if let Some((First::Join(join), topic)) = joins {
            problems.at(topic.at).add(format!(
                "callback `{name}` goes by stamps, but those of `{}` are not known, for `{}` makes it of several \
                 messages: leave out the `window`, to take the newest of each",
                topic.value, file.callbacks[*join].name
            ));
            continue;
        }
        // Topics from outside may be triggered together; two callbacks are not.
        let apart = firsts.iter().position(|first| {
            *first != firsts[0] && !matches!((first, firsts[0]), (First::Topic(_), First::Topic(_)))
        });
        let uneven = firsts.iter().position(|first| period(first) != period(&firsts[0]));
        if let (0, Some(other)) = (window.value, apart.or(uneven)) {
            let (one, other) = (&callback.topics[0].value, &callback.topics[other].value);
            problems.at(window.at).add(format!(
                "callback `{name}` waits for equal stamps, but `{one}` and `{other}` {}: make the `window` as long as \
                 their stamps may lie apart, or leave it out, to take the newest of each",
                if apart.is_some() { "do not come from one source" } else { "have different periods" }
            ));
        }
    }
}

/// Returns the source of a message's stamps: a join by equal stamps passes on the stamps that it got.
fn stamped_by(file: &Declared, streams: &Streams, mut first: First) -> First {
    while let First::Join(join) = first
        && file.callbacks[join].window.as_ref().is_some_and(|window| window.value == 0)
    {
        first = streams.first(join, streams.sources(join)[0]);
    }
    first
}

/// Checks that it is known which topic is the fastest.
fn paced(
    callback: &super::declared::Callback,
    shared: Option<&str>,
    periods: &[Option<u64>],
    problems: &Collector,
) {
    let Some(policy) = &callback.policy else { return };
    let name = &callback.name;
    let what = if let Some(topic) = shared {
        format!(
            "`{topic}` comes from several publishers, or from one with several triggers, so that it has no rate of its own"
        )
    } else {
        // The analysis reports topics without a rate of their own, such as those of a join.
        let Some(fastest) = periods.iter().flatten().min() else { return };
        let fast = periods.iter().zip(&callback.topics);
        let mut fast = fast.filter(|(period, _)| period.as_ref() == Some(fastest));
        let (Some((_, one)), Some((_, other))) = (fast.next(), fast.next()) else { return };
        format!("`{}` and `{}` have the same period", one.value, other.value)
    };
    problems.at(policy.at).add(format!(
        "callback `{name}` runs at the pace of the fastest of its topics, but {what}: let the one that sets the pace \
         be its `topic`, and put the others into `reads`"
    ));
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Admission: whether a new program or thread may run beside those that run already. Everything that shares
//! the cores of one machine is analysed as one system.
use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use super::content::Lock;
use super::{
    CallbackEntry, CheckedSystem, Client, CoreEntry, Executor, JoinPolicy, OverrunPolicy, SystemFile,
    ThreadPriority, WakeUp, locks, reservations,
};
use crate::system::{Callback, Core, Relay};
use crate::{Order, Overheads, Reservation, Task};

/// A system file in use, as seen by the machine that is one of its hosts.
#[derive(Debug, Clone, Copy)]
pub struct Share<'f> {
    /// The file.
    pub file: &'f SystemFile,
    /// Which of its hosts the machine is.
    pub host: &'f str,
    /// Its name in messages: its path.
    pub label: &'f str,
}

/// A real-time thread that no system file describes, with the parameters that it states itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LooseThread {
    /// The name of its callback.
    pub name: String,
    /// Its owner: a program and its process.
    pub label: String,
    /// Its only core; `None`: it may run on any core, and is counted on each.
    pub core: Option<usize>,
    /// `SCHED_FIFO` priority, 1 to 99; ignored if there is a reservation.
    pub priority: u8,
    /// What the kernel reserves for it, under SCHED_DEADLINE.
    pub reservation: Option<Reservation>,
    /// Shortest time between two releases. Without it, or without a budget, nothing at its priority or below has a
    /// bound.
    pub period_ns: Option<u64>,
    /// How many topics release it, each with this period; 1 for a timer. Their messages may come at once.
    pub streams: usize,
    /// How much later than nominal a release may be.
    pub jitter_ns: u64,
    /// The processor time of a job.
    pub budget_ns: Option<u64>,
    /// The deadline of a job, relative to its release; `None`: it cannot be late.
    pub deadline_ns: Option<u64>,
}

/// Everything that shares the cores of one machine.
#[derive(Debug, Clone, Default)]
pub struct Machine<'f> {
    shares: Vec<Share<'f>>,
    threads: Vec<LooseThread>,
}

/// A file or a thread that is to be admitted.
#[derive(Debug, Clone)]
pub enum Candidate<'f> {
    /// Everything that a system file describes.
    File(Share<'f>),
    /// One additional thread.
    Thread(LooseThread),
}

/// The result of the analysis for a candidate.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Admission {
    /// Everything that runs, and the candidate, analysed as one system. A name that several files use includes
    /// the file's name.
    pub checked: CheckedSystem,
    /// What would miss its deadline, the candidate's own callbacks and chains first; empty: it may run.
    pub broken: Vec<Broken>,
}

/// A deadline that would not be met.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Broken {
    /// `callback` or `chain`.
    pub kind: &'static str,
    /// Its name.
    pub name: String,
    /// Its owner: a system file's path, or a program.
    pub label: String,
    /// Whether it belongs to the candidate.
    pub is_own: bool,
    /// Its response time, or latency, together with all others; `None`: nothing bounds it.
    pub response_ns: Option<u64>,
    /// The longest allowed time.
    pub deadline_ns: u64,
}

impl fmt::Display for Broken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Broken { kind, name, label, deadline_ns, .. } = self;
        let deadline = Duration::from_nanos(*deadline_ns);
        match self.response_ns.map(Duration::from_nanos) {
            Some(time) => write!(
                f,
                "{kind} `{name}` of {label} would take up to {time:?}, its deadline is {deadline:?}"
            ),
            None => write!(f, "{kind} `{name}` of {label} would have no bound, its deadline is {deadline:?}"),
        }
    }
}

impl<'f> Machine<'f> {
    /// Adds a file in use. A file with the same text for the same host counts as the same system, whatever number of
    /// processes use it.
    pub fn add_file(&mut self, share: Share<'f>) {
        if self.position(&share).is_none() {
            self.shares.push(share);
        }
    }

    /// Adds a thread that no file describes.
    pub fn add_thread(&mut self, thread: LooseThread) {
        self.threads.push(thread);
    }

    /// Whether nothing real-time is known to run.
    pub fn is_empty(&self) -> bool {
        self.shares.is_empty() && self.threads.is_empty()
    }

    /// Everything that runs, analysed as one system.
    pub fn check(&self) -> CheckedSystem {
        self.unite().file.check()
    }

    /// The effect on all deadlines if the candidate runs, too. It is admitted if it meets its own deadlines and breaks
    /// none that is met without it.
    pub fn admit(&self, candidate: &Candidate<'f>) -> Admission {
        let mut with = self.clone();
        let own = match candidate {
            Candidate::File(share) => {
                with.add_file(*share);
                Origin::File(with.position(share).unwrap_or(0))
            }
            Candidate::Thread(thread) => {
                with.add_thread(thread.clone());
                Origin::Thread(self.threads.len())
            }
        };
        let union = with.unite();
        let checked = union.file.check();
        let mut broken = with.unmet(&union, &checked, own);
        if broken.iter().any(|broken| !broken.1.is_own) {
            let before = self.unite();
            let before = self.unmet(&before, &before.file.check(), own);
            broken.retain(|(key, broken)| broken.is_own || before.iter().all(|(other, _)| other != key));
        }
        broken.sort_by_key(|(_, broken)| !broken.is_own);
        // A thread that may run on several cores appears once for each.
        broken.dedup_by(|(a, _), (b, _)| a == b);
        Admission { checked, broken: broken.into_iter().map(|(_, broken)| broken).collect() }
    }

    fn position(&self, share: &Share) -> Option<usize> {
        let is_same =
            |other: &Share| (other.file.fingerprint, other.host) == (share.file.fingerprint, share.host);
        self.shares.iter().position(is_same)
    }

    /// Returns all deadlines that are not met, each with its key.
    fn unmet(&self, union: &Union, checked: &CheckedSystem, own: Origin) -> Vec<(Key, Broken)> {
        let broken = |kind: &'static str, key: &(Origin, usize), response_ns, deadline_ns| {
            let (name, label) = self.name_of(kind, *key);
            let broken = Broken { kind, name, label, is_own: key.0 == own, response_ns, deadline_ns };
            ((kind, key.0, key.1), broken)
        };
        let callbacks = checked.callbacks.iter().zip(&union.callbacks).filter(|(callback, _)| !callback.met);
        // A thread that states no deadline misses none.
        let callbacks = callbacks.filter(|(_, (origin, _))| self.has_deadline(*origin));
        let callbacks = callbacks.map(|(callback, key)| {
            broken("callback", key, callback.response_overhead_ns, callback.entry.deadline_ns)
        });
        let chains = checked.chains.iter().zip(&union.chains).filter(|(chain, _)| !chain.met);
        let chains = chains.map(|(chain, key)| broken("chain", key, chain.latency_ns, chain.deadline_ns));
        callbacks.chain(chains).collect()
    }

    fn has_deadline(&self, origin: Origin) -> bool {
        match origin {
            Origin::File(_) => true,
            Origin::Thread(index) => self.threads[index].deadline_ns.is_some(),
        }
    }

    fn name_of(&self, kind: &str, (origin, index): (Origin, usize)) -> (String, String) {
        match origin {
            Origin::File(share) => {
                let Share { file, label, .. } = &self.shares[share];
                let name = if kind == "chain" {
                    &file.system.chains[index].name
                } else {
                    &file.callbacks[index].name
                };
                (name.clone(), (*label).to_owned())
            }
            Origin::Thread(thread) => (self.threads[thread].name.clone(), self.threads[thread].label.clone()),
        }
    }

    fn unite(&self) -> Union {
        let mut union = Union::default();
        for (index, share) in self.shares.iter().enumerate() {
            union.add_file(Origin::File(index), share);
        }
        // Threads that may run on any core come last: by then all cores are known.
        let (floating, pinned): (Vec<_>, Vec<_>) =
            self.threads.iter().enumerate().partition(|(_, thread)| thread.core.is_none());
        for (index, thread) in pinned.into_iter().chain(floating) {
            union.add_thread(Origin::Thread(index), thread);
        }
        let labels = |origin: Origin| match origin {
            Origin::File(index) => self.shares[index].label,
            Origin::Thread(index) => self.threads[index].label.as_str(),
        };
        union.tell_apart(labels);
        union.follow();
        union
    }
}

/// Where a callback or a chain is from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Origin {
    File(usize),
    Thread(usize),
}

type Key = (&'static str, Origin, usize);

/// Several systems as one. It has no file of its own; its order is that of the files and threads that it was made of.
#[derive(Default)]
struct Union {
    file: SystemFile,
    /// The origin of each callback, and the callback's number there.
    callbacks: Vec<(Origin, usize)>,
    chains: Vec<(Origin, usize)>,
    /// The next number of a thread that several callbacks share.
    groups: u32,
}

/// The name of the machine itself, whatever a file calls it.
const HERE: &str = "";

impl Union {
    fn add_file(&mut self, origin: Origin, share: &Share) {
        let Share { file, host, .. } = share;
        let cores: Vec<usize> = (0..file.cores.len()).map(|core| self.core_of(file, core, host)).collect();
        let first = self.file.system.callbacks.len();
        for (index, entry) in file.callbacks.iter().enumerate() {
            let tasks = entry.tasks.start + first..entry.tasks.end + first;
            self.file.callbacks.push(CallbackEntry { core: cores[entry.core], tasks, ..entry.clone() });
            self.callbacks.push((origin, index));
        }
        let groups = self.groups;
        // The copies of a reservation on other cores depend on all cores, and come last: see `follow`.
        for callback in file.system.callbacks.iter().filter(|callback| callback.copy_of.is_none()) {
            let mut callback = Callback { core: cores[callback.core], ..callback.clone() };
            (callback.task.blocking_ns, callback.task.lock_waits) = (0, 0);
            if let Some((source, _)) = &mut callback.trigger {
                *source += first;
            }
            if let Some(join) = &mut callback.join {
                join.inputs.iter_mut().for_each(|input| *input += first);
            }
            if let Some(group) = &mut callback.task.group {
                group.id = group.id.saturating_add(groups);
                self.groups = self.groups.max(group.id.saturating_add(1));
            }
            self.file.system.callbacks.push(callback);
        }
        for relay in &file.system.relays {
            let source = relay.source.map(|(task, transfer)| (task + first, transfer));
            self.file.system.relays.push(Relay { core: cores[relay.core], source, ..relay.clone() });
        }
        // Locks of two files are not the same, whatever their names.
        let (Origin::File(number) | Origin::Thread(number)) = origin;
        let lock = |lock: &Lock| {
            let resource = format!("{number} {}", lock.resource);
            Lock { task: lock.task + first, resource, ..lock.clone() }
        };
        self.file.locks.extend(file.locks.iter().map(lock));
        for (index, chain) in file.system.chains.iter().enumerate() {
            let mut chain = chain.clone();
            chain
                .parts
                .iter_mut()
                .flat_map(|part| &mut part.ways)
                .flatten()
                .for_each(|stage| *stage += first);
            self.file.system.chains.push(chain);
            self.chains.push((origin, index));
        }
        self.file.topics.extend(file.topics.iter().cloned());
        self.file.warnings.extend(file.warnings.iter().cloned());
    }

    /// Adds a thread as a task for each of its streams: on each core of the machine, if it may run on several.
    fn add_thread(&mut self, origin: Origin, thread: &LooseThread) {
        let here = |entry: &(usize, &CoreEntry)| entry.1.host == HERE;
        let core = |number| CoreEntry {
            host: HERE.to_owned(),
            number,
            sampler_priority: 99,
            stall_ns: 0,
            refuses_unlisted: false,
        };
        let cores: Vec<usize> = match thread.core {
            Some(number) => vec![self.core(core(number), Overheads::NONE)],
            None => {
                self.core(core(0), Overheads::NONE);
                self.file.cores.iter().enumerate().filter(here).map(|(index, _)| index).collect()
            }
        };
        // A reservation on any core is copied to the others like a file's.
        let cores = if thread.reservation.is_some() { &cores[..1] } else { &cores[..] };
        // A thread that does not state its load is assumed to use the whole core.
        let (period_ns, wcet_ns) = match (thread.period_ns, thread.budget_ns) {
            (Some(period_ns), Some(budget_ns)) => (period_ns.max(1), budget_ns.max(1)),
            _ => (1_000_000_000, 1_000_000_000),
        };
        let deadline_ns = thread.deadline_ns.unwrap_or(period_ns);
        let streams = if thread.reservation.is_some() { 1 } else { thread.streams.max(1) };
        for &core in cores {
            let (period, wcet) = (Duration::from_nanos(period_ns), Duration::from_nanos(wcet_ns));
            let task = Task::new(&thread.name, period, wcet, thread.priority)
                .deadline(Duration::from_nanos(deadline_ns))
                .jitter(Duration::from_nanos(thread.jitter_ns));
            let priority = thread.reservation.map_or(thread.priority, |_| Reservation::PRIORITY);
            let mut task = Task { reservation: thread.reservation, priority, ..task };
            if streams > 1 {
                task = task.group(self.groups, Order::Any);
                self.groups = self.groups.saturating_add(1);
            }
            let index = self.file.system.callbacks.len();
            self.file.system.callbacks.extend(std::iter::repeat_n(Callback::new(task, core), streams));
            self.file.callbacks.push(CallbackEntry {
                name: thread.name.clone(),
                node: thread.label.clone(),
                client: Client::Tautline,
                executor: Executor::SingleThreaded,
                thread: format!("cb:{}", thread.name),
                group: None,
                core,
                priority,
                thread_priority: ThreadPriority::Group,
                lowest_priority: priority,
                wake_up: WakeUp::Sampler("as far as is known: it is in no file"),
                rank: None,
                reservation: thread.reservation,
                floats: thread.reservation.is_some() && thread.core.is_none(),
                topics: Vec::new(),
                joins: false,
                policy: JoinPolicy::ByWindow,
                overrun: OverrunPolicy::Tell,
                window_ns: None,
                publishes: Vec::new(),
                depth: None,
                deadline_ns,
                input_max: None,
                tasks: index..index + streams,
            });
            self.callbacks.push((origin, 0));
        }
    }

    /// Adds what depends on the whole union: the copies of reservations on other cores, and the blocking by locks.
    fn follow(&mut self) {
        let SystemFile { callbacks: entries, cores, system, locks, .. } = &mut self.file;
        let floating = entries.iter().filter(|entry| entry.floats);
        for entry in floating.map(|entry| (entry.tasks.start, entry.name.clone())).collect::<Vec<_>>() {
            reservations::copy(&entry.1, entry.0, cores, &mut system.callbacks);
        }
        locks::block(locks, system);
    }

    fn core_of(&mut self, file: &SystemFile, core: usize, here: &str) -> usize {
        let mut entry = file.cores[core].clone();
        if entry.host == here {
            HERE.clone_into(&mut entry.host);
        }
        self.core(entry, file.system.cores[core].overheads)
    }

    /// Adds a core, or merges it with the same core: the worst overheads and stall count, and callbacks stay below the lowest sampler.
    fn core(&mut self, core: CoreEntry, costs: Overheads) -> usize {
        let is_it = |entry: &CoreEntry| (&entry.host, entry.number) == (&core.host, core.number);
        match self.file.cores.iter().position(is_it) {
            Some(index) => {
                let entry = &mut self.file.cores[index];
                entry.sampler_priority = entry.sampler_priority.min(core.sampler_priority);
                entry.stall_ns = entry.stall_ns.max(core.stall_ns);
                let overheads = &mut self.file.system.cores[index].overheads;
                *overheads = worse(overheads, &costs);
                index
            }
            None => {
                self.file.cores.push(core);
                self.file.system.cores.push(Core { overheads: costs, stall_ns: 0 });
                self.file.cores.len() - 1
            }
        }
    }

    /// Appends the labels of their origins to names that several callbacks have.
    fn tell_apart<'l>(&mut self, label: impl Fn(Origin) -> &'l str) {
        let mut counts: BTreeMap<String, usize> = BTreeMap::new();
        for entry in &self.file.callbacks {
            *counts.entry(entry.name.clone()).or_default() += 1;
        }
        for (entry, (origin, _)) in self.file.callbacks.iter_mut().zip(&self.callbacks) {
            if counts[&entry.name] > 1 {
                entry.name = format!("{} ({})", entry.name, label(*origin));
                for callback in &mut self.file.system.callbacks[entry.tasks.clone()] {
                    callback.task.name.clone_from(&entry.name);
                }
            }
        }
    }
}

/// Returns the larger overheads, the ticks that cost most, and the throttling with the shortest time for real-time work.
fn worse(a: &Overheads, b: &Overheads) -> Overheads {
    let load = |of: &Overheads| u128::from(of.tick_ns) * 1_000_000 / u128::from(of.tick_period_ns.max(1));
    let ticks = if load(b) > load(a) { b } else { a };
    let left = |throttling: &crate::Throttling| {
        u128::from(throttling.runtime_ns) * 1_000_000 / u128::from(throttling.period_ns.max(1))
    };
    Overheads {
        context_switch_ns: a.context_switch_ns.max(b.context_switch_ns),
        per_message_ns: a.per_message_ns.max(b.per_message_ns),
        tick_period_ns: ticks.tick_period_ns,
        tick_ns: ticks.tick_ns,
        throttling: [a.throttling, b.throttling].into_iter().flatten().min_by_key(left),
    }
}

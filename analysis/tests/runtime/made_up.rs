// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random systems, as a model and as the file that says the same.

use std::fmt::Write;

use rand::RngExt;
use rand::rngs::StdRng;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Budget {
    Tell,
    Demote,
    Suspend,
    /// Runtime and period.
    Reserved(u64, u64),
}

#[derive(Debug, Clone)]
pub struct Callback {
    pub core: usize,
    /// Its timer's period, or that of its topic from outside.
    pub period: u64,
    pub jitter: u64,
    /// Between two of its own releases.
    pub min_distance: u64,
    /// The callbacks whose topics trigger it; none: a timer or a topic from outside.
    pub triggers: Vec<usize>,
    pub is_outside: bool,
    pub wcet: u64,
    pub bcet: u64,
    pub priority: u8,
    pub group: Option<usize>,
    pub budget: Budget,
    /// The offset in the job's work and the length of its section, of the one lock of its core.
    pub lock: Option<(u64, u64)>,
    pub is_non_preemptive: bool,
    /// The callback whose topic it reads.
    pub reads: Option<usize>,
    /// The callback whose topic it publishes too.
    pub also: Option<usize>,
}

#[derive(Debug, Clone)]
pub struct Model {
    /// The host of each core.
    pub hosts: Vec<usize>,
    pub callbacks: Vec<Callback>,
    /// Whether each group is first in, first out.
    pub groups: Vec<bool>,
    pub chains: Vec<Vec<usize>>,
    pub per_message: u64,
    pub gateway: u64,
    pub tick: Option<(u64, u64)>,
    /// Whether reservations run on any core.
    pub floats: bool,
    /// The period, and how much of it real-time threads may use.
    pub throttling: Option<(u64, u64)>,
    /// For how long each core may stand still.
    pub stall: u64,
    /// What an executor of rclcpp uses for each job; none on cores of Tautline's nodes.
    pub executors: Vec<Option<u64>>,
    pub network: (u64, u64),
    pub is_ceiling: bool,
}

/// The depth of queues that the file states.
pub const DEPTH: usize = 3;

impl Model {
    pub fn random(rng: &mut StdRng) -> Model {
        let hosts = [vec![0], vec![0, 0], vec![0, 1]][rng.random_range(0..3)].clone();
        let count = rng.random_range(2..=6);
        let load = rng.random_range(0.3..1.1);
        let executor = rng.random_range(0..4);
        let executors: Vec<_> = hosts.iter().map(|_| rng.random_bool(0.15).then_some(executor)).collect();
        let groups = executors.iter().map(|executor| executor.is_none() && rng.random_bool(0.7)).collect();
        let per_message = if rng.random_bool(0.5) { rng.random_range(1..=2) } else { 0 };
        let mut model = Model {
            callbacks: Vec::new(),
            groups,
            chains: Vec::new(),
            per_message,
            gateway: if rng.random_bool(0.5) { rng.random_range(1..=3) } else { 0 },
            tick: rng.random_bool(0.3).then(|| (rng.random_range(20..60), 1)),
            floats: hosts == [0, 0] && rng.random_bool(0.5),
            throttling: rng.random_bool(0.15).then(|| {
                let period = rng.random_range(100..400);
                (period, period * rng.random_range(70..98) / 100)
            }),
            stall: if rng.random_bool(0.15) { rng.random_range(1..150) } else { 0 },
            executors,
            network: if rng.random_bool(0.5) { (2, 2 + rng.random_range(0..60)) } else { (3, 3) },
            is_ceiling: rng.random_bool(0.5),
            hosts,
        };
        for i in 0..count {
            let one = model.callback(i, count, load, rng);
            model.callbacks.push(one);
        }
        for to in 1..count {
            let before = |i: usize| {
                let Callback { triggers, reads, .. } = &model.callbacks[i];
                triggers.first().copied().or(*reads)
            };
            let mut path = vec![to];
            while let Some(from) = before(path[0]).filter(|_| path.len() < 4) {
                path.insert(0, from);
            }
            if path.len() > 1 {
                model.chains.push(path);
            }
        }
        model
    }

    fn callback(&self, i: usize, count: usize, load: f64, rng: &mut StdRng) -> Callback {
        let core = rng.random_range(0..self.hosts.len());
        let period = [20, 30, 40, 50, 60, 80, 100, 150, 200][rng.random_range(0..9)];
        let triggers = match i {
            _ if i == 0 || rng.random_bool(0.55) => Vec::new(),
            _ if i > 1 && rng.random_bool(0.15) => vec![i - 1, i - 2],
            _ => vec![rng.random_range(0..i)],
        };
        // About as much as leaves something for the others.
        let slowest = triggers.iter().map(|from| self.period(*from)).min().unwrap_or(period);
        let share = load * self.hosts.len() as f64 / count as f64;
        let wcet =
            (slowest as f64 * share * rng.random_range(0.2..1.6)).round().clamp(1.0, slowest as f64) as u64;
        let is_outside = triggers.is_empty() && rng.random_bool(0.4);
        let jitter = if triggers.is_empty() && rng.random_bool(0.4) {
            rng.random_range(0..=period * 3 / 2)
        } else {
            0
        };
        let is_single = triggers.len() < 2;
        // One on each core, or as many as there are cores.
        let is_beside = |other: &&Callback| other.core == core || self.floats;
        let reserved = self.callbacks.iter().filter(is_beside);
        let reserved = reserved.filter(|other| matches!(other.budget, Budget::Reserved(..))).count();
        let has_reserved = reserved >= if self.floats { self.hosts.len() } else { 1 };
        let min_distance = if jitter > 0 && rng.random_bool(0.3) { rng.random_range(0..=period) } else { 0 };
        let budget = match rng.random_range(0..12) {
            _ if self.executors[core].is_some() => Budget::Tell,
            0 | 1 => Budget::Demote,
            2 if is_single => Budget::Suspend,
            3 if is_single && !has_reserved && wcet + 2 < period => {
                Budget::Reserved(wcet + 2, period.max(100))
            }
            _ => Budget::Tell,
        };
        let group = (budget == Budget::Tell && rng.random_bool(0.25)).then_some(core);
        let locks = matches!(budget, Budget::Tell | Budget::Demote) && rng.random_bool(0.25);
        let length = rng.random_range(1..=wcet);
        Callback {
            core,
            period,
            jitter,
            min_distance,
            triggers,
            is_outside,
            wcet,
            bcet: rng.random_range(0..=wcet),
            priority: group
                .map_or(10 + 3 * ((i as u8 * 7 + rng.random_range(0..7)) % 20), |core| 12 + 3 * core as u8),
            group,
            budget,
            lock: locks.then(|| (rng.random_range(0..=wcet - length), length)),
            is_non_preemptive: budget == Budget::Tell && group.is_none() && !locks && rng.random_bool(0.1),
            reads: (i > 0 && rng.random_bool(0.3)).then(|| rng.random_range(0..i)),
            also: (i > 0 && rng.random_bool(0.1)).then(|| rng.random_range(0..i)),
        }
    }

    /// What the system has that others lack.
    pub fn features(&self) -> Vec<&'static str> {
        let has = |what: &dyn Fn(&Callback) -> bool| self.callbacks.iter().any(what);
        let features = [
            ("demotion", has(&|c| c.budget == Budget::Demote)),
            ("suspension", has(&|c| c.budget == Budget::Suspend)),
            ("reservations", has(&|c| matches!(c.budget, Budget::Reserved(..)))),
            ("floating", self.floats && has(&|c| matches!(c.budget, Budget::Reserved(..)))),
            ("groups", has(&|c| c.group.is_some())),
            ("locks", has(&|c| c.lock.is_some())),
            ("sections", has(&|c| c.is_non_preemptive)),
            ("several triggers", has(&|c| c.triggers.len() > 1)),
            ("least distances", has(&|c| c.min_distance > 0)),
            ("two hosts", self.hosts.contains(&1)),
            ("gateways", self.gateway > 0),
            ("throttling", self.throttling.is_some()),
            ("rclcpp", self.executors.iter().any(Option::is_some)),
        ];
        features.into_iter().filter(|(_, has)| *has).map(|(name, _)| name).collect()
    }

    /// The shortest period with which a callback is released.
    pub fn period(&self, i: usize) -> u64 {
        let Callback { period, triggers, .. } = &self.callbacks[i];
        triggers.iter().map(|from| self.period(*from)).min().unwrap_or(*period)
    }

    /// Who publishes the topic of a callback.
    pub fn publishers(&self, topic: usize) -> impl Iterator<Item = usize> {
        (0..self.callbacks.len()).filter(move |i| *i == topic || self.callbacks[*i].also == Some(topic))
    }

    pub fn text(&self) -> String {
        let mut text = String::new();
        for host in 0..=self.hosts.iter().copied().max().unwrap_or(0) {
            writeln!(
                text,
                "[hosts.h{host}]\nstall = \"{}us\"\ncores = {}",
                self.stall,
                self.hosts.iter().filter(|of| **of == host).count()
            )
            .unwrap();
        }
        writeln!(text, "[network]\nlatency = [\"{}us\", \"{}us\"]", self.network.0, self.network.1).unwrap();
        writeln!(
            text,
            "[priorities]\nlocks = \"{}\"",
            if self.is_ceiling { "ceiling" } else { "inheritance" }
        )
        .unwrap();
        writeln!(
            text,
            "[overheads]\nper_message = \"{}us\"\ngateway = \"{}us\"",
            self.per_message, self.gateway
        )
        .unwrap();
        let executor = self.executors.iter().flatten().next().unwrap_or(&0);
        writeln!(text, "rclcpp = \"{executor}us\"").unwrap();
        if let Some((period, runtime)) = self.throttling {
            writeln!(text, "throttling = {{ period = \"{period}us\", runtime = \"{runtime}us\" }}").unwrap();
        }
        if let Some((period, wcet)) = self.tick {
            writeln!(text, "tick = {{ period = \"{period}us\", wcet = \"{wcet}us\" }}").unwrap();
        }
        for (core, host) in self.hosts.iter().enumerate() {
            let number = self.hosts[..core].iter().filter(|other| *other == host).count();
            writeln!(text, "[nodes.n{core}]\nhost = \"h{host}\"\ncore = {number}").unwrap();
            if self.executors[core].is_some() {
                writeln!(text, "client = \"rclcpp\"").unwrap();
            }
        }
        for (group, is_fifo) in self.groups.iter().enumerate() {
            if self.callbacks.iter().any(|callback| callback.group == Some(group)) {
                writeln!(text, "[groups.g{group}]").unwrap();
                if self.executors[group].is_none() {
                    writeln!(text, "order = \"{}\"", if *is_fifo { "fifo" } else { "any" }).unwrap();
                }
            }
        }
        writeln!(text, "[topics]").unwrap();
        for (i, callback) in self.callbacks.iter().enumerate() {
            let is_held =
                self.callbacks.iter().any(|to| to.triggers.contains(&i) && to.budget != Budget::Tell);
            let depth = if is_held { DEPTH.to_string() } else { "\"auto\"".into() };
            writeln!(text, "t{i} = {{ remote = true, depth = {depth} }}").unwrap();
            if callback.is_outside {
                let depth =
                    if callback.budget == Budget::Tell { "\"auto\"".into() } else { DEPTH.to_string() };
                writeln!(
                    text,
                    "x{i} = {{ period = \"{}us\", jitter = \"{}us\", min_distance = \"{}us\", depth = {depth} }}",
                    callback.period, callback.jitter, callback.min_distance
                )
                .unwrap();
            }
        }
        for (i, callback) in self.callbacks.iter().enumerate() {
            let Callback { core, period, jitter, min_distance, wcet, bcet, priority, .. } = callback;
            writeln!(text, "[callbacks.c{i}]\nnode = \"n{core}\"\nwcet = \"{wcet}us\"\nbcet = \"{bcet}us\"\ndeadline = \"1s\"").unwrap();
            let topics: Vec<_> = callback.triggers.iter().map(|from| format!("\"t{from}\"")).collect();
            match (topics.is_empty(), callback.is_outside) {
                (false, _) => writeln!(text, "topic = [{}]", topics.join(", ")).unwrap(),
                (true, true) => writeln!(text, "topic = \"x{i}\"").unwrap(),
                (true, false) => writeln!(
                    text,
                    "period = \"{period}us\"\njitter = \"{jitter}us\"\nmin_distance = \"{min_distance}us\""
                )
                .unwrap(),
            }
            match (callback.budget, callback.group) {
                (Budget::Reserved(runtime, period), _) => {
                    writeln!(text, "reservation = {{ runtime = \"{runtime}us\", period = \"{period}us\" }}")
                        .unwrap();
                    if self.floats {
                        writeln!(text, "core = \"any\"").unwrap();
                    }
                }
                (_, Some(group)) => writeln!(text, "priority = {priority}\ngroup = \"g{group}\"").unwrap(),
                _ => writeln!(text, "priority = {priority}\nshares_priority = true").unwrap(),
            }
            match callback.budget {
                Budget::Demote => writeln!(text, "overrun = \"demote\"").unwrap(),
                Budget::Suspend => writeln!(text, "overrun = \"suspend\"").unwrap(),
                _ => {}
            }
            if let Some((_, length)) = callback.lock {
                writeln!(text, "locks = [{{ resource = \"l{core}\", length = \"{length}us\" }}]").unwrap();
            }
            if callback.is_non_preemptive {
                writeln!(text, "non_preemptive = \"{wcet}us\"").unwrap();
            }
            if let Some(from) = callback.reads {
                writeln!(text, "reads = \"t{from}\"").unwrap();
            }
            let also = callback.also.map_or(String::new(), |topic| format!(", \"t{topic}\""));
            writeln!(text, "publishes = [\"t{i}\"{also}]").unwrap();
        }
        for (i, path) in self.chains.iter().enumerate() {
            let path: Vec<_> = path.iter().map(|stage| format!("\"c{stage}\"")).collect();
            writeln!(text, "[[chains]]\nname = \"k{i}\"\npath = [{}]\ndeadline = \"1s\"", path.join(", "))
                .unwrap();
        }
        text
    }
}

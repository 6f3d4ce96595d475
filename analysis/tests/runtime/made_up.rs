// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random systems, as a model and as the file that says the same.

use std::fmt::Write;

use rand::RngExt;
use rand::rngs::StdRng;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Budget {
    Tell,
    Demote,
    /// As demoted, and nothing after that job.
    End,
    Suspend,
    /// Runtime and period.
    Reserved(u64, u64),
}

impl Budget {
    pub fn demotes(self) -> bool {
        matches!(self, Budget::Demote | Budget::End)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    Fifo,
    Any,
    /// The highest rank next, with all others of it that wait then.
    Rank,
    /// As by rank, and the rank is the thread's priority while it runs the callback.
    Lowered,
}

impl Order {
    pub fn has_ranks(self) -> bool {
        matches!(self, Order::Rank | Order::Lowered)
    }
}

/// What a callback that waits for all of its topics takes for a set. Windows in steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Matching {
    Newest,
    Exact,
    Approximate(u64),
    Epsilon(u64),
    LatestTime,
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
    /// If it waits for all of these: what for, and the longest run that only takes a message.
    pub join: Option<(Matching, u64)>,
    pub is_outside: bool,
    pub wcet: u64,
    /// What its budget is, if more than that.
    pub charged: u64,
    pub bcet: u64,
    /// In a group that goes by ranks, that.
    pub priority: u8,
    pub group: Option<usize>,
    pub budget: Budget,
    /// Which locks of its core it holds, one after the other, and for how long.
    pub locks: Vec<(usize, u64)>,
    /// How much of a run nothing preempts.
    pub non_preemptive: u64,
    /// The depth of its queues, if the file states one; otherwise they never overflow.
    pub depth: usize,
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
    /// How the group of each core goes on.
    pub groups: Vec<Order>,
    pub chains: Vec<Vec<usize>>,
    /// Of each host.
    pub per_message: Vec<u64>,
    pub gateway: Vec<u64>,
    /// What a switch costs, and what holds a job to its budget.
    pub switch: u64,
    pub demotion: u64,
    pub tick: Option<(u64, u64)>,
    /// Whether reservations run on any core.
    pub floats: bool,
    /// The period, and how much of it real-time threads may use.
    pub throttling: Option<(u64, u64)>,
    /// For how long each core may stand still.
    pub stall: u64,
    /// What an executor of ROS 2 uses for each job; none on cores of Tautline's nodes.
    pub executors: Vec<Option<u64>>,
    /// Whether executors of rclpy have two nodes, of which each has every other callback.
    pub has_two_nodes: bool,
    pub network: (u64, u64),
    pub is_ceiling: bool,
    /// Who chooses priorities, if the file states none.
    pub policy: Option<&'static str>,
}

/// Whose executors run the callbacks of each core, by turns, if any do.
const CLIENTS: [&str; 2] = ["rclcpp", "rclpy"];
/// The depth of queues that the file states.
const DEPTH: usize = 3;

impl Model {
    pub fn random(rng: &mut StdRng) -> Model {
        let hosts = [vec![0], vec![0, 0], vec![0, 1]][rng.random_range(0..3)].clone();
        let count = rng.random_range(2..=6);
        let load = rng.random_range(0.3..1.1);
        let executor = rng.random_range(0..4);
        let executors: Vec<_> = hosts.iter().map(|_| rng.random_bool(0.15).then_some(executor)).collect();
        let groups = executors.iter().map(|executor| match (executor, rng.random_range(0..10)) {
            (None, 0..7) => Order::Fifo,
            (Some(_), 0..3) => Order::Rank,
            (Some(_), 3..6) => Order::Lowered,
            _ => Order::Any,
        });
        let groups = groups.collect();
        let mut of_hosts = |most: u64| {
            let first = rng.random_range(0..=most * 2).saturating_sub(most);
            vec![first, if rng.random_bool(0.3) { rng.random_range(0..=most) } else { first }]
        };
        let (per_message, gateway) = (of_hosts(2), of_hosts(3));
        let mut model = Model {
            callbacks: Vec::new(),
            groups,
            chains: Vec::new(),
            per_message,
            gateway,
            switch: rng.random_range(0..5) / 3,
            demotion: rng.random_range(0..3),
            tick: rng.random_bool(0.3).then(|| (rng.random_range(20..60), 1)),
            floats: hosts == [0, 0] && rng.random_bool(0.5),
            throttling: rng.random_bool(0.15).then(|| {
                let period = rng.random_range(100..400);
                (period, period * rng.random_range(70..98) / 100)
            }),
            stall: if rng.random_bool(0.15) { rng.random_range(1..150) } else { 0 },
            executors,
            has_two_nodes: rng.random_bool(0.5),
            network: if rng.random_bool(0.5) { (2, 2 + rng.random_range(0..60)) } else { (3, 3) },
            is_ceiling: rng.random_bool(0.5),
            policy: rng
                .random_bool(0.1)
                .then(|| ["rate-monotonic", "deadline-monotonic", "audsley"][rng.random_range(0..3)]),
            hosts,
        };
        for i in 0..count {
            let one = model.callback(i, count, load, rng);
            model.callbacks.push(one);
        }
        for to in 1..count {
            let any = rng.random_range(0..3);
            let before = |i: usize| {
                let Callback { triggers, reads, .. } = &model.callbacks[i];
                triggers.get(any % triggers.len().max(1)).copied().or(*reads)
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
        let waits = i > 1 && rng.random_bool(0.2);
        let triggers = match i {
            _ if waits => {
                let inputs = rng.random_range(2..=i.min(3));
                rand::seq::index::sample(rng, i, inputs).into_vec()
            }
            _ if i == 0 || rng.random_bool(0.55) => Vec::new(),
            _ if i > 1 && rng.random_bool(0.15) => vec![i - 1, i - 2],
            _ => vec![rng.random_range(0..i)],
        };
        // About as much as leaves something for the others.
        let slowest = triggers.iter().map(|from| self.period(*from)).min().unwrap_or(period);
        let share = load * self.hosts.len() as f64 / count as f64;
        let wcet =
            (slowest as f64 * share * rng.random_range(0.2..1.6)).round().clamp(1.0, slowest as f64) as u64;
        let is_ranked = self.groups[core].has_ranks();
        let own = 10 + 3 * ((i as u8 * 7 + rng.random_range(0..7)) % 20);
        let in_group = rng.random_bool(if is_ranked { 0.7 } else { 0.25 });
        let is_outside =
            triggers.is_empty() && rng.random_bool(if is_ranked && in_group { 0.6 } else { 0.4 });
        let join = waits.then(|| {
            let window = rng.random_range(1..=slowest * 2);
            let from_one = triggers.windows(2).all(|pair| self.source(pair[0]) == self.source(pair[1]));
            let matching = match rng.random_range(0..5) {
                _ if from_one && rng.random_bool(0.6) => Matching::Exact,
                0 | 1 => Matching::Newest,
                2 => Matching::Approximate(window),
                3 => Matching::Epsilon(window),
                _ => Matching::LatestTime,
            };
            (matching, rng.random_range(1..=wcet.min(4)))
        });
        let jitter = if triggers.is_empty() && rng.random_bool(0.4) {
            rng.random_range(0..=period * 3 / 2)
        } else {
            0
        };
        let is_single = triggers.len() < 2 && !triggers.iter().any(|from| self.follows_join(*from));
        // One on each core, or as many as there are cores.
        let is_beside = |other: &&Callback| other.core == core || self.floats;
        let reserved = self.callbacks.iter().filter(is_beside);
        let reserved = reserved.filter(|other| matches!(other.budget, Budget::Reserved(..))).count();
        let has_reserved = reserved >= if self.floats { self.hosts.len() } else { 1 };
        let min_distance = if jitter > 0 && rng.random_bool(0.3) { rng.random_range(0..=period) } else { 0 };
        let is_unseen = self.executors[core].is_some() && triggers.is_empty() && !is_outside;
        let budget = match rng.random_range(0..12) {
            _ if is_unseen || waits => Budget::Tell,
            0 => Budget::Demote,
            // rmw_tautline enforces no other, and none of timers, which it does not see.
            _ if self.executors[core].is_some() => Budget::Tell,
            1 => [Budget::Demote, Budget::End][rng.random_range(0..2)],
            2 if is_single => Budget::Suspend,
            3 if is_single && !has_reserved && wcet + 4 < period => {
                Budget::Reserved(wcet + 2 + 2 * self.switch, period.max(100))
            }
            _ => Budget::Tell,
        };
        let group = (budget == Budget::Tell && in_group).then_some(core);
        let may_lock = budget == Budget::Tell || budget.demotes();
        let mut locks = Vec::new();
        if may_lock && rng.random_bool(0.25) {
            let first = rng.random_range(0..2);
            locks.push((first, rng.random_range(1..=wcet)));
            if locks[0].1 < wcet && rng.random_bool(0.3) {
                locks.push((1 - first, rng.random_range(1..=wcet - locks[0].1)));
            }
        }
        let is_stiff = budget == Budget::Tell && group.is_none() && locks.is_empty() && rng.random_bool(0.12);
        let section = if rng.random_bool(0.5) { wcet } else { rng.random_range(1..=wcet) };
        Callback {
            core,
            period,
            jitter,
            min_distance,
            triggers,
            join,
            is_outside,
            wcet,
            charged: 0,
            bcet: rng.random_range(0..=wcet),
            priority: match group {
                Some(core) if self.groups[core] == Order::Lowered => own,
                Some(_) if is_ranked => rng.random_range(1..=4),
                Some(core) => group_priority(core),
                None => own,
            },
            group,
            budget,
            locks,
            non_preemptive: if is_stiff { section } else { 0 },
            depth: if budget == Budget::Tell { usize::MAX } else { DEPTH },
            reads: (i > 0 && rng.random_bool(0.3)).then(|| rng.random_range(0..i)),
            also: (i > 0 && rng.random_bool(0.1)).then(|| rng.random_range(0..i)),
        }
    }

    /// What the system has that others lack.
    pub fn features(&self) -> Vec<&'static str> {
        let has = |what: &dyn Fn(&Callback) -> bool| self.callbacks.iter().any(what);
        let features = [
            ("demotion", has(&|c| c.budget.demotes())),
            ("joins", has(&|c| c.join.is_some())),
            ("ranks", has(&|c| self.is_ranked(c))),
            ("lowered", has(&|c| c.group.is_some_and(|group| self.ceiling(group).is_some()))),
            ("ranks and timers", has(&|c| self.is_ranked(c) && c.triggers.is_empty() && !c.is_outside)),
            ("suspension", has(&|c| c.budget == Budget::Suspend)),
            ("reservations", has(&|c| matches!(c.budget, Budget::Reserved(..)))),
            ("floating", self.floats && has(&|c| matches!(c.budget, Budget::Reserved(..)))),
            ("groups", has(&|c| c.group.is_some())),
            ("locks", has(&|c| !c.locks.is_empty())),
            ("sections", has(&|c| c.non_preemptive > 0)),
            ("several triggers", has(&|c| c.triggers.len() > 1 && c.join.is_none())),
            ("least distances", has(&|c| c.min_distance > 0)),
            ("two hosts", self.hosts.contains(&1)),
            ("switches", self.switch > 0),
            ("gateways", self.gateway.iter().any(|cost| *cost > 0)),
            ("throttling", self.throttling.is_some()),
            ("rclcpp", self.executors.iter().any(Option::is_some)),
        ];
        features.into_iter().filter(|(_, has)| *has).map(|(name, _)| name).collect()
    }

    fn is_ranked(&self, callback: &Callback) -> bool {
        callback.group.is_some_and(|group| self.groups[group].has_ranks())
    }

    /// The priority at which the thread of a group waits, if it has those of its callbacks, of which timers have none.
    pub fn ceiling(&self, group: usize) -> Option<u8> {
        let is_message = |callback: &&Callback| {
            callback.group == Some(group) && (callback.is_outside || !callback.triggers.is_empty())
        };
        let members = self.callbacks.iter().filter(is_message).map(|callback| callback.priority);
        members.max().filter(|_| self.groups[group] == Order::Lowered)
    }

    /// Whether a callback is of the second node of an executor of rclpy.
    pub fn is_of_second_node(&self, i: usize) -> bool {
        let core = self.callbacks[i].core;
        self.has_two_nodes && self.executors[core].is_some() && CLIENTS[core % 2] == "rclpy" && i % 2 == 1
    }

    /// The shortest period with which a callback is released.
    pub fn period(&self, i: usize) -> u64 {
        let Callback { period, triggers, .. } = &self.callbacks[i];
        triggers.iter().map(|from| self.period(*from)).min().unwrap_or(*period)
    }

    /// Whose releases those of a callback are in the end; `None` if it has several.
    fn source(&self, i: usize) -> Option<usize> {
        match self.callbacks[i].triggers[..] {
            [] => Some(i),
            [from] => self.source(from),
            _ => None,
        }
    }

    fn follows_join(&self, i: usize) -> bool {
        let Callback { triggers, join, .. } = &self.callbacks[i];
        join.is_some() || triggers.iter().any(|from| self.follows_join(*from))
    }

    /// The ways by which releases reach a callback, each by a number of its own.
    pub fn ways(&self, i: usize) -> Vec<u64> {
        if self.callbacks[i].triggers.is_empty() || self.callbacks[i].join.is_some() {
            return vec![i as u64];
        }
        self.taken(i)
    }

    /// The ways of the messages that it takes.
    pub fn taken(&self, i: usize) -> Vec<u64> {
        let topics = self.callbacks[i].triggers.iter();
        let of = |topic: &usize| -> Vec<u64> {
            let publishers = self.publishers(*topic);
            let ways = publishers.flat_map(|from| self.ways(from).into_iter().map(move |way| (from, way)));
            ways.map(|(from, way)| longer(way, from, *topic)).collect()
        };
        topics.flat_map(of).collect()
    }

    /// A callback, and all before it.
    pub fn upstream(&self, i: usize) -> Vec<usize> {
        let (mut found, mut next) = (vec![i], 0);
        while let Some(&i) = found.get(next) {
            next += 1;
            for from in self.callbacks[i].triggers.iter().flat_map(|topic| self.publishers(*topic)) {
                if !found.contains(&from) {
                    found.push(from);
                }
            }
        }
        found
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
        let protocol = if self.is_ceiling { "ceiling" } else { "inheritance" };
        let policy = self.policy.unwrap_or("rate-monotonic");
        writeln!(text, "[priorities]\nlocks = \"{protocol}\"\npolicy = \"{policy}\"").unwrap();
        let costs = |host: usize| {
            format!("per_message = \"{}us\"\ngateway = \"{}us\"", self.per_message[host], self.gateway[host])
        };
        if self.hosts.contains(&1) && costs(0) != costs(1) {
            writeln!(text, "[hosts.h1.overheads]\n{}", costs(1)).unwrap();
        }
        let executor = self.executors.iter().flatten().next().unwrap_or(&0);
        writeln!(text, "[overheads]\n{}", costs(0)).unwrap();
        writeln!(text, "context_switch = \"{}us\"\ndemotion = \"{}us\"", self.switch, self.demotion).unwrap();
        CLIENTS.iter().for_each(|client| writeln!(text, "{client} = \"{executor}us\"").unwrap());
        if let Some((period, runtime)) = self.throttling {
            writeln!(text, "throttling = {{ period = \"{period}us\", runtime = \"{runtime}us\" }}").unwrap();
        }
        if let Some((period, wcet)) = self.tick {
            writeln!(text, "tick = {{ period = \"{period}us\", wcet = \"{wcet}us\" }}").unwrap();
        }
        for (core, host) in self.hosts.iter().enumerate() {
            let number = self.hosts[..core].iter().filter(|other| *other == host).count();
            for node in &["n", "second"][..if self.has_two_nodes { 2 } else { 1 }] {
                writeln!(text, "[nodes.{node}{core}]\nhost = \"h{host}\"\ncore = {number}").unwrap();
                if self.executors[core].is_some() {
                    writeln!(text, "client = \"{}\"", CLIENTS[core % 2]).unwrap();
                }
            }
        }
        for (group, order) in self.groups.iter().enumerate() {
            if self.callbacks.iter().any(|callback| callback.group == Some(group)) {
                writeln!(text, "[groups.g{group}]").unwrap();
                match order {
                    Order::Fifo => writeln!(text, "order = \"fifo\"").unwrap(),
                    Order::Any => writeln!(text, "order = \"any\"").unwrap(),
                    Order::Lowered if self.ceiling(group).is_some() => {
                        writeln!(text, "order = \"priority\"\nthread_priority = \"callback\"").unwrap();
                    }
                    Order::Rank | Order::Lowered => {
                        writeln!(text, "order = \"priority\"\npriority = {}", group_priority(group)).unwrap();
                    }
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
            let node = if self.is_of_second_node(i) { "second" } else { "n" };
            writeln!(text, "[callbacks.c{i}]\nnode = \"{node}{core}\"\nwcet = \"{wcet}us\"\nbcet = \"{bcet}us\"\ndeadline = \"1s\"").unwrap();
            let topics: Vec<_> = callback.triggers.iter().map(|from| format!("\"t{from}\"")).collect();
            match (topics.is_empty(), callback.is_outside) {
                (false, _) if callback.join.is_some() => {
                    writeln!(text, "all = [{}]", topics.join(", ")).unwrap();
                }
                (false, _) => writeln!(text, "topic = [{}]", topics.join(", ")).unwrap(),
                (true, true) => writeln!(text, "topic = \"x{i}\"").unwrap(),
                (true, false) => writeln!(
                    text,
                    "period = \"{period}us\"\njitter = \"{jitter}us\"\nmin_distance = \"{min_distance}us\""
                )
                .unwrap(),
            }
            if let Some((matching, take)) = callback.join {
                writeln!(text, "take = \"{take}us\"").unwrap();
                match matching {
                    Matching::Newest => {}
                    Matching::Exact => writeln!(text, "window = \"0ms\"").unwrap(),
                    Matching::Approximate(window) => writeln!(text, "window = \"{window}us\"").unwrap(),
                    Matching::Epsilon(window) => {
                        writeln!(text, "window = \"{window}us\"\npolicy = \"approximate_epsilon_time\"")
                            .unwrap();
                    }
                    Matching::LatestTime => writeln!(text, "policy = \"latest_time\"").unwrap(),
                }
            }
            let is_timer = callback.triggers.is_empty() && !callback.is_outside;
            let has_priority = if self.is_ranked(callback) { !is_timer } else { self.policy.is_none() };
            match (callback.budget, callback.group) {
                (Budget::Reserved(runtime, period), _) => {
                    writeln!(text, "reservation = {{ runtime = \"{runtime}us\", period = \"{period}us\" }}")
                        .unwrap();
                    if self.floats {
                        writeln!(text, "core = \"any\"").unwrap();
                    }
                }
                (_, Some(group)) if has_priority => {
                    writeln!(text, "priority = {priority}\ngroup = \"g{group}\"").unwrap();
                }
                (_, Some(group)) => writeln!(text, "group = \"g{group}\"").unwrap(),
                _ if self.policy.is_some() => {}
                _ => writeln!(text, "priority = {priority}\nshares_priority = true").unwrap(),
            }
            if callback.group.is_some() {
                writeln!(text, "shares_priority = true").unwrap();
            }
            match callback.budget {
                Budget::Demote => writeln!(text, "overrun = \"demote\"").unwrap(),
                Budget::End => writeln!(text, "overrun = \"end\"").unwrap(),
                Budget::Suspend => writeln!(text, "overrun = \"suspend\"").unwrap(),
                _ => {}
            }
            let lock = |(lock, length): &(usize, u64)| {
                format!("{{ resource = \"l{core}_{lock}\", length = \"{length}us\" }}")
            };
            let locks: Vec<_> = callback.locks.iter().map(lock).collect();
            writeln!(text, "locks = [{}]", locks.join(", ")).unwrap();
            if callback.non_preemptive > 0 {
                writeln!(text, "non_preemptive = \"{}us\"", callback.non_preemptive).unwrap();
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

/// The priority of a core's group, which callbacks with threads of their own may share.
pub const fn group_priority(core: usize) -> u8 {
    13 + 3 * core as u8
}

/// The way from a way's callback on, by its topic.
pub const fn longer(way: u64, from: usize, topic: usize) -> u64 {
    way.wrapping_mul(1_000_003).wrapping_add(from as u64 * 64 + topic as u64 + 1)
}

/// The age penalty of a join with a window, which no file states.
pub const fn age_penalty(window: u64) -> f64 {
    [0.1, 0.0, 0.1, 1.5][window as usize % 4]
}

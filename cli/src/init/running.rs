// SPDX-License-Identifier: MIT OR Apache-2.0
//! Describes a recording as a system file: the callbacks that ran, each with the topics that its thread published meanwhile. Of timers of
//! ROS's client libraries only publications are seen: those of a thread that waits in the RMW, between its wake and its first take.

use crate::trace::messages::{Run, runs};
use crate::trace::recording::{Process, Recording, TimedEvent};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt::Write;
use tautline_rt::{self as rt, Policy, ThreadInfo};
use tautline_trace::{EventKind, ObjectId, ObjectKind};

pub struct Described {
    pub text: String,
    pub callbacks: usize,
    /// Values that were not stated but measured or assumed.
    pub guesses: usize,
}

struct Callback {
    key: String,
    node: String,
    process: u32,
    tid: u32,
    /// Its subscription, or the first of several of its topic.
    source: ObjectId,
    trigger: Trigger,
    runs: usize,
    longest_ns: u64,
    /// Whether `longest_ns` is processor time.
    is_exact: bool,
    publishes: BTreeSet<String>,
}

#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Trigger {
    Timer(u64),
    /// A timer of a ROS client library, with the mean distance of its publications.
    Unseen(u64),
    Topic(String),
    /// Neither a timer nor a subscription, such as a stream of the program's own.
    Unknown,
}

/// Topics that ROS's client libraries publish by themselves.
const OF_EVERY_NODE: [&str; 2] = ["/rosout", "/parameter_events"];

/// Threads by process and thread id.
type Threads = HashMap<(u32, u32), ThreadInfo>;

/// How often a topic is published that no callback publishes.
struct Rate {
    messages: usize,
    /// Mean distance and greatest deviation from that; `None` with fewer than three messages.
    regular: Option<(u64, u64)>,
}

/// Drops processes that have ended: a recorder also fetches what killed processes left.
pub fn of_those_that_run(mut recording: Recording) -> Recording {
    recording.processes.retain(|_, process| !process.has_ended);
    recording.events.retain(|timed| recording.processes.contains_key(&timed.process));
    recording
}

/// `overheads` are lines of `[overheads]`, each with where its value comes from; `priorities` are those with which threads take messages, by
/// process and thread.
pub fn describe(
    recording: &Recording,
    overheads: &[(String, String)],
    priorities: &HashMap<(u32, u32), u8>,
) -> Described {
    let threads = threads(recording, priorities);
    let callbacks = callbacks(recording, &threads);
    let mut file = File { text: String::new(), guesses: 0 };
    file.head(recording, &threads, overheads);
    file.nodes(recording, &callbacks);
    file.topics(&rates(recording, &callbacks));
    let placed: Vec<_> =
        callbacks.iter().map(|callback| threads.get(&(callback.process, callback.tid))).collect();
    let groups = file.groups(recording, &callbacks, &placed);
    for (index, callback) in callbacks.iter().enumerate() {
        let shares = || {
            let others = callbacks.iter().zip(&placed).filter(|(other, _)| other.tid != callback.tid);
            let own = placed[index].map(|thread| (thread.policy, core_of(thread).0));
            others
                .into_iter()
                .any(|(_, thread)| own.is_some() && thread.map(|t| (t.policy, core_of(t).0)) == own)
        };
        let group = groups.get(&(callback.process, callback.tid)).map(String::as_str);
        file.callback(callback, placed[index], group, shares());
    }
    let count = callbacks.iter().filter(|callback| callback.trigger != Trigger::Unknown).count();
    Described { text: file.text, callbacks: count, guesses: file.guesses }
}

/// The callbacks: one for each node, thread, and topic or timer.
fn callbacks(recording: &Recording, threads: &Threads) -> Vec<Callback> {
    let mut found: BTreeMap<(String, Trigger, u32, u32), Callback> = BTreeMap::new();
    let runs = runs(recording);
    let used_ns = used(&runs, threads);
    let mut open: HashMap<(u32, u32), Vec<&Run>> = HashMap::new();
    runs.iter().for_each(|run| open.entry((run.process, run.tid)).or_default().push(run));
    let mut published: HashMap<(u32, u32, u64), BTreeSet<&str>> = HashMap::new();
    for timed in recording.events.iter().filter(|timed| timed.event.kind == EventKind::Publish) {
        let Some(topic) = recording.object(timed.process, timed.event.object) else { continue };
        if let Some(run) = run_at(&open, timed.process, timed.tid, timed.event.time_ns) {
            published.entry((run.process, run.tid, run.start_ns)).or_default().insert(&topic.name);
        }
    }
    for (run, used_ns) in runs.iter().zip(used_ns) {
        let Some(callback) = recording.object(run.process, run.callback) else { continue };
        let source = recording.object(run.process, callback.parent);
        let trigger = match source.map(|source| (source.kind, source.detail, &source.name)) {
            Some((ObjectKind::Timer, period_ns, _)) if period_ns > 0 => Trigger::Timer(period_ns),
            Some((ObjectKind::Subscription, _, topic)) => Trigger::Topic(topic.clone()),
            _ => Trigger::Unknown,
        };
        let node = source.and_then(|source| node_of(recording, run.process, source.parent));
        // An RMW without a system file names a callback `/node /topic`.
        let node = node.or_else(|| callback.name.split_once(" /").map(|(node, _)| node.to_owned()));
        let node = node.unwrap_or_else(|| format!("process_{}", pid(recording, run.process)));
        let place = (node.clone(), trigger.clone(), run.process, run.tid);
        let one = found.entry(place).or_insert_with(|| Callback {
            key: key(&callback.name),
            node,
            process: run.process,
            tid: run.tid,
            source: callback.parent,
            trigger,
            runs: 0,
            longest_ns: 0,
            is_exact: true,
            publishes: BTreeSet::new(),
        });
        one.runs += 1;
        one.longest_ns = one.longest_ns.max(used_ns);
        one.is_exact &= run.used_ns.is_some() || run.end_ns.is_none();
        let topics = published.get(&(run.process, run.tid, run.start_ns)).into_iter().flatten();
        one.publishes.extend(topics.map(|topic| (*topic).to_owned()));
    }
    let mut callbacks: Vec<_> = found.into_values().chain(unseen_timers(recording, &open)).collect();
    let mut taken = BTreeSet::new();
    for callback in &mut callbacks {
        let names =
            (1..).map(|n: u32| if n == 1 { callback.key.clone() } else { format!("{}_{n}", callback.key) });
        let free = names.into_iter().find(|name| !taken.contains(name));
        callback.key = free.unwrap_or_default();
        taken.insert(callback.key.clone());
    }
    callbacks
}

/// The nodes whose executor has several threads, by those that run a callback of one subscription, and the nodes that share a thread with them.
fn multi_threaded(callbacks: &[Callback]) -> BTreeSet<&str> {
    let is_same = |one: &Callback, other: &Callback| {
        (one.process, one.source) == (other.process, other.source) && one.tid != other.tid
    };
    let of_topics = || callbacks.iter().filter(|callback| matches!(callback.trigger, Trigger::Topic(_)));
    let several = of_topics().filter(|one| of_topics().any(|other| is_same(one, other)));
    let mut nodes: BTreeSet<&str> = several.map(|callback| callback.node.as_str()).collect();
    loop {
        let of_nodes = callbacks.iter().filter(|callback| nodes.contains(callback.node.as_str()));
        let threads: BTreeSet<_> = of_nodes.map(|callback| (callback.process, callback.tid)).collect();
        let beside = callbacks.iter().filter(|callback| threads.contains(&(callback.process, callback.tid)));
        let all: BTreeSet<_> = beside.map(|callback| callback.node.as_str()).collect();
        if all.len() == nodes.len() {
            return nodes;
        }
        nodes = all;
    }
}

/// What a thread of a ROS executor did between its wake and its first take.
struct Round {
    woken_ns: u64,
    ends_ns: u64,
    /// The publications: time, topic and node.
    published: Vec<(u64, String, String)>,
}

/// The timers of ROS's client libraries, whose executors run timers before they take anything.
fn unseen_timers(recording: &Recording, runs: &HashMap<(u32, u32), Vec<&Run>>) -> Vec<Callback> {
    let mut rounds: BTreeMap<(u32, u32), Vec<Round>> = BTreeMap::new();
    for timed in &recording.events {
        let (place, time_ns) = ((timed.process, timed.tid), timed.event.time_ns);
        let object = recording.object(timed.process, timed.event.object);
        let is_rmw = object.is_some_and(|object| object.name == "rmw_wait");
        match timed.event.kind {
            EventKind::SpinWake | EventKind::SpinTimeout if is_rmw => {
                let round = Round { woken_ns: time_ns, ends_ns: u64::MAX, published: Vec::new() };
                rounds.entry(place).or_default().push(round);
            }
            EventKind::Publish if run_at(runs, timed.process, timed.tid, time_ns).is_none() => {
                let node = object.and_then(|topic| node_of(recording, timed.process, topic.parent));
                let round = rounds.get_mut(&place).and_then(|rounds| rounds.last_mut());
                if let (Some(topic), Some(node), Some(round)) = (object, node, round)
                    && round.ends_ns == u64::MAX
                    && !OF_EVERY_NODE.contains(&&*topic.name)
                {
                    round.published.push((time_ns, topic.name.clone(), node));
                }
            }
            EventKind::CallbackStart | EventKind::SpinStart => {
                if let Some(round) = rounds.get_mut(&place).and_then(|rounds| rounds.last_mut()) {
                    round.ends_ns = round.ends_ns.min(time_ns);
                }
            }
            _ => {}
        }
    }
    rounds.into_iter().flat_map(|((process, tid), rounds)| timers_of_thread(process, tid, &rounds)).collect()
}

/// A timer, identified by the rounds in which it published.
struct Timer<'r> {
    node: &'r str,
    rounds: Vec<usize>,
    period_ns: u64,
    publishes: BTreeSet<String>,
}

/// The timers of a thread. Topics that a node always publishes in the same rounds belong to one timer.
fn timers_of_thread(process: u32, tid: u32, rounds: &[Round]) -> Vec<Callback> {
    // For each topic of a node, the rounds in which it was published, each with the time of the first publication.
    let mut topics: BTreeMap<(&str, &str), BTreeMap<usize, u64>> = BTreeMap::new();
    for (index, round) in rounds.iter().enumerate().filter(|(_, round)| round.ends_ns != u64::MAX) {
        for (time_ns, topic, node) in &round.published {
            topics.entry((node, topic)).or_default().entry(index).or_insert(*time_ns);
        }
    }
    let mut timers: Vec<Timer<'_>> = Vec::new();
    for ((node, topic), seen) in topics {
        let times: Vec<u64> = seen.values().copied().collect();
        let Some((period_ns, deviation_ns)) = rate(&times).regular else { continue };
        if deviation_ns > period_ns / 2 {
            continue;
        }
        let (rounds, publishes) = (seen.into_keys().collect(), BTreeSet::from([topic.to_owned()]));
        match timers.iter_mut().find(|timer| timer.node == node && timer.rounds == rounds) {
            Some(timer) => timer.publishes.extend(publishes),
            None => timers.push(Timer { node, rounds, period_ns, publishes }),
        }
    }
    let described = |timer: Timer<'_>| {
        let length_ns = |index: &usize| rounds[*index].ends_ns.saturating_sub(rounds[*index].woken_ns);
        let first = timer.publishes.first().map_or("", String::as_str);
        Callback {
            key: key(&format!("{} {first} timer", timer.node)),
            node: timer.node.to_owned(),
            process,
            tid,
            source: ObjectId::NONE,
            trigger: Trigger::Unseen(timer.period_ns),
            runs: timer.rounds.len(),
            longest_ns: timer.rounds.iter().map(length_ns).max().unwrap_or(0),
            is_exact: false,
            publishes: timer.publishes,
        }
    };
    timers.into_iter().map(described).collect()
}

/// The run of a thread's callback at this time.
fn run_at<'r>(
    runs: &HashMap<(u32, u32), Vec<&'r Run>>,
    process: u32,
    tid: u32,
    time_ns: u64,
) -> Option<&'r Run> {
    let of_thread = runs.get(&(process, tid))?;
    let before = of_thread.partition_point(|run| run.start_ns <= time_ns);
    let run = of_thread.get(before.checked_sub(1)?)?;
    run.end_ns.is_none_or(|end_ns| time_ns <= end_ns).then_some(run)
}

fn node_of(recording: &Recording, process: u32, id: ObjectId) -> Option<String> {
    let node = recording.object(process, id).filter(|object| object.kind == ObjectKind::Node)?;
    Some(node.name.clone())
}

fn pid(recording: &Recording, process: u32) -> u32 {
    recording.processes.get(&process).map_or(0, |of| of.pid)
}

/// The name as a TOML key that needs no quotes.
fn key(name: &str) -> String {
    let letters = name.chars().map(|c| if c.is_ascii_alphanumeric() || "_-".contains(c) { c } else { '_' });
    let key: String = letters.collect();
    let key = key.trim_matches('_').to_owned();
    if key.is_empty() { "callback".to_owned() } else { key }
}

/// The threads of the recorded processes, as far as they still exist.
fn threads(recording: &Recording, priorities: &HashMap<(u32, u32), u8>) -> Threads {
    let of = |(process, of): (&u32, &Process)| {
        let threads = rt::threads_of(of.pid).unwrap_or_default();
        let waiting = |thread: ThreadInfo| {
            let stated = priorities.get(&(of.pid, thread.tid)).copied();
            ThreadInfo { policy: waiting_policy(thread.policy, stated), ..thread }
        };
        threads.into_iter().map(waiting).map(|thread| ((*process, thread.tid), thread)).collect::<Vec<_>>()
    };
    recording.processes.iter().flat_map(of).collect()
}

/// The policy with which a thread takes messages at a stated priority: it may run a callback below that just now.
fn waiting_policy(now: Policy, stated: Option<u8>) -> Policy {
    match (now, stated) {
        (Policy::Fifo(now), Some(stated)) if stated < Policy::RESERVATION => Policy::Fifo(stated.max(now)),
        _ => now,
    }
}

/// The processor time of each run. If it was not measured, it is the time from start to end without the time of runs that preempted it:
/// those that lie within it on the only core of both threads.
fn used(runs: &[Run], threads: &Threads) -> Vec<u64> {
    let mut used: Vec<u64> =
        runs.iter().map(|run| run.end_ns.map_or(0, |end_ns| end_ns.saturating_sub(run.start_ns))).collect();
    // For each core, the runs that have begun and may not have ended, the inner ones last.
    let mut open: HashMap<usize, Vec<usize>> = HashMap::new();
    for (index, run) in runs.iter().enumerate() {
        let core = threads.get(&(run.process, run.tid)).map(core_of);
        let (Some((core, false)), Some(end_ns)) = (core, run.end_ns) else { continue };
        let outer = open.entry(core).or_default();
        outer.retain(|outer| runs[*outer].end_ns.is_some_and(|outer_ns| outer_ns >= end_ns));
        if let Some(outer) = outer.last() {
            used[*outer] = used[*outer].saturating_sub(end_ns.saturating_sub(run.start_ns));
        }
        outer.push(index);
    }
    used.iter_mut().zip(runs).for_each(|(used_ns, run)| *used_ns = run.used_ns.unwrap_or(*used_ns));
    used
}

/// The rate of each topic that triggers a callback and that no callback publishes: of its publications, or of its takes if it has none.
fn rates(recording: &Recording, callbacks: &[Callback]) -> BTreeMap<String, Rate> {
    let by_callbacks: BTreeSet<_> = callbacks.iter().flat_map(|callback| &callback.publishes).collect();
    let wanted: BTreeSet<_> = callbacks
        .iter()
        .filter_map(|callback| match &callback.trigger {
            Trigger::Topic(topic) => Some(topic),
            _ => None,
        })
        .filter(|topic| !by_callbacks.contains(topic))
        .collect();
    let mut published: BTreeMap<&str, Vec<u64>> = BTreeMap::new();
    let mut taken: BTreeMap<(&str, u32, ObjectId), Vec<u64>> = BTreeMap::new();
    for TimedEvent { process, event, .. } in &recording.events {
        let object = recording.object(*process, event.object).filter(|object| wanted.contains(&object.name));
        let Some(object) = object else { continue };
        let times = match event.kind {
            EventKind::Publish => published.entry(&object.name).or_default(),
            EventKind::Take => taken.entry((&object.name, *process, event.object)).or_default(),
            _ => continue,
        };
        times.push(event.time_ns);
    }
    // Each subscription takes every message: the one that took most stands for the topic.
    let mut times: BTreeMap<&str, Vec<u64>> = BTreeMap::new();
    for ((topic, ..), taken) in taken {
        let most = times.entry(topic).or_default();
        if taken.len() > most.len() {
            *most = taken;
        }
    }
    times.extend(published);
    times.into_iter().map(|(topic, times)| (topic.to_owned(), rate(&times))).collect()
}

fn rate(times: &[u64]) -> Rate {
    let regular = || {
        let (first, last) = (*times.first()?, *times.last()?);
        let period = (last - first).checked_div(times.len() as u64 - 1).filter(|period| *period > 0)?;
        let late = times
            .iter()
            .enumerate()
            .map(|(n, at)| i128::from(*at) - i128::from(first) - n as i128 * i128::from(period));
        let (least, most) = late.fold((0, 0), |(least, most), late| (late.min(least), late.max(most)));
        Some((period, u64::try_from(most - least).unwrap_or(u64::MAX)))
    };
    Rate { messages: times.len(), regular: if times.len() > 2 { regular() } else { None } }
}

/// The core of a thread, and whether it may run on others, too.
fn core_of(thread: &ThreadInfo) -> (usize, bool) {
    (thread.cores.iter().next().unwrap_or(0), thread.cores.len() > 1)
}

/// A time in the largest unit in which it is a whole number.
fn time(ns: u64) -> String {
    match ns {
        _ if ns.is_multiple_of(1_000_000) => format!("{}ms", ns / 1_000_000),
        _ if ns.is_multiple_of(1_000) => format!("{}us", ns / 1_000),
        _ => format!("{ns}ns"),
    }
}

/// Rounds to three significant digits.
fn rounded(ns: u64) -> u64 {
    let unit = 10_u64.pow(ns.max(100).ilog10().saturating_sub(2));
    (ns + unit / 2) / unit * unit
}

/// Rounds up to two significant digits.
fn rounded_up(ns: u64) -> u64 {
    let unit = 10_u64.pow(ns.max(1_000).ilog10().saturating_sub(1));
    ns.max(1).next_multiple_of(unit)
}

struct File {
    text: String,
    guesses: usize,
}

impl File {
    /// Writes a line; `why` is the reason why its value is a guess.
    fn guess(&mut self, line: &str, why: &str) {
        self.guesses += 1;
        let _ = writeln!(self.text, "{line:<28} # guess: {why}");
    }

    fn line(&mut self, line: &str) {
        let _ = writeln!(self.text, "{line}");
    }

    fn head(&mut self, recording: &Recording, threads: &Threads, overheads: &[(String, String)]) {
        let events = recording.events.iter().map(|timed| timed.event.time_ns);
        let seconds =
            events.clone().max().unwrap_or(0).saturating_sub(events.min().unwrap_or(0)) as f64 / 1e9;
        self.line(&format!("# What ran for {seconds:.1} s, by `taut init`. All keys: docs/system-toml.md"));
        self.line("# A `guess` is a value that nobody stated: replace it by what must hold, then run `taut check`.\n");
        let host = key(&rt::host::name());
        self.line(&format!("version = {}\n", tautline_analysis::file::version::CURRENT));
        self.line(&format!("[hosts.{host}]"));
        let cores = rt::CoreSet::allowed().map_or(1, |cores| cores.iter().last().map_or(1, |last| last + 1));
        self.line(&format!("cores = {cores}"));
        let samplers = threads.values().filter(|thread| thread.name == "sampler");
        let lowest = samplers.filter_map(|thread| fifo(thread.policy)).min();
        if let Some(priority) = lowest.filter(|priority| *priority != 90) {
            self.line(&format!("sampler_priority = {priority}"));
        }
        self.line("\n[overheads]");
        self.guess("context_switch = \"2us\"", "of a common machine");
        self.guess("per_message = \"20us\"", "`taut demo` measures it");
        overheads.iter().for_each(|(line, source)| self.guess(line, source));
    }

    fn nodes(&mut self, recording: &Recording, callbacks: &[Callback]) {
        let nodes: BTreeMap<_, _> =
            callbacks.iter().map(|callback| (&callback.node, callback.process)).collect();
        let several = multi_threaded(callbacks);
        for (node, process) in nodes {
            self.line(&format!("\n[nodes.{}]", node_key(node)));
            let of_ros = recording.processes.get(&process).is_some_and(|of| {
                of.objects
                    .values()
                    .any(|object| object.kind == ObjectKind::Sampler && object.name == "rmw_wait")
            });
            if of_ros {
                let exe =
                    std::fs::read_link(format!("/proc/{}/exe", pid(recording, process))).unwrap_or_default();
                let name = exe.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let client = if name.starts_with("python") { "rclpy" } else { "rclcpp" };
                self.line(&format!("client = \"{client}\""));
                if several.contains(node.as_str()) {
                    self.guess(
                        "executor = \"multi-threaded\"",
                        "several threads ran a callback of its executor",
                    );
                }
            }
        }
    }

    fn topics(&mut self, rates: &BTreeMap<String, Rate>) {
        for (topic, Rate { messages, regular }) in rates {
            self.line(&format!("\n[topics.\"{topic}\"]"));
            match regular {
                Some((period, jitter)) => {
                    self.guess(
                        &format!("period = \"{}\"", time(*period)),
                        &format!("the mean of {messages} messages"),
                    );
                    self.guess(
                        &format!("jitter = \"{}\"", time(rounded_up(*jitter))),
                        "as late as one of them was",
                    );
                }
                None => self.guess("period = \"1s\"", &format!("only {messages} messages were seen")),
            }
        }
    }

    /// Writes the threads with several callbacks as groups. Returns the groups' names.
    fn groups(
        &mut self,
        recording: &Recording,
        callbacks: &[Callback],
        placed: &[Option<&ThreadInfo>],
    ) -> HashMap<(u32, u32), String> {
        let mut groups = HashMap::new();
        for (callback, thread) in callbacks.iter().zip(placed) {
            let place = (callback.process, callback.tid);
            let of_thread = callbacks.iter().filter(|other| (other.process, other.tid) == place);
            let count = of_thread.filter(|other| other.trigger != Trigger::Unknown).count();
            if count < 2 || groups.contains_key(&place) {
                continue;
            }
            let thread_name = recording.thread_name(callback.process, callback.tid);
            let name = key(thread_name.strip_prefix("cb:").unwrap_or(&thread_name));
            let name = if groups.values().any(|group| *group == name) {
                format!("{name}_{}", callback.tid)
            } else {
                name
            };
            self.line(&format!("\n# A thread with several callbacks.\n[groups.{name}]"));
            if let Some(priority) = thread.and_then(|thread| fifo(thread.policy)) {
                self.line(&format!("priority = {priority}"));
            }
            groups.insert(place, name);
        }
        groups
    }

    fn callback(
        &mut self,
        callback: &Callback,
        thread: Option<&ThreadInfo>,
        group: Option<&str>,
        shares: bool,
    ) {
        let Callback { key, node, trigger, runs, longest_ns, is_exact, publishes, .. } = callback;
        if *trigger == Trigger::Unknown {
            self.line(&format!(
                "\n# {key} of {node} ran {runs} times for neither a topic nor a timer: it is not described."
            ));
            return;
        }
        self.line(&format!("\n[callbacks.{key}]\nnode = {:?}", node_name(node)));
        match trigger {
            Trigger::Timer(period_ns) => self.line(&format!("period = \"{}\"", time(*period_ns))),
            Trigger::Unseen(period_ns) => self.guess(
                &format!("period = \"{}\"", time(rounded(*period_ns))),
                "a timer, by the mean distance of what it published",
            ),
            Trigger::Topic(topic) => self.line(&format!("topic = {topic:?}")),
            Trigger::Unknown => {}
        }
        let wcet = format!("wcet = \"{}\"", time(rounded_up(*longest_ns)));
        let of = if *is_exact { "processor time" } else { "time from start to end" };
        self.guess(&wcet, &format!("the longest {of} of {runs} runs"));
        let reservation = thread.filter(|_| group.is_none()).and_then(|thread| match thread.policy {
            Policy::Deadline { runtime_ns, period_ns } => Some((time(runtime_ns), time(period_ns))),
            _ => None,
        });
        match thread.map(core_of) {
            Some((core, false)) => self.line(&format!("core = {core}")),
            Some((_, true)) if reservation.is_some() => self.line("core = \"any\""),
            Some((core, true)) => self.guess(&format!("core = {core}"), "its thread may run on others, too"),
            None => self.guess("core = 0", "its thread has ended"),
        }
        let priority = thread.and_then(|thread| fifo(thread.policy));
        match (group, priority, reservation) {
            (Some(group), ..) => self.line(&format!("group = {group:?}")),
            (None, Some(priority), _) => self.line(&format!("priority = {priority}")),
            (None, None, Some((runtime, period))) => {
                self.line(&format!("reservation = {{ runtime = \"{runtime}\", period = \"{period}\" }}"))
            }
            (None, None, None) => self.line("# It has no real-time priority: [priorities] chooses one."),
        }
        if shares && priority.is_some() {
            self.line("shares_priority = true       # with another thread of its core");
        }
        if !publishes.is_empty() {
            let topics: Vec<_> = publishes.iter().map(|topic| format!("{topic:?}")).collect();
            self.line(&format!("publishes = [{}]", topics.join(", ")));
        }
    }
}

fn fifo(policy: Policy) -> Option<u8> {
    match policy {
        Policy::Fifo(priority) => Some(priority),
        _ => None,
    }
}

/// The node's name as callbacks state it: without the slash if it is in the root namespace.
fn node_name(node: &str) -> &str {
    node.strip_prefix('/').filter(|short| !short.contains('/')).unwrap_or(node)
}

fn node_key(node: &str) -> String {
    let name = node_name(node);
    if key(name) == name { name.to_owned() } else { format!("{name:?}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_trace::{Description, Event};

    /// Its publisher is not recorded.
    #[test]
    fn a_topic_that_two_subscriptions_take_has_the_rate_of_one() {
        let mut recording = Recording::default();
        let (id, parent) = (ObjectId(7), ObjectId::NONE);
        for process in [1, 2] {
            let (kind, name) = (ObjectKind::Subscription, "/imu".to_owned());
            let object = Description { id, kind, parent, detail: 0, gid: [0; 2], created_ns: 0, name };
            recording.process(process).objects.insert(id, object);
            for number in 0..10 {
                let (time_ns, kind) = (1000 * number + 100 * u64::from(process), EventKind::Take);
                let event = Event { time_ns, kind, object: id, arguments: [number, 0, 9] };
                recording.events.push(TimedEvent { process, tid: process, event });
            }
        }
        recording.finish();
        let callback = Callback {
            key: String::new(),
            node: String::new(),
            process: 1,
            tid: 1,
            source: id,
            trigger: Trigger::Topic("/imu".to_owned()),
            runs: 10,
            longest_ns: 1,
            is_exact: true,
            publishes: BTreeSet::new(),
        };
        let rate = &rates(&recording, &[callback])["/imu"];
        assert_eq!((rate.messages, rate.regular), (10, Some((1000, 0))));
    }

    #[test]
    fn a_thread_has_the_priority_with_which_it_waits() {
        let other = Policy::Other { nice: 0 };
        assert_eq!(waiting_policy(Policy::Fifo(20), Some(42)), Policy::Fifo(42));
        assert_eq!(waiting_policy(Policy::Fifo(20), None), Policy::Fifo(20));
        assert_eq!(waiting_policy(other, Some(42)), other);
    }

    /// `/lidar` and `/map` are in one executor; `/radar` has two subscriptions of one topic, each in an executor of its own.
    #[test]
    fn one_subscription_in_several_threads_shows_a_multi_threaded_executor() {
        let of = |node: &str, source: u64, tid: u32| Callback {
            key: String::new(),
            node: node.to_owned(),
            process: 1,
            tid,
            source: ObjectId(source),
            trigger: Trigger::Topic("/scan".to_owned()),
            runs: 1,
            longest_ns: 1,
            is_exact: true,
            publishes: BTreeSet::new(),
        };
        let callbacks = [
            of("/lidar", 1, 10),
            of("/lidar", 1, 11),
            of("/lidar", 2, 12),
            of("/map", 3, 12),
            of("/radar", 4, 20),
            of("/radar", 5, 21),
        ];
        assert_eq!(multi_threaded(&callbacks), BTreeSet::from(["/lidar", "/map"]));
    }

    #[test]
    fn a_thread_with_a_reservation_is_described_with_it() {
        let callback = Callback {
            key: "points".to_owned(),
            node: "/lidar".to_owned(),
            process: 1,
            tid: 1,
            source: ObjectId(1),
            trigger: Trigger::Timer(20_000_000),
            runs: 1,
            longest_ns: 1_000_000,
            is_exact: true,
            publishes: BTreeSet::new(),
        };
        for (cores, core) in [("0", "core = 0\n"), ("0-1", "core = \"any\"\n")] {
            let cores = rt::CoreSet::parse(cores).unwrap();
            let policy = Policy::Deadline { runtime_ns: 4_200_000, period_ns: 20_000_000 };
            let thread = ThreadInfo { tid: 1, name: "cb:points".to_owned(), policy, cores };
            let mut file = File { text: "[hosts.robot]\ncores = 2\n[nodes.lidar]\n".to_owned(), guesses: 0 };
            file.callback(&callback, Some(&thread), None, false);
            assert!(file.text.contains(core), "{}", file.text);
            let parsed = tautline_analysis::file::SystemFile::parse(&file.text).unwrap();
            let reservation = parsed.callbacks()[0].reservation.unwrap();
            assert_eq!((reservation.runtime_ns, reservation.period_ns), (4_200_000, 20_000_000));
        }
    }
}

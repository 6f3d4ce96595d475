// SPDX-License-Identifier: MIT OR Apache-2.0
//! Decides when the black box is written: a deadline is missed, a process dies, a topic falls silent, or the user requests it.

use crate::record::args::Kind;
use crate::record::observers::Observers;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use taut_cli::report::run::Run;
use taut_cli::verb::Outcome;
use tautline_executor::ForeignStatistics;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_system::shared_statistics;
use tautline_transport::{EndpointKind, GraphSnapshot, Visitor};

/// The interval at which statistics are read.
const STATISTICS_NS: u64 = 100_000_000;
/// How long the statistics of ended processes are kept.
const ENDED_NS: u64 = 5_000_000_000;
/// A topic without a time of its own is silent after this multiple of its longest pause so far. It must have had this number of messages.
const PAUSES: u64 = 10;
const MESSAGES: u64 = 10;
/// The least time after which a topic is silent.
const SILENCE_NS: u64 = 1_000_000_000;

/// Why the black box is written.
pub struct Alarm {
    pub kind: Kind,
    pub words: String,
    pub at_ns: u64,
    /// The statistics of callbacks at that time.
    pub statistics: Option<Run>,
}

pub struct Alarms {
    domain: u32,
    kinds: Vec<Kind>,
    /// Topics with a time of their own.
    silent: BTreeMap<String, u64>,
    /// The same alarm is not repeated within this time.
    rest_ns: u64,
    said: HashMap<String, u64>,
    visitor: Visitor,
    graph: Arc<GraphSnapshot>,
    /// The system refused to let the graph be read, and the user was warned.
    is_refused: bool,
    asked: Arc<AtomicBool>,
    processes: Vec<ForeignStatistics>,
    /// The time at which each process that has ended did so.
    ended: HashMap<PathBuf, u64>,
    looked_ns: u64,
    is_first: bool,
    misses: HashMap<(PathBuf, String), u64>,
    heard: HashMap<usize, Heard>,
}

/// The messages of a topic so far.
#[derive(Clone, Copy, Default)]
struct Heard {
    messages: u64,
    last_ns: u64,
    longest_ns: u64,
    is_silent: bool,
}

impl Alarms {
    pub fn new(
        domain: u32,
        kinds: &[Kind],
        silent: &[(String, Duration)],
        rest: Duration,
        asked: Arc<AtomicBool>,
    ) -> Outcome<Self> {
        Ok(Alarms {
            domain,
            kinds: kinds.to_vec(),
            silent: silent.iter().map(|(topic, time)| (topic.clone(), nanoseconds(*time))).collect(),
            rest_ns: nanoseconds(rest),
            said: HashMap::new(),
            visitor: Visitor::new(domain)?,
            graph: Arc::default(),
            is_refused: false,
            asked,
            processes: Vec::new(),
            ended: HashMap::new(),
            looked_ns: 0,
            is_first: true,
            misses: HashMap::new(),
            heard: HashMap::new(),
        })
    }

    fn watches(&self, kind: Kind) -> bool {
        self.kinds.contains(&kind)
    }

    /// The alarms since the last call. The same alarm is not repeated for a while.
    pub fn look(&mut self, observers: &Observers) -> Outcome<Vec<Alarm>> {
        let now_ns = monotonic_ns();
        let mut found = Vec::new();
        if self.asked.swap(false, Ordering::Relaxed) && self.watches(Kind::Request) {
            found.push((Kind::Request, String::new(), "it was asked for".to_owned()));
        }
        match self.visitor.graph() {
            Ok(graph) => (self.graph, self.is_refused) = (graph, false),
            // The graph of the last refresh is used until the next.
            Err(error) if error.is_passing() => {
                if !std::mem::replace(&mut self.is_refused, true) {
                    eprintln!("taut: warning: deaths are noticed only when the system permits it: {error}");
                }
            }
            Err(error) => return Err(error.into()),
        }
        let graph = self.graph.clone();
        for death in self.visitor.take_deaths() {
            let nodes: Vec<_> = death.nodes.iter().map(ToString::to_string).collect();
            let of = if nodes.is_empty() { String::new() } else { format!(" ({})", nodes.join(", ")) };
            let words = format!("process {}{of} died", death.pid);
            found.push((Kind::Death, words.clone(), words));
        }
        if now_ns >= self.looked_ns + STATISTICS_NS {
            self.looked_ns = now_ns;
            self.missed(&mut found);
        }
        let has_publisher = |topic: &str| {
            graph.endpoints.iter().any(|end| end.kind == EndpointKind::Publisher && end.topic == topic)
        };
        for (number, topic, messages) in observers.heard() {
            let least_ns = self.silent.get(topic).copied();
            let new = Heard { messages, last_ns: now_ns, ..Heard::default() };
            let heard = self.heard.entry(number).or_insert(new);
            if heard.falls_silent(messages, least_ns, now_ns) && has_publisher(topic) {
                let seconds = (now_ns - heard.last_ns) as f64 / 1e9;
                found.push((
                    Kind::Silence,
                    topic.to_owned(),
                    format!("{topic} is silent for {seconds:.1} s, and has a publisher"),
                ));
            }
        }
        let (watched, rest_ns) = (self.kinds.clone(), self.rest_ns);
        found.retain(|(kind, of, _)| {
            let is_new = self.said.get(of).is_none_or(|said_ns| now_ns.saturating_sub(*said_ns) >= rest_ns);
            let is_said = watched.contains(kind) && (is_new || *kind == Kind::Request);
            if is_said {
                self.said.insert(of.clone(), now_ns);
            }
            is_said
        });
        self.said.retain(|_, said_ns| now_ns.saturating_sub(*said_ns) < rest_ns);
        let statistics = if found.is_empty() { None } else { self.statistics() };
        let alarm = |(kind, _, words)| Alarm { kind, words, at_ns: now_ns, statistics: statistics.clone() };
        Ok(found.into_iter().map(alarm).collect())
    }

    /// Adds an alarm for each callback that missed deadlines since the last call.
    fn missed(&mut self, found: &mut Vec<(Kind, String, String)>) {
        // Statistics that cannot be read now are read the next time.
        let (there, _) = shared_statistics(self.domain).unwrap_or_default();
        for process in there {
            if !self.processes.iter().any(|known| known.path() == process.path()) {
                self.processes.push(process);
            }
        }
        let is_first = std::mem::take(&mut self.is_first);
        for process in &self.processes {
            let Ok(Some(snapshot)) = process.read() else { continue };
            for callback in snapshot.callbacks.iter().filter(|callback| !callback.is_group) {
                let key = (process.path().to_owned(), callback.name.clone());
                let before = self.misses.insert(key, callback.deadline_misses);
                // Misses from before the recording do not count.
                let before = before.unwrap_or(if is_first { u64::MAX } else { 0 });
                if callback.deadline_misses > before {
                    let times = callback.deadline_misses - before;
                    let deadline = callback
                        .deadline_ns
                        .map_or(String::new(), |ns| format!(" of {:.3} ms", ns as f64 / 1e6));
                    let words = format!(
                        "callback '{}' of {} (process {}) missed its deadline{deadline}, {times} x",
                        callback.name, snapshot.process.program, snapshot.process.pid
                    );
                    found.push((Kind::Deadline, format!("callback {}", callback.name), words));
                }
            }
        }
        // The alarm about a dead process includes its statistics.
        let (misses, ended, now_ns) = (&mut self.misses, &mut self.ended, self.looked_ns);
        self.processes.retain(|process| {
            let path = process.path();
            if process.is_running() {
                return true;
            }
            let stays = now_ns - *ended.entry(path.to_owned()).or_insert(now_ns) < ENDED_NS;
            if !stays {
                ended.remove(path);
                misses.retain(|(of, _), _| of != path);
            }
            stays
        });
    }

    /// The statistics of callbacks, as `taut report --save` writes them, with the system file of the first process that has one.
    fn statistics(&self) -> Option<Run> {
        let path = self.processes.iter().find_map(|process| {
            let path = process.read().ok()??.process.system_path;
            (!path.as_os_str().is_empty()).then_some(path)
        });
        let text = path.as_ref().and_then(|path| std::fs::read_to_string(path).ok()).unwrap_or_default();
        let path = path.as_deref().unwrap_or(Path::new(""));
        Run::gather(self.domain, path, &text, &self.processes).ok().filter(|run| !run.processes.is_empty())
    }
}

impl Heard {
    /// Takes the number of messages so far. Returns whether the topic falls silent now.
    fn falls_silent(&mut self, messages: u64, own_ns: Option<u64>, now_ns: u64) -> bool {
        let since_ns = now_ns.saturating_sub(self.last_ns);
        if messages != self.messages {
            if self.messages > 0 {
                self.longest_ns = self.longest_ns.max(since_ns);
            }
            (self.messages, self.last_ns, self.is_silent) = (messages, now_ns, false);
            return false;
        }
        let usual = || (self.longest_ns.saturating_mul(PAUSES)).max(SILENCE_NS);
        let most_ns = own_ns.or_else(|| (messages >= MESSAGES).then(usual));
        let is_over = messages > 0 && most_ns.is_some_and(|most_ns| since_ns > most_ns);
        is_over && !std::mem::replace(&mut self.is_silent, true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_is_silent_after_ten_times_its_longest_pause() {
        let mut heard = Heard::default();
        const MS: u64 = 1_000_000;
        // A topic that never had a message is not silent.
        assert!(!heard.falls_silent(0, Some(MS), 1000 * MS));
        (1..=9).for_each(|n| assert!(!heard.falls_silent(n, None, 1000 * MS + n * 200 * MS)));
        assert!(!heard.falls_silent(9, None, 60_000 * MS), "too few to tell");
        assert!(!heard.falls_silent(10, None, 60_000 * MS), "a pause of 57.2 s");
        assert!(!heard.falls_silent(10, None, 600_000 * MS));
        assert!(heard.falls_silent(10, None, 640_000 * MS));
        assert!(!heard.falls_silent(10, None, 650_000 * MS), "said once");
        assert!(!heard.falls_silent(11, None, 660_000 * MS));
        assert!(heard.falls_silent(11, Some(50 * MS), 660_051 * MS), "its own time");
    }
}

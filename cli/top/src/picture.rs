// SPDX-License-Identifier: MIT OR Apache-2.0
//! The present state of a domain: callbacks, topics and cores, from the statistics that its processes keep in shared memory.

use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;
use taut_cli::rates::{RateMeter, per_second};
use taut_cli::times::ms;
use taut_cli::verb::Outcome;
use tautline::{Bucket, HistogramSnapshot};
use tautline_analysis::file::{CheckedCallback, SystemFile};
use tautline_executor::CallbackSnapshot;
use tautline_transport::{EndpointKind, Gid, Visitor};

/// The whole picture. Rates and loads are those since the previous refresh.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Picture {
    pub domain: u32,
    /// The time since the previous refresh, which rates cover.
    pub seconds: f64,
    pub callbacks: Vec<CallbackRow>,
    pub topics: Vec<TopicRow>,
    pub cores: Vec<CoreRow>,
}

#[derive(Clone, Debug, Serialize)]
pub struct CallbackRow {
    pub name: String,
    pub program: String,
    pub pid: u32,
    /// The priority of SCHED_FIFO.
    pub priority: Option<u8>,
    pub core: Option<usize>,
    /// The number of jobs that have ended.
    pub jobs: u64,
    pub releases_hz: f64,
    /// Response times of the jobs since the previous refresh.
    pub response_p50_ms: Option<f64>,
    pub response_p99_ms: Option<f64>,
    /// The longest response time of all jobs.
    pub response_max_ms: Option<f64>,
    /// The bound that `taut check` computes from the process's system file; `None` if that has another text by now.
    pub bound_ms: Option<f64>,
    pub execution_max_ms: Option<f64>,
    pub budget_ms: Option<f64>,
    pub overruns: u64,
    pub missed: u64,
    pub queue_max: u64,
    pub capacity: Option<usize>,
    pub depth: u64,
    pub lost: u64,
}

#[derive(Clone, Debug, Serialize)]
pub struct TopicRow {
    pub name: String,
    #[serde(rename = "type")]
    pub type_name: String,
    pub publishers: usize,
    pub subscriptions: usize,
    /// `None` if all its publishers are on other hosts, which have no counters here.
    pub rate_hz: Option<f64>,
    pub bytes_per_s: Option<f64>,
    /// Messages that were overwritten before a current subscription took them; `None` as for `rate_hz`.
    pub lost: Option<u64>,
}

#[derive(Clone, Debug, Serialize)]
pub struct CoreRow {
    pub core: usize,
    /// The share of the time since the previous refresh.
    pub load_percent: f64,
    /// The share of the time that the hypervisor gave to others.
    pub steal_percent: f64,
    /// How often the core was throttled for its temperature since the system started; `None` if unknown.
    pub throttled: Option<u64>,
}

impl CallbackRow {
    /// Whether a bound is exceeded, messages were lost, or deadlines or budgets were missed.
    pub fn is_bad(&self) -> bool {
        let is_late = self.bound_ms.zip(self.response_max_ms).is_some_and(|(bound, max)| max > bound);
        is_late || self.lost > 0 || self.missed > 0 || self.overruns > 0
    }
}

/// Process, thread and name of a callback: several of a process may have one name.
type CallbackKey = (u32, u32, String);

/// The values at the previous refresh.
#[derive(Default)]
struct Before {
    callbacks: BTreeMap<CallbackKey, (u64, BTreeMap<u64, u64>)>,
    cores: BTreeMap<usize, CoreTimes>,
}

/// Times of a core from /proc/stat, in ticks.
#[derive(Clone, Copy, Default)]
struct CoreTimes {
    all: u64,
    idle: u64,
    steal: u64,
}

/// What a system file predicts of its callbacks.
type Bounds = BTreeMap<String, Predicted>;

#[derive(Clone, Copy, Default)]
struct Predicted {
    bound_ns: Option<u64>,
    capacity: Option<usize>,
    /// The priority of its thread while that waits, and while it runs the callback.
    priorities: Option<(u8, u8)>,
}

/// The bounds of each text of a system file that a process runs with, by the file's path and the text's fingerprint.
#[derive(Default)]
struct Systems(BTreeMap<(PathBuf, u64), Bounds>);

impl Systems {
    /// None if the file has another text by now, is being edited, or was removed: it is read again at the next refresh.
    fn bounds(&mut self, path: &Path, fingerprint: u64) -> Bounds {
        let key = (path.to_owned(), fingerprint);
        if let Some(known) = self.0.get(&key) {
            return known.clone();
        }
        let file = SystemFile::read(path).ok().filter(|file| file.fingerprint() == fingerprint);
        let Some(file) = file else { return Bounds::new() };
        let predicted = |one: CheckedCallback| {
            let priorities = Some((one.entry.priority, one.entry.running_priority()));
            let (bound_ns, capacity) = (one.response_overhead_ns, one.capacity);
            (one.entry.name, Predicted { bound_ns, capacity, priorities })
        };
        let bounds: Bounds = file.check().callbacks.into_iter().map(predicted).collect();
        self.0.insert(key, bounds.clone());
        bounds
    }
}

/// Refreshes the picture.
pub struct Gatherer {
    domain: u32,
    visitor: Visitor,
    rates: RateMeter,
    before: Before,
    refreshed: Option<Instant>,
    systems: Systems,
}

impl Gatherer {
    pub fn new(domain: u32) -> Outcome<Self> {
        let (rates, before, refreshed, systems) = Default::default();
        Ok(Gatherer { domain, visitor: Visitor::new(domain)?, rates, before, refreshed, systems })
    }

    /// Reads the domain, and returns what changed since the previous call.
    pub fn refresh(&mut self) -> Outcome<Picture> {
        let now = Instant::now();
        let seconds = self.refreshed.replace(now).map_or(0.0, |before| (now - before).as_secs_f64());
        let mut picture = Picture { domain: self.domain, seconds, ..Picture::default() };
        let before = std::mem::take(&mut self.before);
        picture.callbacks = self.callbacks(&before, seconds)?;
        picture.topics = self.topics()?;
        picture.cores = self.cores(&before);
        Ok(picture)
    }

    fn callbacks(&mut self, before: &Before, seconds: f64) -> Outcome<Vec<CallbackRow>> {
        let mut rows = Vec::new();
        let (processes, _) = tautline_system::shared_statistics(self.domain)?;
        for process in processes {
            // A process that is ending, or has another version, is omitted.
            let Ok(Some(snapshot)) = process.read() else { continue };
            let bounds = self.systems.bounds(&snapshot.process.system_path, snapshot.process.system_hash);
            for callback in snapshot.callbacks.iter().filter(|callback| !callback.ended && !callback.is_group)
            {
                let key = (snapshot.process.pid, callback.tid, callback.name.clone());
                let former = before.callbacks.get(&key);
                let Predicted { bound_ns, capacity, priorities } =
                    bounds.get(&callback.name).copied().unwrap_or_default();
                // Recorded is the priority with which the thread takes a message.
                let running = priorities.filter(|(waiting, _)| callback.priority == Some(*waiting));
                let of = |time: std::time::Duration| time.as_secs_f64() * 1e3;
                let recent = recent(callback, former.map(|(_, buckets)| buckets));
                let quantile = |q: f64| (recent.n() > 0).then(|| of(recent.p(q)));
                let max = |times: &HistogramSnapshot| (times.n() > 0).then(|| of(times.max()));
                rows.push(CallbackRow {
                    name: callback.name.clone(),
                    program: snapshot.process.program.clone(),
                    pid: snapshot.process.pid,
                    priority: running.map(|(_, running)| running).or(callback.priority),
                    core: callback.core,
                    jobs: callback.completions,
                    releases_hz: former
                        .map_or(0.0, |(before, _)| per_second(callback.releases, *before, seconds)),
                    response_p50_ms: quantile(0.5),
                    response_p99_ms: quantile(0.99),
                    response_max_ms: max(&callback.response),
                    bound_ms: bound_ns.map(ms),
                    execution_max_ms: max(&callback.execution),
                    budget_ms: callback.budget_ns.map(ms),
                    overruns: callback.overruns,
                    missed: callback.deadline_misses,
                    queue_max: callback.max_queue,
                    capacity,
                    depth: callback.depth,
                    lost: callback.lost,
                });
                self.before.callbacks.insert(key, (callback.releases, buckets(&callback.response)));
            }
        }
        rows.sort_by(|one, other| {
            (&one.program, one.pid, &one.name).cmp(&(&other.program, other.pid, &other.name))
        });
        Ok(rows)
    }

    fn topics(&mut self) -> Outcome<Vec<TopicRow>> {
        let graph = self.visitor.graph()?;
        let rates = self.rates.measure(&mut self.visitor, &graph)?;
        let subscriptions = graph.endpoints.iter().filter(|end| end.kind == EndpointKind::Subscription);
        let subscriptions: BTreeSet<Gid> = subscriptions.map(|end| end.gid).collect();
        let mut rows: BTreeMap<(&str, &str), TopicRow> = BTreeMap::new();
        for end in &graph.endpoints {
            let row = rows.entry((&end.topic, &end.topic_type.name)).or_insert_with(|| TopicRow {
                name: end.topic.clone(),
                type_name: end.topic_type.name.to_string(),
                publishers: 0,
                subscriptions: 0,
                rate_hz: None,
                bytes_per_s: None,
                lost: None,
            });
            match end.kind {
                EndpointKind::Subscription => row.subscriptions += 1,
                EndpointKind::Publisher => {
                    row.publishers += 1;
                    let lost = self.visitor.overwritten(end)?;
                    // Messages that an observer misses are not lost.
                    let lost = lost.iter().filter(|(gid, _)| subscriptions.contains(gid));
                    let lost = lost.fold(0, |sum: u64, (_, count)| sum.saturating_add(*count));
                    let Some(rate) = rates.get(&end.gid) else { continue };
                    row.lost = Some(row.lost.unwrap_or(0).saturating_add(lost));
                    let rate = rate.unwrap_or_default();
                    *row.rate_hz.get_or_insert(0.0) += rate.messages_hz;
                    *row.bytes_per_s.get_or_insert(0.0) += rate.bytes_per_s;
                }
            }
        }
        Ok(rows.into_values().collect())
    }

    fn cores(&mut self, before: &Before) -> Vec<CoreRow> {
        self.before.cores = core_times(&fs::read_to_string("/proc/stat").unwrap_or_default());
        let row = |(core, now): (&usize, &CoreTimes)| {
            let before = before.cores.get(core).copied().unwrap_or_default();
            let all = now.all.saturating_sub(before.all).max(1) as f64;
            let part = |ticks: u64| (100.0 * ticks as f64 / all).clamp(0.0, 100.0);
            let throttled = format!("/sys/devices/system/cpu/cpu{core}/thermal_throttle/core_throttle_count");
            CoreRow {
                core: *core,
                load_percent: 100.0 - part(now.idle.saturating_sub(before.idle)),
                steal_percent: part(now.steal.saturating_sub(before.steal)),
                throttled: fs::read_to_string(throttled).ok().and_then(|text| text.trim().parse().ok()),
            }
        };
        self.before.cores.iter().map(row).collect()
    }
}

fn buckets(times: &HistogramSnapshot) -> BTreeMap<u64, u64> {
    times.buckets().map(|bucket| (bucket.low_ns, bucket.count)).collect()
}

/// The response times of the jobs that have ended since the previous refresh.
fn recent(callback: &CallbackSnapshot, before: Option<&BTreeMap<u64, u64>>) -> HistogramSnapshot {
    let max_ns = u64::try_from(callback.response.max().as_nanos()).unwrap_or(u64::MAX);
    let new = callback.response.buckets().filter_map(|bucket| {
        let former = before.and_then(|before| before.get(&bucket.low_ns)).copied().unwrap_or(0);
        let count = bucket.count.saturating_sub(former);
        (count > 0).then_some(Bucket { count, ..bucket })
    });
    HistogramSnapshot::of_buckets(new, 0, max_ns)
}

/// The lines `cpu0 ...` of /proc/stat.
fn core_times(stat: &str) -> BTreeMap<usize, CoreTimes> {
    let line = |line: &str| {
        // The first line is the sum over all cores, and has no number.
        let numbered =
            line.strip_prefix("cpu").filter(|rest| rest.starts_with(|c: char| c.is_ascii_digit()))?;
        let mut words = numbered.split_whitespace();
        let core = words.next()?.parse().ok()?;
        let ticks: Vec<u64> = words.map_while(|word| word.parse().ok()).collect();
        // user nice system idle iowait irq softirq steal; the times of guests are part of user and nice.
        let at = |index: usize| ticks.get(index).copied().unwrap_or(0);
        let all = ticks.iter().take(8).sum();
        Some((core, CoreTimes { all, idle: at(3) + at(4), steal: at(7) }))
    };
    stat.lines().filter_map(line).collect()
}

#[derive(clap::ValueEnum, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Order {
    /// By name
    #[default]
    Name,
    /// The highest rate first
    Rate,
    /// The longest response time or the highest bandwidth first
    Load,
    /// Rows with violations first
    Trouble,
}

impl Order {
    pub fn next(self) -> Self {
        match self {
            Order::Name => Order::Rate,
            Order::Rate => Order::Load,
            Order::Load => Order::Trouble,
            Order::Trouble => Order::Name,
        }
    }
}

impl Picture {
    /// Keeps the rows whose names contain `text`, and sorts them.
    pub fn arrange(&mut self, text: &str, order: Order) {
        self.callbacks.retain(|row| row.name.contains(text) || row.program.contains(text));
        self.topics.retain(|row| row.name.contains(text));
        let descending = |one: f64, other: f64| other.total_cmp(&one);
        // Stable: equal rows stay sorted by name.
        match order {
            Order::Name => {}
            Order::Rate => {
                self.callbacks.sort_by(|one, other| descending(one.releases_hz, other.releases_hz));
                self.topics.sort_by(|one, other| {
                    descending(one.rate_hz.unwrap_or(0.0), other.rate_hz.unwrap_or(0.0))
                });
            }
            Order::Load => {
                let longest = |row: &CallbackRow| row.response_p99_ms.unwrap_or(0.0);
                self.callbacks.sort_by(|one, other| descending(longest(one), longest(other)));
                let most = |row: &TopicRow| row.bytes_per_s.unwrap_or(0.0);
                self.topics.sort_by(|one, other| descending(most(one), most(other)));
            }
            Order::Trouble => {
                self.callbacks.sort_by_key(|row| !row.is_bad());
                self.topics.sort_by_key(|row| std::cmp::Reverse(row.lost));
            }
        }
    }

    pub fn processes(&self) -> usize {
        self.callbacks.iter().map(|row| row.pid).collect::<BTreeSet<_>>().len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernels_times_are_read() {
        let stat = "cpu  9 9 9 9\ncpu0 10 0 5 80 4 1 0 7 3 0\ncpu12 1 2 3 4 5 6 7 8\nintr 5\n";
        let times = core_times(stat);
        assert_eq!(times.keys().copied().collect::<Vec<_>>(), [0, 12]);
        assert_eq!((times[&0].all, times[&0].idle, times[&0].steal), (107, 84, 7));
        assert!(core_times("").is_empty());
    }

    #[test]
    fn bounds_are_those_of_the_text_with_which_a_process_runs() {
        let text = |wcet: &str| {
            format!(
                "[hosts.a]\ncores = 1\n[nodes.slam]\n[topics]\nscan = {{ period = \"10ms\" }}\n[callbacks]\n\
                 map = {{ topic = \"scan\", wcet = \"{wcet}\" }}\n"
            )
        };
        let (former, edited) = (text("1ms"), text("2ms"));
        let [was, is] = [&former, &edited].map(|text| SystemFile::parse(text).unwrap().fingerprint());
        let path = std::env::temp_dir().join(format!("taut-top-{}.toml", std::process::id()));
        let mut systems = Systems::default();
        let mut bound_ns =
            |fingerprint| systems.bounds(&path, fingerprint).get("map").and_then(|of| of.bound_ns);
        assert_eq!(bound_ns(was), None, "the file is not there yet");
        fs::write(&path, &former).unwrap();
        let first = bound_ns(was);
        assert!(first >= Some(1_000_000), "{first:?}");
        // The file is edited; then the process adopts it.
        fs::write(&path, &edited).unwrap();
        assert_eq!(bound_ns(was), first);
        assert!(bound_ns(is) >= Some(2_000_000));
        assert!(Systems::default().bounds(&path, was).is_empty(), "its text is not there any more");
        fs::remove_file(&path).unwrap();
    }

    fn topic(name: &str, rate_hz: f64) -> TopicRow {
        let (publishers, subscriptions, bytes_per_s) = (1, 0, Some(1.0));
        TopicRow {
            name: name.into(),
            type_name: "a/msg/B".into(),
            publishers,
            subscriptions,
            rate_hz: Some(rate_hz),
            bytes_per_s,
            lost: Some(0),
        }
    }

    #[test]
    fn rows_are_filtered_and_put_in_order() {
        let topics = vec![topic("/a", 1.0), topic("/b", 3.0), topic("/ab", 2.0)];
        let mut picture = Picture { topics, ..Picture::default() };
        picture.arrange("a", Order::Rate);
        assert_eq!(picture.topics.iter().map(|row| &*row.name).collect::<Vec<_>>(), ["/ab", "/a"]);
    }
}

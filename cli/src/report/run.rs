// SPDX-License-Identifier: MIT OR Apache-2.0
//! A run: the system file and the statistics of callbacks, read from shared memory or from a saved file.
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};
use tautline::{Bucket, HistogramSnapshot, Policy};
use tautline_executor::{Admitted, CallbackSnapshot, ForeignStatistics, ProcessSnapshot};

use crate::moment::Moment;
use crate::replace::NewFile;
use crate::verb::{Failure, Outcome};

/// The first member of a saved run. The number changes when older programs would misread the file.
const FORMAT: &str = "tautline run 1";

/// The data of a report, which `--save` writes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Run {
    format: String,
    /// Seconds since 1970.
    pub taken_at_s: u64,
    pub domain: u32,
    /// The path and the text of the system file.
    pub system_path: PathBuf,
    pub system: String,
    pub processes: Vec<Process>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Process {
    /// The file of its statistics; each context of a process has one.
    #[serde(skip)]
    path: PathBuf,
    pub pid: u32,
    pub program: String,
    pub host: String,
    pub realtime: bool,
    /// Whether the process was alive when this was read.
    pub running: bool,
    pub sampler_priority: Option<u8>,
    /// The hash of the system file that it was started with.
    pub system_hash: u64,
    /// Processor time that the hypervisor gave to others since it started, in ticks of 10 ms.
    pub steal_ticks: u64,
    /// The node that it plays from a bag; empty if none.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub stands_in: String,
    /// The callbacks that are late because it was admitted by force.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub forced: Option<String>,
    pub callbacks: Vec<Callback>,
    /// Present if core time is accounted for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampler: Option<SamplerThread>,
}

/// The statistics of a process's sampler.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SamplerThread {
    pub core: Option<usize>,
    pub moments: Vec<Moment>,
    #[serde(default)]
    pub older_moments: u64,
}

/// A `CallbackSnapshot` that can be serialized.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Callback {
    pub name: String,
    pub is_group: bool,
    /// Whether only its publications are seen.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_by_publications: bool,
    pub ended: bool,
    pub tid: u32,
    pub priority: Option<u8>,
    /// Its reservation, if the callback runs under SCHED_DEADLINE and its thread was alive.
    #[serde(skip)]
    pub reservation: Option<Policy>,
    pub core: Option<usize>,
    pub measures_execution: bool,
    pub period_ns: Option<u64>,
    pub deadline_ns: Option<u64>,
    pub budget_ns: Option<u64>,
    pub releases: u64,
    pub completions: u64,
    pub overruns: u64,
    #[serde(default)]
    pub demotions: u64,
    pub deadline_misses: u64,
    pub first_release_ns: u64,
    pub last_release_ns: u64,
    pub least_distance_ns: Option<u64>,
    #[serde(default)]
    pub greatest_distance_ns: Option<u64>,
    pub lost: u64,
    pub max_queue: u64,
    pub depth: u64,
    /// The least time since the release of a job that was running when this was read.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unfinished_ns: Option<u64>,
    pub response: Times,
    pub execution: Times,
    /// Whether the moments include time that was taken from its core.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub accounts_core_time: bool,
    /// The latest moments: late jobs, and time that was taken from its core.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub moments: Vec<Moment>,
    #[serde(default)]
    pub older_moments: u64,
    /// Execution times by the size of the input, if its jobs state it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<SizeClass>,
}

/// A `tautline_executor::SizeClass` that can be serialized.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SizeClass {
    pub jobs: u64,
    pub least: u64,
    pub greatest: u64,
    pub max_ns: u64,
    pub size_of_max: u64,
    pub longest_ns: Vec<u64>,
}

/// A histogram: the least value and the count of each non-empty bucket.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Times {
    sum_ns: u64,
    max_ns: u64,
    buckets: Vec<(u64, u64)>,
}

impl Run {
    /// The run of these processes up to now. Processes that are just starting are omitted.
    pub fn gather(
        domain: u32,
        system_path: &Path,
        system: &str,
        processes: &[ForeignStatistics],
    ) -> Outcome<Run> {
        let now = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
        let mut gathered = Vec::new();
        for process in processes {
            // Checked first, so that the statistics of an ended process are complete.
            let running = process.is_running();
            // Also read before the statistics: a running job has run at least until this time.
            let now_ns = running.then(tautline_rt::clock::monotonic_ns);
            if let Some(snapshot) = process.read().map_err(unread)? {
                gathered.push(Process { path: process.path().into(), ..Process::new(&snapshot, now_ns) });
            }
        }
        gathered.sort_by_key(|process| process.pid);
        Ok(Run {
            format: FORMAT.into(),
            taken_at_s: now.as_secs(),
            domain,
            system_path: system_path.into(),
            system: system.into(),
            processes: gathered,
        })
    }

    /// Adds moments from an earlier reading that have been overwritten since.
    pub fn with_moments_of(mut self, before: &Run) -> Run {
        for process in &mut self.processes {
            let Some(before) = before.processes.iter().find(|other| other.path == process.path) else {
                continue;
            };
            for callback in &mut process.callbacks {
                let is_it = |other: &&Callback| other.name == callback.name && other.tid == callback.tid;
                if let Some(before) = before.callbacks.iter().find(is_it) {
                    let latest = (&mut callback.moments, &mut callback.older_moments);
                    prepend((&before.moments, before.older_moments), latest);
                }
            }
            if let (Some(before), Some(sampler)) = (&before.sampler, &mut process.sampler) {
                prepend(
                    (&before.moments, before.older_moments),
                    (&mut sampler.moments, &mut sampler.older_moments),
                );
            }
        }
        self
    }

    /// Reads a saved run from its text.
    pub fn parse(path: &Path, text: &str) -> Outcome<Run> {
        let refuse =
            |reason: String| Failure::unusable(format!("`{}` is not a saved run: {reason}", path.display()));
        let run: Run = serde_json::from_str(text).map_err(|error| refuse(error.to_string()))?;
        if run.format != FORMAT {
            return Err(refuse(format!("its format is `{}`, not `{FORMAT}`", run.format)));
        }
        Ok(run)
    }

    /// Writes the run to a file, which appears only when it is complete.
    pub fn save(&self, path: &Path) -> Outcome {
        let refuse = |error: io::Error| Failure::unwritable(path, &error);
        let text = serde_json::to_string(self).map_err(|error| refuse(error.into()))?;
        let mut file = NewFile::create(path).map_err(refuse)?;
        file.write_all((text + "\n").as_bytes()).and_then(|()| file.finish()).map_err(refuse)
    }
}

/// The failure to read the statistics of a process.
pub fn unread(error: io::Error) -> Failure {
    Failure::unusable(format!("the statistics cannot be read: {error}"))
}

/// The maximum number of moments per callback; reading more each second would take long.
const MOST_MOMENTS: usize = 10_000;

/// Puts earlier moments before the present ones. Both state the number of older ones.
fn prepend((known, older_known): (&[Moment], u64), (latest, older): (&mut Vec<Moment>, &mut u64)) {
    let known_until = older_known + known.len() as u64;
    // The number of present moments that were known before, and the number of moments that were missed.
    let again = usize::try_from(known_until.saturating_sub(*older)).unwrap_or(usize::MAX).min(latest.len());
    let missed = older.saturating_sub(known_until);
    let new = latest.split_off(again);
    let dropped = (known.len() + new.len()).saturating_sub(MOST_MOMENTS);
    *latest = known.iter().chain(&new).skip(dropped).copied().collect();
    *older = older_known + missed + dropped as u64;
}

impl Process {
    /// `now_ns` is `None` if the process has ended.
    fn new(snapshot: &ProcessSnapshot, now_ns: Option<u64>) -> Process {
        let process = &snapshot.process;
        Process {
            path: PathBuf::new(),
            pid: process.pid,
            program: process.program.clone(),
            host: process.host.clone(),
            realtime: process.realtime,
            running: now_ns.is_some(),
            sampler_priority: process.sampler_priority,
            system_hash: process.system_hash,
            steal_ticks: tautline_rt::host::steal_ticks(None).saturating_sub(process.steal_ticks),
            stands_in: process.stands_in.clone(),
            forced: match &process.admitted {
                Admitted::Forced(why) => Some(why.clone()),
                Admitted::Unchecked | Admitted::Checked => None,
            },
            callbacks: snapshot.callbacks.iter().map(|of| Callback::new(of, now_ns)).collect(),
            sampler: snapshot.sampler.as_ref().map(|of| SamplerThread {
                core: of.core,
                moments: of.moments.iter().map(Moment::from).collect(),
                older_moments: of.older_moments,
            }),
        }
    }

    /// A name for people.
    pub fn label(&self) -> String {
        format!("{} (process {})", self.program, self.pid)
    }
}

impl Callback {
    fn new(of: &CallbackSnapshot, now_ns: Option<u64>) -> Callback {
        // A killed process does not record its end.
        let ended = of.ended || now_ns.is_none();
        let is_busy = !ended && of.releases > of.completions;
        Callback {
            name: of.name.clone(),
            is_group: of.is_group,
            is_by_publications: of.is_by_publications,
            ended,
            tid: of.tid,
            priority: of.priority,
            reservation: of.reservation.filter(|_| !ended),
            core: of.core,
            measures_execution: of.measures_execution,
            period_ns: of.period_ns,
            deadline_ns: of.deadline_ns,
            budget_ns: of.budget_ns,
            releases: of.releases,
            completions: of.completions,
            overruns: of.overruns,
            demotions: of.demotions,
            deadline_misses: of.deadline_misses,
            first_release_ns: of.first_release_ns,
            last_release_ns: of.last_release_ns,
            least_distance_ns: of.least_distance_ns,
            greatest_distance_ns: of.greatest_distance_ns,
            lost: if of.is_by_publications { missing(of) } else { of.lost },
            max_queue: of.max_queue,
            depth: of.depth,
            unfinished_ns: now_ns.filter(|_| is_busy).map(|now| now.saturating_sub(of.last_release_ns)),
            response: Times::new(&of.response),
            execution: Times::new(&of.execution),
            accounts_core_time: of.accounts_core_time,
            moments: of.moments.iter().map(Moment::from).collect(),
            older_moments: of.older_moments,
            inputs: of.inputs.iter().map(SizeClass::from).collect(),
        }
    }

    /// The longest time from a release until now or the job's end; `None` without a job.
    pub fn longest_response_ns(&self) -> Option<u64> {
        self.response.max_ns().max(self.unfinished_ns)
    }

    /// The largest input; `None` if the jobs state no sizes.
    pub fn greatest_input(&self) -> Option<u64> {
        self.inputs.iter().map(|class| class.greatest).max()
    }

    /// The mean time between two releases.
    pub fn mean_distance_ns(&self) -> Option<u64> {
        let steps = self.releases.checked_sub(1).filter(|steps| *steps > 0)?;
        Some(self.last_release_ns.saturating_sub(self.first_release_ns) / steps)
    }
}

/// The number of periods in which the timer published nothing.
fn missing(of: &CallbackSnapshot) -> u64 {
    let Some(period_ns) = of.period_ns.filter(|_| of.releases > 0) else { return 0 };
    let time_ns = of.last_release_ns.saturating_sub(of.first_release_ns).saturating_add(period_ns / 2);
    (time_ns / period_ns).saturating_add(1).saturating_sub(of.releases)
}

impl From<&tautline_executor::SizeClass> for SizeClass {
    fn from(of: &tautline_executor::SizeClass) -> SizeClass {
        let tautline_executor::SizeClass { jobs, least, greatest, max_ns, size_of_max, ref longest_ns } = *of;
        SizeClass { jobs, least, greatest, max_ns, size_of_max, longest_ns: longest_ns.clone() }
    }
}

impl Times {
    fn new(histogram: &HistogramSnapshot) -> Times {
        let max_ns = u64::try_from(histogram.max().as_nanos()).unwrap_or(u64::MAX);
        let buckets = histogram.buckets().map(|bucket| (bucket.low_ns, bucket.count)).collect();
        Times { sum_ns: histogram.sum_ns(), max_ns, buckets }
    }

    pub fn histogram(&self) -> HistogramSnapshot {
        let bucket = |&(low_ns, count): &(u64, u64)| Bucket { low_ns, high_ns: low_ns, count };
        HistogramSnapshot::of_buckets(self.buckets.iter().map(bucket), self.sum_ns, self.max_ns)
    }

    /// The longest time; `None` if it is empty.
    pub fn max_ns(&self) -> Option<u64> {
        (!self.buckets.is_empty()).then_some(self.max_ns)
    }

    /// The number of longer times. Times in the bucket that contains the limit do not count.
    pub fn longer_than(&self, limit_ns: u64) -> u64 {
        self.buckets.iter().filter(|(low_ns, _)| *low_ns > limit_ns).map(|(_, count)| count).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::moment::Kind;

    fn moments(numbers: std::ops::Range<u64>) -> Vec<Moment> {
        numbers
            .map(|from_ns| Moment { kind: Kind::Taken, from_ns, to_ns: from_ns + 1, length_ns: 1 })
            .collect()
    }

    #[test]
    fn what_is_overwritten_between_two_looks_is_kept_and_what_nobody_saw_is_counted() {
        let after = |known: std::ops::Range<u64>, latest: std::ops::Range<u64>| {
            let (before, mut older, mut now) =
                ((moments(known.clone()), known.start), latest.start, moments(latest));
            prepend((&before.0, before.1), (&mut now, &mut older));
            (now, older)
        };
        // Nothing new; some; none in common; some that were never seen; of one whose first ones were missed already.
        assert_eq!(after(0..5, 0..5), (moments(0..5), 0));
        assert_eq!(after(0..5, 2..7), (moments(0..7), 0));
        assert_eq!(after(0..5, 5..9), (moments(0..9), 0));
        let (all, older) = after(0..5, 7..9);
        assert_eq!((all, older), ([moments(0..5), moments(7..9)].concat(), 2));
        assert_eq!(after(3..5, 4..9), (moments(3..9), 3));
        let most = MOST_MOMENTS as u64;
        assert_eq!(after(0..most, most - 2..most + 3), (moments(3..most + 3), 3));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report of a demo run: the data and its JSON. The printed text is in `text` and `details`.

use std::io::{self, Write};
use std::time::Duration;

use serde::Serialize;
use tautline_analysis::taken::{Seen, TakenTimes, response_time_with};
use tautline_analysis::{Overheads, Task};
use tautline_rt::Interruptions;

use crate::moment::ACCOUNTED_TO_NS;
use crate::table::times;
use crate::times::ms;

/// One run of the demo. The fields up to `topics` are a contract with scripts: names, order and units stay.
#[derive(Debug, Clone, Serialize)]
pub struct DemoReport {
    /// Whether the threads ran at their real-time priorities; without them no bound applies.
    pub realtime: bool,
    /// The core everything ran on.
    pub core: usize,
    /// Length of the measurement.
    pub seconds: f64,
    /// Time the hypervisor gave to others meanwhile: `steal` of /proc/stat, in ticks of 10 ms.
    pub steal_ticks: u64,
    /// Kernel release, as `uname -r` prints it.
    pub kernel: String,
    /// One entry for each topic, fastest first.
    pub topics: Vec<TopicReport>,
    /// Preemption model of the kernel, such as `PREEMPT_RT`.
    pub preemption: String,
    /// Work of publisher, transport and sampler for each message, as charged by `rta_overhead_ms`.
    pub overhead_us: f64,
    /// SCHED_FIFO priority of the sampler.
    pub sampler_priority: u8,
    /// Longest regular interruption of the core (99th percentile), charged as blocking by `rta_overhead_ms`.
    pub interruption_us: f64,
    /// Share of the core that regular interruptions take, in percent, charged as a task above all others.
    pub interrupted_percent: f64,
    /// Longest measured interruption; no bound contains it.
    pub longest_interruption_us: f64,
    /// Time that the host took from threads that ran, in this run: steal, and interrupts where the kernel accounts for them apart.
    pub taken_running_ms: f64,
    /// Time for which a due timer was not served, and which no thread measured as taken.
    pub taken_late_ms: f64,
    /// The longest interval of either.
    pub longest_taken_ms: f64,
    /// Time that threads outside of the demo had the core while jobs waited for it.
    pub others_ms: f64,
    /// The most that the middleware used of the core at once; `overhead_us` is a mean.
    pub longest_use_us: f64,
    /// Number of moments that were overwritten before they were collected. Responses that they would explain count as unexplained.
    pub moments_overwritten: u64,
}

/// Prediction and measurement of one topic. The fields up to `max_queue` are part of the contract.
#[derive(Debug, Clone, Serialize)]
pub struct TopicReport {
    pub topic: String,
    /// Time between two messages.
    pub period_ms: f64,
    /// Execution time of the callback.
    pub wcet_ms: f64,
    /// SCHED_FIFO priority of the callback.
    pub priority: u8,
    /// Messages whose callback ended.
    pub n: u64,
    /// Median response time, from scheduled release to end of callback; `None` (null) if `n` is 0.
    pub p50_ms: Option<f64>,
    /// 99th percentile.
    pub p99_ms: Option<f64>,
    /// Longest response time.
    pub max_ms: Option<f64>,
    /// Predicted worst case without overheads; `None` (null) if there is no bound.
    pub rta_ms: Option<f64>,
    /// Predicted worst case with the measured overhead; `None` (null) if there is no bound.
    pub rta_overhead_ms: Option<f64>,
    /// Response times past the deadline.
    pub deadline_misses: u64,
    /// Messages overwritten before their callback took them.
    pub lost: u64,
    /// The maximum number of waiting messages.
    pub max_queue: u64,
    /// The deadline, relative to the scheduled release.
    pub deadline_ms: f64,
    /// The predicted worst case including the time that the host took in this run; `None` (null) if there is no bound.
    pub rta_host_ms: Option<f64>,
    /// Response times above `rta_overhead_ms`.
    pub beyond: u64,
    /// Those of them that are defects: the time that the host, other threads and the middleware had before their ends does not explain
    /// them to within 0.1 ms.
    pub unexplained: u64,
    /// The longest of these, unexplained ones first; `None` (null) if there is none.
    pub worst: Option<Worst>,
    /// Every response time, ascending, in nanoseconds.
    #[serde(skip)]
    pub latencies_ns: Vec<u64>,
}

/// A response above the prediction.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Worst {
    pub response_ms: f64,
    /// The time that the host took during the response.
    pub host_took_ms: f64,
    /// The time of the core that threads outside the demo had during the response.
    pub others_had_ms: f64,
    /// The time of the middleware during the response, for any message, and the time that this callback and those above it used beyond
    /// their wcet.
    pub middleware_used_ms: f64,
    /// The predicted bound with all of these times; `None` (null) if there is no bound then.
    pub allowed_ms: Option<f64>,
}

const NOT_MIDDLEWARE: &[Seen] = &[Seen::Running, Seen::WokenLate, Seen::Waited];

#[derive(Debug, Clone)]
pub struct TopicRun {
    /// Name, period, execution time, deadline and priority of the callback.
    pub task: Task,
    /// Scheduled releases, in ns of `CLOCK_MONOTONIC`.
    pub releases_ns: Vec<u64>,
    /// Response times from release to end of callback, in nanoseconds and in the same order.
    pub latencies_ns: Vec<u64>,
    /// Messages overwritten before their callback took them.
    pub lost: u64,
    /// The maximum number of waiting messages.
    pub max_queue: u64,
    /// The time of the core that the host, other threads and the middleware had. The middleware's mean is [`Costs::per_message`].
    pub lost_time: TakenTimes,
}

/// Worst-case response times in nanoseconds; `None` where the core is overloaded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Prediction {
    /// Without any costs of the machine.
    pub rta_ns: Option<u64>,
    /// Including the middleware's work for each message.
    pub rta_overhead_ns: Option<u64>,
    /// Including also the time that the host took.
    pub rta_host_ns: Option<u64>,
}

/// The measured costs of the machine and the middleware.
#[derive(Debug, Clone, Default)]
pub struct Costs {
    /// Middleware work for each message of any topic, charged at the highest priority.
    pub per_message: Duration,
    /// Interrupts, kernel and hypervisor: the regular ones as a task above all others, the longest of them as blocking.
    pub interruptions: Interruptions,
    /// The time that the host took from the core during the run.
    pub taken: TakenTimes,
}

/// The tasks with their additional costs.
struct Loaded {
    /// With the expected interruptions: the regular ones are a task above all others.
    expected: Vec<Task>,
    /// With the longest regular interruption only, because the time that callbacks lost in the run is known.
    seen: Vec<Task>,
    overheads: Overheads,
}

impl Loaded {
    fn new(tasks: &[Task], costs: &Costs) -> Loaded {
        let blocking = Duration::from_nanos(costs.interruptions.regular_ns);
        let seen: Vec<_> = tasks.iter().map(|task| task.clone().blocking(blocking)).collect();
        let expected = seen.iter().cloned().chain(interrupt_task(&costs.interruptions)).collect();
        let per_message_ns = u64::try_from(costs.per_message.as_nanos()).unwrap_or(u64::MAX);
        Loaded { expected, seen, overheads: Overheads { per_message_ns, ..Overheads::NONE } }
    }

    fn bound_ns(&self, index: usize) -> Option<u64> {
        let response = response_time_with(&self.expected, &self.overheads, index, |_| 0);
        Some(response.ok()?.response_ns)
    }

    /// The bound of a task if a window loses at most `taken_within`; at least the bound with the expected interruptions.
    fn host_bound_ns(&self, index: usize, taken_within: impl Fn(u64) -> u64) -> Option<u64> {
        let response = response_time_with(&self.seen, &self.overheads, index, taken_within);
        Some(response.ok()?.response_ns.max(self.bound_ns(index)?))
    }

    /// As [`host_bound_ns`](Self::host_bound_ns), but `lost_within` includes the middleware's measured time instead of its mean.
    fn allowed_ns(&self, index: usize, lost_within: impl Fn(u64) -> u64) -> Option<u64> {
        let response = response_time_with(&self.seen, &Overheads::NONE, index, lost_within);
        Some(response.ok()?.response_ns)
    }
}

/// Predicts every task's response time, without costs of the machine and with `costs`.
pub fn predict(tasks: &[Task], costs: &Costs) -> Vec<Prediction> {
    let (ideal, real) = (Loaded::new(tasks, &Costs::default()), Loaded::new(tasks, costs));
    let prediction = |index| Prediction {
        rta_ns: ideal.bound_ns(index),
        rta_overhead_ns: real.bound_ns(index),
        rta_host_ns: real.host_bound_ns(index, |window_ns| costs.taken.most_within(window_ns)),
    };
    (0..tasks.len()).map(prediction).collect()
}

fn interrupt_task(seen: &Interruptions) -> Option<Task> {
    let (period, work) = (Duration::from_nanos(seen.period_ns()?), Duration::from_nanos(seen.mean_ns()?));
    Some(Task::new("interrupts", period, work, u8::MAX).message_overhead(Duration::ZERO))
}

/// Summarises each run with its prediction, in the given order.
pub fn topic_reports(runs: Vec<TopicRun>, costs: &Costs) -> Vec<TopicReport> {
    let tasks: Vec<_> = runs.iter().map(|run| run.task.clone()).collect();
    let predictions = predict(&tasks, costs);
    let loaded = Loaded::new(&tasks, costs);
    let report = |(index, (run, prediction)): (usize, (TopicRun, Prediction))| {
        let excess = Excess::of(&run, prediction, |taken_within, lost_within| {
            loaded.host_bound_ns(index, taken_within).max(loaded.allowed_ns(index, lost_within))
        });
        topic_report(run, prediction, excess)
    };
    runs.into_iter().zip(predictions).enumerate().map(report).collect()
}

/// Writes the report as one JSON object and a newline.
///
/// # Errors
/// Whatever `out` fails with.
pub fn write_json(report: &DemoReport, out: &mut impl Write) -> io::Result<()> {
    serde_json::to_writer(&mut *out, report)?;
    writeln!(out)
}

impl DemoReport {
    /// The texts of the topics that have one, separated by commas.
    pub fn list(&self, text: impl Fn(&TopicReport) -> Option<String>) -> String {
        self.topics.iter().filter_map(text).collect::<Vec<_>>().join(", ")
    }
}

impl TopicReport {
    pub fn failed(&self) -> bool {
        self.n == 0 || self.deadline_misses > 0 || self.lost > 0
    }

    /// The longest response as a share of its bound, which includes the time that others took; `None` without a bound.
    pub fn share_of_bound(&self) -> Option<f64> {
        let (longest_ms, bound_ms) = match self.worst {
            Some(worst) => (worst.response_ms, worst.allowed_ms? + ms(ACCOUNTED_TO_NS)),
            None => (self.max_ms?, self.rta_overhead_ms?),
        };
        Some(longest_ms / bound_ms)
    }

    /// A text about the responses above the prediction, if any, and about the threads that had the core during the worst of them.
    pub fn beyond_prediction(&self) -> Option<String> {
        let (worst, predicted) = (self.worst?, self.rta_overhead_ms?);
        let count = if self.unexplained > 0 { self.unexplained } else { self.beyond };
        let times = times(count);
        let Worst { response_ms, host_took_ms, others_had_ms, middleware_used_ms, allowed_ms } = worst;
        let allowed = allowed_ms.map_or(String::new(), |ms| format!(", with that {ms:.2} ms"));
        let host = format!(
            ", of which the host took {host_took_ms:.2} ms, other threads {others_had_ms:.2} ms and the middleware {middleware_used_ms:.2} ms; predicted {predicted:.2} ms{allowed}"
        );
        Some(format!("{} {times} ({response_ms:.2} ms{host})", self.topic))
    }
}

/// The responses of a topic above the prediction.
#[derive(Debug, Default)]
struct Excess {
    beyond: u64,
    unexplained: u64,
    worst: Option<Worst>,
}

impl Excess {
    /// `bound` computes the topic's bound from two times that a window loses: to everything except the middleware, and in total.
    fn of(
        run: &TopicRun,
        prediction: Prediction,
        bound: impl Fn(&dyn Fn(u64) -> u64, &dyn Fn(u64) -> u64) -> Option<u64>,
    ) -> Excess {
        let [host, others, middleware, taken] =
            [&[Seen::Running, Seen::WokenLate][..], &[Seen::Waited], &[Seen::Overran], NOT_MIDDLEWARE]
                .map(|ways| run.lost_time.seen(ways));
        let mut excess = Excess::default();
        let mut longest = (false, 0);
        let Some(bound_ns) = prediction.rta_overhead_ns else { return excess };
        let mut before_ns = 0;
        for (&release_ns, &latency_ns) in run.releases_ns.iter().zip(&run.latencies_ns) {
            let end_ns = release_ns.saturating_add(latency_ns);
            // When the previous job ended, no job above it waited. So time that was lost until then did not delay this job, if it was
            // released later.
            let since_ns = std::mem::replace(&mut before_ns, end_ns);
            let since_ns = if since_ns <= release_ns { since_ns } else { 0 };
            if latency_ns <= bound_ns {
                continue;
            }
            let lost =
                |times: &TakenTimes, window_ns: u64| times.before(end_ns, window_ns.min(end_ns - since_ns));
            let allowed_ns =
                bound(&|window_ns| lost(&taken, window_ns), &|window_ns| lost(&run.lost_time, window_ns));
            let explained = |allowed_ns: u64| latency_ns <= allowed_ns.saturating_add(ACCOUNTED_TO_NS);
            let unexplained = !allowed_ns.is_some_and(explained);
            excess.beyond += 1;
            excess.unexplained += u64::from(unexplained);
            if (unexplained, latency_ns) > longest {
                longest = (unexplained, latency_ns);
                let lasted = |times: &TakenTimes| ms(times.before(end_ns, latency_ns));
                excess.worst = Some(Worst {
                    response_ms: ms(latency_ns),
                    host_took_ms: lasted(&host),
                    others_had_ms: lasted(&others),
                    middleware_used_ms: lasted(&middleware),
                    allowed_ms: allowed_ns.map(ms),
                });
            }
        }
        excess
    }
}

fn topic_report(run: TopicRun, prediction: Prediction, excess: Excess) -> TopicReport {
    let TopicRun { task, mut latencies_ns, lost, max_queue, .. } = run;
    latencies_ns.sort_unstable();
    let on_time = latencies_ns.partition_point(|latency| *latency <= task.deadline_ns);
    let percentile = |p| percentile(&latencies_ns, p).map(ms);
    TopicReport {
        period_ms: ms(task.period_ns),
        wcet_ms: ms(task.wcet_ns),
        priority: task.priority,
        n: latencies_ns.len() as u64,
        p50_ms: percentile(50),
        p99_ms: percentile(99),
        max_ms: percentile(100),
        rta_ms: prediction.rta_ns.map(ms),
        rta_overhead_ms: prediction.rta_overhead_ns.map(ms),
        deadline_misses: (latencies_ns.len() - on_time) as u64,
        lost,
        max_queue,
        deadline_ms: ms(task.deadline_ns),
        rta_host_ms: prediction.rta_host_ns.map(ms),
        beyond: excess.beyond,
        unexplained: excess.unexplained,
        worst: excess.worst,
        topic: task.name,
        latencies_ns,
    }
}

/// The smallest sample that `percent` of the samples do not exceed.
fn percentile(ascending: &[u64], percent: usize) -> Option<u64> {
    let rank = (ascending.len() * percent).div_ceil(100);
    ascending.get(rank.checked_sub(1)?).copied()
}

#[cfg(test)]
pub mod tests;

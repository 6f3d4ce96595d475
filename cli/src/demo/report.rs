// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a demo run found: the data, its JSON, and (in `text`) the table a person reads.
use std::io::{self, Write};
use std::time::Duration;

use serde::Serialize;
use tautline::rt::Interruptions;
use tautline_analysis::{Overheads, Response, Task, response_time_per_task};

mod text;

pub use text::write_table;

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
    /// Longest interruption seen; charged to nobody.
    pub longest_interruption_us: f64,
}

/// Prediction and measurement of one topic. The fields up to `max_queue` are part of the contract.
#[derive(Debug, Clone, Serialize)]
pub struct TopicReport {
    /// Name of the topic.
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
    /// Predicted worst case on a machine that costs nothing; `None` (null) if there is no bound.
    pub rta_ms: Option<f64>,
    /// Predicted worst case with the measured overhead; `None` (null) if there is no bound.
    pub rta_overhead_ms: Option<f64>,
    /// Response times past the deadline.
    pub deadline_misses: u64,
    /// Messages overwritten before their callback took them.
    pub lost: u64,
    /// Most messages waiting at once.
    pub max_queue: u64,
    /// Latest end wanted, relative to the scheduled release.
    pub deadline_ms: f64,
    /// Every response time, ascending, in nanoseconds.
    #[serde(skip)]
    pub latencies_ns: Vec<u64>,
}

/// What was measured on one topic.
#[derive(Debug, Clone)]
pub struct TopicRun {
    /// Name, period, execution time, deadline and priority of the callback.
    pub task: Task,
    /// Response times from scheduled release to end of callback, in nanoseconds and in any order.
    pub latencies_ns: Vec<u64>,
    /// Messages overwritten before their callback took them.
    pub lost: u64,
    /// Most messages waiting at once.
    pub max_queue: u64,
}

/// Worst-case response times in nanoseconds; `None` where the core is overloaded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Prediction {
    /// On a machine that costs nothing.
    pub rta_ns: Option<u64>,
    /// With the middleware's work for each message.
    pub rta_overhead_ns: Option<u64>,
}

/// What the machine costs besides the callbacks, as measured in the run.
#[derive(Debug, Clone, Copy, Default)]
pub struct Costs {
    /// Middleware work for each message of any topic, charged at the highest priority.
    pub per_message: Duration,
    /// Interrupts, kernel and hypervisor: the regular ones as a task above all others, the longest of them as blocking.
    pub interruptions: Interruptions,
}

/// Predicts every task's response time, on a machine that costs nothing and on one that costs `costs`.
pub fn predict(tasks: &[Task], costs: &Costs) -> Vec<Prediction> {
    let bounds = |tasks: &[Task], per_message: Duration| -> Vec<Option<u64>> {
        let per_message_ns = u64::try_from(per_message.as_nanos()).unwrap_or(u64::MAX);
        let outcomes = response_time_per_task(tasks, &Overheads { per_message_ns, ..Overheads::NONE });
        outcomes
            .into_iter()
            .map(|outcome| outcome.ok().map(|Response { response_ns, .. }| response_ns))
            .collect()
    };
    let ideal = bounds(tasks, Duration::ZERO);
    let blocking = Duration::from_nanos(costs.interruptions.regular_ns);
    let mut loaded: Vec<_> = tasks.iter().map(|task| task.clone().blocking(blocking)).collect();
    loaded.extend(interrupt_task(&costs.interruptions));
    let real = bounds(&loaded, costs.per_message);
    let both = ideal.into_iter().zip(real);
    both.map(|(rta_ns, rta_overhead_ns)| Prediction { rta_ns, rta_overhead_ns }).collect()
}

fn interrupt_task(seen: &Interruptions) -> Option<Task> {
    let (period, work) = (Duration::from_nanos(seen.period_ns()?), Duration::from_nanos(seen.mean_ns()?));
    Some(Task::new("interrupts", period, work, u8::MAX).message_overhead(Duration::ZERO))
}

/// Condenses the runs and sets their prediction beside them, in the order given.
pub fn topic_reports(runs: Vec<TopicRun>, costs: &Costs) -> Vec<TopicReport> {
    let tasks: Vec<_> = runs.iter().map(|run| run.task.clone()).collect();
    let predictions = predict(&tasks, costs);
    runs.into_iter().zip(predictions).map(|(run, prediction)| topic_report(run, prediction)).collect()
}

/// Writes the report as one JSON object and a newline.
///
/// # Errors
/// Whatever `out` fails with.
pub fn write_json(report: &DemoReport, out: &mut impl Write) -> io::Result<()> {
    serde_json::to_writer(&mut *out, report)?;
    writeln!(out)
}

impl TopicReport {
    fn failed(&self) -> bool {
        self.n == 0 || self.deadline_misses > 0 || self.lost > 0
    }

    /// Longest response time and prediction, if the one exceeds the other.
    fn beyond_prediction(&self) -> Option<(f64, f64)> {
        let (max, bound) = (self.max_ms?, self.rta_overhead_ms?);
        (max > bound).then_some((max, bound))
    }
}

fn topic_report(run: TopicRun, prediction: Prediction) -> TopicReport {
    let TopicRun { task, mut latencies_ns, lost, max_queue } = run;
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
        topic: task.name,
        latencies_ns,
    }
}

/// The smallest sample that `percent` of the samples do not exceed.
fn percentile(ascending: &[u64], percent: usize) -> Option<u64> {
    let rank = (ascending.len() * percent).div_ceil(100);
    ascending.get(rank.checked_sub(1)?).copied()
}

fn ms(ns: u64) -> f64 {
    ns as f64 / 1e6
}

#[cfg(test)]
mod tests;

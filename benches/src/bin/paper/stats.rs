// SPDX-License-Identifier: MIT OR Apache-2.0
//! From the runs of a cell to one row for each topic.

use serde::Serialize;
use tautline_paper::Topic;

use crate::plan::{Cell, Plan};
use crate::process::Run;
use crate::rounds::CellRuns;

/// What was found for one topic in one cell. The fields up to `steal_ticks` are a contract with scripts: names, order and
/// units stay.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub system: &'static str,
    pub variant: String,
    pub topic: String,
    pub runs: usize,
    /// Messages whose callback ended.
    pub n: u64,
    /// Median response time of all runs together, from scheduled release to end of callback; null if `n` is 0.
    pub p50_ms: Option<f64>,
    pub p99_ms: Option<f64>,
    pub max_ms: Option<f64>,
    /// Standard deviation of the runs' 99th percentiles; 0 for one run.
    pub p99_std_ms: Option<f64>,
    /// Classical response-time analysis, on a machine that costs nothing.
    pub rta_ms: Option<f64>,
    pub deadline_ms: f64,
    pub misses: u64,
    /// Messages published whose callback never ran.
    pub lost: u64,
    /// Messages that the middleware itself counted as lost; null if it does not count.
    pub counted_lost: Option<u64>,
    /// Ticks of 10 ms that the hypervisor took from the core during these runs.
    pub steal_ticks: u64,
    pub mean_ms: Option<f64>,
    /// Response-time analysis with the overhead that was measured; null where it does not apply.
    pub rta_overhead_ms: Option<f64>,
    pub replaced_runs: usize,
    pub published: u64,
    /// Releases of any topic that the publisher missed in these runs; never published, so not lost.
    pub missed_releases: u64,
    #[serde(skip)]
    pub cell: Cell,
    #[serde(skip)]
    pub index: usize,
    /// Every response time, ascending.
    #[serde(skip)]
    pub latencies_ns: Vec<u64>,
}

impl Row {
    /// Whether every message was handled in time.
    pub fn meets_deadline(&self) -> bool {
        self.n > 0 && self.misses == 0 && self.lost == 0
    }
}

/// The runs that count: as many as planned, the undisturbed ones first; where there are not enough, the least disturbed.
pub fn counted(runs: &[Run], wanted: usize) -> Vec<&Run> {
    let mut runs: Vec<_> = runs.iter().collect();
    runs.sort_by_key(|run| (run.is_disturbed(), run.steal_ticks));
    runs.truncate(wanted);
    runs
}

pub fn rows(plan: &Plan, cell: &CellRuns) -> Vec<Row> {
    let counted = counted(&cell.runs, plan.runs as usize);
    let topics = plan.job(cell.cell, String::new()).topics;
    let rta_ns = plan.rta_ns(cell.cell);
    let steal_ticks = counted.iter().map(|run| run.steal_ticks).sum();
    let missed_releases = counted.iter().map(|run| run.published.missed).sum();
    let row = |(index, topic): (usize, &Topic)| {
        let runs: Vec<&[u64]> = counted.iter().map(|run| latencies_ns(run, index)).collect();
        let published: u64 = counted.iter().filter_map(|run| run.published.messages.get(index)).sum();
        let mut latencies_ns = runs.concat();
        latencies_ns.sort_unstable();
        let n = latencies_ns.len() as u64;
        Row {
            system: cell.cell.system,
            variant: cell.cell.experiment.to_string(),
            topic: topic.name.clone(),
            runs: counted.len(),
            n,
            p50_ms: percentile(&latencies_ns, 50).map(ms),
            p99_ms: percentile(&latencies_ns, 99).map(ms),
            max_ms: latencies_ns.last().copied().map(ms),
            p99_std_ms: p99_deviation_ms(&runs),
            rta_ms: rta_ns[index].map(ms),
            deadline_ms: ms(topic.deadline_ns),
            misses: latencies_ns.iter().filter(|latency| **latency > topic.deadline_ns).count() as u64,
            lost: published.saturating_sub(n),
            counted_lost: counted
                .iter()
                .map(|run| run.measured.topics.get(index).and_then(|topic| topic.counted_lost))
                .sum(),
            steal_ticks,
            mean_ms: mean(latencies_ns.iter().map(|latency| ms(*latency))),
            rta_overhead_ms: None,
            replaced_runs: cell.runs.len() - counted.len(),
            published,
            missed_releases,
            cell: cell.cell,
            index,
            latencies_ns,
        }
    };
    topics.iter().enumerate().map(row).collect()
}

fn latencies_ns(run: &Run, index: usize) -> &[u64] {
    run.measured.topics.get(index).map_or(&[], |topic| &topic.latencies_ns)
}

/// The middleware's work for each message in these runs, publisher and subscriber together, in nanoseconds.
pub fn overhead_ns(runs: &[&Run]) -> u64 {
    let per_run = |run: &&Run| {
        let handled: usize = run.measured.topics.iter().map(|topic| topic.latencies_ns.len()).sum();
        let published: u64 = run.published.messages.iter().sum();
        let publisher = run.published.cpu_ns.checked_div(published)?;
        Some((publisher + run.measured.overhead_cpu_ns.checked_div(handled as u64)?) as f64)
    };
    mean(runs.iter().filter_map(per_run)).unwrap_or(0.0) as u64
}

/// The value that `percent` of the sorted values do not exceed (nearest rank); `None` if there are none.
fn percentile(sorted: &[u64], percent: usize) -> Option<u64> {
    let rank = (sorted.len() * percent).div_ceil(100);
    sorted.get(rank.max(1) - 1).copied()
}

/// The 99th percentile of times in any order.
pub fn p99_ms(latencies_ns: &[u64]) -> Option<f64> {
    let mut sorted = latencies_ns.to_vec();
    sorted.sort_unstable();
    percentile(&sorted, 99).map(ms)
}

/// Sample standard deviation of the runs' 99th percentiles; 0 for one run, `None` without any.
fn p99_deviation_ms(runs: &[&[u64]]) -> Option<f64> {
    let values: Vec<f64> = runs.iter().filter_map(|run| p99_ms(run)).collect();
    let mean = mean(values.iter().copied())?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    Some((squares / (values.len().max(2) - 1) as f64).sqrt())
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) = values.fold((0, 0.0), |(count, sum), value| (count + 1, sum + value));
    (count > 0).then(|| sum / f64::from(count))
}

pub fn ms(ns: u64) -> f64 {
    ns as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::{Experiment, R2R};
    use tautline_paper::{Measured, Published, TopicMeasured, Variant};

    fn run(latencies_ms: [&[u64]; 2], published: [u64; 2], steal_ticks: u64) -> Run {
        let topic = |ms: &[u64]| TopicMeasured {
            latencies_ns: ms.iter().map(|ms| ms * 1_000_000).collect(),
            counted_lost: Some(1),
        };
        Run {
            published: Published { messages: published.to_vec(), missed: 0, cpu_ns: 1_000 },
            measured: Measured { overhead_cpu_ns: 900, topics: latencies_ms.map(topic).to_vec() },
            steal_ticks,
            repetition: false,
        }
    }

    #[test]
    fn percentiles_are_the_nearest_rank() {
        let sorted: Vec<u64> = (1..=200).collect();
        assert_eq!([50, 99, 100].map(|p| percentile(&sorted, p)), [Some(100), Some(198), Some(200)]);
        assert_eq!((percentile(&[7], 99), percentile(&[], 99)), (Some(7), None));
    }

    #[test]
    fn the_deviation_is_that_of_the_runs() {
        let ms = 1_000_000;
        assert_eq!(p99_deviation_ms(&[&[2 * ms], &[4 * ms], &[6 * ms]]), Some(2.0));
        assert_eq!(p99_deviation_ms(&[&[2 * ms, 9 * ms]]), Some(0.0));
        assert_eq!(p99_deviation_ms(&[&[], &[]]), None);
    }

    #[test]
    fn a_row_counts_what_is_late_and_what_is_lost_in_undisturbed_runs() {
        let mut plan = crate::report::tests::plan();
        plan.runs = 2;
        let cell = Cell { system: R2R, experiment: Experiment::Paper(Variant::FUTURES_RT) };
        let runs = vec![
            run([&[2, 2, 11], &[6]], [4, 1], 0),
            run([&[500], &[6]], [1, 1], 3),
            run([&[2, 3], &[]], [2, 0], 0),
        ];
        let rows = rows(&plan, &CellRuns { cell, runs });
        let first = &rows[0];
        assert_eq!((first.runs, first.replaced_runs, first.n, first.published), (2, 1, 5, 6));
        assert_eq!((first.misses, first.lost, first.steal_ticks), (1, 1, 0));
        assert_eq!((first.p50_ms, first.max_ms, first.mean_ms), (Some(2.0), Some(11.0), Some(4.0)));
        assert_eq!((first.rta_ms, first.deadline_ms), (Some(2.0), 10.0));
        assert!(!first.meets_deadline() && rows[1].meets_deadline());
        assert_eq!((rows[2].n, rows[2].p99_ms, rows[2].meets_deadline()), (0, None, false));
    }

    #[test]
    fn the_least_disturbed_runs_count_where_there_are_not_enough() {
        let runs = [run([&[1], &[]], [1, 0], 5), run([&[2], &[]], [1, 0], 0), run([&[3], &[]], [1, 0], 1)];
        let steal: Vec<_> = counted(&runs, 2).iter().map(|run| run.steal_ticks).collect();
        assert_eq!(steal, [0, 1]);
    }

    #[test]
    fn overhead_is_the_publishers_and_the_subscribers_share_of_a_message() {
        let run = run([&[1, 1], &[1]], [4, 1], 0);
        assert_eq!(overhead_ns(&[&run]), 1_000 / 5 + 900 / 3);
        assert_eq!(overhead_ns(&[]), 0);
    }
}

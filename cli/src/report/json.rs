// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report as JSON for scripts. Names, order and units do not change.
use std::io::{self, Write};

use serde::Serialize;
use tautline::HistogramSnapshot;

use super::explain::Mark;
use super::verdict::{ChainRow, Comparison, Measured, Row, Running, Unknown, Verdict, least_distance};
use crate::times::ms;

#[derive(Serialize)]
struct Report<'a> {
    kept: bool,
    realtime: bool,
    callbacks: Vec<Callback<'a>>,
    chains: Vec<Chain<'a>>,
    processes: Vec<Process<'a>>,
    unknown: Vec<Stray<'a>>,
    notes: &'a [String],
}

#[derive(Serialize)]
struct Callback<'a> {
    name: &'a str,
    core: usize,
    priority: u8,
    predicted: Predicted,
    measured: Option<Seen<'a>>,
    violations: Vec<Violation<'a>>,
}

/// Times without a bound are null.
#[derive(Serialize)]
struct Predicted {
    response_ms: Option<f64>,
    deadline_ms: f64,
    wcet_ms: f64,
    /// Includes the overheads that the file charges to one job.
    budget_ms: f64,
    period_ms: f64,
    least_distance_ms: f64,
    capacity: Option<usize>,
}

/// Times without a measurement are null.
#[derive(Serialize)]
struct Seen<'a> {
    process: &'a str,
    jobs: u64,
    response_ms: Times,
    deadline_misses: u64,
    execution_ms: Times,
    overruns: u64,
    demotions: u64,
    mean_distance_ms: Option<f64>,
    least_distance_ms: Option<f64>,
    greatest_distance_ms: Option<f64>,
    max_queue: u64,
    depth: u64,
    lost: u64,
    ended: bool,
    /// Whether jobs and distances are those of its publications, and response times are not known.
    by_publications: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    host: Option<HostShare>,
}

/// The effect of the host; present if core time is accounted for.
#[derive(Serialize)]
struct HostShare {
    /// The bound plus the most that the host took in any window.
    response_ms: Option<f64>,
    /// The number of responses above the bound; among them those that are explained only together with waits for the core, and those without
    /// an explanation.
    beyond: u64,
    waited: u64,
    unexplained: u64,
    longest_ms: Option<f64>,
    taken_ms: Option<f64>,
    overran_ms: Option<f64>,
    waited_ms: Option<f64>,
}

#[derive(Serialize)]
struct Times {
    n: u64,
    p50: Option<f64>,
    p99: Option<f64>,
    max: Option<f64>,
}

#[derive(Serialize)]
struct Violation<'a> {
    name: &'a str,
    explanation: &'a str,
}

/// A chain whose callbacks trigger one another.
#[derive(Serialize)]
struct Chain<'a> {
    name: &'a str,
    callbacks: &'a [String],
    /// The sum of its callbacks' longest responses, which no message exceeded.
    longest_ms: f64,
    predicted_ms: Option<f64>,
    /// The sum of its callbacks' bounds with the most that the host took in any window.
    #[serde(skip_serializing_if = "Option::is_none")]
    host_ms: Option<f64>,
    deadline_ms: f64,
}

#[derive(Serialize)]
struct Process<'a> {
    process: &'a str,
    host: &'a str,
    running: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    forced: Option<&'a str>,
    violations: Vec<Violation<'a>>,
}

#[derive(Serialize)]
struct Stray<'a> {
    name: &'a str,
    process: &'a str,
    core: Option<usize>,
    priority: Option<u8>,
    violations: Vec<Violation<'a>>,
}

/// Writes one JSON object and a newline.
pub fn write(comparison: &Comparison, out: &mut impl Write) -> io::Result<()> {
    let report = Report {
        kept: comparison.verdict == Verdict::Kept,
        realtime: comparison.realtime,
        callbacks: comparison.rows.iter().map(callback).collect(),
        chains: comparison.chains.iter().map(chain).collect(),
        processes: comparison.processes.iter().map(process).collect(),
        unknown: comparison.unknown.iter().map(stray).collect(),
        notes: &comparison.notes,
    };
    serde_json::to_writer(&mut *out, &report)?;
    writeln!(out)
}

fn callback(row: &Row) -> Callback<'_> {
    let Row { predicted, measured, marks } = row;
    Callback {
        name: &predicted.entry.name,
        core: predicted.core,
        priority: predicted.entry.running_priority(),
        predicted: Predicted {
            response_ms: predicted.response_overhead_ns.map(ms),
            deadline_ms: ms(predicted.entry.deadline_ns),
            wcet_ms: ms(predicted.wcet_ns),
            budget_ms: ms(predicted.charged_ns),
            period_ms: ms(predicted.period_ns),
            least_distance_ms: ms(least_distance(predicted)),
            capacity: predicted.capacity,
        },
        measured: measured.as_ref().map(seen),
        violations: violations(marks),
    }
}

fn seen(measured: &Measured) -> Seen<'_> {
    let callback = &measured.callback;
    Seen {
        process: &measured.process,
        jobs: callback.completions,
        response_ms: times(&measured.response),
        deadline_misses: measured.misses,
        execution_ms: times(&measured.execution),
        overruns: callback.overruns,
        demotions: callback.demotions,
        mean_distance_ms: callback.mean_distance_ns().map(ms),
        least_distance_ms: callback.least_distance_ns.map(ms),
        greatest_distance_ms: callback.greatest_distance_ns.map(ms),
        max_queue: callback.max_queue,
        depth: callback.depth,
        lost: callback.lost,
        ended: callback.ended,
        by_publications: callback.is_by_publications,
        host: measured.share.as_ref().map(|share| HostShare {
            response_ms: share.bound_ns.map(ms),
            beyond: share.beyond,
            waited: share.waited,
            unexplained: share.unexplained,
            longest_ms: share.longest.map(|longest| ms(longest.response_ns)),
            taken_ms: share.longest.map(|longest| ms(longest.taken_ns)),
            overran_ms: share.longest.map(|longest| ms(longest.overran_ns)),
            waited_ms: share.longest.map(|longest| ms(longest.waited_ns)),
        }),
    }
}

fn chain(row: &ChainRow) -> Chain<'_> {
    let ChainRow { predicted, callbacks, longest_ns, host_ns } = row;
    Chain {
        name: &predicted.name,
        callbacks,
        longest_ms: ms(*longest_ns),
        predicted_ms: predicted.latency_ns.map(ms),
        host_ms: host_ns.map(ms),
        deadline_ms: ms(predicted.deadline_ns),
    }
}

fn process(running: &Running) -> Process<'_> {
    Process {
        process: &running.label,
        host: &running.host,
        running: running.running,
        forced: running.forced.as_deref(),
        violations: violations(running.mark.as_slice()),
    }
}

fn stray(unknown: &Unknown) -> Stray<'_> {
    Stray {
        name: &unknown.name,
        process: &unknown.process,
        core: unknown.callback.core,
        priority: unknown.callback.priority,
        violations: violations(unknown.mark.as_slice()),
    }
}

fn violations(marks: &[Mark]) -> Vec<Violation<'_>> {
    marks.iter().map(|mark| Violation { name: mark.name, explanation: &mark.explanation }).collect()
}

fn times(histogram: &HistogramSnapshot) -> Times {
    let n = histogram.n();
    let some = |time: std::time::Duration| (n > 0).then_some(time.as_nanos() as f64 / 1e6);
    Times { n, p50: some(histogram.p(0.5)), p99: some(histogram.p(0.99)), max: some(histogram.max()) }
}

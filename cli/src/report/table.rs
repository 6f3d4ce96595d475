// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report as a table for people: predictions beside measurements, then violations and their fixes.
use std::io::{self, Write};
use std::time::Duration;

use tautline::HistogramSnapshot;

use super::explain;
use super::host::Share;
use super::run::Run;
use super::verdict::{ChainRow, Comparison, NOTHING, Row, Verdict};
use crate::table::{BAD, GOOD, WARNING, count, ms, wrap, write_table};

/// Writes the whole report; callbacks with a violation are red.
pub fn write(comparison: &Comparison, run: &Run, out: &mut impl Write) -> io::Result<()> {
    let with_host = comparison.rows.iter().any(|row| share(row).is_some());
    let mut head = vec![
        "callback",
        "jobs",
        "R p50\nms",
        "R p99\nms",
        "R max\nms",
        "R+\npredicted",
        "R+\nhost",
        "missed",
        "used max\nms",
        "wcet\nms",
        "apart min\nms",
        "period\nms",
        "queue max\nof capacity",
        "lost",
    ];
    let rows = comparison.rows.iter().map(|row| (row.marks.is_empty(), cells(row)));
    let mut rows: Vec<_> = rows.collect();
    if !with_host {
        head.remove(HOST);
        rows.iter_mut().for_each(|(_, cells)| drop(cells.remove(HOST)));
    }
    write_table(&head, 1, rows, out)?;
    writeln!(out)?;
    chains(comparison, with_host, out)?;
    for unknown in &comparison.unknown {
        let where_it_runs = match (unknown.callback.priority, unknown.callback.core) {
            (Some(priority), Some(core)) => format!("core {core}, {}", explain::level(priority)),
            (Some(priority), None) => explain::level(priority),
            _ => "time sharing".into(),
        };
        let (name, process) = (&unknown.name, &unknown.process);
        let text = format!("`{name}` runs in {process} ({where_it_runs}), but is not in the file.");
        writeln!(out, "{}", wrap(&text))?;
    }
    for (name, mark) in comparison.marks() {
        let text = wrap(&format!("{name}: {}: {}", mark.name, mark.explanation));
        let (first, rest) = text.split_at(name.len() + 2 + mark.name.len());
        writeln!(out, "{BAD}{first}{BAD:#}{rest}")?;
    }
    for note in &comparison.notes {
        writeln!(out, "{WARNING}note:{WARNING:#} {}", wrap(note))?;
    }
    verdict(comparison, run, out)
}

/// Writes the chains, if there are any.
fn chains(comparison: &Comparison, with_host: bool, out: &mut impl Write) -> io::Result<()> {
    if comparison.chains.is_empty() {
        return Ok(());
    }
    let cells = |chain: &ChainRow| {
        let ChainRow { predicted, callbacks, longest_ns, host_ns } = chain;
        let host = with_host.then(|| ms(*host_ns));
        let first = [
            predicted.name.clone(),
            callbacks.len().to_string(),
            ms(Some(*longest_ns)),
            ms(predicted.latency_ns),
        ];
        first.into_iter().chain(host).chain([ms(Some(predicted.deadline_ns))]).collect()
    };
    let host = with_host.then_some("R+\nhost");
    let head = ["chain", "callbacks", "R max\ntogether ms", "R+\npredicted"]
        .into_iter()
        .chain(host)
        .chain(["deadline\nms"]);
    write_table(
        &head.collect::<Vec<_>>(),
        1,
        comparison.chains.iter().map(|chain| (true, cells(chain))).collect(),
        out,
    )?;
    writeln!(out)
}

/// The index of the column with the host's effect on the bound; it is omitted if no process accounts for core time.
const HOST: usize = 6;

fn share(row: &Row) -> Option<&Share> {
    row.measured.as_ref()?.share.as_ref()
}

fn cells(row: &Row) -> Vec<String> {
    let Row { predicted, measured, .. } = row;
    let none = || "-".to_owned();
    let seen = measured.as_ref();
    let time = |histogram: &HistogramSnapshot, value: fn(&HistogramSnapshot) -> Duration| match histogram.n()
    {
        0 => "-".into(),
        _ => ms(u64::try_from(value(histogram).as_nanos()).ok()),
    };
    let response = |value: fn(&HistogramSnapshot) -> Duration| {
        seen.map_or_else(none, |measured| time(&measured.response, value))
    };
    let count = |value: fn(&super::verdict::Measured) -> u64| {
        seen.map_or_else(none, |measured| value(measured).to_string())
    };
    let capacity = predicted.capacity.map_or_else(none, |capacity| capacity.to_string());
    vec![
        predicted.entry.name.clone(),
        count(|measured| measured.callback.completions),
        response(|histogram| histogram.p(0.5)),
        response(|histogram| histogram.p(0.99)),
        response(HistogramSnapshot::max),
        ms(predicted.response_overhead_ns),
        ms(share(row).and_then(|share| share.bound_ns)),
        count(|measured| measured.misses),
        seen.map_or_else(none, |measured| time(&measured.execution, HistogramSnapshot::max)),
        ms(Some(predicted.wcet_ns)),
        ms(seen.and_then(|measured| measured.callback.least_distance_ns)),
        ms(Some(predicted.period_ns)),
        format!("{} of {capacity}", count(|measured| measured.callback.max_queue)),
        count(|measured| measured.callback.lost),
    ]
}

fn verdict(comparison: &Comparison, run: &Run, out: &mut impl Write) -> io::Result<()> {
    let jobs = comparison.jobs();
    let running = run.processes.iter().filter(|process| process.running).count();
    let processes = match (run.processes.len(), running) {
        (1, 1) => "one process".into(),
        (1, _) => "one process, which has ended".into(),
        (all, running) if all == running => format!("{all} processes"),
        (all, running) => format!("{all} processes, {} of them ended", all - running),
    };
    if comparison.verdict == Verdict::Nothing {
        return writeln!(out, "{NOTHING} ({processes}).");
    }
    if comparison.verdict == Verdict::Kept {
        let text = format!("Kept: no assumption of the analysis was violated in {jobs} jobs ({processes}).");
        return writeln!(out, "{GOOD}{text}{GOOD:#}");
    }
    let mut names: Vec<&str> = comparison.marks().map(|(name, _)| name).collect();
    let count = count(names.len(), "assumption");
    names.dedup();
    let text = format!("Violated: {count}, of {}; {jobs} jobs ({processes}).", names.join(", "));
    writeln!(out, "{BAD}{}{BAD:#}", wrap(&text))
}

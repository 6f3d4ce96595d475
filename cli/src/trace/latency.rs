// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut trace latency`: from publication to callback, per callback.

use super::file;
use super::messages::{messages_lost, publications, runs};
use super::output::write_to;
use super::recording::Recording;
use crate::table::write_table;
use crate::times::us;
use crate::verb::Outcome;
use clap::Args;
use hdrhistogram::Histogram;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use tautline_trace::{ObjectId, ObjectKind};

/// Prints the latencies of a recording: from publication to callback start and end, and how long callbacks took
///
/// For a timer's callback the latency counts from the instant at which it was due. Times are in microseconds.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut trace latency run.trace
  taut trace latency run.trace --json | jq '.callbacks[] | {callback, p99: .publish_to_start.p99_us}'")]
pub struct LatencyArgs {
    /// The recording
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

/// The latencies of one callback.
struct Row {
    pid: u32,
    process: String,
    thread: String,
    callback: String,
    /// `None`: a timer, or a stream of the program's own.
    topic: Option<String>,
    to_start: Histogram<u64>,
    to_end: Histogram<u64>,
    duration: Histogram<u64>,
    /// Runs whose message has no publication in the recording.
    unmatched: u64,
    /// `None` also if it is not known what was taken: see [`messages_lost`].
    messages_lost: Option<u64>,
}

pub fn run(args: &LatencyArgs, json: bool) -> Outcome {
    let recording = file::read(&args.file)?;
    let rows = rows(&recording);
    write_to(Path::new("-"), |to| {
        if json { writeln!(to, "{}", to_json(&recording, &rows)) } else { table(&rows, to) }
    })?;
    if !json {
        recording.warnings.iter().for_each(|warning| eprintln!("taut: warning: {warning}"));
    }
    Ok(())
}

pub fn histogram() -> Histogram<u64> {
    // The histogram grows as needed; three is a valid number of significant digits.
    Histogram::new(3).expect("3 is between 0 and 5")
}

/// Records a duration; a duration without an end is omitted.
fn record(to: &mut Histogram<u64>, since_ns: u64, until_ns: Option<u64>) {
    if let Some(until_ns) = until_ns {
        // This cannot fail, because the histogram grows to 64 bits.
        let _ = to.record(until_ns.saturating_sub(since_ns));
    }
}

fn rows(recording: &Recording) -> Vec<Row> {
    let (published, lost) = (publications(recording), messages_lost(recording));
    let mut rows: BTreeMap<(u32, ObjectId), Row> = BTreeMap::new();
    for run in runs(recording) {
        let row = rows.entry((run.process, run.callback)).or_insert_with(|| {
            let callback = recording.object(run.process, run.callback);
            let source = callback.and_then(|callback| recording.object(run.process, callback.parent));
            let subscription = source.filter(|source| source.kind == ObjectKind::Subscription);
            let lost_of = |id| lost.get(&(run.process, id)).copied();
            let (pid, process) = recording.program(run.process);
            Row {
                pid,
                process: process.to_owned(),
                thread: recording.thread_name(run.process, run.tid),
                callback: callback
                    .map_or_else(|| format!("#{}", run.callback.0), |callback| callback.name.clone()),
                topic: subscription.map(|subscription| subscription.name.clone()),
                to_start: histogram(),
                to_end: histogram(),
                duration: histogram(),
                unmatched: 0,
                messages_lost: subscription.and_then(|subscription| lost_of(subscription.id)),
            }
        });
        let since = match (row.topic.is_some(), run.message.and_then(|message| published.get(&message))) {
            (true, Some(publication)) => Some(publication.time_ns),
            (true, None) => None,
            (false, _) => Some(run.release_ns),
        };
        match since {
            Some(since_ns) => {
                record(&mut row.to_start, since_ns, Some(run.start_ns));
                record(&mut row.to_end, since_ns, run.end_ns);
            }
            None => row.unmatched += 1,
        }
        record(&mut row.duration, run.start_ns, run.end_ns);
    }
    rows.into_values().collect()
}

/// The cell of a quantile in µs.
pub fn cell(of: &Histogram<u64>, quantile: f64) -> String {
    if of.is_empty() { "-".to_owned() } else { format!("{:.1}", us(of.value_at_quantile(quantile))) }
}

fn distribution(of: &Histogram<u64>) -> Value {
    let at = |quantile: f64| us(of.value_at_quantile(quantile));
    json!({"n": of.len(), "p50_us": at(0.5), "p99_us": at(0.99), "p99_9_us": at(0.999), "max_us": us(of.max())})
}

fn to_json(recording: &Recording, rows: &[Row]) -> Value {
    let callbacks = rows.iter().map(|row| {
        json!({
            "process": row.process, "pid": row.pid, "thread": row.thread, "callback": row.callback, "topic": row.topic,
            "n": row.duration.len(),
            "publish_to_start": distribution(&row.to_start),
            "publish_to_end": distribution(&row.to_end),
            "duration": distribution(&row.duration),
            "unmatched": row.unmatched, "messages_lost": row.messages_lost,
        })
    });
    json!({
        "session": recording.session,
        "callbacks": callbacks.collect::<Vec<_>>(),
        "events_lost": recording.events_lost(),
        "warnings": recording.warnings,
    })
}

fn table(rows: &[Row], mut to: &mut dyn Write) -> io::Result<()> {
    let head = ["callback", "thread", "what", "n", "p50 µs", "p99 µs", "p99.9 µs", "max µs", "lost"];
    let mut lines = Vec::new();
    for row in rows {
        let since = if row.topic.is_some() { "publish" } else { "release" };
        let parts = [
            (format!("{since} to start"), &row.to_start),
            (format!("{since} to end"), &row.to_end),
            ("duration".to_owned(), &row.duration),
        ];
        for (index, (what, of)) in parts.into_iter().enumerate() {
            let first = |text: &str| if index == 0 { text.to_owned() } else { String::new() };
            let lost = row.messages_lost.map_or_else(|| "-".to_owned(), |lost| lost.to_string());
            let line = vec![
                first(&row.callback),
                first(&format!("{} ({})", row.thread, row.pid)),
                what,
                of.len().to_string(),
                cell(of, 0.5),
                cell(of, 0.99),
                cell(of, 0.999),
                cell(of, 1.0),
                first(&lost),
            ];
            lines.push((true, line));
        }
    }
    write_table(&head, 3, lines, &mut to)?;
    for row in rows.iter().filter(|row| row.unmatched != 0) {
        writeln!(
            to,
            "{}: of {} of its messages the publication is not in the recording",
            row.callback, row.unmatched
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_measured_is_no_latency_of_zero() {
        let mut row = Row {
            pid: 7,
            process: "robot".into(),
            thread: "cb:scan".into(),
            callback: "scan".into(),
            topic: Some("/scan".into()),
            to_start: histogram(),
            to_end: histogram(),
            duration: histogram(),
            unmatched: 1,
            messages_lost: Some(0),
        };
        record(&mut row.duration, 1_000, Some(3_000));
        let mut text = Vec::new();
        table(&[row], &mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        let cells = |what: &str| {
            let line = text.lines().find(|line| line.contains(what)).unwrap();
            line.split(what).nth(1).unwrap().split_whitespace().take(5).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(cells("publish to start"), "0 - - - -", "{text}");
        assert_eq!(cells("duration"), "1 2.0 2.0 2.0 2.0", "{text}");
    }
}

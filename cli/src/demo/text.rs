// SPDX-License-Identifier: MIT OR Apache-2.0
//! The printed report: the table and its summary.

use std::io::{self, Write};

use super::details;
use super::report::{DemoReport, TopicReport};
use crate::table::{BAD, GOOD, wrap, write_spaced_table};

/// The suggestion after a run without a fault.
const NEXT: &str =
    "Next: `taut init robot.toml`; `taut check robot.toml` computes bounds, `taut report` verifies them.";

/// Writes the report for people: the table and its summary, or with `verbose` all circumstances.
///
/// # Errors
/// Whatever `out` fails with.
pub fn write_text(report: &DemoReport, verbose: bool, out: &mut impl Write) -> io::Result<()> {
    write_topics(&report.topics, out)?;
    writeln!(out)?;
    let verdicts: Vec<_> = [deadlines(report), prediction(report)].into_iter().flatten().collect();
    for (holds, text) in &verdicts {
        let style = if *holds { GOOD } else { BAD };
        writeln!(out, "{style}{}{style:#}", wrap(text))?;
    }
    writeln!(out, "{}", wrap(&host(report)))?;
    let explanations = details::explanations(report);
    if verbose {
        let details =
            [details::excesses(report), details::circumstances(report)].into_iter().chain(explanations);
        return details.filter(|text| !text.is_empty()).try_for_each(|text| writeln!(out, "{}", wrap(&text)));
    }
    let is_faultless = report.realtime && verdicts.iter().all(|(holds, _)| *holds);
    let cause = explanations.first().filter(|_| !is_faultless);
    writeln!(out, "{}", wrap(cause.map_or(NEXT, String::as_str)))
}

fn write_topics(topics: &[TopicReport], out: &mut impl Write) -> io::Result<()> {
    let head = [
        "topic",
        "period\nms",
        "wcet\nms",
        "prio",
        "n",
        "p50\nms",
        "p99\nms",
        "max\nms",
        "RTA\nms",
        "RTA+\noverhead",
        "RTA+\nhost",
        "late",
        "lost",
        "max\nqueue",
    ];
    let time = |time: Option<f64>| time.map_or("-".into(), |ms| format!("{ms:.2}"));
    let row = |t: &TopicReport| {
        let cells = vec![
            t.topic.clone(),
            t.period_ms.to_string(),
            t.wcet_ms.to_string(),
            t.priority.to_string(),
            t.n.to_string(),
            time(t.p50_ms),
            time(t.p99_ms),
            time(t.max_ms),
            time(t.rta_ms),
            time(t.rta_overhead_ms),
            time(t.rta_host_ms),
            t.deadline_misses.to_string(),
            t.lost.to_string(),
            t.max_queue.to_string(),
        ];
        (!t.failed(), cells)
    };
    write_spaced_table(1, &head, 1, topics.iter().map(row).collect(), out)
}

/// Whether deadlines were met, and a sentence about it.
fn deadlines(report: &DemoReport) -> Option<(bool, String)> {
    let topics = &report.topics;
    let total: u64 = topics.iter().map(|t| t.n).sum();
    let missed: u64 = topics.iter().map(|t| t.deadline_misses).sum();
    let lost: u64 = topics.iter().map(|t| t.lost).sum();
    if missed > 0 {
        let which = report.list(|t| {
            (t.deadline_misses > 0).then(|| format!("{} ({} of {})", t.topic, t.deadline_misses, t.n))
        });
        let count = if missed == 1 { "One deadline".into() } else { format!("{missed} deadlines") };
        return Some((false, format!("{count} missed: {which}.")));
    }
    if lost > 0 {
        let which = report.list(|t| (t.lost > 0).then(|| format!("{} ({})", t.topic, t.lost)));
        return Some((false, format!("{lost} messages lost: {which}; all others met their deadline.")));
    }
    if topics.iter().any(|t| t.n == 0) {
        return Some((false, "No verdict: not every topic was measured.".into()));
    }
    (total > 0).then(|| (true, format!("All deadlines met: {total} messages, none late, none lost.")))
}

/// Whether the measurement stayed within the prediction, and how close it came; `None` if no bound applies.
fn prediction(report: &DemoReport) -> Option<(bool, String)> {
    if !report.realtime {
        return None;
    }
    let exceeded =
        |t: &TopicReport| (t.unexplained > 0).then(|| format!("{} ({} of {})", t.topic, t.unexplained, t.n));
    let exceeded = report.list(exceeded);
    if !exceeded.is_empty() {
        return Some((false, format!("Prediction exceeded: {exceeded}.")));
    }
    let above: u64 = report.topics.iter().map(|t| t.beyond).sum();
    let (share, topic) = report
        .topics
        .iter()
        .filter_map(|t| Some((t.share_of_bound()?, &t.topic)))
        .max_by(|a, b| a.0.total_cmp(&b.0))?;
    let how = match above {
        0 => String::new(),
        1 => " with what others took (one response)".into(),
        _ => format!(" with what others took ({above} responses)"),
    };
    let text = format!("Prediction held{how}; closest: {topic}, {:.1} % of its bound.", share * 100.0);
    Some((true, text))
}

fn host(report: &DemoReport) -> String {
    format!(
        "The host took {:.2} ms of the core (longest {:.2} ms), other threads {:.2} ms; steal {} ticks.",
        report.taken_running_ms + report.taken_late_ms,
        report.longest_taken_ms,
        report.others_ms,
        report.steal_ticks
    )
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The report for people: table, verdict, circumstances.
use std::io::{self, Write};

use anstyle::Style;
use comfy_table::{CellAlignment, LineStyle, Table, TableStyle};

use super::{DemoReport, TopicReport};
use crate::table::{BAD, GOOD, wrap};

/// Writes the report for people: a table, the verdict, the circumstances, and what explains anything odd.
///
/// # Errors
/// Whatever `out` fails with.
pub fn write_table(report: &DemoReport, out: &mut impl Write, colour: bool) -> io::Result<()> {
    let paint =
        |style: Style, text: &str| if colour { format!("{style}{text}{style:#}") } else { text.into() };

    let table = table(&report.topics);
    let lines: Vec<_> = table.lines().collect();
    let head = lines.len() - report.topics.len();
    for (i, line) in lines.iter().enumerate() {
        let failed = i.checked_sub(head).is_some_and(|row| report.topics[row].failed());
        let line = line.trim_end();
        writeln!(out, "{}", if failed { paint(BAD, line) } else { line.to_owned() })?;
    }
    writeln!(out)?;
    for (holds, text) in [deadline_verdict(report), prediction_verdict(report)].into_iter().flatten() {
        writeln!(out, "{}", paint(if holds { GOOD } else { BAD }, &wrap(&text)))?;
    }
    writeln!(out, "{}", wrap(&circumstances(report)))?;
    explanations(report).iter().try_for_each(|text| writeln!(out, "{}", wrap(text)))
}

fn table(topics: &[TopicReport]) -> Table {
    let style = TableStyle::new().header_separator(LineStyle::none().fill('─').junction('─'));
    let mut table = Table::new();
    table.load_style(style).set_header([
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
    ]);
    let time = |time: Option<f64>| time.map_or("-".into(), |ms| format!("{ms:.2}"));
    for t in topics {
        table.add_row([
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
        ]);
    }
    for (i, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, 1));
        if i > 0 {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}

/// Some microseconds for each job are the kernel's, which changes from one thread to another: of forty jobs a fifth of a millisecond.
const SWITCHES_MS: f64 = 0.5;

/// Whether deadlines were met, in words.
fn deadline_verdict(report: &DemoReport) -> Option<(bool, String)> {
    let topics = &report.topics;
    let total: u64 = topics.iter().map(|t| t.n).sum();
    let missed: u64 = topics.iter().map(|t| t.deadline_misses).sum();
    let lost: u64 = topics.iter().map(|t| t.lost).sum();
    if missed > 0 {
        let which = list(topics, |t| {
            (t.deadline_misses > 0).then(|| format!("{} ({} of {})", t.topic, t.deadline_misses, t.n))
        });
        return Some((false, format!("{missed} deadlines missed: {which}.")));
    }
    if lost > 0 {
        let which = list(topics, |t| (t.lost > 0).then(|| format!("{} ({})", t.topic, t.lost)));
        return Some((false, format!("{lost} messages lost: {which}; all others met their deadline.")));
    }
    if topics.iter().any(|t| t.n == 0) {
        return Some((false, "No verdict: not every topic was measured.".into()));
    }
    (total > 0).then(|| (true, format!("All deadlines met: {total} messages, none late, none lost.")))
}

/// Whether the measurement stayed within the prediction, in words; nothing to say if no bound applies.
fn prediction_verdict(report: &DemoReport) -> Option<(bool, String)> {
    if !report.realtime {
        return None;
    }
    let unexplained = list(&report.topics, |t| (t.unexplained > 0).then(|| t.beyond_prediction())?);
    if !unexplained.is_empty() {
        return Some((false, format!("Prediction exceeded: {unexplained}.")));
    }
    let explained = list(&report.topics, TopicReport::beyond_prediction);
    if !explained.is_empty() {
        let text = format!(
            "Prediction held, except where the host or other threads had the core, or the middleware used more than its mean: {explained}. \
             With what was seen of that before each of these, the prediction allows them all, to the 0.1 ms to which it is known."
        );
        return Some((true, text));
    }
    let share = |t: &TopicReport| Some((t.max_ms? / t.rta_overhead_ms?, t.topic.clone()));
    let (share, topic) = report.topics.iter().filter_map(share).max_by(|a, b| a.0.total_cmp(&b.0))?;
    let text = format!(
        "Prediction held: no response time above RTA+overhead; the closest was {topic} at {:.1} % of it.",
        share * 100.0
    );
    Some((true, text))
}

fn circumstances(report: &DemoReport) -> String {
    format!(
        "{:.1} s on core {}, sampler at priority {}. Measured overhead: {:.1} µs of middleware per message (most at once: {:.0} µs), \
         interruptions of {:.0} µs that take {:.2} % of the core (longest seen before the run: {:.0} µs). \
         Taken by the host during the run: {:.2} ms while threads ran, {:.2} ms before timers were served (longest {:.2} ms); by \
         other threads {:.2} ms; steal {} ticks. Kernel {}, preemption {}.",
        report.seconds,
        report.core,
        report.sampler_priority,
        report.overhead_us,
        report.longest_use_us,
        report.interruption_us,
        report.interrupted_percent,
        report.longest_interruption_us,
        report.taken_running_ms,
        report.taken_late_ms,
        report.longest_taken_ms,
        report.others_ms,
        report.steal_ticks,
        report.kernel,
        report.preemption
    )
}

/// A line for each circumstance that would puzzle a reader of the table.
fn explanations(report: &DemoReport) -> Vec<String> {
    let mut texts = Vec::new();
    if !report.realtime {
        texts.push(
            "Not real-time: no bound applies, and the RTA columns show what real-time priorities would give. \
             Leave --no-rt away; where the system refuses real-time priorities, a banner names what mends it."
                .into(),
        );
    }
    if report.steal_ticks > 0 {
        texts.push(format!(
            "Steal: the hypervisor gave {} ms of processor time to others during the run, as it says; what was seen of it is in RTA+host. \
             Repeat on an idle host, or on hardware of your own.",
            report.steal_ticks * 10
        ));
    }
    let highest = report.topics.iter().map(|t| t.priority).max().unwrap_or(0);
    let sampler_below = report.realtime && report.sampler_priority <= highest;
    if sampler_below {
        texts.push(format!(
            "The sampler, at priority {}, is not above the callbacks ({highest} and less): a message waits until they \
             pause before anybody is told of it. The prediction assumes a sampler above all callbacks.",
            report.sampler_priority
        ));
    }
    let unexplained = report.topics.iter().any(|t| t.unexplained > 0);
    if report.realtime && unexplained && !sampler_below {
        texts.push(
            "What exceeds the prediction was taken neither by the host nor by other threads, nor used by the middleware, as far as \
             threads saw it: look for interrupts, and for a callback whose priority is not its own."
                .into(),
        );
    }
    if report.realtime
        && report.topics.iter().filter_map(|t| t.worst).any(|worst| worst.others_had_ms > SWITCHES_MS)
    {
        texts.push(
            "Other threads had the core while jobs waited for it, or the host did between two threads: real-time threads that are not the \
             demo's, or ordinary ones in the 5 % that Linux keeps for them (since 6.12 /sys/kernel/debug/sched/fair_server, before \
             kernel.sched_rt_runtime_us): move them to another core."
                .into(),
        );
    }
    if report.moments_overwritten > 0 {
        texts.push(format!(
            "{} records of what was taken and used were overwritten before they could be read; responses that they would explain count \
             as unexplained. Leave the other cores some time.",
            report.moments_overwritten
        ));
    }
    let unbounded = list(&report.topics, |t| t.rta_overhead_ms.is_none().then(|| t.topic.clone()));
    if !unbounded.is_empty() {
        texts.push(format!(
            "No prediction for {unbounded}: with the overhead, the work at that priority and above needs more than \
             the core; lower a rate or a wcet."
        ));
    }
    let lossy = list(&report.topics, |t| (t.lost > 0).then(|| t.topic.clone()));
    if !lossy.is_empty() {
        texts.push(format!(
            "Lost on {lossy}: messages were overwritten while their callback was busy; its queue is too short for \
             its response time."
        ));
    }
    let silent = list(&report.topics, |t| (t.n == 0).then(|| t.topic.clone()));
    if !silent.is_empty() {
        texts.push(format!(
            "Nothing arrived on {silent}: the run was shorter than its period, its publisher did not run, or its \
             callback never got the core."
        ));
    }
    let preemption = report.preemption.to_lowercase();
    if preemption.contains("voluntary") || preemption.contains("none") {
        texts.push(format!(
            "A kernel with preemption {} may finish a system call of any thread first; boot with preempt=full, or \
             use a PREEMPT_RT kernel.",
            report.preemption
        ));
    }
    texts
}

fn list(topics: &[TopicReport], text: impl Fn(&TopicReport) -> Option<String>) -> String {
    topics.iter().filter_map(text).collect::<Vec<_>>().join(", ")
}

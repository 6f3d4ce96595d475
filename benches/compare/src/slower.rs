// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a rival is ahead of Tautline as it comes, by how much, and why it stays so.

use std::collections::BTreeSet;
use std::fmt;

use tautline_harness::rows::Metric::{self, CpuTime, Interval, Memory, P50, P99, P999, Start};
use tautline_harness::rows::{By, Compared, Figure, Row};
use tautline_harness::table::size;

use crate::modes::SYSTEMS;

/// A figure that a rival has better.
#[derive(Debug)]
pub struct Slower {
    /// The experiment, the payload and the figure.
    pub what: String,
    pub found: String,
    pub reason: &'static str,
}

impl fmt::Display for Slower {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}; {}", self.what, self.found, self.reason)
    }
}

/// Why a rival is ahead. What was not looked into has no reason.
fn reason(row: &Row, rival: &str, figure: Metric) -> &'static str {
    let (is_of, kind) = (|part: &str| row.experiment.contains(part), row.experiment.split('/').next());
    // Of more, waking is a small part.
    let is_small = row.payload_bytes <= 32 << 10;
    match (kind.unwrap_or_default(), figure) {
        ("latency", P50 | P99 | P999) if is_small && POLLING.iter().any(|mode| rival.ends_with(mode)) => {
            A_BARE_RECEIVE
        }
        ("latency" | "open-loop", P50) if is_small => TWO_WAKES,
        ("latency", P50) => FILLING,
        (_, P99 | P999) => RARE,
        ("fan-out", P50) => TO_ALL,
        ("fan-out", CpuTime) => JANITOR,
        ("robot", P50 | CpuTime) if is_of("/at-once/") => A_THREAD_EACH,
        ("robot", P50 | CpuTime) => TWO_WAKES,
        ("robot", Memory) => STACKS,
        ("throughput", Interval) if !is_small => FILLING,
        ("throughput", Interval) if rival.starts_with("zenoh") => BATCHES,
        ("start-up", Start) if is_of("/100-topics/") => CONNECTED,
        _ => UNKNOWN,
    }
}

const A_BARE_RECEIVE: &str = "its row is a bare receive() of bytes; Tautline's goes to a callback: a header that is checked, numbers that tell what was lost, release and response time of each job";
const TWO_WAKES: &str = "blocking wakes two threads one after the other, the sampler and the callback's, which is what keeps priorities apart and can be bounded; direct and one-thread wake one";
const FILLING: &str = "no cause in Tautline is known: nearly all of it is filling and reading the payload, of which the floor itself differs as much from round to round";
const RARE: &str = "no cause in Tautline is known: a tail of few messages, which changes from run to run";
const TO_ALL: &str = "the sampler's wake comes before the callbacks', and each subscription's callback has a thread of its own";
const A_THREAD_EACH: &str = "a thread for each callback, so that each has its own priority: they are woken one after the other, where one thread of the rival's takes all; one-thread does as it does";
const JANITOR: &str = "in each process a janitor thread looks at the ports when they have changed, which here is spread over some tens of messages; and with several subscriptions in a process a thread is woken for each";
const STACKS: &str = "each of the 20 callbacks has a thread, whose whole stack is touched and locked before it starts (CallbackOptions::stack_bytes sets its size); one-thread does without";
const BATCHES: &str =
    "it packs many small messages into one packet, and one wake delivers them all; Tautline announces each";
const CONNECTED: &str = "each publisher is announced and connected as it is made, some tens of µs; the rest is the tries, one in 10 ms, of which every system needs more than one";
const UNKNOWN: &str = "no reason is known";

/// Less is noise of the machine.
const NOTABLE: f64 = 1.05;
/// Modes that never sleep: they are compared with each other.
const POLLING: [&str; 2] = ["busy-poll", "items"];

/// All of them, in the order of the rows.
pub fn slower(rows: &[Row]) -> Vec<Slower> {
    let mut seen = BTreeSet::new();
    let mut found = Vec::new();
    for row in rows.iter().filter(|row| row.system == "tautline") {
        if !seen.insert((row.experiment.as_str(), row.payload_bytes)) {
            continue;
        }
        for figure in figures(&row.experiment) {
            for system in SYSTEMS.into_iter().filter(|system| !["tautline", "floor"].contains(system)) {
                for is_polling in [false, true] {
                    found.extend(beside(rows, row, *figure, system, is_polling));
                }
            }
        }
    }
    found
}

/// What is compared in an experiment.
fn figures(experiment: &str) -> &'static [Metric] {
    match experiment.split('/').next() {
        Some("latency" | "open-loop") => &[P50, P99, P999],
        Some("robot") => &[P50, CpuTime, Memory],
        Some("throughput") => &[Interval],
        Some("fan-out") => &[P50, CpuTime],
        Some("start-up") => &[Start],
        // Of which Tautline has no way that it has by default.
        _ => &[],
    }
}

fn beside(rows: &[Row], row: &Row, metric: Metric, system: &str, is_polling: bool) -> Option<Slower> {
    let of = |system: &str| -> Vec<&Row> {
        let key = |row: &Row| (row.experiment.clone(), row.payload_bytes);
        rows.iter().filter(|other| other.system == system && key(other) == key(row)).collect()
    };
    let figure = Figure::from(metric);
    let (mut theirs, mut ours) = (of(system), of("tautline"));
    theirs.retain(|row| POLLING.contains(&row.mode.as_str()) == is_polling);
    let default =
        ours.iter().copied().find(|row| row.mode == if is_polling { "busy-poll" } else { "blocking" })?;
    let (theirs, _) = figure.sort(&theirs);
    let them = figure.best(&theirs)?;
    let ratio = Compared::of(default, them, figure, By::Ratio)?.median;
    if ratio < NOTABLE {
        return None;
    }
    let (name, unit) = (them.name(), metric.unit());
    let mut found = format!(
        "{name} {} {unit}, {} {} ({ratio:.2} x)",
        figure.text(them),
        default.mode,
        figure.text(default)
    );
    // A mode that its users can choose instead.
    ours.retain(|row| ["direct", "one-thread"].contains(&row.mode.as_str()) && !is_polling);
    let (ours, _) = figure.sort(&ours);
    if let Some(other) = figure.best(&ours).filter(|other| figure.median(other) < figure.median(default)) {
        found += &format!(", {} {}", other.mode, figure.text(other));
    }
    let reason = reason(row, &name, metric);
    let what = format!("{}, {}, {}", row.experiment, size(row.payload_bytes), metric.name());
    Some(Slower { what, found, reason })
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use tautline_harness::Distribution;
    use tautline_harness::rows::Tally;

    /// A round of 10,000 times.
    pub fn row(experiment: &str, system: &str, mode: &str, bytes: usize, us: f64) -> Row {
        let (mut times, mut tally) = (Distribution::new(), Tally::default());
        times.add(&[((us * 1e3) as u64, 10_000)]);
        tally.add(1, &times).cpu_us_per_msg = Some(us);
        tally.row(experiment, system, mode, bytes)
    }

    #[test]
    fn what_sleeps_is_compared_with_what_sleeps_and_the_better_mode_is_named() {
        let held = "latency/whole/held-off";
        let rows = [
            row(held, "tautline", "blocking", 64, 6.0),
            row(held, "tautline", "direct", 64, 4.0),
            row(held, "tautline", "busy-poll", 64, 1.2),
            row(held, "cyclonedds", "tuned", 64, 5.0),
            row(held, "iceoryx2", "busy-poll", 64, 1.0),
            row(held, "fastdds", "default", 64, 9.0),
            row(held, "floor", "futex", 64, 2.0),
        ];
        let lines: Vec<String> = slower(&rows).iter().map(ToString::to_string).collect();
        let of_p50: Vec<&String> = lines.iter().filter(|line| line.contains(" p50:")).collect();
        assert_eq!(of_p50.len(), 2, "{lines:?}");
        assert!(of_p50[0].contains("iceoryx2 busy-poll 1.00 µs, busy-poll 1.20 (1.20 x);"), "{lines:?}");
        assert!(
            of_p50[1].contains("cyclonedds tuned 5.00 µs, blocking 6.00 (1.20 x), direct 4.00;"),
            "{lines:?}"
        );
    }

    #[test]
    fn what_was_lost_is_not_ahead() {
        let robot = "robot/20x100Hz/as-shipped";
        let rows = [
            row(robot, "tautline", "blocking", 4096, 6.0),
            Row { lost: 1, ..row(robot, "zenoh", "tcp", 4096, 1.0) },
        ];
        assert!(slower(&rows).is_empty());
    }
}

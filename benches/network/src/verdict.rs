// SPDX-License-Identifier: MIT OR Apache-2.0
//! What must hold between the rows of one run. A miss is printed, never an error: the machine has its part in it.
//!
//! Rivals are compared within each round and the median round decides, as in the bench of wake-ups.

use std::fmt;

use crate::plan::{Experiment, System};
use crate::report::{Round, Row, payload};

/// A relation and whether it holds.
pub struct Verdict {
    claim: String,
    unit: &'static str,
    /// Ours and the limit in the median round; `None` if ours was not measured.
    numbers: Option<(f64, f64)>,
    at_most: bool,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Verdict { claim, unit, numbers, at_most } = self;
        let Some((ours, limit)) = numbers else { return write!(f, "{:7} {claim}: not measured", "-") };
        let (holds, bound) = if *at_most { (ours <= limit, "at most") } else { (ours >= limit, "at least") };
        let word = if holds { "holds" } else { "MISSED" };
        write!(f, "{word:7} {claim}: {ours:.1} {unit}, {bound} {limit:.1}")
    }
}

/// All relations, in the order in which they are promised.
pub fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let find = |experiment, system, mode: &str, bytes| {
        rows.iter().find(|row| {
            // Without real-time priorities the mode says so.
            let is_mode =
                row.mode.strip_prefix(mode).is_some_and(|rest| rest.is_empty() || rest.starts_with(", "));
            is_mode && (row.experiment, row.system, row.payload_bytes) == (experiment, system, bytes)
        })
    };
    let of_zenoh = |experiment, bytes| {
        rows.iter().filter(move |row| {
            (row.experiment, row.system, row.payload_bytes) == (experiment, System::Zenoh, bytes)
        })
    };
    let mut verdicts = Vec::new();
    for (bytes, factor) in [(64, 1.5), (1 << 20, 1.1)] {
        let ours = find(Experiment::RoundTrip, System::Tautline, "node-to-node", bytes);
        for theirs in of_zenoh(Experiment::RoundTrip, bytes) {
            verdicts.push(Verdict {
                claim: format!(
                    "{}, round trip, p50 <= {factor} x plain Zenoh, {}",
                    payload(bytes),
                    theirs.mode
                ),
                unit: "µs",
                numbers: median_round(ours, theirs, |round| round.time_us, factor),
                at_most: true,
            });
        }
    }
    for bytes in [64 << 10, 1 << 20] {
        let ours = find(Experiment::Stream, System::Tautline, "window", bytes);
        for theirs in of_zenoh(Experiment::Stream, bytes) {
            verdicts.push(Verdict {
                claim: format!("{}, stream, >= 0.9 x plain Zenoh, {}", payload(bytes), theirs.mode),
                unit: "MB/s",
                numbers: median_round(ours, theirs, |round| round.mb_per_s, 0.9),
                at_most: false,
            });
        }
    }
    let topics = rows.iter().filter(|row| row.experiment == Experiment::Callbacks);
    for flooded in topics {
        let Some(topic) = flooded.mode.strip_prefix("flood ") else { continue };
        let quiet = find(Experiment::Callbacks, System::Tautline, &format!("quiet {topic}"), 0);
        let Some(quiet) = quiet else { continue };
        verdicts.push(Verdict {
            claim: format!("callback of {topic}, p99 <= 1.1 x without the flood"),
            unit: "µs",
            numbers: median_round(Some(flooded), quiet, |round| round.time_us, 1.1),
            at_most: true,
        });
    }
    verdicts
}

/// Ours and the limit in the round where their ratio is the median; the upper one of two.
fn median_round(
    ours: Option<&Row>,
    theirs: &Row,
    number: fn(&Round) -> f64,
    factor: f64,
) -> Option<(f64, f64)> {
    let rounds = ours?.rounds.iter().zip(&theirs.rounds);
    let mut pairs: Vec<_> = rounds.map(|(ours, theirs)| (number(ours), factor * number(theirs))).collect();
    pairs.sort_by(|a, b| (a.0 * b.1).total_cmp(&(b.0 * a.1)));
    pairs.get(pairs.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(system: System, mode: &str, times_us: &[f64]) -> Row {
        Row {
            experiment: Experiment::RoundTrip,
            system,
            mode: mode.to_owned(),
            payload_bytes: 64,
            n: 1,
            p50_us: 0.0,
            p99_us: 0.0,
            p999_us: 0.0,
            max_us: 0.0,
            lost: 0,
            throttled: None,
            mb_per_s: None,
            rounds: times_us.iter().map(|&time_us| Round { time_us, mb_per_s: 0.0 }).collect(),
        }
    }

    #[test]
    fn the_median_round_decides() {
        let ours = row(System::Tautline, "node-to-node", &[50.0, 90.0, 60.0]);
        let theirs = row(System::Zenoh, "pub-sub", &[40.0, 40.0, 40.0]);
        let first = |rows: &[Row]| verdicts(rows)[0].to_string();
        assert!(verdicts(std::slice::from_ref(&ours)).is_empty(), "nothing to compare with");
        assert_eq!(
            first(&[ours.clone(), theirs.clone()]),
            "holds   64 B, round trip, p50 <= 1.5 x plain Zenoh, pub-sub: 60.0 µs, at most 60.0"
        );
        assert!(first(std::slice::from_ref(&theirs)).ends_with("not measured"));
        let slow = row(System::Tautline, "node-to-node", &[61.0]);
        assert!(first(&[slow, theirs]).starts_with("MISSED"));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What must hold between the rows of one run. A miss is printed, never an error: the machine has its part in it.
//!
//! Rivals are compared within each round and the median round decides. Virtual cores move between near and far places
//! of a machine within seconds, and a percentile over all rounds says mostly how often each rival met which.

use std::fmt;

use crate::plan::Idle;
use crate::report::{Round, Row};

const TAUTLINE: [(&str, &str); 3] =
    [("tautline", "same-core"), ("tautline", "one-core"), ("tautline", "busy-poll")];
const SMALL: usize = 64;
const LARGE: usize = 8 << 20;

/// A relation and whether it holds.
pub struct Verdict {
    claim: String,
    /// The measured and the greatest allowed time in µs of the median round; `None` if a row is missing.
    numbers: Option<(f64, f64)>,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.numbers {
            Some((measured, limit)) => {
                let word = if measured <= limit { "holds" } else { "MISSED" };
                write!(f, "{word:7} {}: {measured:.2} µs, at most {limit:.2} µs", self.claim)
            }
            None => write!(f, "{:7} {}: not measured", "-", self.claim),
        }
    }
}

/// Which number of a round.
type Number = fn(&Round) -> f64;

/// All relations, in the order in which they are promised.
pub fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let find = |(system, mode), idle, payload_bytes| {
        rows.iter().find(|row| {
            (row.system, row.mode, row.idle, row.payload_bytes, row.touched)
                == (system, mode, idle, payload_bytes, false)
        })
    };
    let compare =
        |claim: &str, number, ours: Option<&Row>, theirs: Option<&Row>, limit: &dyn Fn(f64) -> f64| {
            let numbers =
                ours.zip(theirs).and_then(|(ours, theirs)| median_round(number, ours, theirs, limit));
            Verdict { claim: claim.to_owned(), numbers }
        };
    let [same_core, one_core, busy_poll] = TAUTLINE;
    let p50: Number = |row| row.p50_us;
    let p99: Number = |row| row.p99_us;
    let floor = ("futex", "blocking");
    let floor_one_core = ("futex", "one-core");

    let shipped = (find(same_core, Idle::Default, SMALL), find(floor, Idle::Default, SMALL));
    let awake = (find(same_core, Idle::Poll, SMALL), find(floor, Idle::Poll, SMALL));
    let one = (find(one_core, Idle::Default, SMALL), find(floor_one_core, Idle::Default, SMALL));
    let busy = (find(busy_poll, Idle::Default, SMALL), find(("iceoryx2", "busy-poll"), Idle::Default, SMALL));
    let large = (find(same_core, Idle::Default, LARGE), find(same_core, Idle::Default, SMALL));
    vec![
        compare("64 B, idle as shipped, p50 <= 1.35 x futex", p50, shipped.0, shipped.1, &|floor| {
            1.35 * floor
        }),
        compare("64 B, idle held off, p50 <= futex + 6 µs", p50, awake.0, awake.1, &|floor| floor + 6.0),
        compare("64 B, idle held off, p99 <= futex + 12 µs", p99, awake.0, awake.1, &|floor| floor + 12.0),
        compare("64 B, all on one core, p50 <= futex + 6 µs", p50, one.0, one.1, &|floor| floor + 6.0),
        compare("64 B, all on one core, p99 <= futex + 12 µs", p99, one.0, one.1, &|floor| floor + 12.0),
        compare("64 B, busy polling, p50 <= 2 x iceoryx2", p50, busy.0, busy.1, &|rival| 2.0 * rival),
        compare("8 MiB untouched, p50 <= 1.2 x that of 64 B", p50, large.0, large.1, &|small| 1.2 * small),
    ]
}

/// Ours and the limit in the round where their ratio is the median; the upper one of two.
fn median_round(number: Number, ours: &Row, theirs: &Row, limit: &dyn Fn(f64) -> f64) -> Option<(f64, f64)> {
    let rounds = ours.rounds.iter().zip(&theirs.rounds);
    let mut pairs: Vec<_> = rounds.map(|(ours, theirs)| (number(ours), limit(number(theirs)))).collect();
    pairs.sort_by(|a, b| (a.0 * b.1).total_cmp(&(b.0 * a.1)));
    pairs.get(pairs.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(system: &'static str, mode: &'static str, times_us: &[f64]) -> Row {
        Row {
            system,
            mode,
            idle: Idle::Default,
            payload_bytes: SMALL,
            touched: false,
            n: 1,
            p50_us: 0.0,
            p99_us: 0.0,
            p999_us: 0.0,
            max_us: 0.0,
            lost: 0,
            rounds: times_us.iter().map(|&time| Round { p50_us: time, p99_us: time }).collect(),
        }
    }

    fn first(rows: &[Row]) -> String {
        verdicts(rows)[0].to_string()
    }

    #[test]
    fn a_verdict_needs_both_rows() {
        let ours = row("tautline", "same-core", &[26.0]);
        let floor = row("futex", "blocking", &[20.0]);
        assert_eq!(
            first(&[ours.clone(), floor.clone()]),
            "holds   64 B, idle as shipped, p50 <= 1.35 x futex: 26.00 µs, at most 27.00 µs"
        );
        assert!(first(&[ours]).ends_with("not measured"));
        let slow = row("tautline", "same-core", &[28.0]);
        assert!(first(&[slow, floor]).starts_with("MISSED"));
    }

    #[test]
    fn rivals_are_compared_in_the_same_round() {
        // Over all rounds ours looks faster than the floor; in two rounds of three it is 1.5 times slower.
        let ours = row("tautline", "same-core", &[3.0, 3.0, 20.0]);
        let floor = row("futex", "blocking", &[2.0, 2.0, 20.0]);
        assert!(first(&[ours, floor]).contains("3.00 µs, at most 2.70 µs"));
    }
}

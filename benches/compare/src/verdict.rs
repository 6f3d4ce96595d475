// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ratios that must hold within a run.

use std::fmt;

use crate::report::{Row, short};

/// What must hold, and what was found. `holds` is `None` where a system was not measured.
#[derive(Debug)]
pub struct Verdict {
    pub claim: String,
    pub found: String,
    pub holds: Option<bool>,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = match self.holds {
            Some(true) => "met",
            Some(false) => "MISSED",
            None => "not measured",
        };
        write!(f, "{word:12}  {}: {}", self.claim, self.found)
    }
}

/// A number of a row.
type Number = fn(&Row) -> Option<f64>;

const P50: Number = |row| row.p50_us;
const P99: Number = |row| row.p99_us;
const P999: Number = |row| row.p999_us;

const MIB: usize = 1 << 20;
/// Systems that are compared as a whole: their best configuration counts.
const RIVALS: [&str; 5] = ["fastdds", "cyclonedds", "zenoh", "hiroz", "r2r"];

/// All of them.
pub fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let rows = Rows(rows);
    let (held, shipped) = ("latency/whole/held-off", "latency/whole/as-shipped");
    let small = |mode| rows.find(held, "tautline", mode, 64);
    let mut all = Vec::new();
    for rival in RIVALS {
        for (name, number) in [("p50", P50), ("p99", P99)] {
            let claim = format!("64 B, blocking, idle states held off: {name} lower than {rival}'s best");
            all.push(at_most(claim, 1.0, small("blocking"), rows.best(held, rival, 64, number), number));
        }
    }
    let iceoryx = |mode| rows.find(held, "iceoryx2", mode, 64);
    all.push(at_most(
        "64 B: p50 within 1.4 x of iceoryx2's WaitSet",
        1.4,
        small("blocking"),
        iceoryx("waitset"),
        P50,
    ));
    all.push(at_most(
        "64 B, busy-polling callback: p50 within 2 x of iceoryx2's busy poll",
        2.0,
        small("busy-poll"),
        iceoryx("busy-poll"),
        P50,
    ));
    all.push(at_most(
        "64 B, as shipped, each system with its own defaults: p50 at most 0.7 x Fast DDS's best",
        0.7,
        rows.find(shipped, "tautline", "own-default", 64),
        rows.best(shipped, "fastdds", 64, P50),
        P50,
    ));
    for bytes in [MIB, 8 * MIB] {
        let size = crate::report::payload(bytes);
        let ours = rows.find(held, "tautline", "blocking", bytes);
        let fast = |mode| rows.find(held, "fastdds", mode, bytes);
        let mut limit = |claim: &str, limit, ours, theirs| {
            all.push(at_most(format!("{size}, written and read whole: {claim}"), limit, ours, theirs, P50));
        };
        limit("within 1.15 x of the floor", 1.15, ours, rows.find(held, "floor", "futex", bytes));
        limit("no slower than Fast DDS's data sharing with loans", 1.0, ours, fast("data-sharing"));
        limit("1.5 x faster than Fast DDS's tuned shared memory", 1.0 / 1.5, ours, fast("tuned"));
        limit("10 x faster than Fast DDS's default", 0.1, ours, fast("default"));
        let image = rows.find(held, "tautline", "image", bytes);
        limit("Image 10 x faster than r2r typed", 0.1, image, rows.find(held, "r2r", "typed", bytes));
    }
    for rival in ["fastdds", "r2r"] {
        let robot = "robot/20x100Hz";
        let cpu: Number = |row| row.cpu_us_per_msg;
        let claim = format!("20 topics at 100 Hz: at most half of {rival}'s CPU time");
        let ours = rows.find(robot, "tautline", "blocking", 4096);
        all.push(at_most(claim, 0.5, ours, rows.best(robot, rival, 4096, cpu), cpu));
    }
    all.push(under_load(&rows));
    all.push(one_wake(&rows));
    all
}

fn at_most(
    claim: impl Into<String>,
    limit: f64,
    ours: Option<&Row>,
    theirs: Option<&Row>,
    number: Number,
) -> Verdict {
    let claim = claim.into();
    let numbers = ours.and_then(number).zip(theirs.and_then(number));
    let (Some((us, them)), Some(theirs)) = (numbers, theirs) else {
        return Verdict { claim, found: "no figures".to_owned(), holds: None };
    };
    let ratio = us / them;
    let rival = format!("{} {}", theirs.system, theirs.mode);
    let found =
        format!("{} µs against {} µs ({rival}): {ratio:.2} x, limit {limit:.2} x", short(us), short(them));
    Verdict { claim, found, holds: Some(ratio <= limit) }
}

/// Its own figures, and what the hypervisor took meanwhile, which explains some of it.
fn under_load(rows: &Rows) -> Verdict {
    let row = |load| rows.find(&format!("open-loop/{load}/held-off"), "tautline", "blocking", 1024);
    let mut verdict = at_most(
        "1 kHz under load: p99.9 at most 3 x that of a quiet machine",
        3.0,
        row("load"),
        row("quiet"),
        P999,
    );
    let steal = row("load").and_then(|row| row.details.as_ref()).map_or(0, |details| details.steal_ticks);
    verdict.found += &format!("; steal of the run under load: {steal} ticks of 10 ms");
    verdict
}

/// The receiver's main thread is its sampler.
fn one_wake(rows: &Rows) -> Verdict {
    let claim =
        "fan-out within a process: the sampler wakes once per message, not per subscription".to_owned();
    let of_count = |count: usize| {
        let row = rows.find(&format!("fan-out/one-process/{count}"), "tautline", "blocking", MIB)?;
        Some((count, row.details.as_ref()?.switches?))
    };
    match [16, 8, 4, 2].into_iter().find_map(of_count) {
        Some((count, wakes)) => Verdict {
            claim,
            found: format!("{wakes:.2} wakes per message with {count} subscriptions"),
            holds: Some(wakes < 1.5),
        },
        None => Verdict { claim, found: "no figures".to_owned(), holds: None },
    }
}

struct Rows<'a>(&'a [Row]);

impl<'a> Rows<'a> {
    fn find(&self, experiment: &str, system: &str, mode: &str, bytes: usize) -> Option<&'a Row> {
        self.of(experiment, system, bytes).find(|row| row.mode == mode)
    }

    /// The configuration with the least of a number.
    fn best(&self, experiment: &str, system: &str, bytes: usize, number: Number) -> Option<&'a Row> {
        let least =
            |a: &&Row, b: &&Row| number(a).unwrap_or(f64::MAX).total_cmp(&number(b).unwrap_or(f64::MAX));
        self.of(experiment, system, bytes).filter(|row| number(row).is_some()).min_by(least)
    }

    fn of(&self, experiment: &str, system: &str, bytes: usize) -> impl Iterator<Item = &'a Row> {
        self.0.iter().filter(move |row| {
            row.experiment == experiment && row.system == system && row.payload_bytes == bytes
        })
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    pub fn row(experiment: &str, system: &str, mode: &str, bytes: usize, us: f64) -> Row {
        Row {
            experiment: experiment.to_owned(),
            system: system.to_owned(),
            mode: mode.to_owned(),
            payload_bytes: bytes,
            n: 1,
            p50_us: Some(us),
            p99_us: Some(us * 2.0),
            p999_us: Some(us * 3.0),
            max_us: Some(us * 4.0),
            lost: 0,
            cpu_us_per_msg: Some(us),
            rss_mib: None,
            note: String::new(),
            details: None,
        }
    }

    fn of<'a>(verdicts: &'a [Verdict], words: &str) -> &'a Verdict {
        verdicts.iter().find(|verdict| verdict.claim.contains(words)).unwrap()
    }

    #[test]
    fn the_best_configuration_of_a_rival_counts_and_what_was_not_measured_is_no_success() {
        let held = "latency/whole/held-off";
        let rows = [
            row(held, "tautline", "blocking", 64, 6.0),
            row(held, "fastdds", "default", 64, 10.0),
            row(held, "fastdds", "data-sharing", 64, 5.0),
            row(held, "iceoryx2", "waitset", 64, 5.0),
            row(held, "tautline", "blocking", MIB, 50.0),
            row(held, "fastdds", "default", MIB, 500.0),
            row(held, "fastdds", "tuned", MIB, 74.0),
        ];
        let verdicts = verdicts(&rows);
        assert_eq!(of(&verdicts, "p50 lower than fastdds's best").holds, Some(false));
        assert_eq!(of(&verdicts, "p50 lower than zenoh's best").holds, None);
        assert_eq!(of(&verdicts, "iceoryx2's WaitSet").holds, Some(true));
        assert_eq!(of(&verdicts, "10 x faster than Fast DDS's default").holds, Some(true));
        assert_eq!(of(&verdicts, "1.5 x faster than Fast DDS's tuned").holds, Some(false));
        assert!(of(&verdicts, "tuned").to_string().starts_with("MISSED"));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ratios that must hold within a run.
//!
//! A machine has slow and fast phases, so figures are compared round by round: rivals run next to each other in each. What is
//! judged is the median of the rounds' ratios.

use std::fmt;

use crate::ratios::{Figure, Ratios, Rows, best, sort, unfit_for};
use crate::report::{Row, payload, short};

/// What must hold, and what was found. `holds` is `None` where that cannot be judged; `found` says why.
#[derive(Debug)]
pub struct Verdict {
    pub claim: String,
    pub found: String,
    pub holds: Option<bool>,
    /// Of a claim that is missed: why it stays so.
    pub reason: Option<&'static str>,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = match self.holds {
            Some(true) => "met",
            Some(false) => "MISSED",
            None => "not judged",
        };
        write!(f, "{word:12}  {}: {}", self.claim, self.found)?;
        match self.reason {
            Some(reason) => write!(f, "; why it stays: {reason}"),
            None => Ok(()),
        }
    }
}

/// Claims that are missed, and why they stay missed.
const REASONS: &[(&str, &str)] = &[
    ("20 topics at 100 Hz, each at its own time: at most half of fastdds's CPU time", A_WAKE_EACH),
    ("20 topics at 100 Hz, each at its own time: at most half of r2r's CPU time", A_WAKE_EACH),
    ("20 topics at 100 Hz, all at once: at most half of fastdds's CPU time", A_LOAN_EACH),
    ("20 topics at 100 Hz, all at once: at most half of r2r's CPU time", A_LOAN_EACH),
];
const A_WAKE_EACH: &str = "most of it is what every system pays here: for each message the sender sleeps, is woken by a timer and interrupts an idle core";
const A_LOAN_EACH: &str = "beyond the floor is what loaning, queueing and taking each of the 20 messages costs, and nobody sleeps between them";
const ONE_WAKE: &str =
    "fan-out within a process: its sampler wakes once per message, not once per subscription";

const MIB: usize = 1 << 20;
/// Systems that are compared as a whole: their best configuration counts.
const RIVALS: [&str; 5] = ["fastdds", "cyclonedds", "zenoh", "hiroz", "r2r"];
/// Tautline's modes whose callback thread sleeps: woken by the sampler, or by the publisher, for one topic or for all of them.
/// The best one counts.
const BLOCKING: &[&str] = &["blocking", "direct", "one-thread"];

const HELD: &str = "latency/whole/held-off";
const SHIPPED: &str = "latency/whole/as-shipped";
const ROBOT: &str = "robot/20x100Hz/as-shipped";
const ROBOT_AT_ONCE: &str = "robot/20x100Hz/at-once/as-shipped";

/// All of them.
pub fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let rows = Rows(rows);
    let mut all = small(&rows);
    for bytes in [MIB, 8 * MIB] {
        all.extend(large(&rows, bytes));
    }
    for (robot, how) in [(ROBOT, "each at its own time"), (ROBOT_AT_ONCE, "all at once")] {
        for rival in ["fastdds", "r2r"] {
            let (ours, theirs) = (rows.find(robot, "tautline", BLOCKING, 4096), rows.all(robot, rival, 4096));
            let floor = rows.find(robot, "floor", &["ring"], 4096);
            let claim = format!("20 topics at 100 Hz, {how}: at most half of {rival}'s CPU time");
            let verdict = at_most(claim, 0.5, &ours, &theirs, Figure::CpuTime);
            all.push(beside_floor(verdict, 0.5, &floor, &theirs, Figure::CpuTime));
        }
    }
    all.push(under_load(&rows));
    all.push(one_wake(&rows));
    for verdict in all.iter_mut().filter(|verdict| verdict.holds == Some(false)) {
        let reason = REASONS.iter().find(|(claim, _)| *claim == verdict.claim);
        verdict.reason = reason.map(|(_, reason)| *reason);
    }
    all
}

/// Of 64 B.
fn small(rows: &Rows) -> Vec<Verdict> {
    let ours = |experiment, modes| rows.find(experiment, "tautline", modes, 64);
    let mut all = Vec::new();
    for rival in RIVALS {
        for figure in [Figure::P50, Figure::P99] {
            let name = figure.name();
            all.push(at_most(
                format!("64 B, blocking, idle states held off: {name} lower than {rival}'s best"),
                1.0,
                &ours(HELD, BLOCKING),
                &rows.all(HELD, rival, 64),
                figure,
            ));
        }
    }
    all.push(at_most(
        "64 B, blocking: p50 within 1.4 x of iceoryx2's WaitSet",
        1.4,
        &ours(HELD, BLOCKING),
        &rows.find(HELD, "iceoryx2", &["waitset"], 64),
        Figure::P50,
    ));
    all.push(at_most(
        "64 B, busy-polling callback: p50 within 2 x of iceoryx2's busy poll",
        2.0,
        &ours(HELD, &["busy-poll"]),
        &rows.find(HELD, "iceoryx2", &["busy-poll"], 64),
        Figure::P50,
    ));
    all.push(at_most(
        "64 B, as shipped, each system with its own defaults: p50 at most 0.7 x Fast DDS's best",
        0.7,
        &ours(SHIPPED, &["own-default"]),
        &rows.all(SHIPPED, "fastdds", 64),
        Figure::P50,
    ));
    all
}

/// Of payloads that are written and read whole.
fn large(rows: &Rows, bytes: usize) -> Vec<Verdict> {
    let size = payload(bytes);
    let mut all = Vec::new();
    let mut limit = |experiment, claim: &str, limit, ours: (&str, &[&str]), theirs: (&str, &[&str])| {
        let idle = if experiment == HELD { "held off" } else { "as shipped" };
        let claim = format!("{size}, written and read whole, idle states {idle}: {claim}");
        let find = |(system, modes)| rows.find(experiment, system, modes, bytes);
        let (ours, theirs, floor) = (find(ours), find(theirs), find(("floor", &["futex"])));
        let verdict = at_most(claim, limit, &ours, &theirs, Figure::P50);
        all.push(beside_floor(verdict, limit, &floor, &theirs, Figure::P50));
    };
    let blocking = ("tautline", BLOCKING);
    let fast = |mode| ("fastdds", mode);
    limit(HELD, "within 1.15 x of the floor", 1.15, blocking, ("floor", &["futex"]));
    limit(
        HELD,
        "no slower than Fast DDS's data sharing with loans",
        1.0,
        blocking,
        fast(&["data-sharing"] as &[&str]),
    );
    limit(HELD, "1.5 x faster than Fast DDS's tuned shared memory", 1.0 / 1.5, blocking, fast(&["tuned"]));
    for (experiment, ours) in [(HELD, BLOCKING), (SHIPPED, &["own-default"] as &[&str])] {
        limit(experiment, "10 x faster than Fast DDS's default", 0.1, ("tautline", ours), fast(&["default"]));
        limit(
            experiment,
            "Image 10 x faster than r2r typed",
            0.1,
            ("tautline", &["image"]),
            ("r2r", &["typed"]),
        );
    }
    all
}

/// Whether the best of `ours` is at most `limit` times the best of `theirs`. What is not fit to be compared never counts for us.
fn at_most(claim: impl Into<String>, limit: f64, ours: &[&Row], theirs: &[&Row], figure: Figure) -> Verdict {
    let verdict = |found: String, holds| Verdict { claim: claim.into(), found, holds, reason: None };
    let (fit_ours, unfit_ours) = sort(ours, figure);
    let (fit_theirs, unfit_theirs) = sort(theirs, figure);
    let (Some(us), Some(them)) = (best(&fit_ours, figure), best(&fit_theirs, figure)) else {
        let mut missing = Vec::new();
        for (side, fit, unfit) in [("ours", fit_ours, unfit_ours), ("theirs", fit_theirs, unfit_theirs)] {
            if fit.is_empty() {
                missing.push(if unfit.is_empty() {
                    format!("{side} not measured")
                } else {
                    unfit.join(", ")
                });
            }
        }
        missing.dedup();
        return verdict(missing.join("; "), None);
    };
    let Some(ratios) = Ratios::of(us, them, figure) else {
        return verdict("no round in which both were measured".to_owned(), None);
    };
    let time = |row| figure.median(row).map_or(String::new(), short);
    let found = format!(
        "{ratios}, limit {limit:.2} x: {} µs ({}) against {} µs ({} {})",
        time(us),
        us.mode,
        time(them),
        them.system,
        them.mode
    );
    let found = match unfit_ours.is_empty() {
        true => found,
        false => format!("{found}; of ours left out: {}", unfit_ours.join(", ")),
    };
    if ratios.median > limit {
        verdict(found, Some(false))
    } else if unfit_theirs.is_empty() {
        verdict(found, Some(true))
    } else {
        verdict(format!("{found}; but not judged: {}", unfit_theirs.join(", ")), None)
    }
}

/// Adds what the floor would have been found with.
fn beside_floor(
    mut verdict: Verdict,
    limit: f64,
    floor: &[&Row],
    theirs: &[&Row],
    figure: Figure,
) -> Verdict {
    let best = best(&sort(theirs, figure).0, figure).filter(|row| row.system != "floor");
    if let ([floor], Some(best)) = (floor, best)
        && let Some(ratio) = Ratios::of(floor, best, figure)
    {
        let beyond = if ratio.median > limit { ": the limit lies below the floor" } else { "" };
        verdict.found += &format!("; the floor itself {:.2} x{beyond}", ratio.median);
    }
    verdict
}

/// Its own figures, and what the hypervisor took meanwhile, which explains some of it.
fn under_load(rows: &Rows) -> Verdict {
    let row = |load| rows.find(&format!("open-loop/{load}/held-off"), "tautline", &["blocking"], 1024);
    let (load, quiet) = (row("load"), row("quiet"));
    let claim = "1 kHz under load: p99.9 at most 3 x that of a quiet machine";
    let mut verdict = at_most(claim, 3.0, &load, &quiet, Figure::P999);
    if let Some(details) = load.first().and_then(|row| row.details.as_ref()) {
        let steal = details.steal_ticks;
        verdict.found += &format!("; steal of the run under load: {steal} ticks of 10 ms");
    }
    verdict
}

/// Of the receiving process, whose main thread is its sampler.
fn one_wake(rows: &Rows) -> Verdict {
    let verdict = |found: String, holds| Verdict { claim: ONE_WAKE.to_owned(), found, holds, reason: None };
    let of_count = |count: usize| {
        let rows =
            rows.find(&format!("fan-out/one-process/held-off/{count}"), "tautline", &["blocking"], MIB);
        let row = *rows.first()?;
        Some((count, row, row.details.as_ref()?.wakes?))
    };
    let Some((count, row, wakes)) = [16, 8, 4, 2].into_iter().find_map(of_count) else {
        return verdict("not measured".to_owned(), None);
    };
    let found = format!(
        "{:.2} wakes of the sampler per message with {count} subscriptions, limit 1.50; the process's other threads, {count} \
         callback threads among them, wake {:.2} times in sum",
        wakes.sampler, wakes.others
    );
    match unfit_for(row, Figure::P50) {
        Some(reason) => verdict(format!("{found}; but it {reason}"), None),
        None => verdict(found, Some(wakes.sampler < 1.5)),
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::report::Round;

    pub fn row(experiment: &str, system: &str, mode: &str, bytes: usize, us: f64) -> Row {
        rounds(experiment, system, mode, bytes, &[us])
    }

    fn rounds(experiment: &str, system: &str, mode: &str, bytes: usize, p50s: &[f64]) -> Row {
        let us = p50s[0];
        let round = |(index, &us): (usize, &f64)| Round {
            round: index as u32 + 1,
            n: 10_000,
            p50_us: us,
            p99_us: us * 2.0,
            p999_us: us * 3.0,
            cpu_us_per_msg: Some(us),
            msgs_per_s: None,
            rss_mib: None,
        };
        Row {
            experiment: experiment.to_owned(),
            system: system.to_owned(),
            mode: mode.to_owned(),
            payload_bytes: bytes,
            n: 10_000,
            p50_us: Some(us),
            p99_us: Some(us * 2.0),
            p999_us: Some(us * 3.0),
            max_us: Some(us * 4.0),
            lost: 0,
            cpu_us_per_msg: Some(us),
            rss_mib: None,
            note: String::new(),
            rounds: p50s.iter().enumerate().map(round).collect(),
            unfit: None,
            details: None,
        }
    }

    fn of<'a>(verdicts: &'a [Verdict], words: &str) -> &'a Verdict {
        verdicts.iter().find(|verdict| verdict.claim.contains(words)).unwrap()
    }

    #[test]
    fn the_best_configuration_of_a_rival_counts_and_what_was_not_measured_is_no_success() {
        let rows = [
            row(HELD, "tautline", "blocking", 64, 6.0),
            row(HELD, "fastdds", "default", 64, 10.0),
            row(HELD, "fastdds", "data-sharing", 64, 5.0),
            row(HELD, "iceoryx2", "waitset", 64, 5.0),
            row(HELD, "tautline", "blocking", MIB, 50.0),
            row(HELD, "fastdds", "default", MIB, 500.0),
            row(HELD, "fastdds", "tuned", MIB, 74.0),
            row(HELD, "floor", "futex", MIB, 60.0),
        ];
        let verdicts = verdicts(&rows);
        assert_eq!(of(&verdicts, "p50 lower than fastdds's best").holds, Some(false));
        assert_eq!(of(&verdicts, "p50 lower than zenoh's best").holds, None);
        assert_eq!(of(&verdicts, "iceoryx2's WaitSet").holds, Some(true));
        let default = of(&verdicts, "held off: 10 x faster than Fast DDS's default");
        assert_eq!(default.holds, Some(true));
        assert!(
            default.found.ends_with("the floor itself 0.12 x: the limit lies below the floor"),
            "{default}"
        );
        assert_eq!(of(&verdicts, "1.5 x faster than Fast DDS's tuned").holds, Some(false));
        assert!(of(&verdicts, "tuned").to_string().starts_with("MISSED"));
    }

    #[test]
    fn rounds_are_compared_with_their_own_rivals() {
        // The machine was slow in one round and in the next it was not: pooled figures would say 14 against 11.
        let rows = [
            rounds(HELD, "tautline", "blocking", 64, &[8.0, 16.0, 14.0]),
            rounds(HELD, "tautline", "direct", 64, &[9.0, 17.0, 15.0]),
            rounds(HELD, "cyclonedds", "tuned", 64, &[10.0, 20.0, 11.0]),
        ];
        let verdicts = verdicts(&rows);
        let verdict = of(&verdicts, "p50 lower than cyclonedds's best");
        assert_eq!(verdict.holds, Some(true));
        assert!(verdict.found.starts_with("0.80 x, the median of 3 rounds (0.80 to 1.27)"), "{verdict}");
        assert!(verdict.found.contains("(blocking)"), "the better one of ours: {verdict}");
    }

    #[test]
    fn what_failed_lost_or_is_of_too_few_is_not_judged() {
        let ours = || row(HELD, "tautline", "blocking", 64, 6.0);
        let theirs = || row(HELD, "fastdds", "default", 64, 10.0);
        let judge = |ours: Row, theirs: Row| {
            let verdicts = verdicts(&[ours, theirs]);
            ["p50", "p99"].map(|name| of(&verdicts, &format!("{name} lower than fastdds's best")).holds)
        };
        assert_eq!(judge(ours(), theirs()), [Some(true); 2]);
        assert_eq!(judge(Row { lost: 1, ..ours() }, theirs()), [None; 2]);
        assert_eq!(judge(ours(), Row { lost: 1, ..theirs() }), [None; 2]);
        assert_eq!(judge(Row { unfit: Some("failed".to_owned()), ..ours() }, theirs()), [None; 2]);
        assert_eq!(judge(Row { n: 999, ..ours() }, theirs()), [Some(true), None]);
        assert_eq!(judge(Row { n: 1000, ..ours() }, theirs()), [Some(true); 2]);
    }

    #[test]
    fn every_reason_belongs_to_a_claim() {
        let verdicts = verdicts(&[]);
        for (claim, _) in REASONS {
            assert!(verdicts.iter().any(|verdict| verdict.claim == *claim), "no such claim: {claim}");
        }
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a smoke run must have found: all that was asked for, and Tautline beside each rival.

use tautline_harness::rows::Row;
use tautline_harness::table::{distinct, size};

use crate::callbacks::{FLOOD, QUIET};
use crate::plan::{Bench, Plan};

/// What is wrong with the rows of a smoke run, beside what failed of Tautline's.
pub fn faults(plan: &Plan, rows: &[Row]) -> Vec<String> {
    let has = |is_it: &dyn Fn(&Row) -> bool| rows.iter().any(|row| row.n > 0 && is_it(row));
    let callbacks: &[&str] = if plan.callbacks.0 > 0 { &[QUIET, FLOOD] } else { &[] };
    let experiments = plan.cases.iter().map(|case| case.experiment.as_str()).chain(callbacks.iter().copied());
    let experiments = distinct(experiments).into_iter().filter(|name| !has(&|row| row.experiment == *name));
    let systems = plan.systems.iter().filter(|name| !has(&|row| row.system == **name)).map(String::as_str);
    let mut faults: Vec<String> =
        experiments.chain(systems).map(|name| format!("nothing was measured of {name}")).collect();
    // That all are asked for is no wish for those that cannot be built here.
    let missing = plan.missing.iter().filter(|_| !plan.systems.is_empty());
    faults.extend(missing.map(|(mode, reason)| format!("{}: not measured: {reason}", mode.name())));
    for row in rows {
        let is_ours = row.system == "tautline";
        let is_beside = |ours: &Row| {
            let place = |row: &Row| (row.experiment.clone(), row.payload_bytes);
            ours.system == "tautline" && place(ours) == place(row)
        };
        // Of plain Zenoh alone.
        let is_alone = plan.bench == Bench::Network && row.experiment.starts_with("throughput/");
        let is_one_by_one = ["latency/", "request/"].iter().any(|kind| row.experiment.starts_with(kind));
        let fault = match row.n {
            0 if row.note.is_empty() => "nothing was measured, and nothing says why".to_owned(),
            1.. if is_ours && is_one_by_one && row.lost > 0 => format!("lost {} messages", row.lost),
            1.. if !is_ours && !is_alone && plan.is_wanted("tautline") && !has(&is_beside) => {
                "tautline has no row beside it".to_owned()
            }
            _ => continue,
        };
        faults.push(format!("{}, {}, {}: {fault}", row.name(), row.experiment, size(row.payload_bytes)));
    }
    faults
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Options;
    use crate::modes::Programs;
    use crate::plan::Case;
    use crate::report::tests::row;
    use clap::Parser;

    /// A plan of these options, with a row for each case.
    fn smoke(options: &str) -> (Plan, Vec<Row>) {
        let options = Options::parse_from(["compare", "--smoke"].into_iter().chain(options.split(' ')));
        let programs = Programs::new(&options.program, &options.without).unwrap();
        let plan = Plan::new(&options, [0, 1], programs).unwrap();
        let of_case =
            |case: &Case| row(&case.experiment, case.mode.system, case.mode.mode, case.payload_bytes, 5.0);
        let rows = plan.cases.iter().map(of_case).collect();
        (plan, rows)
    }

    #[test]
    fn a_smoke_run_fails_without_what_was_asked_for_and_without_us() {
        let (plan, rows) = smoke("--systems tautline,fastdds --program fastdds=x --program gateway=x");
        let fail: fn(&mut Row) = |row| (row.n, row.note) = (0, "FAILED".to_owned());
        let silent =
            "fastdds tuned, latency/whole/held-off, 64 B: nothing was measured, and nothing says why";
        let alone = "fastdds default, start-up/late-joiner/as-shipped, 64 B: tautline has no row beside it";
        let lossy = "tautline blocking, latency/whole/held-off, 64 B: lost 2 messages";
        type Change<'t> = (&'t str, fn(&mut Row), &'t str);
        let changes: [Change<'_>; 8] = [
            ("", |_| {}, ""),
            ("fastdds tuned", fail, ""),
            ("fastdds tuned", |row| row.n = 0, silent),
            ("fastdds", fail, "nothing was measured of fastdds"),
            ("robot/20x100Hz/as-shipped", fail, "nothing was measured of robot/20x100Hz/as-shipped"),
            ("start-up/late-joiner/as-shipped tautline", fail, alone),
            ("latency/whole/held-off tautline", |row| row.lost = 2, lossy),
            ("robot/20x100Hz/as-shipped tautline", |row| row.lost = 2, ""),
        ];
        for (which, change, words) in changes {
            let mut rows = rows.clone();
            let of = |row: &&mut Row| format!("{} {}", row.experiment, row.name()).contains(which);
            rows.iter_mut().filter(of).for_each(change);
            let faults = faults(&plan, &rows);
            assert!(faults.is_empty() == words.is_empty() && faults.join("\n").contains(words), "{faults:?}");
        }
    }

    #[test]
    fn a_smoke_run_fails_without_a_program_only_if_its_system_was_named() {
        let (plan, rows) = smoke("--systems tautline,fastdds --without fastdds=gone --program gateway=x");
        assert!(faults(&plan, &rows).contains(&"fastdds tuned: not measured: gone".to_owned()));
        let (plan, rows) = smoke("--without fastdds=gone");
        assert!(faults(&plan, &rows).is_empty());
    }

    #[test]
    fn a_smoke_run_of_the_network_has_callbacks_and_streams_of_others_alone() {
        let programs = ["zenoh", "hiroz", "gateway", "taut"].map(|name| format!("--program={name}=x"));
        let (plan, mut rows) = smoke(&format!("--bench=network {}", programs.join(" ")));
        assert_eq!(
            faults(&plan, &rows),
            [QUIET, FLOOD].map(|name| format!("nothing was measured of {name}"))
        );
        rows.extend([QUIET, FLOOD].map(|name| row(name, "tautline", "topic1", 0, 5.0)));
        assert!(faults(&plan, &rows).is_empty());
    }
}

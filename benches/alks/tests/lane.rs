// SPDX-License-Identifier: MIT OR Apache-2.0
//! The car keeps its lane: three drives of four simulated minutes at 130 km/h, with curves, gusts and cut-ins.

use tautline_alks::{PLAN_EVERY, STEP_S, drive};

/// From the lane's centre, in m: a car of 1.95 m in a lane of 3.75 m has 0.9 m on either side.
const MOST_M: f64 = 0.5;
/// Of a drive.
const MINUTES: f64 = 4.0;

#[test]
fn minutes_of_curves_and_cut_ins() {
    let seeds = match std::env::var("TAUT_SEED") {
        Ok(seed) => vec![seed.parse().expect("TAUT_SEED is a number")],
        Err(_) => vec![1, 2, 3],
    };
    for seed in seeds {
        let drive = drive::run(seed, MINUTES, |_| {});
        let without_course = drive::Drive { course: Vec::new(), ..drive };
        println!("repeat with TAUT_SEED={seed}: {without_course:?}");
        let drive = without_course;
        assert!(drive.lateral_max_m < MOST_M, "{} m off the centre", drive.lateral_max_m);
        assert_eq!((drive.collisions, drive.unsolved), (0, 0));
        assert!(drive.cut_ins >= 2 && drive.in_curves > 0.3, "too easy");
        let gap_m = drive.gap_min_m.expect("somebody was ahead");
        assert!(gap_m > 5.0 && drive.mean_kmh > 100.0, "{gap_m} m, {} km/h", drive.mean_kmh);
        // Before lines are seen there is nothing to plan.
        let most = (MINUTES * 60.0 / STEP_S) as u64 / PLAN_EVERY;
        assert!((most - 5..=most).contains(&u64::from(drive.plans)), "{} of {most} plans", drive.plans);
    }
}

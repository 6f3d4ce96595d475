// SPDX-License-Identifier: MIT OR Apache-2.0
//! By how much callbacks may grow, compared with searches for each: what is found for all at once holds, and is seldom much less.

#[path = "runtime/made_up.rs"]
#[allow(dead_code)] // it serves a simulation, too
mod made_up;

use made_up::Model;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use tautline_analysis::file::SystemFile;
use tautline_analysis::sensitivity;
use tautline_analysis::system::{Callback, System};

#[test]
fn what_is_found_for_all_at_once_holds_for_each() {
    let mut rng = StdRng::seed_from_u64(tautline_seed::seed());
    let mut shares = Vec::new();
    for round in 0..300 {
        let deadline = format!("deadline = \"{}us\"", rng.random_range(100..2_000));
        let text = Model::random(&mut rng).text().replace("deadline = \"1s\"", &deadline);
        let Ok(file) = SystemFile::parse(&text) else { continue };
        let system = file.system();
        let tasks: Vec<_> = file.callbacks().iter().map(|callback| callback.tasks.clone()).collect();
        let holds = system.analyse().is_ok_and(|report| report.schedulable());
        let Some(factors) = sensitivity::wcet_of_each(system, &tasks) else {
            assert!(!holds, "{round}: {text}");
            continue;
        };
        assert!(holds, "{round}: {text}");
        for (callback, factor) in file.callbacks().iter().zip(factors) {
            let of = |i: usize| system.callbacks[i].copy_of.unwrap_or(i);
            let tasks: Vec<_> =
                (0..system.callbacks.len()).filter(|i| callback.tasks.contains(&of(*i))).collect();
            let grown = grown(system, &tasks, factor);
            let report = grown.analyse().unwrap();
            let why: Vec<_> = report.callbacks.iter().filter_map(|found| found.as_ref().err()).collect();
            assert!(report.schedulable(), "{round}: {} by {factor}: {why:?}\n{text}", callback.name);
            let most = sensitivity::wcet(system, &tasks);
            shares.push((factor - 1_000) as f64 / (most - 1_000).max(1) as f64);
        }
    }
    shares.sort_by(f64::total_cmp);
    let at = |share: f64| shares[((shares.len() - 1) as f64 * share) as usize];
    println!("{} callbacks; found / exact growth: p10 {:.2}, median {:.2}", shares.len(), at(0.1), at(0.5));
    assert!(at(0.5) > 0.2);
}

fn grown(system: &System, tasks: &[usize], factor: u64) -> System {
    let mut grown = system.clone();
    for i in tasks {
        let Callback { task, .. } = &mut grown.callbacks[*i];
        let is_section = task.non_preemptive_ns == task.wcet_ns;
        task.wcet_ns = (u128::from(task.wcet_ns) * u128::from(factor)).div_ceil(1_000) as u64;
        if is_section {
            task.non_preemptive_ns = task.wcet_ns;
        }
    }
    grown
}

/// The deadline is missed on a core other than the first one of the reservation.
#[test]
fn a_reservation_that_misses_a_deadline_on_any_core_has_no_room() {
    let file = SystemFile::parse(include_str!("cases/floating_reservation.toml")).unwrap();
    let tasks: Vec<_> = file.callbacks().iter().map(|callback| callback.tasks.clone()).collect();
    assert!(!file.check().schedulable);
    assert!(sensitivity::wcet_of_each(file.system(), &tasks).is_none());
}

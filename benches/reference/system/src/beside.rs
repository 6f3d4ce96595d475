// SPDX-License-Identifier: MIT OR Apache-2.0
//! The same nodes on Tautline with both system files, and on r2r, in turn.

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use std::io::{IsTerminal, stderr, stdout};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;
use tautline_harness::without_settings;
use tautline_reference::{Job, Kpis};

use crate::bounds::{self, Bounds};
use crate::report::Report;
use crate::{Result, own_file, table, write};

/// From Copper's port of the graph and the report of LaME, measured by their authors on like systems: no machine of ours.
const ELSEWHERE: &str = "From elsewhere, on a like system, 60 s, p99 of three real-time chains in ms, no deadline missed: \
    Copper 151.7, 12.3, 23.5; LaME 113.5, 56.4, 88.9. Other machines and other chains: to be read beside these, not compared.";

/// Nobody else's.
const DOMAIN: &str = "88";
/// What is compared.
struct Contestant {
    name: &'static str,
    program: PathBuf,
    job: Job,
    bounds: Option<Bounds>,
    rounds: Vec<Kpis>,
}

#[derive(Serialize)]
struct Comparison {
    /// Of all rounds.
    systems: Vec<Report>,
    /// Each alone.
    rounds: Vec<Kpis>,
    /// Of runs that are therefore not among them.
    failures: Vec<String>,
    elsewhere: &'static str,
    r2r_left_out: Option<String>,
}

/// Runs each in turn, as a process of its own, as often as `rounds` says. `r2r` is its program, or why there is none.
pub fn run(
    job: &Job,
    r2r: std::result::Result<PathBuf, String>,
    rounds: u32,
    json: Option<&Path>,
) -> Result<()> {
    let mut contestants = contestants(job, r2r.as_ref().ok())?;
    let steps = u64::from(rounds) * contestants.len() as u64;
    let bar = ProgressBar::new(steps);
    bar.set_style(ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed}  {msg}")?);
    bar.enable_steady_tick(Duration::from_secs(1));
    let mut order: Vec<usize> = (0..contestants.len()).rev().collect();
    let mut failures = Vec::new();
    for round in 1..=rounds {
        // To and fro, so that a drift of the machine meets all.
        order.reverse();
        for &index in &order {
            let contestant = &mut contestants[index];
            let message = format!("{}, round {round} of {rounds}", contestant.name);
            if !stderr().is_terminal() {
                eprintln!("{message}: {:.0} s", job.seconds);
            }
            bar.set_message(message);
            match measure(contestant) {
                Ok(kpis) => contestant.rounds.push(kpis),
                // What the others did counts.
                Err(error) => {
                    bar.suspend(|| eprintln!("{error}"));
                    failures.push(error.to_string());
                }
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    let pooled = |it: &Contestant| Some(Report::new(Kpis::pooled(&it.rounds)?, it.bounds.as_ref()));
    let reports: Vec<Report> = contestants.iter().filter_map(pooled).collect();
    table::print(&reports.iter().collect::<Vec<_>>(), &mut stdout().lock())?;
    explain(&reports, r2r.as_ref().err());
    if let Some(path) = json {
        let rounds = contestants.into_iter().flat_map(|contestant| contestant.rounds).collect();
        let all = Comparison {
            systems: reports,
            rounds,
            failures: failures.clone(),
            elsewhere: ELSEWHERE,
            r2r_left_out: r2r.err(),
        };
        write(path, &serde_json::to_string_pretty(&all)?)?;
    }
    if failures.is_empty() { Ok(()) } else { Err(failures.join("\n").into()) }
}

fn contestants(job: &Job, r2r: Option<&PathBuf>) -> Result<Vec<Contestant>> {
    let mut all = Vec::new();
    for (name, file) in [("Tautline, system.toml", "system.toml"), ("Tautline, flat.toml", "flat.toml")] {
        let file = own_file(file);
        let bounds = Some(Bounds::read(&file)?);
        let job = Job { system_file: Some(file), ..job.clone() };
        all.push(Contestant { name, program: std::env::current_exe()?, job, bounds, rounds: Vec::new() });
    }
    if let Some(program) = r2r {
        let placements = bounds::placements(&own_file("system.toml"))?;
        for (name, placements) in [("r2r, one LocalPool", Vec::new()), ("r2r, a thread each", placements)] {
            let (program, job) = (program.clone(), Job { system_file: None, placements, ..job.clone() });
            all.push(Contestant { name, program, job, bounds: None, rounds: Vec::new() });
        }
    }
    Ok(all)
}

/// Runs one as a process of its own. What it complains about is seen.
fn measure(contestant: &Contestant) -> Result<Kpis> {
    let mut command = Command::new(&contestant.program);
    command.arg("--child").arg(serde_json::to_string(&contestant.job)?);
    without_settings(&mut command);
    // r2r would look for others in the whole network, and hear whoever publishes the same topics.
    command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST").env("ROS_DOMAIN_ID", DOMAIN);
    let output = command.stderr(Stdio::inherit()).output();
    let output = output.map_err(|error| format!("{}: {error}", contestant.program.display()))?;
    if !output.status.success() {
        return Err(format!("the run of {} failed: {}", contestant.name, output.status).into());
    }
    Ok(serde_json::from_slice(&output.stdout)?)
}

fn explain(reports: &[Report], r2r_left_out: Option<&String>) {
    println!(
        "Hot path: from the beginning of the FrontLidarDriver's run to the end of the ObjectCollisionEstimator's; below it from that\n\
         of the lidar's run that came first, for either may have to wait. Bounds are those of `taut check`.\n\
         Each in a process of its own, in turn. Tautline: a thread for each callback; it keeps the cores out of idle states by\n\
         itself. r2r: all callbacks on one LocalPool, as its manual shows, and each on a thread with the priority and core of\n\
         system.toml below the thread that spins, as the ECRTS 2025 paper proposes; one node of r2r's, for each has a wait set of\n\
         its own; typed messages, for no package of ROS 2 has one of 4096 bytes that can be loaned."
    );
    let steal: u64 = reports.iter().map(|report| report.kpis.steal_ticks).sum();
    println!("Steal: {steal} ticks of 10 ms in all runs.");
    if let Some(reason) = r2r_left_out {
        println!("r2r LEFT OUT: {reason}");
    }
    println!("{ELSEWHERE}");
}

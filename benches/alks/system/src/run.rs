// SPDX-License-Identifier: MIT OR Apache-2.0
//! Starts the three processes, waits for them, and takes what they tell.

use std::io::{IsTerminal, stderr};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use tautline_alks::job::{Job, Line, Role, Shared};
use tautline_alks::records::Part;
use tautline_harness::{Process, interrupted, without_settings};
use tautline_rt::host::steal_ticks;

use crate::report::{Bounds, Report};
use crate::{Options, Result, own_file, progress, sharing};

/// Longest time for a process to hear its topics, and, once it was told, to end.
const PATIENCE: Duration = Duration::from_secs(30);
/// How often the progress is shown.
const LOOK: Duration = Duration::from_millis(200);
/// Of comparisons, nobody else's; r2r's, too.
const DOMAIN: &str = "87";
/// Whether processes account for the time of their cores, by which `taut report` explains what was late.
const CORE_TIME: &str = "TAUT_CORE_TIME";
/// What is measured in turn.
struct Contestant {
    system: &'static str,
    program: PathBuf,
    job: Job,
    bounds: Option<Bounds>,
    parts: Vec<Vec<Part>>,
    steal_ticks: u64,
}

/// One run, or a comparison in rounds.
pub fn all(options: &Options, realtime: bool) -> Result<Vec<Report>> {
    let file = options.system.clone().unwrap_or_else(|| own_file("system.toml"));
    let bounds = Bounds::read(&file, realtime)?;
    let job = Job {
        role: Role::Adapter,
        seconds: options.seconds,
        seed: options.seed,
        realtime,
        shared: sharing(options.shared),
        system_file: Some(file),
    };
    let program = std::env::current_exe()?;
    let tautline = |shared: Shared| Contestant {
        system: "tautline",
        program: program.clone(),
        job: Job { shared, ..job.clone() },
        bounds: Some(bounds.clone()),
        parts: Vec::new(),
        steal_ticks: 0,
    };
    let compares = options.r2r.is_some() || options.without_r2r.is_some();
    let mut contestants: Vec<_> =
        if compares { Shared::ALL.map(tautline).into() } else { vec![tautline(job.shared)] };
    if let Some(program) = &options.r2r {
        let job = Job { shared: Shared::Mutex, system_file: None, ..job };
        let (system, program, parts) = ("r2r", program.clone(), Vec::new());
        contestants.push(Contestant { system, program, job, bounds: None, parts, steal_ticks: 0 });
    }
    let (rounds, interrupted) = (if compares { options.rounds } else { 1 }, interrupted()?);
    for round in 1..=rounds {
        // To and fro, so that a drift of the machine meets all.
        contestants.reverse();
        for contestant in &mut contestants {
            let what = format!("{}, {}", contestant.system, contestant.job.shared.as_str());
            let bar = progress("")?;
            bar.set_message(if rounds > 1 {
                format!("{what}, round {round} of {rounds}")
            } else {
                what.clone()
            });
            if !stderr().is_terminal() {
                eprintln!("{}: {:.0} s", bar.message(), contestant.job.seconds);
            }
            let before = steal_ticks(None);
            let parts = drive(&contestant.program, &contestant.job, compares, &bar, &interrupted);
            bar.finish_and_clear();
            contestant.parts.push(parts.map_err(|error| format!("{what}: {error}"))?);
            contestant.steal_ticks += steal_ticks(None).saturating_sub(before);
        }
    }
    if rounds % 2 == 1 {
        contestants.reverse();
    }
    if let Some(reason) = &options.without_r2r {
        eprintln!("r2r LEFT OUT: {reason}");
    }
    contestants
        .into_iter()
        .map(|of| Report::new(of.system, &of.job, &of.parts, of.bounds, of.steal_ticks))
        .collect()
}

/// The three processes of one run: their words in the order of [`Role`]. Not `apart` they are in the domain of the environment, where tools
/// find them.
fn drive(
    program: &Path,
    job: &Job,
    apart: bool,
    bar: &ProgressBar,
    interrupted: &AtomicBool,
) -> Result<Vec<Part>> {
    let start = |role| start(program, &Job { role, ..job.clone() }, apart, interrupted);
    let mut listening = [start(Role::Alks)?, start(Role::Visualizer)?];
    for process in &mut listening {
        process.expect(PATIENCE, |line| matches!(line, Line::Ready).then_some(()))?;
    }
    let (begin, limit) = (Instant::now(), Duration::from_secs_f64(job.seconds) + PATIENCE);
    let mut adapter = start(Role::Adapter)?;
    let driven = loop {
        let since = begin.elapsed();
        bar.set_position((since.as_secs_f64() / (job.seconds + 1.5) * 1000.0) as u64);
        let looked = adapter.wait_for(LOOK, part);
        match looked.map_err(|error| format!("after {:.1} s: {error}", since.as_secs_f64()))? {
            Some(part) => break part,
            None if since > limit => return Err(format!("the drive has not ended after {limit:?}").into()),
            None => {}
        }
    };
    adapter.finish()?;
    // The last messages are on their way no longer when the adapter has ended.
    let mut parts = vec![driven];
    for process in &mut listening {
        process.tell("end")?;
        parts.push(process.expect(PATIENCE, part)?);
        process.finish()?;
    }
    Ok(parts)
}

fn part(line: Line) -> Option<Part> {
    match line {
        Line::Part(part) => Some(*part),
        Line::Ready => None,
    }
}

fn start<'a>(
    program: &Path,
    job: &Job,
    apart: bool,
    interrupted: &'a AtomicBool,
) -> Result<Process<'a, Line>> {
    let mut command = Command::new(program);
    command.arg("--child").arg(serde_json::to_string(job)?);
    if apart {
        without_settings(&mut command);
        // r2r would look for others in the whole network, and hear whoever publishes the same topics.
        command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST").env("ROS_DOMAIN_ID", DOMAIN);
    } else if std::env::var_os(CORE_TIME).is_none() {
        command.env(CORE_TIME, "on");
    }
    Process::start(&mut command, format!("{:?} process", job.role), interrupted)
}

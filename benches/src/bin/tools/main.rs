// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut` as users and publishers see it: whether a publisher notices that somebody looks, how long verbs take to answer, whether the
//! rates that they print are true, and how much a recorder takes.

mod disturbance;
mod rates;
mod recording;
mod start;

use clap::{Parser, ValueEnum};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::json;
use std::path::PathBuf;
use std::process::{Child, Command, ExitCode, Stdio};
use tautline_harness::readings::{judge, table};
use tautline_harness::table::distinct;
use tautline_harness::{Disturbance, Result, Run, machine, verdict};
use tautline_rt::{CoreSet, Policy, set_affinity, set_policy};
use tempfile::TempDir;

/// None of ROS 2's own.
const DOMAIN: u32 = 146;

/// Measures the command line's tools.
#[derive(Parser)]
struct Options {
    #[command(flatten)]
    run: Run,
    /// Only this part of it, and each further one that is named
    #[arg(long, value_enum, value_name = "PART")]
    only: Vec<Part>,
    /// The command [default: taut, beside this program]
    #[arg(long, value_name = "FILE")]
    taut: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Part {
    /// What a publisher notices of who looks
    Disturbance,
    /// Whether printed rates are true
    Rates,
    /// How long verbs take
    Start,
    /// A minute of twenty topics and a camera, recorded and played
    Flight,
    /// Long messages as fast as the disk is
    Sequential,
    /// Whether a recorder's memory is the same after ten minutes
    Memory,
}

#[derive(Clone)]
struct Taut(PathBuf);

impl Taut {
    /// With these arguments, in the domain of the measurement.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(&self.0);
        command.args(arguments).env("TAUT_DOMAIN", DOMAIN.to_string()).stderr(Stdio::null());
        command
    }
}

/// A tool that runs until this is dropped.
struct Looking {
    child: Child,
    _folder: TempDir,
}

impl Looking {
    pub fn start(taut: &Taut, arguments: &[&str]) -> Result<Self> {
        // For what it writes.
        let folder = tempfile::tempdir()?;
        let child = taut.command(arguments).current_dir(folder.path()).stdout(Stdio::null()).spawn();
        let child = child.map_err(|error| format!("{}: {error}", taut.0.display()))?;
        Ok(Looking { child, _folder: folder })
    }
}

impl Drop for Looking {
    fn drop(&mut self) {
        let _ = interrupt(&self.child);
        let _ = self.child.wait();
    }
}

/// Asks a tool to end, as Ctrl-C does.
fn interrupt(child: &Child) -> Result {
    let pid = Pid::from_raw(child.id().cast_signed()).ok_or("no process")?;
    Ok(kill_process(pid, Signal::INT)?)
}

/// Moves this thread to the last core allowed and gives it a priority, if it may have one.
fn as_robot(priority: u8) -> Result {
    if let Some(core) = CoreSet::allowed()?.iter().last() {
        set_affinity(CoreSet::one(core))?;
    }
    if let Err(error) = set_policy(Policy::Fifo(priority)) {
        println!("without a real-time priority: {error}");
    }
    Ok(())
}

fn main() -> ExitCode {
    tautline_harness::exit("tools", measure(&Options::parse()))
}

/// Measures the parts, and judges what they found.
fn measure(options: &Options) -> Result {
    let beside = || Some(std::env::current_exe().ok()?.with_file_name("taut"));
    let taut = Taut(options.taut.clone().or_else(beside).ok_or("where is taut? Say it with --taut FILE")?);
    let (machine, disturbance) = (machine(), Disturbance::start());
    let (quick, mut readings) = (options.run.quick, Vec::new());
    if quick {
        println!("a quick run: seconds in place of minutes, smaller images and files");
    }
    for part in Part::value_variants() {
        if !options.only.is_empty() && !options.only.contains(part) {
            continue;
        }
        let help = part.to_possible_value().and_then(|value| value.get_help().map(ToString::to_string));
        println!("\n{}", help.unwrap_or_default());
        let of_it = match part {
            Part::Disturbance => disturbance::measure(&taut, quick)?,
            Part::Rates => rates::measure(&taut, quick)?,
            Part::Start => start::measure(&taut, quick)?,
            Part::Flight => recording::flight(&taut, quick)?,
            Part::Sequential => recording::sequential(&taut, quick)?,
            Part::Memory => recording::memory(&taut, quick)?,
        };
        for experiment in distinct(of_it.iter().map(|one| &one.experiment)) {
            println!("\n{experiment}\n{}", table(of_it.iter().filter(|one| one.experiment == *experiment)));
        }
        readings.extend(of_it);
    }
    let verdicts = judge(&mut readings);
    let disturbance = disturbance.report();
    println!("\n{machine}\n{disturbance}\n");
    let report = json!({"machine": machine, "disturbance": disturbance, "quick": quick, "rows": readings});
    options.run.write(&report).map_err(|error| error.to_string())?;
    verdict::print(&verdicts)
}

/// Why a quick run says nothing of how long something takes.
fn too_short(quick: bool) -> Option<&'static str> {
    quick.then_some("a quick run is too short for that")
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut` as users and publishers see it: whether a publisher notices that somebody looks, how long verbs take to answer, whether the
//! rates that they print are true, and how much a recorder takes.

mod disturbance;
mod rates;
mod recording;
mod start;

use clap::{Parser, ValueEnum};
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;
use serde_json::{Value, json};
use std::error::Error;
use std::path::PathBuf;
use std::process::{Child, Command, ExitCode, Stdio};
use tautline_benches::{Disturbance, machine};
use tempfile::TempDir;

type Result<T = ()> = std::result::Result<T, Box<dyn Error>>;

/// None of ROS 2's own.
const DOMAIN: u32 = 146;

/// Measures the command line's tools.
#[derive(Parser)]
struct Options {
    /// Fewer rounds: half a minute
    #[arg(long)]
    quick: bool,
    /// Only this part of it, and each further one that is named
    #[arg(long, value_enum, value_name = "PART")]
    only: Vec<Part>,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// The command [default: taut, beside this program]
    #[arg(long, value_name = "FILE")]
    taut: Option<PathBuf>,
}

/// One question each.
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

/// The command that is measured.
#[derive(Clone)]
pub struct Taut(PathBuf);

impl Taut {
    /// With these arguments, in the domain of the measurement.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(&self.0);
        command.args(arguments).env("TAUT_DOMAIN", DOMAIN.to_string()).stderr(Stdio::null());
        command
    }
}

/// A tool that runs until this is dropped.
pub struct Looking {
    child: Child,
    _folder: TempDir,
}

impl Looking {
    /// Starts the command with these arguments.
    pub fn start(taut: &Taut, arguments: &[String]) -> Result<Self> {
        // For what it writes.
        let folder = tempfile::tempdir()?;
        let mut command = taut.command(&[]);
        let child = command.args(arguments).current_dir(folder.path()).stdout(Stdio::null()).spawn();
        let child = child.map_err(|error| format!("{}: {error}", taut.0.display()))?;
        Ok(Looking { child, _folder: folder })
    }
}

impl Drop for Looking {
    fn drop(&mut self) {
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, Signal::INT);
        }
        let _ = self.child.wait();
    }
}

fn main() -> ExitCode {
    match measure(&Options::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("tools: {error}");
            ExitCode::FAILURE
        }
    }
}

/// What was measured, to be written, and what does not hold.
fn of<T: Serialize>(measured: Result<(T, Vec<String>)>) -> Result<(Value, Vec<String>)> {
    let (measured, broken) = measured?;
    Ok((serde_json::to_value(measured)?, broken))
}

fn measure(options: &Options) -> Result<bool> {
    let beside = || Some(std::env::current_exe().ok()?.with_file_name("taut"));
    let taut = Taut(options.taut.clone().or_else(beside).ok_or("where is taut? Say it with --taut FILE")?);
    // Before this program confines itself to one core.
    let (machine, watched) = (machine(), Disturbance::start());
    let (mut report, mut broken) = (serde_json::Map::new(), Vec::new());
    let quick = options.quick;
    for part in Part::value_variants() {
        if !options.only.is_empty() && !options.only.contains(part) {
            continue;
        }
        let (key, (measured, wrong)) = match part {
            Part::Disturbance => ("disturbance", of(disturbance::measure(&taut, quick))?),
            Part::Rates => ("rates", of(rates::measure(&taut, quick))?),
            Part::Start => ("start", of(start::measure(&taut, quick))?),
            Part::Flight => ("flight", of(recording::flight(&taut, quick))?),
            Part::Sequential => ("sequential", of(recording::sequential(&taut, quick))?),
            Part::Memory => ("memory", of(recording::memory(&taut, quick))?),
        };
        report.insert(key.to_owned(), measured);
        broken.extend(wrong);
    }
    println!("\n{machine}\n{}", watched.report());
    if let Some(path) = &options.json {
        report.insert("broken".to_owned(), json!(broken));
        tautline_benches::write_json(path, &report)?;
    }
    broken.iter().for_each(|broken| println!("does not hold: {broken}"));
    Ok(broken.is_empty())
}

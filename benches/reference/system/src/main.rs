// SPDX-License-Identifier: MIT OR Apache-2.0
//! The Autoware reference system of the ROS real-time working group: 24 nodes in one process, and what is measured of them.
//!
//! The nodes and their work are in `tautline-reference`; here is what brings their messages ([`robot`]), what the analysis
//! predicts of them ([`bounds`]), and the same nodes on r2r beside it ([`beside`]).
#![forbid(unsafe_code)]

mod beside;
mod bounds;
mod report;
mod robot;
mod table;

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use std::fs;
use std::io::{IsTerminal, stderr, stdout};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use tautline_harness::Result;
use tautline_reference::{CRUNCHER_LIMIT, Job, Load};
use tautline_rt::permission::realtime_permitted;

use bounds::Bounds;
use report::Report;

/// As in `examples/src/lib.rs`: the example cannot run here.
const SKIPPED: u8 = 77;

/// Runs the Autoware reference system: 24 nodes, each callback a thread of its own, with the priorities and cores of a
/// system file; prints its key performance indicators beside what `taut check` predicts.
#[derive(Parser)]
#[command(after_help = "Examples:
  reference_system                        ten seconds, with the hot path at the highest priorities
  reference_system --system examples/systems/reference/flat.toml
                                          every callback at one priority
  reference_system --cruncher-limit 2048  less work for each node
  reference_system --seconds 60 --json kpis.json --svg hot_path.svg
  cargo xtask bench reference-system      the same on r2r over Fast DDS beside it

While it runs, `taut report --watch` compares all callbacks with the file, and explains what was late.")]
struct Options {
    /// How long is measured
    #[arg(long, value_name = "N", default_value_t = 10.0, value_parser = seconds)]
    seconds: f64,
    /// Up to where each node counts primes
    #[arg(long, value_name = "N", default_value_t = CRUNCHER_LIMIT)]
    cruncher_limit: u64,
    /// Who runs where, at which priority [default: its system.toml]
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
    /// Run without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Write the indicators to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Draw the latencies of the hot path
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Run it on r2r, too, in turn with both system files of the example: its program
    #[arg(long, value_name = "PROGRAM", conflicts_with_all = ["system", "svg"])]
    r2r: Option<PathBuf>,
    /// Why r2r is left out of the comparison
    #[arg(long, hide = true, conflicts_with_all = ["r2r", "system", "svg"])]
    without_r2r: Option<String>,
    /// Rounds of a comparison
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// A run of a comparison
    #[arg(long, hide = true)]
    child: Option<String>,
}

/// One of the system files of this system.
fn own_file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../examples/systems/reference").join(name)
}

fn seconds(text: &str) -> std::result::Result<f64, String> {
    match text.parse() {
        Ok(seconds) if (0.5..=86_400.0).contains(&seconds) => Ok(seconds),
        _ => Err("seconds from 0.5 to 86400 are expected".to_owned()),
    }
}

fn main() -> ExitCode {
    match start(&Options::parse()) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("reference_system: {error}");
            ExitCode::FAILURE
        }
    }
}

fn start(options: &Options) -> Result<ExitCode> {
    if let Some(job) = &options.child {
        let job: Job = serde_json::from_str(job)?;
        let load = Load::measure(job.cruncher_limit);
        println!("{}", serde_json::to_string(&robot::run(&job, &load, false, |_| {})?)?);
        return Ok(ExitCode::SUCCESS);
    }
    let realtime = !options.no_rt && std::env::var("TAUT_REALTIME").as_deref() != Ok("off");
    if realtime && let Err(missing) = realtime_permitted(tautline::ContextBuilder::SAMPLER_PRIORITY) {
        eprintln!("{missing}\nTo run without real-time priorities, pass --no-rt.");
        return Ok(ExitCode::from(SKIPPED));
    }
    let load = Load::measure(options.cruncher_limit);
    println!("{load}");
    let system_file = options.system.clone().unwrap_or_else(|| own_file("system.toml"));
    let job = Job {
        seconds: options.seconds,
        cruncher_limit: options.cruncher_limit,
        realtime,
        system_file: Some(system_file),
        placements: Vec::new(),
    };
    if options.r2r.is_some() || options.without_r2r.is_some() {
        let r2r = options.r2r.clone().ok_or_else(|| options.without_r2r.clone().unwrap_or_default());
        beside::run(&job, r2r, options.rounds, options.json.as_deref())?;
    } else {
        alone(&job, &load, options)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// One run on Tautline.
fn alone(job: &Job, load: &Load, options: &Options) -> Result<()> {
    let system_file = job.system_file.as_deref().ok_or("a system file")?;
    let bounds = Bounds::read(system_file)?;
    let bar = if job.seconds > 2.0 { ProgressBar::new(1000) } else { ProgressBar::hidden() };
    bar.set_style(ProgressStyle::with_template("{bar:30} {elapsed} of {msg}")?);
    bar.set_message(format!("{:.0} s", job.seconds));
    if job.seconds > 2.0 && !stderr().is_terminal() {
        eprintln!("measuring for {:.0} s", job.seconds);
    }
    let shown = bar.clone();
    let accounts = std::env::var_os("TAUT_CORE_TIME").is_none();
    let kpis = robot::run(job, load, accounts, move |share| shown.set_position((share * 1000.0) as u64))?;
    bar.finish_and_clear();
    let report = Report::new(kpis, Some(&bounds));
    table::print(&[&report], &mut stdout().lock())?;
    println!("{}", report.about_the_bounds(&bounds));
    if let Some(path) = &options.json {
        write(path, &serde_json::to_string_pretty(&report)?)?;
    }
    if let Some(path) = &options.svg {
        write(path, &report.picture()?)?;
    }
    Ok(())
}

fn write(path: &Path, text: &str) -> Result<()> {
    fs::write(path, text).map_err(|error| format!("{}: {error}", path.display()).into())
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! An automated lane keeping system: three processes, in a closed loop with a simulated car on a simulated motorway.
//!
//! The car, the controllers and the planner are in `tautline-alks`; here is what brings their messages ([`adapter`], [`alks`],
//! [`visualizer`]), who starts them ([`run`]), and what was measured ([`report`], [`page`]).
#![forbid(unsafe_code)]

mod adapter;
mod alks;
mod page;
mod report;
mod ros;
mod run;
mod visualizer;

use std::io::{IsTerminal, stderr};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use tautline::{Context, Realtime};
use tautline_alks::job::{Job, Role, Shared};
use tautline_alks::{drive, picture};
use tautline_harness::{Result, write, write_json};
use tautline_rt::permission::realtime_permitted;

/// As in `examples/src/lib.rs`: the example cannot run here.
const SKIPPED: u8 = 77;
/// Of the samplers in the system files.
const PRIORITY: u8 = 20;

/// Runs an automated lane keeping system: a simulated car with eleven topics, the system that drives it, and a visualizer, in three
/// processes with the priorities of a system file; prints what was measured beside what `taut check` predicts.
#[derive(Parser)]
#[command(after_help = "Examples:
  alks                                     twenty seconds
  alks --system examples/systems/alks/computed.toml --seconds 60
                                           with computed priorities
  alks --shared mutex                      what subscribers and timer share is locked, as in the paper
  alks --json run.json --html run.html --svg drive.svg
  alks drive --minutes 10 --svg drive.svg  the closed loop alone, as fast as the processor can
  cargo xtask bench alks                   the same on r2r over Fast DDS beside it

While it runs, `taut report --watch` compares all callbacks with the file, and explains what was late; `taut record /visualization/markers` keeps the markers as MCAP,
which Foxglove shows; `taut bridge-ros` brings them to rviz.")]
struct Cli {
    #[command(subcommand)]
    verb: Option<Verb>,
    #[command(flatten)]
    options: Options,
}

#[derive(Subcommand)]
enum Verb {
    /// Drives without any middleware, and reports how well the lane was kept
    Drive(DriveOptions),
}

#[derive(Args)]
struct DriveOptions {
    /// Simulated minutes
    #[arg(long, value_name = "N", default_value_t = 10.0, value_parser = minutes)]
    minutes: f64,
    /// Of road, traffic and noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Draw the drive
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print one JSON object instead
    #[arg(long)]
    json: bool,
}

/// How the ALKS node's subscribers share with its timer what they know.
#[derive(Clone, Copy, ValueEnum)]
enum Sharing {
    /// Wait-free
    Latest,
    /// A lock whose holder inherits priorities
    Inherit,
    /// A lock of the standard library
    Mutex,
}

#[derive(Args, Clone)]
struct Options {
    /// How long is measured
    #[arg(long, value_name = "N", default_value_t = 20.0, value_parser = seconds)]
    seconds: f64,
    /// Of road, traffic and noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Who runs where, at which priority [default: its system.toml]
    #[arg(long, value_name = "FILE")]
    system: Option<PathBuf>,
    /// How the ALKS node's subscribers share with its timer what they know
    #[arg(long, value_enum, default_value = "latest")]
    shared: Sharing,
    /// Run without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write tables and histograms to FILE as a page
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Draw the drive
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Run it in each way to share, and on r2r, too: its program
    #[arg(long, value_name = "PROGRAM")]
    r2r: Option<PathBuf>,
    /// Run it in each way to share; why r2r is left out
    #[arg(long, hide = true, conflicts_with = "r2r")]
    without_r2r: Option<String>,
    /// Rounds of a comparison
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// One of the processes
    #[arg(long, hide = true)]
    child: Option<String>,
}

fn seconds(text: &str) -> std::result::Result<f64, String> {
    within(text, 1.0, 86_400.0, "seconds")
}

fn minutes(text: &str) -> std::result::Result<f64, String> {
    within(text, 0.1, 600.0, "minutes")
}

fn within(text: &str, least: f64, most: f64, unit: &str) -> std::result::Result<f64, String> {
    let value = text.parse().ok().filter(|value| (least..=most).contains(value));
    value.ok_or_else(|| format!("{unit} from {least} to {most} are expected"))
}

/// One of the system files of this system.
fn own_file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../examples/systems/alks").join(name)
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let done = match &cli.verb {
        Some(Verb::Drive(options)) => drive_alone(options),
        None => start(&cli.options),
    };
    done.unwrap_or_else(|error| {
        eprintln!("alks: {error}");
        ExitCode::FAILURE
    })
}

fn start(options: &Options) -> Result<ExitCode> {
    if let Some(job) = &options.child {
        be(&serde_json::from_str(job)?)?;
        return Ok(ExitCode::SUCCESS);
    }
    let realtime = !options.no_rt && std::env::var("TAUT_REALTIME").as_deref() != Ok("off");
    if realtime && let Err(missing) = realtime_permitted(PRIORITY) {
        eprintln!("{missing}\nTo run without real-time priorities, pass --no-rt.");
        return Ok(ExitCode::from(SKIPPED));
    }
    let reports = run::all(options, realtime)?;
    report::print(&reports);
    if let Some(path) = &options.json {
        write_json(path, &reports)?;
    }
    if let Some(path) = &options.html {
        write(path, &page::page(&reports)?)?;
    }
    if let (Some(path), Some(drive)) = (&options.svg, reports.first().map(|report| &report.drive)) {
        write(path, &picture::drive(drive)?)?;
    }
    let all_hold = report::all_hold(reports.iter().flat_map(|report| &report.verdicts));
    Ok(if all_hold { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// One of the three processes.
fn be(job: &Job) -> Result<()> {
    let file = job.system_file.as_deref().ok_or("a system file says who runs where")?;
    let realtime = if job.realtime { Realtime::Required } else { Realtime::Off };
    let context = Context::builder().system(file).realtime(realtime).build()?;
    match job.role {
        Role::Adapter => adapter::run(job, &context),
        Role::Alks => alks::run(job, &context),
        Role::Visualizer => visualizer::run(job, &context),
    }
}

fn drive_alone(options: &DriveOptions) -> Result<ExitCode> {
    let bar = progress("simulated")?;
    if !stderr().is_terminal() {
        eprintln!("driving {} simulated minutes", options.minutes);
    }
    let drive = drive::run(options.seed, options.minutes, |share| bar.set_position((share * 1000.0) as u64));
    bar.finish_and_clear();
    if let Some(path) = &options.svg {
        write(path, &picture::drive(&drive)?)?;
    }
    let verdicts = report::verdicts_of_drive(&drive);
    if options.json {
        let drive = drive::Drive { course: Vec::new(), ..drive };
        println!("{}", serde_json::to_string_pretty(&drive)?);
    } else {
        println!("{}", report::about(&drive));
        println!(
            "The planner ran {} times, {:.2} ms on average and at most {:.2} ms; {} without a solution.",
            drive.plans, drive.plan_mean_ms, drive.plan_max_ms, drive.unsolved
        );
        verdicts.iter().for_each(|verdict| println!("{verdict}"));
    }
    Ok(if report::all_hold(&verdicts) { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn progress(what: &'static str) -> Result<ProgressBar> {
    let bar = ProgressBar::new(1000);
    bar.set_style(ProgressStyle::with_template("{bar:30} {elapsed}  {msg}")?);
    bar.set_message(what);
    Ok(bar)
}

const fn sharing(of: Sharing) -> Shared {
    match of {
        Sharing::Latest => Shared::Latest,
        Sharing::Inherit => Shared::Inherit,
        Sharing::Mutex => Shared::Mutex,
    }
}

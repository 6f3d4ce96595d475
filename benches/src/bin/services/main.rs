// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does a request and its response cost, beside a message to and fro on two topics?
//!
//! Two processes, each pinned to a core, real-time; both ends block. The whole round trip is reported. Every system runs in every
//! round, directly after its rivals; ratios are those of the median round. The measuring processes are this binary again,
//! started with `--child`, and r2r's program (`benches/paper-r2r/src/bin/services-r2r.rs`), which `--r2r` names.
//!
//! | module | holds |
//! |---|---|
//! | `child` | one of a pair: the clock of the round trips, Tautline's topics and services |
//! | `iceoryx` | iceoryx2's request-response with an event service to wake, as its users combine them |
//! | `report` | the table, the JSON, what should hold |

mod child;
mod iceoryx;
mod report;

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use clap::Parser;
use serde::{Deserialize, Serialize};
use tautline_benches::pair::Measured;
use tautline_benches::rows::{Row, Tally};
use tautline_benches::{Disturbance, Scratch, exit, interrupted, pair, two_cores, version_of, write_json};
use tautline_rt::permission;

/// What nobody handles but the person who reads it.
pub type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// How long a process may take to set itself up.
const PATIENCE: Duration = Duration::from_secs(30);
/// The priority of the threads that measure.
pub const PRIORITY: u8 = 50;

/// Measures round trips: Tautline's services beside its topics, iceoryx2's request-response and r2r's services over Fast DDS.
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  cargo xtask bench services --quick\n  cargo xtask bench services --json services.json"
)]
struct Options {
    /// Fewer and shorter rounds: some seconds
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Measure without real-time priorities; the numbers then say little
    #[arg(long)]
    no_rt: bool,
    /// r2r's program; without it r2r is left out
    #[arg(long, value_name = "PROGRAM")]
    r2r: Option<PathBuf>,
    /// Why r2r is left out
    #[arg(long, hide = true, default_value = "no program was given with --r2r")]
    without_r2r: String,
    /// Run one process of a pair; the argument is its job
    #[arg(long, hide = true)]
    child: Option<String>,
}

/// A way to ask and to answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum System {
    /// A topic each way.
    Topics,
    /// A service in place.
    Server,
    /// A service with owned messages.
    ServiceOwned,
    /// iceoryx2's request-response, with an event service each way.
    Iceoryx2,
    /// r2r's services, spun as its manual shows, over Fast DDS as it comes.
    R2r,
}

impl System {
    const ALL: [Self; 5] = [Self::Topics, Self::Server, Self::Iceoryx2, Self::ServiceOwned, Self::R2r];

    /// The system and its mode, as in the table and the JSON.
    fn names(self) -> (&'static str, &'static str) {
        match self {
            Self::Topics => ("tautline", "topics"),
            Self::Server => ("tautline", "service, in place"),
            Self::ServiceOwned => ("tautline", "service, owned"),
            Self::Iceoryx2 => ("iceoryx2", "request-response"),
            Self::R2r => ("r2r", "over Fast DDS"),
        }
    }
}

/// What one process of a pair is told.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Job {
    pub(crate) system: System,
    pub(crate) bytes: usize,
    pub(crate) asks: bool,
    pub(crate) core: usize,
    pub(crate) realtime: bool,
    pub(crate) budget: Duration,
    /// Different for each pair.
    pub(crate) pair: String,
    /// Of iceoryx2's files.
    pub(crate) prefix: String,
    pub(crate) directory: PathBuf,
}

/// A line of the result in the making.
struct Cell {
    system: System,
    bytes: usize,
    tally: Tally,
}

impl Cell {
    fn name(&self) -> String {
        let (system, mode) = self.system.names();
        format!("{system} {mode}, {} B", self.bytes)
    }

    fn row(&self) -> Row {
        let (system, mode) = self.system.names();
        self.tally.row(report::EXPERIMENT, system, mode, self.bytes)
    }
}

fn main() -> ExitCode {
    let options = Options::parse();
    let result = match &options.child {
        Some(job) => child::run(job),
        None => measure(&options),
    };
    exit("services", result)
}

fn measure(options: &Options) -> Result<()> {
    if !options.no_rt {
        permission::realtime_permitted(PRIORITY)
            .map_err(|error| format!("{error} (or measure without: --no-rt)"))?;
    }
    let [asking, answering] = two_cores(None)?;
    let interrupted = interrupted()?;
    let (rounds, budget): (u32, u64) = if options.quick { (3, 200) } else { (7, 1000) };
    let sizes = [64, 4 << 10, 1 << 20];
    let r2r = match &options.r2r {
        Some(program) => Some((program.as_path(), versions_of(program)?)),
        None => None,
    };
    if r2r.is_none() {
        eprintln!("r2r is left out: {}", options.without_r2r);
    }
    let mut cells: Vec<_> = sizes
        .into_iter()
        .flat_map(|bytes| System::ALL.map(|system| (system, bytes)))
        // A copy of a MiB is no news.
        .filter(|&(system, bytes)| system != System::ServiceOwned || bytes == 64)
        .filter(|&(system, _)| system != System::R2r || r2r.is_some())
        .map(|(system, bytes)| Cell { system, bytes, tally: Tally::default() })
        .collect();
    let scratch = Scratch::new("services")?;
    let disturbance = Disturbance::start();
    // For all systems alike: of itself only Tautline does so. Ignored: where it is refused, all wake-ups are slower by the same.
    let _idle = tautline_rt::IdleHold::new();
    let progress = indicatif::ProgressBar::new(u64::from(rounds) * cells.len() as u64);
    for round in 1..=rounds {
        for cell in &mut cells {
            progress.set_message(cell.name());
            let job = Job {
                system: cell.system,
                bytes: cell.bytes,
                asks: false,
                core: answering,
                realtime: !options.no_rt,
                budget: Duration::from_millis(budget),
                pair: format!("{}_{round}_{}", std::process::id(), progress.position()),
                prefix: format!("{}{}_", scratch.prefix(), progress.position()),
                directory: scratch.directory().to_owned(),
            };
            let program = match (cell.system, &r2r) {
                (System::R2r, Some((program, _))) => program.to_path_buf(),
                _ => std::env::current_exe()?,
            };
            let measured = run_pair(&program, &job, asking, &interrupted)
                .map_err(|error| format!("{}: {error}", cell.name()))?;
            cell.tally.add_measured(round, &measured);
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    let r2r = r2r.map_or_else(|| format!("r2r LEFT OUT: {}", options.without_r2r), |(_, versions)| versions);
    let versions = format!("iceoryx2 {}, {r2r}", version_of("iceoryx2").unwrap_or("?"));
    let rows = cells.iter().map(Cell::row).collect();
    let report = report::print(rows, &disturbance.report(), versions)?;
    match &options.json {
        Some(path) => write_json(path, &report),
        None => Ok(()),
    }
}

/// What r2r's program says that it is made of.
fn versions_of(program: &Path) -> Result<String> {
    let output = Command::new(program).arg("--version").output()?;
    if !output.status.success() {
        let reason = String::from_utf8_lossy(&output.stderr);
        return Err(format!("{}: {}", program.display(), reason.trim()).into());
    }
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

fn run_pair(program: &Path, job: &Job, asking: usize, interrupted: &AtomicBool) -> Result<Measured> {
    let command = |job: &Job| -> Result<Command> {
        let mut command = Command::new(program);
        // Of r2r, which would look for others in the whole network.
        command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
        command.arg("--child").arg(serde_json::to_string(job)?);
        Ok(command)
    };
    let pair = [command(job)?, command(&Job { asks: true, core: asking, ..job.clone() })?];
    // The one that answers does so for ever.
    pair::measure(pair, PATIENCE + 2 * job.budget, interrupted).map(|(measured, _)| measured)
}

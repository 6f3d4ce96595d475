// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does a request and its response cost, beside a message to and fro on two topics?
//!
//! Two processes, each pinned to a core, real-time; both ends block. The whole round trip is reported. Every system runs in every
//! round, directly after its rivals; ratios are those of the median round. The measuring processes are this binary again,
//! started with `--child`.
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
use std::io::{BufRead, BufReader, Read};
use std::path::PathBuf;
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::Duration;

use clap::Parser;
use serde::{Deserialize, Serialize};
use tautline_benches::{Distribution, Disturbance};
use tautline_rt::{CoreSet, permission};

/// What nobody handles but the person who reads it.
pub type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// The priority of the threads that measure.
pub const PRIORITY: u8 = 50;

/// Measures round trips: Tautline's services beside its topics and iceoryx2's request-response.
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
    ServiceLoaned,
    /// A service with owned messages.
    ServiceOwned,
    /// iceoryx2's request-response, with an event service each way.
    Iceoryx2,
}

impl System {
    const ALL: [Self; 4] = [Self::Topics, Self::ServiceLoaned, Self::Iceoryx2, Self::ServiceOwned];

    pub fn name(self) -> &'static str {
        match self {
            Self::Topics => "tautline topics",
            Self::ServiceLoaned => "tautline service, in place",
            Self::ServiceOwned => "tautline service, owned",
            Self::Iceoryx2 => "iceoryx2 request-response",
        }
    }
}

/// What one process of a pair is told.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Job {
    pub system: System,
    pub bytes: usize,
    pub asks: bool,
    pub core: usize,
    pub realtime: bool,
    pub budget: Duration,
    /// Different for each pair.
    pub pair: String,
}

/// A line of the result.
pub struct Cell {
    pub system: System,
    pub bytes: usize,
    pub all: Distribution,
    pub rounds_p50_us: Vec<f64>,
}

fn main() -> ExitCode {
    let options = Options::parse();
    let result = match &options.child {
        Some(job) => child::run(job),
        None => measure(&options),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("services: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(options: &Options) -> Result<()> {
    if !options.no_rt {
        permission::realtime_permitted(PRIORITY)
            .map_err(|error| format!("{error} (or measure without: --no-rt)"))?;
    }
    let cores: Vec<_> = CoreSet::allowed()?.iter().take(2).collect();
    let [asking, answering] = cores[..] else { return Err("two cores are needed".into()) };
    let (rounds, budget) = if options.quick { (3, 200) } else { (7, 1000) };
    let sizes = [64, 4 << 10, 1 << 20];
    let mut cells: Vec<_> = sizes
        .into_iter()
        .flat_map(|bytes| System::ALL.map(|system| (system, bytes)))
        // A copy of a MiB is no news.
        .filter(|&(system, bytes)| system != System::ServiceOwned || bytes == 64)
        .map(|(system, bytes)| Cell { system, bytes, all: Distribution::new(), rounds_p50_us: vec![] })
        .collect();
    let disturbance = Disturbance::start();
    let progress = indicatif::ProgressBar::new((rounds * cells.len()) as u64);
    for round in 0..rounds {
        for cell in &mut cells {
            progress.set_message(format!("{}, {} B", cell.system.name(), cell.bytes));
            let job = Job {
                system: cell.system,
                bytes: cell.bytes,
                asks: false,
                core: answering,
                realtime: !options.no_rt,
                budget: Duration::from_millis(budget),
                pair: format!("{}_{round}_{}", std::process::id(), progress.position()),
            };
            let measured = run_pair(&job, asking)
                .map_err(|error| format!("{}, {} B: {error}", cell.system.name(), cell.bytes))?;
            let mut distribution = Distribution::new();
            distribution.add(&measured);
            cell.rounds_p50_us.push(distribution.quantile_us(0.5));
            cell.all.add(&measured);
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    let verdict = report::print(&cells, &disturbance.report());
    match &options.json {
        Some(path) => report::write_json(path, &cells, &verdict),
        None => Ok(()),
    }
}

/// Round trips in ns and how often each occurred.
fn run_pair(job: &Job, asking: usize) -> Result<Vec<(u64, u64)>> {
    let mut answers = Peer::start(job)?;
    if answers.line()?.trim() != "ready" {
        return Err(format!("the answering process ended: {}", answers.last_words()).into());
    }
    let mut asks = Peer::start(&Job { asks: true, core: asking, ..job.clone() })?;
    let line = asks.line()?;
    serde_json::from_str(&line)
        .map_err(|_| format!("{}; its peer: {}", asks.last_words(), answers.last_words()).into())
}

/// A process of a pair; ended on drop.
struct Peer {
    child: Child,
    output: BufReader<std::process::ChildStdout>,
}

impl Peer {
    fn start(job: &Job) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.arg("--child").arg(serde_json::to_string(job)?).stdin(Stdio::null());
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
        let output = BufReader::new(child.stdout.take().ok_or("a pipe")?);
        Ok(Peer { child, output })
    }

    /// Its next line; empty if it ended.
    fn line(&mut self) -> Result<String> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        Ok(line)
    }

    fn last_words(&mut self) -> String {
        let _ = self.child.kill();
        let mut words = String::new();
        if let Some(mut errors) = self.child.stderr.take() {
            let _ = errors.read_to_string(&mut words);
        }
        words.trim().to_owned()
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // Ignored: both fail only if it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

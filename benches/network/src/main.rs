// SPDX-License-Identifier: MIT OR Apache-2.0
//! What do the gateways cost? Node to node over two of them, beside plain Zenoh and hiroz, on the loopback of one machine.
//!
//! Two processes exchange messages, round trips and streams; every system runs in every round, directly after its rivals.
//! Each end has a core, which the gateway of that end shares with it. The measuring processes are this binary again, started
//! with `--child`, and hiroz's program.
//!
//! | module | holds |
//! |---|---|
//! | `plan` | what is measured: systems, payloads, rounds |
//! | `rounds` | starts the pairs, merges what they measured |
//! | `tautline`, `zenoh` | the systems; hiroz's is `benches/network-hiroz` |
//! | `callbacks` | real-time callbacks, with and without a flood from the network |
//! | `report` | what is said of the rows |

mod callbacks;
mod plan;
mod report;
mod rounds;
mod tautline;
mod zenoh;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use plan::{Experiment, Plan, System};
use report::Report;
use tautline_benches::{Disturbance, exit, interrupted, two_cores, write_json};
use tautline_exchange::{Job, NETWORK_PRIORITY};
use tautline_rt::permission;

/// What nobody handles but the person who reads it.
type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Measures topics over two gateways beside plain Zenoh and hiroz, and what a flood costs local callbacks.
#[derive(Parser)]
#[command(after_help = "Examples:
  cargo xtask bench network --quick                           under two minutes
  cargo xtask bench network --json network.json               some nine minutes
  cargo xtask bench network -- --only stream --systems tautline,zenoh")]
struct Options {
    /// Fewer and shorter rounds
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// How often each is measured
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    rounds: Option<u32>,
    /// Measure without real-time priorities; the numbers then say little
    #[arg(long)]
    no_rt: bool,
    /// The two cores, one for each host [default: the first two allowed]
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    cores: Option<Vec<usize>>,
    /// Leave the threads to the scheduler: any core
    #[arg(long, conflicts_with = "cores")]
    no_cores: bool,
    /// Only these experiments [default: all]
    #[arg(long, value_name = "EXPERIMENT,...", value_delimiter = ',', value_enum)]
    only: Vec<Experiment>,
    /// Only these systems [default: all]
    #[arg(long, value_name = "SYSTEM,...", value_delimiter = ',', value_enum)]
    systems: Vec<System>,
    /// hiroz's program [default: network-hiroz beside this one]
    #[arg(long, value_name = "PROGRAM")]
    hiroz: Option<PathBuf>,
    /// Why hiroz is left out
    #[arg(long, value_name = "REASON", conflicts_with = "hiroz")]
    without_hiroz: Option<String>,
    /// The gateway [default: taut-gateway beside this program]
    #[arg(long, value_name = "PROGRAM")]
    gateway: Option<PathBuf>,
    /// The program with the demo [default: taut beside this program]
    #[arg(long, value_name = "PROGRAM")]
    taut: Option<PathBuf>,
    /// Run one process of a pair; the argument is its job
    #[arg(long, hide = true, num_args = 2, value_names = ["SYSTEM", "JOB"])]
    child: Option<Vec<String>>,
}

fn main() -> ExitCode {
    let options = Options::parse();
    let result = match options.child.as_deref() {
        Some([system, job]) => child(system, job).map_err(|error| error as Box<dyn std::error::Error>),
        _ => measure(&options),
    };
    exit("network", result)
}

fn child(system: &str, job: &str) -> tautline_exchange::Result<()> {
    let job = Job::begin(job)?;
    match system {
        "tautline" => tautline::run(&job),
        _ => zenoh::run(&job),
    }
}

fn measure(options: &Options) -> Result<()> {
    if !options.no_rt {
        // The gateway's budget looks from above.
        permission::realtime_permitted(NETWORK_PRIORITY + 1)
            .map_err(|error| format!("{error} (or measure without: --no-rt)"))?;
    }
    let plan = Plan::new(options, two_cores(options.cores.as_deref())?)?;
    let interrupted = interrupted()?;
    let disturbance = Disturbance::start();
    let mut rows = rounds::run(&plan, &interrupted)?;
    let mut flood = None;
    if plan.experiments.contains(&Experiment::Callbacks) {
        let (more, arrived) = callbacks::run(&plan, &interrupted)?;
        rows.extend(more);
        flood = Some(arrived);
    }
    let report = Report { rows, flood, disturbance: disturbance.report() };
    report.print(&plan)?;
    match &options.json {
        Some(path) => write_json(path, &report.rows),
        None => Ok(()),
    }
}

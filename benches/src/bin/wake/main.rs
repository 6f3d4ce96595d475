// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long does it take from `send` in one process to the receiver's code in another?
//!
//! Two processes, real-time, each pinned to a core, send one message to and fro; half of the round trip is reported.
//! Every system runs in every round, directly after its rivals. The measuring processes are this binary again, started
//! with `--child`.
//!
//! | module | holds |
//! |---|---|
//! | `plan` | what is measured: modes, payloads, idle states, rounds |
//! | `rounds` | the parent: starts the pairs, merges what they measured |
//! | `child` | one of a pair: the round trip's clock (`Pinger`), set-up, the loops over a `Link` |
//! | `payload` | what a message contains |
//! | `futex`, `iceoryx`, `tautline` | the systems |
//! | `report` | what is said of the rows |

mod child;
mod futex;
mod iceoryx;
mod payload;
mod plan;
mod report;
mod rounds;
mod tautline;

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use tautline_benches::{exit, two_cores, write_json};
use tautline_rt::permission;

/// What nobody handles but the person who reads it.
pub type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Measures the wake-up from one process to another: Tautline beside a bare futex and iceoryx2.
#[derive(Parser)]
struct Options {
    /// Fewer payloads and rounds: under a minute
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Measure without real-time priorities; the numbers then say little
    #[arg(long)]
    no_rt: bool,
    /// The two cores, the sender's and the receiver's [default: the first two allowed]
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    cores: Option<Vec<usize>>,
    /// Run one process of a pair; the argument is its job
    #[arg(long, hide = true)]
    child: Option<String>,
}

fn main() -> ExitCode {
    let options = Options::parse();
    let result = match &options.child {
        Some(job) => child::run(job),
        None => measure(&options),
    };
    exit("wake", result)
}

fn measure(options: &Options) -> Result<()> {
    if !options.no_rt {
        permission::realtime_permitted(plan::PRIORITY)
            .map_err(|error| format!("{error} (or measure without: --no-rt)"))?;
    }
    let plan = plan::Plan::new(options.quick, two_cores(options.cores.as_deref())?, !options.no_rt);
    let rows = rounds::run(&plan)?;
    report::print(&plan, &rows)?;
    if let Some(path) = &options.json {
        write_json(path, &rows.rows)?;
    }
    let lost_messages = rows.rows.iter().any(|row| row.system == "tautline" && row.lost > 0);
    if lost_messages { Err("tautline lost wake-ups".into()) } else { Ok(()) }
}

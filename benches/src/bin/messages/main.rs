// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does it cost to write a message, publish it, and read it, beside filling and reading a plain buffer, and beside
//! encoding and decoding it?
//!
//! One process, one core: costs are compared, not latencies. Every implementation runs in every round, directly after its
//! rivals, on the same values; a row's ratio is that of the median round.
//!
//! | module | holds |
//! |---|---|
//! | `cases` | the messages and, for each, the ways to handle it |
//! | `rivals` | the same messages for `cdr-encoding` and `hiroz-cdr` |
//! | `topic` | a topic within this process |
//! | `rounds` | runs the ways in turn and times them |
//! | `report` | the table, the JSON, what must hold |

mod cases;
mod report;
mod rivals;
mod rounds;
mod topic;

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;

/// What nobody handles but the person who reads it.
pub type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Measures messages: in place through a topic, owned, and with other encoders.
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  cargo xtask bench messages --quick\n  cargo xtask bench messages --json messages.json"
)]
struct Options {
    /// Fewer rounds: some seconds
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// The core to run on [default: the last one allowed]
    #[arg(long, value_name = "CORE")]
    core: Option<usize>,
}

fn main() -> ExitCode {
    tautline_benches::exit("messages", measure(&Options::parse()))
}

fn measure(options: &Options) -> Result<()> {
    let core = rounds::pin(options.core)?;
    let disturbance = tautline_benches::Disturbance::start();
    let rows = rounds::run(&mut cases::all()?, options.quick)?;
    report::print(&rows, core, &disturbance.report());
    match &options.json {
        Some(path) => tautline_benches::write_json(path, &rows),
        None => Ok(()),
    }
}

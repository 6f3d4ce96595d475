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
//! | `report` | the table |

mod cases;
mod report;
mod rivals;
mod rounds;
mod topic;

use std::process::ExitCode;

use clap::Parser;
use tautline_harness::{Documented, Result, one_core};
use tautline_rt::CoreSet;

/// Measures messages: in place through a topic, owned, and with other encoders.
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  cargo xtask bench messages --quick\n  cargo xtask bench messages --json messages.json"
)]
struct Options {
    #[command(flatten)]
    documented: Documented,
    /// The core to run on [default: the last one allowed]
    #[arg(long, value_name = "CORE")]
    core: Option<usize>,
}

fn main() -> ExitCode {
    tautline_harness::exit("messages", measure(&Options::parse()))
}

fn measure(options: &Options) -> Result<()> {
    let core = one_core(options.core)?;
    tautline_rt::set_affinity(CoreSet::one(core))?;
    let disturbance = tautline_harness::Disturbance::start();
    let rows = rounds::run(&mut cases::all()?, options.documented.run.quick)?;
    report::print(&rows, core, &disturbance.report())?;
    options.documented.write(&rows, || report::document(&rows))
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut demo`: the paper's application, five periodic topics on one core, measured beside its prediction.
//!
//! Three processes: this one starts a publisher and a subscriber, shows the progress and prints the report. They
//! end when their standard input is closed, so they also end if this process is killed.

mod application;
mod conductor;
mod losses;
mod output;
pub mod plot;
mod process;
mod protocol;
mod publisher;
mod report;
mod subscriber;

use crate::verb::{Failure, Outcome};
use clap::{Args, ValueEnum};
use std::path::PathBuf;
use std::process::ExitCode;
use tautline_rt::RtError;

/// Runs five periodic topics on one core and compares their response times with the prediction.
///
/// A publisher process releases messages at absolute times (every 10, 20, 50, 100 and 200 ms); a subscriber process runs
/// one callback thread per topic at rate-monotonic priorities, all on one core, 90 % loaded. At the end: response times
/// from scheduled release to end of callback beside the computed bounds, as a table, an SVG and (on request) JSON.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut demo                           ten seconds, table on the terminal, picture in taut-demo.svg
  taut demo --seconds 60 --json r.json
  taut demo --no-rt                   without real-time priorities: see what they are for
  taut demo --sampler-priority 15     the sampler below the callbacks: topics 1 to 3 miss their deadlines")]
pub struct DemoArgs {
    /// Length of the measurement
    #[arg(long, default_value_t = 10, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=3600))]
    seconds: u64,
    /// Run without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Core on which everything runs [default: the last one this process may use]
    #[arg(long, value_name = "N")]
    core: Option<usize>,
    /// Write the report as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the picture here
    #[arg(long, value_name = "FILE", default_value = "taut-demo.svg")]
    svg: PathBuf,
    /// Print all measurements of the run, and the cause of each response above its prediction
    #[arg(long, short)]
    verbose: bool,
    /// Priority of the subscriber's sampler; the callbacks have 20 to 16 [default: 21]
    #[arg(long, value_name = "P", value_parser = clap::value_parser!(u8).range(1..=99))]
    sampler_priority: Option<u8>,
    /// Which of the demo's processes this is
    #[arg(long, hide = true, value_enum)]
    role: Option<Role>,
    /// Namespace of the demo's topics, chosen by the process that starts the others
    #[arg(long, hide = true, default_value = "")]
    namespace: String,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    Publisher,
    Subscriber,
}

tautline_rt::names!(Role: const fn name(self) -> &'static str { Publisher: "publisher", Subscriber: "subscriber" });

/// A core that cannot be used.
fn unusable_core(core: usize) -> impl FnOnce(RtError) -> Failure {
    move |error| Failure::unusable(format!("core {core} cannot be used: {error}; choose one with --core"))
}

pub fn run(args: DemoArgs) -> Outcome<ExitCode> {
    match args.role {
        None => conductor::run(args),
        Some(Role::Publisher) => publisher::run(&args).map(|()| ExitCode::SUCCESS),
        Some(Role::Subscriber) => subscriber::run(&args).map(|()| ExitCode::SUCCESS),
    }
}

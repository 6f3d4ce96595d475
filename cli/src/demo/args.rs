// SPDX-License-Identifier: MIT OR Apache-2.0
//! The arguments of the demo's processes.

use crate::verb::Failure;
use clap::{Args, ValueEnum};
use std::path::PathBuf;
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
    pub seconds: u64,
    /// Run without real-time priorities
    #[arg(long)]
    pub no_rt: bool,
    /// Core on which everything runs [default: the last one this process may use]
    #[arg(long, value_name = "N")]
    pub core: Option<usize>,
    /// Write the report as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the picture here
    #[arg(long, value_name = "FILE", default_value = "taut-demo.svg")]
    pub svg: PathBuf,
    /// Print all measurements of the run, and the cause of each response above its prediction
    #[arg(long, short)]
    pub verbose: bool,
    /// Priority of the subscriber's sampler; the callbacks have 20 to 16 [default: 21]
    #[arg(long, value_name = "P", value_parser = clap::value_parser!(u8).range(1..=99))]
    pub sampler_priority: Option<u8>,
    /// Which of the demo's processes this is
    #[arg(long, hide = true, value_enum)]
    pub role: Option<Role>,
    /// Namespace of the demo's topics, chosen by the process that starts the others
    #[arg(long, hide = true, default_value = "")]
    pub namespace: String,
}

#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    Publisher,
    Subscriber,
}

tautline_rt::names!(Role: pub const fn name(self) -> &'static str { Publisher: "publisher", Subscriber: "subscriber" });

/// A core that cannot be used.
pub fn unusable_core(core: usize) -> impl FnOnce(RtError) -> Failure {
    move |error| Failure::unusable(format!("core {core} cannot be used: {error}; choose one with --core"))
}

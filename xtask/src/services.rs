// SPDX-License-Identifier: MIT OR Apache-2.0
//! The services bench: builds r2r's side, if it can, and runs all.

use crate::build::Build;
use crate::{bench, r2r, steps};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench services --quick               some seconds
  cargo xtask bench services --json services.json  some minutes
  cargo xtask bench services -- --no-rt            without real-time priorities

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros.")]
pub struct Options {
    /// Fewer and shorter rounds
    #[arg(long)]
    pub quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Leave r2r out
    #[arg(long)]
    pub no_r2r: bool,
    #[arg(skip)]
    pub build: Build,
    /// Passed on: see `cargo xtask bench services -- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

pub fn run(options: &Options) -> ExitCode {
    steps::run(&mut command(options))
}

/// The command that measures. r2r's program is built before.
pub fn command(options: &Options) -> Command {
    let mut command = bench(options.build, "services", options.quick, options.json.as_deref());
    r2r::join(&mut command, "services-r2r", options.no_r2r);
    command.args(&options.arguments);
    command
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bench of the gateways: builds Zenoh and hiroz, minutes each from cold, and runs it.

use crate::machine;
use crate::steps::{self, Outcome, execute};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench network --quick                    under two minutes, once it is built
  cargo xtask bench network --json network.json        some ten minutes
  cargo xtask bench network --no-hiroz -- --only round-trip

Zenoh and hiroz, each with a Zenoh of its own, take minutes to build.")]
pub struct Options {
    /// Fewer and shorter rounds
    #[arg(long)]
    pub quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Leave hiroz out
    #[arg(long)]
    pub no_hiroz: bool,
    /// Passed on: see `cargo xtask bench network -- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

pub fn run(options: &Options) -> ExitCode {
    match command(options) {
        Ok(mut command) => steps::run(&mut command),
        Err(reason) => {
            eprintln!("bench network: {reason}");
            ExitCode::FAILURE
        }
    }
}

/// Builds, and makes the command that measures.
pub fn command(options: &Options) -> Result<Command, String> {
    // In one go: Zenoh is then built once, with the features that both need.
    let ours = "build --release -p taut -p tautline-gateway -p tautline-bench-network --bins";
    if let Outcome::Failed(reason) | Outcome::Skipped(reason) = execute(&mut steps::cargo(ours)) {
        return Err(format!("the build failed: {reason}"));
    }
    let hiroz = if options.no_hiroz {
        Err("as --no-hiroz says; `cargo xtask bench network` has it".into())
    } else {
        build_hiroz()
    };
    let mut command = Command::new(machine::target_dir().join("release/network"));
    match hiroz {
        Ok(program) => command.arg("--hiroz").arg(program),
        Err(reason) => command.arg(format!("--without-hiroz={reason}")),
    };
    if options.quick {
        command.arg("--quick");
    }
    if let Some(path) = &options.json {
        command.arg("--json").arg(path);
    }
    command.args(&options.arguments);
    Ok(command)
}

/// hiroz's program.
pub fn build_hiroz() -> Result<PathBuf, String> {
    let target = machine::target_dir().join("network-hiroz");
    let manifest = machine::root().join("benches/network-hiroz/Cargo.toml");
    let mut build = steps::cargo("build --release --locked");
    build.arg("--manifest-path").arg(manifest).arg("--target-dir").arg(&target);
    match execute(&mut build) {
        Outcome::Ok => Ok(target.join("release/network-hiroz")),
        Outcome::Failed(reason) | Outcome::Skipped(reason) => Err(format!("its build failed: {reason}")),
    }
}

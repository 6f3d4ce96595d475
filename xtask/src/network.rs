// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bench of the gateways: builds Zenoh and hiroz, minutes each from cold, and runs it.

use crate::bench::Options;
use crate::build::{RELEASE, apart, build};
use crate::{machine, steps};
use std::path::PathBuf;
use std::process::Command;

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench network --quick                    under two minutes, once it is built
  cargo xtask bench network --json network.json        some ten minutes
  cargo xtask bench network --no-hiroz -- --only round-trip

Zenoh and hiroz, each with a Zenoh of its own, take minutes to build.")]
pub struct Network {
    #[command(flatten)]
    pub bench: Options,
    /// Leave hiroz out
    #[arg(long)]
    pub no_hiroz: bool,
}

impl Network {
    /// Builds, and makes the command that measures.
    pub fn command(&self) -> Result<Command, String> {
        // In one go: Zenoh is then built once, with the features that both need.
        let ours = "build --release -p taut -p tautline-gateway -p tautline-bench-network --bins";
        build(&mut steps::cargo(ours))?;
        let hiroz = if self.no_hiroz {
            Err("as --no-hiroz says; `cargo xtask bench network` has it".into())
        } else {
            build_hiroz()
        };
        let mut command = Command::new(machine::target_dir().join("release/network"));
        match hiroz {
            Ok(program) => command.arg("--hiroz").arg(program),
            Err(reason) => command.arg(format!("--without-hiroz={reason}")),
        };
        self.bench.pass_on(&mut command, &["--quick"]);
        Ok(command)
    }
}

/// hiroz's program.
pub fn build_hiroz() -> Result<PathBuf, String> {
    apart(&mut steps::cargo(RELEASE), "benches/network-hiroz", "network-hiroz", "network-hiroz")
}

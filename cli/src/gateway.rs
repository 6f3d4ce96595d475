// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut gateway`: becomes `taut-gateway`, a program of its own, so that nobody builds the network who does not use it.

use crate::sibling::{Sibling, SiblingError};
use clap::Args;
use std::ffi::OsString;

const GATEWAY: Sibling = Sibling {
    program: "taut-gateway",
    build: "build it with `cargo build --release -p tautline-gateway`, or install it with `cargo install --path transport/zenoh`",
};

/// Mirrors this host's topics over the network: one gateway per host and domain.
///
/// Runs the program taut-gateway: the one beside this one, else the one in PATH. Its options: taut gateway --help.
#[derive(Args, Debug)]
#[command(disable_help_flag = true)]
pub struct GatewayArgs {
    /// Passed on
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "OPTIONS")]
    arguments: Vec<OsString>,
}

/// Does not return if the gateway could be started.
pub fn run(args: GatewayArgs) -> Result<std::process::ExitCode, SiblingError> {
    Err(GATEWAY.become_it(&args.arguments))
}

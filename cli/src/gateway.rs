// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut gateway`: runs `taut-gateway`, a separate program, so that only its users build Zenoh.

use crate::sibling::{Sibling, SiblingError};
use clap::Args;
use std::ffi::OsString;

const GATEWAY: Sibling = Sibling {
    program: "taut-gateway",
    build: "build it with `cargo build --release -p tautline-gateway`, or install it with `cargo install --path transport/zenoh`",
};

/// Mirrors this host's topics over the network: one gateway per host and domain.
///
/// Runs the program taut-gateway, from the folder of this program or from PATH. Its options: taut gateway --help.
#[derive(Args, Debug)]
#[command(disable_help_flag = true)]
pub struct GatewayArgs {
    /// Passed on
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "OPTIONS")]
    arguments: Vec<OsString>,
}

/// Returns only if the gateway cannot be started.
pub fn run(args: GatewayArgs) -> Result<std::process::ExitCode, SiblingError> {
    Err(GATEWAY.become_it(&args.arguments))
}

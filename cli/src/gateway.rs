// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut gateway`: becomes `taut-gateway`, a program of its own, so that nobody builds the network who does not use it.

use clap::Args;
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

const PROGRAM: &str = "taut-gateway";

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

/// Why the gateway was not started.
#[derive(Debug, thiserror::Error)]
pub enum GatewayError {
    #[error(
        "{PROGRAM} is not built: neither beside {} nor in PATH; build it with `cargo build --release -p tautline-gateway`, or install it with `cargo install --path transport/zenoh`",
        beside.display()
    )]
    Missing { beside: PathBuf },
    #[error("{} cannot be run: {source}", program.display())]
    Exec { program: PathBuf, source: std::io::Error },
}

/// Does not return if the gateway could be started.
pub fn run(args: GatewayArgs) -> Result<std::process::ExitCode, GatewayError> {
    let own = std::env::current_exe().unwrap_or_default();
    let sibling = own.with_file_name(PROGRAM);
    let program = if sibling.is_file() { sibling } else { PROGRAM.into() };
    let source = Command::new(&program).args(args.arguments).exec();
    Err(match source.kind() {
        std::io::ErrorKind::NotFound => GatewayError::Missing { beside: own },
        _ => GatewayError::Exec { program, source },
    })
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut init`: writes a commented system file to start from.
use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

/// The template; it passes `taut check` unchanged.
const TEMPLATE: &str = include_str!("init.toml");

/// Writes a commented system file to start from
///
/// The file describes a small robot and passes `taut check`; change it until it describes yours. An existing file is
/// never overwritten.
#[derive(Args, Clone, Debug)]
pub struct InitArgs {
    /// The file to write
    #[arg(default_value = "system.toml", value_name = "FILE")]
    file: PathBuf,
}

/// Runs the verb.
pub fn run(args: &InitArgs) -> ExitCode {
    let path = args.file.display();
    let written = OpenOptions::new().write(true).create_new(true).open(&args.file);
    match written.and_then(|mut file| file.write_all(TEMPLATE.as_bytes())) {
        Ok(()) => {
            println!("Wrote {path}. Change it to your system, then run: taut check {path}");
            ExitCode::SUCCESS
        }
        Err(error) if error.kind() == ErrorKind::AlreadyExists => {
            eprintln!("taut: {path} exists and is left as it is: name another file, or remove it first");
            ExitCode::FAILURE
        }
        Err(error) => {
            eprintln!("taut: {path} cannot be written: {error}");
            ExitCode::FAILURE
        }
    }
}

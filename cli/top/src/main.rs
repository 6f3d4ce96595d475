// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-top`: the verb `top`, for which `taut` starts this program.
#![forbid(unsafe_code)]

mod picture;
mod screen;
mod top;

use clap::Subcommand;
use std::process::ExitCode;

#[derive(Subcommand)]
enum Verb {
    Top(top::TopArgs),
}

fn main() -> ExitCode {
    taut_cli::run_verbs(|Verb::Top(args)| top::run(&args))
}

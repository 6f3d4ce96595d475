// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-top`: the verb `top`, for which `taut` starts this program.
#![forbid(unsafe_code)]

mod picture;
mod screen;
mod top;

use clap::{Parser, Subcommand};
use std::process::ExitCode;
use taut_cli::man::ManArgs;

#[derive(Parser)]
#[command(name = "taut", bin_name = "taut", version, propagate_version = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    Top(top::TopArgs),
    #[command(hide = true)]
    Man(ManArgs),
}

fn main() -> ExitCode {
    taut_cli::run_verbs::<Cli>(|cli| match cli.verb {
        Verb::Top(args) => top::run(&args),
        Verb::Man(args) => taut_cli::man::write_verbs::<Cli>(&args),
    })
}

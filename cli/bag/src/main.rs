// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-bag`: the verbs `record`, `play` and `bag` of `taut`, which starts it for them.
#![forbid(unsafe_code)]

mod bag;
mod definitions;
mod offered_qos;
mod play;
mod record;
mod ring;
mod terminal;

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
    Record(Box<record::RecordArgs>),
    Play(play::PlayArgs),
    Bag(bag::BagArgs),
    #[command(hide = true)]
    Man(ManArgs),
}

fn main() -> ExitCode {
    taut_cli::run_verbs::<Cli>(|cli| match cli.verb {
        Verb::Record(args) => record::run(&args),
        Verb::Play(args) => play::run(&args),
        Verb::Bag(args) => bag::run(&args),
        Verb::Man(args) => taut_cli::man::write_verbs::<Cli>(&args),
    })
}

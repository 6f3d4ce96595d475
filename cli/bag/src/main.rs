// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut-bag`: the verbs `record`, `play` and `bag` of `taut`, which starts it for them.
#![forbid(unsafe_code)]

#[macro_use]
extern crate taut_cli;

mod bag;
mod definitions;
mod offered_qos;
mod play;
mod record;
mod ring;
mod terminal;

use clap::Subcommand;
use std::process::ExitCode;
use taut_cli::verb::Verbs;

#[derive(Subcommand)]
enum Verb {
    Record(Box<record::RecordArgs>),
    Play(play::PlayArgs),
    Bag(Verbs<bag::Verb>),
}

fn main() -> ExitCode {
    taut_cli::run_verbs(|verb| match verb {
        Verb::Record(args) => record::run(&args),
        Verb::Play(args) => play::run(&args),
        Verb::Bag(args) => bag::run(&args),
    })
}

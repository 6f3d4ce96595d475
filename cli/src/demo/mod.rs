// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut demo`: the paper's application, five periodic topics on one core, measured beside its prediction.
//!
//! Three processes: this one starts a publisher and a subscriber, shows the progress and prints the report. They
//! end when their standard input is closed, so they also end if this process is killed.

mod application;
mod args;
mod conductor;
mod details;
mod losses;
mod output;
pub mod plot;
mod process;
mod protocol;
mod publisher;
mod report;
mod subscriber;
mod text;

pub use args::DemoArgs;

use crate::verb::Outcome;
use args::Role;
use std::process::ExitCode;

pub fn run(args: DemoArgs) -> Outcome<ExitCode> {
    match args.role {
        None => conductor::run(args),
        Some(Role::Publisher) => publisher::run(&args).map(|()| ExitCode::SUCCESS),
        Some(Role::Subscriber) => subscriber::run(&args).map(|()| ExitCode::SUCCESS),
    }
}

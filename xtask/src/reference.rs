// SPDX-License-Identifier: MIT OR Apache-2.0
//! The Autoware reference system: builds r2r's side, if it can, and runs both.

use crate::{r2r, steps};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

/// r2r's side.
pub const PROGRAM: &str = "reference-r2r";

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench reference-system --quick              under a minute
  cargo xtask bench reference-system --json kpis.json     two rounds of twenty seconds each
  cargo xtask bench reference-system --cruncher-limit 2048

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros. The system alone:
  cargo run --release -p reference-system -- --help")]
pub struct Options {
    /// Rounds of three seconds
    #[arg(long)]
    pub quick: bool,
    /// Length of a run [default: 20]
    #[arg(long, value_name = "N")]
    pub seconds: Option<f64>,
    /// Up to where each node counts primes [default: 4096]
    #[arg(long, value_name = "N")]
    pub cruncher_limit: Option<u64>,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Leave r2r out
    #[arg(long)]
    pub no_r2r: bool,
    /// Passed on: see `cargo run --release -p reference-system -- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

pub fn run(options: &Options) -> ExitCode {
    steps::run(&mut command(options))
}

/// The command that measures. r2r's program is built before.
pub fn command(options: &Options) -> Command {
    let mut command = steps::cargo("run --release -p reference-system --");
    r2r::join(&mut command, PROGRAM, options.no_r2r);
    let seconds = options.seconds.unwrap_or(if options.quick { 3.0 } else { 20.0 });
    command.args(["--seconds", &seconds.to_string()]);
    if let Some(limit) = options.cruncher_limit {
        command.args(["--cruncher-limit", &limit.to_string()]);
    }
    if let Some(path) = &options.json {
        command.arg("--json").arg(path);
    }
    command.args(&options.arguments);
    command
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_passed_on() {
        let options = Options {
            no_r2r: true,
            quick: true,
            cruncher_limit: Some(2048),
            json: Some("kpis.json".into()),
            arguments: vec!["--rounds".into(), "1".into()],
            ..Options::default()
        };
        let command = command(&options);
        let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy()).collect();
        let own = words.iter().position(|word| word == "--").unwrap() + 1;
        let expected = ["--without-r2r=as --no-r2r says", "--seconds", "3", "--cruncher-limit", "2048"];
        assert_eq!(words[own..own + 5], expected);
        assert_eq!(words[own + 5..], ["--json", "kpis.json", "--rounds", "1"]);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The automated lane keeping system: builds r2r's side, if it can, and runs both.

use crate::{r2r, steps};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

/// r2r's side.
pub const PROGRAM: &str = "alks-r2r";

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench alks --quick                        a minute
  cargo xtask bench alks --json alks.json --html alks.html
                                                        two rounds of sixty seconds each

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros. The system alone:
  cargo run --release -p alks -- --help")]
pub struct Options {
    /// One round of five seconds
    #[arg(long)]
    pub quick: bool,
    /// Length of a run [default: 60]
    #[arg(long, value_name = "N")]
    pub seconds: Option<f64>,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write tables, histograms and drives to FILE as a page
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
    /// Leave r2r out
    #[arg(long)]
    pub no_r2r: bool,
    /// Passed on: see `cargo run --release -p alks -- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

pub fn run(options: &Options) -> ExitCode {
    steps::run(&mut command(options))
}

/// The command that measures. r2r's program is built before.
pub fn command(options: &Options) -> Command {
    let mut command = steps::cargo("run --release -p alks --");
    r2r::join(&mut command, PROGRAM, options.no_r2r);
    let seconds = options.seconds.unwrap_or(if options.quick { 5.0 } else { 60.0 });
    command.args(["--seconds", &seconds.to_string()]);
    command.args(["--rounds", if options.quick { "1" } else { "2" }]);
    for (option, path) in [("--json", &options.json), ("--html", &options.html)] {
        if let Some(path) = path {
            command.arg(option).arg(path);
        }
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
            html: Some("alks.html".into()),
            arguments: vec!["--seed".into(), "7".into()],
            ..Options::default()
        };
        let command = command(&options);
        let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy()).collect();
        let own = words.iter().position(|word| word == "--").unwrap() + 1;
        let expected = ["--without-r2r=as --no-r2r says", "--seconds", "5", "--rounds", "1"];
        assert_eq!(words[own..own + 5], expected);
        assert_eq!(words[own + 5..], ["--html", "alks.html", "--seed", "7"]);
    }
}

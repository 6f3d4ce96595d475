// SPDX-License-Identifier: MIT OR Apache-2.0
//! The evaluation: builds r2r's side, if it can, and runs both.

use crate::build::Build;
use crate::{r2r, steps};
use std::path::PathBuf;
use std::process::{Command, ExitCode};

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench paper --quick                              some minutes: two runs of three seconds
  cargo xtask bench paper --json paper.json --html paper.html  two hours: ten runs of twenty seconds, as in the paper
  cargo xtask bench paper --results paper.runs --minutes 30    half an hour of it; the same once more goes on
  cargo xtask bench paper --runs 3 -- --variants futures-rt,tokio,nort-tokio

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros.")]
pub struct Options {
    /// Two runs of three seconds
    #[arg(long)]
    pub quick: bool,
    /// Runs of each variant [default: 10]
    #[arg(long, value_name = "N")]
    pub runs: Option<u32>,
    /// Length of a run [default: 20]
    #[arg(long, value_name = "S")]
    pub seconds: Option<f64>,
    /// Keep every run in FILE, and go on from the runs that it holds
    #[arg(long, value_name = "FILE")]
    pub results: Option<PathBuf>,
    /// Stop after so many minutes; the same command goes on later
    #[arg(long, value_name = "N", requires = "results")]
    pub minutes: Option<u64>,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Write the report with its pictures to FILE
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
    /// Leave r2r out
    #[arg(long)]
    pub no_r2r: bool,
    #[arg(skip)]
    pub build: Build,
    /// Passed on: see `cargo xtask bench paper -- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

pub fn run(options: &Options) -> ExitCode {
    steps::run(&mut command(options))
}

/// The command that measures. r2r's program is built before.
pub fn command(options: &Options) -> Command {
    let mut command = options.build.program("tautline-benches", "paper");
    r2r::join(&mut command, "paper-r2r", options.no_r2r);
    if options.quick {
        command.arg("--quick");
    }
    if let Some(runs) = options.runs {
        command.args(["--runs", &runs.to_string()]);
    }
    if let Some(seconds) = options.seconds {
        command.args(["--seconds", &seconds.to_string()]);
    }
    if let Some(minutes) = options.minutes {
        command.args(["--minutes", &minutes.to_string()]);
    }
    let results = ("--results", &options.results);
    for (name, path) in [results, ("--json", &options.json), ("--html", &options.html)] {
        if let Some(path) = path {
            command.arg(name).arg(path);
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
            runs: Some(3),
            seconds: Some(0.5),
            results: Some("paper.runs".into()),
            minutes: Some(30),
            html: Some("paper.html".into()),
            arguments: vec!["--core".into(), "0".into()],
            ..Options::default()
        };
        let command = command(&options);
        let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy()).collect();
        let own = words.iter().position(|word| word == "--").unwrap() + 1;
        let expected = [
            "--without-r2r=as --no-r2r says",
            "--runs",
            "3",
            "--seconds",
            "0.5",
            "--minutes",
            "30",
            "--results",
            "paper.runs",
            "--html",
            "paper.html",
            "--core",
            "0",
        ];
        assert_eq!(words[own..], expected);
    }
}

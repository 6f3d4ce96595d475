// SPDX-License-Identifier: MIT OR Apache-2.0
//! The benches with a side of r2r's, which is built if it can be.

use crate::bench::{Options, pass};
use crate::{r2r, steps};
use std::path::PathBuf;
use std::process::Command;

/// r2r's side of the Autoware reference system and of the automated lane keeping system.
pub const REFERENCE: &str = "reference-r2r";
pub const ALKS: &str = "alks-r2r";

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench paper --quick                              some minutes: two runs of three seconds
  cargo xtask bench paper --json paper.json --html paper.html  two hours: ten runs of twenty seconds, as in the paper
  cargo xtask bench paper --results paper.runs --minutes 30    half an hour of it; the same once more goes on
  cargo xtask bench paper --runs 3 -- --variants futures-rt,tokio,nort-tokio

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros.")]
pub struct Paper {
    #[command(flatten)]
    pub bench: Options,
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
    /// Write the report with its pictures to FILE
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
    /// Leave r2r out
    #[arg(long)]
    pub no_r2r: bool,
}

impl Paper {
    pub fn command(&self) -> Command {
        let mut command = self.bench.build.program("tautline-benches", "paper");
        r2r::join(&mut command, "paper-r2r", self.no_r2r);
        pass(&mut command, "--runs", self.runs.map(|runs| runs.to_string()));
        pass(&mut command, "--seconds", self.seconds.map(|seconds| seconds.to_string()));
        pass(&mut command, "--minutes", self.minutes.map(|minutes| minutes.to_string()));
        pass(&mut command, "--results", self.results.as_ref());
        pass(&mut command, "--html", self.html.as_ref());
        self.bench.pass_on(&mut command, &["--quick"]);
        command
    }
}

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench reference-system --quick              under a minute
  cargo xtask bench reference-system --json kpis.json     two rounds of twenty seconds each
  cargo xtask bench reference-system --cruncher-limit 2048

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros. The system alone:
  cargo run --release -p reference-system -- --help")]
pub struct Reference {
    #[command(flatten)]
    pub bench: Options,
    /// Length of a run [default: 20]
    #[arg(long, value_name = "N")]
    pub seconds: Option<f64>,
    /// Up to where each node counts primes [default: 4096]
    #[arg(long, value_name = "N")]
    pub cruncher_limit: Option<u64>,
    /// Leave r2r out
    #[arg(long)]
    pub no_r2r: bool,
}

impl Reference {
    pub fn command(&self) -> Command {
        let mut command = steps::cargo("run --release -p reference-system --");
        r2r::join(&mut command, REFERENCE, self.no_r2r);
        let seconds = self.seconds.unwrap_or(if self.bench.quick { 3.0 } else { 20.0 });
        command.args(["--seconds", &seconds.to_string()]);
        pass(&mut command, "--cruncher-limit", self.cruncher_limit.map(|limit| limit.to_string()));
        self.bench.pass_on(&mut command, &[]);
        command
    }
}

#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  cargo xtask bench alks --quick                        a minute
  cargo xtask bench alks --json alks.json --html alks.html
                                                        two rounds of sixty seconds each

r2r's side is built with the ROS 2 that is sourced, else with one from PyPI under target/ros. The system alone:
  cargo run --release -p alks -- --help")]
pub struct Alks {
    #[command(flatten)]
    pub bench: Options,
    /// Length of a run [default: 60]
    #[arg(long, value_name = "N")]
    pub seconds: Option<f64>,
    /// Write tables, histograms and drives to FILE as a page
    #[arg(long, value_name = "FILE")]
    pub html: Option<PathBuf>,
    /// Leave r2r out
    #[arg(long)]
    pub no_r2r: bool,
}

impl Alks {
    pub fn command(&self) -> Command {
        let mut command = steps::cargo("run --release -p alks --");
        r2r::join(&mut command, ALKS, self.no_r2r);
        let (seconds, rounds) = if self.bench.quick { (5.0, "1") } else { (60.0, "2") };
        command.args(["--seconds", &self.seconds.unwrap_or(seconds).to_string(), "--rounds", rounds]);
        pass(&mut command, "--html", self.html.as_ref());
        self.bench.pass_on(&mut command, &[]);
        command
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What a bench's own program is told.
    fn told(command: &Command) -> String {
        let words: Vec<_> = command.get_args().map(|word| word.to_string_lossy()).collect();
        words.join(" ").split_once(" -- ").unwrap().1.to_owned()
    }

    #[test]
    fn options_are_passed_on() {
        let bench = |arguments: &str| Options {
            quick: true,
            json: Some("x.json".into()),
            arguments: arguments.split(' ').map(str::to_owned).collect(),
            ..Options::default()
        };
        let paper = Paper {
            bench: Options { quick: false, ..bench("--core 0") },
            no_r2r: true,
            runs: Some(3),
            seconds: Some(0.5),
            results: Some("paper.runs".into()),
            minutes: Some(30),
            html: Some("paper.html".into()),
        };
        assert_eq!(
            told(&paper.command()),
            "--without-r2r=as --no-r2r says --runs 3 --seconds 0.5 --minutes 30 --results paper.runs --html paper.html \
             --json x.json --core 0"
        );
        let reference = Reference {
            bench: bench("--rounds 1"),
            no_r2r: true,
            cruncher_limit: Some(2048),
            ..Reference::default()
        };
        let expected =
            "--without-r2r=as --no-r2r says --seconds 3 --cruncher-limit 2048 --json x.json --rounds 1";
        assert_eq!(told(&reference.command()), expected);
        let alks =
            Alks { bench: bench("--seed 7"), no_r2r: true, html: Some("a.html".into()), ..Alks::default() };
        let expected =
            "--without-r2r=as --no-r2r says --seconds 5 --rounds 1 --html a.html --json x.json --seed 7";
        assert_eq!(told(&alks.command()), expected);
    }
}

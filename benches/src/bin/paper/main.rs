// SPDX-License-Identifier: MIT OR Apache-2.0
//! Do the response times of the paper hold, with Tautline and with r2r, and only for the structure that it proposes?
//!
//! The evaluation of 'A first look at ROS 2 applications written in asynchronous Rust' (ECRTS 2025), section 5: a publisher
//! and a subscriber process on one core, in every variant, first of Tautline, then of r2r over Fast DDS, run after run. The
//! measuring processes are this binary again, started with `--child`, and r2r's program, which `--r2r` names.
//!
//! | module | holds |
//! |---|---|
//! | `application` | the topics of both experiments, from examples/systems |
//! | `plan` | what is measured: systems, variants, runs |
//! | `ledger` | the runs on disk, to go on with |
//! | `rounds` | the order of the runs, and the repetition of those that the hypervisor disturbed |
//! | `process` | one run: starts both processes, collects what they measured |
//! | `tautline` | both processes on Tautline |
//! | `stats` | from runs to rows: percentiles, misses, losses |
//! | `predict` | response times computed, with the overhead that was measured |
//! | `verdict` | what the paper says of its variants, as readings |
//! | `report`, `html`, `figures` | the terminal, the JSON; the page and its pictures |

mod application;
mod figures;
mod html;
mod ledger;
mod plan;
mod predict;
mod process;
mod report;
mod rounds;
mod stats;
mod tautline;
mod verdict;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use tautline_harness::{Documented, Result, one_core, write};
use tautline_paper::{Variant, priorities};
use tautline_rt::permission;

/// Runs the evaluation of an ECRTS 2025 paper on Tautline and, beside it, on r2r over Fast DDS.
#[derive(Parser)]
#[command(after_help = "Examples:
  cargo xtask bench paper --quick                              five minutes: two runs of three seconds
  cargo xtask bench paper --json paper.json --html paper.html  as in the paper: ten runs of twenty seconds
  cargo xtask bench paper --results paper.runs --minutes 30    half an hour of it; the same once more goes on
  cargo xtask bench paper --runs 3 -- --variants futures-rt,tokio,nort-tokio")]
struct Options {
    #[command(flatten)]
    documented: Documented,
    /// Runs of each variant
    #[arg(long, conflicts_with = "quick", value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: u32,
    /// Length of a run
    #[arg(long, conflicts_with = "quick", value_name = "S", default_value_t = 20.0, value_parser = seconds)]
    seconds: f64,
    /// How often a variant may be run once more because the core was taken away [default: half of the runs]
    #[arg(long, value_name = "N")]
    repeats: Option<u32>,
    /// Keep every run in FILE, and go on from the runs that it holds
    #[arg(long, value_name = "FILE")]
    results: Option<PathBuf>,
    /// Stop after so many minutes; the same command goes on later
    #[arg(long, value_name = "N", requires = "results", value_parser = clap::value_parser!(u64).range(1..=10_000))]
    minutes: Option<u64>,
    /// Write the report with its pictures to FILE
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Only these variants [default: all]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    variants: Option<Vec<Variant>>,
    /// The core on which everything runs [default: the last one allowed]
    #[arg(long, value_name = "N")]
    core: Option<usize>,
    /// Measure without real-time priorities; the numbers then say little
    #[arg(long)]
    no_rt: bool,
    /// r2r's program; without it r2r is left out
    #[arg(long, value_name = "PROGRAM")]
    r2r: Option<PathBuf>,
    /// Why r2r is left out
    #[arg(long, hide = true, default_value = "no program was given with --r2r")]
    without_r2r: String,
    /// Run one process; the argument is its job
    #[arg(long, hide = true)]
    child: Option<String>,
}

fn seconds(text: &str) -> std::result::Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (0.5..=3600.0).contains(&seconds) { Ok(seconds) } else { Err("0.5 to 3600 are possible".to_owned()) }
}

fn main() -> ExitCode {
    let options = Options::parse();
    let result = match &options.child {
        Some(job) => tautline::run(job),
        None => measure(&options),
    };
    tautline_harness::exit("paper", result)
}

fn measure(options: &Options) -> Result<()> {
    if !options.no_rt {
        permission::realtime_permitted(priorities::PUBLISHER + 1)
            .map_err(|error| format!("{error} (or measure without: --no-rt)"))?;
    }
    let plan = plan::Plan::new(options, one_core(options.core)?)?;
    let limit = options.minutes.map(|minutes| Duration::from_secs(60 * minutes));
    let results = rounds::run(&plan, options.results.as_deref(), limit)?;
    let report = report::Report::new(&plan, &results)?;
    report::print(&report);
    options.documented.write(&report.rows, || report::document(&plan, &report))?;
    if let Some(path) = &options.html {
        write(path, &html::page(&report)?)?;
        println!("Report: {}", path.display());
    }
    println!();
    tautline_harness::verdict::print(&report.verdicts)
}

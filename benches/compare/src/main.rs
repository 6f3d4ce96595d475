// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline beside other middleware: all systems in one run. Four benches: `compare` asks what a user gets who chooses one of
//! them, `wake` what a wake-up costs, `services` what a request does, `network` what gateways do.
//!
//! The same messages, payloads, priorities and cores for every system; every system runs in every round, directly after its
//! rivals. The measuring processes are this binary again, started with `--child`, and the rivals' programs, which
//! `cargo xtask bench` builds: a job on the command line, lines of JSON back, as `tautline-exchange` has them.
//!
//! | module | holds |
//! |---|---|
//! | `modes` | the systems and their ways, what was set, what they do better |
//! | `plan` | what is measured: benches, experiments, systems |
//! | `settings` | payloads, idle states, lengths and rounds of each experiment |
//! | `rounds` | the parent: rounds to and fro, and what became of each case |
//! | `pair`, `flow` | one measurement: round trips, or one way |
//! | `load` | what disturbs the measurement under load |
//! | `callbacks` | real-time callbacks, with and without a flood from the network |
//! | `claims` | what must hold, and where a rival is ahead |
//! | `report` | the tables, the JSON |
//! | `smoke` | what must not be missing where everything is only tried |
//! | `html`, `figures` | the page and its pictures |
//! | `markdown` | the tables of the documents |

mod callbacks;
mod claims;
mod figures;
mod flow;
mod html;
mod load;
mod markdown;
mod modes;
mod pair;
mod plan;
mod report;
mod rounds;
mod settings;
mod smoke;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use modes::Programs;
use pair::Setup;
use plan::{Bench, Experiment, Plan};
use report::Report;
use tautline_benches::systems;
use tautline_exchange::{APPLICATION_PRIORITY, Job, NETWORK_PRIORITY};
use tautline_harness::{Disturbance, Result, Scratch, exit, interrupted, two_cores, write, write_json};
use tautline_rt::permission;

/// Measures Tautline beside other middleware.
#[derive(Parser)]
#[command(after_help = "Examples:
  cargo xtask bench compare --quick                                   under ten minutes, once it is built
  cargo xtask bench compare --json compare.json --html compare.html   about an hour
  cargo xtask bench compare --systems tautline,fastdds -- --only latency,robot
  cargo xtask bench network --quick -- --no-cores")]
struct Options {
    /// What is asked
    #[arg(long, value_name = "BENCH", value_enum, default_value = "compare")]
    bench: Bench,
    /// Fewer payloads, fewer and shorter rounds
    #[arg(long)]
    quick: bool,
    /// A round of a few payloads, which fails if not everything runs; the numbers mean nothing
    #[arg(long, conflicts_with = "quick")]
    smoke: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the report with its pictures to FILE
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Draw the best latencies of six systems by size to FILE
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Write the tables of the documents to FILE
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
    /// Take the numbers of an earlier run from FILE instead of measuring: for --svg, --markdown and the ratios
    #[arg(long, value_name = "FILE", conflicts_with_all = ["json", "html"])]
    from: Option<PathBuf>,
    /// How often each is measured
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    rounds: Option<u32>,
    /// Measure without real-time priorities; the numbers then say little
    #[arg(long)]
    no_rt: bool,
    /// The two cores, the sender's and the receiver's [default: the first two allowed]
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    cores: Option<Vec<usize>>,
    /// Leave the threads to the scheduler: any core
    #[arg(long, conflicts_with = "cores")]
    no_cores: bool,
    /// Only these experiments [default: all]
    #[arg(long, value_name = "EXPERIMENT,...", value_delimiter = ',', value_enum)]
    only: Vec<Experiment>,
    /// Only these systems [default: all]
    #[arg(long, value_name = "SYSTEM,...", value_delimiter = ',', value_parser = modes::SYSTEMS)]
    systems: Vec<String>,
    /// A rival's program
    #[arg(long, value_name = "NAME=PATH")]
    program: Vec<String>,
    /// Why a rival is left out
    #[arg(long, value_name = "NAME=REASON")]
    without: Vec<String>,
    /// Only say whether the options are right; rivals' programs need not be there
    #[arg(long, hide = true)]
    check_options: bool,
    /// Run one process of a measurement; the arguments are its system and its job
    #[arg(long, hide = true, num_args = 2, value_names = ["SYSTEM", "JOB"])]
    child: Option<Vec<String>>,
}

fn main() -> ExitCode {
    let options = Options::parse();
    let result = match (options.child.as_deref(), &options.from) {
        (Some([system, job]), _) => Job::begin(job).and_then(|job| systems::run(system, &job)),
        (_, Some(path)) if !options.check_options => show(&options, path),
        _ => measure(&options),
    };
    exit("compare", result)
}

fn measure(options: &Options) -> Result<()> {
    if !options.no_rt {
        let highest = match options.bench {
            // The gateway's budget looks from above.
            Bench::Network => NETWORK_PRIORITY + 1,
            _ => APPLICATION_PRIORITY + 10,
        };
        permission::realtime_permitted(highest)
            .map_err(|error| format!("{error} (or measure without: --no-rt)"))?;
    }
    let programs = Programs::new(&options.program, &options.without)?;
    let plan = Plan::new(options, two_cores(options.cores.as_deref())?, programs)?;
    // Before minutes are spent on what cannot be written.
    for path in [&options.json, &options.html, &options.svg, &options.markdown].into_iter().flatten() {
        let file = std::fs::File::options().create(true).append(true).open(path);
        file.map_err(|error| format!("cannot write {}: {error}", path.display()))?;
    }
    if options.check_options {
        return Ok(());
    }
    let interrupted = interrupted()?;
    let disturbance = Disturbance::start();
    let scratch = Scratch::new("compare")?;
    let setup = Setup { plan: &plan, scratch: &scratch, interrupted: &interrupted };
    let cells = rounds::run(&setup)?;
    let more = callbacks::run(&setup)?;
    let report = Report::new(&plan, cells, more, disturbance.report());
    report.print();
    if let Some(path) = &options.json {
        write_json(path, &report.rows)?;
    }
    if let Some(path) = &options.html {
        write(path, &html::page(&plan, &report)?)?;
        println!("\nthe report is in {}", path.display());
    }
    draw(options, &report)?;
    report.failure().map_or(Ok(()), |failure| Err(failure.into()))
}

/// Shows an earlier run.
fn show(options: &Options, path: &std::path::Path) -> Result<()> {
    let text = std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
    let report = Report::of_rows(serde_json::from_str(&text)?);
    report.print();
    draw(options, &report)
}

fn draw(options: &Options, report: &Report) -> Result<()> {
    if let Some(path) = &options.markdown {
        write(path, &markdown::tables(options.bench, &report.rows))?;
    }
    let Some(path) = &options.svg else { return Ok(()) };
    let picture = figures::overview(&report.rows, "latency/whole/held-off")?;
    write(path, &picture.ok_or("latencies of several sizes are needed for a picture")?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_checked_without_any_rival() {
        let check = |options: &str| {
            let words = ["compare", "--check-options", "--no-rt"].into_iter().chain(options.split(' '));
            Options::try_parse_from(words)
                .map_err(|error| error.to_string())
                .and_then(|options| measure(&options).map_err(|error| error.to_string()))
        };
        assert_eq!(check("--quick --systems tautline,fastdds --only latency"), Ok(()));
        for (options, why) in [
            ("--systems tautline,fastds", "invalid value 'fastds'"),
            ("--onli latency", "unexpected argument '--onli'"),
            ("--only request", "--only request: this bench does not measure it"),
            ("--bench wake --systems dora", "none of them takes part"),
            ("--cores 0,0", "--cores takes two different cores"),
            ("--json /nowhere/x.json", "cannot write /nowhere/x.json"),
        ] {
            let refused = check(options).unwrap_err();
            assert!(refused.contains(why), "{options}: {refused}");
        }
    }
}

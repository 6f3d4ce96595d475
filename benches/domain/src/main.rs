// SPDX-License-Identifier: MIT OR Apache-2.0
//! What does a domain of many processes and topics cost?
//!
//! The processes are this binary again, started with `--child`, in a scope of their own: nobody else's processes are in the way,
//! and none is disturbed but by the load.
//!
//! | module | holds |
//! |---|---|
//! | `job` | what a process is told, and what it says |
//! | `place` | the domain's files, a gate at which processes wait for each other |
//! | `process` | what the kernel says of processes: time, memory, descriptors |
//! | `stopwatch` | times of several kinds, which a process tells the bench |
//! | `ros_node` | a node with the ten endpoints that every ROS 2 node has |
//! | `population` | 1 to 300 processes with such a node: idle, looked at, joined, killed |
//! | `topics` | 10 to 10,000 topics between two processes |
//! | `storm` | 100 processes that start at once; one with 100 nodes; 1,000 publishers and as many subscriptions of a topic |
//! | `traffic` | messages at a rate: 200 topics beside iceoryx2, images to many subscriptions, many subscriptions of a topic |
//! | `report` | the table, the JSON; whether goals are met |

mod job;
mod place;
mod population;
mod process;
mod report;
mod ros_node;
mod stopwatch;
mod storm;
mod topics;
mod traffic;

use clap::{Parser, ValueEnum};
use job::Job;
use report::{Circumstances, Report};
use std::process::ExitCode;
use std::sync::atomic::AtomicBool;
use tautline_exchange::APPLICATION_PRIORITY;
use tautline_harness::readings::Reading;
use tautline_harness::{Disturbance, Documented, Result, Scratch};
use tautline_rt::{host, permission};

/// Measures what a domain of many processes and topics costs.
#[derive(Parser)]
#[command(after_help = "Examples:
  cargo xtask bench domain --quick                 under 90 s
  cargo xtask bench domain --json domain.json      some ten minutes
  cargo xtask bench domain -- --only processes,storm")]
struct Options {
    #[command(flatten)]
    documented: Documented,
    /// Only these experiments [default: all]
    #[arg(long, value_name = "EXPERIMENT,...", value_delimiter = ',', value_enum)]
    only: Vec<Experiment>,
    /// Processes, in place of 1,10,60,300
    #[arg(long, value_name = "N,...", value_delimiter = ',')]
    processes: Option<Vec<usize>>,
    /// Topics, in place of 10,100,1000,10000
    #[arg(long, value_name = "N,...", value_delimiter = ',')]
    topics: Option<Vec<usize>>,
    /// Send and receive messages without real-time priorities
    #[arg(long)]
    no_rt: bool,
    /// Run one of the processes; the argument is its job
    #[arg(long, hide = true, value_name = "JOB")]
    child: Option<String>,
}

/// A question, and its name in the JSON.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Experiment {
    /// 1 to 300 processes with a ROS 2 node each
    Processes,
    /// 10 to 10,000 topics
    Topics,
    /// 100 processes that start at once
    Storm,
    /// 100 nodes in a process
    Nodes,
    /// 1,000 publishers and 1,000 subscriptions of one topic
    Crowd,
    /// 200 topics at 100 Hz, beside iceoryx2
    Load,
    /// 8 MB at 30 Hz to 1 to 32 subscriptions
    Images,
    /// 10 to 200 subscriptions of a topic
    FanOut,
    /// 10 to 200 subscriptions of a topic in as many processes, beside iceoryx2
    Readers,
    /// 200 topics of point clouds at 100 Hz, beside iceoryx2
    Clouds,
    /// A topic of 64 B, 64 KiB and 8 MiB at 100 Hz, of which nobody copies, beside iceoryx2
    Sizes,
}

struct Bench<'a> {
    /// In a scope that nobody else is in.
    scratch: &'a Scratch,
    quick: bool,
    realtime: bool,
    processes: Vec<usize>,
    topics: Vec<usize>,
    interrupted: &'a AtomicBool,
}

fn main() -> ExitCode {
    let options = Options::parse();
    let result = match options.child.as_deref() {
        Some(job) => Job::run(job),
        None => measure(&options),
    };
    tautline_harness::exit("domain", result)
}

fn measure(options: &Options) -> Result<()> {
    let interrupted = tautline_harness::interrupted()?;
    // Three pipes for each process.
    let open_files = host::raise_open_files();
    let disturbance = Disturbance::start();
    let scratch = Scratch::new("bench_domain")?;
    let is_quick = options.documented.run.quick;
    let sizes = |full: &[usize], quick: &[usize]| if is_quick { quick } else { full }.to_vec();
    let bench = Bench {
        scratch: &scratch,
        quick: is_quick,
        realtime: !options.no_rt && permission::realtime_permitted(APPLICATION_PRIORITY + 10).is_ok(),
        processes: options.processes.clone().unwrap_or_else(|| sizes(&[1, 10, 60, 300], &[1, 10, 60])),
        topics: options.topics.clone().unwrap_or_else(|| sizes(&[10, 100, 1000, 10_000], &[10, 100, 1000])),
        interrupted: &interrupted,
    };
    let mut rows = Vec::new();
    let is_chosen = |experiment: &Experiment| options.only.is_empty() || options.only.contains(experiment);
    for &experiment in Experiment::value_variants().iter().filter(|experiment| is_chosen(experiment)) {
        let of_it = bench.run(experiment).map_err(|error| format!("{}: {error}", experiment.name()))?;
        rows.extend(of_it);
        rows.push(place::left_behind(experiment)?);
    }
    let (disturbance, realtime) = (disturbance.report(), bench.realtime);
    let circumstances = Circumstances { open_files, disturbance, realtime, quick: is_quick };
    let report = Report::new(rows, circumstances);
    report.print();
    options.documented.write(&report, || report.document())?;
    report.print_verdicts()
}

impl Bench<'_> {
    fn run(&self, experiment: Experiment) -> Result<Vec<Reading>> {
        match experiment {
            Experiment::Processes => population::measure(self),
            Experiment::Topics => topics::measure(self),
            Experiment::Storm => storm::start_at_once(self),
            Experiment::Nodes => storm::many_nodes(self),
            Experiment::Crowd => storm::crowd(self),
            Experiment::Load => traffic::load(self),
            Experiment::Images => traffic::images(self),
            Experiment::FanOut => traffic::fan_out(self),
            Experiment::Readers => traffic::readers(self),
            Experiment::Clouds => traffic::clouds(self),
            Experiment::Sizes => traffic::sizes(self),
        }
    }
}

impl Experiment {
    fn name(self) -> String {
        self.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default()
    }
}

impl From<Experiment> for String {
    fn from(experiment: Experiment) -> Self {
        experiment.name()
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! rmw_tautline beside Fast DDS's RMW: the same programs use both, by the names that rcl uses.
//!
//! | module | holds |
//! |---|---|
//! | `trips` | half round trips |
//! | `end` | an end of them that calls the RMW itself; `client.py` and `rclcpp.cpp` are ends in rclpy and rclcpp |
//! | `flow` | the CPU time of topics at a rate |
//! | `waits` | `rmw_wait` and take of messages that are there |
//! | `nodes` | the time until nodes have found each other |
//! | `system` | the RMWs, and the processes that use them |
//! | `rmw` | an RMW's functions |
//! | `types` | type supports |

#[path = "../../../rmw/src/bindings.rs"]
mod bindings;
mod end;
mod flow;
mod nodes;
mod rmw;
mod system;
mod trips;
mod types;
mod waits;

use clap::{Parser, ValueEnum};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;
use system::{Case, Message, Starter, System, Task};
use tautline_exchange::{Job, Measured, Result};
use tautline_harness::claims::{Claim, Goal, Ways, judge};
use tautline_harness::rows::{Metric, Row, Tally};
use tautline_harness::table::of_rows;
use tautline_harness::verdict::{self, Verdict};
use tautline_harness::{Distribution, Disturbance, Documented, exit, machine, progress_bar};
use tautline_rt::IdleHold;
use trips::{Client, Trip};
use waits::Waits;

/// rmw_tautline beside Fast DDS's RMW: round trips, CPU time, start-up
#[derive(Parser)]
#[command(after_help = "Examples:
  cargo xtask bench rmw
  cargo xtask bench rmw --quick --json rmw.json
  cargo xtask bench rmw -- --only loaned,cpu
  cargo xtask bench rmw -- --only c --bytes 1048576")]
struct Arguments {
    #[command(flatten)]
    told: Documented,
    /// These parts only
    #[arg(long, value_name = "PART,...", value_delimiter = ',')]
    only: Vec<Part>,
    /// Round trips of messages of these lengths only
    #[arg(long, value_name = "N,...", value_delimiter = ',', value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(48..1 << 30))]
    bytes: Vec<usize>,
    /// Without real-time priorities, where they are not permitted
    #[arg(long)]
    no_rt: bool,
    /// rmw_tautline's library
    #[arg(long, value_name = "LIBRARY")]
    tautline: PathBuf,
    /// Fast DDS's RMW
    #[arg(long, value_name = "LIBRARY", default_value = "librmw_fastrtps_cpp.so")]
    fast_dds: PathBuf,
    /// The Python that has rclpy
    #[arg(long, value_name = "PROGRAM")]
    python: Option<PathBuf>,
    /// A program made of benches/rmw/rclcpp.cpp, which says how
    #[arg(long, value_name = "PROGRAM")]
    rclcpp: Option<PathBuf>,
    /// The job of a process, for this program's own use
    #[arg(long, hide = true, requires = "task")]
    end: Option<String>,
    #[arg(long, hide = true)]
    task: Option<Task>,
}

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Part {
    /// Round trips of rmw_wait and take
    C,
    /// Those of loaned messages
    Loaned,
    /// Those of rclcpp
    Rclcpp,
    /// Those of rclpy
    Rclpy,
    /// rmw_wait and take of messages that are there: of many subscriptions, and under a system file
    Waits,
    /// The CPU time of 20 topics at 100 Hz
    Cpu,
    /// The time until nodes have found each other
    Nodes,
}

const TAUTLINE: &str = "rmw_tautline";
const FAST_DDS: &str = "rmw_fastrtps_cpp";

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    exit(
        "bench-rmw",
        match (&arguments.end, arguments.task) {
            (Some(job), Some(task)) => play(job, task),
            _ => measure(&arguments),
        },
    )
}

/// What a process that this program has started does.
fn play(job: &str, task: Task) -> Result<()> {
    let job = Job::begin(job)?;
    match task {
        Task::Struct => end::run(&job, Message::Struct),
        Task::Serialized => end::run(&job, Message::Serialized),
        Task::Loaned => end::run(&job, Message::Loaned),
        Task::Flow => flow::run(&job),
        Task::Node => nodes::run(&job),
        Task::Waits => waits::run(&job),
    }
}

fn measure(arguments: &Arguments) -> Result<()> {
    tautline_rt::domain::set_scope(&format!("bench_rmw_{}", std::process::id())).ok();
    let run = Run {
        arguments,
        starter: Starter {
            python: arguments.python.as_deref(),
            rclcpp: arguments.rclcpp.as_deref(),
            realtime: !arguments.no_rt,
        },
        systems: [
            System { name: TAUTLINE, library: arguments.tautline.clone() },
            System { name: FAST_DDS, library: arguments.fast_dds.clone() },
        ],
    };
    let disturbance = Disturbance::start();
    let mut rows = run.trips()?;
    rows.extend(run.waits()?);
    rows.extend(run.flows()?);
    rows.extend(run.nodes()?);
    let disturbance = disturbance.report();
    println!("{}\n{}\n{disturbance}\n", of_rows(&rows), machine());
    let conditions = format!("`cargo xtask bench rmw`: {}; {disturbance}.\n", machine());
    arguments.told.write(&rows, || format!("{}\n{conditions}", of_rows(&rows).markdown()))?;
    verdict::print(&verdicts(&rows))?;
    match rows.iter().filter(|row| row.system == TAUTLINE).map(|row| row.lost).sum() {
        0 => Ok(()),
        lost => Err(format!("{TAUTLINE} lost {lost} messages").into()),
    }
}

/// Beside Fast DDS's RMW; loaned messages, whatever their size.
fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let trip = |client: Client, message, bytes| Trip { client, message, bytes, is_governed: false };
    let [small, large, loaned, small_loaned] = [
        trip(Client::C, Message::Struct, rmw::STRUCT_BYTES),
        trip(Client::C, Message::Serialized, MIB),
        trip(Client::C, Message::Loaned, 8 * MIB),
        trip(Client::C, Message::Loaned, rmw::STRUCT_BYTES),
    ];
    let image = trip(Client::Rclcpp, Message::Struct, 8 * MIB);
    let [held, of_rclcpp] = [small, image].map(|trip| trip.experiment(true));
    let modes = [small, large, loaned].map(|trip| [trip.message.name()]);
    let at_most = |times, metric, experiment, bytes: Option<usize>, modes| {
        let [ours, theirs] = [TAUTLINE, FAST_DDS].map(|system| Ways::new(experiment, bytes, system, modes));
        Claim::new(metric, ours, Goal::Times(times, theirs))
    };
    let of_loaned = |trip: Trip| Ways::new(&held, trip.bytes, TAUTLINE, &modes[2]);
    let waits = WAITS.map(|waits| (waits.experiment(false), [waits.mode()]));
    let waits = waits.each_ref().map(|(experiment, [mode])| (&**experiment, [&**mode]));
    let of_waits = |index: usize, system| {
        let (experiment, modes): &(&str, [&str; 1]) = &waits[index];
        Ways::new(experiment, None, system, modes)
    };
    let waits_at_most =
        |index, times, other| Claim::new(Metric::P50, of_waits(index, TAUTLINE), Goal::Times(times, other));
    let governed = Trip { is_governed: true, ..small }.mode();
    let governed = [&*governed];
    let [free, governed] =
        [&modes[0], &governed].map(|modes| Ways::new(&held, Some(small.bytes), TAUTLINE, modes));
    let nodes = NODES.map(nodes::experiment);
    let claims = [
        at_most(0.5, Metric::P50, &held, Some(small.bytes), &modes[0]),
        at_most(0.2, Metric::P50, &held, Some(large.bytes), &modes[1]).because(SERIALIZED_COPIES),
        at_most(0.5, Metric::P50, &of_rclcpp, Some(image.bytes), &modes[0]),
        Claim::new(Metric::P50, of_loaned(loaned), Goal::Times(1.5, of_loaned(small_loaned))),
        Claim::new(Metric::P50, governed, Goal::Times(1.1, free)),
        waits_at_most(1, 1.1, of_waits(0, TAUTLINE)),
        waits_at_most(4, 1.0, of_waits(4, FAST_DDS)),
        waits_at_most(6, 1.5, of_waits(5, TAUTLINE)).because(ORDER_WAITS),
        at_most(1.0, Metric::CpuTime, flow::EXPERIMENT, None, &[]),
    ];
    let found = nodes.iter().map(|nodes| at_most(1.0, Metric::Start, nodes, None, &[]));
    judge(rows, claims.into_iter().chain(found))
}

const ORDER_WAITS: &str =
    "each of 20 priorities has a wait of its own, for which rclcpp builds the wait set anew";
const SERIALIZED_COPIES: &str =
    "a serialized message is copied into shared memory, for the buffer is the publisher's own";

/// Round trips of one kind.
struct Trips {
    part: Part,
    client: Client,
    rounds: u32,
    lengths: &'static [usize],
    /// Of a quick run.
    few: &'static [usize],
}

const fn waits(client: Client, ready: usize, of: usize, is_governed: bool) -> Waits {
    Waits { client, ready, of, is_governed }
}

/// `rmw_wait` and take; the governed ones of rmw_tautline alone.
const WAITS: [Waits; 7] = [
    waits(Client::C, 1, 1, false),
    waits(Client::C, 1, 1, true),
    waits(Client::C, 20, 20, false),
    waits(Client::C, 20, 20, true),
    waits(Client::C, 1, 500, false),
    waits(Client::Rclcpp, 20, 20, false),
    waits(Client::Rclcpp, 20, 20, true),
];
const KIB: usize = 1 << 10;
const MIB: usize = 1 << 20;
const PARTS: [Trips; 4] = [
    Trips {
        part: Part::C,
        client: Client::C,
        rounds: 5,
        lengths: &[48, 64 * KIB, MIB, 8 * MIB],
        few: &[48, MIB],
    },
    Trips {
        part: Part::Loaned,
        client: Client::C,
        rounds: 5,
        lengths: &[48, MIB, 8 * MIB],
        few: &[48, 8 * MIB],
    },
    Trips {
        part: Part::Rclcpp,
        client: Client::Rclcpp,
        rounds: 3,
        lengths: &[48, 64 * KIB, MIB, 8 * MIB],
        few: &[48],
    },
    Trips { part: Part::Rclpy, client: Client::Rclpy, rounds: 3, lengths: &[48, 64 * KIB, MIB], few: &[48] },
];
/// How many nodes find each other.
const NODES: [usize; 3] = [5, 20, 50];

impl Trips {
    fn trip(&self, bytes: usize) -> Trip {
        let message = match self.part {
            Part::Loaned => Message::Loaned,
            Part::C if bytes > rmw::STRUCT_BYTES => Message::Serialized,
            _ => Message::Struct,
        };
        Trip { client: self.client, message, bytes, is_governed: false }
    }
}

/// All that is measured, in turns: what the machine does besides meets both systems.
struct Run<'a> {
    arguments: &'a Arguments,
    starter: Starter<'a>,
    systems: [System; 2],
}

impl Run<'_> {
    fn has(&self, part: Part) -> bool {
        self.arguments.only.is_empty() || self.arguments.only.contains(&part)
    }

    fn quick(&self) -> bool {
        self.arguments.told.run.quick
    }

    /// Round trips, and how many rounds of them.
    fn plan(&self) -> Vec<(u32, Vec<Trip>)> {
        let mut plan = Vec::new();
        for part in PARTS.iter().filter(|part| self.has(part.part)) {
            if part.client != Client::C && self.starter.program(part.client).is_none() {
                println!("{} is left out: no program that has it was named, see --help", part.client.name());
                continue;
            }
            let lengths = match &self.arguments.bytes[..] {
                [] if self.quick() => part.few,
                [] => part.lengths,
                own => own,
            };
            let rounds = if self.quick() { 1 } else { part.rounds };
            let mut trips: Vec<_> = lengths.iter().map(|&bytes| part.trip(bytes)).collect();
            if let Some(at) =
                trips.iter().position(|trip| part.part == Part::C && trip.message == Message::Struct)
            {
                trips.insert(at + 1, Trip { is_governed: true, ..trips[at] });
            }
            plan.push((rounds, trips));
        }
        plan
    }

    fn trips(&self) -> Result<Vec<Row>> {
        let (mut rows, plan) = (Vec::new(), self.plan());
        if plan.is_empty() {
            return Ok(rows);
        }
        let priority = if self.starter.realtime { ", SCHED_FIFO" } else { "" };
        println!(
            "half a round trip, two processes, a core each{priority}; c: rmw_wait and take; rclcpp, rclpy: an executor with one thread"
        );
        for held in [true, false] {
            let hold = if held { IdleHold::new().ok() } else { None };
            if held && hold.is_none() {
                println!("idle states cannot be held off here: /dev/cpu_dma_latency cannot be opened");
                continue;
            }
            for (rounds, trips) in &plan {
                rows.extend(self.part(*rounds, trips, [400, 700], held)?);
            }
        }
        Ok(rows)
    }

    /// The rows of a part. What is compared is measured in turns.
    fn part<C: Case>(
        &self,
        rounds: u32,
        cases: &[C],
        length_ms: [u64; 2],
        is_held: bool,
    ) -> Result<Vec<Row>> {
        let length = Duration::from_millis(length_ms[usize::from(!self.quick())]);
        let pairs = cases.iter().flat_map(|case| self.systems.iter().map(move |system| (system, *case)));
        let pairs = pairs.filter(|(system, case)| !case.is_governed() || system.name == TAUTLINE);
        let mut found: Vec<_> = pairs.map(|(system, case)| (system, case, Tally::default(), 0)).collect();
        let bar = progress_bar(u64::from(rounds) * found.len() as u64);
        for round in 1..=rounds {
            for (system, case, tally, all_faults) in &mut found {
                bar.set_message(format!("{}, {}, {} B", system.name, case.mode(), case.bytes()));
                let Measured { times_ns, lost, faults, .. } = case.measure(&self.starter, system, length)?;
                let mut times = Distribution::new();
                times_ns.into_iter().for_each(|time_ns| times.record(time_ns));
                tally.add(round, &times);
                tally.lost += lost;
                *all_faults += faults;
                bar.inc(1);
            }
        }
        bar.finish_and_clear();
        let row = |(system, case, tally, faults): &(&System, C, Tally, u64)| {
            let row = tally.row(case.experiment(is_held), system.name, &case.mode(), case.bytes());
            let per_message = *faults as f64 / row.n.max(1) as f64 / 2.0;
            let note =
                if per_message < 0.01 { row.note } else { format!("{per_message:.1} page faults a message") };
            Row { note, ..row }
        };
        Ok(found.iter().map(row).collect())
    }

    fn waits(&self) -> Result<Vec<Row>> {
        if !self.has(Part::Waits) {
            return Ok(Vec::new());
        }
        let can = |waits: &&Waits| waits.client == Client::C || self.starter.program(waits.client).is_some();
        let waits: Vec<_> = WAITS.iter().filter(can).copied().collect();
        self.part(if self.quick() { 1 } else { 3 }, &waits, [300, 700], false)
    }

    fn flows(&self) -> Result<Vec<Row>> {
        if !self.has(Part::Cpu) {
            return Ok(Vec::new());
        }
        let seconds = Duration::from_secs(if self.quick() { 2 } else { 5 });
        let bar = progress_bar(2);
        let measure = |system: &System| {
            bar.set_message(format!("{}: {}", system.name, flow::MODE));
            let row = flow::measure(&self.starter, system, seconds);
            bar.inc(1);
            row
        };
        let rows = self.systems.iter().map(measure).collect();
        bar.finish_and_clear();
        rows
    }

    fn nodes(&self) -> Result<Vec<Row>> {
        let mut rows = Vec::new();
        if !self.has(Part::Nodes) {
            return Ok(rows);
        }
        let sizes = if self.quick() { &NODES[..1] } else { &NODES[..] };
        let bar = progress_bar(2 * sizes.len() as u64);
        for &nodes in sizes {
            for system in &self.systems {
                bar.set_message(format!("{}: {nodes} nodes", system.name));
                match nodes::measure(&self.starter, system, nodes) {
                    Ok(row) => rows.push(row),
                    // It needs multicast, which not every network has.
                    Err(error) if system.name == FAST_DDS => {
                        let row = Tally::default().row(nodes::experiment(nodes), FAST_DDS, nodes::MODE, 0);
                        rows.push(Row { note: format!("not measured: {error}"), ..row });
                    }
                    Err(error) => return Err(error),
                }
                bar.inc(1);
            }
        }
        bar.finish_and_clear();
        Ok(rows)
    }
}

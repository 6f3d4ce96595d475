// SPDX-License-Identifier: MIT OR Apache-2.0
//! rmw_tautline beside Fast DDS's RMW: the same programs use both, by the names that rcl uses.
//!
//! | module | holds |
//! |---|---|
//! | `trips` | half round trips: their rows |
//! | `end` | an end of them that calls the RMW itself; `client.py` and `rclcpp.cpp` are ends in rclpy and rclcpp |
//! | `flow` | the CPU time of topics at a rate |
//! | `nodes` | the time until nodes have found each other |
//! | `system` | the RMWs, and the processes that use them |
//! | `rmw` | an RMW's functions |
//! | `types` | type supports |

#[path = "../src/bindings.rs"]
mod bindings;
mod end;
mod flow;
mod nodes;
#[path = "../../benches/src/process.rs"]
#[allow(dead_code, reason = "no bench uses all of it")]
mod process;
mod rmw;
mod system;
mod trips;
mod types;

use clap::{Parser, ValueEnum};
use serde_json::{Value, json};
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;
use system::{Message, Starter, System, Task};
use tautline_exchange::{Job, Result};
use tautline_rt::IdleHold;
use trips::{Client, Trip};

/// rmw_tautline beside Fast DDS's RMW: round trips, CPU time, start-up
#[derive(Parser)]
#[command(after_help = "Examples:
  cargo xtask bench rmw
  cargo xtask bench rmw --quick --json rmw.json
  cargo xtask bench rmw -- --only loaned,cpu
  cargo xtask bench rmw -- --only c --bytes 1048576")]
struct Arguments {
    /// Fewer and shorter rounds: half a minute instead of five
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
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
    /// A program made of rmw/bench/rclcpp.cpp, which says how
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
    /// The CPU time of 20 topics at 100 Hz
    Cpu,
    /// The time until nodes have found each other
    Nodes,
}

const TAUTLINE: &str = "rmw_tautline";
const FAST_DDS: &str = "rmw_fastrtps_cpp";

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let done = match (&arguments.end, arguments.task) {
        (Some(job), Some(task)) => play(job, task).map(|()| true),
        _ => measure(&arguments),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("bench-rmw: {error}");
            ExitCode::FAILURE
        }
    }
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
    }
}

fn measure(arguments: &Arguments) -> Result<bool> {
    tautline_rt::domain::set_scope(&format!("bench_rmw_{}", std::process::id())).ok();
    let scope = tautline_rt::domain::scope()?.map(str::to_owned);
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
    let trips = run.trips()?;
    let flows = run.flows()?;
    let nodes = run.nodes()?;
    let claims = claims(&trips);
    for claim in &claims {
        println!("{}", claim.said());
    }
    let of_trips = trips.iter().filter(|row| row.system == TAUTLINE).map(|row| row.lost);
    let of_flows = flows.iter().filter(|row| row.system == TAUTLINE).map(|row| row.lost);
    let lost: u64 = of_trips.chain(of_flows).sum();
    println!("lost by {TAUTLINE}: {lost}");
    if let Some(path) = &arguments.json {
        let all = json!({
            "rows": trips.iter().map(trips::Row::to_json).collect::<Value>(),
            "cpu": flows.iter().map(flow::Row::to_json).collect::<Value>(),
            "nodes": nodes.iter().map(nodes::Row::to_json).collect::<Value>(),
            "claims": claims.iter().map(Claim::to_json).collect::<Value>(),
            "scope": scope,
        });
        std::fs::write(path, serde_json::to_string_pretty(&all)?)?;
    }
    Ok(lost == 0 && (arguments.quick || claims.iter().all(Claim::holds)))
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

    /// Round trips of each part, and how many rounds of them.
    fn plan(&self) -> Vec<(usize, Vec<Trip>)> {
        const KIB: usize = 1 << 10;
        const MIB: usize = 1 << 20;
        type Lengths = &'static [usize];
        // Rounds, lengths, and those of a quick run.
        let parts: [(Part, Client, usize, Lengths, Lengths); 4] = [
            (Part::C, Client::C, 5, &[48, 64 * KIB, MIB, 8 * MIB], &[48, MIB]),
            (Part::Loaned, Client::C, 5, &[48, MIB, 8 * MIB], &[48, 8 * MIB]),
            (Part::Rclcpp, Client::Rclcpp, 3, &[48, 64 * KIB, MIB, 8 * MIB], &[48]),
            (Part::Rclpy, Client::Rclpy, 3, &[48, 64 * KIB, MIB], &[48]),
        ];
        let Arguments { quick, bytes: own, .. } = self.arguments;
        let mut plan = Vec::new();
        for (part, client, rounds, full, short) in parts.into_iter().filter(|(part, ..)| self.has(*part)) {
            if client != Client::C && self.starter.program(client).is_none() {
                println!("{} is left out: no program that has it was named, see --help", client.name());
                continue;
            }
            let lengths = match own.is_empty() {
                true if *quick => short,
                true => full,
                false => own,
            };
            let trip = |&bytes: &usize| {
                let message = match part {
                    Part::Loaned => Message::Loaned,
                    Part::C if bytes > rmw::STRUCT_BYTES => Message::Serialized,
                    _ => Message::Struct,
                };
                Trip { client, message, bytes }
            };
            plan.push((if *quick { 1 } else { rounds }, lengths.iter().map(trip).collect()));
        }
        plan
    }

    fn trips(&self) -> Result<Vec<trips::Row>> {
        let (mut rows, plan) = (Vec::new(), self.plan());
        if plan.is_empty() {
            return Ok(rows);
        }
        let priority = if self.starter.realtime { ", SCHED_FIFO" } else { "" };
        println!("half a round trip, two processes, a core each{priority}, µs");
        println!("c: rmw_wait and take; rclcpp, rclpy: an executor with one thread\n\n{}", trips::HEAD);
        for held in [true, false] {
            let hold = if held { IdleHold::new().ok() } else { None };
            if held && hold.is_none() {
                println!("idle states cannot be held off here: /dev/cpu_dma_latency cannot be opened");
                continue;
            }
            for (rounds, trips) in &plan {
                rows.extend(self.part(*rounds, trips, held)?);
            }
        }
        println!();
        Ok(rows)
    }

    /// The rows of a part. What is compared is measured in turns.
    fn part(&self, rounds: usize, trips: &[Trip], held: bool) -> Result<Vec<trips::Row>> {
        let length = Duration::from_millis(if self.arguments.quick { 400 } else { 700 });
        let pairs = trips.iter().flat_map(|trip| self.systems.iter().map(move |system| (system, *trip)));
        let mut found: Vec<_> =
            pairs.map(|(system, trip)| (system, trips::Row::new(system.name, trip, held))).collect();
        for round in 1..=rounds {
            for (system, row) in &mut found {
                let Trip { client, bytes, .. } = row.trip;
                progress(&format!("{}, {bytes} B: round {round} of {rounds}", client.name()));
                row.add(&self.starter, system, length)?;
            }
        }
        progress("");
        found.iter().for_each(|(_, row)| println!("{row}"));
        Ok(found.into_iter().map(|(_, row)| row).collect())
    }

    fn flows(&self) -> Result<Vec<flow::Row>> {
        let mut rows = Vec::new();
        if !self.has(Part::Cpu) {
            return Ok(rows);
        }
        let seconds = Duration::from_secs(if self.arguments.quick { 2 } else { 5 });
        println!(
            "{} topics at {} Hz, two processes: CPU time in ms for each second",
            flow::TOPICS,
            flow::RATE_HZ
        );
        println!("\n{}", flow::HEAD);
        for system in &self.systems {
            progress(system.name);
            let row = flow::Row::measure(&self.starter, system, seconds)?;
            progress("");
            println!("{row}");
            rows.push(row);
        }
        let [own, other] = [&rows[0], &rows[1]].map(flow::Row::cpu_ms_per_s);
        println!("{TAUTLINE}: {:.2} of Fast DDS's CPU time\n", own / other);
        Ok(rows)
    }

    fn nodes(&self) -> Result<Vec<nodes::Row>> {
        let mut rows = Vec::new();
        if !self.has(Part::Nodes) {
            return Ok(rows);
        }
        println!("until nodes have found each other, each in a process of its own, with rclpy's ends");
        println!("\n{}", nodes::HEAD);
        for nodes in if self.arguments.quick { vec![5] } else { vec![5, 20, 50] } {
            for system in &self.systems {
                progress(&format!("{}: {nodes} nodes", system.name));
                let measured = nodes::Row::measure(&self.starter, system, nodes);
                progress("");
                match measured {
                    Ok(row) => {
                        println!("{row}");
                        rows.push(row);
                    }
                    // It needs multicast, which not every network has.
                    Err(error) if system.name == FAST_DDS => println!("{FAST_DDS} is left out: {error}"),
                    Err(error) => return Err(error),
                }
            }
        }
        println!();
        Ok(rows)
    }
}

/// What is being done, where somebody looks.
fn progress(text: &str) {
    let mut out = std::io::stderr();
    if out.is_terminal() {
        let _ = write!(out, "\r\x1b[K{text}").and_then(|()| out.flush());
    }
}

/// A ratio that is to be so much at most, with idle states held off.
struct Claim {
    what: &'static str,
    of: &'static str,
    ratio: f64,
    limit: f64,
}

impl Claim {
    fn holds(&self) -> bool {
        self.ratio <= self.limit
    }

    fn said(&self) -> String {
        let verdict = if self.holds() { "holds" } else { "does not hold" };
        let Claim { what, of, ratio, limit } = self;
        format!("{what}: {ratio:.2} of {of}, {limit:.2} at most: {verdict}")
    }

    fn to_json(&self) -> Value {
        json!({ "claim": self.what, "of": self.of, "ratio": self.ratio, "limit": self.limit })
    }
}

fn claims(rows: &[trips::Row]) -> Vec<Claim> {
    let p50s = |system: &str, message: Message, bytes: usize| {
        let is_it = |row: &&trips::Row| {
            row.system == system && row.trip == Trip { client: Client::C, message, bytes }
        };
        rows.iter().find(|row| row.held && is_it(row)).map(|row| &row.p50s_us[..])
    };
    let beside = |what, message, bytes, limit| {
        let ratio = ratio(p50s(TAUTLINE, message, bytes)?, p50s(FAST_DDS, message, bytes)?)?;
        Some(Claim { what, of: "Fast DDS's p50", ratio, limit })
    };
    let loaned = || {
        let own = |bytes| p50s(TAUTLINE, Message::Loaned, bytes);
        let ratio = ratio(own(8 << 20)?, own(48)?)?;
        Some(Claim { what: "8 MiB, loaned", of: "its p50 at 48 B", ratio, limit: 1.5 })
    };
    let all = [
        beside("48 B", Message::Struct, 48, 0.5),
        beside("1 MiB, serialized", Message::Serialized, 1 << 20, 1.0 / 3.0),
        loaned(),
    ];
    all.into_iter().flatten().collect()
}

/// The median of the rounds' ratios: those of a round are measured one after the other, on a machine in the same state.
fn ratio(own: &[f64], other: &[f64]) -> Option<f64> {
    let mut ratios: Vec<f64> = own.iter().zip(other).map(|(own, other)| own / other).collect();
    ratios.sort_unstable_by(f64::total_cmp);
    ratios.get(ratios.len() / 2).copied()
}

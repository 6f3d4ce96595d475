// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tables and the JSON.

use std::fs;
use std::path::Path;

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{Cell, CellAlignment, Table};
use serde::Serialize;
use tautline_benches::{machine, version_of};
use tautline_exchange::{APPLICATION_PRIORITY, NETWORK_PRIORITY};

use crate::Result;
use crate::plan::{Experiment, Plan, System};
use crate::verdict::verdicts;

/// One way to do one thing with one payload: half round trips, times between arrivals, response times.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub experiment: Experiment,
    pub system: System,
    pub mode: String,
    pub payload_bytes: usize,
    pub n: u64,
    pub p50_us: f64,
    pub p99_us: f64,
    pub p999_us: f64,
    pub max_us: f64,
    pub lost: u64,
    /// How often a gateway used up its budget, in the round where it was most: after that its threads are ordinary ones for a while.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub throttled: Option<u64>,
    /// What arrived, of a stream or of the flood beside the callbacks: the median round.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mb_per_s: Option<f64>,
    /// The same of each round, for comparison with rivals of that round.
    #[serde(skip)]
    pub rounds: Vec<Round>,
}

/// What one round contributed to a [`Row`].
#[derive(Clone, Copy, Debug)]
pub struct Round {
    /// The round's number that is compared: the median, or of response times the 99th percentile.
    pub time_us: f64,
    pub mb_per_s: f64,
}

/// What was sent beside the callbacks, and what of it arrived.
pub struct Flood {
    pub offered_mb_per_s: f64,
    pub arrived_mb_per_s: f64,
    /// How often the gateway used up its budget, in the round where it was most.
    pub throttled: u64,
}

/// The result of a run.
pub struct Report {
    pub rows: Vec<Row>,
    pub flood: Option<Flood>,
    pub disturbance: String,
}

impl Report {
    /// Prints the machine, a table per experiment and what must hold.
    pub fn print(&self, plan: &Plan) {
        println!("{}", machine());
        println!("{}; {}", versions(), self.disturbance);
        println!("{}", conditions(plan));
        if let Err(reason) = &plan.hiroz {
            println!("without hiroz: {reason}");
        }
        if !plan.realtime {
            println!("\n*** measured without real-time priorities: these are not the numbers to compare ***");
        }
        for &experiment in &plan.experiments {
            let rows: Vec<_> = self.rows.iter().filter(|row| row.experiment == experiment).collect();
            println!("\n{}\n{}", title(experiment), table(&rows));
        }
        if let Some(flood) = &self.flood {
            println!(
                "flood: {:.0} MB/s sent, {:.0} MB/s arrived (median round); the gateway's budget was used up at most {} times a round",
                flood.offered_mb_per_s, flood.arrived_mb_per_s, flood.throttled
            );
        }
        println!();
        for verdict in verdicts(&self.rows) {
            println!("{verdict}");
        }
    }

    /// Writes the rows to `path`.
    pub fn write_json(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(&self.rows)?;
        fs::write(path, text + "\n")
            .map_err(|error| format!("cannot write {}: {error}", path.display()).into())
    }
}

fn conditions(plan: &Plan) -> String {
    let priorities = if plan.realtime {
        format!("FIFO {NETWORK_PRIORITY} for the network, FIFO {APPLICATION_PRIORITY} for the application")
    } else {
        "NO REAL-TIME PRIORITY".to_owned()
    };
    let cores = match plan.cores {
        [Some(near), Some(far)] => format!("each with its gateway on a core, {near} and {far}"),
        _ => "on any core".to_owned(),
    };
    format!("two processes, {cores}; {priorities}; TCP over loopback; {} rounds", plan.rounds)
}

fn title(experiment: Experiment) -> &'static str {
    match experiment {
        Experiment::RoundTrip => "Half round trips in µs:",
        Experiment::Stream => "Streams: times between arrivals in µs, and what arrived in a second:",
        Experiment::Callbacks => {
            "Response times of local callbacks that load a core to 90 %, in µs, medians of the rounds:"
        }
    }
}

fn table(rows: &[&Row]) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header([
        "payload",
        "system",
        "mode",
        "n",
        "p50",
        "p99",
        "p99.9",
        "max",
        "lost",
        "throttled",
        "MB/s",
    ]);
    let mut previous = String::new();
    for row in rows {
        let payload = payload(row.payload_bytes);
        let shown = if payload == previous { String::new() } else { payload.clone() };
        previous = payload;
        let times = [row.p50_us, row.p99_us, row.p999_us, row.max_us].map(|time| format!("{time:.1}"));
        let rate = row.mb_per_s.map_or(String::new(), |rate| format!("{rate:.0}"));
        let throttled = row.throttled.map_or(String::new(), |times| times.to_string());
        let last = vec![row.lost.to_string(), throttled, rate];
        let numbers = [vec![row.n.to_string()], times.to_vec(), last].concat();
        let words = [shown, system(row.system).to_owned(), row.mode.clone()];
        let cells = words.into_iter().map(Cell::new);
        let number_cells =
            numbers.into_iter().map(|text| Cell::new(text).set_alignment(CellAlignment::Right));
        table.add_row(cells.chain(number_cells));
    }
    table
}

/// Its name.
pub fn system(system: System) -> &'static str {
    match system {
        System::Zenoh => "zenoh",
        System::Tautline => "tautline",
        System::Hiroz => "hiroz",
    }
}

/// With its unit.
pub fn payload(bytes: usize) -> String {
    match bytes {
        0 => "-".to_owned(),
        bytes if bytes >= 1 << 20 => format!("{} MiB", bytes >> 20),
        bytes if bytes >= 1 << 10 => format!("{} KiB", bytes >> 10),
        bytes => format!("{bytes} B"),
    }
}

fn versions() -> String {
    let version = |package| version_of(package).unwrap_or("?");
    let hiroz = include_str!("../../network-hiroz/Cargo.toml");
    let hiroz = hiroz.split_once("hiroz = \"=").and_then(|(_, rest)| rest.split('"').next()).unwrap_or("?");
    format!("tautline {}, zenoh {}, hiroz {hiroz}", version("tautline"), version("zenoh"))
}

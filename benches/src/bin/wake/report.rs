// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table and the JSON.

use std::fs;
use std::path::Path;

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{Cell, CellAlignment, Table};
use serde::Serialize;
use tautline_benches::{machine, version_of};

use crate::Result;
use crate::plan::{Idle, PRIORITY, Plan};
use crate::verdict::verdicts;

/// One way to send one payload under one idle state: half round trips.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub system: &'static str,
    pub mode: &'static str,
    pub idle: Idle,
    pub payload_bytes: usize,
    pub touched: bool,
    pub n: u64,
    pub p50_us: f64,
    pub p99_us: f64,
    pub p999_us: f64,
    pub max_us: f64,
    /// Round trips in which a wake-up was lost.
    pub lost: u64,
    /// The same of each round, for comparison with rivals of that round.
    #[serde(skip)]
    pub rounds: Vec<Round>,
}

/// What one round contributed to a [`Row`].
#[derive(Clone, Copy, Debug)]
pub struct Round {
    pub p50_us: f64,
    pub p99_us: f64,
}

/// The result of a run.
pub struct Rows {
    pub rows: Vec<Row>,
    pub disturbance: String,
    /// Why idle states could not be held off.
    pub idle_refused: Option<String>,
}

/// Prints the machine, a table per idle state and what must hold.
pub fn print(plan: &Plan, result: &Rows) {
    println!("{}", machine());
    println!("{}; {}", versions(), result.disturbance);
    let [sender, receiver] = plan.cores;
    let priority =
        if plan.realtime { format!("FIFO {PRIORITY}") } else { "NO REAL-TIME PRIORITY".to_owned() };
    println!("two processes, {priority}, cores {sender} and {receiver}; half round trips in µs");
    if !plan.realtime {
        println!("\n*** measured without real-time priorities: these are not the numbers to compare ***");
    }
    for &idle in &plan.idles {
        let rows: Vec<_> = result.rows.iter().filter(|row| row.idle == idle).collect();
        match idle {
            Idle::Default => println!("\nIdle states as shipped:"),
            Idle::Poll => println!("\nIdle states held off (/dev/cpu_dma_latency at 0):"),
        }
        match &result.idle_refused {
            Some(reason) if rows.is_empty() => println!("not measured: {reason}"),
            _ => println!("{}", table(&rows)),
        }
    }
    println!();
    for verdict in verdicts(&result.rows) {
        println!("{verdict}");
    }
}

/// Writes the rows to `path`.
pub fn write_json(path: &Path, result: &Rows) -> Result<()> {
    let text = serde_json::to_string_pretty(&result.rows)?;
    fs::write(path, text + "\n").map_err(|error| format!("cannot write {}: {error}", path.display()).into())
}

fn table(rows: &[&Row]) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header(["payload", "system", "mode", "n", "p50", "p99", "p99.9", "max", "lost"]);
    let mut previous = String::new();
    for row in rows {
        let payload = payload(row);
        let shown = if payload == previous { String::new() } else { payload.clone() };
        previous = payload;
        let times = [row.p50_us, row.p99_us, row.p999_us, row.max_us].map(|time| format!("{time:.2}"));
        let numbers = [vec![row.n.to_string()], times.to_vec(), vec![row.lost.to_string()]].concat();
        let words = [shown, row.system.to_owned(), row.mode.to_owned()];
        let cells = words.into_iter().map(Cell::new);
        let number_cells =
            numbers.into_iter().map(|text| Cell::new(text).set_alignment(CellAlignment::Right));
        table.add_row(cells.chain(number_cells));
    }
    table
}

fn payload(row: &Row) -> String {
    let touched = if row.touched { ", all written and read" } else { "" };
    match row.payload_bytes {
        bytes if bytes >= 1 << 20 => format!("{} MiB{touched}", bytes >> 20),
        bytes if bytes >= 1 << 10 => format!("{} KiB{touched}", bytes >> 10),
        bytes => format!("{bytes} B{touched}"),
    }
}

fn versions() -> String {
    let version = |package| version_of(package).unwrap_or("?");
    format!("tautline {}, iceoryx2 {}", version("tautline"), version("iceoryx2"))
}

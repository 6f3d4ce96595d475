// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table, the JSON, what should hold.

use std::path::Path;

use comfy_table::{CellAlignment, Table};
use serde::Serialize;
use tautline_benches::machine;

use crate::{Cell, Result, System};

/// A promise and what was measured of it.
#[derive(Serialize)]
pub struct Verdict {
    what: &'static str,
    ratio: f64,
    limit: f64,
    holds: bool,
}

pub fn print(cells: &[Cell], disturbance: &str, versions: &str) -> Vec<Verdict> {
    println!("Round trips between two processes, both blocking, in µs. {}; {disturbance}.", machine());
    println!("{versions}\n");
    let mut table = Table::new();
    table.set_header(["system", "bytes asked", "n", "p50", "p99", "p99.9", "max", "lost"]);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    for cell in cells {
        let quantile = |share| format!("{:.1}", cell.all.quantile_us(share));
        table.add_row([
            cell.system.name().to_owned(),
            cell.bytes.to_string(),
            cell.all.len().to_string(),
            quantile(0.5),
            quantile(0.99),
            quantile(0.999),
            format!("{:.0}", cell.all.max_us()),
            cell.lost.to_string(),
        ]);
    }
    println!("{table}\n");
    let verdicts = verdicts(cells);
    for Verdict { what, ratio, limit, holds } in &verdicts {
        let word = if *holds { "holds" } else { "DOES NOT HOLD" };
        println!("{what}: {ratio:.2}, at most {limit}: {word}");
    }
    verdicts
}

fn verdicts(cells: &[Cell]) -> Vec<Verdict> {
    use System::{Server, Topics};
    [
        ("64 B in place: p50 beside topics", (Server, 64), (Topics, 64), 1.2),
        ("1 MiB in place: p50 beside 64 B", (Server, 1 << 20), (Server, 64), 1.2),
    ]
    .into_iter()
    .filter_map(|(what, one, other, limit)| {
        let rounds = |(system, bytes)| {
            let cell = cells.iter().find(|cell| (cell.system, cell.bytes) == (system, bytes));
            cell.map(|cell| &cell.rounds_p50_us)
        };
        let mut ratios: Vec<_> =
            rounds(one)?.iter().zip(rounds(other)?).map(|(one, other)| one / other).collect();
        ratios.sort_by(f64::total_cmp);
        let ratio = *ratios.get(ratios.len() / 2)?;
        Some(Verdict { what, ratio, limit, holds: ratio <= limit })
    })
    .collect()
}

pub fn write_json(path: &Path, cells: &[Cell], verdicts: &[Verdict], versions: &str) -> Result<()> {
    let row = |cell: &Cell| {
        serde_json::json!({
            "system": cell.system.name(),
            "request_bytes": cell.bytes,
            "n": cell.all.len(),
            "p50_us": cell.all.quantile_us(0.5),
            "p99_us": cell.all.quantile_us(0.99),
            "p999_us": cell.all.quantile_us(0.999),
            "max_us": cell.all.max_us(),
            "lost": cell.lost,
            "rounds_p50_us": cell.rounds_p50_us,
        })
    };
    let rows: Vec<_> = cells.iter().map(row).collect();
    let run =
        serde_json::json!({ "machine": machine(), "versions": versions, "rows": rows, "verdicts": verdicts });
    Ok(std::fs::write(path, serde_json::to_string_pretty(&run)?)?)
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Ways to write and read a message.

use super::figures::{machine, us};
use serde_json::Value;
use std::fmt::Write;

/// A line per message, a column per way to handle it.
pub(super) fn table(run: &Value) -> String {
    let rows: Vec<_> = run.as_array().into_iter().flatten().collect();
    let names = |key: &str| {
        let mut names: Vec<_> = rows.iter().filter_map(|row| row[key].as_str()).collect();
        let mut seen = std::collections::BTreeSet::new();
        names.retain(|name| seen.insert(*name));
        names
    };
    let implementations = names("implementation");
    let mut out = format!("| message | bytes | {} |\n", implementations.join(" | "));
    let _ = writeln!(out, "|---|--:|{}", "--:|".repeat(implementations.len()));
    for case in names("case") {
        let find = |implementation: &str| {
            rows.iter().find(|row| row["case"] == case && row["implementation"] == implementation)
        };
        let bytes = find(implementations[0]).map_or(&Value::Null, |row| &row["bytes"]);
        let time = |row: &&Value| match row["p50_us"].as_f64() {
            Some(us) if us < 1.0 => format!("{us:.3}"),
            _ => us(row, "p50_us"),
        };
        let times = implementations.iter().map(|name| find(name).map_or("-".into(), time));
        let _ = writeln!(out, "| {case} | {bytes} | {} |", times.collect::<Vec<_>>().join(" | "));
    }
    let _ =
        writeln!(out, "\n`cargo xtask bench messages`: medians in µs, one process, one core; {}.", machine());
    out
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What several tables have in common.

use serde_json::Value;
use std::fmt::Write;
use std::fs;

/// A way of a system, and the rows of the run.
pub(super) struct Way<'r> {
    rows: &'r [&'r Value],
    system: &'r str,
    mode: &'r str,
}

impl<'r> Way<'r> {
    /// In the order in which they first appear.
    fn all(rows: &'r [&'r Value]) -> Vec<Self> {
        let mut ways: Vec<Self> = Vec::new();
        for row in rows {
            if let (Some(system), Some(mode)) = (row["system"].as_str(), row["mode"].as_str())
                && !ways.iter().any(|way| (way.system, way.mode) == (system, mode))
            {
                ways.push(Way { rows, system, mode });
            }
        }
        ways
    }

    /// What was measured of it in an experiment with so many bytes.
    pub(super) fn cell(&self, experiment: &str, bytes: u64, text: impl Fn(&Value) -> String) -> String {
        let is_wanted = |row: &&&Value| {
            row["experiment"] == experiment
                && row["system"] == self.system
                && row["mode"] == self.mode
                && row["payload_bytes"] == bytes
        };
        self.rows.iter().find(is_wanted).map_or("-".into(), |row| text(row))
    }
}

/// A table: a line for each way of each system of which there is something to say.
pub(super) fn table(
    rows: &[&Value],
    corner: &str,
    titles: &[String],
    cells: impl Fn(&Way<'_>) -> Vec<String>,
) -> String {
    let mut out = format!("| {corner} | {} |\n|---|{}\n", titles.join(" | "), "--:|".repeat(titles.len()));
    for way in Way::all(rows) {
        let cells = cells(&way);
        if cells.iter().any(|cell| cell != "-") {
            let _ = writeln!(out, "| {}, {} | {} |", way.system, way.mode, cells.join(" | "));
        }
    }
    out
}

/// Payloads of these rows, from the least.
pub(super) fn sizes(rows: &[&Value]) -> Vec<u64> {
    let mut sizes: Vec<u64> = rows.iter().filter_map(|row| row["payload_bytes"].as_u64()).collect();
    sizes.sort_unstable();
    sizes.dedup();
    sizes
}

/// With its unit.
pub(super) fn size(bytes: u64) -> String {
    match bytes {
        0x10_0000.. => format!("{} MiB", bytes >> 20),
        0x400.. => format!("{} KiB", bytes >> 10),
        _ => format!("{bytes} B"),
    }
}

/// The numbers of these fields.
pub(super) fn all_us(row: &Value, keys: &[&str]) -> String {
    keys.iter().map(|key| us(row, key)).collect::<Vec<_>>().join(" / ")
}

/// Three figures are enough.
pub(super) fn us(row: &Value, key: &str) -> String {
    match row[key].as_f64() {
        Some(us) if us < 100.0 => format!("{us:.2}"),
        Some(us) => format!("{us:.0}"),
        None => "-".into(),
    }
}

/// What was measured on.
pub(super) fn machine() -> String {
    let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpuinfo
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(": "))
        .map_or("?", |m| m.1);
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let virtual_machine = if cpuinfo.contains(" hypervisor") { ", virtual machine" } else { "" };
    format!("{model}, {cores} cores{virtual_machine}, Linux {}", kernel.trim())
}

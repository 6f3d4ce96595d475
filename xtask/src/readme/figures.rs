// SPDX-License-Identifier: MIT OR Apache-2.0
//! What several tables have in common.

use serde_json::Value;
use std::fs;

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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What `taut demo` found.

use serde_json::Value;
use std::fmt::Write;
use std::fs;

pub(super) fn table(demo: &Value) -> String {
    let mut out = String::from(
        "| topic | period ms | wcet ms | priority | n | p50 ms | p99 ms | max ms | RTA ms | RTA + overhead ms | RTA + host ms | missed | lost | max queue |\n\
         |---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n",
    );
    for topic in demo["topics"].as_array().into_iter().flatten() {
        let time = |key: &str| topic[key].as_f64().map_or("-".into(), |ms| format!("{ms:.2}"));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            topic["topic"].as_str().unwrap_or("?"),
            topic["period_ms"],
            topic["wcet_ms"],
            topic["priority"],
            topic["n"],
            time("p50_ms"),
            time("p99_ms"),
            time("max_ms"),
            time("rta_ms"),
            time("rta_overhead_ms"),
            time("rta_host_ms"),
            topic["deadline_misses"],
            topic["lost"],
            topic["max_queue"],
        );
    }
    let _ = writeln!(
        out,
        "\n`taut demo`: {} s on one core, {:.1} µs of middleware per message, steal {} ticks; {}, {}.",
        demo["seconds"],
        demo["overhead_us"].as_f64().unwrap_or(f64::NAN),
        demo["steal_ticks"],
        machine(),
        demo["preemption"].as_str().unwrap_or("?"),
    );
    out
}

/// What was measured on.
fn machine() -> String {
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Round trips by system and by size.

use super::figures::{machine, names, us};
use serde_json::Value;
use std::fmt::Write;

pub(super) fn table(rows: &Value) -> String {
    let rows: Vec<&Value> = rows.as_array().into_iter().flatten().collect();
    let mut out = String::from(
        "64 B, from one process to another, half a round trip, in µs (p50 / p99 / p99.9 / max):\n\n\
         | system | idle states as shipped | idle states held off |\n|---|--:|--:|\n",
    );
    for (system, mode) in names(&rows) {
        let cell = |idle| {
            let row = find(&rows, system, mode, idle, 64, false);
            row.map_or("-".into(), |row| {
                format!(
                    "{} / {} / {} / {}",
                    us(row, "p50_us"),
                    us(row, "p99_us"),
                    us(row, "p999_us"),
                    us(row, "max_us")
                )
            })
        };
        let _ = writeln!(out, "| {system}, {mode} | {} | {} |", cell("default"), cell("poll"));
    }
    let sizes: [(u64, &str); 4] = [(64, "64 B"), (4 << 10, "4 KiB"), (1 << 20, "1 MiB"), (8 << 20, "8 MiB")];
    out.push_str("\nBy size, idle states held off, p50 in µs (payload untouched / all of it written and read):\n\n| system |");
    sizes.iter().for_each(|(_, name)| out.push_str(&format!(" {name} |")));
    out.push_str("\n|---|--:|--:|--:|--:|\n");
    for (system, mode) in names(&rows) {
        let _ = write!(out, "| {system}, {mode} |");
        for (bytes, _) in sizes {
            let p50 = |touched| {
                find(&rows, system, mode, "poll", bytes, touched).map_or("-".into(), |row| us(row, "p50_us"))
            };
            let _ = write!(out, " {} / {} |", p50(false), p50(true));
        }
        out.push('\n');
    }
    let lost: u64 = rows.iter().filter_map(|row| row["lost"].as_u64()).sum();
    let n: u64 = rows.iter().filter_map(|row| row["n"].as_u64()).sum();
    let _ = writeln!(
        out,
        "\n`cargo xtask bench wake`: two processes, FIFO 50, pinned, {n} round trips in alternating rounds, {lost} wake-ups \
         lost; {}. A bare futex is the floor for anything that sleeps; busy polling occupies a core. iceoryx2 alone is faster \
         where it polls: Tautline adds sequence numbers, time stamps, loss counters and a callback.",
        machine()
    );
    out
}

fn find<'r>(
    rows: &[&'r Value],
    system: &str,
    mode: &str,
    idle: &str,
    bytes: u64,
    touched: bool,
) -> Option<&'r Value> {
    let wanted = |row: &&&Value| {
        row["system"] == system
            && row["mode"] == mode
            && row["idle"] == idle
            && row["payload_bytes"] == bytes
            && row["touched"] == touched
    };
    rows.iter().find(wanted).copied()
}

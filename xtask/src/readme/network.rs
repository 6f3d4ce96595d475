// SPDX-License-Identifier: MIT OR Apache-2.0
//! What goes over the gateways.

use super::figures::{all_us, machine, size, sizes, table as of_ways};
use serde_json::Value;
use std::fmt::Write;

/// Round trips and streams, a line per system, a column per payload; and the callbacks.
pub(super) fn table(run: &Value) -> String {
    let rows: Vec<&Value> = run.as_array().into_iter().flatten().collect();
    let of = |experiment: &str| -> Vec<&Value> {
        rows.iter().copied().filter(|row| row["experiment"] == experiment).collect()
    };
    let mut out = String::new();
    type Number = fn(&Value) -> String;
    let columns: [(&str, &str, Number); 2] = [
        ("round-trip", "half a round trip in µs, p50 / p99", |row| all_us(row, &["p50_us", "p99_us"])),
        ("stream", "a stream in MB/s", |row| {
            row["mb_per_s"].as_f64().map_or("-".into(), |rate| format!("{rate:.0}"))
        }),
    ];
    for (experiment, title, number) in columns {
        let rows = of(experiment);
        let sizes = sizes(&rows);
        let titles: Vec<String> = sizes.iter().map(|&bytes| size(bytes)).collect();
        out += &of_ways(&rows, title, &titles, |way| {
            sizes.iter().map(|&bytes| way.cell(experiment, bytes, number)).collect()
        });
        out.push('\n');
    }
    let p99 = |experiment: &str| {
        let rows = of(experiment);
        rows.iter()
            .map(|row| row["p99_us"].as_f64().map_or("-".into(), |us| format!("{:.2}", us / 1e3)))
            .collect::<Vec<_>>()
            .join(" / ")
    };
    let arrived = of("callbacks/flood").iter().find_map(|row| row["mb_per_s"].as_f64()).unwrap_or(0.0);
    let _ = writeln!(
        out,
        "p99 response times in ms of five real-time callbacks that load a core to 90 %: {} alone, {} while {arrived:.0} MB/s \
         arrive for another topic.",
        p99("callbacks/quiet"),
        p99("callbacks/flood"),
    );
    let lost: u64 =
        rows.iter().filter(|row| row["system"] == "tautline").filter_map(|row| row["lost"].as_u64()).sum();
    let hiroz = if rows.iter().any(|row| row["system"] == "hiroz") { " and hiroz" } else { "" };
    let _ = writeln!(
        out,
        "\n`cargo xtask bench network`: from a node over two gateways to a node, beside Zenoh's own publishers and \
         subscribers{hiroz}, TCP over loopback, two processes, each with its gateway on a core, alternating rounds; {lost} messages of \
         Tautline's lost; {}.",
        machine()
    );
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_networks_tables_have_a_column_per_payload() {
        let row = |experiment: &str, system: &str, mode: &str, bytes: u64, us: f64| {
            serde_json::json!({"experiment": experiment, "system": system, "mode": mode, "payload_bytes": bytes,
                               "p50_us": us, "p99_us": 2.0 * us, "mb_per_s": 700.4, "lost": 0})
        };
        let rows = [
            row("round-trip", "zenoh", "pub-sub", 64, 40.0),
            row("round-trip", "zenoh", "pub-sub", 1 << 20, 400.0),
            row("round-trip", "tautline", "node-to-node", 64, 50.0),
            row("stream", "zenoh", "window", 64 << 10, 1.0),
            row("callbacks/quiet", "tautline", "a", 0, 2000.0),
            row("callbacks/flood", "tautline", "a", 1 << 20, 2100.0),
        ];
        let tables = table(&rows.to_vec().into());
        for line in [
            "| half a round trip in µs, p50 / p99 | 64 B | 1 MiB |\n|---|--:|--:|",
            "| zenoh, pub-sub | 40.00 / 80.00 | 400 / 800 |",
            "| tautline, node-to-node | 50.00 / 100 | - |",
            "| a stream in MB/s | 64 KiB |\n|---|--:|\n| zenoh, window | 700 |",
            "90 %: 4.00 alone, 4.20 while 700 MB/s",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }
}

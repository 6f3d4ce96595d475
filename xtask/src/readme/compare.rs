// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline beside other middleware.

use super::figures::{all_us, table as of_ways, us};
use serde_json::Value;
use std::fmt::Write;

/// The comparison: a line for each way of each system.
pub(super) fn table(run: &Value) -> String {
    let rows: Vec<&Value> = run.as_array().into_iter().flatten().collect();
    let measured: Vec<&Value> = rows.iter().copied().filter(|row| row["n"] != 0).collect();
    let held = "latency/whole/held-off";
    let both = |row: &Value| all_us(row, &["p50_us", "p99_us"]);
    type Cell<'a> = (&'a str, &'a str, u64, &'a dyn Fn(&Value) -> String);
    let columns: [Cell; 7] = [
        ("64 B", held, 64, &both),
        ("1 MiB", held, 1 << 20, &both),
        ("8 MiB", held, 8 << 20, &both),
        ("1 kHz under load, p99.9", "open-loop/load/held-off", 1024, &|row| us(row, "p999_us")),
        ("robot: CPU", "robot/20x100Hz/as-shipped", 4096, &|row| us(row, "cpu_us_per_msg")),
        ("at once", "robot/20x100Hz/at-once/as-shipped", 4096, &|row| us(row, "cpu_us_per_msg")),
        ("robot: MiB", "robot/20x100Hz/as-shipped", 4096, &|row| us(row, "rss_mib")),
    ];
    let titles = columns.map(|(title, ..)| title.to_owned());
    let mut out = of_ways(&measured, "system", &titles, |way| {
        columns.map(|(_, experiment, bytes, text)| way.cell(experiment, bytes, text)).to_vec()
    });
    let mut missing: Vec<String> = Vec::new();
    let word = |row: &Value, key: &str| row[key].as_str().unwrap_or("?").to_owned();
    let of_machine = |row: &&Value| row["system"] == "machine";
    let failed = |row: &&Value| row["n"] == 0 && !of_machine(row);
    for row in rows.iter().copied().filter(failed) {
        let word = |key: &str| word(row, key);
        let experiment = if word("experiment") == "-" { String::new() } else { word("experiment") + ": " };
        let mode = match word("mode").as_str() {
            "-" => String::new(),
            mode => format!(", {mode}"),
        };
        let text = format!("{}{mode} ({experiment}{})", word("system"), word("note"));
        if !missing.contains(&text) {
            missing.push(text);
        }
    }
    let conditions = rows.iter().copied().find(of_machine).map(|row| word(row, "note"));
    let conditions =
        conditions.unwrap_or_else(|| "machine, priorities and idle states are not known".to_owned());
    let missing =
        if missing.is_empty() { String::new() } else { format!(" Left out: {}.", missing.join("; ")) };
    let _ = writeln!(
        out,
        "\n`cargo xtask bench compare`: half round trips in µs (p50 / p99), payload written and read whole, the experiment with \
         idle states held off; pinned; one way at 1 kHz under load; 20 topics at 100 Hz: CPU time of all processes per message \
         in µs, the topics evenly over the period and all at once, and resident memory; \
         -: not measured, or too few times for that percentile; {conditions}.{missing}"
    );
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_comparisons_table_has_a_line_per_way_and_names_what_is_left_out() {
        let row = |experiment: &str, system: &str, bytes: u64, n: u64| {
            serde_json::json!({"experiment": experiment, "system": system, "mode": "m", "payload_bytes": bytes, "n": n,
                               "p50_us": 5.0, "p99_us": 50.0, "p999_us": 500.0, "cpu_us_per_msg": 40.0,
                               "rss_mib": 12.0, "note": "not measured: why"})
        };
        let held = "latency/whole/held-off";
        let rows = [
            row(held, "tautline", 64, 9),
            row("robot/20x100Hz/as-shipped", "tautline", 4096, 9),
            row(held, "fastdds", 64, 9),
            row(held, "fastdds", 1 << 20, 0),
            row("latency/untouched/held-off", "hiroz", 64, 9),
            row("-", "copper", 0, 0),
        ];
        let tables = table(&rows.to_vec().into());
        for line in [
            "| tautline, m | 5.00 / 50.00 | - | - | - | 40.00 | - | 12.00 |",
            "| fastdds, m | 5.00 / 50.00 | - | - | - | - | - | - |",
            "Left out: fastdds, m (latency/whole/held-off: not measured: why); copper, m (not measured: why).",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
        assert!(!tables.contains("hiroz"), "it has none of these numbers\n{tables}");
    }
}

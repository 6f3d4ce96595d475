// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reading parameters, and setting them beside a callback.

use super::figures::{machine, us};
use serde_json::Value;
use std::fmt::Write;

/// What a read costs, and what a thread that sets does to a callback.
pub(super) fn table(run: &Value) -> String {
    let rows: Vec<&Value> = run.as_array().into_iter().flatten().collect();
    let of = |experiment: &str| -> Vec<&Value> {
        rows.iter().copied().filter(|row| row["experiment"] == experiment).collect()
    };
    let mut out = String::from("| read | ns | ns, while it is set |\n|---|--:|--:|\n");
    let ns = |row: &Value| row["p50_us"].as_f64().map_or("-".into(), |us| format!("{:.1}", us * 1e3));
    for row in of("read") {
        let Some(what) = row["mode"].as_str().and_then(|mode| mode.strip_suffix(", not being set")) else {
            continue;
        };
        let being_set = format!("{what}, being set");
        let other = rows.iter().find(|row| row["mode"].as_str() == Some(&being_set));
        let _ = writeln!(out, "| {what} | {} | {} |", ns(row), other.map_or("-".into(), |row| ns(row)));
    }
    out.push_str(
        "\n| 1 kHz callback, meanwhile | p50 µs | p99 µs | p99.9 µs | max µs | p99 to the quiet one's |\n\
         |---|--:|--:|--:|--:|--:|\n",
    );
    for row in of("callback") {
        let ratio = |at: usize| row["ratio"][at].as_f64().unwrap_or(f64::NAN);
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {:.2} ({:.2} to {:.2}) |",
            row["mode"].as_str().unwrap_or("?"),
            us(row, "p50_us"),
            us(row, "p99_us"),
            us(row, "p999_us"),
            us(row, "max_us"),
            ratio(0),
            ratio(1),
            ratio(2),
        );
    }
    let jobs: u64 = of("callback").iter().filter_map(|row| row["n"].as_u64()).sum();
    let disturbance = rows.first().and_then(|row| row["disturbance"].as_str()).unwrap_or("?");
    let _ = writeln!(
        out,
        "\n`cargo xtask bench parameters`: medians of rounds; {jobs} jobs in alternating rounds, the callback FIFO 40 on one core, the \
         other thread, 10,000 times a second, on another; {disturbance}; {}.",
        machine()
    );
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parameters_tables_have_reads_and_the_callback() {
        let row = |experiment: &str, mode: &str, us: f64, ratio: Value| {
            serde_json::json!({"experiment": experiment, "system": "tautline", "mode": mode, "p50_us": us, "n": 10,
                               "p99_us": 2.0 * us, "ratio": ratio, "disturbance": "steal 3 ticks"})
        };
        let rows = [
            row("read", "f64, not being set", 0.0031, Value::Null),
            row("read", "f64, being set", 0.0052, Value::Null),
            row("callback", "quiet", 10.0, serde_json::json!([1.0, 1.0, 1.0])),
            row("callback", "a thread sets", 10.5, serde_json::json!([1.05, 0.97, 1.2])),
        ];
        let tables = table(&rows.to_vec().into());
        for line in [
            "| f64 | 3.1 | 5.2 |\n",
            "| quiet | 10.00 | 20.00 | - | - | 1.00 (1.00 to 1.00) |\n",
            "| a thread sets | 10.50 | 21.00 | - | - | 1.05 (0.97 to 1.20) |\n",
            "20 jobs in alternating rounds",
            "steal 3 ticks",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }
}

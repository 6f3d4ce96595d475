// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's evaluation.

use super::figures::{machine, us};
use serde_json::Value;
use std::fmt::Write;

/// The 99th percentiles of the evaluation: a row for each variant, ours and r2r's for each topic.
pub(super) fn table(rows: &Value) -> String {
    let rows: Vec<&Value> = rows.as_array().into_iter().flatten().collect();
    let of_paper = |row: &&&Value| !row["variant"].as_str().unwrap_or("").starts_with("capacity");
    let (mut variants, mut topics) = (Vec::new(), Vec::new());
    for row in rows.iter().filter(of_paper) {
        if !variants.contains(&&row["variant"]) {
            variants.push(&row["variant"]);
        }
        if !topics.iter().any(|(topic, _)| *topic == &row["topic"]) {
            topics.push((&row["topic"], row["deadline_ms"].as_f64().unwrap_or(f64::NAN)));
        }
    }
    let text = |value: &Value| value.as_str().unwrap_or("?").to_owned();
    let heads: Vec<String> =
        topics.iter().map(|(topic, deadline)| format!("{} ({deadline})", text(topic))).collect();
    let mut out = format!("| variant | {} |\n|---|{}\n", heads.join(" | "), "--:|".repeat(heads.len()));
    for variant in &variants {
        let number = |system: &str, topic: &Value| {
            let wanted = |row: &&&Value| {
                row["system"] == system && row["variant"] == **variant && row["topic"] == *topic
            };
            let row = rows.iter().find(wanted)?;
            let mark = if row["misses"] == 0 && row["lost"] == 0 { "" } else { "*" };
            Some(format!("{}{mark}", us(row, "p99_ms")))
        };
        let cells = topics.iter().map(|(topic, _)| {
            let numbers = ["tautline", "r2r"].into_iter().filter_map(|system| number(system, topic));
            numbers.collect::<Vec<_>>().join(" / ")
        });
        let _ = writeln!(out, "| {} | {} |", text(variant), cells.collect::<Vec<_>>().join(" | "));
    }
    let counts = |key: &'static str| rows.iter().filter_map(move |row| row[key].as_u64());
    let (least_runs, most_ticks) = (counts("runs").min(), counts("steal_ticks").max());
    let _ = writeln!(
        out,
        "\n`cargo xtask bench paper`: 99th percentiles in ms, Tautline / r2r 0.9.7 over Fast DDS, deadlines in brackets; \
         \\* marks missed deadlines or lost messages; at least {} runs of {:.0} s of each variant, of which the hypervisor took at most \
         {} ticks of 10 ms from one variant; {}.",
        least_runs.unwrap_or(0),
        rows.first().map_or(f64::NAN, |row| run_seconds(row)),
        most_ticks.unwrap_or(0),
        machine()
    );
    out
}

/// A topic's period is its deadline.
fn run_seconds(row: &Value) -> f64 {
    let number = |key: &str| row[key].as_f64().unwrap_or(f64::NAN);
    number("n") * number("deadline_ms") / 1e3 / number("runs")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_evaluations_table_has_both_systems_and_marks_what_failed() {
        let row = |system: &str, topic: &str, p99_ms: f64, misses: u64| {
            serde_json::json!({"system": system, "variant": "tokio", "topic": topic, "deadline_ms": 10.0,
                               "p99_ms": p99_ms, "misses": misses, "lost": 0, "runs": 3, "n": 600,
                               "steal_ticks": 1})
        };
        let rows = [row("tautline", "a", 2.0, 0), row("tautline", "b", 3.0, 0), row("r2r", "a", 123.4, 5)];
        let table = table(&rows.to_vec().into());
        let lines: Vec<_> = table.lines().take(3).collect();
        assert_eq!(
            lines,
            ["| variant | a (10) | b (10) |", "|---|--:|--:|", "| tokio | 2.00 / 123* | 3.00 |"]
        );
        assert!(table.contains("3 runs of 2 s of each"), "{table}");
        assert!(table.contains("at most 1 ticks"));
    }
}

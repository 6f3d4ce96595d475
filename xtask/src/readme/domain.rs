// SPDX-License-Identifier: MIT OR Apache-2.0
//! A domain of many processes, topics and ends: one table for each question, a column for each size.

use super::figures::machine;
use serde_json::Value;
use std::fmt::Write;

/// Each experiment, by its name in the report, and what it was done with; `#` is the number at the head of a column.
const EXPERIMENTS: [(&str, &str); 8] = [
    ("processes", "# processes with the ten endpoints of every ROS node each"),
    ("topics", "# topics between two processes"),
    ("storm", "# processes that start at once"),
    ("nodes", "# such nodes in one process"),
    ("crowd", "# publishers and as many subscriptions of one topic"),
    ("load", "# topics x 2 subscriptions x 100 Hz"),
    ("images", "8 MB at 30 Hz to # subscriptions"),
    ("fan-out", "# subscriptions of one topic at 100 Hz"),
];

/// Medians; with an aim for another column of the report, that one.
pub(super) fn tables(run: &Value) -> String {
    let rows: Vec<&Value> = run["rows"].as_array().into_iter().flatten().collect();
    let mut out = String::new();
    for (name, title) in EXPERIMENTS {
        let of: Vec<&Value> = rows.iter().copied().filter(|row| row["experiment"] == name).collect();
        if !of.is_empty() {
            experiment(&mut out, title, &of);
        }
    }
    let text = |key: &str| run[key].as_str().unwrap_or("?");
    let _ = writeln!(
        out,
        "`cargo xtask bench domain`: medians unless a row says otherwise; {}; {}; {}.",
        text("versions"),
        text("disturbance"),
        machine()
    );
    out
}

fn experiment(out: &mut String, title: &str, rows: &[&Value]) {
    let mut sizes: Vec<u64> =
        rows.iter().filter_map(|row| row["size"].as_u64()).filter(|&size| size > 0).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let heads: String = sizes.iter().map(|size| format!(" {size} |")).collect();
    let _ = writeln!(out, "| {title} | at most |{heads}\n|---|---|{}", "--:|".repeat(sizes.len()));
    let mut said: Vec<(&str, &str)> = Vec::new();
    for row in rows {
        let (system, what) = (row["system"].as_str().unwrap_or("?"), row["what"].as_str().unwrap_or("?"));
        if said.contains(&(system, what)) {
            continue;
        }
        said.push((system, what));
        let same: Vec<&Value> =
            rows.iter().copied().filter(|row| row["system"] == system && row["what"] == what).collect();
        let column = same.iter().find_map(|row| row["aim"]["of"].as_str()).unwrap_or("p50");
        let aim = limits(&same);
        // One that holds for all sizes together stands in the last column.
        let cell = |size: &u64| {
            let here = same
                .iter()
                .find(|row| row["size"] == *size || (row["size"] == 0 && Some(size) == sizes.last()));
            let missed = |row: &Value| row["aim"]["is_met"] == false;
            here.map_or(String::new(), |row| shown(&row[column]) + if missed(row) { " (missed)" } else { "" })
        };
        let cells: String = sizes.iter().map(|size| format!(" {} |", cell(size))).collect();
        let systems = if system == "tautline" { String::new() } else { format!("{system}: ") };
        let of = if column == "p50" { String::new() } else { format!(", {column}") };
        let unit = row["unit"].as_str().unwrap_or("?");
        let _ = writeln!(out, "| {systems}{what}{of}, {unit} | {aim} |{cells}");
    }
    out.push('\n');
}

/// One limit if it is that of all, else each with its size.
fn limits(rows: &[&Value]) -> String {
    let limits: Vec<(&Value, String)> = rows
        .iter()
        .filter(|row| !row["aim"].is_null())
        .map(|row| (&row["size"], shown(&row["aim"]["at_most"])))
        .collect();
    match limits.first() {
        Some((_, first)) if limits.len() == rows.len() && limits.iter().all(|(_, limit)| limit == first) => {
            first.clone()
        }
        _ => limits.iter().map(|(size, limit)| format!("{size}: {limit}")).collect::<Vec<_>>().join("; "),
    }
}

/// With as many digits as say something.
fn shown(number: &Value) -> String {
    match number.as_f64() {
        None => "-".into(),
        Some(number) if number == 0.0 || number.abs() >= 100.0 => format!("{number:.0}"),
        Some(number) if number.abs() >= 10.0 => format!("{number:.1}"),
        Some(number) => format!("{number:.2}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_domains_tables_have_a_column_for_each_size() {
        let row = |experiment: &str, size: u64, system: &str, what: &str, p50: f64, aim: Value| {
            json!({"experiment": experiment, "size": size, "system": system, "what": what, "unit": "µs", "n": 9, "p50": p50,
                   "p99": 2.0 * p50, "p999": null, "max": 3.0 * p50, "aim": aim})
        };
        let aim = |of: &str, at_most: f64| json!({"at_most": at_most, "of": of, "is_met": true});
        let run = json!({"versions": "tautline 1", "disturbance": "steal 3 ticks", "rows": [
            row("processes", 1, "tautline", "a look", 1.5, Value::Null),
            row("processes", 60, "tautline", "a look", 22.0, aim("max", 50.0)),
            row("processes", 1, "tautline", "files", 2.0, json!({"at_most": 0.0, "of": "p50", "is_met": false})),
            row("processes", 60, "tautline", "files", 0.0, aim("p50", 0.0)),
            row("load", 200, "iceoryx2", "publishing", 4321.0, Value::Null),
        ]});
        let tables = tables(&run);
        for line in [
            "| # processes with the ten endpoints of every ROS node each | at most | 1 | 60 |\n",
            "| a look, max, µs | 60: 50.0 | 4.50 | 66.0 |\n",
            "| files, µs | 0 | 2.00 (missed) | 0 |\n",
            "| # topics x 2 subscriptions x 100 Hz | at most | 200 |\n",
            "| iceoryx2: publishing, µs |  | 4321 |\n",
            "tautline 1; steal 3 ticks",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }
}

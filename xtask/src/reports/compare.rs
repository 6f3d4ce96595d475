// SPDX-License-Identifier: MIT OR Apache-2.0
//! The comparison's report.

use super::{Fields, Kind::*, check_fields, judge};
use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

/// Of every row of the comparison; times are numbers where something was measured.
const COMPARE_ROW: Fields = &[(Text, "experiment system mode note"), (Count, "payload_bytes n lost")];

/// Its times and costs, and what is not in all rows.
const NUMBERS: [&str; 6] = ["p50_us", "p99_us", "p999_us", "max_us", "cpu_us_per_msg", "rss_mib"];
const OF_SOME: [&str; 4] = ["rounds", "unfit", "mb_per_s", "throttled"];

/// The comparison's rows: exactly the promised fields; each of these experiments is there, and each system; Tautline takes part in every
/// experiment that a rival has, and loses nothing where messages come one by one.
pub fn check_compare(path: &Path, systems: &[&str], experiments: &[&str]) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        rows.iter().try_for_each(check_compare_row)?;
        let is_of = |row: &Value, kind: &str| {
            row["experiment"].as_str().is_some_and(|name| name.split('/').next() == Some(kind))
        };
        for kind in experiments {
            if !rows.iter().any(|row| is_of(row, kind) && row["n"] != 0) {
                return Err(format!("nothing was measured of {kind}"));
            }
        }
        for system in systems {
            if !rows.iter().any(|row| row["system"] == *system && row["n"] != 0) {
                return Err(format!("nothing was measured of {system}"));
            }
        }
        for row in rows.iter().filter(|row| row["n"] != 0) {
            let ours = |other: &&Value| {
                other["system"] == "tautline"
                    && other["experiment"] == row["experiment"]
                    && other["payload_bytes"] == row["payload_bytes"]
            };
            if !rows.iter().any(|row| ours(&row) && row["n"] != 0) {
                return Err(format!("tautline has no row beside this one: {row}"));
            }
        }
        let one_by_one = |row: &&Value| is_of(row, "latency") || is_of(row, "request");
        match rows.iter().filter(one_by_one).find(|row| row["system"] == "tautline" && row["lost"] != 0) {
            Some(row) => Err(format!("tautline lost messages: {row}")),
            None => Ok(()),
        }
    })
}

fn check_compare_row(row: &Value) -> Result<(), String> {
    check_fields(row, "a row", COMPARE_ROW)?;
    let fields = COMPARE_ROW.iter().flat_map(|(_, names)| names.split(' '));
    let known = |name: &str| {
        NUMBERS.contains(&name) || OF_SOME.contains(&name) || fields.clone().any(|field| field == name)
    };
    if let Some(name) = row.as_object().and_then(|row| row.keys().find(|name| !known(name))) {
        return Err(format!("a row with a field '{name}': {row}"));
    }
    let is_measured = row["n"] != 0;
    for name in NUMBERS {
        let number = row.get(name).ok_or_else(|| format!("a row has no field '{name}': {row}"))?;
        // A start has no cost per message, and few times have no high quantiles.
        let may_lack = !is_measured || !["p50_us", "max_us"].contains(&name);
        if !(number.is_number() || may_lack && number.is_null()) {
            return Err(format!("'{name}' is no number: {row}"));
        }
    }
    match is_measured || row["note"] != "" {
        true => Ok(()),
        false => Err(format!("nothing was measured and nothing says why: {row}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reports::tests::refusal;
    use serde_json::json;

    #[test]
    fn a_comparison_without_a_reason_or_without_us_is_refused() {
        let row = |system: &str, n: u64| {
            let time = if n > 0 { json!(1.5) } else { Value::Null };
            json!({
                "experiment": "latency/whole/held-off", "system": system, "mode": "m", "payload_bytes": 64, "n": n,
                "p50_us": time, "p99_us": time, "p999_us": time, "max_us": time, "lost": 0, "cpu_us_per_msg": null,
                "rss_mib": null, "note": "",
            })
        };
        let judged = |rows: &[Value]| {
            refusal(|path| check_compare(path, &["tautline"], &["latency"]), &Value::from(rows))
        };
        assert_eq!(judged(&[row("tautline", 1), row("fastdds", 1)]), "");
        assert!(judged(&[row("fastdds", 1)]).contains("nothing was measured of tautline"));
        assert!(judged(&[row("tautline", 0)]).contains("nothing says why"));
        assert!(judged(&[]).contains("nothing was measured of latency"));
        assert!(judged(&[row("tautline", 1), row("zenoh", 0)]).contains("nothing says why"));
        let changed = |name: &str, value: Value| {
            let mut ours = row("tautline", 1);
            ours[name] = value;
            judged(&[ours, row("fastdds", 1)])
        };
        assert!(changed("payload_bytes", json!(65)).contains("tautline has no row beside"));
        assert!(changed("lost", json!(1)).contains("lost messages"));
        assert!(changed("p50_us", Value::Null).contains("'p50_us' is no number"));
        assert!(changed("p99_us", json!("much")).contains("'p99_us' is no number"));
        assert!(changed("idle", json!("poll")).contains("a field 'idle'"));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The network bench's report.

use super::{ROW, check_row, judge};
use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

/// The network bench's rows: each question is answered for Tautline, and beside Zenoh where that can be.
pub fn check_network(path: &Path) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        rows.iter().try_for_each(|row| check_row(row, ROW))?;
        for (experiment, system, count) in [
            ("round-trip", "tautline", 3),
            ("round-trip", "zenoh", 3),
            ("stream", "tautline", 2),
            ("stream", "zenoh", 2),
            ("callbacks/quiet", "tautline", 5),
            ("callbacks/flood", "tautline", 5),
        ] {
            let of = |row: &&Value| row["experiment"] == experiment && row["system"] == system;
            let found = rows.iter().filter(of).count();
            if found < count {
                return Err(format!("{found} rows of {system}'s {experiment}, {count} are promised"));
            }
        }
        match rows.iter().find(|row| row["experiment"] == "stream" && !row["mb_per_s"].is_number()) {
            Some(row) => Err(format!("nothing says how much arrived: {row}")),
            None => Ok(()),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reports::tests::refusal;
    use serde_json::json;

    #[test]
    fn a_network_report_answers_every_question() {
        let row = |experiment: &str, system: &str| {
            json!({"experiment": experiment, "system": system, "mode": "m", "payload_bytes": 64, "n": 9, "p50_us": 1.0,
                   "p99_us": 2, "p999_us": 3.0, "max_us": 4.0, "lost": 0, "mb_per_s": 5.0})
        };
        let mut rows = vec![row("callbacks/quiet", "tautline"); 5];
        rows.extend(vec![row("callbacks/flood", "tautline"); 5]);
        for (experiment, count) in [("round-trip", 3), ("stream", 2)] {
            rows.extend(vec![row(experiment, "tautline"); count]);
            rows.extend(vec![row(experiment, "zenoh"); count]);
        }
        let judged = |rows: &[Value]| refusal(check_network, &Value::from(rows));
        assert_eq!(judged(&rows), "");
        assert!(judged(&rows[1..]).contains("4 rows of tautline's callbacks/quiet, 5 are promised"));
        rows[15].as_object_mut().unwrap().remove("mb_per_s");
        assert!(judged(&rows).is_empty(), "of round trips there is none");
        rows[18].as_object_mut().unwrap().remove("mb_per_s");
        assert!(judged(&rows).contains("how much arrived"));
    }
}

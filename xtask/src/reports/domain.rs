// SPDX-License-Identifier: MIT OR Apache-2.0
//! The domain bench's report.

use super::{Fields, Kind::*, check_fields, check_row, judge};
use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

const DOMAIN: Fields = &[
    (Text, "machine versions disturbance"),
    (Count, "open_files"),
    (Bool, "realtime quick"),
    (List, "rows"),
];

const DOMAIN_ROW: Fields = &[(Text, "experiment system what unit"), (Count, "size n"), (Number, "p50")];

const EXPERIMENTS: [&str; 8] =
    ["processes", "topics", "storm", "nodes", "crowd", "load", "images", "fan-out"];

/// The domain bench's rows: each question is answered, and no process has left files in shared memory.
pub fn check_domain(path: &Path) -> Outcome {
    judge(path, |report| {
        check_fields(report, "the report", DOMAIN)?;
        let rows = report["rows"].as_array().map_or(&[][..], Vec::as_slice);
        rows.iter().try_for_each(|row| check_row(row, DOMAIN_ROW))?;
        for experiment in EXPERIMENTS {
            let of = |row: &&Value| row["experiment"] == experiment;
            let left = rows.iter().filter(of).find(|row| row["what"] == "files left in /dev/shm");
            match left {
                None => return Err(format!("nothing was measured of '{experiment}'")),
                Some(left) if left["p50"] != 0.0 => return Err(format!("files are left: {left}")),
                Some(_) => {}
            }
        }
        let beside =
            |system: &str| rows.iter().any(|row| row["experiment"] == "load" && row["system"] == system);
        match ["tautline", "iceoryx2"].into_iter().find(|system| !beside(system)) {
            Some(system) => Err(format!("nothing was measured of {system} under load")),
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
    fn a_domain_report_answers_every_question_and_leaves_nothing() {
        let row = |experiment: &str, system: &str, left: f64| {
            json!({"experiment": experiment, "size": 1, "system": system, "what": "files left in /dev/shm", "unit": "files",
                   "n": 1, "p50": left, "p99": null, "p999": null, "max": null, "aim": null})
        };
        let judged = |rows: &[Value]| {
            let report = json!({"machine": "m", "versions": "v", "open_files": 1024, "disturbance": "", "realtime": true,
                                "quick": true, "rows": rows});
            refusal(check_domain, &report)
        };
        let mut rows: Vec<Value> = EXPERIMENTS.map(|experiment| row(experiment, "tautline", 0.0)).into();
        assert!(judged(&rows).contains("nothing was measured of iceoryx2"));
        rows.push(row("load", "iceoryx2", 0.0));
        assert_eq!(judged(&rows), "");
        assert!(judged(&rows[1..]).contains("nothing was measured of 'processes'"));
        rows[3] = row("nodes", "tautline", 2.0);
        assert!(judged(&rows).contains("files are left"));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The reports of the automated lane keeping system.

use super::{Fields, Kind::*, check_fields, judge};
use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

const REPORT: Fields = &[
    (Text, "system shared"),
    (Bool, "realtime"),
    (List, "rows lost"),
    (Number, "chain_below_paper"),
    (Count, "published steal_ticks"),
];

const ROW: Fields =
    &[(Text, "span name"), (Count, "n"), (Number, "p50_ms p99_ms p999_ms max_ms"), (List, "values")];

/// Each way to share was measured, no message of Tautline's was lost, and the car kept its lane.
pub fn check_lane(path: &Path) -> Outcome {
    judge(path, |reports| {
        let reports = reports.as_array().ok_or("the report is no list")?;
        for shared in ["latest", "inherit", "mutex"] {
            let is_it = |report: &&Value| report["system"] == "Tautline" && report["shared"] == shared;
            let report =
                reports.iter().find(is_it).ok_or_else(|| format!("Tautline with '{shared}' is missing"))?;
            check_run(report).map_err(|reason| format!("{shared}: {reason}"))?;
        }
        reports.iter().try_for_each(|report| check_fields(report, "a run", REPORT))
    })
}

fn check_run(report: &Value) -> Result<(), String> {
    let rows = report["rows"].as_array().ok_or("no rows")?;
    rows.iter().try_for_each(|row| check_fields(row, "a row", ROW))?;
    for span in ["Chain", "Imu", "Odometry", "Subscriber", "Timer", "Planning", "Draw"] {
        if !rows.iter().any(|row| row["span"] == span && row["n"].as_u64() > Some(0)) {
            return Err(format!("nothing is known of '{span}'"));
        }
    }
    let lost = report["lost"].as_array().ok_or("no list of what was lost")?;
    if !lost.is_empty() {
        return Err(format!("messages were lost: {}", report["lost"]));
    }
    let drive = &report["drive"];
    let off_m = drive["lateral_max_m"].as_f64().ok_or("no 'lateral_max_m'")?;
    if off_m > 0.6 || drive["collisions"] != 0 {
        return Err(format!(
            "the car was {off_m} m off the lane's centre, with {} collisions",
            drive["collisions"]
        ));
    }
    Ok(())
}

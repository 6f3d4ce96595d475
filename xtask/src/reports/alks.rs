// SPDX-License-Identifier: MIT OR Apache-2.0
//! The reports of the automated lane keeping system.

use super::{Kind, Kind::*, check_fields, judge};
use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

const REPORT: &[(&str, Kind)] = &[
    ("system", Text),
    ("shared", Text),
    ("realtime", Bool),
    ("rows", List),
    ("chain_below_paper", Number),
    ("lost", List),
    ("published", Count),
    ("steal_ticks", Count),
];

const ROW: &[(&str, Kind)] = &[
    ("span", Text),
    ("name", Text),
    ("n", Count),
    ("p50_ms", Number),
    ("p99_ms", Number),
    ("p999_ms", Number),
    ("max_ms", Number),
    ("values", List),
];

/// Of so many messages of a topic one may be lost, which the report tells, on a machine that others share.
const MOST_LOST_IN: u64 = 50;

/// Each way to share was measured, hardly a message of Tautline's was lost, and the car kept its lane.
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
    if lost.iter().any(is_much) {
        return Err(format!("more than one of {MOST_LOST_IN} messages was lost: {}", report["lost"]));
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

/// Topic, lost, published. A command that comes late is overwritten by the next one: where the host takes the core, single ones are.
fn is_much(lost: &Value) -> bool {
    let count = |at: usize| lost[at].as_u64().unwrap_or(u64::MAX);
    count(1).saturating_mul(MOST_LOST_IN) > count(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn single_messages_may_be_lost() {
        assert!(!is_much(&json!(["/alks/command", 4, 226])));
        assert!(is_much(&json!(["/alks/command", 5, 226])));
        assert!(is_much(&json!(["/alks/command", null, 226])));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The reference system's reports.

use super::{Fields, Kind::*, check_fields, judge};
use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

/// Of a run of the reference system.
const REFERENCE: Fields = &[
    (Text, "system mode"),
    (Bool, "realtime"),
    (
        Count,
        "cruncher_limit dropped_in_transforms dropped front_lidar_samples front_lidar_without_estimate planner_runs",
    ),
    (Count, "steal_ticks"),
    (Number, "seconds crunch_ms cpu_percent rss_mib hot_path_average_ms hot_path_p99_ms hot_path_worst_ms"),
    (
        Number,
        "both_lidars_average_ms both_lidars_worst_ms planner_jitter_average_ms planner_jitter_worst_ms planner_drift_ms",
    ),
    (List, "hot_path_ms callbacks"),
];

/// How the comparison runs the nodes: each middleware with each way to execute callbacks.
const REFERENCE_MODES: [(&str, &str); 4] = [
    ("tautline", "system.toml"),
    ("tautline", "flat.toml"),
    ("r2r", "one LocalPool"),
    ("r2r", "a thread each"),
];

/// The reference system's report: every callback of it ran and the hot path was measured; in real time it has bounds.
pub fn check_reference(path: &Path, realtime: bool) -> Outcome {
    judge(path, |report| {
        check_reference_run(report)?;
        if report["realtime"] != realtime {
            return Err(format!("realtime is {}", report["realtime"]));
        }
        // Without, or if the machine is slower than the system file says, there is nothing to compare with.
        for bound in ["hot_path_bound_ms", "planner_jitter_bound_ms"] {
            let field = report.get(bound).ok_or_else(|| format!("the report has no field '{bound}'"))?;
            if !(field.is_number() && realtime || field.is_null()) {
                return Err(format!("'{bound}' is {field}"));
            }
        }
        Ok(())
    })
}

/// The reference system's comparison: each system's nodes ran.
pub fn check_reference_beside(path: &Path) -> Outcome {
    judge(path, |report| {
        let systems = report["systems"].as_array().ok_or("it has no list of systems")?;
        systems.iter().try_for_each(check_reference_run)?;
        for (system, mode) in REFERENCE_MODES {
            if !systems.iter().any(|it| it["system"] == system && it["mode"] == mode) {
                return Err(format!("nothing was measured of {system} ({mode})"));
            }
        }
        Ok(())
    })
}

fn check_reference_run(report: &Value) -> Result<(), String> {
    check_fields(report, "the report", REFERENCE)?;
    let callbacks = report["callbacks"].as_array().map_or(&[][..], Vec::as_slice);
    if callbacks.len() != 25 {
        return Err(format!("{} callbacks instead of 25", callbacks.len()));
    }
    if let Some(callback) = callbacks.iter().find(|callback| callback["runs"] == 0) {
        return Err(format!("a callback never ran: {callback}"));
    }
    let estimates = report["hot_path_ms"].as_array().map_or(0, Vec::len) as u64;
    let (samples, without) = (&report["front_lidar_samples"], &report["front_lidar_without_estimate"]);
    match samples.as_u64().zip(without.as_u64()) {
        Some((samples, without)) if estimates > 0 && samples == without + estimates => Ok(()),
        _ => Err(format!(
            "{samples} samples of the front lidar, {without} of them lost, make no {estimates} estimates"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reports::tests::refusal;
    use serde_json::json;

    #[test]
    fn a_reference_system_with_a_silent_node_is_refused() {
        let callbacks = vec![json!({"name": "n", "runs": 3, "dropped": 0}); 25];
        let report = json!({
            "system": "tautline", "mode": "system.toml", "realtime": true, "seconds": 1.0, "cruncher_limit": 4096, "crunch_ms": 1.6,
            "cpu_percent": 30.0, "rss_mib": 9.0, "dropped_in_transforms": 0, "dropped": 0, "front_lidar_samples": 3,
            "front_lidar_without_estimate": 1, "hot_path_average_ms": 9.0, "hot_path_p99_ms": 9.0, "hot_path_worst_ms": 9.0,
            "hot_path_ms": [9.0, 9.0], "both_lidars_average_ms": 10.0, "both_lidars_worst_ms": 10.0, "planner_runs": 3, "planner_jitter_average_ms": 0.1, "planner_jitter_worst_ms": 0.1,
            "planner_drift_ms": 0.0, "steal_ticks": 0, "callbacks": callbacks, "hot_path_bound_ms": 60.0,
            "planner_jitter_bound_ms": null,
        });
        let judged = |change: &dyn Fn(&mut Value)| {
            let mut changed = report.clone();
            change(&mut changed);
            refusal(|path| check_reference(path, true), &changed)
        };
        assert_eq!(judged(&|_| {}), "");
        assert!(judged(&|it| it["callbacks"][7]["runs"] = json!(0)).contains("a callback never ran"));
        assert!(judged(&|it| drop(it["callbacks"].as_array_mut().unwrap().pop())).contains("24 callbacks"));
        assert!(judged(&|it| it["front_lidar_samples"] = json!(4)).contains("make no 2 estimates"));
        assert!(judged(&|it| it["realtime"] = json!(false)).contains("realtime is false"));
        assert!(
            judged(&|it| drop(it.as_object_mut().unwrap().remove("hot_path_bound_ms"))).contains("no field")
        );
        let beside = |modes: &[(&str, &str)]| {
            let of = |&(system, mode): &(&str, &str)| {
                let mut run = report.clone();
                (run["system"], run["mode"]) = (json!(system), json!(mode));
                run
            };
            let runs: Vec<_> = modes.iter().map(of).collect();
            refusal(check_reference_beside, &json!({"systems": runs})).is_empty()
        };
        assert!(beside(&REFERENCE_MODES));
        assert!(!beside(&REFERENCE_MODES[1..]));
    }
}

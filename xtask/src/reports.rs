// SPDX-License-Identifier: MIT OR Apache-2.0
//! The JSON that scripts rely on: every promised field is there, with its type. No time is judged.

use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

/// A field's type.
#[derive(Clone, Copy)]
enum Kind {
    Bool,
    Count,
    Number,
    Text,
    List,
}
use Kind::{Bool, Count, List, Number, Text};

const BRIDGE_CPU: &[(&str, Kind)] = &[
    ("bridge", Number),
    ("direct", Number),
    ("bridged", Number),
    ("publisher", Number),
    ("machine", Number),
];

const BRIDGE_SUBSCRIBER: &[(&str, Kind)] =
    &[("messages", Count), ("disordered", Count), ("p50_us", Number), ("p99_us", Number)];

const DEMO: &[(&str, Kind)] = &[
    ("realtime", Bool),
    ("core", Count),
    ("seconds", Number),
    ("steal_ticks", Count),
    ("kernel", Text),
    ("topics", List),
];

const DEMO_TOPIC: &[(&str, Kind)] = &[
    ("topic", Text),
    ("period_ms", Number),
    ("wcet_ms", Number),
    ("priority", Count),
    ("n", Count),
    ("p50_ms", Number),
    ("p99_ms", Number),
    ("max_ms", Number),
    ("rta_ms", Number),
    ("rta_overhead_ms", Number),
    ("deadline_misses", Count),
    ("lost", Count),
    ("max_queue", Count),
];

const WAKE_ROW: &[(&str, Kind)] = &[
    ("system", Text),
    ("mode", Text),
    ("idle", Text),
    ("payload_bytes", Count),
    ("touched", Bool),
    ("n", Count),
    ("p50_us", Number),
    ("p99_us", Number),
    ("p999_us", Number),
    ("max_us", Number),
    ("lost", Count),
];

const MESSAGES_ROW: &[(&str, Kind)] = &[
    ("case", Text),
    ("implementation", Text),
    ("bytes", Count),
    ("n", Count),
    ("p50_us", Number),
    ("p99_us", Number),
    ("ratio_to_plain_buffer", Number),
];

const NETWORK_ROW: &[(&str, Kind)] = &[
    ("experiment", Text),
    ("system", Text),
    ("mode", Text),
    ("payload_bytes", Count),
    ("n", Count),
    ("p50_us", Number),
    ("p99_us", Number),
    ("p999_us", Number),
    ("max_us", Number),
    ("lost", Count),
];

/// Of every row of the comparison; times are numbers where something was measured.
const COMPARE_ROW: &[(&str, Kind)] = &[
    ("experiment", Text),
    ("system", Text),
    ("mode", Text),
    ("payload_bytes", Count),
    ("n", Count),
    ("lost", Count),
    ("note", Text),
];

/// Its other fields.
const COMPARE_NUMBERS: [&str; 6] = ["p50_us", "p99_us", "p999_us", "max_us", "cpu_us_per_msg", "rss_mib"];

const PAPER_ROW: &[(&str, Kind)] = &[
    ("system", Text),
    ("variant", Text),
    ("topic", Text),
    ("runs", Count),
    ("n", Count),
    ("p50_ms", Number),
    ("p99_ms", Number),
    ("max_ms", Number),
    ("p99_std_ms", Number),
    ("rta_ms", Number),
    ("deadline_ms", Number),
    ("misses", Count),
    ("lost", Count),
    ("steal_ticks", Count),
];

/// Of a run of the reference system.
const REFERENCE: &[(&str, Kind)] = &[
    ("system", Text),
    ("mode", Text),
    ("realtime", Bool),
    ("seconds", Number),
    ("cruncher_limit", Count),
    ("crunch_ms", Number),
    ("cpu_percent", Number),
    ("rss_mib", Number),
    ("dropped_in_transforms", Count),
    ("dropped", Count),
    ("front_lidar_samples", Count),
    ("front_lidar_without_estimate", Count),
    ("hot_path_average_ms", Number),
    ("hot_path_p99_ms", Number),
    ("hot_path_worst_ms", Number),
    ("hot_path_ms", List),
    ("both_lidars_average_ms", Number),
    ("both_lidars_worst_ms", Number),
    ("planner_runs", Count),
    ("planner_jitter_average_ms", Number),
    ("planner_jitter_worst_ms", Number),
    ("planner_drift_ms", Number),
    ("steal_ticks", Count),
    ("callbacks", List),
];

/// How the comparison runs the nodes: each middleware with each way to execute callbacks.
const REFERENCE_MODES: [(&str, &str); 4] = [
    ("tautline", "system.toml"),
    ("tautline", "flat.toml"),
    ("r2r", "one LocalPool"),
    ("r2r", "a thread each"),
];

/// The demo's report: five topics, each with messages; in real time if `realtime`.
pub fn check_demo(path: &Path, realtime: bool) -> Outcome {
    judge(path, |report| {
        check_fields(report, "the report", DEMO)?;
        if realtime && report["realtime"] != true {
            return Err("the demo ran without real-time priorities".to_owned());
        }
        let topics = report["topics"].as_array().map_or(&[][..], Vec::as_slice);
        if topics.len() != 5 {
            return Err(format!("{} topics instead of 5", topics.len()));
        }
        topics.iter().try_for_each(|topic| match check_row(topic, DEMO_TOPIC) {
            Ok(()) if topic["lost"] != 0 => Err(format!("messages were lost: {topic}")),
            checked => checked,
        })
    })
}

/// The demo's report with the sampler below the callbacks: its three fastest topics must miss deadlines, or the
/// measurement cannot fail.
pub fn check_ablation(path: &Path) -> Outcome {
    judge(path, |report| {
        check_fields(report, "the report", DEMO)?;
        let topics = report["topics"].as_array().map_or(&[][..], Vec::as_slice);
        match topics.iter().take(3).find(|topic| topic["deadline_misses"] == 0) {
            Some(topic) => Err(format!("no deadline was missed: {topic}")),
            None => Ok(()),
        }
    })
}

/// The wake bench's report: a list of rows, each with measurements.
pub fn check_wake(path: &Path) -> Outcome {
    check_rows(path, WAKE_ROW)
}

/// The messages bench's rows.
pub fn check_messages(path: &Path) -> Outcome {
    check_rows(path, MESSAGES_ROW)
}

/// The network bench's rows: each question is answered for Tautline, and beside Zenoh where that can be.
pub fn check_network(path: &Path) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        rows.iter().try_for_each(|row| check_row(row, NETWORK_ROW))?;
        for (experiment, system, count) in [
            ("round-trip", "tautline", 3),
            ("round-trip", "zenoh", 3),
            ("stream", "tautline", 2),
            ("stream", "zenoh", 2),
            ("callbacks", "tautline", 10),
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

/// The bridge's ways: all that was published came through each of them, once and in order, and what it cost is beside r2r's.
pub fn check_bridge(path: &Path, expected: u64) -> Outcome {
    judge(path, |report| {
        let ways = report.as_array().ok_or("it is not a list")?;
        let names: Vec<&Value> = ways.iter().map(|way| &way["direction"]).collect();
        if names != ["from_ros", "to_ros"] {
            return Err(format!("its ways are {names:?}"));
        }
        ways.iter().try_for_each(|way| {
            check_fields(&way["cpu"], "cpu", BRIDGE_CPU)?;
            for subscriber in ["direct", "bridged"] {
                check_fields(&way[subscriber], subscriber, BRIDGE_SUBSCRIBER)?;
            }
            let (all, got) = (&way["expected"], &way["bridged"]);
            if *all != expected || got["messages"] != *all || got["disordered"] != 0 {
                return Err(format!(
                    "{}: {expected} were expected in order, not {got} of {all}",
                    way["direction"]
                ));
            }
            Ok(())
        })
    })
}

/// The comparison's rows: exactly the promised fields; each system is there or says why not; Tautline takes part in every
/// experiment that a rival has, and loses nothing where messages come one by one.
pub fn check_compare(path: &Path, systems: &[&str]) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        rows.iter().try_for_each(check_compare_row)?;
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
        let latency =
            |row: &&Value| row["experiment"].as_str().is_some_and(|name| name.starts_with("latency/"));
        match rows.iter().filter(latency).find(|row| row["system"] == "tautline" && row["lost"] != 0) {
            Some(row) => Err(format!("tautline lost messages: {row}")),
            None => Ok(()),
        }
    })
}

fn check_compare_row(row: &Value) -> Result<(), String> {
    check_fields(row, "a row", COMPARE_ROW)?;
    // What the ratios are judged by comes on top.
    let known = |name: &str| {
        COMPARE_ROW.iter().any(|(field, ..)| *field == name)
            || COMPARE_NUMBERS.contains(&name)
            || ["rounds", "unfit"].contains(&name)
    };
    if let Some(name) = row.as_object().and_then(|row| row.keys().find(|name| !known(name))) {
        return Err(format!("a row with a field '{name}': {row}"));
    }
    let is_measured = row["n"] != 0;
    for name in COMPARE_NUMBERS {
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

fn check_rows(path: &Path, fields: &[(&str, Kind)]) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        if rows.is_empty() {
            return Err("it has no rows".to_owned());
        }
        rows.iter().try_for_each(|row| check_row(row, fields))
    })
}

/// The evaluation's report: a list of rows, each with measurements; in real time, where one thread serves all topics the
/// fastest miss deadlines, and a queue that is too short loses messages, or the measurement cannot fail.
pub fn check_paper(path: &Path, realtime: bool) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        rows.iter().try_for_each(|row| check_row(row, PAPER_ROW))?;
        let variant = |name: &'static str| rows.iter().filter(move |row| row["variant"] == name);
        for name in ["futures", "futures-rt", "tokio", "nort-tokio", "futures-rt-mw-below"] {
            if variant(name).count() != 5 {
                return Err(format!("{name} has {} topics instead of 5", variant(name).count()));
            }
        }
        if !realtime {
            return Ok(());
        }
        if let Some(row) = variant("futures").take(3).find(|row| row["misses"] == 0) {
            return Err(format!("no deadline was missed: {row}"));
        }
        if variant("capacity-15").all(|row| row["lost"] == 0) {
            return Err("a queue of 15 lost nothing where 16 are needed".to_owned());
        }
        Ok(())
    })
}

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

fn judge(path: &Path, check: impl FnOnce(&Value) -> Result<(), String>) -> Outcome {
    let text = std::fs::read_to_string(path).map_err(|error| error.to_string());
    let report = text.and_then(|text| serde_json::from_str(&text).map_err(|error| error.to_string()));
    match report.and_then(|report| check(&report)) {
        Ok(()) => Outcome::Ok,
        Err(reason) => Outcome::Failed(format!("{}: {reason}", path.display())),
    }
}

fn check_row(row: &Value, fields: &[(&str, Kind)]) -> Result<(), String> {
    check_fields(row, &row.to_string(), fields)?;
    if row["n"] == 0 { Err(format!("nothing was measured in {row}")) } else { Ok(()) }
}

fn check_fields(value: &Value, what: &str, fields: &[(&str, Kind)]) -> Result<(), String> {
    for &(name, kind) in fields {
        let field = value.get(name).ok_or_else(|| format!("{what} has no field '{name}'"))?;
        let (fits, wanted) = match kind {
            Bool => (field.is_boolean(), "true or false"),
            Count => (field.is_u64(), "a whole number"),
            Number => (field.is_number(), "a number"),
            Text => (field.is_string(), "a string"),
            List => (field.is_array(), "a list"),
        };
        if !fits {
            return Err(format!("'{name}' of {what} should be {wanted}, not {field}"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn wake_row() -> Value {
        json!({"system": "futex", "mode": "blocking", "idle": "poll", "payload_bytes": 64, "touched": false, "n": 9,
               "p50_us": 1.0, "p99_us": 2, "p999_us": 3.0, "max_us": 4.0, "lost": 0})
    }

    /// The evaluation's report as it must be, with `change` made to every row.
    fn paper_report(change: impl Fn(&mut Value)) -> Result<(), String> {
        let row = |variant: &str, topic: &str, misses: u64, lost: u64| {
            json!({"system": "tautline", "variant": variant, "topic": topic, "runs": 1, "n": 9, "p50_ms": 1.0, "p99_ms": 2.0,
                   "max_ms": 3.0, "p99_std_ms": 0.0, "rta_ms": 2.0, "deadline_ms": 10.0, "misses": misses, "lost": lost,
                   "steal_ticks": 0})
        };
        let topics = ["topic1", "topic2", "topic3", "topic4", "topic5"];
        let mut rows = vec![row("capacity-15", "goal", 0, 0), row("capacity-15", "scan", 0, 8)];
        for variant in ["futures", "futures-rt", "tokio", "nort-tokio", "futures-rt-mw-below"] {
            rows.extend(topics.map(|topic| row(variant, topic, 4, 0)));
        }
        rows.iter_mut().for_each(change);
        let file = std::env::temp_dir().join(format!("taut_paper_report_{}.json", std::process::id()));
        std::fs::write(&file, Value::from(rows).to_string()).unwrap();
        let outcome = check_paper(&file, true);
        std::fs::remove_file(file).unwrap();
        match outcome {
            Outcome::Ok => Ok(()),
            Outcome::Failed(reason) | Outcome::Skipped(reason) => Err(reason),
        }
    }

    #[test]
    fn a_bridge_that_loses_or_repeats_is_refused() {
        let judged = |messages: u64, disordered: u64| {
            let subscriber =
                json!({"messages": messages, "disordered": disordered, "p50_us": 1.0, "p99_us": 2.0});
            let cpu = json!({"bridge": 1.0, "direct": 1.0, "bridged": 1.0, "publisher": 1.0, "machine": 2.0});
            let way = |name| json!({"direction": name, "expected": 9, "direct": subscriber, "bridged": subscriber, "cpu": cpu});
            let file = std::env::temp_dir().join(format!("taut_bridge_report_{}.json", std::process::id()));
            std::fs::write(&file, json!([way("from_ros"), way("to_ros")]).to_string()).unwrap();
            let outcome = check_bridge(&file, 9);
            std::fs::remove_file(file).unwrap();
            matches!(outcome, Outcome::Ok)
        };
        assert!(judged(9, 0));
        assert!(!judged(8, 0) && !judged(9, 1) && !judged(10, 0));
    }

    #[test]
    fn an_evaluation_that_cannot_fail_is_refused() {
        assert_eq!(paper_report(|_| {}), Ok(()));
        assert!(paper_report(|row| row["misses"] = json!(0)).unwrap_err().contains("no deadline was missed"));
        assert!(paper_report(|row| row["lost"] = json!(0)).unwrap_err().contains("queue of 15 lost nothing"));
        assert!(paper_report(|row| row["variant"] = json!("futures")).unwrap_err().contains("instead of 5"));
        let nameless = paper_report(|row| drop(row.as_object_mut().unwrap().remove("rta_ms")));
        assert!(nameless.unwrap_err().ends_with("has no field 'rta_ms'"));
    }

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
        let file = std::env::temp_dir().join(format!("taut_reference_report_{}.json", std::process::id()));
        let judged = |change: &dyn Fn(&mut Value)| {
            let mut changed = report.clone();
            change(&mut changed);
            std::fs::write(&file, changed.to_string()).unwrap();
            let outcome = check_reference(&file, true);
            std::fs::remove_file(&file).unwrap();
            match outcome {
                Outcome::Ok => String::new(),
                Outcome::Failed(reason) | Outcome::Skipped(reason) => reason,
            }
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
            std::fs::write(&file, json!({"systems": runs}).to_string()).unwrap();
            let outcome = check_reference_beside(&file);
            std::fs::remove_file(&file).unwrap();
            matches!(outcome, Outcome::Ok)
        };
        assert!(beside(&REFERENCE_MODES));
        assert!(!beside(&REFERENCE_MODES[1..]));
    }

    #[test]
    fn a_network_report_answers_every_question() {
        let row = |experiment: &str, system: &str| {
            json!({"experiment": experiment, "system": system, "mode": "m", "payload_bytes": 64, "n": 9, "p50_us": 1.0,
                   "p99_us": 2, "p999_us": 3.0, "max_us": 4.0, "lost": 0, "mb_per_s": 5.0})
        };
        let mut rows = vec![row("callbacks", "tautline"); 10];
        for (experiment, count) in [("round-trip", 3), ("stream", 2)] {
            rows.extend(vec![row(experiment, "tautline"); count]);
            rows.extend(vec![row(experiment, "zenoh"); count]);
        }
        let file = std::env::temp_dir().join(format!("taut_network_report_{}.json", std::process::id()));
        let judged = |rows: &[Value]| {
            std::fs::write(&file, Value::from(rows).to_string()).unwrap();
            let outcome = check_network(&file);
            std::fs::remove_file(&file).unwrap();
            match outcome {
                Outcome::Ok => String::new(),
                Outcome::Failed(reason) | Outcome::Skipped(reason) => reason,
            }
        };
        assert_eq!(judged(&rows), "");
        assert!(judged(&rows[1..]).contains("9 rows of tautline's callbacks, 10 are promised"));
        rows[15].as_object_mut().unwrap().remove("mb_per_s");
        assert!(judged(&rows).is_empty(), "of round trips there is none");
        rows[18].as_object_mut().unwrap().remove("mb_per_s");
        assert!(judged(&rows).contains("how much arrived"));
    }

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
        let file = std::env::temp_dir().join(format!("taut_compare_report_{}.json", std::process::id()));
        let judged = |rows: &[Value]| {
            std::fs::write(&file, Value::from(rows).to_string()).unwrap();
            let outcome = check_compare(&file, &["tautline"]);
            std::fs::remove_file(&file).unwrap();
            match outcome {
                Outcome::Ok => String::new(),
                Outcome::Failed(reason) | Outcome::Skipped(reason) => reason,
            }
        };
        assert_eq!(judged(&[row("tautline", 1), row("fastdds", 1)]), "");
        assert!(judged(&[row("fastdds", 1)]).contains("nothing was measured of tautline"));
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

    #[test]
    fn what_is_missing_or_of_another_type_is_named() {
        assert_eq!(check_row(&wake_row(), WAKE_ROW), Ok(()));
        let refused = |name: &str, value: Value| {
            let mut row = wake_row();
            row[name] = value;
            check_row(&row, WAKE_ROW).unwrap_err()
        };
        assert!(refused("lost", json!(-1)).starts_with("'lost' of"));
        assert!(refused("p50_us", Value::Null).contains("should be a number, not null"));
        assert!(refused("n", json!(0)).starts_with("nothing was measured"));
        let mut row = wake_row();
        row.as_object_mut().unwrap().remove("idle");
        assert!(check_row(&row, WAKE_ROW).unwrap_err().ends_with("has no field 'idle'"));
    }
}

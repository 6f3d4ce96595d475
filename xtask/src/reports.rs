// SPDX-License-Identifier: MIT OR Apache-2.0
//! The JSON that scripts rely on. For each report a program of jq's says what is wrong with it: a promised field that is missing or of another
//! type, a measurement that found nothing or cannot fail. No time is judged.

use jaq_core::load::{Arena, File, Loader};
use jaq_core::{Compiler, Ctx, Vars, data, unwrap_valr};
use jaq_json::{Val, read};
use serde_json::Value;
use std::path::Path;

/// What is wrong with a report, in jq's language; nothing if it is as it should be.
pub struct Check(&'static str);

pub const ABLATION: Check = Check(include_str!("reports/ablation.jq"));
/// Is given how many messages are `expected` each way.
pub const BRIDGE: Check = Check(include_str!("reports/bridge.jq"));
/// Is given whether it was in `realtime`.
pub const DEMO: Check = Check(include_str!("reports/demo.jq"));
pub const LANE: Check = Check(include_str!("reports/lane.jq"));
/// Is given whether it was in `realtime`.
pub const PAPER: Check = Check(include_str!("reports/paper.jq"));
/// Is given whether it was in `realtime`, and whether it is of all systems `beside` each other.
pub const REFERENCE: Check = Check(include_str!("reports/reference.jq"));

/// What all of them use.
const COMMON: &str = include_str!("reports/common.jq");

impl Check {
    /// Checks the report in this file; the program is given these values by their names.
    pub fn of(&self, path: &Path, given: &[(&str, Value)]) -> Result<(), String> {
        let text = std::fs::read_to_string(path).map_err(|error| error.to_string());
        let judged = text.and_then(|text| self.judge(&text, given));
        judged.map_err(|fault| format!("{}: {fault}", path.display()))
    }

    /// The first fault, if there is one.
    fn judge(&self, report: &str, given: &[(&str, Value)]) -> Result<(), String> {
        // What jq reads is more than JSON.
        serde_json::from_str::<Value>(report).map_err(|error| error.to_string())?;
        let given: String = given.iter().map(|(name, value)| format!("def {name}: {value};\n")).collect();
        match first(&[COMMON, &given, self.0].concat(), report)? {
            None => Ok(()),
            Some(fault) => Err(serde_json::from_str(&fault).unwrap_or(fault)),
        }
    }
}

/// What a program of jq's makes first of a text of JSON.
fn first(program: &str, text: &str) -> Result<Option<String>, String> {
    let definitions = jaq_core::defs().chain(jaq_std::defs()).chain(jaq_json::defs());
    let functions = jaq_core::funs().chain(jaq_std::funs()).chain(jaq_json::funs());
    let arena = Arena::default();
    let modules = Loader::new(definitions).load(&arena, File { code: program, path: () });
    let modules = modules.map_err(|errors| format!("the check cannot be read: {errors:?}"))?;
    let program = Compiler::default().with_funs(functions).compile(modules);
    let program = program.map_err(|errors| format!("the check cannot be compiled: {errors:?}"))?;
    let value = read::parse_single(text.as_bytes()).map_err(|error| error.to_string())?;
    let context = Ctx::<data::JustLut<Val>>::new(&program.lut, Vars::new([]));
    let made = program.id.run((context, value)).map(unwrap_valr).next();
    made.map(|value| value.map(|value| value.to_string()).map_err(|error| error.to_string())).transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// As it is, the report passes; after each of these changes, in jq's language, the first fault has these words.
    fn refuses(check: &Check, given: &[(&str, Value)], report: &Value, changes: &[(&str, &str)]) {
        assert_eq!(check.judge(&report.to_string(), given), Ok(()));
        for (change, words) in changes {
            let fault = check.judge(&changed(change, report), given).unwrap_err();
            assert!(fault.contains(words), "{change}: {fault}");
        }
    }

    fn changed(change: &str, report: &Value) -> String {
        first(change, &report.to_string()).unwrap().unwrap()
    }

    #[test]
    fn a_demo_that_loses_or_cannot_fail_is_refused() {
        let topic = json!({"topic": "/a", "period_ms": 1.0, "wcet_ms": 1.0, "p50_ms": 1.0, "p99_ms": 1.0, "max_ms": 1.0, "rta_ms": 1.0,
                           "rta_overhead_ms": 1.0, "rta_host_ms": 1.0, "priority": 1, "n": 9, "beyond": 0, "unexplained": 0,
                           "deadline_misses": 3, "lost": 0, "max_queue": 1});
        let report = json!({"realtime": true, "core": 0, "steal_ticks": 0, "seconds": 1.0, "kernel": "k", "topics": vec![topic; 5]});
        refuses(
            &DEMO,
            &[("realtime", json!(true))],
            &report,
            &[
                (".realtime = false", "without real-time"),
                ("del(.topics[4])", "4 topics instead of 5"),
                (".topics[1].n = 0", "nothing was measured"),
                (".topics[1].lost = 1", "messages were lost"),
                (".topics[1].priority = -1", "'priority' should be of type count"),
                (".topics[1].priority = 1.5", "'priority' should be of type count"),
                (".topics[1].p99_ms = null", "'p99_ms' should be of type number"),
                ("del(.topics[1].rta_overhead_ms)", "'rta_overhead_ms' is no bound"),
                ("del(.topics)", "'topics' should be of type array"),
            ],
        );
        for unreadable in ["[3]", "[", "[NaN]", "{}"] {
            assert!(DEMO.judge(unreadable, &[("realtime", json!(true))]).is_err(), "{unreadable}");
        }
        refuses(&ABLATION, &[], &report, &[(".topics[2].deadline_misses = 0", "no deadline was missed")]);
    }

    #[test]
    fn an_evaluation_that_cannot_fail_is_refused() {
        let row = |variant: &str, misses: u64, lost: u64| {
            json!({"system": "tautline", "variant": variant, "topic": "t", "runs": 1, "n": 9, "p50_ms": 1.0, "p99_ms": 2.0,
                   "max_ms": 3.0, "p99_std_ms": 0.0, "rta_ms": 2.0, "deadline_ms": 10.0, "misses": misses, "lost": lost,
                   "steal_ticks": 0})
        };
        let mut rows = vec![row("capacity-15", 0, 0), row("capacity-15", 0, 8)];
        for variant in ["futures", "futures-rt", "tokio", "nort-tokio", "futures-rt-mw-below"] {
            rows.extend(vec![row(variant, 4, 0); 5]);
        }
        let changes = [
            ("map(.misses = 0)", "no deadline was missed"),
            ("map(.lost = 0)", "a queue of 15 lost nothing"),
            ("del(.[9])", "futures-rt has 4 topics instead of 5"),
            ("map(del(.rta_ms))", "'rta_ms' should be of type number"),
        ];
        refuses(&PAPER, &[("realtime", json!(true))], &json!(rows), &changes);
        let quiet = changed(changes[0].0, &json!(rows));
        assert_eq!(PAPER.judge(&quiet, &[("realtime", json!(false))]), Ok(()));
    }

    #[test]
    fn a_reference_system_with_a_silent_node_is_refused() {
        let callbacks = vec![json!({"name": "n", "runs": 3, "dropped": 0}); 25];
        let run = json!({
            "system": "tautline", "mode": "system.toml", "realtime": true, "seconds": 1.0, "cruncher_limit": 4096, "crunch_ms": 1.6,
            "cpu_percent": 30.0, "rss_mib": 9.0, "dropped_in_transforms": 0, "dropped": 0, "front_lidar_samples": 3,
            "front_lidar_without_estimate": 1, "hot_path_average_ms": 9.0, "hot_path_p99_ms": 9.0, "hot_path_worst_ms": 9.0,
            "hot_path_ms": [9.0, 9.0], "both_lidars_average_ms": 10.0, "both_lidars_worst_ms": 10.0, "planner_runs": 3,
            "planner_jitter_average_ms": 0.1, "planner_jitter_worst_ms": 0.1, "planner_drift_ms": 0.0, "steal_ticks": 0,
            "callbacks": callbacks, "hot_path_bound_ms": 60.0, "planner_jitter_bound_ms": null,
        });
        let given = |beside: bool| [("realtime", json!(true)), ("beside", json!(beside))];
        refuses(
            &REFERENCE,
            &given(false),
            &run,
            &[
                (".callbacks[7].runs = 0", "a callback never ran"),
                ("del(.callbacks[0])", "24 callbacks instead of 25"),
                (".front_lidar_samples = 4", "make no 2 estimates"),
                (".realtime = false", "realtime is false"),
                ("del(.hot_path_bound_ms)", "'hot_path_bound_ms' is null"),
            ],
        );
        let modes = [
            ("tautline", "system.toml"),
            ("tautline", "flat.toml"),
            ("r2r", "one LocalPool"),
            ("r2r", "a thread each"),
        ];
        let systems = modes.map(|(system, mode)| {
            let mut of = run.clone();
            (of["system"], of["mode"]) = (json!(system), json!(mode));
            of
        });
        let changes = [
            ("del(.systems[2])", "nothing was measured of"),
            (".systems[1].callbacks[0].runs = 0", "never ran"),
        ];
        refuses(&REFERENCE, &given(true), &json!({"systems": systems}), &changes);
        assert!(REFERENCE.judge(&run.to_string(), &given(true)).is_err());
    }

    #[test]
    fn a_car_that_leaves_its_lane_or_loses_messages_is_refused() {
        let row = |what: &str, aim: Value| json!({"experiment": "latest", "system": "tautline", "what": what, "unit": "ms", "n": 3, "p50": 1.0, "aim": aim});
        let times = [
            "odometry chain, end to end",
            "adapter: IMU callback",
            "ALKS: odometry callback",
            "ALKS: all subscribers",
            "ALKS: timer without planning",
            "ALKS: timer with planning",
            "visualizer: markers",
        ];
        let judged = ["off the lane's centre", "collisions", "messages lost"];
        let times = times.map(|what| row(what, json!({"at_most": 2.0, "is_met": false})));
        let rows =
            [times.to_vec(), judged.map(|what| row(what, json!({"must": true, "is_met": true}))).to_vec()]
                .concat();
        let reports = ["latest", "inherit", "mutex"].map(|shared| {
            json!({"system": "tautline", "shared": shared, "realtime": true, "rows": rows, "verdicts": [], "lost": [], "steal_ticks": 0, "drive": {}})
        });
        refuses(
            &LANE,
            &[],
            &json!(reports),
            &[
                ("del(.[1])", "tautline with 'inherit' is missing"),
                ("del(.[0].rows[2])", "nothing is known of 'ALKS: odometry callback'"),
                (".[0].rows[2].n = 0", "nothing was measured"),
                (".[0].rows[9].aim.is_met = false", "missed: {"),
                (".[2].rows[7].aim = null", "2 of three were judged"),
                ("del(.[2].drive)", "'drive' should be of type object"),
            ],
        );
    }

    #[test]
    fn a_bridge_that_loses_or_repeats_is_refused() {
        let row = |experiment: &str, what: &str, n: u64| json!({"experiment": experiment, "system": "r2r", "what": what, "unit": "u", "n": n, "p50": 0.0, "aim": {"must": true, "is_met": true}});
        let way = |way: &str| {
            [
                row(way, "from publishing to the subscriber, by the bridge", 9),
                row(way, "lost, by the bridge", 1),
            ]
        };
        refuses(
            &BRIDGE,
            &[("expected", json!(9))],
            &json!([way("from ROS"), way("to ROS")].concat()),
            &[
                (".[0].n = 8", "9 messages were expected"),
                (".[3].aim.is_met = false", "missed: {"),
                (".[:2]", "nothing was measured to ROS"),
                ("del(.[0])", "1 ways instead of 2"),
                ("del(.[0].unit)", "'unit' should be of type string"),
            ],
        );
    }
}

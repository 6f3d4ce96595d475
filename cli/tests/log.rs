// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut log`: lines of nodes that log, and the levels of their loggers.

mod support;

use serde_json::{Value, json};
use support::{Here, said};
use tautline::rcl_interfaces::msg::{Log, LoggerLevel};
use tautline::rcl_interfaces::srv::SetLoggerLevels;
use tautline::{Client, LogSeverity, Logger, Node, Qos, log_debug, log_error, log_info, log_warn};

/// A line without its time.
fn timeless(line: &str) -> String {
    let (level, rest) = line.split_once("] [").unwrap();
    let (_, rest) = rest.split_once("] [").unwrap();
    format!("{level}] [{rest}")
}

#[test]
fn lines_are_printed_by_node_and_level() {
    let here = Here::new(57);
    let (arm, other) = (here.node("arm", "/robot"), here.node("armour", "/robot"));
    let logger = arm.logger().clone();
    log_info!(logger, "ready");
    log_warn!(logger.child("driver"), "hot: {} °C", 81);
    log_error!(other.logger(), "\"broken\"");
    let lines = |args: &[&str]| -> Vec<String> {
        here.taut(&[&["log"], args].concat()).lines().map(timeless).collect()
    };
    let [ready, hot, broken] = [
        "[INFO] [robot.arm]: ready",
        "[WARN] [robot.arm.driver]: hot: 81 °C",
        "[ERROR] [robot.armour]: \"broken\"",
    ];
    assert_eq!(lines(&["-n", "3"]), [ready, hot, broken]);
    assert_eq!(lines(&["-n", "2", "robot/arm"]), [ready, hot]);
    assert_eq!(lines(&["-n", "2", "--level", "warn"]), [hot, broken]);
    assert_eq!(lines(&["/robot/arm", "--level", "warn", "-n1", "/robot/armour"]), [hot]);
    let source = here.taut(&["log", "-n", "1", "--source"]);
    assert!(source.contains("ready (cli/tests/log.rs:"), "{source}");
    let line: Value =
        serde_json::from_str(&here.taut(&["log", "/robot/armour", "-n", "1", "--json"])).unwrap();
    assert_eq!((&line["level"], &line["logger"]), (&json!("ERROR"), &json!("robot.armour")));
    assert_eq!(line["text"], json!("\"broken\""));
    assert!(line["time_ns"].as_i64().unwrap() > 0);

    let (code, out, words) = here.refused(&["log", "/robot/armour", "-n", "2", "--timeout", "3s"]);
    assert_eq!((code, out.lines().count()), (1, 1));
    assert!(words.contains("1 of 2 lines came on /rosout"), "{words}");
    said(&here.refused(&["log", "/nobody", "--timeout", "50ms"]), 1, "node '/nobody' to exist in domain 57");
    said(&here.refused(&["log", "--level", "loud"]), 2, "[possible values: unset, debug, info");

    // From now on, once it is there. Last: both nodes are of one context, which keeps its last 1,000 lines.
    let mut running = here.start(&["log", "--new", "-n", "1", "--timeout", "60s"]);
    while !running.has_ended() {
        log_info!(logger.child("driver"), "later");
        std::thread::yield_now();
    }
    let (code, out, words) = running.end();
    assert_eq!((code, timeless(&out)), (0, "[INFO] [robot.arm.driver]: later\n".to_owned()), "{words}");
}

#[test]
fn a_node_that_keeps_no_lines_is_named() {
    let here = Here::new(70);
    let mut brief = here.node("brief", "");
    let publisher = brief.create_publisher::<Log>("/rosout", Qos::default()).unwrap();
    let (code, _, words) = here.refused(&["log", "-n", "1", "--timeout", "100ms"]);
    assert!(code == 1 && words.contains("lines of /brief do not arrive, because its durability"), "{words}");
    let mut running = here.start(&["log", "--new", "-n", "1", "--timeout", "60s"]);
    let log = Log { level: 25, name: "brief".into(), msg: "between".into(), ..Log::default() };
    while !running.has_ended() {
        publisher.publish(&log).unwrap();
        std::thread::yield_now();
    }
    assert_eq!(running.end().1, "[25] [0000000000.000000000] [brief]: between\n");
}

/// The answer of a node to levels that are none, and to too many.
fn set(client: &Client<SetLoggerLevels::Service>, name: &str, level: u32) -> (bool, String) {
    let request = SetLoggerLevels::Request { levels: vec![LoggerLevel { name: name.into(), level }] };
    let answer = futures::executor::block_on(client.request(&request).unwrap()).unwrap();
    (answer.results[0].successful, answer.results[0].reason.clone())
}

#[test]
fn levels_are_read_and_set_while_a_node_runs() {
    let mut here = Here::new(60);
    let mut leg: Node = here.node("leg", "/robot");
    let handler = leg.make_logger_handler().unwrap();
    here.serve(&mut leg, handler);
    let level = |more: &[&str]| here.taut(&[&["log", "level", "/robot/leg"], more].concat());
    assert_eq!(level(&[]), "robot.leg: UNSET\n");
    assert_eq!(level(&["debug"]), "Set robot.leg to DEBUG\n");
    assert_eq!(level(&[]), "robot.leg: DEBUG\n");
    log_debug!(leg.logger(), "wanted now");
    assert!(here.taut(&["log", "-n", "1"]).ends_with("[robot.leg]: wanted now\n"));
    assert_eq!(level(&["error", "--logger", "robot.leg.driver"]), "Set robot.leg.driver to ERROR\n");
    assert_eq!(Logger::new("robot.leg.driver").level(), LogSeverity::Error);
    let told = here.json(&["log", "level", "robot/leg", "--logger", "robot.leg.driver"]);
    assert_eq!(told, json!({ "node": "/robot/leg", "logger": "robot.leg.driver", "level": "ERROR" }));
    assert_eq!(level(&["unset"]), "Set robot.leg to UNSET\n");

    let mut asking = here.node("asking", "");
    let name = "/robot/leg/set_logger_levels";
    let client = asking.create_client::<SetLoggerLevels::Service>(name).unwrap();
    let (done, reason) = set(&client, "robot.leg", 11);
    assert!(!done && reason.starts_with("11 is no level: 0 unset, 10 debug"), "{reason}");
    // Each makes every log statement slower, so nobody may have any number of them.
    let refused = (0..200).find_map(|n| {
        let (done, reason) = set(&client, &format!("logger{n}"), 10);
        (!done).then_some((n, reason))
    });
    let (count, reason) = refused.unwrap();
    assert!(count > 100 && reason.starts_with("128 loggers of this process"), "{count}: {reason}");
    said(
        &here.refused(&["log", "level", "/robot/leg", "debug", "--logger", "one.more"]),
        1,
        "/robot/leg does not set the level of 'one.more': 128 loggers",
    );

    let quiet =
        "node '/asking' does not serve the levels of its loggers (rclcpp, rclpy: enable_logger_service";
    said(&here.refused(&["log", "level", "asking"]), 1, quiet);
    said(&here.refused(&["log", "level", "/robot/lge"]), 1, "did you mean /robot/leg?");
    said(&here.refused(&["log", "-n", "1", "level", "/robot/leg"]), 2, "prints no lines");
}

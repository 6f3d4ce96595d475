// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut` asks nodes of rclpy through the bridge: parameters, services, actions, lifecycle, topics.

mod support;

use serde_json::{Value, json};
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use support::{BridgeProcess, Peer, STRING, Values, built, ros, scope, wait_until};
use tautline_schema::{DynamicMessage, Packages};

struct Tools {
    taut: PathBuf,
    domain: u32,
}

impl Tools {
    /// Those of a domain with a bridge to that of ROS with the same number, and the environment of rclpy; `None` without ROS 2 or `taut`.
    fn start(domain: u32) -> Option<(Self, BridgeProcess, PathBuf)> {
        let (venv, taut) = (ros()?, built("taut", "taut")?);
        Some((Tools { taut, domain }, BridgeProcess::start(domain, domain, &[]), venv))
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut taut = Command::new(&self.taut);
        taut.args(args)
            .env("TAUT_SCOPE", scope())
            .env("TAUT_DOMAIN", self.domain.to_string())
            .env_remove("RUST_LOG");
        taut
    }

    fn run(&self, args: &[&str]) -> Output {
        // ROS's processes answer when they have found each other.
        self.command(args).args(["--timeout", "60s"]).output().unwrap()
    }

    /// What a command prints that succeeds.
    fn taut(&self, args: &[&str]) -> String {
        let output = self.run(args);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{args:?}: {errors}");
        String::from_utf8(output.stdout).unwrap()
    }

    fn json(&self, args: &[&str]) -> Value {
        serde_json::from_str(&self.taut(&[args, &["--json"]].concat())).unwrap()
    }

    /// The words of one that gets "no" for an answer.
    fn refused(&self, args: &[&str]) -> String {
        let output = self.run(args);
        let words = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{args:?}: {words}");
        words
    }

    /// Until the bridge has told of it.
    fn await_services(&self, names: &[&str]) {
        for name in names {
            wait_until(name, || self.run(&["service", "type", name]).status.success());
        }
    }
}

#[test]
fn nodes_of_ros_are_asked_and_told() {
    let Some((tools, _bridge, venv)) = Tools::start(34) else { return };
    let mut peer = Peer::start_with_services(&venv, tools.domain, "there");

    let values = json!({ "gain": 1.5, "arm.speed": 3, "frames": ["map", "odom"] });
    peer.tell(json!({ "do": "serve_parameters", "values": values }));
    let services = ["list", "get", "set", "describe"].map(|verb| format!("/there/{verb}_parameters"));
    tools.await_services(&services.each_ref().map(String::as_str));
    let all = tools.taut(&["param", "list"]);
    assert!(all.contains("/there:\n  arm.speed\n  frames\n  gain\n"), "{all}");
    assert_eq!(tools.taut(&["param", "get", "/there", "gain"]), "Double value is: 1.5\n");
    assert_eq!(tools.taut(&["param", "set", "/there", "gain", "2.5"]), "Set parameter successful\n");
    assert_eq!(tools.json(&["param", "get", "there", "gain"])["value"], 2.5);
    assert!(
        tools.refused(&["param", "set", "/there", "gain", "fast"]).contains("Setting parameter failed: ")
    );
    assert!(tools.refused(&["param", "get", "/there", "gian"]).contains("did you mean gain?"));
    let described = tools.taut(&["param", "describe", "/there", "arm.speed"]);
    assert!(described.starts_with("Parameter name: arm.speed\n  Type: integer\n"), "{described}");
    let dumped = tools.taut(&["param", "dump", "/there"]);
    let expected = "/there:\n  ros__parameters:\n    arm:\n      speed: 3\n    frames:\n    - map\n    - odom\n    gain: 2.5\n";
    assert!(dumped.starts_with(expected), "{dumped}");
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), dumped.replace("speed: 3", "speed: 4")).unwrap();
    let loaded = tools.taut(&["param", "load", "/there", file.path().to_str().unwrap()]);
    assert!(loaded.starts_with("Set parameter arm.speed successful\n"), "{loaded}");
    assert_eq!(tools.taut(&["param", "get", "--hide-type", "/there", "arm.speed"]), "4\n");

    peer.tell(json!({ "do": "service", "name": "/set_bool", "type": "std_srvs/srv/SetBool", "behaviour": "set_bool" }));
    peer.tell(json!({ "do": "action_server", "name": "/fibonacci" }));
    peer.tell(json!({ "do": "lifecycle_node", "name": "living" }));
    let parts = ["send_goal", "get_result", "cancel_goal"].map(|part| format!("/fibonacci/_action/{part}"));
    tools.await_services(&parts.each_ref().map(String::as_str));
    tools.await_services(&[
        "/set_bool",
        "/living/get_state",
        "/living/change_state",
        "/living/get_available_transitions",
    ]);
    let answer = tools.taut(&["service", "call", "/set_bool", "{data: true}"]);
    assert_eq!(answer, "success: true\nmessage: 'on'\n");

    let goal = ["action", "send_goal", "/fibonacci", "--feedback", "--json"];
    let lines = tools.taut(&[&goal[..], &["{order: 4}"]].concat());
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let feedback = |sequence: &[i32]| json!({ "feedback": { "sequence": sequence } });
    let result = json!({ "status": "SUCCEEDED", "result": { "sequence": [0, 1, 1, 2, 3] } });
    let told = [feedback(&[0, 1]), feedback(&[0, 1, 1]), feedback(&[0, 1, 1, 2]), result];
    assert_eq!(lines[1..], told, "{}", lines[0]);
    let rejected = tools.refused(&[&goal[..], &["{order: -1}"]].concat());
    assert!(rejected.contains("the server rejected the goal"), "{rejected}");

    assert!(tools.json(&["lifecycle", "nodes"]).as_array().unwrap().contains(&json!("/living")));
    assert_eq!(tools.taut(&["lifecycle", "get", "/living"]), "unconfigured [1]\n");
    assert_eq!(tools.taut(&["lifecycle", "set", "/living", "configure"]), "Transitioning successful\n");
    assert_eq!(tools.taut(&["lifecycle", "get", "living"]), "inactive [2]\n");
    let unknown = tools.refused(&["lifecycle", "set", "/living", "configure"]);
    assert!(unknown.contains("there is no transition of /living"), "{unknown}");

    peer.tell(json!({ "do": "logging_node", "name": "talkative", "line": "hot" }));
    tools.await_services(&["/talkative/get_logger_levels", "/talkative/set_logger_levels"]);
    let line = tools.json(&["log", "/talkative", "-n", "1"]);
    assert_eq!(
        (&line["level"], &line["logger"], &line["text"]),
        (&json!("WARN"), &json!("talkative"), &json!("hot"))
    );
    assert_eq!(peer.tell(json!({ "do": "logs_debug" })), false);
    assert_eq!(tools.taut(&["log", "level", "/talkative", "debug"]), "Set talkative to DEBUG\n");
    assert_eq!(peer.tell(json!({ "do": "logs_debug" })), true);
    assert_eq!(tools.taut(&["log", "level", "talkative"]), "talkative: DEBUG\n");

    let publisher = peer.publisher("/text", STRING, json!({ "latched": true }));
    peer.publish_text(publisher, &["from ROS"]);
    assert_eq!(tools.taut(&["topic", "echo", "/text", "--once"]), "data: from ROS\n---\n");
}

#[test]
fn topics_of_ros_are_shown_and_measured() {
    let Some((tools, _bridge, venv)) = Tools::start(41) else { return };
    let mut peer = Peer::start_with_services(&venv, tools.domain, "there");
    let publisher = peer.publisher("/heard", STRING, json!({}));
    let told = peer.subscription("/told", STRING, json!({}));
    peer.tell(json!({ "do": "service", "name": "/set_bool", "type": "std_srvs/srv/SetBool", "behaviour": "set_bool" }));
    peer.tell(json!({ "do": "action_server", "name": "/fibonacci" }));
    tools.await_services(&["/set_bool", "/fibonacci/_action/send_goal"]);
    wait_until("/heard and /told", || {
        let list = tools.taut(&["topic", "list"]);
        list.contains("/heard") && list.contains("/told")
    });

    assert_eq!(tools.taut(&["topic", "type", "/heard"]), "std_msgs/msg/String\n");
    assert_eq!(tools.taut(&["topic", "find", STRING]), "/heard\n/told\n");
    let ends = tools.taut(&["topic", "info", "/heard", "--verbose"]);
    assert!(ends.contains("Node name: there\n") && ends.contains("Reliability: RELIABLE\n"), "{ends}");
    assert!(tools.taut(&["node", "list"]).contains("/there"));
    let parts = tools.taut(&["node", "info", "/there"]);
    for part in ["/heard: std_msgs/msg/String", "/set_bool: std_srvs/srv/SetBool", "/fibonacci: "] {
        assert!(parts.contains(part), "{part}: {parts}");
    }
    assert!(tools.taut(&["service", "list"]).contains("/set_bool"));
    assert_eq!(tools.taut(&["service", "find", "std_srvs/srv/SetBool"]), "/set_bool\n");
    assert!(tools.taut(&["action", "list"]).contains("/fibonacci"));
    let servers = tools.taut(&["action", "info", "/fibonacci"]);
    assert!(servers.contains("Action servers: 1\n    /there\n"), "{servers}");
    assert_eq!(
        tools.taut(&["interface", "show", "std_srvs/srv/SetBool"]).lines().last(),
        Some("string message")
    );

    let picture = tools.json(&["graph", "--rates", "0"]);
    let edges = picture["edges"].as_array().unwrap();
    let has = |kind: &str, topic: &str| {
        let is_it = |edge: &&Value| edge["kind"] == kind && edge["topic"] == topic;
        edges.iter().find(is_it).is_some_and(|edge| edge["node_name"] == "/there")
    };
    assert!(has("publisher", "/heard") && has("subscription", "/told"), "{picture}");

    tools.taut(&["topic", "pub", "/told", STRING, "data: by hand", "--once"]);
    assert_eq!(peer.take_texts(told, 1), ["by hand"]);

    // All three at once, while there is something to measure.
    let of = |verb| {
        let mut command =
            tools.command(&["topic", verb, "/heard", "--json", "--every", "300ms", "--timeout", "5s"]);
        command.stdout(Stdio::piped()).spawn().unwrap()
    };
    let mut running = ["hz", "bw", "delay"].map(of);
    while running.iter_mut().any(|one| one.try_wait().unwrap().is_none()) {
        peer.publish_text(publisher, &["again"]);
    }
    let last = running.map(|one| {
        let output = one.wait_with_output().unwrap();
        let lines = String::from_utf8(output.stdout).unwrap();
        let mut lines = lines.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        lines.rfind(|line| line["publishers"].as_array().is_some_and(|all| !all.is_empty())).unwrap()
    });
    let [hz, bw, delay] = &last;
    for rates in [hz, bw] {
        assert_eq!(
            (&rates["from"], &rates["publishers"][0]["publisher"]),
            (&json!("messages"), &json!("/there"))
        );
        assert!(
            rates["rate_hz"].as_f64() > Some(0.0) && rates["bytes_per_s"].as_f64() > Some(0.0),
            "{rates}"
        );
    }
    assert!(delay["publishers"][0]["messages"].as_u64() > Some(0), "{delay}");
}

/// Of nine packages: everything that ROS 2's types are made of.
const TYPES: &str = "\
    builtin_interfaces/msg/Time diagnostic_msgs/msg/DiagnosticArray geometry_msgs/msg/PoseStamped \
    geometry_msgs/msg/PoseWithCovarianceStamped geometry_msgs/msg/Polygon \
    geometry_msgs/msg/TransformStamped geometry_msgs/msg/Twist nav_msgs/msg/OccupancyGrid \
    nav_msgs/msg/Odometry nav_msgs/msg/Path rcl_interfaces/msg/Log rcl_interfaces/msg/ParameterEvent \
    sensor_msgs/msg/BatteryState sensor_msgs/msg/CameraInfo sensor_msgs/msg/Image sensor_msgs/msg/Imu \
    sensor_msgs/msg/JointState sensor_msgs/msg/LaserScan sensor_msgs/msg/NavSatFix \
    sensor_msgs/msg/PointCloud2 std_msgs/msg/Bool std_msgs/msg/ColorRGBA std_msgs/msg/Float64MultiArray \
    std_msgs/msg/Header std_msgs/msg/String test_msgs/msg/Arrays test_msgs/msg/BasicTypes \
    test_msgs/msg/BoundedSequences test_msgs/msg/Empty test_msgs/msg/MultiNested test_msgs/msg/Strings \
    test_msgs/msg/UnboundedSequences test_msgs/msg/WStrings trajectory_msgs/msg/JointTrajectory \
    visualization_msgs/msg/Marker";

/// The topic of a type.
fn topic(name: &str) -> String {
    format!("/{}", name.replace("/msg/", "_").to_lowercase())
}

/// How many are echoed at once: each is a process, and a topic that the bridge joins.
const AT_ONCE: usize = 7;

#[test]
fn messages_of_many_types_are_echoed_as_rclpy_has_them() {
    let Some((tools, _bridge, venv)) = Tools::start(40) else { return };
    let mut packages = Packages::new();
    packages.add_folder(&venv);
    let mut peer = Peer::start(&venv, tools.domain, "many");
    let types: Vec<_> = TYPES.split(' ').collect();
    for names in types.chunks(AT_ONCE) {
        let mut said = Vec::new();
        for name in names {
            let publisher = peer.publisher(&topic(name), name, json!({ "latched": true }));
            said.push(peer.tell(Values::new(name).prepare(name, 1))[0].clone());
            peer.tell(json!({ "do": "publish_prepared", "end": publisher, "count": 1 }));
        }
        let echoed = |name: &str| tools.taut(&["topic", "echo", &topic(name), "--once", "--json"]);
        let echoed: Vec<String> = std::thread::scope(|scope| {
            let all: Vec<_> = names.iter().map(|name| scope.spawn(|| echoed(name))).collect();
            all.into_iter().map(|one| one.join().unwrap()).collect()
        });
        for ((name, said), echoed) in names.iter().zip(said).zip(echoed) {
            let schema = Arc::new(packages.schema(&name.parse().unwrap()).unwrap());
            let said = DynamicMessage::from_json(&schema, &said.to_string()).unwrap().to_json();
            assert_eq!(echoed.trim_end(), said, "{name}");
        }
    }
}

/// From rclpy through the bridge into a bag, and from there through the bridge to rclpy.
#[test]
fn what_rclpy_sent_is_recorded_and_played_to_rclpy() {
    const COUNT: usize = 3;
    let Some((tools, _bridge, venv)) = Tools::start(42) else { return };
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag").to_str().unwrap().to_owned();
    let mut packages = Packages::new();
    packages.add_folder(&venv);
    let mut peer = Peer::start(&venv, tools.domain, "flight");
    let (mut publishers, mut said) = (Vec::new(), Vec::new());
    let types: Vec<_> = TYPES.split(' ').collect();
    for name in &types {
        let publisher = peer.publisher(&topic(name), name, json!({ "latched": true, "depth": COUNT }));
        said.push(peer.tell(Values::new(name).prepare(name, COUNT)));
        peer.tell(json!({ "do": "publish_prepared", "end": publisher, "count": COUNT }));
        publishers.push(publisher);
    }
    let topics: Vec<_> = types.iter().map(|name| topic(name)).collect();
    let mut record = tools.command(&["record", "--fetch", "-o", &bag, "--depth", "10"]);
    let recorder = record.args(&topics).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    wait_until("everything to be in the bag", || {
        let output = tools.run(&["bag", "check", &bag, "--json"]);
        let checked: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        checked["messages"] == types.len() * COUNT
    });
    let pid = recorder.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let output = recorder.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));

    publishers.iter().for_each(|publisher| drop(peer.tell(json!({ "do": "destroy", "end": publisher }))));
    let subscribe = |name: &&str| peer.subscription(&topic(name), name, json!({ "depth": COUNT }));
    let subscriptions: Vec<_> = types.iter().map(subscribe).collect();
    let mut played = None;
    // Topics are refused as long as the bridge tells of the publishers.
    wait_until("the publishers to be gone", || {
        let output = tools.run(&["play", &bag, "--wait", "--json"]);
        let is_done = output.status.code() != Some(2);
        played = is_done.then_some(output);
        is_done
    });
    let played = played.unwrap();
    assert!(played.status.success(), "{}", String::from_utf8_lossy(&played.stderr));
    let report: Value = serde_json::from_slice(&played.stdout).unwrap();
    assert_eq!(report["published"], types.len() * COUNT, "{report}");
    for ((name, said), subscription) in types.iter().zip(said).zip(subscriptions) {
        let schema = Arc::new(packages.schema(&name.parse().unwrap()).unwrap());
        let text = |value: &Value| DynamicMessage::from_json(&schema, &value.to_string()).unwrap().to_json();
        let received: Vec<_> = peer.take(subscription, COUNT).iter().map(text).collect();
        assert_eq!(received, said.as_array().unwrap().iter().map(text).collect::<Vec<_>>(), "{name}");
    }
}

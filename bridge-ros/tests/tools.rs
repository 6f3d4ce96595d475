// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut` asks nodes of rclpy through the bridge: parameters, services, actions, lifecycle, topics.

mod support;

use serde_json::{Value, json};
use std::path::PathBuf;
use std::process::{Command, Output};
use support::{BridgeProcess, Peer, STRING, built, ros, scope, wait_until};

const DOMAIN: u32 = 34;

struct Tools(PathBuf);

impl Tools {
    fn run(&self, args: &[&str]) -> Output {
        let mut taut = Command::new(&self.0);
        taut.args(args)
            .env("TAUT_SCOPE", scope())
            .env("TAUT_DOMAIN", DOMAIN.to_string())
            .env_remove("RUST_LOG");
        // ROS's processes answer when they have found each other.
        taut.args(["--timeout", "60s"]).output().unwrap()
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
    let Some(venv) = ros() else { return };
    let Some(program) = built("taut", "taut") else { return };
    let tools = Tools(program);
    let _bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let mut peer = Peer::start_with_services(&venv, DOMAIN, "there");

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

    let publisher = peer.publisher("/text", STRING, json!({ "latched": true }));
    peer.publish_text(publisher, &["from ROS"]);
    assert_eq!(tools.taut(&["topic", "echo", "/text", "--once"]), "data: from ROS\n---\n");
}

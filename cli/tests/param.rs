// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut param` on nodes that answer, refuse, and are silent; and files as ROS 2's.

mod support;

use futures::StreamExt;
use serde_json::json;
use std::fs;
use support::{Here, said};
use tautline::rcl_interfaces::msg;
use tautline::rcl_interfaces::srv::{GetParameters, ListParameters, SetParameters};
use tautline::{Node, ParameterDescriptor, ParameterValue, Qos};

fn parameters(here: &mut Here, name: &str, namespace: &str) -> Node {
    let mut node = here.node(name, namespace);
    let gain = ParameterDescriptor::new().description("Of the controller").range(0.0..=10.0).step(0.5);
    node.declare_parameter_with("gain", 1.5, gain).unwrap();
    node.declare_parameter("frames", vec!["map".to_owned(), "odom".to_owned()]).unwrap();
    node.declare_parameter("arm.speed", 3).unwrap();
    node.declare_parameter_with("arm.name", "left".to_owned(), ParameterDescriptor::new().read_only())
        .unwrap();
    let (handler, _changes) = node.make_parameter_handler().unwrap();
    here.serve(&mut node, handler);
    node
}

#[test]
fn parameters_are_listed_read_and_set() {
    let mut here = Here::new(79);
    let control = parameters(&mut here, "control", "/robot");
    let _twin = parameters(&mut here, "other", "");
    let names = ["arm.name", "arm.speed", "frames", "gain", "use_sim_time"];
    let listed = |margin: &str| names.map(|name| format!("{margin}{name}\n")).concat();
    assert_eq!(here.taut(&["param", "list", "robot/control"]), listed(""));
    let all = format!("/other:\n{0}/robot/control:\n{0}", listed("  "));
    assert_eq!(here.taut(&["param", "list"]), all);
    assert_eq!(here.json(&["param", "list"])[1], json!({ "node": "/robot/control", "parameters": names }));

    let get = |name| here.taut(&["param", "get", "/robot/control", name]);
    assert_eq!(get("gain"), "Double value is: 1.5\n");
    assert_eq!(get("frames"), "String values are: [\"map\", \"odom\"]\n");
    assert_eq!(get("use_sim_time"), "Boolean value is: False\n");
    assert_eq!(here.taut(&["param", "get", "--hide-type", "/robot/control", "arm.name"]), "left\n");
    let speed = json!({ "node": "/robot/control", "name": "arm.speed", "type": "integer", "value": 3 });
    assert_eq!(here.json(&["param", "get", "/robot/control", "arm.speed"]), speed);

    let set = |name, value| here.taut(&["param", "set", "/robot/control", name, value]);
    assert_eq!(set("gain", "2.5"), "Set parameter successful\n");
    set("arm.speed", "-4");
    set("frames", "[]");
    assert_eq!(control.get_parameter::<f64>("gain").unwrap(), 2.5);
    assert_eq!(control.get_parameter::<i64>("arm.speed").unwrap(), -4);
    assert!(control.get_parameter::<Vec<String>>("frames").unwrap().is_empty());

    let described = "Parameter name: gain\n  Type: double\n  Description: Of the controller\n  Constraints:\n    Min value: 0.0\n    \
                     Max value: 10.0\n    Step: 0.5\nParameter name: arm.name\n  Type: string\n  Constraints:\n    Read only: true\n";
    assert_eq!(here.taut(&["param", "describe", "/robot/control", "gain", "arm.name"]), described);
    let all = here.json(&["param", "describe", "/robot/control"]);
    assert_eq!((all.as_array().unwrap().len(), &all[1]["type"]), (5, &json!("integer")));

    let refused = |args: &[&str]| here.refused(&[&["param"], args].concat());
    let node = "/robot/control";
    let unknown =
        "there is no parameter of /robot/control 'gian'; did you mean gain? `taut param list /robot/control`";
    for verb in [
        &["get", node, "gian"][..],
        &["set", node, "gian", "1"],
        &["describe", node, "gian"],
        &["delete", node, "gian"],
    ] {
        said(&refused(verb), 1, unknown);
    }
    said(
        &refused(&["set", node, "gain", "11.0"]),
        1,
        "Setting parameter failed: parameter 'gain': 11.0 is not in 0.0..=10.0",
    );
    said(
        &refused(&["set", node, "gain", "3"]),
        1,
        "is of type double, but 3 is of type integer: write a double with a point",
    );
    said(&refused(&["set", node, "arm.name", "right"]), 1, "is read-only");
    said(&refused(&["set", node, "frames", "[1, x]"]), 2, "here are integer and string (x)");
    said(
        &refused(&["delete", node, "gain"]),
        1,
        "Deleting parameter failed: parameter 'gain' cannot be undeclared",
    );
    said(
        &refused(&["list", "/robot/contrl"]),
        1,
        "there is no node '/robot/contrl'; did you mean /robot/control?",
    );
    let (code, out, _) = refused(&["set", node, "gain", "11.0", "--json"]);
    let told: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((code, &told["successful"], &told["name"]), (1, &json!(false), &json!("gain")));

    files(&here, &control);

    // One that never answers, and one that tells nothing.
    let mut asleep = here.node("asleep", "");
    let qos = Qos::services_default();
    let _silent = asleep.create_service::<ListParameters::Service>("~/list_parameters", qos).unwrap();
    let _mute = here.node("mute", "");
    let (code, out, words) = refused(&["list", "--timeout", "3s"]);
    assert_eq!((code, out.lines().count()), (1, 12), "{words}");
    assert!(
        words.contains(
            "taut: /asleep: service '/asleep/list_parameters': no response within 3s: its node is stopped"
        ),
        "{words}"
    );
    assert!(words.ends_with("taut: 1 of 3 nodes did not answer\n"), "{words}");
    said(&refused(&["list", "asleep", "--timeout", "50ms"]), 1, "no response within 50ms");
    said(
        &refused(&["get", "mute", "gain"]),
        1,
        "node '/mute' does not serve its parameters: there is no service",
    );

    // One that answers without a result for any parameter.
    let mut vague = here.node("vague", "");
    let _listed = vague.create_service::<ListParameters::Service>("~/list_parameters", qos).unwrap();
    let requests = vague.create_service::<GetParameters::Service>("~/get_parameters", qos).unwrap().owned();
    let answer = requests.for_each(|request| {
        request.respond(GetParameters::Response::default()).unwrap();
        std::future::ready(())
    });
    here.serve(&mut vague, answer);
    let requests = vague.create_service::<SetParameters::Service>("~/set_parameters", qos).unwrap().owned();
    let answer = requests.for_each(|request| {
        request.respond(SetParameters::Response::default()).unwrap();
        std::future::ready(())
    });
    here.serve(&mut vague, answer);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("vague.yaml");
    fs::write(&file, "/vague: {ros__parameters: {gain: 1.0, speed: 2}}\n").unwrap();
    let loaded = here.refused(&["param", "load", "vague", file.to_str().unwrap()]);
    said(&loaded, 1, "/vague refuses 2 of 2");
    for name in ["gain", "speed"] {
        let line = format!("Set parameter {name} failed: the node does not say whether it was set\n");
        assert!(loaded.1.contains(&line), "{loaded:?}");
    }
}

/// As rclcpp does for a parameter that is declared with a type, but without a value: whoever asks for that one, too, gets no value at all.
#[test]
fn a_parameter_without_a_value_hides_no_other() {
    const NAMES: [&str; 5] = ["frame", "gain", "serial", "speed", "unset"];
    let mut here = Here::new(80);
    let mut node = here.node("driver", "");
    let qos = Qos::services_default();
    let requests = node.create_service::<ListParameters::Service>("~/list_parameters", qos).unwrap().owned();
    let answer = requests.for_each(|request| {
        let mut answer = ListParameters::Response::default();
        answer.result.names = NAMES.map(String::from).into();
        request.respond(answer).unwrap();
        std::future::ready(())
    });
    here.serve(&mut node, answer);
    let requests = node.create_service::<GetParameters::Service>("~/get_parameters", qos).unwrap().owned();
    let answer = requests.for_each(|request| {
        let names = request.message.names.clone();
        let is_known = |name: &String| name != "unset" && NAMES.contains(&&**name);
        let value = |name: &String| msg::ParameterValue::from(&ParameterValue::from(name.as_str()));
        let values = if names.iter().all(is_known) { names.iter().map(value).collect() } else { Vec::new() };
        request.respond(GetParameters::Response { values }).unwrap();
        std::future::ready(())
    });
    here.serve(&mut node, answer);
    // It refuses everything.
    let requests = node.create_service::<SetParameters::Service>("~/set_parameters", qos).unwrap().owned();
    let answer = requests.for_each(|request| {
        let results =
            request.message.parameters.iter().map(|_| msg::SetParametersResult::default()).collect();
        request.respond(SetParameters::Response { results }).unwrap();
        std::future::ready(())
    });
    here.serve(&mut node, answer);

    let expected = "/driver:\n  ros__parameters:\n    frame: frame\n    gain: gain\n    serial: serial\n    speed: speed\n";
    assert_eq!(here.taut(&["param", "dump", "driver"]), expected);
    assert_eq!(here.taut(&["param", "get", "driver", "unset"]), "Parameter not set.\n");
    // What has its value already is not refused.
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("driver.yaml");
    fs::write(&file, "/driver: {ros__parameters: {frame: frame, gain: gain, unset: 1, speed: 2}}\n").unwrap();
    let loaded = here.refused(&["param", "load", "driver", file.to_str().unwrap()]);
    said(&loaded, 1, "/driver refuses 2 of 4");
    assert!(loaded.1.contains("Set parameter gain successful\n"), "{loaded:?}");
}

fn files(here: &Here, control: &Node) {
    let node = "/robot/control";
    let dumped = here.taut(&["param", "dump", node]);
    let expected = "/robot/control:\n  ros__parameters:\n    arm:\n      name: left\n      speed: -4\n    frames: []\n    gain: 2.5\n    \
                    use_sim_time: false\n";
    assert_eq!(dumped, expected);
    let file = std::env::temp_dir().join(format!("tautline_param_{}.yaml", std::process::id()));
    let path = file.to_str().unwrap();
    let load = |text: &str, more: &[&str]| {
        fs::write(&file, text).unwrap();
        here.refused(&[&["param", "load", node, path], more].concat())
    };
    // What is dumped can be loaded, though some of it is read-only.
    let (code, out, words) = load(&dumped, &[]);
    assert_eq!((code, out.lines().count()), (0, 5), "{out}{words}");
    assert!(
        out.starts_with("Set parameter arm.name successful\nSet parameter arm.speed successful\n"),
        "{out}"
    );
    let (code, out, words) = load(
        "/**:\n  ros__parameters: {gain: 3.5, arm: {speed: 7}}\n/other: {ros__parameters: {gain: 1.0}}\n",
        &[],
    );
    assert_eq!(
        (code, &*out),
        (0, "Set parameter gain successful\nSet parameter arm.speed successful\n"),
        "{words}"
    );
    assert_eq!(control.get_parameter::<i64>("arm.speed").unwrap(), 7);
    assert_eq!(control.get_parameter::<f64>("gain").unwrap(), 3.5);

    let refused = load("robot/control: {ros__parameters: {gain: 99.0, arm: {speed: 8}}}", &[]);
    said(&refused, 1, "/robot/control refuses 1 of 2");
    assert!(refused.1.contains("Set parameter gain failed: parameter 'gain': 99.0 is not in"), "{refused:?}");
    assert_eq!(control.get_parameter::<i64>("arm.speed").unwrap(), 8);
    let (_, out, _) = load("robot/control: {ros__parameters: {gain: 4.0}}", &["--json"]);
    let done: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(done, json!([{ "node": node, "name": "gain", "successful": true, "reason": null }]));
    said(&load("/other: {ros__parameters: {gain: 1.0}}", &[]), 2, "says nothing for /robot/control");
    said(&load("/**:\n  ros__parameters:\n    gain: [1\n", &[]), 2, "line");
    fs::remove_file(&file).unwrap();
    said(&here.refused(&["param", "load", node, path]), 2, "No such file");
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut graph` on a domain with a mismatch, with ends without a node, on another host, and with a system file.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::Checked;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;
use tautline_transport::{
    EndpointKind, Gid, Limits, NodeName, Origin, Participant, Qos, RemoteGraph, RemoteNode, ServiceType,
    TopicEndpoint, TopicType,
};

const DOMAIN: u32 = 68;

fn command(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.arg("graph").args(args).env("TAUT_DOMAIN", DOMAIN.to_string()).env_remove("RUST_LOG");
    command
}

fn taut(args: &[&str]) -> Output {
    let output = command(args).checked();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

fn text(args: &[&str]) -> String {
    String::from_utf8(taut(args).stdout).unwrap()
}

fn parsed(args: &[&str]) -> Value {
    serde_json::from_str(&text(args)).unwrap()
}

#[track_caller]
fn refused(args: &[&str], code: i32, words: &str) {
    let output = command(args).output().unwrap();
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(
        output.status.code() == Some(code) && errors.contains(words) && output.stdout.is_empty(),
        "{args:?}: {errors}"
    );
}

fn edge<'p>(picture: &'p Value, kind: &str, node: &str, topic: &str) -> &'p Value {
    let is_it = |edge: &&Value| edge["kind"] == kind && edge["node_name"] == node && edge["topic"] == topic;
    picture["edges"]
        .as_array()
        .unwrap()
        .iter()
        .find(is_it)
        .unwrap_or_else(|| panic!("{kind} {node} {topic}: {picture}"))
}

fn names(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|one| one["name"].as_str().unwrap_or("-")).collect()
}

/// Looks until a rate was seen, however slow this computer is.
fn with_a_rate() -> Value {
    loop {
        let picture = parsed(&["--services", "--rates", "200ms", "--json"]);
        if edge(&picture, "publisher", "/camera", "/image")["rate_hz"].as_f64() > Some(0.0) {
            return picture;
        }
    }
}

fn scratch() -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("drawing-{}", std::process::id()));
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

#[test]
fn a_domain_is_drawn() {
    let participant = Participant::new(DOMAIN).unwrap();
    let [camera, viewer, recorder] =
        ["camera", "viewer", "recorder"].map(|name| participant.create_node(name, "/").unwrap());
    let image = TopicType::new("a_msgs/msg/Image");
    let publisher = |node: Option<&_>, topic: &str| {
        let of = node.map_or_else(|| participant.clone(), |node| participant.for_node(node));
        of.create_raw_publisher(topic, &image, Qos::keep_last(5).best_effort(), Limits::default()).unwrap()
    };
    let subscription = |node, topic: &str, qos| {
        participant.for_node(node).create_raw_subscription(topic, &image, qos, Limits::default()).unwrap()
    };
    let images = publisher(Some(&camera), "/image");
    let _others = [publisher(None, "/loose"), publisher(Some(&camera), "/rosout")];
    let _reliable = subscription(&viewer, "/image", Qos::keep_last(7));
    let _fitting = [
        subscription(&recorder, "/image", Qos::keep_last(7).best_effort()),
        subscription(&recorder, "/far", Qos::keep_last(7).best_effort()),
    ];
    let start = ServiceType {
        request: TopicType::new("a_msgs/srv/Start"),
        response: TopicType::new("a_msgs/srv/Start"),
    };
    let _server =
        participant.for_node(&camera).create_raw_server("/start", &start, 10, Limits::default()).unwrap();
    let _client =
        participant.for_node(&viewer).create_raw_client("/start", &start, Limits::default()).unwrap();

    // What a gateway would say.
    let there = |gid| Origin::here(Gid([gid; 16]), "robot2");
    let lidar = NodeName { namespace: "/".into(), name: "lidar".into() };
    let far = TopicEndpoint {
        kind: EndpointKind::Publisher,
        topic: "/far".into(),
        topic_type: image.clone(),
        gid: Gid([0xab; 16]),
        qos: Qos::keep_last(5),
        node: Some(lidar.clone()),
        pid: None,
        is_remote: true,
        is_own: false,
        origin: there(1),
        teller: None,
    };
    let nodes = vec![RemoteNode { name: lidar, enclave: "/".into(), origin: there(2) }];
    let gateway = Participant::new(DOMAIN).unwrap();
    gateway.set_remote(&RemoteGraph { nodes, endpoints: vec![far], ..RemoteGraph::default() }).unwrap();

    let looking = std::thread::spawn(with_a_rate);
    while !looking.is_finished() {
        images.publish(&[0; 8]).unwrap();
        // A thousand times a second.
        std::thread::sleep(Duration::from_millis(1));
    }
    let picture = looking.join().unwrap();

    assert_eq!(names(&picture["nodes"]), ["/camera", "/lidar", "/recorder", "/viewer", "-"]);
    assert_eq!(names(&picture["topics"]), ["/far", "/image", "/loose", "/start"]);
    assert_eq!(picture["left_out"], 1);
    let pid = std::process::id();
    assert_eq!(picture["nodes"][1], json!({ "id": 1, "name": "/lidar", "pid": null, "place": "robot2" }));
    assert_eq!(picture["nodes"][4], json!({ "id": 4, "name": null, "pid": pid, "place": null }));
    assert_eq!(edge(&picture, "subscription", "/viewer", "/image")["problem"], "QoS: reliability");
    assert_eq!(edge(&picture, "subscription", "/recorder", "/image")["problem"], Value::Null);
    assert_eq!(edge(&picture, "publisher", "/lidar", "/far")["rate_hz"], Value::Null);
    assert_eq!(edge(&picture, "server", "/camera", "/start")["qos"], Value::Null);
    edge(&picture, "client", "/viewer", "/start");
    let reason = "the offered reliability does not meet the requested one";
    let expected =
        json!([{ "topic": "/image", "publisher": "/camera", "subscription": "/viewer", "reason": reason }]);
    assert_eq!(picture["mismatches"], expected);

    // Parts of it.
    let part = parsed(&["--node", "viewer", "--rates", "0", "--json"]);
    assert_eq!(names(&part["nodes"]), ["/camera", "/recorder", "/viewer"]);
    assert_eq!((names(&part["topics"]), &part["seconds"]), (vec!["/image"], &Value::Null));
    let part = parsed(&["--topic", "rosout", "--rates", "0", "--json"]);
    assert_eq!((names(&part["nodes"]), names(&part["topics"])), (vec!["/camera"], vec!["/rosout"]));
    assert!(names(&parsed(&["--all", "--rates", "0", "--json"])["topics"]).contains(&"/rosout"));
    refused(&["--node", "/camra"], 1, "there is no node '/camra'; did you mean /camera?");
    refused(&["--topic", "imge"], 1, "there is no topic '/imge'; did you mean /image?");

    // In all formats, without colours where there is no terminal; in any place, whatever the environment says.
    let shown = text(&["--rates", "0"]);
    assert!(
        shown.contains(&format!("  publisher     (no node) pid {pid}  BEST_EFFORT, VOLATILE, KEEP_LAST 5\n")),
        "{shown}"
    );
    assert!(shown.contains("KEEP_LAST 7  QoS: reliability\n") && !shown.contains('\u{1b}'), "{shown}");
    let directory = scratch();
    for (name, begin) in [
        ("a.svg", "<svg "),
        ("a.dot", "digraph "),
        ("a.gv", "digraph "),
        ("a.mmd", "flowchart "),
        ("a.json", "{"),
        ("a.txt", "/far "),
    ] {
        let path = directory.join(name);
        assert!(text(&["--rates", "0", "-o", path.to_str().unwrap()]).is_empty());
        let written = std::fs::read_to_string(path).unwrap();
        assert!(written.starts_with(begin) && written.contains("/image"), "{name}: {written}");
    }
    let domain = DOMAIN.to_string();
    let elsewhere =
        command(&["--rates", "0", "--domain", &domain]).env("TAUT_DOMAIN", "229").output().unwrap();
    assert_eq!(String::from_utf8(elsewhere.stdout).unwrap(), shown);
    refused(&["-o", "a.png"], 2, "`a.png` does not say which format");
    refused(&["--json", "--format", "svg"], 2, "say one of them");
    refused(&["--rates", "0", "-o", "/nowhere/a.svg"], 2, "`/nowhere/a.svg` cannot be written");

    // Who has seen enough.
    let mut child =
        command(&["--rates", "50ms"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let ended = child.wait_with_output().unwrap();
    assert!(ended.status.success() && ended.stderr.is_empty(), "{ended:?}");

    bounds_are_shown(&directory);
    std::fs::remove_dir_all(directory).unwrap();
}

fn bounds_are_shown(directory: &Path) {
    let system = "[hosts.robot]\ncores = 1\n[nodes.recorder]\n[nodes.planner]\n[topics]\n\"/image\" = { period = \"10ms\" }\n\
                  \"/goal\" = { period = \"100ms\" }\n[callbacks]\nrecord = { node = \"recorder\", topic = \"/image\", wcet = \"1ms\" }\n\
                  plan = { node = \"planner\", topic = \"/goal\", wcet = \"5ms\" }\n";
    let path = directory.join("system.toml");
    std::fs::write(&path, system).unwrap();
    let path = path.to_str().unwrap();
    let output = taut(&["--system", path, "--rates", "0", "--json"]);
    let picture: Value = serde_json::from_slice(&output.stdout).unwrap();
    let bound = &edge(&picture, "subscription", "/recorder", "/image")["bound"];
    assert_eq!((&bound["callbacks"], &bound["met"]), (&json!(["record"]), &json!(true)), "{bound}");
    assert_eq!(edge(&picture, "subscription", "/viewer", "/image")["bound"], Value::Null);
    let errors = String::from_utf8(output.stderr).unwrap();
    let expected = "taut: node 'planner' of the system file does not run\n\
                    taut: topic '/goal', which triggers callback 'plan', does not exist\n";
    assert_eq!(errors, expected);

    // As `taut check` says it.
    std::fs::write(path, "[hosts.robot]\ncoers = 1\n").unwrap();
    for path in [path, "/nowhere.toml"] {
        let check = Command::new(env!("CARGO_BIN_EXE_taut")).args(["check", path]).output().unwrap();
        let words = String::from_utf8(check.stderr).unwrap();
        assert!(!words.is_empty());
        refused(&["--system", path], 2, &words);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What `taut node`, `taut service` and `taut topic info` print of nodes here and on other hosts.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::Checked;
use serde_json::{Value, json};
use std::process::{Command, Output};
use tautline_transport::{
    EndpointKind, Gid, Limits, NodeName, Origin, Participant, Qos, RemoteGraph, RemoteNode, ServiceEndpoint,
    ServiceKind, ServiceType, TopicEndpoint, TopicType,
};

const DOMAIN: u32 = 112;

fn taut(args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.args(args).env("TAUT_DOMAIN", DOMAIN.to_string()).checked()
}

fn text(args: &[&str]) -> String {
    let output = taut(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn parsed(args: &[&str]) -> Value {
    serde_json::from_str(&text(args)).unwrap()
}

#[test]
fn nodes_services_and_ends_of_topics_are_printed() {
    let participant = Participant::new(DOMAIN).unwrap();
    let node = participant.create_node("camera", "/robot").unwrap();
    let topic_type = TopicType::new("a_msgs/msg/Image").with_hash(format!("RIHS01_{:064x}", 1));
    let qos = Qos::keep_last(3).best_effort();
    let of_node = participant.for_node(&node);
    let publisher = of_node.create_raw_publisher("/image", &topic_type, qos, Limits::default()).unwrap();
    let hash = format!("RIHS01_{:064x}", 2);
    let service_type = |name: &'static str, hash: Option<&str>| {
        let request = TopicType { hash: hash.map(|hash| hash.to_owned().into()), ..TopicType::new(name) };
        ServiceType { response: request.clone(), request }
    };
    let server = |name: &str, service_type: &ServiceType| {
        of_node.create_raw_server(name, service_type, 10, Limits::default()).unwrap()
    };
    let _service = server("/robot/add", &service_type("a_msgs/srv/Add", Some(&hash)));
    let _action = server("/robot/turn/_action/send_goal", &service_type("a_msgs/action/Turn_SendGoal", None));
    let stop = service_type("a_msgs/srv/Stop", None);
    let _client = of_node.create_raw_client("/theirs/stop", &stop, Limits::default()).unwrap();

    // What a gateway would say.
    let there = |gid| Origin::here(Gid([gid; 16]), "robot2");
    let gateway = Participant::new(DOMAIN).unwrap();
    let theirs = NodeName { namespace: "/".into(), name: "viewer".into() };
    let subscription = TopicEndpoint {
        kind: EndpointKind::Subscription,
        topic: "/image".into(),
        topic_type,
        gid: Gid([0xab; 16]),
        qos: Qos::keep_last(5).transient_local(),
        node: Some(theirs.clone()),
        pid: None,
        is_remote: true,
        is_own: false,
        origin: there(1),
        teller: None,
    };
    let service = ServiceEndpoint {
        kind: ServiceKind::Server,
        name: "/theirs/stop".into(),
        type_name: "a_msgs/srv/Stop".into(),
        type_hash: None,
        gid: Gid([0xcd; 16]),
        node: Some(theirs.clone()),
        pid: None,
        is_remote: true,
        origin: there(2),
        teller: None,
    };
    let viewer = RemoteNode { name: theirs, enclave: "/secure/viewer".into(), origin: there(3) };
    let remote = RemoteGraph {
        nodes: vec![viewer],
        endpoints: vec![subscription],
        services: vec![service],
        ..RemoteGraph::default()
    };
    gateway.set_remote(&remote).unwrap();

    let pid = std::process::id();
    let nodes = parsed(&["node", "list", "--json"]);
    let expected = json!([
        {
            "name": "viewer", "namespace": "/", "enclave": "/secure/viewer", "pid": null, "remote": true,
            "place": "robot2",
        },
        {
            "name": "camera", "namespace": "/robot", "enclave": "/", "pid": pid, "remote": false,
            "place": null,
        },
    ]);
    assert_eq!(nodes, expected);
    let table = text(&["node", "list"]);
    let rows: Vec<Vec<&str>> = table.lines().skip(2).map(|line| line.split_whitespace().collect()).collect();
    assert_eq!(rows, [vec!["/viewer", "on", "robot2"], vec!["/robot/camera", &*pid.to_string()]]);

    let expected = format!(
        "/robot/camera (process {pid})\n  subscribers:\n  publishers:\n    /image: a_msgs/msg/Image\n  service servers:\n    \
         /robot/add: a_msgs/srv/Add\n  service clients:\n    /theirs/stop: a_msgs/srv/Stop\n  action servers:\n    \
         /robot/turn: a_msgs/action/Turn\n  action clients:\n"
    );
    assert_eq!(text(&["node", "info", "/robot/camera"]), expected);
    let viewer = text(&["node", "info", "viewer"]);
    assert!(viewer.starts_with("/viewer (on robot2, enclave /secure/viewer)\n"), "{viewer}");
    let viewer = parsed(&["node", "info", "viewer", "--json"]);
    assert_eq!(viewer["subscribers"], json!([{ "name": "/image", "type": "a_msgs/msg/Image" }]));
    assert_eq!(viewer["remote"], json!(true));
    let unknown = taut(&["node", "info", "camera"]);
    assert!(!unknown.status.success());
    assert!(String::from_utf8(unknown.stderr).unwrap().contains("there is no node '/camera'"));

    let services = parsed(&["service", "list", "--json"]);
    let expected = json!({
        "service": "/theirs/stop", "type": "a_msgs/srv/Stop", "hash": null,
        "servers": [{ "node": "/viewer", "remote": true, "place": "robot2" }],
        "clients": [{ "node": "/robot/camera", "remote": false, "place": null }],
    });
    assert_eq!((services.as_array().unwrap().len(), &services[2]), (3, &expected));
    assert_eq!(services[0]["hash"], json!(hash));
    let table = text(&["service", "list"]);
    let line = table.lines().find(|line| line.starts_with("/theirs/stop")).unwrap();
    assert_eq!(
        line.split_whitespace().collect::<Vec<_>>(),
        ["/theirs/stop", "a_msgs/srv/Stop", "here,robot2", "1", "1"]
    );

    let list = text(&["topic", "list"]);
    let line = list.lines().find(|line| line.starts_with("/image")).unwrap();
    assert_eq!(
        line.split_whitespace().collect::<Vec<_>>(),
        ["/image", "a_msgs/msg/Image", "here,robot2", "1", "1"]
    );
    let short = "Type: a_msgs/msg/Image\nPublisher count: 1\nSubscription count: 1, 1 elsewhere\n";
    assert_eq!(text(&["topic", "info", "image"]), short);
    let long = text(&["topic", "info", "/image", "-v"]);
    for part in [
        "Node name: camera",
        "Reliability: BEST_EFFORT",
        "KEEP_LAST (5)",
        "TRANSIENT_LOCAL",
        "abababab",
        "Liveliness: AUTOMATIC",
    ] {
        assert!(long.contains(part), "{part}: {long}");
    }
    let info = &parsed(&["topic", "info", "/image", "--json"])[0];
    assert_eq!(info["publishers"][0]["gid"], json!(format!("{:?}", publisher.gid())));
    assert_eq!(info["subscriptions"][0]["qos"]["durability"], json!("TRANSIENT_LOCAL"));
    assert!(!taut(&["topic", "info", "/nothing"]).status.success());

    // In any place, whatever the environment says.
    let domain = DOMAIN.to_string();
    for (verb, more) in [("node", "list"), ("service", "list"), ("topic", "list")] {
        let here = text(&[verb, more]);
        for arguments in [[verb, "--domain", &domain, more], [verb, more, "--domain", &domain]] {
            let mut taut = Command::new(env!("CARGO_BIN_EXE_taut"));
            let output = taut.args(arguments).env("TAUT_DOMAIN", "229").output().unwrap();
            assert_eq!(String::from_utf8(output.stdout).unwrap(), here, "{arguments:?}");
        }
    }
    assert!(!taut(&["topic", "list", "--domain", "233"]).status.success());

    // Two of one name: said, as in ROS 2.
    let _twin = participant.create_node("camera", "/robot").unwrap();
    let errors = String::from_utf8(taut(&["node", "list"]).stderr).unwrap();
    assert_eq!(errors, "taut: 2 nodes are called /robot/camera\n");
}

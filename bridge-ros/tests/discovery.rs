// SPDX-License-Identifier: MIT OR Apache-2.0
//! What discovery has to cope with: late joiners, topics with two types, other domains, names, several bridges, ends that
//! do not fit.

mod support;

use serde_json::{Value, json};
use std::collections::BTreeSet;
use support::{
    BridgeProcess, Peer, STRING, joined, matched, publish_texts, publisher, ros, scope, subscription,
    take_texts, text_body, wait_until,
};
use tautline_transport::{EndpointKind, Participant, Qos};

#[test]
fn late_joiners_get_what_is_kept() {
    let Some((_bridge, participant, mut peer)) = joined(30, "latched") else { return };
    let latched = json!({ "latched": true, "depth": 2 });
    let kept = Qos::keep_last(2).transient_local();

    // Published before anybody was there; two join one after the other.
    let here = publisher(&participant, "/to_ros", STRING, kept);
    publish_texts(&here, &["old", "one", "two"]);
    for _ in 0..2 {
        let there = peer.subscription("/to_ros", STRING, latched.clone());
        assert_eq!(peer.take_texts(there, 2), ["one", "two"]);
    }
    let there = peer.publisher("/from_ros", STRING, latched);
    peer.publish_text(there, &["old", "one", "two"]);
    for _ in 0..2 {
        let here = subscription(&participant, "/from_ros", STRING, kept);
        assert_eq!(take_texts(&here, 2), ["one", "two"]);
    }
    // Each publisher keeps its own, as those of /tf_static do.
    let first = peer.publisher("/tf_static", STRING, json!({ "latched": true, "depth": 1 }));
    let second = peer.publisher("/tf_static", STRING, json!({ "latched": true, "depth": 1 }));
    peer.publish_text(first, &["first"]);
    peer.publish_text(second, &["second"]);
    for _ in 0..2 {
        let here = subscription(&participant, "/tf_static", STRING, Qos::keep_last(100).transient_local());
        let got: BTreeSet<String> = take_texts(&here, 2).into_iter().collect();
        assert_eq!(got, ["first", "second"].map(String::from).into());
    }
}

#[test]
fn what_is_kept_stays_and_comes_once_though_ends_come_and_go() {
    let Some((bridge, participant, mut peer)) = joined(31, "latched") else { return };
    let latched = |depth: usize| json!({ "latched": true, "depth": depth });

    // To ROS: between two readers nobody listens, and the bridge takes nothing.
    let here = publisher(&participant, "/to_ros", STRING, Qos::keep_last(2).transient_local());
    publish_texts(&here, &["one", "two"]);
    let first = peer.subscription("/to_ros", STRING, latched(2));
    assert_eq!(peer.take_texts(first, 2), ["one", "two"]);
    peer.tell(json!({ "do": "destroy", "end": first }));
    wait_until("it rests", || bridge.topic("/to_ros", "to_ros")["active"] == false);
    let second = peer.subscription("/to_ros", STRING, latched(2));
    assert_eq!(peer.take_texts(second, 2), ["one", "two"]);
    wait_until("it goes on", || bridge.topic("/to_ros", "to_ros")["active"] == true);
    here.publish(&text_body("three")).unwrap();
    assert_eq!(peer.take_texts(second, 1), ["three"], "what is kept came again");

    // From ROS: publishers come while somebody listens, until they are too many for what was kept.
    let deep = Qos::keep_last(10).transient_local();
    let listening = subscription(&participant, "/tf_static", STRING, deep);
    let mut all = BTreeSet::new();
    for number in 0..6 {
        let text = format!("frame {number}");
        let there = peer.publisher("/tf_static", STRING, latched(1));
        peer.publish_text(there, &[&text]);
        all.insert(text.clone());
        wait_until("who listens has it", || {
            let mut texts = std::iter::from_fn(|| listening.try_take().unwrap());
            texts.any(|sample| support::text_of(sample.body()) == text)
        });
        let late = subscription(&participant, "/tf_static", STRING, deep);
        let got: BTreeSet<String> = take_texts(&late, all.len()).into_iter().collect();
        assert_eq!(got, all, "a late joiner after publisher {number}");
    }
}

#[test]
fn a_topic_with_two_types_in_ros() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 29;
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let participant = Participant::new(DOMAIN).unwrap();
    // A process has one type of a topic.
    let mut peer = Peer::start(&venv, DOMAIN, "two_types");
    let mut other = Peer::start(&venv, DOMAIN, "of_the_other_type");
    let wrong = other.publisher("/both", "std_msgs/msg/Int32", json!({}));
    let here = subscription(&participant, "/both", STRING, Qos::default());
    let said = bridge.wait_for("the mismatch", |stats| stats["not_bridged"]["/both"].is_string());
    let said = said["not_bridged"]["/both"].as_str().unwrap().to_owned();
    assert!(said.contains("std_msgs/msg/Int32") && said.contains(STRING), "{said}");
    let right = peer.publisher("/both", STRING, json!({}));
    peer.matched(right, 1);
    peer.publish_text(right, &["text"]);
    assert_eq!(take_texts(&here, 1), ["text"]);
    bridge.wait_for("no mismatch", |stats| stats["not_bridged"] == json!({}));
    // The other way, and the wrong one is still there.
    let here = publisher(&participant, "/both", STRING, Qos::default());
    let there = peer.subscription("/both", STRING, json!({}));
    matched(&here, 2);
    here.publish(&text_body("back")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["back"]);
    other.matched(wrong, 0);
    // Two types here, too: what is bridged stays so.
    let _other = publisher(&participant, "/both", "std_msgs/msg/Int32", Qos::default());
    bridge.wait_for("the second type", |stats| {
        stats["not_bridged"]["/both"].as_str().is_some_and(|said| said.contains("one type of a topic"))
    });
    here.publish(&text_body("still")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["still"]);
}

#[test]
fn ros_domain_id_is_honoured() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 8;
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN + 1, &[]);
    assert_eq!(bridge.stats()["ros_domain"], DOMAIN + 1);
    drop(bridge);
    // Without the option; Tautline's domain is said by another variable.
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_taut-bridge-ros"));
    command.args(["--no-rt", "--json"]).env("TAUT_DOMAIN", DOMAIN.to_string()).env("TAUT_SCOPE", scope());
    command.env("ROS_DOMAIN_ID", (DOMAIN + 1).to_string()).stdout(std::process::Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut lines = std::io::BufRead::lines(std::io::BufReader::new(child.stdout.take().unwrap()));
    let stats: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
    assert_eq!((&stats["domain"], &stats["ros_domain"]), (&json!(DOMAIN), &json!(DOMAIN + 1)));
    let participant = Participant::new(DOMAIN).unwrap();
    let here = publisher(&participant, "/x", STRING, Qos::default());
    let (mut other, mut same) = (Peer::start(&venv, DOMAIN, "other"), Peer::start(&venv, DOMAIN + 1, "same"));
    let nothing = other.subscription("/x", STRING, json!({}));
    let there = same.subscription("/x", STRING, json!({}));
    matched(&here, 1);
    same.matched(there, 1);
    here.publish(&text_body("there")).unwrap();
    assert_eq!(same.take_texts(there, 1), ["there"]);
    other.matched(nothing, 0);
    assert!(other.take(nothing, 0).is_empty());
    child.kill().unwrap();
    child.wait().unwrap();
}

#[test]
fn names_directions_and_rates_of_a_file() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 10;
    let file = tempfile::NamedTempFile::new().unwrap();
    let text = "
        [[topic]]
        topic = '/robot/**'
        ros_topic = '/r1/**'
        [[topic]]
        topic = '/out_only'
        direction = 'to_ros'
        [[topic]]
        topic = '/slow'
        max_rate_hz = 0.01
        [[topic]]
        topic = '/weak'
        qos = { reliability = 'best_effort', depth = 7 }
        [[topic]]
        topic = '/typed'
        type = 'std_msgs/msg/Int32'
    ";
    std::fs::write(file.path(), text).unwrap();
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &["--config", file.path().to_str().unwrap()]);
    let participant = Participant::new(DOMAIN).unwrap();
    let mut peer = Peer::start(&venv, DOMAIN, "file");

    let here = publisher(&participant, "/robot/a", STRING, Qos::default());
    let there = peer.subscription("/r1/a", STRING, json!({}));
    let back = (
        subscription(&participant, "/robot/b", STRING, Qos::default()),
        peer.publisher("/r1/b", STRING, json!({})),
    );
    matched(&here, 1);
    here.publish(&text_body("renamed")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["renamed"]);
    peer.matched(back.1, 1);
    peer.publish_text(back.1, &["renamed"]);
    assert_eq!(take_texts(&back.0, 1), ["renamed"]);

    let slow = publisher(&participant, "/slow", STRING, Qos::default());
    let there = peer.subscription("/slow", STRING, json!({}));
    matched(&slow, 1);
    publish_texts(&slow, &["first", "second", "third"]);
    assert_eq!(peer.take_texts(there, 1), ["first"]);
    wait_until("drops", || bridge.topic("/slow", "to_ros")["dropped"]["rate limit"] == 2);

    let _weak = publisher(&participant, "/weak", STRING, Qos::default());
    peer.tell(json!({ "do": "wait_topic", "topic": "/weak", "type": STRING }));
    let ends = peer.tell(json!({ "do": "endpoints", "topic": "/weak" }));
    assert_eq!(ends[0][0][1], "BEST_EFFORT", "{ends}");

    let _typed = publisher(&participant, "/typed", STRING, Qos::default());
    bridge.wait_for("the wrong type", |stats| {
        stats["not_bridged"]["/typed"].as_str().is_some_and(|said| said.contains("std_msgs/msg/Int32"))
    });
    // What is not in the file, or goes the other way only.
    let _one_way = subscription(&participant, "/out_only", STRING, Qos::default());
    let _other = subscription(&participant, "/other", STRING, Qos::default());
    let (one_way, other) =
        (peer.publisher("/out_only", STRING, json!({})), peer.publisher("/other", STRING, json!({})));
    // Later than these, and bridged.
    let _last = subscription(&participant, "/robot/last", STRING, Qos::default());
    let last = peer.publisher("/r1/last", STRING, json!({}));
    peer.matched(last, 1);
    peer.matched(one_way, 0);
    peer.matched(other, 0);
}

#[test]
fn ends_that_do_not_fit_are_told_as_ros_tells_them() {
    let Some((bridge, participant, mut peer)) = joined(11, "misfits") else { return };
    // Offered here, requested there.
    let _here = publisher(&participant, "/out", STRING, Qos::default().best_effort());
    let there = peer.subscription("/out", STRING, json!({}));
    let policy = peer.tell(json!({ "do": "incompatible_qos", "end": there }));
    assert!(policy.as_str().unwrap().contains("RELIABILITY"), "{policy}");
    bridge.wait_for("the event", |stats| stats["incompatible_qos"]["/out"]["last_policy"] == "reliability");
    wait_until("it is said", || bridge.said().contains("'/out'") && bridge.said().contains("reliability"));
    // Offered there, requested here: of two publishers the one that fits is heard.
    let here = subscription(&participant, "/in", STRING, Qos::default());
    let weak = peer.publisher("/in", STRING, json!({ "best_effort": true }));
    let strong = peer.publisher("/in", STRING, json!({}));
    // By the subscription for its class, and by the other one, which leaves it to that.
    peer.matched(strong, 2);
    wait_until("both are bridged", || {
        let topics = participant.topics().unwrap();
        let topic = topics.iter().find(|topic| topic.name == "/in");
        topic.is_some_and(|topic| topic.publishers.len() == 2)
    });
    peer.publish_text(weak, &["weak"]);
    peer.publish_text(strong, &["strong"]);
    assert_eq!(take_texts(&here, 1), ["strong"]);
    wait_until("both arrived", || bridge.topic("/in", "from_ros")["messages"] == 2);
    assert!(here.try_take().unwrap().is_none());
    // A subscription that asks for less hears both.
    let modest = subscription(&participant, "/in", STRING, Qos::default().best_effort());
    peer.publish_text(weak, &["weak"]);
    assert_eq!(take_texts(&modest, 1), ["weak"]);
}

#[test]
fn each_side_lists_the_other() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 12;
    let _bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let participant = Participant::new(DOMAIN).unwrap();
    let node = participant.create_node_in_enclave("driver", "/robot", "/ours").unwrap();
    let of_node = participant.for_node(&node);
    let _port = publisher(&of_node, "/lidar", "sensor_msgs/msg/PointCloud2", Qos::default().best_effort());
    let mut peer = Peer::start_as(&venv, DOMAIN, "lister", "ros_peer.py", |command| {
        command.args(["--ros-args", "--enclave", "/theirs"]);
    });
    peer.tell(json!({ "do": "wait_node", "name": "/robot/driver" }));
    peer.tell(json!({ "do": "wait_topic", "topic": "/lidar", "type": "sensor_msgs/msg/PointCloud2" }));
    let _there = peer.publisher("/theirs", STRING, json!({ "latched": true }));

    wait_until("ROS's node and topic are listed", || {
        let graph = participant.graph().unwrap();
        let node = graph.nodes.iter().find(|node| node.name.full_name() == "/lister");
        let end = graph.endpoints.iter().find(|end| end.topic == "/theirs");
        let Some((node, end)) = node.zip(end) else { return false };
        assert!(node.is_remote && node.pid.is_none() && node.enclave == "/theirs", "{node:?}");
        assert_eq!((end.kind, &*end.topic_type.name), (EndpointKind::Publisher, STRING));
        assert!(end.topic_type.hash.as_deref().is_some_and(|hash| hash.starts_with("RIHS01_df668c74")));
        assert_eq!(end.qos.durability, tautline_transport::Durability::TransientLocal);
        assert_eq!(end.node.as_ref().map(|node| &*node.name), Some("lister"));
        true
    });
    // What is there for the other side's sake is not listed on this one.
    let graph = participant.graph().unwrap();
    assert!(graph.nodes.iter().all(|node| !node.name.name.starts_with("taut_bridge_")), "{:?}", graph.nodes);
    assert_eq!(graph.nodes.iter().filter(|node| node.name.name == "driver").count(), 1);
    drop((_port, of_node, node));
    peer.tell(json!({ "do": "wait_node", "name": "/robot/driver", "there": false }));
}

#[test]
fn two_bridges_neither_loop_nor_double() {
    let Some(venv) = ros() else { return };
    // Two domains of Tautline, one of ROS. A second one for a pair of domains is refused.
    const DOMAINS: [u32; 2] = [13, 14];
    let bridges = [BridgeProcess::start(DOMAINS[0], 13, &[]), BridgeProcess::start(DOMAINS[1], 13, &[])];
    let refused = support::failure_of(&["--domain", "14", "--ros-domain", "13", "--no-rt"], |_| {});
    let pid = bridges[1].pid();
    assert!(
        refused.contains("has a bridge to ROS domain 13 already")
            && refused.contains(&format!("process {pid}")),
        "{refused}"
    );
    let participants = DOMAINS.map(|domain| Participant::new(domain).unwrap());
    let mut peer = Peer::start(&venv, 13, "between");
    // Kept: a writer may match a reader later than the reader says it has.
    let (kept, latched) = (Qos::default().transient_local(), json!({ "latched": true }));
    let publishers = participants.each_ref().map(|one| publisher(one, "/x", STRING, kept));
    let subscriptions = participants.each_ref().map(|one| subscription(one, "/x", STRING, kept));
    let out = peer.publisher("/x", STRING, latched.clone());
    let into = peer.subscription("/x", STRING, latched);
    // Those here, and the bridges.
    publishers.iter().for_each(|one| matched(one, 2));
    peer.matched(out, 3);
    peer.matched(into, 3);
    for (number, one) in publishers.iter().enumerate() {
        one.publish(&text_body(&format!("from {number}"))).unwrap();
    }
    peer.publish_text(out, &["from ros"]);
    let all = |texts: Vec<String>| texts.into_iter().collect::<BTreeSet<_>>();
    assert_eq!(all(peer.take_texts(into, 3)), ["from 0", "from 1", "from ros"].map(String::from).into());
    // The domains hear each other through ROS.
    for one in &subscriptions {
        assert_eq!(all(take_texts(one, 3)), ["from 0", "from 1", "from ros"].map(String::from).into());
    }
    // Had one of them come twice, it would be there before what is sent now.
    for one in &publishers {
        one.publish(&text_body("last")).unwrap();
    }
    assert_eq!(peer.take_texts(into, 2), ["last", "last"]);
    for one in &subscriptions {
        assert_eq!(take_texts(one, 2), ["last", "last"]);
    }
}

/// What one domain has reaches the other one through ROS, unless a bridge is told not to pass it on; what is each one's own goes to ROS
/// all the same.
#[test]
fn a_bridge_without_transit_passes_on_what_is_of_its_domain() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 71;
    const ROS: [u32; 2] = [71, 73];
    let _bridges = ROS.map(|of| BridgeProcess::start(DOMAIN, of, &["--no-transit"]));
    let participant = Participant::new(DOMAIN).unwrap();
    let [mut one, mut other] = ROS.map(|of| Peer::start(&venv, of, "peer"));
    let publisher = publisher(&participant, "/x", STRING, Qos::default());
    let (out, from_one) = (one.publisher("/x", STRING, json!({})), one.subscription("/x", STRING, json!({})));
    let from_other = other.subscription("/x", STRING, json!({}));
    let here = subscription(&participant, "/x", STRING, Qos::default());
    one.matched(from_one, 2);
    other.matched(from_other, 1);
    one.matched(out, 2);
    matched(&publisher, 3);
    one.publish_text(out, &["from one"]);
    assert_eq!(take_texts(&here, 1), ["from one"]);
    publisher.publish(&text_body("from here")).unwrap();
    assert_eq!(one.take_texts(from_one, 2), ["from one", "from here"]);
    assert_eq!(other.take_texts(from_other, 1), ["from here"], "nothing of the other ROS graph");
    assert_eq!(take_texts(&here, 1), ["from here"]);
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bridges and gateways together: ROS graphs and hosts reach each other through both, and nothing comes twice.

mod support;

use futures::StreamExt;
use futures::future::{join, join_all};
use serde_json::{Value, json};
use std::cell::RefCell;
use std::collections::BTreeSet;
use support::gateway::{GatewayProcess, link};
use support::node::{Spinning, fibonacci, serve_echo};
use support::{BridgeProcess, Peer, Program, STRING, publish_texts, ros, text_of, wait_until};
use tautline::rcl_interfaces::msg::{Parameter, ParameterValue};
use tautline::rcl_interfaces::srv::{GetParameters, SetParameters};
use tautline::test_msgs::action::Fibonacci;
use tautline::test_msgs::srv::BasicTypes;
use tautline::{GoalStatus, Qos};
use tautline_transport::{
    EndpointKind, Limits, Participant, RawPublisher, RawSubscription, TopicEndpoint, TopicType,
};

/// As ROS 2 has it: what has no hash crosses no network.
const STRING_HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
const BASIC_TYPES: &str = "test_msgs/srv/BasicTypes";
/// `rcl_interfaces/msg/ParameterType`.
const DOUBLE: u8 = 3;
/// More than is ever on its way.
const DEPTH: usize = 1000;
/// Published at once. What is on its way fits into every queue, of the network's links too.
const CHUNK: usize = 50;
const REQUESTS: i64 = 200;
/// As many at once as a server in ROS has room for.
const AT_ONCE: usize = 10;

fn string_type() -> TopicType {
    TopicType::new(STRING).with_hash(STRING_HASH)
}

/// Who publishes texts.
enum Talker<'p> {
    Here(Box<RawPublisher>),
    There(&'p RefCell<Peer>, u64),
}

impl<'p> Talker<'p> {
    fn here(participant: &Participant, topic: &str) -> Self {
        let (qos, limits) = (Qos::keep_last(DEPTH), Limits::default());
        let publisher = participant.create_raw_publisher(topic, &string_type(), qos, limits).unwrap();
        Talker::Here(Box::new(publisher))
    }

    fn there(peer: &'p RefCell<Peer>, topic: &str) -> Self {
        let end = peer.borrow_mut().publisher(topic, STRING, json!({ "depth": DEPTH }));
        Talker::There(peer, end)
    }

    fn publish(&self, texts: &[String]) {
        match self {
            Talker::Here(publisher) => publish_texts(publisher, texts),
            Talker::There(peer, end) => peer.borrow_mut().publish_text(*end, texts),
        }
    }
}

/// Who gets them.
enum Listener<'p> {
    Here(Box<RawSubscription>),
    There(&'p RefCell<Peer>, u64),
}

impl<'p> Listener<'p> {
    fn here(participant: &Participant, topic: &str) -> Self {
        let (qos, limits) = (Qos::keep_last(DEPTH), Limits::default());
        let subscription = participant.create_raw_subscription(topic, &string_type(), qos, limits).unwrap();
        Listener::Here(Box::new(subscription))
    }

    fn there(peer: &'p RefCell<Peer>, topic: &str) -> Self {
        let end = peer.borrow_mut().subscription(topic, STRING, json!({ "depth": DEPTH }));
        Listener::There(peer, end)
    }

    /// What has come.
    fn heard(&self) -> Vec<String> {
        match self {
            Listener::Here(subscription) => {
                let samples = std::iter::from_fn(|| subscription.try_take().unwrap());
                samples.map(|sample| text_of(sample.body())).collect()
            }
            Listener::There(peer, end) => peer.borrow_mut().take_texts(*end, 0),
        }
    }

    /// What has come, once that is so much.
    fn hear(&self, count: usize) -> Vec<String> {
        let mut heard = Vec::new();
        wait_until(&format!("{count} texts"), || {
            heard.extend(self.heard());
            heard.len() >= count
        });
        heard
    }
}

/// Publishes until each listener has heard each talker and `is_settled`, then waits for what is on its way. From then on nothing is
/// lost for want of a connection.
fn connect(talkers: &[Talker], listeners: &[Listener], is_settled: impl Fn() -> bool) {
    for (index, talker) in talkers.iter().enumerate() {
        let probe = [format!("probe {index}")];
        let mut silent: Vec<&Listener> = listeners.iter().collect();
        wait_until("a talker to be heard by all", || {
            talker.publish(&probe);
            silent.retain(|listener| !listener.heard().contains(&probe[0]));
            silent.is_empty()
        });
    }
    wait_until("the ways that are to stay", || {
        talkers.iter().for_each(|talker| talker.publish(&["probe".into()]));
        listeners.iter().for_each(|listener| drop(listener.heard()));
        is_settled()
    });
    flush(talkers, listeners, "the last probe");
}

/// Publishes a word of each talker's, and returns what the listeners have heard when all of these have come.
fn flush(talkers: &[Talker], listeners: &[Listener], word: &str) -> Vec<Vec<String>> {
    let words: Vec<String> = (0..talkers.len()).map(|index| format!("{word} {index}")).collect();
    for (talker, word) in talkers.iter().zip(&words) {
        talker.publish(std::slice::from_ref(word));
    }
    let hear = |listener: &Listener| {
        let (mut missing, mut all) = (BTreeSet::from_iter(&words), Vec::new());
        wait_until(&format!("'{word}' of {} talkers", words.len()), || {
            let heard = listener.heard();
            missing.retain(|word| !heard.contains(word));
            all.extend(heard);
            missing.is_empty()
        });
        all
    };
    listeners.iter().map(hear).collect()
}

/// Each listener gets so many texts of each talker, each of them once and in order, and nothing else.
fn exchange(talkers: &[Talker], listeners: &[Listener], count: usize) {
    let mut heard = vec![Vec::new(); listeners.len()];
    for first in (0..count).step_by(CHUNK) {
        let numbers = first..count.min(first + CHUNK);
        for (index, talker) in talkers.iter().enumerate() {
            let texts: Vec<String> = numbers.clone().map(|number| format!("{index}: {number}")).collect();
            talker.publish(&texts);
        }
        for (listener, heard) in listeners.iter().zip(&mut heard) {
            heard.extend(listener.hear(talkers.len() * numbers.len()));
        }
    }
    // Had one of them come twice, it would be there before what is sent now.
    let rest = flush(talkers, listeners, "last");
    for (number, (mut heard, rest)) in heard.into_iter().zip(rest).enumerate() {
        heard.extend(rest);
        for index in 0..talkers.len() {
            let of_talker = |text: &&String| text.starts_with(&format!("{index}: "));
            let expected = (0..count).map(|number| format!("{index}: {number}"));
            let own: Vec<&String> = heard.iter().filter(of_talker).collect();
            assert!(own.iter().copied().eq(&expected.collect::<Vec<_>>()), "listener {number}: {own:?}");
        }
        assert_eq!(heard.len(), talkers.len() * (count + 1), "listener {number}: {heard:?}");
    }
    // Nor has one of these.
    for heard in flush(talkers, listeners, "very last") {
        assert_eq!(heard.len(), talkers.len(), "{heard:?}");
    }
}

/// How many ends of a topic are listed in a domain that are such.
fn ends(participant: &Participant, topic: &str, is_it: impl Fn(&TopicEndpoint) -> bool) -> usize {
    let graph = participant.graph().unwrap();
    graph.endpoints.iter().filter(|end| end.topic == topic && is_it(end)).count()
}

fn is_of(end: &TopicEndpoint, kind: EndpointKind, node: &str) -> bool {
    end.kind == kind && end.is_remote && end.node.as_ref().is_some_and(|name| name.full_name() == node)
}

fn has_remote_node(participant: &Participant, name: &str) -> bool {
    let graph = participant.graph().unwrap();
    graph.nodes.iter().any(|node| node.is_remote && node.name.full_name() == name)
}

#[test]
fn a_ros_graph_is_reached_from_another_host() {
    let Some(venv) = ros() else { return };
    const A: u32 = 34;
    const B: u32 = 35;
    let Some(_gateways) = link(A, B) else { return };
    let _bridge = BridgeProcess::start(A, A, &[]);
    let participant = Participant::new(B).unwrap();
    let peer = RefCell::new(Peer::start(&venv, A, "in_ros"));

    let talkers = [Talker::there(&peer, "/from_ros")];
    wait_until("ROS's topic and node to be listed on the other host", || {
        ends(&participant, "/from_ros", |end| is_of(end, EndpointKind::Publisher, "/in_ros")) == 1
            && has_remote_node(&participant, "/in_ros")
    });
    let listeners = [Listener::here(&participant, "/from_ros")];
    connect(&talkers, &listeners, || true);
    exchange(&talkers, &listeners, 200);

    let listeners = [Listener::there(&peer, "/to_ros")];
    wait_until("ROS's subscription to be listed on the other host", || {
        ends(&participant, "/to_ros", |end| is_of(end, EndpointKind::Subscription, "/in_ros")) == 1
    });
    let talkers = [Talker::here(&participant, "/to_ros")];
    connect(&talkers, &listeners, || true);
    exchange(&talkers, &listeners, 200);
}

#[test]
fn two_ros_graphs_are_one_across_hosts() {
    let Some(venv) = ros() else { return };
    const A: u32 = 36;
    const B: u32 = 37;
    let Some(_gateways) = link(A, B) else { return };
    let _bridges = [A, B].map(|domain| BridgeProcess::start(domain, domain, &[]));
    let left = RefCell::new(Peer::start(&venv, A, "left"));
    let right = RefCell::new(Peer::start(&venv, B, "right"));
    // Each of these topics one way, then one both ways.
    for (from, to, topic) in [(&left, &right, "/to_the_right"), (&right, &left, "/to_the_left")] {
        let (talkers, listeners) = ([Talker::there(from, topic)], [Listener::there(to, topic)]);
        connect(&talkers, &listeners, || true);
        exchange(&talkers, &listeners, 1000);
    }
    let peers = [&left, &right];
    let talkers = peers.map(|peer| Talker::there(peer, "/both"));
    let listeners = peers.map(|peer| Listener::there(peer, "/both"));
    connect(&talkers, &listeners, || true);
    exchange(&talkers, &listeners, 1000);
}

#[test]
fn a_ring_of_bridges_and_gateways_neither_loops_nor_doubles() {
    let Some(venv) = ros() else { return };
    const A: u32 = 39;
    const B: u32 = 42;
    const R: u32 = A;
    let Some(gateways) = link(A, B) else { return };
    let bridges = [A, B].map(|domain| BridgeProcess::start(domain, R, &[]));
    let participants = [A, B].map(|domain| Participant::new(domain).unwrap());
    let peer = RefCell::new(Peer::start(&venv, R, "in_ros"));
    let [in_a, in_b] = &participants;
    let talkers = [Talker::here(in_a, "/ring"), Talker::here(in_b, "/ring"), Talker::there(&peer, "/ring")];
    let listeners =
        [Listener::here(in_a, "/ring"), Listener::here(in_b, "/ring"), Listener::there(&peer, "/ring")];
    // Those here, on the other host and in ROS, each once though there are two ways to each.
    let is_listed = |participant: &Participant| {
        let mut kinds = [EndpointKind::Publisher, EndpointKind::Subscription].into_iter();
        kinds.all(|kind| ends(participant, "/ring", |end| end.kind == kind) == 3)
    };
    wait_until("all ends to be listed", || participants.iter().all(is_listed));
    // From host to host without a detour through ROS, and from ROS to each host by its own bridge.
    let has_passed = |program: &Program, direction: &str, what: &str| {
        program.topic("/ring", direction)[what].as_u64().is_some_and(|count| count > 0)
    };
    connect(&talkers, &listeners, || {
        gateways.iter().all(|gateway| has_passed(gateway, "in", "messages"))
            && bridges.iter().all(|bridge| has_passed(bridge, "from_ros", "messages"))
            && bridges.iter().all(|bridge| has_passed(bridge, "to_ros", "messages"))
            && participants.iter().all(is_listed)
    });
    exchange(&talkers, &listeners, 1000);
    assert!(participants.iter().all(is_listed));

    // One way ends without a word: the other one serves, until the first one is back.
    let [first, second] = gateways;
    let count = |gateway: &Program| gateway.topic("/ring", "in")["messages"].as_u64().unwrap_or(0);
    let first = first.again(true, || {
        connect(&talkers, &listeners, || second.stats()["links"] == 0 && participants.iter().all(is_listed));
        exchange(&talkers, &listeners, 500);
    });
    let before = count(&second);
    let is_back = || count(&first) > 0 && count(&second) > before && participants.iter().all(is_listed);
    connect(&talkers, &listeners, is_back);
    exchange(&talkers, &listeners, 500);
}

/// Anybody in ROS can write what bridges tell each other.
#[test]
fn what_is_no_table_of_a_bridge_harms_nobody() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 73;
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let participant = Participant::new(DOMAIN).unwrap();
    let peer = RefCell::new(Peer::start(&venv, DOMAIN, "enemy"));
    // None takes the place of one that the bridge has not read yet.
    let qos = json!({ "depth": 10, "latched": true });
    let table = peer.borrow_mut().publisher("/_tautline/ends", STRING, qos);
    let end = |topic: &str, depth: u64, origin: Value| {
        json!({
            "node": 0, "kind": "sub", "topic": topic, "type": STRING, "hash": STRING_HASH, "gid": "07".repeat(16),
            "qos": { "depth": depth }, "origin": origin,
        })
    };
    let of = |ends: Vec<Value>| {
        let nodes = [json!({ "namespace": "/", "name": "n" })];
        json!({ "bridge": 1, "graph": { "nodes": nodes, "ends": ends } }).to_string()
    };
    let (origin, far) = (json!({ "tag": 7 }), json!({ "tag": 7, "path": vec![1; 9] }));
    for text in [
        "no table".to_owned(),
        "[".repeat(100_000),
        of(vec![end("no name", 7, origin.clone()), end("/x\u{7}", 7, origin.clone())]),
        of(vec![end("/told", 7, far), end("/told", u64::MAX, origin.clone())]),
        of(vec![end("/told", 8, origin.clone()); 20_000]),
        of(vec![end("/told", 7, origin)]),
    ] {
        peer.borrow_mut().publish_text(table, &[text]);
    }
    // What can be is believed, and nothing else is told.
    wait_until("the last table to be read", || {
        ends(&participant, "/told", |end| end.is_remote && end.qos.depth == 7) == 1
    });
    let graph = participant.graph().unwrap();
    assert!(
        graph.endpoints.iter().all(|end| ["/told", "/rosout", "/parameter_events"].contains(&&*end.topic))
    );
    let (talkers, listeners) = ([Talker::there(&peer, "/x")], [Listener::here(&participant, "/x")]);
    connect(&talkers, &listeners, || true);
    exchange(&talkers, &listeners, 100);
    let (talkers, listeners) = ([Talker::here(&participant, "/y")], [Listener::there(&peer, "/y")]);
    connect(&talkers, &listeners, || true);
    exchange(&talkers, &listeners, 100);
    assert!(bridge.said().contains("is not understood"), "{}", bridge.said());
}

/// The gateways and the bridge between two nodes.
type Between = ([GatewayProcess; 2], BridgeProcess);

/// A node of Tautline's, and on another host a ROS graph with a node of rclpy that has services.
fn far_nodes(there: u32, here: u32) -> Option<(Between, Spinning, Peer)> {
    let (venv, gateways) = (ros()?, link(there, here)?);
    let bridge = BridgeProcess::start(there, there, &[]);
    let here = Spinning::new(here, "here");
    Some(((gateways, bridge), here, Peer::start_with_services(&venv, there, "there")))
}

fn request(number: i64) -> BasicTypes::Request {
    let string_value = format!("request {number}");
    BasicTypes::Request { int64_value: number, string_value, ..Default::default() }
}

#[test]
fn services_cross_bridges_and_gateways() {
    let Some(((_gateways, bridge), mut here, mut peer)) = far_nodes(45, 57) else { return };

    // The other host asks ROS.
    peer.tell(json!({ "do": "service", "name": "/there/echo", "type": BASIC_TYPES, "behaviour": "echo" }));
    let client = here.node.create_client::<BasicTypes::Service>("/there/echo").unwrap();
    here.available(&client);
    let numbers: Vec<i64> = (0..REQUESTS).collect();
    for numbers in numbers.chunks(AT_ONCE) {
        let pending: Vec<_> =
            numbers.iter().map(|number| client.request(&request(*number)).unwrap()).collect();
        let answers = here.wait("answers", join_all(pending));
        for (number, answer) in numbers.iter().zip(answers) {
            let answer = answer.unwrap();
            assert_eq!((answer.int64_value, answer.string_value), (*number, format!("request {number}")));
        }
    }

    // ROS asks the other host.
    let _served = serve_echo(&mut here.node, "/here/echo");
    let client = peer.tell(json!({ "do": "client", "name": "/here/echo", "type": BASIC_TYPES }));
    for numbers in numbers.chunks(AT_ONCE) {
        let text = |number: &i64| format!("request {number}");
        let ask = |number: &i64| json!({ "int64_value": number, "string_value": text(number) });
        let requests: Vec<Value> = numbers.iter().map(ask).collect();
        let answers = peer.tell(json!({ "do": "call", "end": client, "requests": requests }));
        let answers = answers.as_array().unwrap();
        assert_eq!(answers.len(), numbers.len());
        for (request, answer) in requests.iter().zip(answers) {
            for field in ["int64_value", "string_value"] {
                assert_eq!(answer[field], request[field]);
            }
        }
    }
    for service in ["/there/echo", "/here/echo"] {
        wait_until("all answers are counted", || bridge.service(service)["answered"] == REQUESTS);
        assert_eq!(bridge.service(service)["failed"], json!({}), "{service}");
    }
}

#[test]
fn goals_from_another_host_are_pursued_in_ros() {
    let Some((_between, mut here, mut peer)) = far_nodes(60, 68) else { return };
    peer.tell(json!({ "do": "action_server", "name": "/fibonacci" }));
    let client = here.node.create_action_client::<Fibonacci::Action>("/fibonacci").unwrap();
    here.wait("a server", client.wait_for_action_server().unwrap()).unwrap();
    // Nobody waits for the feedback's publisher: the first of it may be over before all on the way know who listens.
    for (order, is_first) in [(60_usize, true), (10, false)] {
        let goal = Fibonacci::Goal { order: i32::try_from(order).unwrap() };
        let sent = client.send_goal_request(goal).unwrap();
        let (goal, result, feedback) = here.wait("a goal", sent).unwrap();
        let told = feedback.map(|feedback| feedback.sequence).collect::<Vec<_>>();
        let (result, told) = here.wait("a result", join(result, told));
        let (status, result) = result.unwrap();
        assert_eq!((status, result.sequence), (GoalStatus::Succeeded, fibonacci(order)));
        assert_eq!(goal.status(), GoalStatus::Succeeded);
        let expected: Vec<_> = (2..=order).map(|len| fibonacci(len - 1)).collect();
        if is_first {
            assert!(!told.is_empty() && expected.ends_with(&told), "{told:?}");
        } else {
            assert_eq!(told, expected);
        }
    }
}

#[test]
fn parameters_of_a_node_in_ros_are_got_and_set_from_another_host() {
    let Some((_between, mut here, mut peer)) = far_nodes(69, 70) else { return };
    peer.tell(json!({ "do": "serve_parameters", "values": { "gain": 1.5 } }));
    let get = here.node.create_client::<GetParameters::Service>("/there/get_parameters").unwrap();
    let set = here.node.create_client::<SetParameters::Service>("/there/set_parameters").unwrap();
    here.available(&get);
    here.available(&set);
    let gain = |here: &mut Spinning| {
        let asked = get.request(&GetParameters::Request { names: vec!["gain".into()] }).unwrap();
        let values = here.wait("a value", asked).unwrap().values;
        values.iter().map(|value| (value.type_, value.double_value)).collect::<Vec<_>>()
    };
    assert_eq!(gain(&mut here), [(DOUBLE, 1.5)]);
    let value = ParameterValue { type_: DOUBLE, double_value: 2.5, ..Default::default() };
    let parameters = vec![Parameter { name: "gain".into(), value }];
    let asked = set.request(&SetParameters::Request { parameters }).unwrap();
    let results = here.wait("a result", asked).unwrap().results;
    assert!(results.len() == 1 && results[0].successful, "{results:?}");
    assert_eq!(gain(&mut here), [(DOUBLE, 2.5)]);
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services both ways, with rclpy on the other side: answers, order, many at once, ends that die.

mod support;

use futures::future::join_all;
use futures::{FutureExt, StreamExt};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use serde_json::{Value, json};
use std::time::Duration;
use support::node::{Spinning, serve_echo};
use support::{BridgeProcess, Peer, joined_nodes, recovers, ros, wait_until};
use tautline::std_srvs::srv::SetBool;
use tautline::test_msgs::srv::BasicTypes;
use tautline::{CallbackOptions, Node, Qos, ServiceError};
use tautline_transport::{Limits, Participant, ServiceType};

const SET_BOOL: &str = "std_srvs/srv/SetBool";
const BASIC_TYPES: &str = "test_msgs/srv/BasicTypes";

/// Answers on a thread of its own.
fn serve_set_bool(node: &mut Node, name: &str) -> tautline::CallbackHandle {
    let requests = node.create_service::<SetBool::Service>(name, Qos::default()).unwrap().owned();
    let answer = requests.for_each(|request| async move {
        let success = request.message.data;
        let message = if success { "on" } else { "off" }.to_owned();
        // Ignored: who asked may have gone.
        let _ = request.respond(SetBool::Response { success, message });
    });
    node.spawn_callback(CallbackOptions::other(), answer).unwrap()
}

fn random(rng: &mut StdRng) -> BasicTypes::Request {
    BasicTypes::Request {
        bool_value: rng.random(),
        byte_value: rng.random(),
        char_value: rng.random(),
        float32_value: finite(|| f32::from_bits(rng.random()).into()) as f32,
        float64_value: finite(|| f64::from_bits(rng.random())),
        int8_value: rng.random(),
        uint8_value: rng.random(),
        int16_value: rng.random(),
        uint16_value: rng.random(),
        int32_value: rng.random(),
        uint32_value: rng.random(),
        int64_value: rng.random(),
        uint64_value: rng.random(),
        string_value: random_text(rng),
    }
}

/// JSON has no others.
fn finite(mut random: impl FnMut() -> f64) -> f64 {
    std::iter::repeat_with(&mut random).find(|value| value.is_finite()).expect("most are")
}

/// Of one to four bytes a character, with what JSON must escape; empty ones too.
fn random_text(rng: &mut StdRng) -> String {
    let characters: Vec<char> = "abcXYZ019 _-'\"\\{}[]\n\tßéλ中ハ😀𝄞".chars().collect();
    (0..rng.random_range(0..50)).map(|_| characters[rng.random_range(0..characters.len())]).collect()
}

/// What rclpy has must be what was sent, to the bit.
fn assert_echoed(sent: &BasicTypes::Request, echoed: &Value, seed: u64) {
    assert_eq!(serde_json::to_value(sent).unwrap(), *echoed, "seed {seed}");
}

/// As many at once as a client in ROS has room for.
fn call(peer: &mut Peer, client: u64, requests: &[Value]) -> Vec<Value> {
    let answers = requests.chunks(10).map(|requests| {
        peer.tell(json!({ "do": "call", "end": client, "requests": requests })).as_array().cloned().unwrap()
    });
    answers.flatten().collect()
}

#[test]
fn requests_are_answered_both_ways() {
    const SEED: u64 = 7;
    let Some((bridge, mut here, mut peer)) = joined_nodes(15) else { return };
    let mut rng = StdRng::seed_from_u64(SEED);

    // ROS asks.
    let _one = serve_set_bool(&mut here.node, "/here/set");
    let _other = serve_echo(&mut here.node, "/here/echo");
    let set = peer.tell(json!({ "do": "client", "name": "/here/set", "type": SET_BOOL })).as_u64().unwrap();
    let echo =
        peer.tell(json!({ "do": "client", "name": "/here/echo", "type": BASIC_TYPES })).as_u64().unwrap();
    let requests: Vec<bool> = (0..50).map(|index| index % 3 == 0).collect();
    let sent: Vec<Value> = requests.iter().map(|data| json!({ "data": data })).collect();
    let answers = call(&mut peer, set, &sent);
    let expected: Vec<Value> = requests
        .iter()
        .map(|data| json!({ "success": data, "message": if *data { "on" } else { "off" } }))
        .collect();
    assert_eq!(answers, expected);
    let sent: Vec<_> = (0..50).map(|_| random(&mut rng)).collect();
    let requests: Vec<Value> = sent.iter().map(|request| serde_json::to_value(request).unwrap()).collect();
    let answers = call(&mut peer, echo, &requests);
    for (sent, echoed) in sent.iter().zip(&answers) {
        assert_echoed(sent, echoed, SEED);
    }
    // Of the node that serves it, as ROS sees it.
    wait_until("ROS to know whose service it is", || {
        let services = peer.ask(json!({ "do": "services_of", "node": "here" }));
        services.is_ok_and(|services| services.as_array().unwrap().contains(&json!("/here/set")))
    });

    // Tautline asks.
    peer.tell(json!({ "do": "service", "name": "/there/set", "type": SET_BOOL, "behaviour": "set_bool" }));
    peer.tell(json!({ "do": "service", "name": "/there/echo", "type": BASIC_TYPES, "behaviour": "echo" }));
    let set = here.node.create_client::<SetBool::Service>("/there/set").unwrap();
    here.available(&set);
    let pending: Vec<_> =
        (0..50).map(|index| set.request(&SetBool::Request { data: index % 3 == 0 }).unwrap()).collect();
    let answers = here.wait("answers", join_all(pending));
    let answers: Vec<bool> = answers.into_iter().map(|answer| answer.unwrap().success).collect();
    assert!(answers.into_iter().eq((0..50).map(|index| index % 3 == 0)));
    let echo = here.node.create_client::<BasicTypes::Service>("/there/echo").unwrap();
    here.available(&echo);
    for _ in 0..50 {
        let request = random(&mut rng);
        let answer = echo.request(&request).unwrap();
        let answer = here.wait("an answer", answer).unwrap();
        assert_echoed(&request, &serde_json::to_value(&answer).unwrap(), SEED);
    }

    let stats = bridge.wait_for("numbers of four services", |stats| {
        let all = stats["services"].as_array();
        all.is_some_and(|all| all.iter().filter(|service| service["answered"] == 50).count() == 4)
    });
    for service in ["/here/set", "/there/echo"] {
        let numbers = bridge.service(service);
        assert_eq!((&numbers["failed"], &numbers["active"]), (&json!({}), &json!(true)), "{stats}");
    }
    assert_eq!(bridge.service("/here/set")["direction"], "to_ros");
    assert_eq!(bridge.service("/there/set")["direction"], "from_ros");
}

#[test]
fn a_server_that_dies_ends_what_it_was_asked() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 17;
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let mut here = Spinning::new(DOMAIN, "here");

    // In ROS: the client here gets an error, and an answer from the next one.
    let mut server = Peer::start_with_services(&venv, DOMAIN, "server");
    server.tell(json!({ "do": "service", "name": "/set", "type": SET_BOOL, "behaviour": "silent" }));
    let client = here.node.create_client::<SetBool::Service>("/set").unwrap();
    here.available(&client);
    // More than are sent to a server in ROS at once.
    let pending: Vec<_> =
        (0..20).map(|_| client.request(&SetBool::Request { data: true }).unwrap()).collect();
    server.kill();
    for outcome in here.wait("errors", join_all(pending)) {
        let error = outcome.unwrap_err();
        assert!(matches!(error, tautline::Error::Service(ServiceError::ServerGone { .. })), "{error}");
    }
    let all = json!({ "its server has gone": 20 });
    bridge.wait_for("all are counted", |stats| stats["services"][0]["failed"] == all);
    let mut server = Peer::start_with_services(&venv, DOMAIN, "server");
    server.tell(json!({ "do": "service", "name": "/set", "type": SET_BOOL, "behaviour": "set_bool" }));
    here.available(&client);
    let answer = client.request(&SetBool::Request { data: true }).unwrap();
    assert_eq!(here.wait("an answer", answer).unwrap().message, "on");

    // Here: the service goes from ROS, what it was asked stays unanswered there, and the next one answers.
    let requests = here.node.create_service::<SetBool::Service>("/here", Qos::default()).unwrap().owned();
    let asking = server.tell(json!({ "do": "client", "name": "/here", "type": SET_BOOL }));
    server.tell(json!({ "do": "available", "end": asking }));
    server.tell(json!({ "do": "ask", "end": asking, "request": { "data": true } }));
    drop(requests);
    server.tell(json!({ "do": "available", "end": asking, "is_so": false }));
    assert_eq!(server.tell(json!({ "do": "answered" })), false);
    wait_until("it is counted", || bridge.service("/here")["failed"] != json!({}));
    let _served = serve_set_bool(&mut here.node, "/here");
    let answers = server.tell(json!({ "do": "call", "end": asking, "requests": [{ "data": false }] }));
    assert_eq!(answers[0]["message"], "off");
}

#[test]
fn a_silent_server_is_asked_no_more_than_there_is_room_for() {
    let Some((bridge, mut here, mut peer)) = joined_nodes(26) else { return };

    // Here: what waits is counted once it is refused, and when the server goes.
    let silent = here.node.create_service::<SetBool::Service>("/silent", Qos::default()).unwrap().owned();
    let _served = serve_set_bool(&mut here.node, "/set");
    let flooding = peer.tell(json!({ "do": "client", "name": "/silent", "type": SET_BOOL }));
    let other = peer.tell(json!({ "do": "client", "name": "/set", "type": SET_BOOL }));
    let request = json!({ "data": true });
    peer.tell(json!({ "do": "flood", "end": flooding, "request": request, "count": 1500 }));
    let full = "too many requests wait for the server here";
    wait_until("some are refused", || bridge.service("/silent")["failed"][full].as_u64().unwrap_or(0) > 0);
    let answers = peer.tell(json!({ "do": "call", "end": other, "requests": [request] }));
    assert_eq!(answers[0]["success"], true, "the others go on");
    drop(silent);
    // Those that wait in the bridge, and those that the server had.
    wait_until("the rest has failed", || {
        let failed = bridge.service("/silent")["failed"].as_object().cloned().unwrap_or_default();
        let others = failed.iter().filter(|(reason, _)| *reason != full);
        others.filter_map(|(_, count)| count.as_u64()).sum::<u64>() >= 1024
    });

    // In ROS: a client has as many requests as it can have, and an error of the next.
    peer.tell(json!({ "do": "service", "name": "/there", "type": SET_BOOL, "behaviour": "silent" }));
    let client = here.node.create_client::<SetBool::Service>("/there").unwrap();
    here.available(&client);
    let ask = || client.request(&SetBool::Request { data: true });
    let pending: Vec<_> = (0..tautline::MAX_PENDING_REQUESTS).map(|_| ask().unwrap()).collect();
    let error = ask().unwrap_err();
    assert!(matches!(error, tautline::Error::Service(ServiceError::TooManyPending { .. })), "{error}");
    bridge.kill();
    let ends = here.wait("errors", join_all(pending));
    assert!(ends.iter().all(Result::is_err));
}

#[test]
fn what_cannot_be_passed_on_ends_alone() {
    const DOMAIN: u32 = 28;
    let Some((bridge, mut here, mut peer)) = joined_nodes(DOMAIN) else { return };
    peer.tell(json!({ "do": "service", "name": "/there", "type": SET_BOOL, "behaviour": "silent" }));
    let client = here.node.create_client::<SetBool::Service>("/there").unwrap();
    here.available(&client);
    let mut waiting = client.request(&SetBool::Request { data: true }).unwrap();
    let participant = Participant::new(DOMAIN).unwrap();
    let service_type = ServiceType::of::<SetBool::Service>();
    let raw = participant.create_raw_client("/there", &service_type, Limits::default()).unwrap();
    // Cut off.
    let mut refused = raw.send(raw.loan(0).unwrap()).unwrap();
    let mut outcome = None;
    wait_until("an error", || {
        outcome = (&mut refused).now_or_never();
        outcome.is_some()
    });
    assert!(matches!(outcome, Some(Err(ServiceError::ServerGone { .. }))));
    let failed = || bridge.service("/there")["failed"].as_object().cloned().unwrap_or_default();
    wait_until("it is counted", || !failed().is_empty());
    let failed = failed();
    assert_eq!(failed.values().collect::<Vec<_>>(), [&json!(1)], "{failed:?}");
    assert!((&mut waiting).now_or_never().is_none(), "the other one goes on");
}

#[test]
fn a_bridge_that_dies_ends_what_it_was_asked_and_the_next_one_goes_on() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 18;
    let mut bridge = Some(BridgeProcess::start(DOMAIN, DOMAIN, &[]));
    let mut here = Spinning::new(DOMAIN, "here");
    let _served = serve_set_bool(&mut here.node, "/here");
    let mut peer = Peer::start_with_services(&venv, DOMAIN, "there");
    peer.tell(json!({ "do": "service", "name": "/silent", "type": SET_BOOL, "behaviour": "silent" }));
    peer.tell(json!({ "do": "service", "name": "/set", "type": SET_BOOL, "behaviour": "set_bool" }));
    let [silent, set] =
        ["/silent", "/set"].map(|name| here.node.create_client::<SetBool::Service>(name).unwrap());
    here.available(&silent);
    here.available(&set);
    let asking = peer.tell(json!({ "do": "client", "name": "/here", "type": SET_BOOL }));
    peer.tell(json!({ "do": "call", "end": asking, "requests": [{ "data": false }] }));

    recovers("services of a bridge that was killed and restarted", || {
        let pending = silent.request(&SetBool::Request { data: true }).unwrap();
        if let Some(bridge) = bridge.take() {
            bridge.kill();
        }
        assert!(here.wait("an error", pending).is_err());
        bridge = Some(BridgeProcess::start(DOMAIN, DOMAIN, &[]));
        here.available(&set);
        let answer = set.request(&SetBool::Request { data: false }).unwrap();
        assert_eq!(here.wait("an answer", answer).unwrap().message, "off");
        // What rclpy still knows of the bridge before does not answer; the one that answers is asked again.
        wait_until("the next bridge to answer", || {
            peer.tell(json!({ "do": "ask", "end": asking, "request": { "data": true } }));
            std::thread::sleep(Duration::from_millis(200));
            peer.tell(json!({ "do": "answered" })) == true
        });
        here.available(&silent);
    });
}

#[test]
fn what_is_wrong_with_a_service_is_said_and_the_others_go_on() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 19;
    let config = tempfile::NamedTempFile::new().unwrap();
    let text = "[[service]]\nservice = \"/a\"\nros_service = \"/b\"\ntype = \"std_srvs/srv/SetBool\"\n\
                [[service]]\nservice = \"/wrong\"\ntype = \"std_srvs/srv/Trigger\"\n\
                [[service]]\nservice = \"/twice\"\n[[service]]\nservice = \"/unknown\"\n";
    std::fs::write(config.path(), text).unwrap();
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &["--config", config.path().to_str().unwrap()]);
    let mut here = Spinning::new(DOMAIN, "here");
    let mut peer = Peer::start_with_services(&venv, DOMAIN, "there");
    peer.tell(json!({ "do": "service", "name": "/twice", "type": SET_BOOL, "behaviour": "set_bool" }));
    wait_until("ROS's service is seen", || {
        here.node.get_service_names_and_types().unwrap().contains_key("/twice")
    });
    let _all = ["/a", "/wrong", "/twice", "/unspoken"].map(|name| serve_set_bool(&mut here.node, name));
    // Of a package that ROS does not have.
    let participant = Participant::new(DOMAIN).unwrap();
    let unknown = ServiceType::new("no_such_srvs/srv/A", None);
    let _unknown = participant.create_raw_server("/unknown", &unknown, 1, Limits::default()).unwrap();

    let asking = peer.tell(json!({ "do": "client", "name": "/b", "type": SET_BOOL }));
    let answers = peer.tell(json!({ "do": "call", "end": asking, "requests": [{ "data": true }] }));
    assert_eq!(answers[0]["success"], true);
    let said = bridge.wait_for("three problems", |stats| {
        stats["services_not_bridged"].as_object().is_some_and(|problems| problems.len() == 3)
    });
    let problems = &said["services_not_bridged"];
    for (service, part) in [
        ("/wrong", "the configuration says std_srvs/srv/Trigger"),
        ("/twice", "both Tautline and ROS have a server"),
        ("/unknown", "ROS 2 package 'no_such_srvs' is not installed"),
    ] {
        assert!(problems[service].as_str().unwrap().contains(part), "{problems}");
    }
    let services = peer.tell(json!({ "do": "services_of", "node": "here" }));
    assert_eq!(services, json!(["/b"]));
}

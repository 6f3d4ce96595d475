// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of rclpy on rmw_tautline, with each other and with Tautline's own ends. `system.rs` has those that a system file governs.

mod support;

use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Duration;
use support::gateway::link;
use support::{
    Domain, Peer, STRING, TYPES, Values, matched, on_tautline, publisher, reserve, ros, subscription, take,
    take_texts, text_body, text_of, wait_until,
};
use tautline_schema::{DynamicMessage, Endian, Packages};
use tautline_transport::{
    EndpointKind, Limits, NodeName, Qos, RawPublisher, RawSubscription, RequestId, SchemaStore, ServiceKind,
    ServiceType,
};

const SET_BOOL: &str = "std_srvs/srv/SetBool";
const BASIC_TYPES: &str = "test_msgs/srv/BasicTypes";

fn values(domain: u32, types: &str) {
    let Some(domain) = Domain::new(domain) else { return };
    let mut packages = Packages::new();
    packages.add_folder(&domain.venv);
    let mut peer = domain.peer("values");
    for name in types.split(' ') {
        Values::new(name).exchange(&mut peer, &domain.participant, &mut packages, name);
    }
}

#[test]
fn values_of_test_messages() {
    values(50, TYPES[0]);
}

#[test]
fn values_of_texts_and_plain_types() {
    values(51, TYPES[1]);
}

#[test]
fn values_of_geometry_and_navigation() {
    values(52, TYPES[2]);
}

#[test]
fn values_of_sensors_and_joints() {
    values(53, TYPES[3]);
}

/// As large fields of messages are, two at a time, in the first thread, whose memory the C library would give back.
#[test]
fn freed_memory_is_used_again_without_page_faults() {
    const PROGRAM: &str = r#"
import rclpy, resource
rclpy.init()
def act():
    for size in (1, 8, 24):
        one, other = b"x" * (size << 20), b"x" * (size << 20)
        del one, other
faults = lambda: resource.getrusage(resource.RUSAGE_THREAD).ru_minflt
for _ in range(3): act()
before = faults()
for _ in range(10): act()
print(faults() - before)
rclpy.shutdown()
"#;
    let Some(domain) = Domain::new(116) else { return };
    let faults = |variables: &[(&str, &str)]| -> u64 {
        let output = domain.python(PROGRAM).envs(variables.iter().copied()).output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        said.trim().parse().unwrap_or_else(|_| panic!("{said} {}", String::from_utf8_lossy(&output.stderr)))
    };
    // Of 16,896 pages, ten times.
    assert!(faults(&[("TAUT_KEEP_MEMORY", "off")]) > 10_000);
    assert!(faults(&[("MALLOC_TRIM_THRESHOLD_", "100000")]) > 10_000, "a setting of the user's");
    let kept = faults(&[]);
    assert!(kept < 100, "{kept} page faults");
}

/// Those of rclpy's raw subscriptions, more of them at once than are lent.
#[test]
fn serialized_messages_of_another_process_are_whole() {
    const PROGRAM: &str = r#"
import array, rclpy, sys
from rclpy.serialization import deserialize_message
from std_msgs.msg import UInt8MultiArray
rclpy.init()
node = rclpy.create_node("raw")
received = []
subscription = node.create_subscription(UInt8MultiArray, "/raw", received.append, 100, raw=True)
for _ in range(600):
    if len(received) < 40:
        rclpy.spin_once(node, timeout_sec=0.1)
assert len(received) == 40, len(received)
for number, message in enumerate(received):
    assert deserialize_message(message, UInt8MultiArray).data == array.array("B", bytes([number]) * 100_000), number
"#;
    let Some(domain) = Domain::new(110) else { return };
    let publisher =
        publisher(&domain.participant, "/raw", "std_msgs/msg/UInt8MultiArray", Qos::keep_last(100));
    let mut receiver = domain.python(PROGRAM).spawn().unwrap();
    matched(&publisher, 1);
    for number in 0..40 {
        let mut body = vec![0; 8];
        body.extend(100_000_u32.to_le_bytes());
        body.resize(12 + 100_000, number);
        publisher.publish(&body).unwrap();
    }
    assert!(receiver.wait().unwrap().success());
}

/// The definition that rclpy's process leaves reads what it publishes.
#[test]
fn definitions_are_kept_for_tools() {
    let Some(domain) = Domain::new(54) else { return };
    let mut peer = domain.peer("definitions");
    let name = "geometry_msgs/msg/PoseStamped";
    let end = peer.publisher("/pose", name, json!({ "latched": true }));
    peer.tell(json!({ "do": "prepare_random", "type": name, "count": 1, "seed": 7 }));
    peer.tell(json!({ "do": "publish_prepared", "end": end, "count": 1 }));
    let mut found = None;
    wait_until("the topic's hash", || {
        found = domain.participant.topic_type("/pose").unwrap().and_then(|of| of.hash);
        found.is_some()
    });
    let hash = found.unwrap();
    let kept = SchemaStore::of_user().read(&hash).unwrap().expect("it was kept");
    let schema = tautline_schema::Schema::from_text(&name.parse().unwrap(), &kept.text).unwrap();
    assert_eq!(schema.hash().to_string(), hash);
    // A late joiner of Tautline's gets what rclpy's publisher keeps.
    let here = subscription(&domain.participant, "/pose", name, Qos::keep_last(1).transient_local());
    let body = take(&here, 1).remove(0);
    assert_eq!(DynamicMessage::from_body(&schema.into(), &body, Endian::Little).unwrap().trailing_bytes(), 0);
}

#[test]
fn late_joiners_get_what_is_kept_between_nodes_of_rclpy() {
    let Some(domain) = Domain::new(55) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    let from = one.publisher("/kept", STRING, json!({ "latched": true, "depth": 3 }));
    one.publish_text(from, &["a", "b", "c", "d"]);
    let to = other.subscription("/kept", STRING, json!({ "latched": true, "depth": 3 }));
    assert_eq!(other.take_texts(to, 3), ["b", "c", "d"]);
}

/// Which policy did not fit is told at both ends, and nothing passes.
#[test]
fn ends_that_do_not_fit_are_told() {
    let Some(domain) = Domain::new(56) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    let from = one.publisher("/unfit", STRING, json!({ "best_effort": true }));
    let to = other.subscription("/unfit", STRING, json!({}));
    let told = |peer: &mut Peer, end| peer.tell(json!({ "do": "incompatible_qos", "end": end }));
    for told in [told(&mut one, from), told(&mut other, to)] {
        assert!(told.as_str().unwrap().contains("RELIABILITY"), "{told}");
    }
    // Another type: nobody fails, and nobody gets anything.
    let typed = other.subscription("/unfit", "std_msgs/msg/Bool", json!({ "best_effort": true }));
    let fits = other.subscription("/unfit", STRING, json!({ "best_effort": true }));
    one.matched(from, 1);
    one.publish_text(from, &["x"]);
    assert_eq!(other.take_texts(fits, 1), ["x"]);
    assert!(other.take(to, 0).is_empty() && other.take(typed, 0).is_empty());
}

#[test]
fn deadlines_losses_matches_and_liveliness_are_told() {
    let Some(domain) = Domain::new(57) else { return };
    let mut peer = domain.simple_peer("events");
    let end = peer.tell(json!({ "do": "watched_subscription", "topic": "/watched", "deadline_ms": 50 }));
    let happened = |peer: &mut Peer, what: &str| {
        peer.tell(json!({ "do": "happened", "end": end, "what": what }))["total_count"].as_u64()
    };
    let qos = Qos { deadline: Some(Duration::from_millis(50)), ..Qos::keep_last(1) };
    let here = publisher(&domain.participant, "/watched", STRING, qos);
    matched(&here, 1);
    assert_eq!(happened(&mut peer, "matched"), Some(1));
    // Taken by nobody meanwhile: the queue is one message deep.
    peer.tell(json!({ "do": "hold" }));
    (0..5).for_each(|n| here.publish(&text_body(&n.to_string())).unwrap());
    peer.tell(json!({ "do": "go_on" }));
    assert_eq!(happened(&mut peer, "message_lost"), Some(4));
    assert!(happened(&mut peer, "deadline").unwrap() > 0);
    drop(here);
    let alive = peer.tell(json!({ "do": "liveliness", "end": end, "alive": 0 }));
    assert_eq!(alive["alive_count"], 0);
}

#[test]
fn each_side_sees_the_others_graph() {
    let Some(domain) = Domain::new(58) else { return };
    let mut peer = Peer::start_as(&domain.venv, 58, "seen", "ros_services_peer.py", |command| {
        on_tautline(command.args(["--ros-args", "--enclave", "/theirs"]));
    });
    peer.publisher("/there", STRING, json!({ "best_effort": true }));
    peer.tell(json!({ "do": "service", "name": "/serve", "type": SET_BOOL, "behaviour": "set_bool" }));
    let mut found = None;
    wait_until("the node's ends", || {
        let graph = domain.participant.graph().unwrap();
        let has_service = graph.services.iter().any(|end| end.name == "/serve");
        found = graph.endpoints.iter().find(|end| end.topic == "/there").cloned();
        found.is_some() && has_service
    });
    let found = found.unwrap();
    assert_eq!((found.kind, &*found.topic_type.name), (EndpointKind::Publisher, STRING));
    assert_eq!(found.node.clone().unwrap().full_name(), "/seen");
    let nodes = domain.participant.graph().unwrap().nodes.clone();
    assert!(nodes.iter().any(|node| node.name.name == "seen" && node.enclave == "/theirs"), "{nodes:?}");
    let service =
        domain.participant.graph().unwrap().services.iter().find(|end| end.name == "/serve").cloned();
    let service = service.unwrap();
    assert_eq!((service.kind, &*service.type_name), (ServiceKind::Server, SET_BOOL));

    let node = domain.participant.create_node_in_enclave("ours", "/here", "/ours").unwrap();
    let of_node = domain.participant.for_node(&node);
    let ours = publisher(&of_node, "/ours", STRING, Qos::keep_last(3).transient_local());
    let server = of_node
        .create_raw_server("/here/serve", &ServiceType::new(SET_BOOL, None), 10, Limits::default())
        .unwrap();
    assert_eq!(peer.tell(json!({ "do": "enclave", "node": "/here/ours" })), "/ours");
    assert_eq!(peer.tell(json!({ "do": "enclave", "node": "/seen" })), "/theirs");
    peer.tell(json!({ "do": "wait_topic", "topic": "/ours", "type": STRING }));
    assert_eq!(
        peer.tell(json!({ "do": "endpoints", "topic": "/ours" })),
        json!([[["ours", "RELIABLE", "TRANSIENT_LOCAL"]], []])
    );
    let services = peer.tell(json!({ "do": "services_of", "node": "ours", "namespace": "/here" }));
    assert_eq!(services, json!(["/here/serve"]));
    drop((ours, server, of_node, node));
    peer.tell(json!({ "do": "wait_node", "name": "/here/ours", "there": false }));
}

/// Also of what rclpy never destroys, its type description service.
#[test]
fn nothing_is_left_of_a_node_that_was_destroyed() {
    let Some(domain) = Domain::new(119) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    one.tell(json!({ "do": "passing_node", "name": "passing" }));
    other.tell(json!({ "do": "wait_node", "name": "/passing" }));
    one.tell(json!({ "do": "pass_by" }));
    other.tell(json!({ "do": "wait_node", "name": "/passing", "there": false }));
    wait_until("its endpoints to go", || {
        let graph = domain.participant.graph().unwrap();
        let services = graph.services.iter().map(|end| &end.node);
        let of_node = |node: &Option<NodeName>| node.as_ref().is_some_and(|node| node.name == "passing");
        !graph.endpoints.iter().map(|end| &end.node).chain(services).any(of_node)
    });
}

/// The body of a `SetBool` request, and the text of its response.
fn set_bool(is_on: bool) -> Vec<u8> {
    vec![is_on.into()]
}

#[test]
fn services_cross_both_ways() {
    let Some(domain) = Domain::new(59) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    one.tell(json!({ "do": "service", "name": "/one/echo", "type": BASIC_TYPES, "behaviour": "echo" }));
    let client = other.tell(json!({ "do": "client", "name": "/one/echo", "type": BASIC_TYPES }));
    let requests: Vec<Value> =
        (0..200).map(|n| json!({ "int32_value": n, "string_value": format!("n {n}") })).collect();
    let answers = other.tell(json!({ "do": "call", "end": client, "requests": requests }));
    for (request, answer) in requests.iter().zip(answers.as_array().unwrap()) {
        assert_eq!(
            (&answer["int32_value"], &answer["string_value"]),
            (&request["int32_value"], &request["string_value"])
        );
    }
    assert_eq!(answers.as_array().unwrap().len(), 200);

    // Tautline asks rclpy.
    one.tell(json!({ "do": "service", "name": "/one/set", "type": SET_BOOL, "behaviour": "set_bool" }));
    let service_type = ServiceType::new(SET_BOOL, None);
    let client =
        domain.participant.create_queued_client("/one/set", &service_type, 10, Limits::default()).unwrap();
    wait_until("its server", || client.server_count() == 1);
    let number = client.reserve();
    let mut loan = client.loan(1).unwrap();
    loan.copy_from_slice(&set_bool(true));
    client.send(number, loan).unwrap();
    let mut response = None;
    wait_until("a response", || {
        response = client.try_take().unwrap();
        response.is_some()
    });
    let response = response.unwrap();
    assert_eq!(response.info().sequence_number, number);
    assert_eq!((response.body()[0], text_of(&response.body()[4..])), (1, "on".to_owned()));

    // rclpy asks Tautline; what it asks before there is a server waits for one.
    let client = other.tell(json!({ "do": "client", "name": "/ours/set", "type": SET_BOOL }));
    other.tell(json!({ "do": "ask", "end": client, "request": { "data": true } }));
    let server =
        domain.participant.create_raw_server("/ours/set", &service_type, 10, Limits::default()).unwrap();
    let mut request = None;
    wait_until("a request", || {
        request = server.try_take().unwrap();
        request.is_some()
    });
    let request = request.unwrap();
    assert_eq!(request.body(), set_bool(true));
    let body = [&[1, 0, 0, 0][..], &text_body("done")].concat();
    let mut response = server.loan(RequestId::of(request.info()), body.len()).unwrap();
    response.copy_from_slice(&body);
    response.send().unwrap();
    wait_until("its answer", || other.tell(json!({ "do": "answered" })) == json!(true));
}

/// More requests than any queue holds by default, asked before there is a server, in the order of asking.
#[test]
fn what_is_asked_before_there_is_a_server_waits() {
    let Some(domain) = Domain::new(60) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    let client = one.tell(json!({ "do": "client", "name": "/late", "type": BASIC_TYPES }));
    let requests: Vec<Value> = (0..300).map(|n| json!({ "int32_value": n })).collect();
    one.tell(json!({ "do": "ask_all", "end": client, "requests": requests }));
    other.tell(json!({ "do": "service", "name": "/late", "type": BASIC_TYPES, "behaviour": "echo" }));
    let answers = one.tell(json!({ "do": "all_answered" }));
    let numbers: Vec<i64> =
        answers.as_array().unwrap().iter().map(|one| one["int32_value"].as_i64().unwrap()).collect();
    assert_eq!(numbers, (0..300).collect::<Vec<_>>());
}

#[test]
fn actions_run_are_cancelled_and_refused() {
    let Some(domain) = Domain::new(61) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    one.tell(json!({ "do": "action_server", "name": "/count" }));
    let client = other.tell(json!({ "do": "action_client", "name": "/count" }));
    for _ in 0..5 {
        let run = other.tell(json!({ "do": "goal", "end": client, "order": 6, "told": 1 }));
        assert_eq!((&run["status"], &run["sequence"]), (&json!(4), &json!([0, 1, 1, 2, 3, 5, 8])), "{run}");
    }
    let cancelled = other.tell(json!({ "do": "goal", "end": client, "order": 500, "cancel_after": 2 }));
    assert_eq!((&cancelled["status"], &cancelled["cancelling"]), (&json!(5), &json!(1)), "{cancelled}");
    let refused = other.tell(json!({ "do": "goal", "end": client, "order": -1 }));
    assert_eq!(refused, json!({ "accepted": false }));
}

#[test]
fn parameters_are_got_set_listed_and_described() {
    let Some(domain) = Domain::new(62) else { return };
    let (mut one, mut other) = (domain.peer("served"), domain.peer("asking"));
    one.tell(json!({ "do": "serve_parameters", "values": { "speed": 3, "name": "x" } }));
    let client = other.tell(json!({ "do": "parameters", "node": "/served" }));
    let set = other.tell(json!({ "do": "set_parameters", "end": client, "values": { "speed": 5 } }));
    assert_eq!(set, json!([[true, ""]]));
    let got = other.tell(json!({ "do": "get_parameters", "end": client, "names": ["speed", "name"] }));
    assert_eq!((&got[0]["integer_value"], &got[1]["string_value"]), (&json!(5), &json!("x")));
    let listed = other.tell(json!({ "do": "list_parameters", "end": client }));
    assert!(
        ["name", "speed"].iter().all(|name| listed.as_array().unwrap().contains(&json!(name))),
        "{listed}"
    );
    let described = other.tell(json!({ "do": "describe_parameters", "end": client, "names": ["speed"] }));
    assert_eq!(described[0]["type"], json!(2));
}

#[test]
fn a_lifecycle_node_changes_its_state_and_time_is_simulated() {
    let Some(domain) = Domain::new(63) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    one.tell(json!({ "do": "lifecycle_node", "name": "living" }));
    // Configure, activate, deactivate.
    for (transition, state) in [(1, "inactive"), (3, "active"), (4, "inactive")] {
        let reached =
            other.tell(json!({ "do": "change_state", "node": "/living", "transition": transition }));
        assert_eq!(reached, json!([true, state]));
    }
    one.tell(json!({ "do": "simulated_node", "name": "simulated" }));
    let clock = other.publisher("/clock", "rosgraph_msgs/msg/Clock", json!({ "best_effort": true }));
    other.matched(clock, 1);
    other.tell(json!({ "do": "publish_clock", "end": clock, "sec": 1000, "nanosec": 5 }));
    let time = one.tell(json!({ "do": "simulated_time", "at_least": 1_000_000_000_005_u64 }));
    assert_eq!(time, json!(1_000_000_000_005_u64));
}

/// Whichever of both is killed: the other one goes on, and hears the next.
#[test]
fn who_is_killed_stops_nobody() {
    let Some(domain) = Domain::new(64) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    let (from, to) =
        (one.publisher("/killed", STRING, json!({})), other.subscription("/killed", STRING, json!({})));
    one.tell(json!({ "do": "service", "name": "/killed/echo", "type": BASIC_TYPES, "behaviour": "silent" }));
    let client = other.tell(json!({ "do": "client", "name": "/killed/echo", "type": BASIC_TYPES }));
    other.tell(json!({ "do": "available", "end": client }));
    other.tell(json!({ "do": "ask", "end": client, "request": {} }));
    one.matched(from, 1);
    one.publish_text(from, &["before"]);
    assert_eq!(other.take_texts(to, 1), ["before"]);
    one.kill();
    other.tell(json!({ "do": "available", "end": client, "is_so": false }));
    let mut one = domain.peer("one_again");
    let from = one.publisher("/killed", STRING, json!({}));
    one.matched(from, 1);
    one.publish_text(from, &["after"]);
    assert_eq!(other.take_texts(to, 1), ["after"]);
    other.kill();
    one.matched(from, 0);
    let here = subscription(&domain.participant, "/killed", STRING, Qos::default());
    one.matched(from, 1);
    one.publish_text(from, &["to the living"]);
    assert_eq!(take_texts(&here, 1), ["to the living"]);
}

/// The processes of `fork_peer.py`, which answer with their role and process number.
struct ForkPeers {
    ask: RawPublisher,
    answers: RawSubscription,
    first: Child,
    pids: BTreeMap<String, i32>,
}

impl ForkPeers {
    fn start(domain: &Domain, how: &str) -> Self {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fork_peer.py");
        let mut command = domain.command(domain.venv.join("bin/python"));
        // Also those are killed that never answer.
        command.arg(script).arg(how).process_group(0);
        let ask = publisher(&domain.participant, "/ask", STRING, Qos::keep_last(10));
        let answers = subscription(&domain.participant, "/answer", STRING, Qos::keep_last(10));
        ForkPeers { ask, answers, first: command.spawn().unwrap(), pids: BTreeMap::new() }
    }

    /// Asks, and waits until these have answered, who are all.
    fn ask(&mut self, roles: &[&str], text: &str) {
        matched(&self.ask, roles.len());
        self.ask.publish(&text_body(text)).unwrap();
        let mut answered = BTreeSet::new();
        for answer in take_texts(&self.answers, roles.len()) {
            let [role, pid, said] = answer.split(' ').collect::<Vec<_>>()[..] else { panic!("{answer}") };
            assert_eq!(said, text);
            self.pids.insert(role.to_owned(), pid.parse().unwrap());
            answered.insert(role.to_owned());
        }
        assert!(answered.iter().eq(roles), "{answered:?}");
    }

    fn kill(&mut self, role: &str) {
        let pid = self.pids.remove(role).unwrap();
        kill_process(Pid::from_raw(pid).unwrap(), Signal::KILL).unwrap();
    }
}

impl Drop for ForkPeers {
    fn drop(&mut self) {
        let _ = kill_process_group(Pid::from_child(&self.first), Signal::KILL);
        let _ = self.first.wait();
    }
}

/// In a process that multiprocessing makes, rclpy has a context of its own; whichever of both is killed, the other one goes on.
fn with_multiprocessing(domain: u32, how: &str) {
    let Some(domain) = Domain::new(domain) else { return };
    for (killed, living) in [("child", "parent"), ("parent", "child")] {
        let mut peers = ForkPeers::start(&domain, how);
        peers.ask(&["child", "parent"], "both");
        peers.kill(killed);
        peers.ask(&[living], "one");
        drop(peers);
        wait_until("both to be cleaned up after", || domain.others() == 0);
    }
}

#[test]
fn processes_that_multiprocessing_forks_live_on_their_own() {
    with_multiprocessing(85, "fork");
}

#[test]
fn processes_that_multiprocessing_spawns_live_on_their_own() {
    with_multiprocessing(86, "spawn");
}

#[test]
fn processes_of_multiprocessings_forkserver_live_on_their_own() {
    with_multiprocessing(87, "forkserver");
}

/// What a forked child does with its parent's node is an error that says what to do, and it exits.
#[test]
fn a_forked_child_is_refused_its_parents_node_and_exits() {
    let Some(domain) = Domain::new(88) else { return };
    let mut peers = ForkPeers::start(&domain, "exit");
    assert_eq!(take_texts(&peers.answers, 1), ["exited with 7"]);
    peers.ask(&["parent"], "still");
}

/// Also in a forked child, which has no thread of its parent's: what is wrong is said by each of them.
#[test]
fn a_forked_child_logs_by_itself() {
    let Some(domain) = Domain::new(89) else { return };
    let system = tempfile::NamedTempFile::new().unwrap();
    let of_others = "[hosts.here]\ncores = 1\n[nodes.n]\n[callbacks.c]\nperiod = \"1s\"\nwcet = \"1ms\"\n";
    std::fs::write(system.path(), of_others).unwrap();
    let said = tempfile::NamedTempFile::new().unwrap();
    // The end of the input ends both.
    let program = "import os, rclpy, sys\nrclpy.init()\npid = os.fork()\nif pid == 0:\n    rclpy.init(context=rclpy.Context())\n\
                   sys.stdin.read()\nif pid:\n    os.waitpid(pid, 0)\n";
    let mut command = domain.python(program);
    command.env("TAUT_SYSTEM", system.path());
    let mut process = command.stdin(Stdio::piped()).stderr(said.reopen().unwrap()).spawn().unwrap();
    let input = process.stdin.take();
    let words = || std::fs::read_to_string(said.path()).unwrap();
    wait_until("a warning of each", || words().matches("has no callback of host").count() == 2);
    drop(input);
    assert!(process.wait().unwrap().success(), "{}", words());
}

/// As many nodes as a large robot has, each with what rclpy gives a node: parameters' services, events, its log.
#[test]
fn a_hundred_nodes_see_and_hear_each_other() {
    let Some(domain) = Domain::new(65) else { return };
    let (mut one, mut other) = (domain.peer("one"), domain.peer("other"));
    for (peer, name) in [(&mut one, "left"), (&mut other, "right")] {
        peer.tell(json!({ "do": "nodes", "name": name, "count": 50 }));
    }
    for n in [0, 49] {
        one.tell(json!({ "do": "wait_node", "name": format!("/right_{n}") }));
        other.tell(json!({ "do": "wait_node", "name": format!("/left_{n}") }));
    }
    let from = one.publisher("/all", STRING, json!({}));
    one.matched(from, 100);
    one.publish_text(from, &["to all"]);
    for peer in [&mut one, &mut other] {
        peer.tell(json!({ "do": "all_heard", "text": "to all" }));
    }
}

/// rclpy on two hosts: a domain each, and gateways between them.
#[test]
fn nodes_on_two_hosts_hear_each_other_through_gateways() {
    let Some(venv) = ros() else { return };
    let domains = [66, 67];
    domains.into_iter().for_each(reserve);
    let Some(_gateways) = link(domains[0], domains[1]) else { return };
    let [mut here, mut there] =
        domains.map(|domain| Peer::start_as(&venv, domain, "peer", "ros_services_peer.py", on_tautline));
    let to = there.subscription("/across", STRING, json!({ "depth": 100 }));
    let from = here.publisher("/across", STRING, json!({ "depth": 100 }));
    here.matched(from, 1);
    let texts: Vec<String> = (0..50).map(|n| format!("n {n}")).collect();
    here.publish_text(from, &texts);
    assert_eq!(there.take_texts(to, 50), texts);
    // Each endpoint counts, not the gateway's that carries the messages of all.
    there.subscription("/across", STRING, json!({}));
    here.matched(from, 2);
    here.publisher("/across", STRING, json!({}));
    there.matched(to, 2);
    here.tell(json!({ "do": "service", "name": "/across/echo", "type": BASIC_TYPES, "behaviour": "echo" }));
    let client = there.tell(json!({ "do": "client", "name": "/across/echo", "type": BASIC_TYPES }));
    let answer = there.tell(json!({ "do": "call", "end": client, "requests": [{ "int32_value": 7 }] }));
    assert_eq!(answer[0]["int32_value"], 7);
}

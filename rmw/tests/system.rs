// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of rclpy that run unchanged under a system file: what it gives their threads, callbacks and queues, and what is reported of them.

mod support;

use futures::StreamExt;
use serde_json::{Value, json};
use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use support::{Domain, STRING, built, matched, may_be_realtime, publisher, text_body, wait_until, words_of};
use tautline::std_msgs::msg::String as Text;
use tautline::{Context, Node, Qos, Realtime};

/// A domain for a test of what `taut` says of it.
fn seen(number: u32) -> Option<Domain> {
    built("taut", "taut").and_then(|_| Domain::new(number))
}

/// The output of `taut` in a domain of the tests.
fn taut(domain: &Domain, arguments: &[&str]) -> String {
    let mut command = Command::new(built("taut", "taut").unwrap());
    command.args(arguments).args(["--domain", &domain.number.to_string()]);
    words_of(command.env("TAUT_SCOPE", support::scope())).1
}

fn json_of(domain: &Domain, arguments: &[&str]) -> Value {
    let said = taut(domain, arguments);
    serde_json::from_str(&said).unwrap_or_else(|error| panic!("{error}: {said}"))
}

fn report(domain: &Domain) -> Value {
    json_of(domain, &["report", "--json"])
}

/// Starts a program that prints a line once it runs, and ends with its input. Returns that line.
fn started(command: &mut Command) -> (Child, String) {
    let mut process = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(process.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (process, line)
}

fn end(mut process: Child) {
    drop(process.stdin.take());
    assert!(process.wait().unwrap().success());
}

/// What `taut report` says of a node of rclpy that `TAUT_SYSTEM` gives a system file, and what `taut trace` saw of it.
#[test]
fn callbacks_of_rclpy_are_reported_and_traced() {
    let Some(domain) = seen(66) else { return };
    let folder = tempfile::tempdir().unwrap();
    let (system, trace) = (folder.path().join("system.toml"), folder.path().join("run.trace"));
    let text = r#"
        [hosts.here]
        cores = 1
        [overheads]
        rclpy = "1s"
        [nodes.listener]
        client = "rclpy"
        [topics]
        "/heard" = { period = "10ms", jitter = "100s" }
        "/also" = { period = "10ms", jitter = "100s" }
        [callbacks.hear]
        topic = ["/heard", "/also"]
        wcet = "1ms"
        deadline = "100s"
        [callbacks.tick]
        period = "1s"
        wcet = "1ms"
        "#;
    std::fs::write(&system, text).unwrap();
    let (system, trace) = (system.to_str().unwrap(), trace.to_str().unwrap());
    let mut peer = domain.simple_peer_with(
        "listener",
        &[("TAUT_SYSTEM", system), ("TAUT_TRACE", "on"), ("TAUT_REALTIME", "off")],
    );
    let (heard, unlisted) =
        (peer.subscription("/heard", STRING, json!({})), peer.subscription("/unlisted", STRING, json!({})));
    let also = peer.subscription("/also", STRING, json!({}));
    let _never = peer.subscription("/never", STRING, json!({}));
    for (topic, end, count) in [("/heard", heard, 5), ("/also", also, 2), ("/unlisted", unlisted, 2)] {
        let here = publisher(&domain.participant, topic, STRING, Qos::keep_last(10));
        matched(&here, 1);
        (0..count).for_each(|n: usize| here.publish(&text_body(&n.to_string())).unwrap());
        assert_eq!(peer.take_texts(end, count).len(), count);
    }
    let mut report = Value::Null;
    // The last one ends when the executor waits again.
    wait_until("7 jobs", || {
        report = self::report(&domain);
        report["callbacks"][0]["measured"]["jobs"] == 7
    });
    let hear = &report["callbacks"][0];
    assert_eq!((&hear["name"], hear["measured"]["lost"].as_u64()), (&json!("hear"), Some(0)), "{report}");
    assert!(hear["measured"]["execution_ms"]["max"].as_f64().unwrap() > 0.0, "{report}");
    assert_eq!(hear["predicted"]["budget_ms"], 1_001.0, "1 ms of its own and 1 s of rclpy: {report}");
    let marks = hear["violations"].to_string();
    assert!(!marks.contains("runs twice") && !marks.contains("not running"), "one of two topics: {report}");
    assert_eq!(report["callbacks"].as_array().unwrap().len(), 1, "an RMW sees no timers: {report}");
    assert!(
        report["notes"]
            .to_string()
            .contains("publish the first of their `publishes` in their node, not: tick")
    );
    let unknown = report["unknown"].as_array().unwrap();
    assert_eq!(unknown.len(), 1, "what never ran is not shown: {report}");
    assert_eq!(unknown[0]["name"], "/listener /unlisted");

    taut(&domain, &["trace", "record", "--seconds", "0", "-o", trace]);
    let mut export = Command::new(built("taut", "taut").unwrap());
    let (_, events, _) = words_of(export.args(["trace", "export", trace, "--format", "csv", "-o", "-"]));
    let of = |what: &str| -> Vec<&str> {
        events
            .lines()
            .filter(|line| line.contains(what))
            .map(|line| line.split(',').nth(5).unwrap())
            .collect()
    };
    let hear: Vec<_> = of(",hear,").into_iter().filter(|kind| !kind.ends_with("_init")).collect();
    let jobs: Vec<_> = std::iter::repeat_n(["callback_start", "callback_end"], 7).flatten().collect();
    assert_eq!(hear, jobs, "{events}");
    let waits = of(",rmw_wait,");
    assert!(waits.contains(&"spin_start") && waits.contains(&"spin_wake"), "{events}");
    assert_eq!(of(",/heard,").iter().filter(|kind| **kind == "take").count(), 5, "{events}");
}

/// Three messages are there before the first wait, and of two topics one each; the executor spins after two more have come.
const EARLY: &str = r#"
import rclpy, sys
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from std_msgs.msg import String
rclpy.init()
node, source, heard = rclpy.create_node("listener"), rclpy.create_node("source"), []
def hear(message): heard.append(message.data)
subscriptions = [node.create_subscription(String, topic, hear, 1) for topic in ("/short", "/early")]
short, early = [source.create_publisher(String, topic, 10) for topic in ("/short", "/early")]
while any(publisher.get_subscription_count() < 1 for publisher in (short, early)): pass
early.publish(String(data="early"))
for text in ("one", "two", "three"): short.publish(String(data=text))
context = rclpy.get_default_context()
with context.handle, subscriptions[0].handle, subscriptions[1].handle:
    waits = rclpy_implementation.WaitSet(2, 0, 0, 0, 0, 0, context.handle)
    waits.clear_entities()
    for subscription in subscriptions: waits.add_subscription(subscription.handle)
    waits.wait(0)
for text in ("four", "five"): short.publish(String(data=text))
executor = SingleThreadedExecutor()
executor.add_node(node)
while len(heard) < 2: executor.spin_once()
executor.spin_once(timeout_sec=0)
print(sorted(heard), flush=True)
sys.stdin.read()
"#;

/// What was published before anyone waited is no job, but lost where it was overwritten; its processor time is known.
#[test]
fn what_came_before_the_first_wait_is_no_job() {
    let Some(domain) = seen(114) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let callback = |name: &str| {
        format!(
            "[callbacks.{name}]\ntopic = \"/{name}\"\nwcet = \"1ms\"\n[topics.\"/{name}\"]\nperiod = \"1s\"\n"
        )
    };
    let head = "[hosts.here]\ncores = 1\n[nodes.listener]\nclient = \"rclpy\"\n";
    std::fs::write(file.path(), [head, &callback("short"), &callback("early")].concat()).unwrap();
    let mut command = domain.python(EARLY);
    let (process, heard) = started(command.env("TAUT_SYSTEM", file.path()).env("TAUT_REALTIME", "off"));
    assert_eq!(heard.trim(), "['early', 'five']");
    let report = report(&domain);
    let picture = json_of(&domain, &["top", "--once", "--json"]);
    end(process);
    let of = |name: &str| {
        let rows = report["callbacks"].as_array().unwrap();
        let seen = &rows.iter().find(|row| row["name"] == name).unwrap()["measured"];
        let used_ms = seen["execution_ms"]["max"].as_f64().unwrap_or(0.0);
        (seen["jobs"].as_u64().unwrap(), seen["lost"].as_u64().unwrap(), used_ms > 0.0)
    };
    assert_eq!(
        [of("short"), of("early")],
        [(1, 4, true), (0, 0, true)],
        "of short, only five was taken: {report}"
    );
    for row in report["callbacks"].as_array().unwrap() {
        let bound_ms = &row["predicted"]["response_ms"];
        let mut shown = picture["callbacks"].as_array().unwrap().iter();
        let shown = shown.find(|of| of["name"] == row["name"]).unwrap();
        assert!(bound_ms.is_number() && shown["bound_ms"] == *bound_ms, "{row} {picture}");
    }
}

/// Five topics, three messages each, all there before an unchanged executor of rclpy begins.
const QUEUED: &str = r#"
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node, source, order = rclpy.create_node("listener"), rclpy.create_node("source"), []
topics = [f"/t{n}" for n in range(5)] + ["/unlisted"]
subscriptions = [node.create_subscription(String, topic, lambda m: order.append(m.data), 10) for topic in topics]
publishers = [source.create_publisher(String, topic, 10) for topic in topics]
while any(publisher.get_subscription_count() < 1 for publisher in publishers): pass
for _ in range(3):
    for topic, publisher in zip(topics, publishers): publisher.publish(String(data=topic[-1]))
executor = SingleThreadedExecutor()
executor.add_node(node)
while len(order) < 18: executor.spin_once()
print("".join(order))
executor.shutdown()
rclpy.shutdown()
"#;

/// A system file orders the callbacks of an executor that knows nothing of it; what it does not list comes last.
#[test]
fn ready_callbacks_run_by_their_priorities() {
    let Some(domain) = Domain::new(68) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let order = |text: &str| {
        std::fs::write(file.path(), text).unwrap();
        let mut command = domain.python(QUEUED);
        let (is_good, out, errors) =
            words_of(command.env("TAUT_SYSTEM", file.path()).env("TAUT_REALTIME", "off"));
        assert!(is_good, "{errors}");
        out.trim().to_owned()
    };
    let mut text = "[hosts.here]\ncores = 1\n[nodes.listener]\nclient = \"rclpy\"\n[groups.all]\n".to_owned();
    let head = text.len();
    for n in 0..5 {
        text += &format!(
            "[callbacks.t{n}]\ntopic = \"/t{n}\"\ngroup = \"all\"\nwcet = \"1ms\"\n[topics.\"/t{n}\"]\nperiod = \"100ms\"\n"
        );
    }
    assert_eq!(order(&text), "01234d".repeat(3), "in rounds");
    text.insert_str(head, "order = \"priority\"\npriority = 40\n");
    for n in 0..5 {
        // The third and the fourth are alike: they are reported together.
        let rank = [1, 2, 3, 3, 5][n];
        text =
            text.replace(&format!("topic = \"/t{n}\"\n"), &format!("topic = \"/t{n}\"\npriority = {rank}\n"));
    }
    assert_eq!(order(&text), "444232323111000ddd");
}

/// Each topic has an executor, and prints what its callback's thread is.
const SCHEDULED: &str = r#"
import os, rclpy, threading
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("listener")
seen = {topic: [] for topic in ("/fast", "/slow", "/unlisted")}
def listen(topic):
    def heard(_):
        started = []
        thread = threading.Thread(target=lambda: started.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
        assert started == [os.SCHED_OTHER], "what it starts is ordinary"
        seen[topic].append((os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, sorted(os.sched_getaffinity(0))))
    return heard
nodes = {topic: rclpy.create_node("listener" if topic != "/unlisted" else "ordinary") for topic in seen}
subscriptions = [nodes[topic].create_subscription(String, topic, listen(topic), 10) for topic in seen]
publishers = {topic: node.create_publisher(String, topic, 10) for topic in seen}
while any(publisher.get_subscription_count() < 1 for publisher in publishers.values()): pass
def spin(topic):
    executor = SingleThreadedExecutor()
    executor.add_node(nodes[topic])
    while not seen[topic]: executor.spin_once()
threads = [threading.Thread(target=spin, args=(topic,)) for topic in seen]
[thread.start() for thread in threads]
for publisher in publishers.values(): publisher.publish(String(data="some"))
[thread.join() for thread in threads]
for topic, all in seen.items():
    policy, priority, cores = all[0]
    print(topic, ["other", "fifo"][policy & ~os.SCHED_RESET_ON_FORK], priority, cores)
rclpy.shutdown()
"#;

/// The thread that waits for a callback becomes the thread that the system file describes; others stay as they are.
#[test]
fn threads_of_unchanged_executors_are_those_of_the_system_file() {
    let Some(domain) = Domain::new(115).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let callback = |name: &str, priority: u8| {
        format!(
            "[callbacks.{name}]\ntopic = \"/{name}\"\npriority = {priority}\nwcet = \"1ms\"\n[topics.\"/{name}\"]\nperiod = \"1s\"\n"
        )
    };
    let head = "[hosts.here]\ncores = 1\nsampler_priority = 90\n[nodes.listener]\nclient = \"rclpy\"\n";
    std::fs::write(file.path(), [head, &callback("fast", 41), &callback("slow", 40)].concat()).unwrap();
    let run = |realtime: &str| {
        let mut command = domain.python(SCHEDULED);
        let (is_good, out, errors) =
            words_of(command.env("TAUT_SYSTEM", file.path()).env("TAUT_REALTIME", realtime));
        assert!(is_good, "{errors}");
        out
    };
    let cores =
        tautline_rt::current_affinity().unwrap().iter().map(|core| core.to_string()).collect::<Vec<_>>();
    let ordinary = |topic: &str| format!("{topic} other 0 [{}]\n", cores.join(", "));
    let governed = ["/fast fifo 41 [0]\n/slow fifo 40 [0]\n", &ordinary("/unlisted")].concat();
    assert_eq!(run("required"), governed);
    assert_eq!(run("off"), ["/fast", "/slow", "/unlisted"].map(ordinary).concat());
}

/// Each callback of one executor tells the priority of its thread; 0: an ordinary one.
const LOWERED: &str = r#"
import os, rclpy, threading
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node, source, seen = rclpy.create_node("listener"), rclpy.create_node("source"), []
def own():
    is_fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    return os.sched_getparam(0).sched_priority if is_fifo else 0
def tell(what):
    started = []
    thread = threading.Thread(target=lambda: started.append(own()))
    thread.start()
    thread.join()
    assert started == [0], "what it starts is ordinary"
    seen.append(f"{what} {own()}")
topics = ["/low", "/unlisted", "/high", "/middle"]
subscriptions = {topic: node.create_subscription(String, topic, lambda message: tell(message.data), 10) for topic in topics}
publishers = {topic: source.create_publisher(String, topic, 10) for topic in topics}
while any(publisher.get_subscription_count() < 1 for publisher in publishers.values()): pass
executor = SingleThreadedExecutor()
executor.add_node(node)
def spin():
    count = len(seen)
    while len(seen) == count: executor.spin_once()
def publish(topic): publishers[topic].publish(String(data=topic[1:]))
def run_low():
    publish("/low")
    spin()
for topic in topics: publish(topic)
for _ in topics: spin()
run_low()
tell("then")
with subscriptions["/high"].handle: assert subscriptions["/high"].handle.take_message(String, False) is None
tell("taken")
run_low()
executor.spin_once(timeout_sec=0)
tell("waited")
run_low()
def tick():
    timer.cancel()
    tell("timer")
timer = node.create_timer(0.001, tick)
while not timer.is_ready(): pass
spin()
run_low()
child = os.fork()
if child == 0:
    os.environ["TAUT_ADMISSION"] = "off"
    context = rclpy.Context()
    rclpy.init(context=context)
    other, its = rclpy.create_node("other", context=context), SingleThreadedExecutor(context=context)
    its.add_node(other)
    its.spin_once(timeout_sec=0)
    print(f"child {own()}", flush=True)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
print(", ".join(seen))
rclpy.shutdown()
"#;

/// A thread has the priority of the callback that it runs, and the ceiling wherever an RMW sees no callback.
#[test]
fn a_thread_has_the_priorities_of_its_callbacks_where_the_file_says_so() {
    let Some(domain) = Domain::new(123).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut text = "[hosts.here]\ncores = 1\nsampler_priority = 90\n[overheads]\nrclpy = \"1ms\"\n[nodes.listener]\nclient = \"rclpy\"\n\
                    [groups.all]\norder = \"priority\"\nthread_priority = \"callback\"\n\
                    [callbacks.tick]\nperiod = \"1s\"\ngroup = \"all\"\nwcet = \"1ms\"\n"
        .to_owned();
    for (name, priority) in [("high", 30), ("middle", 20), ("low", 10)] {
        text += &format!(
            "[callbacks.{name}]\ntopic = \"/{name}\"\ngroup = \"all\"\npriority = {priority}\nwcet = \"1ms\"\n[topics.\"/{name}\"]\nperiod = \"1s\"\n"
        );
    }
    let run = |text: &str, realtime: &str| {
        std::fs::write(file.path(), text).unwrap();
        let mut command = domain.python(LOWERED);
        command.env("TAUT_SYSTEM", file.path()).env("TAUT_REALTIME", realtime);
        let (is_good, out, errors) = words_of(&mut command);
        assert!(is_good, "{errors}");
        out
    };
    assert_eq!(
        run(&text, "required"),
        "child 0\nhigh 30, middle 20, low 10, unlisted 30, low 10, then 10, taken 30, low 10, waited 30, low 10, timer 30, low 10\n"
    );
    let of_group = text.replace("thread_priority = \"callback\"", "priority = 40");
    let all = |own: u8| {
        ["high", "middle", "low", "unlisted", "low", "then", "taken", "low", "waited", "low", "timer", "low"]
            .map(|what| format!("{what} {own}"))
            .join(", ")
    };
    assert_eq!(run(&of_group, "required"), format!("child 0\n{}\n", all(40)));
    assert_eq!(run(&text, "off"), format!("child 0\n{}\n", all(0)));
}

/// A subscription, one that no file has, and a service; their callbacks run in the ways that `argv` names.
const WRONG: &str = r#"
import os, rclpy, sys, threading, time
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from std_msgs.msg import String
from std_srvs.srv import SetBool
rclpy.init()
source = rclpy.create_node("source")
nodes = [rclpy.create_node("listener", namespace=namespace) for namespace in ("/one", "/two")]
how, topics, policies = sys.argv[1], ["/one", "/two"], []
def heard(_): policies.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)
subscriptions = [node.create_subscription(String, topic, heard, 10) for node, topic in zip(nodes, topics)]
publishers = [source.create_publisher(String, topic, 10) for topic in topics]
if how == "more":
    ours = rclpy.create_node("ours")
    unknown = nodes[0].create_subscription(String, "/unknown", heard, 10)
    client = nodes[0].create_client(SetBool, "asked")
    services = [nodes[0].create_service(SetBool, name, lambda request, response: response) for name in ("listed", "own")]
    print("runs", flush=True)
    sys.stdin.read()
while any(publisher.get_subscription_count() < 1 for publisher in publishers): pass
def publish(): [publisher.publish(String(data="some")) for publisher in publishers]
def spin(executor, nodes):
    [executor.add_node(node) for node in nodes]
    while len(policies) < 2: executor.spin_once(timeout_sec=0.1)
def poll():
    taken = None
    while taken is None:
        with subscriptions[0].handle: taken = subscriptions[0].handle.take_message(String, False)
    [heard(taken) for _ in range(2)]
if how == "two":
    threads = [threading.Thread(target=spin, args=(SingleThreadedExecutor(), [node])) for node in nodes]
elif how == "many":
    threads = [threading.Thread(target=spin, args=(MultiThreadedExecutor(2), nodes))]
elif how == "poll":
    threads = [threading.Thread(target=poll)]
else:
    threads = [threading.Thread(target=spin, args=(SingleThreadedExecutor(), nodes))]
if how != "more":
    [thread.start() for thread in threads]
    publish()
    [thread.join() for thread in threads]
    print(all(policies), flush=True)
rclpy.shutdown()
"#;

/// The group `all` has the callbacks of both topics.
fn wrong_file(core: u32, more: &str) -> String {
    let callback = |name: &str| {
        format!(
            "[callbacks.{name}]\nnode = \"/{name}/listener\"\ntopic = \"/{name}\"\ngroup = \"all\"\nwcet = \"1ms\"\n[topics.\"/{name}\"]\nperiod = \"1s\"\n\
             [nodes.\"/{name}/listener\"]\nclient = \"rclpy\"\n"
        )
    };
    let head = format!(
        "[hosts.here]\ncores = [{core}]\nsampler_priority = 90\n[overheads]\nrclpy = \"1ms\"\n[groups.all]\norder = \"any\"\npriority = 40\n"
    );
    [&head, &callback("one"), &callback("two"), more].concat()
}

/// Starts [`WRONG`] under a file, with a program in front that takes its rights away.
fn wrong(domain: &Domain, how: &str, path: &Path, realtime: &str, front: &[&str]) -> Command {
    let python = domain.venv.join("bin/python");
    let mut words = front.iter().map(OsStr::new).chain([python.as_os_str()]);
    let mut command = domain.command(words.next().unwrap());
    command.args(words).args(["-c", WRONG, how]).env("TAUT_SYSTEM", path).env("TAUT_REALTIME", realtime);
    command
}

/// What a node has and the file lacks is named as the node starts; what the file has and no node, by `taut report`.
#[test]
fn what_file_and_node_lack_of_each_other_is_named() {
    let Some(domain) = seen(94).filter(|_| may_be_realtime()) else { return };
    let (file, said) = (tempfile::NamedTempFile::new().unwrap(), tempfile::NamedTempFile::new().unwrap());
    let callback = |name: &str, topic: &str| {
        format!(
            "[callbacks.{name}]\nnode = \"/one/listener\"\ntopic = \"{topic}\"\ngroup = \"all\"\nwcet = \"1ms\"\n[topics.\"{topic}\"]\nperiod = \"1s\"\n"
        )
    };
    let silent =
        "[callbacks.silent]\nnode = \"/one/listener\"\nperiod = \"1s\"\nwcet = \"1ms\"\npriority = 30\n"
            .to_owned();
    let ours = silent.replace("silent", "ours").replace("/one/listener", "/ours").replace("30", "20");
    let ours = ours + "[nodes.\"/ours\"]\n";
    let more = [callback("gone", "/gone"), callback("listed", "request:/one/listed"), silent, ours].concat();
    std::fs::write(file.path(), wrong_file(0, &more)).unwrap();
    let mut command = wrong(&domain, "more", file.path(), "required", &[]);
    let output = said.reopen().unwrap();
    command.stdin(Stdio::piped()).stdout(output.try_clone().unwrap()).stderr(output);
    let mut process = command.spawn().unwrap();
    let words = || std::fs::read_to_string(said.path()).unwrap();
    wait_until("it runs, and its warnings", || {
        let is_told = words().contains("`topic = \"request:/one/own\"`") && words().contains("runs\n");
        is_told || process.try_wait().unwrap().is_some()
    });
    let report = report(&domain);
    drop(process.stdin.take());
    assert!(process.wait().unwrap().success(), "it starts all the same: {}", words());
    for topic in ["/unknown", "response:/one/asked", "request:/one/own"] {
        let text = format!("no callback of node `/one/listener` with `topic = \"{topic}\"`");
        assert!(words().contains(&text), "{topic}: {}", words());
    }
    for text in [
        "node `/source` is not in the system file, which has `/one/listener`, `/two/listener` on this host",
        "node `/ours` runs in an executor of ROS, but callback `ours` of the system file is one of Tautline",
    ] {
        assert!(words().contains(text), "{text}: {}", words());
    }
    assert_eq!(
        words().matches("add it to the file").count(),
        3,
        "of every node's services nothing: {}",
        words()
    );
    let row =
        |name: &str| report["callbacks"].as_array().unwrap().iter().find(|row| row["name"] == name).unwrap();
    assert_eq!(row("listed")["violations"], json!([]), "a service is one as any: {report}");
    let row = row("gone");
    assert_eq!(row["violations"][0]["name"], "not running", "{report}");
    let fix = "start node `/one/listener`, with TAUT_SYSTEM set, and a subscription of /gone, or take it out of the file";
    assert!(row["violations"][0]["explanation"].as_str().unwrap().contains(fix), "{report}");
}

/// What a node has and the file lacks is refused in the words of the warning, where the file says so; with the rest of it, all that the node has
/// starts, and so it does where callbacks are only measured.
#[test]
fn what_the_file_lacks_is_refused_where_it_says_so() {
    let Some(domain) = Domain::new(193).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let run = |more: &str, realtime: &str| {
        let text = wrong_file(0, more).replace("cores = [0]\n", "cores = [0]\nunlisted = \"refuse\"\n");
        std::fs::write(file.path(), text).unwrap();
        words_of(&mut wrong(&domain, "more", file.path(), realtime, &[]))
    };
    let node = |name: &str, priority: u8| {
        format!(
            "[nodes.{name}]\nclient = \"rclpy\"\n[callbacks.{name}]\nnode = \"{name}\"\nperiod = \"1s\"\nwcet = \"1ms\"\npriority = {priority}\n"
        )
    };
    let callback = |name: &str, topic: &str| {
        format!(
            "[callbacks.{name}]\nnode = \"/one/listener\"\ntopic = \"{topic}\"\ngroup = \"all\"\nwcet = \"1ms\"\n[topics.\"{topic}\"]\nperiod = \"1s\"\n"
        )
    };
    let unlisted = |topic: &str| format!("no callback of node `/one/listener` with `topic = \"{topic}\"`");
    let mut more = String::new();
    let (is_good, out, errors) = run(&more, "off");
    assert!(is_good && out.trim() == "runs", "{out}{errors}");
    for (lacking, entry) in [
        ("node `/source` is not in the system file".to_owned(), node("source", 30)),
        ("node `/ours` is not in the system file".to_owned(), node("ours", 31)),
        (unlisted("/unknown"), callback("unknown", "/unknown")),
        (unlisted("response:/one/asked"), callback("asked", "response:/one/asked")),
        (unlisted("request:/one/listed"), callback("listed", "request:/one/listed")),
        (unlisted("request:/one/own"), callback("own", "request:/one/own")),
    ] {
        let (is_good, out, errors) = run(&more, "required");
        assert!(!is_good && out.is_empty(), "{lacking}: {out}{errors}");
        for part in [&*lacking, "host `here` of the file has `unlisted = \"refuse\"`"] {
            assert!(errors.contains(part), "{part}: {errors}");
        }
        more += &entry;
    }
    let (is_good, out, errors) = run(&more, "required");
    assert!(is_good && out.trim() == "runs", "{out}{errors}");
}

/// A thread that runs the file's callbacks is the file's, and what makes the bounds wrong is named.
#[test]
fn threads_that_the_file_does_not_expect_are_governed_and_named() {
    let Some(domain) = Domain::new(95).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), wrong_file(0, "")).unwrap();
    let run = |how: &str| {
        let (is_good, out, errors) = words_of(&mut wrong(&domain, how, file.path(), "required", &[]));
        assert!(is_good, "{errors}");
        assert_eq!(out.trim(), "True", "{how}: {errors}");
        errors
    };
    let without_wait = "takes messages of 'cb:all' and does not wait for them in the RMW";
    let errors = run("one");
    assert!(!errors.contains(without_wait) && !errors.contains("two threads"), "as the file says: {errors}");
    for how in ["poll", "many"] {
        let errors = run(how);
        assert!(
            errors.contains(without_wait) && errors.contains("an executor with one thread that waits"),
            "{errors}"
        );
    }
    let errors = run("two");
    assert!(
        errors.contains("wait for callbacks of 'cb:all', which the system file gives one thread"),
        "{errors}"
    );
    assert!(errors.contains("use one executor for them, with one thread, or name two groups"), "{errors}");
    let mut text = wrong_file(0, "").replace("group = \"all\"\n", "");
    text = text.replace("[groups.all]\norder = \"any\"\npriority = 40\n", "");
    for (name, priority) in [("one", 41), ("two", 40)] {
        let head = format!("[callbacks.{name}]\n");
        text = text.replace(&head, &format!("{head}priority = {priority}\n"));
    }
    std::fs::write(file.path(), text).unwrap();
    let errors = run("one");
    let text = "one executor runs callbacks of two threads of the system file, 'cb:one' and 'cb:two': give each an executor";
    assert!(errors.contains(text), "{errors}");
}

/// Two contexts after each other in one thread, and the thread's priority under each.
const ANEW: &str = r#"
import os, rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
for _ in range(2):
    rclpy.init()
    node = rclpy.create_node("listener", namespace="/one")
    subscription = node.create_subscription(String, "/one", lambda message: None, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin_once(timeout_sec=0)
    print(os.sched_getparam(0).sched_priority, flush=True)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown()
"#;

/// Each context reads the file; its threads are those of the contexts before it.
#[test]
fn a_thread_is_that_of_the_file_under_a_later_context() {
    let Some(domain) = Domain::new(122).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), wrong_file(0, "")).unwrap();
    let (is_good, out, errors) = words_of(domain.python(ANEW).env("TAUT_SYSTEM", file.path()));
    assert!(is_good && out == "40\n40\n", "{out}{errors}");
    assert!(!errors.contains("threads of the system file"), "{errors}");
}

/// Without rights, and under a file for another machine, a node is refused, with the fix; that it is only measured is a choice.
#[test]
fn a_file_that_cannot_be_kept_to_here_is_refused() {
    let Some(domain) = Domain::new(96) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), wrong_file(0, "")).unwrap();
    // As root these rights are of the bounding set; any other user has the limits alone.
    let no_rights: &[&str] = match rustix::process::geteuid().is_root() {
        true => &[
            "setpriv",
            "--bounding-set=-sys_nice,-ipc_lock",
            "--inh-caps=-sys_nice,-ipc_lock",
            "prlimit",
            "--rtprio=0:0",
            "--memlock=0:0",
        ],
        false => &["prlimit", "--rtprio=0:0", "--memlock=0:0"],
    };
    let (is_good, out, errors) = words_of(&mut wrong(&domain, "one", file.path(), "required", no_rights));
    assert!(!is_good && out.is_empty(), "{out}{errors}");
    for part in ["thread 'cb:all' of TAUT_SYSTEM:", "setcap cap_sys_nice", "TAUT_REALTIME=off only measures"]
    {
        assert!(errors.contains(part), "{part}: {errors}");
    }
    let (is_good, out, errors) = words_of(&mut wrong(&domain, "one", file.path(), "off", no_rights));
    assert!(is_good && out.trim() == "False", "{out}{errors}");
    if !may_be_realtime() {
        return;
    }
    std::fs::write(file.path(), wrong_file(500, "")).unwrap();
    let (is_good, out, errors) = words_of(&mut wrong(&domain, "one", file.path(), "required", &[]));
    assert!(!is_good && out.is_empty(), "{out}{errors}");
    assert!(errors.contains("core 500 does not exist here: choose from"), "{errors}");
}

/// Waits for words, subscribes to `/work` of a depth of 1, and lives until its input ends.
const ADMITTED: &str = r#"
import os, rclpy, sys
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node(sys.argv[1])
qos = QoSProfile(depth=1, reliability=ReliabilityPolicy[os.environ.get("OFFERS", "RELIABLE")])
subscriptions = [node.create_subscription(String, topic, lambda m: None, qos) for topic in ("/work", "/unlisted")]
print("runs", flush=True)
sys.stdin.read()
"#;

/// Load is checked beside what runs, as that of Tautline's own nodes; what the file says of queues is set, and what it lacks is named.
#[test]
fn load_of_unchanged_nodes_is_admitted_or_refused() {
    let Some(domain) = Domain::new(90).filter(|_| may_be_realtime()) else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, wcet_ms: u32, priority: u8, more: &str| {
        let path = folder.path().join(format!("{name}.toml"));
        let text = format!(
            "[hosts.here]\ncores = 1\nsampler_priority = 90\n[overheads]\nrclpy = \"1us\"\n[nodes.{name}]\nclient = \"rclpy\"\n[callbacks.{name}]\ntopic = \"/work\"\n\
             wcet = \"{wcet_ms}ms\"\npriority = {priority}\ndeadline = \"60ms\"\n[topics.\"/work\"]\nperiod = \"10ms\"\n{more}"
        );
        std::fs::write(&path, text).unwrap();
        path
    };
    let start_with = |path: &Path, name: &str, admission: &str, reliability: &str| {
        let said = tempfile::NamedTempFile::new().unwrap();
        let mut command = domain.python(ADMITTED);
        command
            .arg(name)
            .env("TAUT_SYSTEM", path)
            .env("TAUT_ADMISSION", admission)
            .env("OFFERS", reliability);
        let output = said.reopen().unwrap();
        command.stdin(Stdio::piped()).stdout(output.try_clone().unwrap()).stderr(output);
        let mut process = command.spawn().unwrap();
        let words = || std::fs::read_to_string(said.path()).unwrap();
        wait_until("the node to run or end", || {
            words().contains("runs\n") || process.try_wait().unwrap().is_some()
        });
        // Log lines come from a thread of their own.
        if words().contains("runs\n") {
            wait_until("its warnings", || words().contains("`topic = \"/unlisted\"`"));
        }
        let text = words();
        (process, text)
    };
    let start = |path: &Path, name: &str, admission: &str| start_with(path, name, admission, "RELIABLE");
    let end = |(mut process, text): (Child, String)| {
        drop(process.stdin.take());
        process.wait().unwrap();
        text
    };
    let first = file("first", 6, 40, "jitter = \"25ms\"\n");
    let second = file("second", 7, 50, "depth = \"auto\"\njitter = \"25ms\"\n");
    let running = start(&first, "first", "check");
    assert!(running.1.contains("`/work` has depth 1, but"), "{}", running.1);
    // 6 + 7 > 10: at the lower priority, `first` has no bound, or is late.
    let refused = end(start(&second, "second", "check"));
    for part in ["second.toml is not admitted to domain 90", "callback `first` of", "its deadline is 60ms"] {
        assert!(refused.contains(part), "{part}: {refused}");
    }
    let forced = end(start(&second, "second", "force"));
    assert!(forced.contains("runs by force") && forced.contains("runs\n"), "{forced}");
    assert!(!forced.contains("has depth 1, but"), "it was made deep enough: {forced}");
    let depth = forced.split_once("callback `second`: `/work` has depth ").unwrap().1;
    let (depth, said) = depth.split_once(", ").unwrap();
    assert!(
        depth.parse::<usize>().unwrap() > 1 && said.starts_with("as the system file says, not 1"),
        "{forced}"
    );
    // The same file is one system; a callback of it that runs already is load once more.
    let again = end(start(&first, "first", "check"));
    assert!(again.contains("callback 'first'") && again.contains("is not admitted"), "{again}");
    end(running);
    let mut measured = domain.python(ADMITTED);
    let measured = started(measured.arg("first").env("TAUT_SYSTEM", &first).env("TAUT_REALTIME", "off"));
    let alone = end(start(&second, "second", "check"));
    assert!(alone.contains("runs\n"), "what has ended, or is only measured, leaves its place: {alone}");
    end(measured);
    // A best-effort queue stays as the program made it.
    let best_effort = end(start_with(&second, "second", "check", "BEST_EFFORT"));
    assert!(best_effort.contains("has depth 1, but") && best_effort.contains("in the node"), "{best_effort}");
}

/// The first callback computes until it is demoted, the second was released before that one has ended; each tells its thread's policy.
const OVERRUNNING: &str = r#"
import os, rclpy, threading, time
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node, source, seen = rclpy.create_node("listener"), rclpy.create_node("source"), []
def is_fifo(): return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
def heard(message):
    seen.append(is_fifo())
    end = time.thread_time() + 5
    while message.data == "long" and is_fifo() and time.thread_time() < end: pass
    seen.append(is_fifo())
    started = []
    thread = threading.Thread(target=lambda: started.append(is_fifo()))
    thread.start()
    thread.join()
    seen.append(started[0])
subscription = node.create_subscription(String, "/work", heard, 10)
publisher = source.create_publisher(String, "/work", 10)
while publisher.get_subscription_count() < 1: pass
executor = SingleThreadedExecutor()
executor.add_node(node)
for text in ("long", "waited", "later"):
    # A wait ends the callback before.
    if text == "later": executor.spin_once(timeout_sec=0)
    publisher.publish(String(data=text))
    count = len(seen)
    while len(seen) == count: executor.spin_once()
print(seen)
rclpy.shutdown()
"#;

/// A callback that uses more than its budget is demoted until its executor waits again.
#[test]
fn an_unchanged_callback_is_held_to_its_budget() {
    let Some(domain) = Domain::new(91).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let run = |overrun: &str| {
        let text = format!(
            "[hosts.here]\ncores = 1\nsampler_priority = 90\n[overheads]\nrclpy = \"20ms\"\n[nodes.listener]\nclient = \"rclpy\"\n[callbacks.work]\n\
             topic = \"/work\"\nwcet = \"100ms\"\npriority = 40\noverrun = \"{overrun}\"\n[topics.\"/work\"]\nperiod = \"1s\"\n"
        );
        std::fs::write(file.path(), text).unwrap();
        let (_, out, errors) = words_of(domain.python(OVERRUNNING).env("TAUT_SYSTEM", file.path()));
        [out, errors]
    };
    let [seen, errors] = run("demote");
    assert_eq!(seen.trim(), "[True, False, False, False, False, False, True, True, False]", "{errors}");
    let [seen, errors] = run("tell");
    assert_eq!(seen.trim(), "[True, True, False, True, True, False, True, True, False]", "{errors}");
    let [_, errors] = run("suspend");
    assert!(errors.contains("say \"demote\" or \"tell\""), "{errors}");
}

/// Timers of rclpy: one tells of itself by what it publishes, another shares its topic with a subscription's callback.
const TICKING: &str = r#"
import rclpy, sys, threading
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("ticker")
ticked, shared = node.create_publisher(String, "/ticked", 10), node.create_publisher(String, "/shared", 10)
subscription = node.create_subscription(String, "/ticked", lambda message: shared.publish(message), 10)
timers = [node.create_timer(0.02, lambda to=to: to.publish(String(data="tick"))) for to in (ticked, shared)]
executor = SingleThreadedExecutor()
executor.add_node(node)
def spin():
    try: executor.spin()
    except ExternalShutdownException: pass
thread = threading.Thread(target=spin)
thread.start()
print("runs", flush=True)
sys.stdin.read()
rclpy.shutdown()
thread.join()
"#;

/// An RMW sees of a timer what it publishes; that its response time is not known is said.
#[test]
fn timers_are_reported_by_what_they_publish() {
    let Some(domain) = seen(93) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let run = |period: &str, jobs: u64| {
        let text = format!(
            "[hosts.here]\ncores = 1\n[overheads]\nrclpy = \"1us\"\n[nodes.ticker]\nclient = \"rclpy\"\n[groups.all]\norder = \"any\"\n\
             [callbacks.tick]\nperiod = \"{period}\"\npublishes = [\"/ticked\"]\ngroup = \"all\"\nwcet = \"1ms\"\n\
             [callbacks.shared]\nperiod = \"{period}\"\npublishes = [\"/shared\"]\ngroup = \"all\"\nwcet = \"1ms\"\n\
             [callbacks.hear]\ntopic = \"/ticked\"\npublishes = [\"/shared\"]\ngroup = \"all\"\nwcet = \"1ms\"\n"
        );
        std::fs::write(file.path(), text).unwrap();
        let mut command = domain.python(TICKING);
        let (process, _) = started(command.env("TAUT_SYSTEM", file.path()).env("TAUT_REALTIME", "off"));
        let (mut report, mut row) = (Value::Null, Value::Null);
        wait_until("publications", || {
            report = self::report(&domain);
            row = report["callbacks"][0].clone();
            row["measured"]["jobs"].as_u64() >= Some(jobs)
        });
        let table = taut(&domain, &["report"]);
        end(process);
        (report, row, table)
    };
    let (report, row, table) = run("20ms", 20);
    let measured = &row["measured"];
    let of = |name: &str| measured[name].as_f64().unwrap();
    assert_eq!((&row["name"], &measured["by_publications"]), (&json!("tick"), &json!(true)), "{report}");
    assert_eq!(
        (&measured["response_ms"]["n"], &measured["execution_ms"]["n"]),
        (&json!(0), &json!(0)),
        "{report}"
    );
    assert!(of("least_distance_ms") <= of("mean_distance_ms"), "{report}");
    assert!(of("mean_distance_ms") <= of("greatest_distance_ms"), "{report}");
    // Each period has a publication or is missed.
    let periods = of("mean_distance_ms") * (of("jobs") - 1.0) / 20.0;
    assert!((periods - (of("jobs") - 1.0 + of("lost"))).abs() <= 1.0, "{report}");
    let names: Vec<_> = report["callbacks"].as_array().unwrap().iter().map(|row| &row["name"]).collect();
    assert_eq!(names, ["tick", "hear"], "who publishes on /shared is not known: {report}");
    let told = table.split_whitespace().collect::<Vec<_>>().join(" ");
    for part in
        ["messages on /ticked", "of a period of 20 ms", "its response times are not known", "not: shared"]
    {
        assert!(told.contains(part), "{part}: {told}");
    }
    // Twice as slow as the file says, and four times as fast.
    let missed = run("10ms", 20).1["violations"].to_string();
    assert!(missed.contains("releases missed") && missed.contains("published on /ticked"), "{missed}");
    let faster = run("80ms", 40).1["violations"].to_string();
    assert!(faster.contains("period not kept"), "{faster}");
}

/// Callbacks and a timer of one executor that use up a known time of their thread; prints all of the thread's and what they used.
const BUSY: &str = r#"
import rclpy, sys, time
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node, source, used = rclpy.create_node("listener"), rclpy.create_node("source"), {"callback": 0, "timer": 0}
def burn(whose, ms):
    start = time.thread_time_ns()
    while time.thread_time_ns() < start + ms * 1_000_000: pass
    used[whose] += time.thread_time_ns() - start
heard = []
def hear(message):
    heard.append(message)
    if sys.argv[1] != "empty": burn("callback", 1)
subscription = node.create_subscription(String, "/busy", hear, 1000)
publisher = source.create_publisher(String, "/busy", 1000)
while publisher.get_subscription_count() < 1: pass
for _ in range(200): publisher.publish(String(data="some"))
if sys.argv[1] == "timer": timer = node.create_timer(0.01, lambda: burn("timer", 2))
executor = SingleThreadedExecutor()
executor.add_node(node)
start = time.thread_time_ns()
while len(heard) < 200: executor.spin_once()
print(time.thread_time_ns() - start, used["callback"], used["timer"], flush=True)
sys.stdin.read()
"#;

/// What an executor uses and what its callbacks use is all that its thread uses, with no timer among it.
#[test]
fn overheads_of_executors_are_measured() {
    let Some(domain) = seen(92) else { return };
    let run = |what: &str, overheads: &str| -> (Vec<f64>, Value) {
        let (process, line) = started(domain.python(BUSY).arg(what).env("TAUT_OVERHEADS", overheads));
        let report = json_of(&domain, &["report", "--overheads", "--json"]);
        end(process);
        (line.split_whitespace().map(|ns| ns.parse::<f64>().unwrap() / 1e6).collect(), report)
    };
    for (what, overheads, kind) in
        [("empty", "empty", "empty"), ("busy", "on", "any"), ("timer", "on", "any")]
    {
        let (used, report) = run(what, overheads);
        let [thread, callbacks, timers] = used[..] else { panic!("{used:?}") };
        let row = &report["executors"][0];
        assert_eq!((&row["executor"], &row["callbacks"]), (&json!("rclpy"), &json!(kind)), "{report}");
        let of = |name: &str| row[name].as_f64().unwrap();
        let all = of("sum_ms") + of("callbacks_sum_ms");
        let told = format!("{used:?} ms, {report}");
        if what == "timer" {
            // Callbacks that a timer ran before are left out, with their overhead.
            assert!((1.0..199.0).contains(&of("n")) && timers > 0.0, "{told}");
            assert!(of("sum_ms") < thread - callbacks - timers, "{told}");
        } else {
            // The last one has not ended.
            assert_eq!(of("n"), 199.0, "{told}");
            assert!((0.7 * thread..=thread).contains(&all), "{told}");
            assert!(of("callbacks_sum_ms") >= callbacks * 198.0 / 200.0, "{told}");
        }
        assert!(of("p50_us") <= of("p99_us") && of("p99_us") <= 1.01 * of("max_us"), "{told}");
        let line = report["overheads"]["rclpy"].as_str().and_then(|text| text.strip_suffix("us"));
        let line: f64 = line.unwrap().parse().unwrap();
        assert!((1.2 * of("max_us")..1.2 * of("max_us") + 1.1).contains(&line), "{told}");
    }
    let nothing = Command::new(built("taut", "taut").unwrap())
        .args(["report", "--overheads", "--domain", &domain.number.to_string()])
        .env("TAUT_SCOPE", support::scope())
        .output()
        .unwrap();
    assert_eq!(nothing.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&nothing.stderr).contains("with TAUT_OVERHEADS=on"), "{nothing:?}");
}

/// A timer and a callback that sleep, for which they use no processor time.
const ASLEEP: &str = r#"
import rclpy, sys, threading, time
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("sleeper")
publisher, again = [node.create_publisher(String, topic, 10) for topic in ("/tick", "/tock")]
def hear(message):
    if not heard: print("runs", flush=True)
    heard.append(message)
    time.sleep(0.05)
heard, subscription = [], node.create_subscription(String, "/tick", hear, 10)
def tick():
    for to in publisher, again: to.publish(String(data="tick"))
timer = node.create_timer(0.1, tick)
executor = SingleThreadedExecutor()
executor.add_node(node)
def spin():
    try: executor.spin()
    except ExternalShutdownException: pass
thread = threading.Thread(target=spin)
thread.start()
sys.stdin.read()
rclpy.shutdown()
thread.join()
"#;

/// `taut init` takes the processor time of callbacks and of their executor, and knows timers by what they publish; what a killed process recorded
/// does not run.
#[test]
fn unchanged_nodes_become_a_file_with_their_timers() {
    let Some(domain) = seen(87) else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("system.toml");
    let (mut killed, _) = started(domain.python(ASLEEP).env("TAUT_TRACE", "on"));
    killed.kill().unwrap();
    killed.wait().unwrap();
    let (process, _) = started(domain.python(ASLEEP).env("TAUT_OVERHEADS", "on"));
    let said = taut(&domain, &["init", "--from-running", "--seconds", "2", file.to_str().unwrap()]);
    end(process);
    let text = std::fs::read_to_string(&file).unwrap_or_else(|error| panic!("{error}: {said}"));
    let mut check = Command::new(built("taut", "taut").unwrap());
    let (_, checked, errors) = words_of(check.arg("check").arg(&file).arg("--json"));
    let checked: Value =
        serde_json::from_str(&checked).unwrap_or_else(|error| panic!("{error}: {errors}{text}"));
    let callbacks = checked["callbacks"].as_array().unwrap();
    assert_eq!(callbacks.len(), 2, "{text}");
    for callback in callbacks {
        let of = |name: &str| callback[name].as_f64().unwrap();
        assert!((90.0..110.0).contains(&of("period_ms")) && of("wcet_ms") < 50.0, "{text}");
    }
    for part in [
        "publishes = [\"/tick\", \"/tock\"]",
        "# guess: a timer",
        "# guess: the longest processor time of ",
        "\nrclpy = \"",
        " callbacks, and 20 % more",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

/// A callback whose messages wait for 50 ms before its thread takes them: the first three before it waits at all.
const LATE: &str = r#"
import rclpy, sys, time
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
rclpy.init()
node, source, heard = rclpy.create_node("listener"), rclpy.create_node("source"), []
subscription = node.create_subscription(String, "/late", heard.append, 10)
publisher = source.create_publisher(String, "/late", 10)
while publisher.get_subscription_count() < 1: pass
executor = SingleThreadedExecutor()
executor.add_node(node)
for count in 3, 1:
    for _ in range(count): publisher.publish(String(data="some"))
    time.sleep(0.05)
    heard.clear()
    while len(heard) < count: executor.spin_once()
    executor.spin_once(timeout_sec=0)
print("heard", flush=True)
sys.stdin.read()
"#;

/// Of a response beyond its bound it is known how long the job was without the core. What was there before the executor spins is no job.
#[test]
fn core_time_of_late_callbacks_is_accounted_for() {
    let Some(domain) = seen(98).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let text = "[hosts.here]\ncores = 1\n[overheads]\nrclpy = \"1ms\"\n[nodes.listener]\nclient = \"rclpy\"\n[topics]\n\"/late\" = { period = \"1s\" }\n\
                [callbacks]\nhear = { topic = \"/late\", wcet = \"1ms\", priority = 10 }\n";
    std::fs::write(file.path(), text).unwrap();
    let run = |value: &str| {
        let mut command = domain.python(LATE);
        command.env("TAUT_SYSTEM", file.path()).env("TAUT_CORE_TIME", value);
        started(&mut command)
    };
    let end = |process: Child| {
        let measured = report(&domain)["callbacks"][0]["measured"].clone();
        end(process);
        measured
    };
    let measured = end(run("on").0);
    let of = |name: &str| measured["host"][name].as_f64().unwrap_or_else(|| panic!("{name}: {measured}"));
    let seen = [&measured["jobs"], &measured["max_queue"], &measured["host"]["beyond"]];
    assert_eq!(seen, [1; 3].map(|one| json!(one)).each_ref(), "{measured}");
    assert!(of("longest_ms") >= 50.0 && of("waited_ms") >= 40.0, "{measured}");
    let measured = end(run("off").0);
    assert_eq!(measured["host"], Value::Null, "{measured}");
    let (mut process, line) = run("1");
    assert!(line.is_empty() && !process.wait().unwrap().success(), "a switch is on or off: {line}");
}

/// A node that republishes what it hears, or publishes by a timer.
const OF_TEN: &str = r#"
import os, rclpy, sys, threading
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
name, heard, published = sys.argv[1:]
rclpy.init()
node = rclpy.create_node(name)
publisher = node.create_publisher(String, published, 10) if published else None
def pass_on(message):
    if publisher: publisher.publish(message)
subscriptions = [node.create_subscription(String, topic, pass_on, 1) for topic in heard.split()]
print("runs", flush=True)
def end():
    sys.stdin.read()
    os._exit(0)
threading.Thread(target=end, daemon=True).start()
executor = SingleThreadedExecutor()
executor.add_node(node)
if not heard:
    while publisher.get_subscription_count() < 1: pass
    # The thread is the file's from its first wait on.
    executor.spin_once(timeout_sec=0)
    timer = node.create_timer(0.25, lambda: pass_on(String(data="some")))
executor.spin()
"#;

/// Ten unchanged nodes of rclpy, each in its own process, keep what `taut check` says of them. What the host took may explain the rest. The file
/// allows 12 ms of processor time: callbacks were seen to use 7 to 10 ms where a virtual machine lost its core and counted no steal.
#[test]
fn a_graph_of_ten_nodes_keeps_its_bounds() {
    let Some(domain) = seen(97).filter(|_| may_be_realtime()) else { return };
    const NODES: [(&str, &str, &str); 10] = [
        ("logger", "/planned /braked", ""),
        ("actuator", "/planned", ""),
        ("planner", "/tracked", "/planned"),
        ("brake", "/near", "/braked"),
        ("tracker", "/detected", "/tracked"),
        ("detector", "/filtered", "/detected"),
        ("filter", "/image", "/filtered"),
        ("near_check", "/scan", "/near"),
        ("camera", "", "/image"),
        ("lidar", "", "/scan"),
    ];
    let quoted =
        |topics: &str| topics.split(' ').map(|topic| format!("{topic:?}")).collect::<Vec<_>>().join(", ");
    let mut text = "[hosts.here]\ncores = [0]\nsampler_priority = 90\n[overheads]\nrclpy = \"5ms\"\ncontext_switch = \"50us\"\nper_message = \"100us\"\n"
        .to_owned();
    for (index, (node, heard, published)) in NODES.iter().enumerate() {
        let priority = 60 + index;
        let trigger = match *heard {
            "" => "period = \"250ms\"".to_owned(),
            topics => format!("topic = [{}]", quoted(topics)),
        };
        let publishes =
            if published.is_empty() { String::new() } else { format!("publishes = [{published:?}]\n") };
        text += &format!(
            "[nodes.{node}]\nclient = \"rclpy\"\n[callbacks.{node}]\nnode = \"{node}\"\n{trigger}\n{publishes}wcet = \"12ms\"\npriority = {priority}\n"
        );
        for topic in heard.split_whitespace() {
            if !text.contains(&format!("[topics.{topic:?}]")) {
                text += &format!("[topics.{topic:?}]\ndepth = \"auto\"\n");
            }
        }
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    let steal_before = tautline_rt::host::steal_ticks(None);
    let start = |(node, heard, published): (&str, &str, &str)| {
        let mut command = domain.python(OF_TEN);
        command.args([node, heard, published]).env("TAUT_SYSTEM", file.path());
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap()
    };
    // Who publishes comes last.
    let (heard, sources): (Vec<_>, Vec<_>) = NODES.into_iter().partition(|of| !of.1.is_empty());
    let mut processes: Vec<Child> = heard.into_iter().map(start).collect();
    for process in &mut processes {
        let mut line = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert_eq!(line.trim(), "runs");
    }
    processes.extend(sources.into_iter().map(start));
    let mut report = Value::Null;
    wait_until("20 jobs of each", || {
        report = self::report(&domain);
        let rows = report["callbacks"].as_array().unwrap();
        rows.len() == NODES.len() && rows.iter().all(|row| row["measured"]["jobs"].as_u64() >= Some(20))
    });
    eprintln!("{}", taut(&domain, &["report"]));
    let steal_ms = 10.0 * (tautline_rt::host::steal_ticks(None) - steal_before) as f64;
    processes.into_iter().for_each(end);
    assert_eq!(report["realtime"], true, "{report}");
    for row in report["callbacks"].as_array().unwrap() {
        assert_eq!(row["measured"]["lost"], 0, "{row}");
        let of = |side: &str, name: &str| row[side][name].as_f64().unwrap_or(0.0);
        let (bound_ms, period_ms) = (of("predicted", "response_ms"), of("predicted", "period_ms"));
        assert!(bound_ms > 0.0, "it has a bound: {row}");
        // Of a timer only its publications are seen, each at most a response after its release.
        let is_timer = row["measured"]["by_publications"] == true;
        let longest_ms = match is_timer {
            true => of("measured", "greatest_distance_ms") - period_ms,
            false => row["measured"]["response_ms"]["max"].as_f64().unwrap(),
        };
        let least_ms = of("predicted", "least_distance_ms") - if is_timer { bound_ms } else { 0.0 };
        for violation in row["violations"].as_array().unwrap() {
            let is_of_host = match violation["name"].as_str().unwrap() {
                "bound exceeded" | "deadline missed" => longest_ms <= bound_ms + steal_ms,
                "period not kept" => of("measured", "least_distance_ms") >= least_ms - steal_ms,
                _ => false,
            };
            assert!(is_of_host, "{steal_ms} ms of steal; {row}");
        }
    }
    assert_eq!(report["unknown"], json!([]), "{report}");
}

/// One file and one table for a chain over two nodes of rclpy and one of Tautline between them.
#[test]
fn a_chain_over_nodes_of_rclpy_and_tautline_is_measured() {
    let Some(domain) = seen(195) else { return };
    const STAGES: [(&str, &str, &str, &str); 3] = [
        ("detect", "rclpy", "/image", "/detected"),
        ("track", "tautline", "/detected", "/tracked"),
        ("plan", "rclpy", "/tracked", "/planned"),
    ];
    let mut text = "[hosts.here]\ncores = 1\n[overheads]\nrclpy = \"1ms\"\n[topics.\"/image\"]\nperiod = \"1s\"\n[[chains]]\nname = \"through\"\n\
                    path = [\"detect\", \"track\", \"plan\"]\ndeadline = \"1s\"\n"
        .to_owned();
    for (name, client, heard, published) in STAGES {
        text += &format!(
            "[nodes.{name}]\nclient = \"{client}\"\n[callbacks.{name}]\nnode = \"{name}\"\ntopic = \"{heard}\"\npublishes = [\"{published}\"]\n\
             wcet = \"1ms\"\n"
        );
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), text).unwrap();
    let context = Context::builder().domain(domain.number).realtime(Realtime::Off).system(file.path());
    let context = context.build().unwrap();
    let mut node = Node::create(context.clone(), "track", "").unwrap();
    let mut detected = node.subscribe::<Text>("/detected", Qos::keep_last(10)).unwrap();
    let tracked = node.create_publisher::<Text>("/tracked", Qos::keep_last(10)).unwrap();
    let track = async move {
        while detected.next().await.is_some() {
            tracked.publish(&Text { data: "some".to_owned() }).unwrap();
        }
    };
    let _callback = node.spawn_callback(context.callback("track").unwrap(), track).unwrap();
    let sampler = context.clone();
    let sampler = std::thread::spawn(move || sampler.spin().unwrap());
    let start = |(name, _, heard, published): (&str, &str, &str, &str)| {
        let mut command = domain.python(OF_TEN);
        command.args([name, heard, published]).env("TAUT_SYSTEM", file.path()).env("TAUT_REALTIME", "off");
        started(&mut command).0
    };
    let processes = [STAGES[0], STAGES[2]].map(start);
    let image = publisher(&domain.participant, "/image", STRING, Qos::keep_last(10));
    matched(&image, 1);
    let mut report = Value::Null;
    wait_until("three jobs of each", || {
        image.publish(&text_body("some")).unwrap();
        report = self::report(&domain);
        let rows = report["callbacks"].as_array().unwrap();
        rows.iter().all(|row| row["measured"]["jobs"].as_u64() >= Some(3))
    });
    processes.into_iter().for_each(end);
    context.shutdown();
    sampler.join().unwrap();
    let of_python = |row: &Value| {
        let is_python = row["measured"]["process"].as_str().unwrap().starts_with("python");
        (row["name"].as_str().unwrap().to_owned(), is_python)
    };
    let rows: Vec<_> = report["callbacks"].as_array().unwrap().iter().map(of_python).collect();
    let expected = STAGES.map(|(name, client, ..)| (name.to_owned(), client == "rclpy"));
    assert_eq!(rows, expected, "{report}");
    let chain = &report["chains"][0];
    assert_eq!(
        (&chain["name"], &chain["callbacks"]),
        (&json!("through"), &json!(["detect", "track", "plan"]))
    );
    assert!(chain["longest_ms"].as_f64().unwrap() > 0.0 && chain["predicted_ms"].is_number(), "{report}");
}

/// Nothing was prepared: no system file, no trace.
#[test]
fn callbacks_of_any_node_of_rclpy_are_seen() {
    let Some(domain) = seen(80) else { return };
    let mut peer = domain.simple_peer("ordinary");
    let heard = peer.subscription("/heard", STRING, json!({}));
    let here = publisher(&domain.participant, "/heard", STRING, Qos::keep_last(10));
    matched(&here, 1);
    (0..3).for_each(|n: usize| here.publish(&text_body(&n.to_string())).unwrap());
    assert_eq!(peer.take_texts(heard, 3).len(), 3);
    let mut row = Value::Null;
    wait_until("3 jobs", || {
        let picture = json_of(&domain, &["top", "--once", "--json"]);
        let mut rows = picture["callbacks"].as_array().unwrap().iter();
        row = rows.find(|row| row["name"] == "/ordinary /heard").cloned().unwrap_or_default();
        row["jobs"] == 3
    });
    assert!(row["response_max_ms"].as_f64().unwrap() > 0.0, "{row}");
    assert_eq!(row["execution_max_ms"], Value::Null, "which would cost a system call: {row}");
    assert_eq!((&row["lost"], &row["bound_ms"]), (&json!(0), &Value::Null), "{row}");
}

#[test]
fn a_system_file_is_used_or_what_is_wrong_with_it_is_said() {
    let Some(domain) = Domain::new(67) else { return };
    let init = |variables: &[(&str, &str)]| {
        let mut command = domain.python("import rclpy; rclpy.init()");
        let (is_good, _, errors) =
            words_of(command.env("TAUT_REALTIME", "off").envs(variables.iter().copied()));
        (is_good, errors)
    };
    let file = tempfile::NamedTempFile::new().unwrap();
    let hosts = "[overheads]\nrclpy = \"1us\"\ncontext_switch = \"1us\"\n[hosts.a]\ncores = 1\n[hosts.b]\ncores = 1\n[nodes.n]\nclient = \"rclpy\"\nhost = \"a\"\n\
                 [callbacks.c]\nperiod = \"1s\"\nwcet = \"1ms\"\n";
    std::fs::write(file.path(), hosts).unwrap();
    let path = file.path().to_str().unwrap();
    let file = |path| ("TAUT_SYSTEM", path);
    // Nobody else is in the domain.
    assert_eq!(init(&[file(path), ("TAUT_HOST", "a")]), (true, String::new()));
    let (is_made, said) = init(&[file(path), ("TAUT_HOST", "b")]);
    assert!(is_made && said.contains("has no callback of host `b`"), "{said}");
    let refused = [
        (&[file("/nowhere/system.toml")][..], "TAUT_SYSTEM: `/nowhere/system.toml` cannot be read"),
        (&[file(path)], "has several hosts: set TAUT_HOST, or `ContextBuilder::host`, to one of a, b"),
        (
            &[file(path), ("TAUT_HOST", "a"), ("TAUT_REALTIME", "of")],
            "TAUT_REALTIME=of is not understood: it may be",
        ),
        (&[file(path), ("TAUT_HOST", "c")], "has no host 'c': set TAUT_HOST, or"),
        (&[("TAUT_REALTIME", "of")], "TAUT_REALTIME=of is not understood: it may be"),
        (&[("TAUT_ADMISSION", "chek")], "TAUT_ADMISSION=chek is not understood: it may be"),
    ];
    for (variables, why) in refused {
        let (is_made, said) = init(variables);
        assert!(!is_made && said.contains(why), "{said}");
    }
}

/// A timer that publishes and then works for longer than its period, so that its message waits with its next release; and a subscription as every
/// node of rclcpp has one.
const BUSY_TIMER: &str = r#"
import rclpy, sys, time
from rcl_interfaces.msg import ParameterEvent
from std_msgs.msg import String
rclpy.init()
node, heard, changes = rclpy.create_node("busy"), [], []
events = node.create_subscription(ParameterEvent, "/parameter_events", changes.append, 10)
node.declare_parameter("some", 1)
publisher = node.create_publisher(String, "/said", 10)
subscription = node.create_subscription(String, "/said", lambda message: heard.append(message.data), 10)
def work():
    publisher.publish(String(data="some"))
    end = time.thread_time() + 0.2
    while time.thread_time() < end: pass
timer = node.create_timer(0.1, work)
while len(heard) < 5 or not changes: rclpy.spin_once(node)
print("heard", flush=True)
sys.stdin.read()
rclpy.shutdown()
"#;

#[test]
fn a_timers_time_is_not_that_of_the_next_callback() {
    let Some(domain) = seen(86) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let text = "[hosts.here]\ncores = 1\n[nodes.busy]\nclient = \"rclpy\"\n[topics]\n\"/said\" = { period = \"1s\" }\n\
                [callbacks.hear]\ntopic = \"/said\"\nwcet = \"100ms\"\n";
    std::fs::write(file.path(), text).unwrap();
    let mut command = domain.python(BUSY_TIMER);
    let (mut process, line) = started(command.env("TAUT_SYSTEM", file.path()).env("TAUT_REALTIME", "off"));
    assert_eq!(line.trim(), "heard");
    let report = report(&domain);
    drop(process.stdin.take());
    assert!(process.wait().unwrap().success());
    // Processor time: 200 ms of the timer's, and next to nothing of its own.
    let used_ms = report["callbacks"][0]["measured"]["execution_ms"]["max"].as_f64().unwrap();
    assert!(used_ms < 100.0, "{report}");
    assert_eq!(report["unknown"], json!([]), "changes of parameters are in no file: {report}");
}

/// Prints each thread of a process that had a priority before it began, and whether it has one.
const FIFO: &str = r#"
import os, rclpy
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(5))
rclpy.init()
node = rclpy.create_node("fifo")
for thread in os.listdir("/proc/self/task"):
    name = open(f"/proc/self/task/{thread}/comm").read().strip()
    print(name, os.sched_getscheduler(int(thread)) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)
rclpy.shutdown()
"#;

#[test]
fn threads_that_only_help_are_ordinary_whoever_starts_them() {
    let Some(domain) = Domain::new(120).filter(|_| may_be_realtime()) else { return };
    let (is_good, out, errors) = words_of(&mut domain.python(FIFO));
    assert!(is_good && out.contains(" True"), "{out}{errors}");
    for thread in ["rmw_helper False", "rmw_log False"] {
        assert!(out.contains(thread), "{out}");
    }
}

/// Nodes under a system file, one of a child that the first one's thread has forked off.
const FORKED: &str = r#"
import os, rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
def governed(name):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node(name, context=context)
    subscription = node.create_subscription(String, "/" + name, lambda message: None, 1)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    executor.spin_once(timeout_sec=0)
    is_fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    print(name, is_fifo, os.sched_getparam(0).sched_priority, flush=True)
    return context, node, subscription, executor
first = governed("one")
child = os.fork()
if child == 0:
    second = governed("two")
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
rclpy.shutdown(context=first[0])
"#;

#[test]
fn a_thread_of_a_forked_child_is_governed_anew() {
    let Some(domain) = Domain::new(121).filter(|_| may_be_realtime()) else { return };
    let file = tempfile::NamedTempFile::new().unwrap();
    let callback = |name: &str, priority: u32| {
        format!(
            "[nodes.{name}]\nclient = \"rclpy\"\n[callbacks.{name}]\nnode = \"{name}\"\ntopic = \"/{name}\"\nwcet = \"1ms\"\npriority = {priority}\n\
             overrun = \"demote\"\n[topics.\"/{name}\"]\nperiod = \"1s\"\n"
        )
    };
    let head = "[hosts.here]\ncores = 1\nsampler_priority = 90\n[overheads]\nrclpy = \"1ms\"\n";
    std::fs::write(file.path(), [head, &callback("one", 40), &callback("two", 30)].concat()).unwrap();
    let (is_good, out, errors) = words_of(domain.python(FORKED).env("TAUT_SYSTEM", file.path()));
    assert!(is_good && out == "one True 40\ntwo True 30\n", "{out}{errors}");
}

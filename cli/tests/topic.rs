// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic` on types that `taut` was not built with, and on publishers that do not notice it.

mod support;

use serde_json::{Value, json};
use std::cell::Cell;
use std::os::unix::process::CommandExt;
use std::process::{Command, Output};
use std::sync::Arc;
use support::Running;
use support::schemas::Checked;
use tautline::{Context, Node, Qos, Realtime};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_schema::{DynamicMessage, Schema};
use tautline_transport::{Limits, Participant, RawPublisher, TopicType};

thread_local! {
    /// Each test has one of its own.
    static DOMAIN: Cell<u32> = const { Cell::new(0) };
}

fn enter(domain: u32) -> Participant {
    DOMAIN.set(domain);
    Participant::new(domain).unwrap()
}

fn command(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.args(args).env("TAUT_DOMAIN", DOMAIN.get().to_string());
    command
}

fn run(args: &[&str]) -> Output {
    command(args).checked()
}

/// What a command prints that succeeds.
fn taut(args: &[&str]) -> String {
    let output = run(args);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// The exit code and the words of one that does not.
fn refused(args: &[&str]) -> (i32, String) {
    let output = run(args);
    assert!(output.stdout.is_empty(), "{args:?}: {}", String::from_utf8_lossy(&output.stdout));
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

fn schema() -> Arc<Schema> {
    let name = "demo_msgs/msg/Echo".parse().unwrap();
    Schema::from_text(&name, "string word\nuint8[] numbers\nbuiltin_interfaces/Time stamp\n===\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n").unwrap().into()
}

fn publisher(participant: &Participant, topic: &str, qos: Qos) -> RawPublisher {
    let schema = schema();
    let topic_type = TopicType::new(schema.name().to_string())
        .with_hash(schema.hash().to_string())
        .with_definition(schema.to_text());
    participant.create_raw_publisher(topic, &topic_type, qos, Limits::default()).unwrap()
}

fn message(json: &Value) -> Vec<u8> {
    DynamicMessage::from_json_value(&schema(), json).unwrap().to_body()
}

#[test]
fn topics_are_listed_found_and_echoed() {
    let participant = enter(191);
    let publisher = publisher(&participant, "/echo", Qos::keep_last(2).transient_local());
    publisher.publish(&message(&json!({ "word": "a, \"b\"", "numbers": [] }))).unwrap();
    publisher
        .publish(&message(&json!({ "word": "taut", "numbers": [1, 2], "stamp": { "sec": 3 } })))
        .unwrap();
    let graph = participant.graph().unwrap();

    let list: Value = serde_json::from_str(&taut(&["topic", "list", "--json"])).unwrap();
    let expected = json!([{
        "topic": "/echo", "type": "demo_msgs/msg/Echo", "hash": schema().hash().to_string(), "publishers": 1, "subscriptions": 0,
        "remote_publishers": 0, "remote_subscriptions": 0, "places": [],
    }]);
    assert_eq!(list, expected);
    let table = taut(&["topic", "list"]);
    assert!(table.contains("/echo") && table.contains("demo_msgs/msg/Echo"), "{table}");
    assert_eq!(taut(&["topic", "type", "echo"]), "demo_msgs/msg/Echo\n");
    assert_eq!(taut(&["topic", "find", "demo_msgs/Echo"]), "/echo\n");
    assert_eq!(taut(&["topic", "find", "demo_msgs/msg/Echo", "--json"]), "[\"/echo\"]\n");

    let echo = |more: &[&str]| taut(&[&["topic", "echo", "/echo", "-n", "2"], more].concat());
    let last = "word: taut\nnumbers:\n- 1\n- 2\nstamp:\n  sec: 3\n  nanosec: 0\n---\n";
    assert!(echo(&[]).ends_with(last), "{}", echo(&[]));
    assert_eq!(echo(&["--csv"]), "\"a, \"\"b\"\"\",0,0\ntaut,1,2,3,0\n");
    assert_eq!(echo(&["--field", "stamp.sec"]), "0\n---\n3\n---\n");
    assert_eq!(echo(&["--field", "numbers", "--no-arr", "--json"]), "[]\n[1,2]\n");
    assert!(
        echo(&["--no-arr", "--no-str"])
            .contains("word: '<string length: <4>>'\nnumbers: '<sequence type: uint8, length: 2>'\nstamp:")
    );
    let one = |more: &[&str]| taut(&[&["topic", "echo", "echo", "--once"], more].concat());
    let of_taut = "{\"word\":\"taut\",\"numbers\":[1,2],\"stamp\":{\"sec\":3,\"nanosec\":0}}\n";
    assert_eq!(one(&["--filter", ".numbers | length == 2", "--json"]), of_taut);
    assert_eq!(one(&["--field", "numbers[1]", "--csv"]), "2\n", "the first that has one");
    let raw = one(&["--raw"]);
    assert!(raw.starts_with("00010000") && raw.ends_with('\n'), "{raw}");

    // Nobody has noticed.
    assert_eq!(
        (publisher.subscription_count(), &participant.graph().unwrap().endpoints),
        (0, &graph.endpoints)
    );
    let (code, words) = refused(&["topic", "echo", "/echo", "--filter", ".word >", "--once"]);
    assert!(code == 2 && words.contains("is not a jq program"), "{words}");
    let (code, words) = refused(&["topic", "echo", "/echo", "--field", "stamp.minute", "--once"]);
    assert!(code == 2 && words.contains("has no field `minute`, it has sec, nanosec"), "{words}");
    let (code, words) = refused(&["topic", "echo", "/none", "--once", "--timeout", "50ms"]);
    assert!(code == 1 && words.contains("waited for topic '/none' to exist"), "{words}");
    let (code, words) = refused(&["topic", "type", "/ecko"]);
    assert!(code == 1 && words.contains("did you mean /echo?"), "{words}");
    let (code, words) = refused(&["topic", "find", "demo_msgs/Ecko"]);
    assert!(code == 1 && words.contains("did you mean demo_msgs/msg/Echo?"), "{words}");
    assert_eq!(refused(&["topic", "hz", "/echo", "--timeout", "5 s"]).0, 2);
}

/// Sends at absolute times until told to stop. Gives the times before and after each publication.
fn flow(
    publisher: RawPublisher,
    hz: f64,
    body: Vec<u8>,
) -> (std::sync::mpsc::Sender<()>, std::thread::JoinHandle<Vec<[u64; 2]>>) {
    let (stop, stopped) = std::sync::mpsc::channel();
    let thread = std::thread::spawn(move || {
        let (start_ns, mut sent) = (monotonic_ns(), Vec::new());
        while stopped.try_recv().is_err() {
            sleep_until_monotonic(start_ns + (sent.len() as f64 * 1e9 / hz) as u64);
            let before_ns = monotonic_ns();
            publisher.publish(&body).unwrap();
            sent.push([before_ns, monotonic_ns()]);
        }
        sent
    });
    (stop, thread)
}

/// The least and the most Hz that so many messages in a row can have had between two looks; a machine that has no time lets them come late, and
/// then at once.
fn slowest_and_fastest(sent: &[[u64; 2]], messages: usize) -> [f64; 2] {
    let messages = messages.max(1);
    let longest = sent.windows(messages + 2).map(|sent| sent[messages + 1][1] - sent[0][0]).max();
    let shortest = sent.windows(messages).map(|sent| sent[messages - 1][0].saturating_sub(sent[0][1])).min();
    [messages as f64 / longest.unwrap_or(u64::MAX) as f64, (messages - 1) as f64 / shortest.unwrap() as f64]
        .map(|rate| rate * 1e9)
}

#[test]
fn rates_are_read_from_the_publishers_own_counts() {
    let participant = enter(95);
    let image = message(&json!({ "word": "x".repeat(8 << 20) }));
    for (topic, hz, body) in [
        ("/slow", 1.0, message(&json!({}))),
        ("/quick", 1000.0, message(&json!({}))),
        ("/fast", 50_000.0, message(&json!({}))),
        ("/image", 20.0, image),
    ] {
        let len_bytes = body.len() as f64;
        let limits = Limits { message_bytes: 9 << 20, ..Limits::default() };
        let topic_type = TopicType::new("demo_msgs/msg/Echo").with_hash(schema().hash().to_string());
        let publisher =
            participant.create_raw_publisher(topic, &topic_type, Qos::keep_last(2), limits).unwrap();
        let (stop, thread) = flow(publisher, hz, body);
        let mut rates = Vec::new();
        for take in [false, true] {
            // Who takes gets as much as its queue holds.
            if take && hz > 100.0 {
                continue;
            }
            let more: &[&str] = if take { &["--take"] } else { &[] };
            let time = if hz < 10.0 { "3500ms" } else { "1500ms" };
            let args = [&["topic", "hz", topic, "--json", "--every", "1s", "--timeout", time], more].concat();
            let lines = taut(&args);
            let report: Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
            let publisher = &report["publishers"][0];
            let messages = publisher["messages"].as_u64().unwrap() as usize;
            let lost = publisher["lost"].as_u64();
            assert_eq!(lost.is_some(), take, "{report}");
            rates.push((report["rate_hz"].as_f64().unwrap(), messages, lost.unwrap_or(0) as usize));
            assert_eq!(report["from"], json!(if take { "messages" } else { "counts" }));
            assert_eq!(publisher["mean_bytes"].as_f64(), Some(len_bytes), "{report}");
            // Messages that are faster come between two looks.
            assert!(publisher["period_ms"].is_null() || hz <= 1000.0, "{report}");
            assert!(publisher["period_ms"].is_object() || hz > 10.0, "{report}");
        }
        stop.send(()).unwrap();
        let sent = thread.join().unwrap();
        for (rate_hz, messages, lost) in rates {
            assert!(messages + lost <= sent.len(), "{topic}: {messages} messages and {lost} lost");
            let [least_hz, most_hz] = slowest_and_fastest(&sent, messages);
            // A rate is of so many messages, or of the time from the first to the last of them.
            let possible =
                least_hz * 0.99..most_hz.max(slowest_and_fastest(&sent, messages - 1)[1]).max(hz) * 1.01;
            assert!(
                possible.contains(&rate_hz),
                "{topic}: {rate_hz} Hz of {messages} messages, not of {possible:?}"
            );
        }
    }
}

#[test]
fn what_was_expected_decides_the_exit_code() {
    let participant = enter(96);
    let (stop, thread) =
        flow(publisher(&participant, "/flow", Qos::keep_last(2)), 100.0, message(&json!({})));
    let expect = |verb, range| run(&["topic", verb, "/flow", "--expect", range, "--timeout", "1s"]);
    assert_eq!(expect("hz", "1..1000").status.code(), Some(0));
    assert_eq!(expect("bw", "..1e6").status.code(), Some(0));
    let output = expect("hz", "..1");
    assert_eq!(output.status.code(), Some(1));
    let words = String::from_utf8(output.stderr).unwrap();
    assert!(words.contains("messages a second, which is not within 0..1"), "{words}");
    assert_eq!(run(&["topic", "delay", "/flow", "--max", "1ns", "--timeout", "1s"]).status.code(), Some(1));
    let delay = taut(&["topic", "delay", "/flow", "--max", "1h", "--timeout", "1s", "--json"]);
    let report: Value = serde_json::from_str(delay.lines().last().unwrap()).unwrap();
    let ages = &report["publishers"][0];
    assert!(ages["messages"].as_u64() > Some(10), "{report}");
    assert!(ages["publish_to_take_ms"]["max"].as_f64() > Some(0.0), "{report}");
    assert!(ages["stamp_to_publish_ms"]["p50"].as_f64() > Some(3e6), "an hour and more: {report}");
    stop.send(()).unwrap();
    thread.join().unwrap();
    // Nor is nothing what was expected.
    let (code, words) = refused(&["topic", "hz", "/none", "--expect", "1.."]);
    assert!(code == 1 && words.contains("waited for topic '/none' to exist in domain 96 for 5s"), "{words}");
    let _silent = self::publisher(&participant, "/silent", Qos::default());
    let (code, words) = refused(&["topic", "delay", "/silent", "--max", "1h", "--timeout", "100ms"]);
    assert!(code == 1 && words.contains("no message came on '/silent'"), "{words}");
}

/// As of nodes that were built with different definitions.
#[test]
fn publishers_of_another_type_are_named() {
    let participant = enter(62);
    let qos = Qos::keep_last(1).transient_local();
    let echo = publisher(&participant, "/mixed", qos);
    echo.publish(&message(&json!({}))).unwrap();
    let mut hash = schema().hash().to_string();
    let last = hash.pop();
    hash.push(if last == Some('0') { '1' } else { '0' });
    let other = TopicType::new(schema().name().to_string()).with_hash(hash);
    for (topic_type, why) in [
        (TopicType::new("std_msgs/msg/String"), "publishes is left out: its type is "),
        (other, "publishes is left out: its definition of demo_msgs/msg/Echo is another one"),
    ] {
        let _other = participant.create_raw_publisher("/mixed", &topic_type, qos, Limits::default()).unwrap();
        for verb in [&["delay"][..], &["echo", "--raw"], &["hz", "--take"]] {
            let args = [&["topic", verb[0], "/mixed", "--timeout", "100ms"], &verb[1..]].concat();
            let errors = String::from_utf8(run(&args).stderr).unwrap();
            assert_eq!(errors.matches(why).count(), 1, "{verb:?}: {errors}");
        }
    }
}

/// As if its process had been restarted.
#[test]
fn the_rate_of_a_publisher_that_has_ended_is_not_added_to_that_of_the_next() {
    let participant = enter(61);
    let sources: [&[&str]; 2] = [&[], &["--take"]];
    for more in sources {
        let start = || {
            let publisher = publisher(&participant, "/flow", Qos::keep_last(2));
            flow(publisher, 100.0, message(&json!({})))
        };
        let (stop, thread) = start();
        let args = [&["topic", "hz", "/flow", "--json", "--every", "20ms"], more].concat();
        let mut hz = Running::start(&mut command(&args));
        let mut publishers = || serde_json::from_str::<Value>(&hz.line()).unwrap()["publishers"].take();
        let mut find = |is_it: &dyn Fn(&Value) -> bool| (0..500).map(|_| publishers()).find(is_it);
        let first = find(&|now| now[0]["messages"].as_u64() > Some(0)).unwrap();
        stop.send(()).unwrap();
        thread.join().unwrap();
        let (stop, thread) = start();
        let is_next = |now: &Value| now.as_array().unwrap().len() == 1 && now[0]["gid"] != first[0]["gid"];
        assert!(find(&is_next).is_some(), "{more:?}: the first one is still there");
        hz.interrupt();
        assert_eq!(hz.end().0, 0);
        stop.send(()).unwrap();
        thread.join().unwrap();
    }
}

/// A sensor's driver offers best effort, and may start after its consumers.
#[test]
fn delays_are_also_those_of_a_publisher_that_comes_later() {
    let participant = enter(71);
    let topic_type = TopicType::new(schema().name().to_string()).with_hash(schema().hash().to_string());
    let qos = Qos::keep_last(5).best_effort();
    let _consumer =
        participant.create_raw_subscription("/scan", &topic_type, qos, Limits::default()).unwrap();
    let mut delay = Running::start(&mut command(&["topic", "delay", "/scan", "--json", "--every", "20ms"]));
    let mut next = || serde_json::from_str::<Value>(&delay.line()).unwrap()["publishers"].take();
    assert_eq!(next(), json!([]), "it has subscribed");
    let publisher = publisher(&participant, "/scan", qos);
    let is_taken = (0..500).any(|_| {
        publisher.publish(&message(&json!({ "stamp": { "sec": i32::MAX } }))).unwrap();
        next()[0]["messages"].as_u64() > Some(0)
    });
    assert!(is_taken, "its messages are not taken");
    delay.interrupt();
    assert_eq!(delay.end().0, 0);
}

/// A sensor whose clock is ahead.
#[test]
fn stamps_without_an_age_are_counted() {
    let participant = enter(73);
    let body = message(&json!({ "stamp": { "sec": i32::MAX } }));
    let (stop, thread) = flow(publisher(&participant, "/ahead", Qos::keep_last(2)), 100.0, body);
    let table = taut(&["topic", "delay", "/ahead", "--timeout", "1s"]);
    assert!(table.contains(" stamps are later than the publication"), "{table}");
    stop.send(()).unwrap();
    thread.join().unwrap();
}

#[test]
fn a_verb_ends_in_time_however_fast_messages_come() {
    let participant = enter(139);
    let publisher = publisher(&participant, "/fast", Qos::keep_last(100));
    let (stop, thread) = flow(publisher, 1e9, message(&json!({})));
    for verb in
        [&["echo", "/fast"][..], &["echo", "/fast", "--raw"], &["delay", "/fast"], &["hz", "/fast", "--take"]]
    {
        taut(&[&["topic"], verb, &["--timeout", "300ms"]].concat());
    }
    let mut echo = command(&["topic", "echo", "/fast", "--filter", "true"]);
    let mut echo = Running::start(echo.process_group(0));
    echo.line();
    echo.interrupt_group();
    let (code, _, words) = echo.end();
    assert!(code == 0 && !words.contains("ended by itself"), "{words}");
    stop.send(()).unwrap();
    thread.join().unwrap();
}

/// Publishes `/clock`, twenty times as fast as the system's, until told to stop.
fn simulate(participant: &Participant) -> (std::sync::mpsc::Sender<()>, std::thread::JoinHandle<()>) {
    let topic_type = TopicType::new("rosgraph_msgs/msg/Clock");
    let publisher = participant
        .create_raw_publisher("/clock", &topic_type, Qos::keep_last(1), Limits::default())
        .unwrap();
    let (stop, stopped) = std::sync::mpsc::channel();
    let thread = std::thread::spawn(move || {
        let start_ns = monotonic_ns();
        for n in 0u64.. {
            if stopped.try_recv().is_ok() {
                return;
            }
            sleep_until_monotonic(start_ns + n * 10_000_000);
            let sim_ns = 20 * (monotonic_ns() - start_ns);
            let (sec, nanosec) = ((sim_ns / 1_000_000_000) as u32, (sim_ns % 1_000_000_000) as u32);
            publisher.publish(&[sec.to_le_bytes(), nanosec.to_le_bytes()].concat()).unwrap();
        }
    });
    (stop, thread)
}

#[test]
fn rates_and_delays_are_by_simulated_time() {
    let participant = enter(216);
    let stamped = message(&json!({ "stamp": { "sec": 0 } }));
    let (stop, thread) = flow(publisher(&participant, "/flow", Qos::keep_last(2)), 100.0, stamped);
    let (stop_clock, clock) = simulate(&participant);
    let verbs: [&[&str]; 7] = [
        &["hz"],
        &["hz", "--take"],
        &["delay"],
        &["hz", "--sim-time"],
        &["hz", "--sim-time", "--take"],
        &["bw", "--sim-time"],
        &["delay", "--sim-time"],
    ];
    let start = |verb: &&[&str]| {
        let args = [&["topic", verb[0], "/flow"], &verb[1..], &["--json", "--timeout", "4s"]].concat();
        Running::start(&mut command(&args))
    };
    let reports = verbs.each_ref().map(start).map(|verb| {
        let (_, lines, words) = verb.end();
        let line: Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
        assert_eq!(
            words.contains("--sim-time counts by /clock"),
            line["sim_time"] == json!(false),
            "{words}"
        );
        line
    });
    let [hz, hz_taken, delay, sim_hz, sim_hz_taken, sim_bw, sim_delay] = reports;
    let number = |report: &Value, key: &str| report[key].as_f64().unwrap();
    for (by_system, by_clock) in [(hz, &sim_hz), (hz_taken, &sim_hz_taken)] {
        assert!(number(&by_system, "rate_hz") > 20.0, "{by_system}");
        assert!((1.0..10.0).contains(&number(by_clock, "rate_hz")), "{by_clock}");
    }
    assert!(number(&sim_bw, "bytes_per_s") < 10.0 * 50.0, "{sim_bw}");
    // The stamp is 0, so the age is the simulated time.
    let age = |report: &Value| report["publishers"][0]["stamp_to_publish_ms"]["max"].as_f64().unwrap();
    assert!((1e3..600e3).contains(&age(&sim_delay)), "{sim_delay}");
    assert!(age(&delay) > 3.5e6, "an hour, the maximum: {delay}");
    stop.send(()).unwrap();
    stop_clock.send(()).unwrap();
    thread.join().unwrap();
    clock.join().unwrap();
}

#[test]
fn messages_are_published_by_hand() {
    let participant = enter(97);
    let mut echo = Running::start(&mut command(&["topic", "echo", "/hand", "--json"]));
    // It is there once somebody publishes; what was kept comes, too. Nobody waits for an observer, so this message shows that it is there.
    let topic_type = TopicType::new("geometry_msgs/msg/PointStamped");
    let (qos, limits) = (Qos::default().transient_local(), Limits::default());
    let kept = participant.create_raw_publisher("/hand", &topic_type, qos, limits).unwrap();
    // A stamp and a frame of zeros, and a point.
    kept.publish(&[&[0; 8][..], &[1, 0, 0, 0, 0, 0, 0, 0], &[0; 24]].concat()).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&echo.line()).unwrap()["point"]["x"], json!(0.0));
    let args = ["--qos-durability", "transient_local", "-n", "3", "-r", "100", "--stamp", "now"];
    let values = "{point: {x: 1.5}}";
    let publishing = Running::start(&mut command(
        &[&["topic", "pub", "/hand", "geometry_msgs/msg/PointStamped", values, "--wait", "1"], &args[..]]
            .concat(),
    ));
    // An observer is no subscription that somebody waits for.
    let subscription =
        participant.create_raw_subscription("/hand", &topic_type, Qos::default(), limits).unwrap();
    let (code, _, words) = publishing.end();
    assert!(code == 0 && words.contains("published 3 messages on '/hand', late by"), "{words}");
    let lines = [(); 3].map(|()| serde_json::from_str::<Value>(&echo.line()).unwrap());
    assert!(lines.iter().all(|line| line["point"]["x"] == json!(1.5)
        && line["header"]["stamp"]["sec"].as_i64() > Some(1_700_000_000)));
    assert_eq!(subscription.counters().lost(), 0);
    echo.interrupt();
    assert_eq!(echo.end().0, 0);

    // Each message has the time of its publication.
    let mut echo = Running::start(&mut command(&["topic", "echo", "/stamped", "--json", "--timeout", "60s"]));
    let values = "{header: auto, twist: {linear: {x: 1}}}";
    let args = [
        "topic",
        "pub",
        "/stamped",
        "geometry_msgs/msg/TwistStamped",
        values,
        "-r",
        "20",
        "--timeout",
        "60s",
    ];
    let mut publishing = Running::start(&mut command(&args));
    let ns = |line: &str| {
        let line: Value = serde_json::from_str(line).unwrap();
        let stamp = |field: &str| line["header"]["stamp"][field].as_i64().unwrap();
        stamp("sec") * 1_000_000_000 + stamp("nanosec")
    };
    let (first, second) = (ns(&echo.line()), ns(&echo.line()));
    assert!(first > 1_700_000_000_000_000_000 && second > first, "{first} {second}");
    publishing.interrupt();
    assert_eq!(publishing.end().0, 0);
    echo.interrupt();

    // What it did cannot be told.
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let mut publishing = command(&["topic", "pub", "/full", "std_msgs/msg/String", "-n", "1", "--json"]);
    let output = publishing.stdout(full).output().unwrap();
    let words = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(2) && words.contains("the result cannot be printed"), "{words}");

    let (code, words) = refused(&["topic", "pub", "/new", "{data: 1}", "--once"]);
    assert!(code == 2 && words.contains("the type of '/new' is not known"), "{words}");
    let (code, words) = refused(&["topic", "pub", "/new", "std_msgs/msg/Strin", "--once"]);
    assert!(code == 2 && words.contains("std_msgs/msg/Strin"), "{words}");
    let (code, words) = refused(&["topic", "pub", "/new", "std_msgs/msg/String", "{date: x}", "--once"]);
    assert!(code == 2 && words.contains("date"), "{words}");
    let (code, words) = refused(&["topic", "pub", "/new", "std_msgs/msg/String", "--stamp", "now", "--once"]);
    assert!(code == 2 && words.contains("neither header.stamp nor stamp"), "{words}");
    let (code, words) =
        refused(&["topic", "pub", "/new", "std_msgs/msg/String", "--once", "--timeout", "100ms"]);
    assert!(code == 1 && words.contains("waited for 1 subscriptions of '/new'"), "{words}");
}

#[derive(tautline::Message, Clone, Copy)]
#[repr(u8)]
enum Mode {
    Idle = 0,
    Driving = 1,
}

#[derive(tautline::Message, Clone, Copy)]
#[repr(C)]
#[message(nested)]
struct Wheel {
    speed: f32,
    slip: f32,
}

#[derive(tautline::Message, Clone, Copy)]
#[repr(C)]
#[message(name = "car_msgs/msg/Car")]
struct Car {
    stamp: tautline::builtin_interfaces::msg::Time,
    matrix: [[f64; 2]; 2],
    wheels: [Wheel; 2],
    r#type: Mode,
    is_on: bool,
}

/// Of types that are only written in Rust.
#[test]
fn own_types_are_printed_like_those_of_ros() {
    let _participant = enter(100);
    let context = Context::builder().domain(100).realtime(Realtime::Off).build().unwrap();
    let mut node = Node::create(context, "car", "").unwrap();
    let publisher = node.create_publisher::<Car>("/car", Qos::default().transient_local()).unwrap();
    let stamp = tautline::builtin_interfaces::msg::Time { sec: 7, nanosec: 8 };
    let wheels = [Wheel { speed: 1.0, slip: 0.5 }, Wheel { speed: 2.0, slip: 0.25 }];
    let modes = [Mode::Idle, Mode::Driving];
    let car = Car { stamp, matrix: [[1.0, 2.0], [3.0, 4.0]], wheels, r#type: modes[1], is_on: true };
    publisher.publish(&car).unwrap();
    assert_eq!(
        taut(&["topic", "echo", "/car", "--once"]),
        "stamp:\n  sec: 7\n  nanosec: 8\nmatrix:\n- 1.0\n- 2.0\n- 3.0\n- 4.0\nwheels:\n- speed: 1.0\n  slip: 0.5\n- speed: 2.0\n  \
         slip: 0.25\ntype: 1\nis_on: true\n---\n"
    );
    let kept = taut(&["topic", "info", "/car", "--json"]);
    assert!(kept.contains("RIHS01_"), "{kept}");
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record --black-box`: what was before something happened is in a bag, with trace and statistics.

mod support;

use futures::StreamExt;
use serde_json::Value;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, Stdio};
use std::time::Duration;
use support::Here;
use support::schemas::Checked;
use tautline::{CallbackOptions, Qos};
use tautline_bag::{BagError, Event, FileReader, files_of};
use tautline_msgs::Message;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{EndpointKind, Limits, Participant, Publisher, Visitor};
use tempfile::TempDir;

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Count", crate = "tautline_msgs")]
#[repr(C)]
struct Count {
    n: u64,
}

const MS: u64 = 1_000_000;

/// A recorder of a black box, which tells what it does.
struct Recorder {
    domain: u32,
    folder: TempDir,
    child: Child,
    told: BufReader<ChildStderr>,
}

impl Recorder {
    fn start(domain: u32, args: &[&str]) -> Recorder {
        let folder = tempfile::tempdir().unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        command.args(["record", "-o", "box", "--json", "--depth", "1000", "--after", "100ms"]);
        command.args(args).env("TAUT_DOMAIN", domain.to_string()).env_remove("RUST_LOG");
        command.current_dir(folder.path()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let told = BufReader::new(child.stderr.take().unwrap());
        let mut it = Recorder { domain, folder, child, told };
        it.hear("recording the last");
        it
    }

    /// The next line that has these words.
    fn hear(&mut self, words: &str) -> String {
        loop {
            let mut line = String::new();
            assert_ne!(self.told.read_line(&mut line).unwrap(), 0, "it ended before it said '{words}'");
            if line.contains(words) {
                return line;
            }
            print!("{line}");
        }
    }

    fn signal(&self, name: &str) {
        let pid = self.child.id().to_string();
        assert!(Command::new("kill").args([name, &pid]).status().unwrap().success());
    }

    /// As Ctrl-C ends it: its exit code and its report.
    fn end(mut self) -> (i32, Value, TempDir) {
        self.signal("-INT");
        let mut report = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut report).unwrap();
        support::schemas::check_as("record", report.as_bytes());
        let code = self.child.wait().unwrap().code().unwrap();
        let folder = std::mem::replace(&mut self.folder, tempfile::tempdir().unwrap());
        (code, serde_json::from_str(&report).unwrap(), folder)
    }

    fn bag(&self, name: &str) -> PathBuf {
        self.folder.path().join("box").join(name)
    }

    fn wait_for(&self, topic: &str) {
        let mut visitor = Visitor::new(self.domain).unwrap();
        let start_ns = monotonic_ns();
        loop {
            let graph = visitor.graph().unwrap();
            let end =
                graph.endpoints.iter().find(|end| end.topic == topic && end.kind == EndpointKind::Publisher);
            if end.is_some_and(|end| !visitor.overwritten(end).unwrap().is_empty()) {
                // The publishing thread is handed the connection a moment after it is there to be seen.
                return sleep_until_monotonic(monotonic_ns() + 50 * MS);
            }
            assert!(
                monotonic_ns() - start_ns < 60_000 * MS,
                "waited for an observer of {topic} for a minute"
            );
            std::thread::yield_now();
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        let _ = self.child.kill();
    }
}

/// The numbers of each topic in a bag.
fn numbers(bag: &Path) -> BTreeMap<String, Vec<u64>> {
    let mut topics = BTreeMap::<_, Vec<_>>::new();
    for file in files_of(bag).unwrap() {
        let visit = &mut |event: Event<'_>| {
            if let Event::Message(message) = event {
                let number = u64::from_le_bytes(message.cdr[4..12].try_into().unwrap());
                topics.entry(message.topic.name.clone()).or_default().push(number);
            }
            Ok::<_, BagError>(())
        };
        FileReader::open(&file).unwrap().read(visit).unwrap();
    }
    topics
}

fn taut(folder: &Path, args: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_taut")).args(args).current_dir(folder).checked();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Publishes every 5 ms; the number of the last one.
fn count(publisher: &Publisher<Count>, first: u64, messages: u64) -> u64 {
    let start_ns = monotonic_ns();
    for n in 0..messages {
        sleep_until_monotonic(start_ns + n * 5 * MS);
        publisher.publish(&Count { n: first + n }).unwrap();
    }
    first + messages - 1
}

#[test]
fn what_was_last_is_written_when_it_is_asked_for() {
    let participant = Participant::new(35).unwrap();
    let create = |topic, qos| participant.create_publisher::<Count>(topic, qos, Limits::default()).unwrap();
    let scan = create("/scan", Qos::default());
    let map = create("/map", Qos::keep_last(2).transient_local());
    (1..=3).for_each(|n| map.publish(&Count { n }).unwrap());
    let mut recorder = Recorder::start(35, &["-a", "--black-box", "500ms"]);
    recorder.wait_for("/scan");
    recorder.wait_for("/map");
    let last = count(&scan, 0, 200);
    recorder.signal("-USR1");
    recorder.hear("request: it was asked for");
    let more = count(&scan, last + 1, 10);
    let told = recorder.hear("001_request: ");
    assert!(told.contains("it was asked for"), "{told}");
    let bag = numbers(&recorder.bag("001_request"));
    assert_eq!(bag["/map"], [2, 3], "though it was long before");
    let kept = &bag["/scan"];
    assert!(kept.is_sorted() && kept.windows(2).all(|pair| pair[1] == pair[0] + 1), "{kept:?}");
    // 600 ms of one each 5 ms, wherever this machine had its pauses; and what came soon after.
    assert!(kept[0] > 50 && kept.contains(&last) && kept.contains(&more), "{kept:?}");
    // What is written is written once, but for what late joiners get.
    recorder.signal("-USR1");
    recorder.hear("002_request: ");
    let second = numbers(&recorder.bag("002_request"));
    assert!(second.get("/scan").is_none_or(Vec::is_empty), "{second:?}");
    assert_eq!(second["/map"], [2, 3]);
    let (code, report, folder) = recorder.end();
    assert_eq!(
        (code, report["bags"].as_array().unwrap().len(), &report["lost"]),
        (0, 2, &0.into()),
        "{report}"
    );
    assert_eq!(report["bags"][0]["causes"][0]["kind"], "request");
    taut(folder.path(), &["bag", "check", "box/001_request"]);
    let info = taut(folder.path(), &["bag", "info", "box/001_request"]);
    assert!(info.contains("/map") && info.contains("from its black box: it was asked for"), "{info}");
}

#[test]
fn a_process_that_dies_is_a_reason() {
    let mut recorder = Recorder::start(37, &["/count", "--black-box", "60s"]);
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
    command.args(["topic", "pub", "--rate", "200", "/count", "std_msgs/msg/UInt64", "{data: 7}"]);
    command.env("TAUT_DOMAIN", "37").stdout(Stdio::null()).stderr(Stdio::null());
    let mut talker = command.spawn().unwrap();
    recorder.wait_for("/count");
    sleep_until_monotonic(monotonic_ns() + 200 * MS);
    talker.kill().unwrap();
    talker.wait().unwrap();
    let told = recorder.hear("death: process");
    assert!(told.contains(&talker.id().to_string()), "{told}");
    recorder.hear("001_death: ");
    let bag = numbers(&recorder.bag("001_death"));
    assert!(bag["/count"].len() > 20 && bag["/count"].iter().all(|n| *n == 7), "{bag:?}");
    // Whoever ends as it should is none.
    let mut talker = command.spawn().unwrap();
    recorder.wait_for("/count");
    assert!(Command::new("kill").args(["-INT", &talker.id().to_string()]).status().unwrap().success());
    assert!(talker.wait().unwrap().success());
    let (code, report, _folder) = recorder.end();
    // What the talkers sent before they were found is counted.
    let lost = report["lost"].as_u64().unwrap();
    assert_eq!((code, report["bags"].as_array().unwrap().len()), (i32::from(lost > 0), 1), "{report}");
}

/// The part of a process that is killed; without its variable it is no test.
#[test]
fn child_main() {
    if std::env::var_os("TAUT_BLACK_BOX_PART").is_none() {
        return;
    }
    let here = Here::new(51);
    let mut node = here.node("doomed", "");
    let publisher = node.create_publisher::<Count>("/last", Qos::default()).unwrap();
    let words = node.subscribe::<Count>("/last", Qos::default()).unwrap().owned();
    let options = CallbackOptions::other().name("last_words");
    let _heard = node.spawn_callback(options, words.for_each(|_| std::future::ready(()))).unwrap();
    for n in 0.. {
        publisher.publish(&Count { n }).unwrap();
        sleep_until_monotonic(monotonic_ns() + 5 * MS);
    }
}

/// Also what its callbacks did is there.
#[test]
fn what_the_dead_did_is_kept() {
    let mut recorder = Recorder::start(51, &["/last", "--black-box", "60s", "--on", "death"]);
    let mut part = Command::new(std::env::current_exe().unwrap());
    part.args(["--exact", "child_main"]).env("TAUT_BLACK_BOX_PART", "1").stdout(Stdio::null());
    let mut part = part.stderr(Stdio::null()).spawn().unwrap();
    recorder.wait_for("/last");
    sleep_until_monotonic(monotonic_ns() + 300 * MS);
    part.kill().unwrap();
    part.wait().unwrap();
    let told = recorder.hear("death: process");
    assert!(told.contains(&part.id().to_string()) && told.contains("/doomed"), "{told}");
    recorder.hear("001_death: ");
    let bag = recorder.bag("001_death");
    let last = &numbers(&bag)["/last"];
    let text = std::fs::read(bag.join("statistics.json")).unwrap();
    let statistics: Value = serde_json::from_slice(&text).unwrap();
    let processes = statistics["processes"].as_array().unwrap();
    let dead = processes.iter().find(|process| process["pid"] == part.id()).unwrap();
    let callback =
        dead["callbacks"].as_array().unwrap().iter().find(|it| it["name"] == "last_words").unwrap();
    // It was killed with messages in its queue.
    let seen = callback["releases"].as_u64().unwrap() + callback["depth"].as_u64().unwrap();
    assert!(seen >= last.len() as u64, "{callback}");
    let trace = taut(&bag, &["trace", "latency", "taut.trace"]);
    assert!(trace.contains("last_words"), "{trace}");
}

#[test]
fn a_topic_that_falls_silent_is_a_reason() {
    let participant = Participant::new(39).unwrap();
    let publisher =
        participant.create_publisher::<Count>("/scan", Qos::default(), Limits::default()).unwrap();
    let args = ["/scan", "--black-box", "60s", "--silent", "scan=400ms", "--on", "silence", "--no-trace"];
    let mut recorder = Recorder::start(39, &args);
    recorder.wait_for("/scan");
    let last = count(&publisher, 1, 50);
    let told = recorder.hear("silence: /scan is silent for ");
    assert!(told.contains("has a publisher"), "{told}");
    recorder.hear("001_silence: ");
    assert_eq!(numbers(&recorder.bag("001_silence"))["/scan"], (1..=last).collect::<Vec<_>>());
    assert!(!recorder.bag("001_silence").join("taut.trace").exists());
    // Not asked for.
    recorder.signal("-USR1");
    let (code, report, _folder) = recorder.end();
    assert_eq!((code, report["bags"].as_array().unwrap().len()), (0, 1), "{report}");
    assert_eq!(report["bags"][0]["trace_events"], Value::Null);
}

#[test]
fn a_missed_deadline_is_a_reason_and_trace_and_statistics_are_beside_it() {
    let here = Here::new(43);
    let mut recorder = Recorder::start(43, &["/work", "--black-box", "60s", "--on", "deadline"]);
    let mut node = here.node("worker", "");
    let publisher = node.create_publisher::<Count>("/work", Qos::default()).unwrap();
    let work = node.subscribe::<Count>("/work", Qos::default()).unwrap().owned();
    let late = work.for_each(|message| {
        let until_ns = monotonic_ns() + message.n * MS;
        sleep_until_monotonic(until_ns);
        std::future::ready(())
    });
    let options = CallbackOptions::other().name("late").deadline(Duration::from_secs(1));
    let _late = node.spawn_callback(options, late).unwrap();
    recorder.wait_for("/work");
    for n in [0, 0, 0, 1500] {
        publisher.publish(&Count { n }).unwrap();
    }
    let told = recorder.hear("deadline: callback 'late' of ");
    assert!(told.contains("missed its deadline of 1000.000 ms, 1 x"), "{told}");
    recorder.hear("001_deadline: ");
    let bag = recorder.bag("001_deadline");
    assert_eq!(numbers(&bag)["/work"], [0, 0, 0, 1500]);
    let statistics: Value =
        serde_json::from_slice(&std::fs::read(bag.join("statistics.json")).unwrap()).unwrap();
    let callbacks = statistics["processes"][0]["callbacks"].as_array().unwrap();
    let late = callbacks.iter().find(|callback| callback["name"] == "late").unwrap();
    assert_eq!((&late["deadline_misses"], &late["completions"]), (&1.into(), &4.into()), "{late}");
    let (code, report, folder) = recorder.end();
    assert!(code == 0 && report["bags"][0]["trace_events"].as_u64().unwrap() > 10, "{report}");
    let latency = taut(folder.path(), &["trace", "latency", "box/001_deadline/taut.trace"]);
    assert!(latency.contains("late"), "{latency}");
}

/// A budget that is too small for what was asked for is said, and the newest is kept.
#[test]
fn a_small_budget_keeps_less() {
    let participant = Participant::new(44).unwrap();
    let publisher =
        participant.create_publisher::<Count>("/scan", Qos::default(), Limits::default()).unwrap();
    let mut recorder =
        Recorder::start(44, &["/scan", "--black-box", "60s", "--budget", "64KiB", "--no-trace"]);
    recorder.wait_for("/scan");
    let start_ns = monotonic_ns();
    for n in 0..5000 {
        sleep_until_monotonic(start_ns + n * MS / 5);
        publisher.publish(&Count { n }).unwrap();
    }
    recorder.signal("-USR1");
    recorder.hear("001_request: ");
    let kept = &numbers(&recorder.bag("001_request"))["/scan"];
    assert!(kept.len() < 2000 && kept.last() == Some(&4999), "{} from {}", kept.len(), kept[0]);
    assert!(kept.windows(2).all(|pair| pair[1] == pair[0] + 1));
    let (code, report, _folder) = recorder.end();
    assert!(code == 0 && report["shortest_ns"].as_u64().unwrap() < 10_000 * MS, "{report}");
}

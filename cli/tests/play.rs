// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut play`: what is in a bag is published again, in its order, when it was and as it was.

#[path = "support/schemas.rs"]
mod schemas;

mod child;

use child::{signal, wait_for};
use rustix::pty;
use schemas::{Checked, ended};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, Command, Stdio};
use tautline_bag::{Compression, Definition, Options, PUBLISHER, Stamp, Topic, Writer};
use tautline_transport::{
    EndpointKind, Limits, MessageInfo, Participant, Qos, RawSubscription, TopicType, graph_of,
};
use tempfile::TempDir;

const START_NS: u64 = 1_700_000_000_000_000_000;
const MS: u64 = 1_000_000;

/// A domain, a bag in a folder, and `taut` beside them.
struct Place {
    domain: u32,
    participant: Participant,
    folder: TempDir,
}

/// A message, as its subscription sees it.
type Seen = (u64, MessageInfo);

fn topic(name: &str, type_name: &str, definition: &str, durability: &str) -> Topic {
    let infinite = "{sec: 9223372036, nsec: 854775807}";
    Topic {
        name: name.to_owned(),
        type_name: type_name.to_owned(),
        definition: Some(Definition::ros2msg(definition)),
        qos: format!(
            "- history: keep_last\n  depth: 2\n  reliability: reliable\n  durability: {durability}\n  deadline: {infinite}\n  lifespan: \
             {infinite}\n  liveliness: automatic\n  liveliness_lease_duration: {infinite}\n"
        ),
        ..Topic::default()
    }
}

fn count(name: &str, durability: &str) -> Topic {
    topic(name, "demo_msgs/msg/Count", "uint64 n\n", durability)
}

/// Numbered from 100 on, as a publisher that was there before; published 3 us before it was received.
fn stamp(n: u64, log_ns: u64) -> Stamp {
    Stamp { sequence: n as u32 + 100, log_ns, publish_ns: log_ns - 3000 }
}

fn cdr(n: u64) -> Vec<u8> {
    [&[0, 1, 0, 0][..], &n.to_le_bytes()].concat()
}

impl Place {
    fn new(domain: u32) -> Self {
        let (participant, folder) = (Participant::new(domain).unwrap(), tempfile::tempdir().unwrap());
        Place { domain, participant, folder }
    }

    /// Writes messages in the order that they are given in.
    fn write(&self, topics: &[Topic], messages: impl Iterator<Item = (usize, Stamp, Vec<u8>)>) {
        let options =
            Options { compression: Compression::Lz4, split_bytes: Some(20_000), ..Options::default() };
        let mut writer = Writer::create(&self.folder.path().join("bag"), options, BTreeMap::new()).unwrap();
        let ids: Vec<_> = topics.iter().map(|topic| writer.add_topic(topic.clone()).unwrap()).collect();
        messages.for_each(|(topic, stamp, cdr)| writer.write(ids[topic], stamp, &cdr).unwrap());
        writer.finish(BTreeMap::new()).unwrap();
    }

    /// Two topics, a message each millisecond in turn; in blocks whose second half is in front, as of recorders that look at one topic
    /// after the other.
    fn write_counts(&self, messages: u64, durability: &str) {
        let blocks = (0..messages).step_by(50).flat_map(|n| (n + 25..n + 50).chain(n..n + 25));
        let message = |n: u64| (n as usize % 2, stamp(n, START_NS + n * MS), cdr(n));
        self.write(&[count("/even", durability), count("/odd", durability)], blocks.map(message));
    }

    fn subscription(&self, topic: &str, type_name: &str) -> RawSubscription {
        let topic_type = TopicType::new(type_name.to_owned());
        let qos = Qos::keep_last(5000);
        self.participant.create_raw_subscription(topic, &topic_type, qos, Limits::default()).unwrap()
    }

    fn counts(&self, topics: &[&str]) -> Vec<RawSubscription> {
        topics.iter().map(|topic| self.subscription(topic, "demo_msgs/msg/Count")).collect()
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut"));
        let budget: &[&str] = if args.contains(&"--budget") { &[] } else { &["--budget", "1MB"] };
        command.args(["play", "bag"]).args(budget).args(args);
        command.env("TAUT_DOMAIN", self.domain.to_string()).env_remove("RUST_LOG").stdin(Stdio::null());
        command.current_dir(self.folder.path()).stdout(Stdio::piped()).stderr(Stdio::piped());
        child::ends_with_test(&mut command);
        command
    }

    fn play(&self, args: &[&str]) -> (i32, String, String) {
        ended(self.command(args).checked())
    }

    /// It has begun.
    fn begin(mut command: Command) -> Child {
        let mut child = command.spawn().unwrap();
        let mut reader = BufReader::with_capacity(1, child.stderr.as_mut().unwrap());
        let mut line = String::new();
        while !line.starts_with("playing") {
            print!("{line}");
            line.clear();
            assert!(reader.read_line(&mut line).unwrap() > 0, "it ended");
        }
        child
    }
}

/// Everything that is there, of several subscriptions in the order of its release.
fn seen(subscriptions: &[RawSubscription]) -> Vec<Seen> {
    let mut seen = Vec::new();
    for subscription in subscriptions {
        while let Some(sample) = subscription.try_take().unwrap() {
            seen.push((u64::from_le_bytes(sample.body().try_into().unwrap()), sample.info()));
        }
        assert_eq!((subscription.counters().lost(), subscription.counters().invalid()), (0, 0));
    }
    seen.sort_by_key(|(n, info)| (info.released_ns, *n));
    seen
}

/// As many as were published: a subscription may find out of them when who published them has gone.
fn all(subscriptions: &[RawSubscription], count: usize) -> Vec<Seen> {
    let mut all = Vec::new();
    wait_for("all that was published", || {
        all.extend(seen(subscriptions));
        all.len() >= count
    });
    all.sort_by_key(|(n, info)| (info.released_ns, *n));
    all
}

fn numbers(seen: &[Seen]) -> Vec<u64> {
    seen.iter().map(|(n, _)| *n).collect()
}

#[test]
fn what_was_recorded_is_published_as_it_was() {
    let place = Place::new(79);
    place.write_counts(500, "volatile");
    let subscriptions = place.counts(&["/even", "/odd"]);
    for (args, nanoseconds) in [(&["--json"][..], MS), (&["--json", "--rate", "4", "--no-rt"], MS / 4)] {
        let (code, out, errors) = place.play(args);
        assert_eq!(code, 0, "{out}{errors}");
        let all = all(&subscriptions, 500);
        assert_eq!(numbers(&all), (0..500).collect::<Vec<_>>());
        let first_ns = all[0].1.released_ns;
        for (n, info) in all {
            let stamp = stamp(n, START_NS + n * MS);
            assert_eq!(info.sequence_number, u64::from(stamp.sequence));
            assert_eq!(info.source_timestamp_ns as u64, stamp.publish_ns);
            assert_eq!(info.released_ns - first_ns, n * nanoseconds, "releases are absolute");
        }
        let report: Value = serde_json::from_str(&out).unwrap();
        assert_eq!(
            (&report["published"], &report["starved"], &report["refused"]),
            (&500.into(), &0.into(), &0.into())
        );
        assert!(report["late_ms"]["max"].as_f64() >= report["late_ms"]["p50"].as_f64(), "{report}");
        assert_eq!(report["topics"][1]["published"], 250, "{report}");
    }
    // None of a microsecond is reached by anybody.
    let (code, out, errors) = place.play(&["--max-jitter", "1us", "--rate", "100"]);
    assert!(code == 1 && errors.contains("late, more than 1µs"), "{errors}");
    assert!(out.contains("500 messages, late by") && out.contains("/even"), "{out}");
    assert_eq!(all(&subscriptions, 500).len(), 500);
}

#[test]
fn a_part_of_it_is_played_and_again() {
    let place = Place::new(81);
    place.write_counts(200, "transient_local");
    let subscriptions = place.counts(&["/even", "/odd"]);
    // What a publisher that keeps two had kept when the part began is there first.
    let (code, _, errors) = place.play(&["--from", "100ms", "--to", "120ms", "--rate", "10"]);
    assert_eq!(code, 0, "{errors}");
    assert_eq!(numbers(&all(&subscriptions, 25)), (96..=120).collect::<Vec<_>>());
    let (code, _, errors) = place.play(&["/odd", "--loop=3", "--rate", "100"]);
    assert_eq!(code, 0, "{errors}");
    let odd: Vec<_> = (0..100).map(|n| n * 2 + 1).collect();
    assert_eq!(numbers(&all(&subscriptions, 300)), odd.repeat(3));
    let (code, _, errors) = place.play(&["-x", "odd", "--rate", "100", "-e", "."]);
    assert_eq!(code, 0, "{errors}");
    assert_eq!(all(&subscriptions, 100).len(), 100);
    // One moment again and again is no flood.
    let (code, out, errors) = place.play(&["--from", "50ms", "--to", "50ms", "--loop=20", "/even", "--json"]);
    let report: Value = serde_json::from_str(&out).unwrap();
    // What was kept before, and the one.
    assert_eq!((code, &report["published"]), (0, &60.into()), "{errors}");
    let of_a_moment = all(&subscriptions, 60);
    assert!(of_a_moment[59].1.released_ns - of_a_moment[0].1.released_ns >= 19 * MS);
    // For ever, until somebody ends it; slowly, for this thread reads at no real-time priority.
    let child = Place::begin(place.command(&["--loop", "--rate", "5", "--json"]));
    let mut count = 0;
    wait_for("a third pass", || {
        count += seen(&subscriptions).len();
        count > 500
    });
    signal(&child, "-INT");
    let (code, out, errors) = ended(child.wait_with_output().unwrap());
    assert_eq!(code, 0, "{errors}");
    let report: Value = serde_json::from_str(&out).unwrap();
    assert!(report["interrupted"] == true && report["published"].as_u64() > Some(500), "{report}");

    for (args, code, why) in [
        (&["/evn"][..], 1, "did you mean /even?"),
        (&["--from", "1h"], 2, "there is nothing between: the bag is of 0.2 s"),
        (&["--from", "20ms", "--to", "10ms"], 2, "there is nothing between"),
        (&["-x", "."], 2, "no topic of the bag is chosen"),
        (&["-x", "("], 2, "regex parse error"),
        (&["--rate", "0"], 2, "is no number of 0.000001 to 1000000"),
        (&["--wait", "/even", "-m", "/even:=/nobody", "--timeout", "1s"], 1, "a subscription of '/nobody'"),
    ] {
        let (found, _, errors) = place.play(args);
        assert!(found == code && errors.contains(why), "{args:?}: {found}: {errors}");
    }
    std::fs::remove_dir_all(place.folder.path().join("bag")).unwrap();
    let (code, _, errors) = place.play(&[]);
    assert!(code == 2 && errors.contains("'bag' cannot be read"), "{errors}");
}

/// A publisher is played by one that keeps for late joiners what it kept: the others' messages do not push it out.
#[test]
fn what_each_publisher_kept_is_kept() {
    let place = Place::new(39);
    let of = |publisher: &str| {
        let mut topic = count("/tf_static", "transient_local");
        topic.qos = topic.qos.replace("depth: 2", "depth: 1");
        Topic { metadata: [(PUBLISHER.to_owned(), publisher.to_owned())].into(), ..topic }
    };
    let at = |publisher: usize, n: u64, ms: u64| (publisher, stamp(n, START_NS + ms * MS), cdr(n));
    // The last one is far away: the others are kept until then.
    let messages = [at(0, 10, 0), at(1, 3, 0), at(1, 4, 1), at(1, 5, 2), at(2, 0, 600_000)];
    let topics = [of("lidar"), of("camera"), count("/tick", "volatile")];
    place.write(&topics, messages.into_iter());
    let join = || {
        let topic_type = TopicType::new("demo_msgs/msg/Count");
        let qos = Qos::keep_last(10).transient_local();
        [place
            .participant
            .create_raw_subscription("/tf_static", &topic_type, qos, Limits::default())
            .unwrap()]
    };
    let child = Place::begin(place.command(&["--json"]));
    let early = join();
    let mut numbers_of = Vec::new();
    wait_for("the last message", || {
        numbers_of.extend(numbers(&seen(&early)));
        numbers_of.contains(&5)
    });
    let mut late = numbers(&all(&join(), 2));
    late.sort_unstable();
    assert_eq!(late, [5, 10]);
    signal(&child, "-INT");
    let (code, out, errors) = ended(child.wait_with_output().unwrap());
    let report: Value = serde_json::from_str(&out).unwrap();
    assert_eq!((code, report["topics"].as_array().unwrap().len()), (0, 2), "{out}{errors}");
}

/// Of one name and type, as when a definition was changed between two recordings.
#[test]
fn each_definition_of_a_type_has_a_publisher() {
    let place = Place::new(225);
    let topics = ["uint64 n\n", "int64 n\n"]
        .map(|definition| topic("/count", "demo_msgs/msg/Count", definition, "volatile"));
    place.write(&topics, (0..10).map(|n| (n as usize % 2, stamp(n, START_NS + n * MS), cdr(n))));
    let child = Place::begin(place.command(&["--paused"]));
    let graph = graph_of(place.domain).unwrap();
    let publishers =
        graph.endpoints.iter().filter(|end| end.kind == EndpointKind::Publisher && end.topic == "/count");
    let hashes: BTreeSet<_> = publishers.map(|end| end.topic_type.hash.clone()).collect();
    assert_eq!(hashes.len(), 2, "{hashes:?}");
    signal(&child, "-INT");
    let (code, out, errors) = ended(child.wait_with_output().unwrap());
    assert_eq!(code, 0, "{out}{errors}");
}

#[test]
fn what_can_be_played_is_played() {
    let place = Place::new(40);
    let json = Topic { encoding: "json".to_owned(), ..count("/log", "volatile") };
    let messages = (0..10).map(|n| (n as usize % 2, stamp(n, START_NS + n * MS), cdr(n)));
    place.write(&[count("/speed", "volatile"), json], messages);
    let subscriptions = place.counts(&["/speed"]);
    let why = "/log cannot be played: its messages are json, not cdr";
    let (code, out, errors) = place.play(&["--json"]);
    assert!(code == 1 && errors.contains(&format!("1 topics were not played; the first: {why}")), "{errors}");
    assert_eq!(serde_json::from_str::<Value>(&out).unwrap()["unplayable_topics"][0], why);
    assert_eq!(numbers(&all(&subscriptions, 5)), [0, 2, 4, 6, 8]);
    let (code, _, errors) = place.play(&["/speed", "/log"]);
    assert!(code == 2 && errors.contains(&format!("{why}; leave it out with -x")), "{errors}");
    assert_eq!(place.play(&["-x", "log"]).0, 0);
    let (code, _, errors) = place.play(&["-x", "speed"]);
    assert!(code == 2 && errors.contains("no topic of the bag can be played"), "{errors}");
}

#[test]
fn nobody_is_surprised_by_messages_beside_his_own() {
    let place = Place::new(82);
    place.write_counts(100, "volatile");
    let topic_type = TopicType::new("demo_msgs/msg/Count");
    let live = place.participant.create_raw_publisher("/odd", &topic_type, Qos::default(), Limits::default());
    let subscriptions = place.counts(&["/even", "/odd", "/other"]);
    let (code, out, errors) = place.play(&["--rate", "10"]);
    assert!(code == 2 && errors.contains("/odd has live publishers") && out.is_empty(), "{out}{errors}");
    assert_eq!(seen(&subscriptions), []);
    let (code, _, errors) = place.play(&["--remap", "/ode:=/other"]);
    assert!(code == 1 && errors.contains("did you mean /odd?"), "{errors}");
    let (code, _, errors) = place.play(&["--rate", "10", "--remap", "/odd:=/other"]);
    assert_eq!(code, 0, "{errors}");
    let each: Vec<_> = subscriptions.chunks(1).zip([50, 0, 50]).map(|(one, n)| all(one, n).len()).collect();
    assert_eq!(each, [50, 0, 50]);
    let (code, _, errors) = place.play(&["--rate", "10", "--mix"]);
    assert_eq!((code, all(&subscriptions, 100).len()), (0, 100), "{errors}");
    drop(live);
    // Nothing, again and again, comes to its end.
    let (code, out, errors) = place.play(&["--from", "50500us", "--to", "50600us", "--loop"]);
    assert!(code == 0 && out.ends_with("0 messages\n"), "{out}{errors}");
}

/// They are copied ahead of their turn, through a ring that they go around in.
#[test]
fn long_messages_are_whole_and_in_time() {
    let place = Place::new(93);
    let image = |n: u64| {
        let len = 200_000 + (n * 7919 % 150_000) as usize;
        [&(len as u32).to_le_bytes()[..], &(0..len).map(|at| (at as u64 * 31 + n) as u8).collect::<Vec<_>>()]
            .concat()
    };
    let message = |n: u64| match n % 25 {
        7 => (1, stamp(n, START_NS + n * MS), [&[0, 1, 0, 0][..], &image(n)].concat()),
        _ => (0, stamp(n, START_NS + n * MS), cdr(n)),
    };
    let bytes = topic("/image", "demo_msgs/msg/Bytes", "uint8[] data\n", "volatile");
    place.write(&[count("/count", "volatile"), bytes], (0..500).map(message));
    let counts = place.counts(&["/count"]);
    let limits = Limits { held: 64, ..Limits::default() };
    let (topic_type, qos) = (TopicType::new("demo_msgs/msg/Bytes"), Qos::keep_last(64));
    let images = place.participant.create_raw_subscription("/image", &topic_type, qos, limits).unwrap();
    let (code, out, errors) = place.play(&["--json"]);
    assert_eq!(code, 0, "{out}{errors}");
    let report: Value = serde_json::from_str(&out).unwrap();
    assert_eq!((&report["published"], &report["refused"]), (&500.into(), &0.into()), "{report}");
    let numbers = numbers(&all(&counts, 480));
    assert_eq!(numbers, (0..500).filter(|n| n % 25 != 7).collect::<Vec<_>>());
    for n in (7..500).step_by(25) {
        let sample = images.try_take().unwrap().unwrap();
        assert!(sample.body() == image(n), "{n}");
        assert_eq!(sample.info().sequence_number, n + 100);
    }
    // Longer than what is read ahead.
    let (code, out, errors) = place.play(&["--budget", "220kB", "--json"]);
    assert!(code == 1 && errors.contains("bytes is longer than --budget"), "{out}{errors}");
}

#[test]
fn it_stands_still_and_goes_step_by_step() {
    let place = Place::new(83);
    place.write_counts(100, "volatile");
    let subscriptions = place.counts(&["/even", "/odd"]);
    let child = Place::begin(place.command(&["--paused"]));
    let mut all = Vec::new();
    for n in 0..3 {
        assert_eq!(all.len(), n);
        signal(&child, "-USR2");
        wait_for("a step", || {
            all.extend(seen(&subscriptions));
            all.len() > n
        });
    }
    signal(&child, "-USR1");
    let (code, _, errors) = ended(child.wait_with_output().unwrap());
    assert_eq!(code, 0, "{errors}");
    all.extend(seen(&subscriptions));
    assert_eq!(numbers(&all), (0..100).collect::<Vec<_>>());
    let spread_ns = all[99].1.released_ns - all[3].1.released_ns;
    assert_eq!(spread_ns, 96 * MS, "time goes on where it stood");
}

#[test]
fn on_a_terminal_it_leaps() {
    let place = Place::new(84);
    place.write_counts(2000, "volatile");
    let flags = pty::OpenptFlags::RDWR | pty::OpenptFlags::NOCTTY | pty::OpenptFlags::CLOEXEC;
    let terminal = pty::openpt(flags).unwrap();
    pty::grantpt(&terminal).unwrap();
    pty::unlockpt(&terminal).unwrap();
    let path = pty::ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
    let subscriptions = place.counts(&["/even", "/odd"]);
    let mut command = place.command(&["--paused"]);
    command.stdin(File::options().read(true).write(true).open(path).unwrap());
    let child = Place::begin(command);
    let mut terminal = File::from(terminal);
    let mut all = Vec::new();
    let mut until = |count: usize| {
        wait_for("messages", || {
            all.extend(seen(&subscriptions));
            all.len() >= count
        });
        numbers(&all)
    };
    terminal.write_all(b"what\nn\n").unwrap();
    assert_eq!(until(1), [0]);
    terminal.write_all(b"s 1.9\nn\n").unwrap();
    assert_eq!(until(2), [0, 1900]);
    terminal.write_all(b"s 500ms\nn\n").unwrap();
    assert_eq!(until(3), [0, 1900, 500]);
    terminal.write_all(b"s 1.95\n\n").unwrap();
    let (code, out, errors) = ended(child.wait_with_output().unwrap());
    assert!(code == 0 && errors.contains("'what' is none of: enter pauses"), "{out}{errors}");
    assert_eq!(until(53), [&[0, 1900, 500][..], &(1950..2000).collect::<Vec<_>>()].concat());
}

/// What was read ahead of passes to come is not lost, and times that begin anew do not add up.
#[test]
fn a_leap_in_a_loop_leaves_the_passes_that_are_to_come() {
    let place = Place::new(47);
    let flags = pty::OpenptFlags::RDWR | pty::OpenptFlags::NOCTTY | pty::OpenptFlags::CLOEXEC;
    let terminal = pty::openpt(flags).unwrap();
    pty::grantpt(&terminal).unwrap();
    pty::unlockpt(&terminal).unwrap();
    let path = pty::ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
    place.write_counts(50, "volatile");
    let subscriptions = place.counts(&["/even", "/odd"]);
    let mut command = place.command(&["--paused", "--loop=5", "--clock"]);
    command.stdin(File::options().read(true).write(true).open(path).unwrap());
    let child = Place::begin(command);
    let mut terminal = File::from(terminal);
    terminal.write_all(b"s 15ms\n\n").unwrap();
    let all = all(&subscriptions, 35 + 4 * 50);
    let (code, out, errors) = ended(child.wait_with_output().unwrap());
    assert!(code == 0 && out.contains("235 messages"), "{out}{errors}");
    let passes = (0..4).flat_map(|_| 0..50);
    assert_eq!(numbers(&all), (15..50).chain(passes).collect::<Vec<_>>());
}

#[test]
fn simulated_time_is_that_of_the_bag() {
    let place = Place::new(85);
    let clock = topic("/clock", "rosgraph_msgs/msg/Clock", CLOCK, "volatile");
    let message = |n: u64| (n as usize % 2, stamp(n, START_NS + n * MS), cdr(n));
    place.write(&[count("/count", "volatile"), clock], (0..200).map(message));
    let (clocks, subscriptions) =
        (place.subscription("/clock", "rosgraph_msgs/msg/Clock"), place.counts(&["/count"]));
    let (code, _, errors) = place.play(&["--clock=1000", "--rate", "2"]);
    assert_eq!(code, 0, "{errors}");
    let counts = all(&subscriptions, 100);
    assert_eq!(counts.len(), 100);
    let mut times = Vec::new();
    while let Some(sample) = clocks.try_take().unwrap() {
        let four = |at: usize| u64::from(u32::from_le_bytes(sample.body()[at..at + 4].try_into().unwrap()));
        times.push((sample.info().released_ns, four(0) * 1_000_000_000 + four(4)));
    }
    // Twice as fast, a hundred times in the tenth of a second; some may be skipped where the processor is busy.
    assert!((50..=110).contains(&times.len()) && times.is_sorted(), "{}", times.len());
    assert!(times[0].1 >= START_NS && times[0].1 < START_NS + 20 * MS);
    let (first, last) = (times[0], times[times.len() - 1]);
    let ratio = (last.1 - first.1) as f64 / (last.0 - first.0) as f64;
    assert!((1.9..2.1).contains(&ratio), "{ratio}");
}

const CLOCK: &str = "builtin_interfaces/Time clock\n\
    ================================================================================\n\
    MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

/// Others write other bytes: big-endian, with padding behind; and some write what is no message.
#[test]
fn what_is_no_message_is_not_played() {
    let place = Place::new(86);
    let text = topic("/text", "std_msgs/msg/String", "string data\n", "volatile");
    let texts: [&[u8]; 5] = [
        b"\0\x01\0\0\x03\0\0\0ab\0",
        b"\0\0\0\0\0\0\0\x03cd\0",
        b"\0\x01\0\0\x03\0\0\0ef\0\0",
        b"\0\x01\0\0\xff\0\0\0gh\0",
        b"\0\x07\0\0\x03\0\0\0ij\0",
    ];
    let messages = texts
        .iter()
        .enumerate()
        .map(|(n, text)| (0, stamp(n as u64, START_NS + n as u64 * MS), text.to_vec()));
    place.write(&[text], messages);
    let subscription = place.subscription("/text", "std_msgs/msg/String");
    let (code, out, errors) = place.play(&["--json"]);
    assert!(code == 1 && errors.contains("2 messages were not played, the first for: /text: "), "{errors}");
    let report: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(report["topics"][0]["unplayable"], 2);
    let mut bodies = Vec::new();
    while let Some(sample) = subscription.try_take().unwrap() {
        bodies.push(sample.body().to_vec());
    }
    assert_eq!(bodies, [b"\x03\0\0\0ab\0", b"\x03\0\0\0cd\0", b"\x03\0\0\0ef\0"]);
}

#[test]
fn what_is_whole_of_a_damaged_bag_is_played() {
    let place = Place::new(87);
    place.write_counts(1000, "volatile");
    let file = place.folder.path().join("bag/bag_1.mcap");
    let whole = std::fs::read(&file).unwrap();
    std::fs::write(&file, &whole[..whole.len() / 2]).unwrap();
    let subscriptions = place.counts(&["/even", "/odd"]);
    let (code, _, errors) = place.play(&["--rate", "20"]);
    assert!(
        code == 1 && errors.contains("1 parts of the bag are damaged; bag/bag_1.mcap: at byte"),
        "{errors}"
    );
    let all = numbers(&seen(&subscriptions));
    assert!(
        all.is_sorted() && all.len() < 1000 && all.len() > 100 && all[all.len() - 1] == 999,
        "{}",
        all.len()
    );
    // It says which node it is, as long as it is there.
    let child = Place::begin(place.command(&["--paused"]));
    let node = format!("/taut_play_{}", child.id());
    let graph = graph_of(place.domain).unwrap();
    let own = graph.endpoints.iter().filter(|end| {
        end.kind == EndpointKind::Publisher && end.node.as_ref().is_some_and(|by| by.full_name() == node)
    });
    assert_eq!(own.count(), 2);
    signal(&child, "-TERM");
    assert_eq!(ended(child.wait_with_output().unwrap()).0, 1, "it is damaged all the same");
    // Also where nobody reads it.
    let mut child = Place::begin(place.command(&["--paused"]));
    drop(child.stdout.take());
    signal(&child, "-TERM");
    assert_eq!(child.wait().unwrap().code(), Some(1));
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record` and `taut bag`: what is published is in the bag, or counted as lost; what others read of it; what a kill leaves.

mod child;
#[path = "../../msgs/schema/tests/support/peer.rs"]
mod peer;
#[path = "../../msgs/schema/tests/support/mod.rs"]
mod ros;
mod support;

use child::wait_for;
use futures::StreamExt;
use peer::{Peer, hex};
use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit};
use serde_json::Value;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use support::Here;
use support::schemas::{Checked, ended};
use tautline::Qos;
use tautline::example_interfaces::action::Fibonacci;
use tautline::example_interfaces::srv::AddTwoInts;
use tautline_bag::{BagError, Event, FileReader, Stamp, files_of, index_of};
use tautline_msgs::Message;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic, wall_ns};
use tautline_rt::{self as rt, CoreSet, Policy, ThreadBuilder};
use tautline_schema::{DynamicMessage, Kind};
use tautline_transport::{
    EndpointKind, Gid, Limits, NodeName, Origin, Participant, Publisher, RawPublisher, RemoteGraph,
    ServiceKind, ServiceType, TopicEndpoint, TopicType, Visitor,
};
use tempfile::TempDir;

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Count", crate = "tautline_msgs")]
#[repr(C)]
struct Count {
    n: u64,
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Other", crate = "tautline_msgs")]
#[repr(C)]
struct Other {
    n: u32,
}

/// A domain, a folder for bags, and `taut` beside them.
struct Place {
    domain: u32,
    participant: Participant,
    folder: TempDir,
}

impl Place {
    fn new(domain: u32) -> Self {
        let (participant, folder) = (Participant::new(domain).unwrap(), tempfile::tempdir().unwrap());
        Place { domain, participant, folder }
    }

    fn publisher<M: Message>(&self, topic: &str, qos: Qos) -> Publisher<M> {
        self.participant.create_publisher(topic, qos, Limits::default()).unwrap()
    }

    fn bag(&self) -> PathBuf {
        self.folder.path().join("bag")
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = self.command_of(env!("CARGO_BIN_EXE_taut"));
        command.args(args);
        command
    }

    fn command_of(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("TAUT_DOMAIN", self.domain.to_string()).env_remove("RUST_LOG");
        command.current_dir(self.folder.path()).stdout(Stdio::piped()).stderr(Stdio::piped());
        child::ends_with_test(&mut command);
        command
    }

    fn run(&self, args: &[&str]) -> (i32, String, String) {
        ended(self.command(args).checked())
    }

    /// Records into `bag`, and has begun.
    fn record(&self, args: &[&str]) -> Recorder {
        self.record_by(self.command(&[]), args)
    }

    /// As [`record`](Self::record), with a command that ends before the verb.
    fn record_by(&self, mut command: Command, args: &[&str]) -> Recorder {
        let mut child = command.args(["record", "-o", "bag", "--budget", "8MB"]).args(args).spawn().unwrap();
        let mut line = String::new();
        BufReader::with_capacity(1, child.stderr.as_mut().unwrap()).read_line(&mut line).unwrap();
        assert!(line.starts_with("recording domain") || line.starts_with("taut: warning"), "{line}");
        Recorder(child)
    }

    /// Waits until the recorder is connected to a publisher, which nobody but a visitor sees.
    fn wait_for_observer(&self, publisher: Gid) {
        self.wait_for_observers([publisher]);
    }

    fn wait_for_observers(&self, publishers: impl IntoIterator<Item = Gid>) {
        let mut visitor = Visitor::new(self.domain).unwrap();
        for publisher in publishers {
            wait_for("an observer", || {
                let graph = visitor.graph().unwrap();
                let any = graph.endpoints.iter().find(|end| end.kind == EndpointKind::Publisher);
                any.is_some_and(|any| {
                    // Also of a service's requests or responses.
                    let end = TopicEndpoint { gid: publisher, ..TopicEndpoint::clone(any) };
                    !visitor.overwritten(&end).unwrap().is_empty()
                })
            });
        }
        // The publishing thread is handed the connection a moment after it is there to be seen, which nobody sees.
        sleep_until_monotonic(monotonic_ns() + 50_000_000);
    }

    fn read(&self) -> BTreeMap<String, Vec<(Stamp, Vec<u8>)>> {
        read(&self.bag())
    }
}

struct Recorder(Child);

impl Recorder {
    fn signal(&self, name: &str) {
        child::signal(&self.0, name);
    }

    /// As Ctrl-C ends it.
    fn end(self) -> (i32, String, String) {
        self.signal("-INT");
        let output = self.0.wait_with_output().unwrap();
        if output.stdout.starts_with(b"{") {
            support::schemas::check_as("record", &output.stdout);
        }
        ended(output)
    }
}

fn read(bag: &Path) -> BTreeMap<String, Vec<(Stamp, Vec<u8>)>> {
    let mut topics = BTreeMap::<_, Vec<_>>::new();
    for file in files_of(bag).unwrap() {
        let mut reader = FileReader::open(&file).unwrap();
        let visit = &mut |event: Event<'_>| {
            if let Event::Message(message) = event {
                assert_eq!(message.cdr[..4], [0, 1, 0, 0]);
                let of_topic = topics.entry(message.topic.name.clone()).or_default();
                of_topic.push((message.stamp, message.cdr[4..].to_vec()));
            }
            Ok::<_, BagError>(())
        };
        reader.read(visit).unwrap();
        assert_eq!(reader.damage().1, 0, "{:?}", reader.damage());
    }
    topics
}

fn numbers(messages: &[(Stamp, Vec<u8>)]) -> Vec<u64> {
    messages.iter().map(|(_, body)| u64::from_le_bytes(body[..8].try_into().unwrap())).collect()
}

#[test]
fn what_is_published_is_in_the_bag() {
    let place = Place::new(5);
    let latched = place.publisher::<Count>("/latched", Qos::keep_last(3).transient_local());
    (1..=5).for_each(|n| latched.publish(&Count { n }).unwrap());
    let many = place.publisher::<Count>("/many", Qos::default());
    many.publish(&Count { n: 0 }).unwrap();
    let recorder = place.record(&["-a", "--depth", "20000", "--json", "--max-size", "100kB"]);
    place.wait_for_observer(many.gid());
    place.wait_for_observer(latched.gid());
    let before_ns = wall_ns() as u64;
    (1..=10_000).for_each(|n| many.publish(&Count { n }).unwrap());
    // Nobody waits for it, or sees it.
    assert_eq!((many.subscription_count(), latched.subscription_count()), (0, 0));
    let (code, out, errors) = recorder.end();
    let after_ns = wall_ns() as u64;
    assert_eq!(code, 0, "{errors}");
    let report: Value = serde_json::from_str(&out).unwrap();
    assert_eq!((&report["lost"], &report["messages"]), (&0.into(), &10_003.into()), "{report}");
    assert!(report["files"].as_array().unwrap().len() > 2, "{report}");
    let topics = place.read();
    assert_eq!(numbers(&topics["/latched"]), [3, 4, 5]);
    assert_eq!(numbers(&topics["/many"]), (1..=10_000).collect::<Vec<_>>());
    for (at, (stamp, _)) in topics["/many"].iter().enumerate() {
        assert_eq!(stamp.sequence as usize, at + 2, "as the publisher counts");
        assert!((before_ns..=after_ns).contains(&stamp.publish_ns), "{stamp:?}");
        assert!(stamp.log_ns >= before_ns - 1_000_000 && stamp.log_ns <= after_ns + 1_000_000, "{stamp:?}");
    }
    let logged: Vec<_> = topics["/many"].iter().map(|(stamp, _)| stamp.log_ns).collect();
    assert!(logged.is_sorted());

    let (code, out, _) = place.run(&["bag", "info", "bag", "--json"]);
    let info: Value = serde_json::from_str(&out).unwrap();
    assert_eq!((code, &info["messages"]), (0, &10_003.into()));
    let many = &info["recording"]["/many"];
    assert_eq!(
        (&many["messages"], &many["lost"], &many["depth"]),
        (&10_000.into(), &0.into(), &20_000.into())
    );
    assert!(many["survives_stall_ns"].as_u64() > many["longest_stall_ns"].as_u64(), "{many}");
    let (code, out, errors) = place.run(&["bag", "check", "bag"]);
    assert!(code == 0 && out.contains("10003 messages"), "{out}{errors}");
    let (code, _, errors) = place.run(&["record", "-a", "-o", "bag"]);
    assert!(code == 2 && errors.contains("'bag' exists already; choose another folder with -o"), "{errors}");
}

/// Times of reception are monotonic ones plus the offset that the bag states.
#[test]
fn the_offset_in_the_bag_is_that_of_its_times() {
    let place = Place::new(54);
    let publisher = place.publisher::<Count>("/count", Qos::default());
    let (topic_type, qos) = (TopicType::new("demo_msgs/msg/Count"), Qos::keep_last(10));
    let subscription =
        place.participant.create_raw_subscription("/count", &topic_type, qos, Limits::default()).unwrap();
    wait_for("a subscription", || publisher.subscription_count() == 1);
    let recorder = place.record(&["/count"]);
    place.wait_for_observer(publisher.gid());
    (0..10).for_each(|n| publisher.publish(&Count { n }).unwrap());
    let (code, _, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}");
    let (_, metadata) = index_of(&files_of(&place.bag()).unwrap()[0]).unwrap().unwrap();
    let session = &metadata.iter().find(|(name, _)| name == "tautline:session").unwrap().1;
    let offset_ns: i64 = session["log_time_minus_monotonic_ns"].parse().unwrap();
    let recorded = &place.read()["/count"];
    assert_eq!(recorded.len(), 10);
    // What is published during a poll has the time of the poll.
    let is_exact = recorded.iter().any(|(stamp, _)| {
        let released_ns = subscription.try_take().unwrap().unwrap().info().released_ns;
        stamp.log_ns.cast_signed() - offset_ns == released_ns.cast_signed()
    });
    assert!(is_exact);
}

#[test]
fn a_closed_terminal_ends_a_recording_unless_hangups_are_ignored() {
    let is_ended = |recorder: &mut Recorder| recorder.0.try_wait().unwrap().is_some();
    let place = Place::new(214);
    let publisher = place.publisher::<Count>("/tick", Qos::default());
    let mut recorder = place.record(&["-a"]);
    place.wait_for_observer(publisher.gid());
    publisher.publish(&Count { n: 1 }).unwrap();
    recorder.signal("-HUP");
    wait_for("the recorder to end", || is_ended(&mut recorder));
    let (code, out, errors) = ended(recorder.0.wait_with_output().unwrap());
    assert_eq!(code, 0, "{out}{errors}");
    assert!(place.bag().join("metadata.yaml").exists());
    assert_eq!(numbers(&place.read()["/tick"]), [1]);

    let place = Place::new(215);
    let publisher = place.publisher::<Count>("/tick", Qos::default());
    // As `nohup` starts a program.
    let mut command = place.command_of("sh");
    command.args(["-c", "trap '' HUP; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_taut")]);
    let recorder = place.record_by(command, &["-a"]);
    place.wait_for_observer(publisher.gid());
    recorder.signal("-HUP");
    publisher.publish(&Count { n: 2 }).unwrap();
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(numbers(&place.read()["/tick"]), [2]);
}

#[test]
fn bags_are_cut_and_merged() {
    let place = Place::new(13);
    let [one, two] = ["/one", "/two"].map(|topic| place.publisher::<Count>(topic, Qos::default()));
    let recorder = place.record(&["-a", "--depth", "1000", "--max-size", "20kB"]);
    place.wait_for_observer(one.gid());
    place.wait_for_observer(two.gid());
    let start_ns = monotonic_ns();
    for n in 0..500 {
        sleep_until_monotonic(start_ns + n * 1_000_000);
        one.publish(&Count { n }).unwrap();
        two.publish(&Count { n }).unwrap();
    }
    assert_eq!(recorder.end().0, 0);
    let cut = |args: &[&str]| {
        let (code, out, errors) = place.run(&[&["bag", "cut", "bag"], args].concat());
        assert_eq!(code, 0, "{out}{errors}");
    };
    cut(&["--to", "200ms", "-o", "begin", "--compression", "zstd"]);
    cut(&["--from", "200ms", "-o", "end"]);
    cut(&["/two", "-o", "two"]);
    cut(&["-x", "tw", "-o", "one"]);
    let all = place.read();
    let read = |bag: &str| read(&place.folder.path().join(bag));
    for (bag, topic) in [("one", "/one"), ("two", "/two")] {
        assert_eq!(read(bag), [(topic.to_owned(), all[topic].clone())].into());
    }
    let (begin, end) = (read("begin"), read("end"));
    let last = |messages: &[(Stamp, Vec<u8>)]| messages.iter().map(|(stamp, _)| stamp.log_ns).max().unwrap();
    let first = |messages: &[(Stamp, Vec<u8>)]| messages.iter().map(|(stamp, _)| stamp.log_ns).min().unwrap();
    let span =
        last(&begin["/one"]).max(last(&begin["/two"])) - first(&begin["/one"]).min(first(&begin["/two"]));
    assert!((150_000_000..200_000_000).contains(&span), "{span}");
    assert!(first(&end["/one"]) - first(&all["/one"]).min(first(&all["/two"])) >= 200_000_000);
    for topics in [["begin", "end"], ["one", "two"]] {
        let (code, out, errors) = place.run(&["bag", "merge", topics[0], topics[1], "-o", "merged"]);
        assert_eq!(code, 0, "{out}{errors}");
        assert_eq!(read("merged"), all);
        assert_eq!(place.run(&["bag", "check", "merged"]).0, 0);
        std::fs::remove_dir_all(place.folder.path().join("merged")).unwrap();
    }
    let refused = |args: &[&str]| {
        let (code, _, errors) = place.run(&[&["bag", "cut", "bag", "-o", "x"], args].concat());
        assert!(!place.folder.path().join("x").exists());
        (code, errors)
    };
    let (code, errors) = refused(&["/twi"]);
    assert!(code == 1 && errors.contains("did you mean /two?"), "{errors}");
    let (code, errors) = refused(&["--from", "1h"]);
    assert!(code == 2 && errors.contains("there is nothing between"), "{errors}");
    let (code, errors) = refused(&["-x", "("]);
    assert!(code == 2 && errors.contains("regex parse error"), "{errors}");
}

#[test]
fn what_is_lost_is_counted() {
    let place = Place::new(6);
    let publisher = place.publisher::<Count>("/lossy", Qos::default());
    let recorder = place.record(&["/lossy", "/never", "--depth", "10"]);
    place.wait_for_observer(publisher.gid());
    recorder.signal("-STOP");
    wait_for("the recorder to stop", || {
        let status = std::fs::read_to_string(format!("/proc/{}/status", recorder.0.id())).unwrap();
        status.lines().any(|line| line.starts_with("State:\tT"))
    });
    (1..=1000).for_each(|n| publisher.publish(&Count { n }).unwrap());
    recorder.signal("-CONT");
    // A publisher that comes later, and sends before anybody can be connected.
    let late = place.publisher::<Count>("/lossy", Qos::default());
    late.publish(&Count { n: 1 }).unwrap();
    place.wait_for_observer(late.gid());
    late.publish(&Count { n: 2 }).unwrap();
    let (code, out, errors) = recorder.end();
    assert!(code == 1 && errors.contains("did not come or could not be: /never"), "{errors}");
    let lossy = out.lines().find(|line| line.starts_with("/lossy")).unwrap();
    let lost: u64 = lossy.split_whitespace().nth(3).unwrap().parse().unwrap();
    let kept = place.read()["/lossy"].len() as u64;
    assert_eq!(kept + lost, 1002, "{out}");
    assert!((990..=991).contains(&lost) && out.contains("LOST"), "{out}");
    let (_, info, _) = place.run(&["bag", "info", "bag"]);
    assert!(info.contains(&format!("lost {lost} messages")), "{info}");
}

#[test]
fn what_is_lost_counts_where_nobody_reads_it() {
    let place = Place::new(148);
    let mut recorder = place.record(&["/never"]);
    drop(recorder.0.stdout.take());
    let (code, _, errors) = recorder.end();
    assert!(code == 1 && errors.contains("did not come or could not be: /never"), "{code}: {errors}");
}

#[test]
fn a_long_period_does_not_delay_the_end() {
    let place = Place::new(142);
    let publisher = place.publisher::<Count>("/seldom", Qos::default());
    let recorder = place.record(&["/seldom", "--period", "1h"]);
    place.wait_for_observer(publisher.gid());
    publisher.publish(&Count { n: 1 }).unwrap();
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(numbers(&place.read()["/seldom"]), [1]);
}

/// At the limit of open files nothing new is found, which is said; what is there is recorded, and what is new when that has passed.
#[test]
fn a_refusal_of_the_system_that_passes_ends_no_recording() {
    let place = Place::new(143);
    let first = place.publisher::<Count>("/first", Qos::default());
    let mut recorder = place.record(&["/first", "/late"]);
    place.wait_for_observer(first.gid());
    let pid = Some(Pid::from_child(&recorder.0));
    let limit = |limit| prlimit(pid, Resource::Nofile, limit).unwrap();
    let before = limit(Rlimit { current: Some(3), ..getrlimit(Resource::Nofile) });
    let other = Participant::new(143).unwrap();
    let late = other.create_publisher::<Count>("/late", Qos::default(), Limits::default()).unwrap();
    let mut told = BufReader::with_capacity(1, recorder.0.stderr.as_mut().unwrap());
    let mut line = String::new();
    while !line.contains("only when the system permits it") {
        line.clear();
        assert!(told.read_line(&mut line).unwrap() > 0, "it ended");
    }
    first.publish(&Count { n: 1 }).unwrap();
    limit(before);
    place.wait_for_observer(late.gid());
    late.publish(&Count { n: 2 }).unwrap();
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{out}{errors}");
    let topics = place.read();
    assert_eq!((numbers(&topics["/first"]), numbers(&topics["/late"])), (vec![1], vec![2]));
}

/// Also of the first publisher of a domain, which nobody knows before.
#[test]
fn what_came_before_the_recorder_found_it_is_counted() {
    let place = Place::new(46);
    let recorder = place.record(&["-a", "--json"]);
    let publisher = place.publisher::<Count>("/first", Qos::default());
    publisher.publish(&Count { n: 1 }).unwrap();
    place.wait_for_observer(publisher.gid());
    publisher.publish(&Count { n: 2 }).unwrap();
    let (code, out, errors) = recorder.end();
    let report: Value = serde_json::from_str(&out).unwrap();
    let (kept, lost) = (report["messages"].as_u64().unwrap(), report["lost"].as_u64().unwrap());
    assert_eq!((code, kept + lost), (i32::from(lost > 0), 2), "{out}{errors}");
}

#[test]
fn topics_are_chosen() {
    let place = Place::new(7);
    let publishers: Vec<Publisher<Count>> =
        ["/a/one", "/a/two", "/b/three"].map(|topic| place.publisher(topic, Qos::default())).into();
    let other: Publisher<Other> = place.publisher("/c/four", Qos::default());
    let wanted = ["-e", "^/a", "-x", "two", "--type", "demo_msgs/Other", "/b/three", "--depth", "100"];
    let recorder = place.record(&wanted);
    [0, 2].into_iter().for_each(|n| place.wait_for_observer(publishers[n].gid()));
    place.wait_for_observer(other.gid());
    publishers.iter().for_each(|publisher| publisher.publish(&Count { n: 1 }).unwrap());
    other.publish(&Other { n: 1 }).unwrap();
    // One that comes later, kept for who is late; and a topic that is of another type from now on.
    let late = place.publisher::<Count>("/a/late", Qos::keep_last(10).transient_local());
    (1..=7).for_each(|n| late.publish(&Count { n }).unwrap());
    place.wait_for_observer(late.gid());
    drop(other);
    let changed = place.publisher::<Count>("/c/four", Qos::default());
    changed.publish(&Count { n: 1 }).unwrap();
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}{out}");
    let topics = place.read();
    let counts: Vec<_> = topics.iter().map(|(name, messages)| (&**name, messages.len())).collect();
    assert_eq!(counts, [("/a/late", 7), ("/a/one", 1), ("/b/three", 1), ("/c/four", 1)]);

    let (code, _, errors) = place.run(&["record", "-o", "x"]);
    assert!(code == 2 && errors.contains("name topics, or give -a"), "{errors}");
    let (code, _, errors) = place.run(&["record", "-e", "(", "-o", "x"]);
    assert!(code == 2 && errors.contains("regex parse error"), "{errors}");
    let (code, _, errors) = place.run(&["record", "-a", "-o", "/proc/none/bag"]);
    assert!(code == 2 && errors.contains("'/proc/none' cannot be written"), "{errors}");
    let (code, _, errors) = place.run(&["record", "-a", "--budget", "900TB", "-o", "x"]);
    assert!(code == 2 && errors.contains("more than there is"), "{errors}");
}

#[test]
fn a_type_that_changes_is_another_topic() {
    let place = Place::new(9);
    let first = place.publisher::<Other>("/changing", Qos::keep_last(1).transient_local());
    first.publish(&Other { n: 7 }).unwrap();
    let recorder = place.record(&["/changing"]);
    place.wait_for_observer(first.gid());
    drop(first);
    let second = place.publisher::<Count>("/changing", Qos::keep_last(1).transient_local());
    second.publish(&Count { n: 8 }).unwrap();
    place.wait_for_observer(second.gid());
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}{out}");
    let (_, info, _) = place.run(&["bag", "info", "bag", "--json"]);
    let info: Value = serde_json::from_str(&info).unwrap();
    let of =
        |at: usize| (info["topics"][at]["type"].as_str().unwrap(), info["topics"][at]["messages"].as_u64());
    assert_eq!(of(0), ("demo_msgs/msg/Count", Some(1)));
    assert_eq!(of(1), ("demo_msgs/msg/Other", Some(1)));
}

#[test]
fn cores_of_real_time_threads_are_left_to_them() {
    let cores = CoreSet::allowed().unwrap();
    let bound = cores.iter().last().unwrap();
    if cores.len() < 2 || rt::permission::realtime_permitted(1).is_err() {
        println!("skipped: this takes two cores and real-time threads");
        return;
    }
    let place = Place::new(52);
    let publisher = place.publisher::<Count>("/count", Qos::default());
    let recorder = place.record(&["-a"]);
    place.wait_for_observer(publisher.gid());
    let pid = recorder.0.id();
    let is_there = |at_all: bool| {
        let threads = rt::threads_of(pid).unwrap();
        let mut there = threads.iter().map(|thread| thread.cores.contains(bound));
        if at_all { there.all(|there| there) } else { !there.any(|there| there) }
    };
    assert!(is_there(true));

    let (stop, stopped) = std::sync::mpsc::channel::<()>();
    let thread = ThreadBuilder::new("robot").policy(Policy::Fifo(1)).cores(CoreSet::one(bound));
    let thread = thread.spawn(move || move || stopped.recv().is_err()).unwrap();
    wait_for("the recorder to leave the core", || is_there(false));
    publisher.publish(&Count { n: 1 }).unwrap();
    drop(stop);
    assert!(thread.join().unwrap());
    wait_for("the recorder to come back", || is_there(true));
    let (code, _, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}");
    assert!(errors.contains("real-time threads are bound to the others"), "{errors}");
    assert!(errors.contains("on all cores again"), "{errors}");
    assert_eq!(numbers(&place.read()["/count"]), [1]);

    let (code, _, errors) = place.run(&["play", "bag", "--core", "4000"]);
    assert_eq!(code, 2, "{errors}");
    assert!(errors.contains("--core: core 4000"), "{errors}");
}

#[test]
fn a_recording_is_thinned_out_and_paused() {
    let place = Place::new(14);
    let [all, some] = ["/all", "/some"].map(|topic| place.publisher::<Count>(topic, Qos::default()));
    let recorder = place.record(&["-a", "--depth", "2000", "--throttle", "some=100", "--paused", "--json"]);
    place.wait_for_observer(all.gid());
    place.wait_for_observer(some.gid());
    all.publish(&Count { n: 1 }).unwrap();
    some.publish(&Count { n: 1 }).unwrap();
    // Nobody sees when it has looked: a hundred periods later it has.
    sleep_until_monotonic(monotonic_ns() + 200_000_000);
    recorder.signal("-USR1");
    sleep_until_monotonic(monotonic_ns() + 200_000_000);
    let start_ns = monotonic_ns();
    // What comes in time to be kept: a machine that has no time lets some come late, and then at once.
    let (mut due_ns, mut at_least) = (0, 0.0);
    for n in 0..1000 {
        sleep_until_monotonic(start_ns + n * 1_000_000);
        all.publish(&Count { n: n + 2 }).unwrap();
        let now_ns = monotonic_ns();
        some.publish(&Count { n: n + 2 }).unwrap();
        if now_ns > due_ns {
            (due_ns, at_least) = (monotonic_ns() + 10_000_000, at_least + 1.0);
        }
    }
    let seconds = (monotonic_ns() - start_ns) as f64 / 1e9;
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}{out}");
    let topics = place.read();
    assert_eq!(numbers(&topics["/all"]), (2..1002).collect::<Vec<_>>());
    let kept = topics["/some"].len() as f64;
    assert!((at_least..=100.0 * seconds + 2.0).contains(&kept), "{kept} of {at_least} in {seconds} s");
    let report: Value = serde_json::from_str(&out).unwrap();
    let some = report["topics"].as_array().unwrap().iter().find(|topic| topic["topic"] == "/some").unwrap();
    assert_eq!((&some["paused"], &some["throttled"]), (&1.into(), &(1000 - kept as u64).into()));
}

#[test]
fn what_a_new_publisher_sends_during_a_pause_is_not_lost() {
    let place = Place::new(155);
    let recorder = place.record(&["-a", "--paused", "--json"]);
    let publisher = place.publisher::<Count>("/new", Qos::default());
    place.wait_for_observer(publisher.gid());
    publisher.publish(&Count { n: 1 }).unwrap();
    // As above.
    sleep_until_monotonic(monotonic_ns() + 200_000_000);
    recorder.signal("-USR1");
    sleep_until_monotonic(monotonic_ns() + 200_000_000);
    publisher.publish(&Count { n: 2 }).unwrap();
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}{out}");
    assert_eq!(numbers(&place.read()["/new"]), [2]);
}

/// It comes through a port that the graph does not list, and that is older than the recording.
#[test]
fn the_past_of_another_hosts_topic_is_not_lost() {
    let place = Place::new(156);
    let gateway = Place::new(156);
    let port = gateway.publisher::<Count>("/far", Qos::default());
    let remote = TopicEndpoint {
        kind: EndpointKind::Publisher,
        topic: "/far".into(),
        topic_type: TopicType::of::<Count>(),
        gid: Gid([9; 16]),
        qos: Qos::default(),
        node: Some(NodeName { namespace: "/".into(), name: "far".into() }),
        pid: None,
        is_remote: true,
        is_own: false,
        origin: Origin { tag: Gid([9; 16]).tag(), ..Origin::default() },
        teller: None,
    };
    gateway
        .participant
        .set_remote(&RemoteGraph { endpoints: vec![remote], ..RemoteGraph::default() })
        .unwrap();
    (1..=100).for_each(|n| port.publish(&Count { n }).unwrap());
    let recorder = place.record(&["/far", "--depth", "2000", "--json"]);
    // Nobody sees when the recorder is connected to such a port.
    let start_ns = monotonic_ns();
    for n in 0..1000 {
        sleep_until_monotonic(start_ns + n * 1_000_000);
        port.publish(&Count { n: 101 + n }).unwrap();
    }
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}{out}");
    assert_eq!(numbers(&place.read()["/far"]).last(), Some(&1100));
}

/// Each publisher's last message is in the bag though the recorder began with a pause, in a channel of the publisher; a topic without
/// messages is in it, too.
#[test]
fn what_publishers_keep_is_recorded_after_a_pause() {
    let place = Place::new(38);
    let latched = Qos::keep_last(1).transient_local();
    let [camera, lidar] = [(); 2].map(|()| place.publisher::<Count>("/tf_static", latched));
    let silent = place.publisher::<Other>("/silent", Qos::default());
    let tick = place.publisher::<Other>("/tick", Qos::default());
    (1..=3).for_each(|n| camera.publish(&Count { n }).unwrap());
    lidar.publish(&Count { n: 10 }).unwrap();
    let recorder = place.record(&["-a", "--paused", "--json"]);
    place.wait_for_observers([&camera, &lidar].map(Publisher::gid));
    place.wait_for_observers([&silent, &tick].map(Publisher::gid));
    tick.publish(&Other { n: 0 }).unwrap();
    let summary = || {
        let mut reader = FileReader::open(&files_of(&place.bag()).unwrap()[0]).unwrap();
        reader.read(&mut |_| Ok::<_, BagError>(())).unwrap();
        reader.summary()
    };
    assert_eq!(summary().messages, 0, "it is paused");
    recorder.signal("-USR1");
    wait_for("a message", || {
        tick.publish(&Other { n: 1 }).unwrap();
        summary().messages > 2
    });
    camera.publish(&Count { n: 4 }).unwrap();
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{errors}{out}");
    let topics = place.read();
    let mut kept = numbers(&topics["/tf_static"]);
    assert_eq!(kept.pop(), Some(4));
    kept.sort_unstable();
    assert_eq!(kept, [3, 10]);
    let messages = |name: &str| {
        let topics = summary().topics;
        topics.values().find(|(topic, _)| topic.name == name).map(|(_, messages)| *messages)
    };
    assert_eq!((messages("/silent"), messages("/tf_static")), (Some(0), Some(3)));
    let bag = tautline_bag::Ordered::open(&place.bag(), &mut |_| {}).unwrap();
    let of_tf = bag.topics().iter().filter(|topic| topic.name == "/tf_static");
    let publishers: Vec<_> = of_tf.map(|topic| topic.metadata[tautline_bag::PUBLISHER].clone()).collect();
    assert!(publishers.len() == 2 && publishers[0] != publishers[1], "{publishers:?}");
}

/// How many times longer than alone a thread needs now that computes and writes: what the machine gives, measured until the sender is gone.
fn slowdown(file: PathBuf, until: std::sync::mpsc::Receiver<()>) -> std::thread::JoinHandle<f64> {
    std::thread::spawn(move || {
        let (start_ns, cpu_ns) = (monotonic_ns(), rt::clock::thread_cpu_ns());
        while until.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {
            rt::clock::burn_cpu(std::time::Duration::from_millis(2));
            std::fs::write(&file, [0; 1 << 16]).unwrap();
        }
        (monotonic_ns() - start_ns) as f64 / (rt::clock::thread_cpu_ns() - cpu_ns) as f64
    })
}

/// Killed at random instants, it leaves a bag of all but the last second, on a machine that has time for it. `TAUT_KILLS` says how often.
#[test]
fn a_kill_costs_no_more_than_the_last_second() {
    let kills: u64 = std::env::var("TAUT_KILLS").map_or(6, |kills| kills.parse().unwrap());
    let seed = tautline_seed::seed();
    let place = Place::new(16);
    let mut state = seed | 1;
    for kill in 0..kills {
        // The recorder before may still be somebody to its topic.
        let topic = format!("/killed_{kill}");
        let publisher = place.publisher::<Count>(&topic, Qos::default());
        let camera_topic = format!("/camera_{kill}");
        // Longer than what is on its way to the disk at once.
        let (mut image, topic_type) = (vec![0; 600_000], TopicType::new("demo_msgs/msg/Bytes"));
        let limits = Limits { message_bytes: image.len(), ..Limits::default() };
        let qos = Qos::keep_last(10);
        let camera = place.participant.create_raw_publisher(&camera_topic, &topic_type, qos, limits).unwrap();
        let compression = ["none", "zstd", "lz4"][kill as usize % 3];
        let mut recorder =
            place.record(&[&topic, &camera_topic, "--depth", "200", "--compression", compression]);
        place.wait_for_observers([publisher.gid(), camera.gid()]);
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let (is_sending, sends) = std::sync::mpsc::channel();
        let slowdown = slowdown(place.folder.path().join("control"), sends);
        let (start_ns, time_ns) = (monotonic_ns(), state % 2_000_000_000);
        let (mut sent, mut sent_images) = (Vec::new(), Vec::new());
        for n in 0.. {
            sleep_until_monotonic(start_ns + n * 1_000_000);
            let now_ns = monotonic_ns();
            if now_ns > start_ns + time_ns {
                break;
            }
            publisher.publish(&Count { n }).unwrap();
            if n % 20 == 0 {
                image[..8].copy_from_slice(&(n / 20).to_le_bytes());
                camera.publish(&image).unwrap();
                sent_images.push(now_ns);
            }
            sent.push(now_ns);
        }
        recorder.0.kill().unwrap();
        let killed_ns = monotonic_ns();
        recorder.0.wait().unwrap();
        drop(is_sending);
        let slowdown = slowdown.join().unwrap();
        let (code, out, errors) = place.run(&["bag", "recover", "bag"]);
        assert_eq!(code, 0, "{out}{errors}");
        let topics = place.read();
        // Of each topic by itself: which of two is taken first is up to the recorder.
        for (topic, sent, latest_first) in [(&topic, &sent, 100.0), (&camera_topic, &sent_images, 5.0)] {
            let kept = topics.get(topic).map_or(Vec::new(), |messages| numbers(messages));
            let first = kept.first().copied().unwrap_or(0);
            assert_eq!(kept, (first..).take(kept.len()).collect::<Vec<_>>());
            let second_ns = (1e9 * slowdown) as u64;
            let certain = sent.iter().filter(|sent_ns| killed_ns - *sent_ns > second_ns).count();
            let until = first as usize + kept.len();
            assert!(
                (first as f64) < latest_first * slowdown && until >= certain,
                "{topic}, killed after {time_ns} ns, {slowdown} x as slow: {first}..{until} of {certain}"
            );
        }
        assert_eq!(place.run(&["bag", "check", "bag"]).0, 0);
        std::fs::remove_dir_all(place.bag()).unwrap();
    }
}

/// Of every topic, however many there are; `TAUT_TOPICS` says so.
#[test]
fn very_many_topics_are_recorded() {
    let many: usize = std::env::var("TAUT_TOPICS").map_or(1000, |topics| topics.parse().unwrap());
    let place = Place::new(49);
    let limits = Limits { loans: 1, ..Limits::default() };
    let start_ns = monotonic_ns();
    let seconds = || (monotonic_ns() - start_ns) as f64 / 1e9;
    let participants: Vec<_> = (0..many.div_ceil(500)).map(|_| Participant::new(49).unwrap()).collect();
    let create = |n: usize| -> Publisher<Count> {
        participants[n / 500].create_publisher(&format!("/topic_{n}"), Qos::keep_last(1), limits).unwrap()
    };
    let publishers: Vec<_> = (0..many).map(create).collect();
    println!("{many} topics are there after {:.1} s", seconds());
    let recorder = place.record(&["-a", "--json", "--depth", "4"]);
    place.wait_for_observers(publishers.iter().map(|publisher| publisher.gid()));
    println!("they are recorded after {:.1} s", seconds());
    for publisher in &publishers {
        (0..3).for_each(|n| publisher.publish(&Count { n }).unwrap());
    }
    let (code, out, errors) = recorder.end();
    println!("all is over after {:.1} s", seconds());
    let report: Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{code}: {errors}"));
    assert_eq!((code, &report["lost"]), (0, &0.into()), "{errors}");
    let stalls = report["topics"].as_array().unwrap().iter().map(|topic| topic["longest_stall_ns"].as_u64());
    println!("longest stall {:.1} ms", stalls.flatten().max().unwrap() as f64 / 1e6);
    let bag = place.read();
    assert_eq!(bag.len(), many);
    assert!(bag.values().all(|messages| numbers(messages) == [0, 1, 2]));
    assert_eq!(place.run(&["bag", "check", "bag"]).0, 0);
}

/// On a disk of some 3 MB/s: what the memory has room for is written, however late, and what it has none for is counted.
#[test]
fn a_slow_disk_loses_what_there_is_no_room_for_and_says_so() {
    let place = Place::new(50);
    let source = place.folder.path().join("slow.c");
    let library = place.folder.path().join("slow.so");
    std::fs::write(&source, SLOW_DISK).unwrap();
    let compiled =
        Command::new("cc").args(["-shared", "-fPIC", "-O1", "-o"]).args([&library, &source]).status();
    assert!(compiled.unwrap().success(), "cc is needed");
    let limits = Limits { message_bytes: 10_000, ..Limits::default() };
    let topic_type = TopicType::new("demo_msgs/msg/Bytes");
    // The recorder before may still be somebody to its topic.
    for (topic, budget, has_room) in [("/much", "64MB", true), ("/little", "1MB", false)] {
        let publisher =
            place.participant.create_raw_publisher(topic, &topic_type, Qos::keep_last(100), limits).unwrap();
        let mut command = place.command(&["record", topic, "-o", "bag", "--json", "--budget", budget]);
        let recorder = Recorder(command.env("LD_PRELOAD", &library).spawn().unwrap());
        place.wait_for_observer(publisher.gid());
        let start_ns = monotonic_ns();
        for n in 0..2000_u64 {
            sleep_until_monotonic(start_ns + n * 500_000);
            let mut body = vec![n as u8; 10_000];
            body[..8].copy_from_slice(&n.to_le_bytes());
            publisher.publish(&body).unwrap();
        }
        let (code, out, errors) = recorder.end();
        let report: Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{code}: {errors}"));
        let (kept, lost) = (report["messages"].as_u64().unwrap(), report["lost"].as_u64().unwrap());
        assert_eq!((kept + lost, code), (2000, i32::from(lost > 0)), "{budget}: {out}{errors}");
        assert!(report["longest_write_ns"].as_u64().unwrap() >= 20_000_000, "{out}");
        let full = report["budget_exhausted"].as_u64().unwrap();
        assert_eq!((lost == 0, full == 0), (has_room, has_room), "{budget}: {lost} lost");
        assert!(has_room || errors.contains("a greater --budget slower disks"), "{errors}");
        let messages = &place.read()[topic];
        assert!(messages.len() as u64 == kept && numbers(messages).is_sorted(), "{budget}");
        std::fs::remove_dir_all(place.bag()).unwrap();
    }
}

/// Each write of a file that has some length takes a while.
const SLOW_DISK: &str = r#"
#include <sys/syscall.h>
#include <sys/types.h>
#include <unistd.h>
ssize_t pwrite64(int fd, const void *bytes, size_t length, off_t offset) {
    if (length > 10000) usleep(20000);
    return syscall(SYS_pwrite64, fd, bytes, length > 65536 ? 65536 : length, offset);
}
ssize_t pwrite(int fd, const void *bytes, size_t length, off_t offset) {
    return pwrite64(fd, bytes, length, offset);
}
"#;

/// On a disk of 4 MB: what is in the bag is whole.
#[test]
fn a_full_disk_ends_a_bag_that_is_whole() {
    let place = Place::new(75);
    let disk = place.folder.path().join("disk");
    std::fs::create_dir(&disk).unwrap();
    let limits = Limits { message_bytes: 10_000, ..Limits::default() };
    let topic_type = TopicType::new("demo_msgs/msg/Bytes");
    let publisher: RawPublisher =
        place.participant.create_raw_publisher("/bytes", &topic_type, Qos::keep_last(100), limits).unwrap();
    let script = "mount -t tmpfs -o size=4m none disk && { \"$0\" record /bytes -o disk/bag --budget 8MB; code=$?; \
                  cp -r disk/bag bag; exit $code; }";
    let user: &[&str] = if rustix::process::geteuid().is_root() { &[] } else { &["--map-root-user"] };
    let tried = Command::new("unshare")
        .arg("--mount")
        .args(user)
        .args(["mount", "-t", "tmpfs", "none"])
        .arg(&disk)
        .output();
    if !tried.is_ok_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "CI must permit `unshare --mount`");
        eprintln!("skipped: no mount namespaces are permitted");
        return;
    }
    let mut command = Command::new("unshare");
    command.arg("--mount").args(user).args(["sh", "-c", script, env!("CARGO_BIN_EXE_taut")]);
    command.env("TAUT_DOMAIN", place.domain.to_string()).current_dir(place.folder.path());
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut recorder = Recorder(child);
    place.wait_for_observer(publisher.gid());
    for n in 0u64.. {
        let mut body = vec![n as u8; 10_000];
        body[..8].copy_from_slice(&n.to_le_bytes());
        publisher.publish(&body).unwrap();
        sleep_until_monotonic(monotonic_ns() + 200_000);
        if recorder.0.try_wait().unwrap().is_some() {
            break;
        }
    }
    let (code, out, errors) = ended(recorder.0.wait_with_output().unwrap());
    assert!(code == 2 && errors.contains("is full"), "{code}: {out}{errors}");
    let messages = &place.read()["/bytes"];
    assert!(messages.len() > 300, "{}: {out}", messages.len());
    let (code, out, errors) = place.run(&["bag", "check", "bag"]);
    assert_eq!(code, 0, "{out}{errors}");
}

/// Requests and responses of a service and of an action's are in the bag as ROS's events, which others read; nobody else sees more.
#[test]
fn services_and_actions_are_recorded_as_events() {
    let place = Place::new(36);
    let mut here = Here::new(place.domain);
    let mut node = here.node("robot", "");
    let qos = Qos::services_default();
    let requests = node.create_service::<AddTwoInts::Service>("/add", qos).unwrap().owned();
    here.serve(
        &mut node,
        requests.for_each(|request| {
            let AddTwoInts::Request { a, b } = request.message;
            request.respond(AddTwoInts::Response { sum: a + b }).unwrap();
            std::future::ready(())
        }),
    );
    let goals = node.create_action_server::<Fibonacci::Action>("/count").unwrap();
    here.serve(
        &mut node,
        goals.for_each(|request| {
            let (goal, _cancels) = request.accept().unwrap();
            goal.publish_feedback(Fibonacci::Feedback { sequence: vec![0] }).unwrap();
            let mut goal = goal;
            goal.succeed(Fibonacci::Result { sequence: vec![0, 1, 1] }).unwrap();
            std::future::ready(())
        }),
    );
    let _add = node.create_client::<AddTwoInts::Service>("/add").unwrap();
    let _count = node.create_action_client::<Fibonacci::Action>("/count").unwrap();
    let unknown = place.participant.create_raw_server(
        "/odd",
        &ServiceType::new("odd_srvs/srv/Odd", None),
        1,
        Limits::default(),
    );
    let recorder = place.record(&["--service", "add", "--service", "/odd", "--action", "/count", "--json"]);
    let graph = place.participant.graph().unwrap();
    let clients = graph.services.iter().filter(|end| end.kind == ServiceKind::Client).map(|end| end.gid);
    assert_eq!(clients.clone().count(), 4);
    place.wait_for_observers(clients);
    for n in 0..20 {
        let [request, response] = [format!("{{a: {n}, b: 2}}"), format!("sum: {}\n", n + 2)];
        assert_eq!(here.taut(&["service", "call", "/add", &request]), response);
    }
    here.taut(&["action", "send_goal", "/count", "{order: 3}", "--feedback"]);
    let (code, out, errors) = recorder.end();
    drop(unknown);
    assert!(code == 1 && errors.contains("the definition of odd_srvs/srv/Odd is not known"), "{errors}");
    assert!(errors.contains("could not be: /odd/_service_event"), "{errors}");
    let report: Value = serde_json::from_str(&out).unwrap();
    let counted = |topic: &str, part: &str| {
        let mut topics = report["topics"].as_array().unwrap().iter();
        let it = topics.find(|it| it["topic"] == topic && it["part"] == part);
        it.map_or(0, |it| it["messages"].as_u64().unwrap())
    };
    assert_eq!(report["lost"], 0, "{out}");
    let mut expected = String::new();
    for (service, calls) in [("/add", 20), ("/count/_action/send_goal", 1), ("/count/_action/get_result", 1)]
    {
        let topic = format!("{service}/_service_event");
        assert_eq!([counted(&topic, "requests"), counted(&topic, "responses")], [calls; 2], "{service}");
    }
    // In the order of their reception: a request and its response in one look are told apart by the order of the observers.
    for n in 0..20 {
        let event = |kind: u8, request: String, response: String| {
            format!(
                "/add/_service_event {{\"info\": {{\"event_type\": {kind}, \"sequence_number\": 1}}, \"request\": [{request}], \
                 \"response\": [{response}]}}\n"
            )
        };
        expected += &event(0, format!("{{\"a\": {n}, \"b\": 2}}"), String::new());
        expected += &event(2, String::new(), format!("{{\"sum\": {}}}", n + 2));
    }
    assert_eq!(counted("/count/_action/feedback", "messages"), 1);
    expected += "/count/_action/feedback {\"feedback\": {\"sequence\": [0]}}\n";
    expected += "/count/_action/send_goal/_service_event {\"request\": [{\"goal\": {\"order\": 3}}], \"response\": []}\n";
    expected +=
        "/count/_action/send_goal/_service_event {\"request\": [], \"response\": [{\"accepted\": true}]}\n";
    expected +=
        "/count/_action/get_result/_service_event {\"info\": {\"event_type\": 0}, \"response\": []}\n";
    expected += "/count/_action/get_result/_service_event {\"response\": [{\"status\": 4, \"result\": {\"sequence\": [0, 1, 1]}}]}\n";
    for _ in 0..counted("/count/_action/status", "messages") {
        expected += "/count/_action/status {}\n";
    }
    // As any topic they are played, and checked.
    let (code, played, errors) = place.run(&["play", "bag", "-x", "_action"]);
    assert!(code == 0 && played.contains("40 messages") && !errors.contains("warning"), "{played}{errors}");
    let Some(venv) = ros::ros() else { return };
    let wanted = place.folder.path().join("expected");
    std::fs::write(&wanted, &expected).unwrap();
    let messages = expected.lines().count();
    let mut script = Command::new(venv.join("bin/python"));
    script
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/bag_values.py"))
        .args([&place.bag(), &wanted]);
    let (code, out, errors) = ended(script.env_remove("LD_LIBRARY_PATH").output().unwrap());
    let states = counted("/count/_action/status", "messages");
    let read = format!("rosbags {messages}\nmcap-ros2-support {states}\n");
    assert!(code == 0 && out.starts_with(&read), "{out}{errors}");
}

/// Every type of a real ROS 2, random values: rclpy's bytes through Tautline and the recorder to readers that are not ours; from a bag that
/// is written by one of them through `taut play` and the recorder again.
#[test]
fn others_read_every_value() {
    let Some(venv) = ros::ros() else { return };
    let seed = tautline_seed::seed();
    let place = Place::new(197);
    let mut packages = ros::packages(&venv);
    let mut peer = Peer::start(&venv);
    let names: Vec<_> = packages.list().into_iter().filter(|name| name.kind() == Kind::Msg).collect();
    let (mut publishers, mut expected, mut narrow) = (Vec::new(), String::new(), 0);
    for name in &names {
        let schema = packages.schema(name).unwrap();
        let topic = format!("/{}", name.as_str().replace('/', "_").to_lowercase());
        let topic_type = TopicType::new(name.to_string())
            .with_hash(schema.hash().to_string())
            .with_definition(schema.to_text());
        narrow += usize::from(!schema.to_text().contains("wstring"));
        let limits = Limits { message_bytes: 64, ..Limits::default() };
        let publisher = place.participant.create_raw_publisher(
            &topic,
            &topic_type,
            Qos::keep_last(5).transient_local(),
            limits,
        );
        let messages = peer.messages(name, 5, seed);
        // What comes of them is not asked for.
        peer.answer(&messages.iter().map(|(cdr, _)| format!("{} \"\"\n", hex(cdr))).collect::<String>());
        // As the middleware has them: what serialize_message() allocated beyond them is none of it.
        let schema = Arc::new(schema);
        let bodies =
            messages.iter().map(|(cdr, _)| DynamicMessage::from_cdr(&schema, cdr).unwrap().to_body());
        publishers.push((publisher.unwrap(), bodies.collect::<Vec<_>>()));
        messages.iter().for_each(|(_, json)| expected += &format!("{topic} {json}\n"));
    }
    for (publisher, bodies) in &publishers {
        bodies.iter().for_each(|body| publisher.publish(body).unwrap());
    }
    let script = |name: &str, args: &[&Path]| {
        let mut script = Command::new(venv.join("bin/python"));
        script.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(name)).args(args);
        let (code, out, errors) = ended(script.env_remove("LD_LIBRARY_PATH").output().unwrap());
        assert_eq!(code, 0, "{out}{errors}");
        out
    };
    let [wanted, theirs] = ["expected", "theirs"].map(|name| place.folder.path().join(name));
    std::fs::write(&wanted, expected).unwrap();
    let mut others_read = || {
        let out = script("bag_values.py", &[&place.bag(), &wanted]);
        let read = format!("rosbags {0}\nmcap-ros2-support {0}\nother hashes", narrow * 5);
        let rest = out.strip_prefix(&read).unwrap_or_else(|| panic!("{out}"));
        // It takes ROS's char for another type than ROS does.
        for name in rest.split_whitespace() {
            let schema = packages.schema(&name.parse().unwrap()).unwrap();
            assert!(schema.to_text().contains("char"), "{name}");
        }
    };
    for compression in ["none", "zstd", "lz4"] {
        let recorder = place.record(&["-a", "--compression", compression]);
        place.wait_for_observers(publishers.iter().map(|(publisher, _)| publisher.gid()));
        let (code, out, errors) = recorder.end();
        assert_eq!(code, 0, "{out}{errors}");
        others_read();
        if compression == "lz4" {
            script("bag_copy.py", &[&place.bag(), &theirs]);
        }
        std::fs::remove_dir_all(place.bag()).unwrap();
    }
    let count = publishers.len();
    drop(publishers);
    let recorder = place.record(&["-a"]);
    let player = Recorder(place.command(&["play", "theirs", "--paused"]).spawn().unwrap());
    let mut graph = place.participant.graph().unwrap();
    wait_for("the player", || {
        graph = place.participant.graph().unwrap();
        graph.endpoints.iter().filter(|end| end.kind == EndpointKind::Publisher).count() == count
    });
    place.wait_for_observers(graph.endpoints.iter().map(|end| end.gid));
    player.signal("-USR1");
    let (code, out, errors) = ended(player.0.wait_with_output().unwrap());
    assert!(code == 0 && out.contains(&format!("{} messages", count * 5)), "{out}{errors}");
    let (code, out, errors) = recorder.end();
    assert_eq!(code, 0, "{out}{errors}");
    others_read();
    assert!(narrow > 160, "{narrow} types of {}", names.len());
}

#[test]
fn what_is_no_bag_is_said() {
    let place = Place::new(180);
    let (code, _, errors) = place.run(&["bag", "info", "none"]);
    assert!(code == 2 && errors.contains("'none' cannot be read"), "{errors}");
    std::fs::write(place.folder.path().join("text.mcap"), "no magic at all, but more bytes than it takes")
        .unwrap();
    for verb in ["info", "check", "recover"] {
        let (code, _, errors) = place.run(&["bag", verb, "text.mcap"]);
        assert!(code == 2 && errors.contains("does not begin as an MCAP file"), "{verb}: {errors}");
    }
    let (code, _, errors) = place.run(&["bag", "info", "text.mcap", "--domain", "3"]);
    assert!(code == 2 && errors.contains("a bag is of no domain"), "{errors}");
}

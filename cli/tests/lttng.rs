// SPDX-License-Identifier: MIT OR Apache-2.0
//! One run of a program, recorded twice: by LTTng and by the rings. Every event is in both, and the latencies agree.
//!
//! Needs lttng-tools and babeltrace2; without them it is skipped with the reason, but not where CI is set.
#![cfg(feature = "lttng")]

mod traced;

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use traced::{MESSAGES, Program, scratch, taut, text};

#[test]
fn lttng_and_the_rings_agree() {
    let name = "lttng_and_the_rings_agree";
    let program = Program::new(name, 231);
    if Program::is_this() {
        assert!(program.run().is_none());
        return;
    }
    if tautline_rt::permission::test_needs(tools()).is_none() {
        return;
    }
    let directory = scratch("lttng");
    let session = Session::start(&directory);
    let run = program.variable("LTTNG_HOME", &session.home).run().unwrap();
    let lttng = session.stop();
    let rings = ring_events(&run.recording);

    // Of each kind the same number, in each thread the same objects and messages in the same order.
    for (of_ring, of_lttng) in PAIRS {
        let (ours, theirs) = (of_kind(&rings, of_ring), of_kind(&lttng, of_lttng));
        // The program waits without a time-out.
        assert!(!ours.is_empty() || of_ring == "spin_timeout", "{of_ring}");
        assert_eq!(ours.len(), theirs.len(), "{of_lttng}");
        let other = ours.iter().zip(&theirs).find(|(ours, theirs)| !ours.is(theirs));
        assert_eq!(other, None, "{of_lttng}");
        // Both are stamped in one function of one thread by one clock, the ring first.
        let early = ours.iter().zip(&theirs).find(|(ours, theirs)| theirs.time_ns < ours.time_ns);
        assert_eq!(early, None, "{of_ring}");
    }

    // From the publication of each message to the start of its callback. Preemption between the two stamps of an event
    // makes single differences as large as it likes: what is compared is the median.
    let (ours, theirs) = (latencies(&rings, "publish"), latencies(&lttng, "ros2:rclcpp_publish"));
    assert_eq!((ours.len(), theirs.len()), (MESSAGES, MESSAGES));
    let mut differences: Vec<u64> =
        ours.iter().map(|(message, latency_ns)| latency_ns.abs_diff(theirs[message])).collect();
    differences.sort_unstable();
    let median_ns = differences[MESSAGES / 2];
    println!("publish to callback start: median of |LTTng - ring| {median_ns} ns of {MESSAGES} messages");
    assert!(median_ns < 10_000, "stamps of one event are a function call apart, not {median_ns} ns");

    // What Ros2TraceAnalyzer starts from.
    for (kind, field, value) in [
        ("ros2:rcl_node_init", "node_name", "\"traced\""),
        ("ros2:rcl_publisher_init", "topic_name", "\"/traced/numbers\""),
        ("ros2:rcl_subscription_init", "topic_name", "\"/traced/numbers\""),
        ("ros2:rclcpp_callback_register", "symbol", "\"/traced/numbers\""),
    ] {
        assert!(of_kind(&lttng, kind).iter().any(|event| event.fields[field] == value), "{kind}");
    }
    let node = of_kind(&lttng, "ros2:rcl_node_init")[0].object;
    assert!(of_kind(&lttng, "r2r:spin_wake").iter().all(|event| event.object == node));
    for kind in ["ros2:rcl_init", "ros2:rmw_publisher_init", "ros2:rclcpp_subscription_init"] {
        assert!(!of_kind(&lttng, kind).is_empty(), "{kind}");
    }
    std::fs::remove_dir_all(directory).unwrap();
}

/// The same event in the rings and in LTTng.
const PAIRS: [(&str, &str); 10] = [
    ("publish", "ros2:rclcpp_publish"),
    ("publish", "ros2:rcl_publish"),
    ("publish", "ros2:rmw_publish"),
    ("take", "ros2:rmw_take"),
    ("callback_start", "ros2:callback_start"),
    ("callback_end", "ros2:callback_end"),
    ("spin_start", "r2r:spin_start"),
    ("spin_wake", "r2r:spin_wake"),
    ("spin_timeout", "r2r:spin_timeout"),
    ("spin_end", "r2r:spin_end"),
];

#[derive(Debug, PartialEq, Eq)]
struct Event {
    kind: String,
    time_ns: u64,
    tid: u32,
    /// Publisher, subscription, callback, sampler.
    object: u64,
    /// The message's source time stamp.
    timestamp: i64,
    fields: HashMap<String, String>,
}

impl Event {
    /// Whether LTTng's event is this one, as far as its fields tell.
    fn is(&self, other: &Event) -> bool {
        // A spin event is the sampler's here and, as in r2r, its node's there.
        let spin = self.kind.starts_with("spin_");
        let object = other.object == 0 || other.object == self.object || spin;
        self.tid == other.tid && object && (other.timestamp == 0 || other.timestamp == self.timestamp)
    }
}

fn of_kind<'e>(events: &'e [Event], kind: &str) -> Vec<&'e Event> {
    events.iter().filter(|event| event.kind == kind).collect()
}

/// By source time stamp: from `publish` to the callback's start that follows the take of the same message.
fn latencies(events: &[Event], publish: &str) -> BTreeMap<i64, u64> {
    let (mut published, mut taken, mut latencies) = (HashMap::new(), HashMap::new(), BTreeMap::new());
    // LTTng's rclcpp_publish has no time stamp: it belongs to the rmw_publish that follows in its thread.
    let mut begun = HashMap::new();
    for event in events {
        match event.kind.as_str() {
            kind if kind == publish && event.timestamp != 0 => {
                published.insert(event.timestamp, event.time_ns);
            }
            kind if kind == publish => {
                begun.insert(event.tid, event.time_ns);
            }
            "ros2:rmw_publish" => {
                published.insert(event.timestamp, begun[&event.tid]);
            }
            "take" | "ros2:rmw_take" => {
                taken.insert(event.tid, event.timestamp);
            }
            "callback_start" | "ros2:callback_start" => {
                let message = taken.remove(&event.tid).unwrap();
                latencies.insert(message, event.time_ns - published[&message]);
            }
            _ => {}
        }
    }
    latencies
}

fn ring_events(recording: &Path) -> Vec<Event> {
    let out = taut(&["trace", "export", &recording.display().to_string(), "--format", "csv", "-o", "-"]);
    let (text, mut events) = (text(&out.stdout), Vec::new());
    let mut lines = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let head = lines.next().unwrap();
    let column = |name: &str| head.iter().position(|column| *column == name).unwrap();
    let columns = ["time_ns", "tid", "event", "object_id", "source_timestamp_ns"].map(column);
    for line in lines {
        let [time_ns, tid, kind, object, timestamp] = columns.map(|column| line[column]);
        // What was made was made by nobody in particular.
        let Ok(tid) = tid.parse() else { continue };
        events.push(Event {
            kind: kind.to_owned(),
            time_ns: time_ns.parse().unwrap(),
            tid,
            object: object.parse().unwrap(),
            timestamp: timestamp.parse().unwrap_or(0),
            fields: HashMap::new(),
        });
    }
    events
}

/// Whether LTTng is there.
fn tools() -> Result<(), String> {
    for tool in ["lttng", "lttng-sessiond", "babeltrace2"] {
        let found = Command::new(tool).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        if !found.is_ok_and(|status| status.success()) {
            return Err(format!(
                "{tool} is missing: sudo apt install lttng-tools liblttng-ust-dev babeltrace2"
            ));
        }
    }
    Ok(())
}

/// A session that records all of both providers, and its daemon unless one runs already.
struct Session {
    daemon: Child,
    name: String,
    home: String,
    output: PathBuf,
}

impl Session {
    fn start(directory: &Path) -> Session {
        // For root the daemon's place is one and the same; for anybody else it is here.
        let home = directory.display().to_string();
        let mut command = Command::new("lttng-sessiond");
        command.args(["--no-kernel"]).env("LTTNG_HOME", &home).stdout(Stdio::null()).stderr(Stdio::null());
        let (daemon, name) = (command.spawn().unwrap(), format!("tautline-{}", std::process::id()));
        let session = Session { daemon, name, home, output: directory.join("ctf") };
        let output = session.output.display().to_string();
        // The daemon needs a moment; one that runs already makes ours end, and serves.
        let start = std::time::Instant::now();
        while !session.try_lttng(&["create", &session.name, "--output", &output]) {
            assert!(start.elapsed().as_secs() < 60, "no session in a minute");
            std::thread::yield_now();
        }
        let of_session = ["--session", &session.name];
        for events in ["ros2:*", "r2r:*"] {
            session.lttng(&[&["enable-event", "--userspace", events], &of_session[..]].concat());
        }
        let contexts = ["--type", "vtid", "--type", "vpid", "--type", "procname"];
        session.lttng(&[&["add-context", "--userspace"], &of_session[..], &contexts].concat());
        session.lttng(&["start", &session.name]);
        session
    }

    fn try_lttng(&self, arguments: &[&str]) -> bool {
        let mut command = Command::new("lttng");
        command.args(["--no-sessiond"]).args(arguments).env("LTTNG_HOME", &self.home);
        command.stdout(Stdio::null()).stderr(Stdio::null()).status().unwrap().success()
    }

    fn lttng(&self, arguments: &[&str]) {
        assert!(self.try_lttng(arguments), "lttng {arguments:?}");
    }

    /// Ends it; returns its events in order of time.
    fn stop(self) -> Vec<Event> {
        self.lttng(&["stop", &self.name]);
        self.lttng(&["destroy", &self.name]);
        let mut command = Command::new("babeltrace2");
        command.args(["--clock-cycles", "--no-delta", "--names", "payload,context"]).arg(&self.output);
        let out = command.output().unwrap();
        assert!(out.status.success(), "{}", text(&out.stderr));
        let events: Vec<Event> = text(&out.stdout).lines().map(event).collect();
        assert!(!events.is_empty(), "not one event: were the tracepoints linked in?");
        events
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.try_lttng(&["destroy", &self.name]);
        }
        // Asked to: it removes its files and ends its consumers.
        let _ = Command::new("kill").arg(self.daemon.id().to_string()).stderr(Stdio::null()).status();
        let _ = self.daemon.wait();
    }
}

/// `[cycles] host kind: { cpu_id = 0 }, { vtid = 1, vpid = 2, procname = "x" }, { callback = 0x5, is_intra_process = 0 }`
fn event(line: &str) -> Event {
    let (time, rest) = line.trim_start_matches('[').split_once(']').unwrap_or_else(|| panic!("{line}"));
    let (head, _) = rest.split_once(" { ").unwrap_or_else(|| panic!("{line}"));
    let kind = head.trim_end_matches([':', ' ']).rsplit(' ').next().unwrap().to_owned();
    let mut fields = HashMap::new();
    for part in rest.split(['{', '}', ',']) {
        if let Some((name, value)) = part.split_once(" = ") {
            fields.insert(name.trim().to_owned(), value.trim().to_owned());
        }
    }
    let number = |name: &str| -> Option<i64> {
        let value = fields.get(name)?;
        match value.strip_prefix("0x") {
            Some(hex) => u64::from_str_radix(hex, 16).ok().map(u64::cast_signed),
            None => value.parse().ok(),
        }
    };
    let handles =
        ["rmw_publisher_handle", "publisher_handle", "rmw_subscription_handle", "callback", "node_handle"];
    Event {
        time_ns: time.parse().unwrap_or_else(|_| panic!("{line}")),
        tid: u32::try_from(number("vtid").unwrap()).unwrap(),
        object: handles.iter().find_map(|handle| number(handle)).unwrap_or(0).cast_unsigned(),
        timestamp: number("timestamp").or_else(|| number("source_timestamp")).unwrap_or(0),
        kind,
        fields,
    }
}

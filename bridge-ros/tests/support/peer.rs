// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of rclpy and programs, in processes of their own, and patience. Tests of the bridge and of the RMW have it in common.

use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tautline_schema::{DynamicMessage, Endian, Packages};
use tautline_transport::{Limits, Participant, Qos, RawPublisher, RawSubscription, TopicType};

#[path = "../../../cli/tests/support/schemas.rs"]
mod schemas;

/// Nothing takes so long unless it is broken: the end of every wait.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// The scope of whoever runs the tests, or one that no user's programs are in.
pub fn scope() -> &'static str {
    tautline_rt::domain::test_scope("test")
}

/// Puts this process into [`scope`] and has the domain with this number, of both sides, for it alone until it ends: other tests wait.
pub fn reserve(domain: u32) {
    static RESERVED: Mutex<BTreeMap<u32, File>> = Mutex::new(BTreeMap::new());
    let mut reserved = RESERVED.lock().unwrap_or_else(PoisonError::into_inner);
    let _ = scope();
    let folder = tautline_rt::domain::kept_folder();
    reserved.entry(domain).or_insert_with(|| {
        // As the store of definitions makes it.
        let _ = std::fs::DirBuilder::new().mode(0o700).create(&folder);
        let file = File::create(folder.join(format!("test_bridge_{domain}.lock"))).unwrap();
        rustix::fs::flock(&file, rustix::fs::FlockOperation::LockExclusive).unwrap();
        file
    });
}

/// Looks until it is so.
pub fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < end, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// The Python environment that `cargo xtask ros` makes with the ROS 2 of the build; prints why a test is skipped without it.
pub fn ros() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let target = std::env::var_os("CARGO_TARGET_DIR").map(PathBuf::from);
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    let prefixes: Vec<PathBuf> = std::env::split_paths(&prefixes).collect();
    // Beside the prefix of the build: there is one for each distribution.
    let built_with = prefixes.iter().map(|prefix| prefix.with_file_name("venv"));
    let targets = target.into_iter().chain([root.join("target")]).map(|target| target.join("ros/venv"));
    let mut venvs = built_with.chain(targets);
    let found = venvs.find(|venv| venv.join("wheels.txt").is_file());
    if found.is_none() {
        assert!(std::env::var_os("CI").is_none(), "CI needs a ROS 2: run `cargo xtask ros`");
        eprintln!("skipped: no ROS 2 under target/ros: run `cargo xtask ros`");
    }
    found
}

/// A program of the workspace's, built before, which is where the tests are; prints why a test is skipped without it.
pub fn built(program: &str, package: &str) -> Option<PathBuf> {
    let tests = std::env::current_exe().unwrap();
    let path = tests.ancestors().nth(2).unwrap().join(program);
    if !path.is_file() {
        assert!(std::env::var_os("CI").is_none(), "CI needs {}: cargo build -p {package}", path.display());
        eprintln!("skipped: no {}: run `cargo build -p {package}`", path.display());
        return None;
    }
    Some(path)
}

/// A node of rclpy.
pub struct Peer {
    child: Child,
    /// `None` once it is told to end.
    input: Option<ChildStdin>,
    answers: mpsc::Receiver<Value>,
}

impl Peer {
    /// Starts `ros_peer.py` in a ROS domain.
    pub fn start(venv: &Path, ros_domain: u32, name: &str) -> Self {
        Self::start_as(venv, ros_domain, name, "ros_peer.py", |_| {})
    }

    /// The same with services, actions and parameters.
    pub fn start_with_services(venv: &Path, ros_domain: u32, name: &str) -> Self {
        Self::start_as(venv, ros_domain, name, "ros_services_peer.py", |_| {})
    }

    /// Starts a script beside those, whose environment `change` changes.
    pub fn start_as(
        venv: &Path,
        ros_domain: u32,
        name: &str,
        script: &str,
        change: impl FnOnce(&mut Command),
    ) -> Self {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../bridge-ros/tests").join(script);
        let mut command = Command::new(venv.join("bin/python"));
        command.arg(script).arg(name).env_remove("LD_LIBRARY_PATH").env_remove("AMENT_PREFIX_PATH");
        command.env("ROS_DOMAIN_ID", ros_domain.to_string()).env("PYTHONDONTWRITEBYTECODE", "1");
        change(&mut command);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (input, output) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
        let (sender, answers) = mpsc::channel();
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                let _ = sender.send(serde_json::from_str(&line).unwrap_or(Value::String(line)));
            }
        });
        let mut peer = Peer { child, input: Some(input), answers };
        assert_eq!(peer.answer(), "ready");
        peer
    }

    fn answer(&mut self) -> Value {
        self.answer_or_error().unwrap_or_else(|error| panic!("{error}"))
    }

    fn answer_or_error(&mut self) -> Result<Value, Value> {
        let answer = self.answers.recv_timeout(PATIENCE);
        let mut answer = answer.expect("the Python process answers; else see its output above");
        if answer.get("ok").is_some() { Ok(answer["ok"].take()) } else { Err(answer) }
    }

    /// Tells it to begin something; [`end`](Self::end) waits for it.
    pub fn begin(&mut self, command: Value) {
        writeln!(self.input.as_mut().unwrap(), "{command}").unwrap();
    }

    pub fn end(&mut self) -> Value {
        self.answer()
    }

    /// Tells it to do something that may fail as long as ROS does not know of all, and waits for it.
    pub fn ask(&mut self, command: Value) -> Result<Value, Value> {
        self.begin(command);
        self.answer_or_error()
    }

    /// Tells it to do something, and waits for it.
    pub fn tell(&mut self, command: Value) -> Value {
        self.begin(command);
        self.end()
    }

    pub fn publisher(&mut self, topic: &str, type_name: &str, qos: Value) -> u64 {
        let command = json!({ "do": "publisher", "topic": topic, "type": type_name, "qos": qos });
        self.tell(command).as_u64().unwrap()
    }

    pub fn subscription(&mut self, topic: &str, type_name: &str, qos: Value) -> u64 {
        let command = json!({ "do": "subscription", "topic": topic, "type": type_name, "qos": qos });
        self.tell(command).as_u64().unwrap()
    }

    pub fn matched(&mut self, end: u64, count: usize) {
        self.tell(json!({ "do": "matched", "end": end, "count": count }));
    }

    pub fn publish_text(&mut self, end: u64, texts: &[impl AsRef<str>]) {
        let texts: Vec<&str> = texts.iter().map(AsRef::as_ref).collect();
        self.tell(json!({ "do": "publish_text", "end": end, "texts": texts }));
    }

    pub fn take(&mut self, end: u64, count: usize) -> Vec<Value> {
        match self.tell(json!({ "do": "take", "end": end, "count": count })) {
            Value::Array(values) => values,
            other => panic!("{other}"),
        }
    }

    /// The texts of so many `std_msgs/msg/String`s.
    pub fn take_texts(&mut self, end: u64, count: usize) -> Vec<String> {
        let text = |value: Value| value["data"].as_str().unwrap().to_owned();
        self.take(end, count).into_iter().map(text).collect()
    }

    pub fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // The end of its input.
        drop(self.input.take());
        end(&mut self.child);
    }
}

/// Waits for a process that was told to end: one that is killed leaves Fast DDS's files in shared memory, over which later ones
/// stumble.
fn end(child: &mut Child) {
    let since = Instant::now();
    while matches!(child.try_wait(), Ok(None)) && since.elapsed() < Duration::from_secs(10) {
        std::thread::sleep(Duration::from_millis(5));
    }
    let _ = child.kill();
    let _ = child.wait();
}

/// A program that prints its numbers, in a process of its own.
pub struct Program {
    child: Child,
    last: Arc<Mutex<Value>>,
    said: Arc<Mutex<String>>,
}

impl Program {
    /// Returns once it has printed numbers.
    pub fn start(name: &'static str, command: Command) -> Self {
        let mut program = Self::spawn(name, command);
        program.wait_for_numbers();
        program
    }

    /// As [`start`](Self::start), but one that may have to wait before it has numbers.
    pub fn spawn(name: &'static str, mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (last, said) = (Arc::new(Mutex::new(Value::Null)), Arc::new(Mutex::new(String::new())));
        let (output, errors) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
        let (to_last, to_said) = (last.clone(), said.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                let numbers: Value = serde_json::from_str(&line).unwrap();
                let program = if numbers["rmw"].is_string() { "bridge-ros" } else { "gateway" };
                let is_as_said = schemas::compare(program, &numbers);
                *to_last.lock().unwrap() = is_as_said.map_or_else(Value::String, |()| numbers);
            }
        });
        std::thread::spawn(move || {
            for line in BufReader::new(errors).lines().map_while(Result::ok) {
                eprintln!("{name}: {line}");
                *to_said.lock().unwrap() += &format!("{line}\n");
            }
        });
        Program { child, last, said }
    }

    pub fn wait_for_numbers(&mut self) {
        wait_until("its first numbers", || {
            let status = self.child.try_wait().unwrap();
            assert!(status.is_none(), "it ended: {}", self.said());
            self.stats().is_object()
        });
    }

    /// The numbers that it printed last.
    pub fn stats(&self) -> Value {
        let numbers = self.last.lock().unwrap().clone();
        assert!(!numbers.is_string(), "{numbers}");
        numbers
    }

    /// All that it has said on standard error.
    pub fn said(&self) -> String {
        self.said.lock().unwrap().clone()
    }

    /// Waits until its numbers are such.
    pub fn wait_for(&self, what: &str, is_so: impl Fn(&Value) -> bool) -> Value {
        wait_until(what, || is_so(&self.stats()));
        self.stats()
    }

    /// The numbers of a topic in a direction.
    pub fn topic(&self, topic: &str, direction: &str) -> Value {
        let stats = self.stats();
        let topics = stats["topics"].as_array().cloned().unwrap_or_default();
        let is_it = |numbers: &Value| numbers["topic"] == topic && numbers["direction"] == direction;
        topics.into_iter().find(is_it).unwrap_or_default()
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// `kill -9`.
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // The number of one that was waited for may be another's.
        if matches!(self.child.try_wait(), Ok(None)) {
            let _ = kill_process(Pid::from_child(&self.child), Signal::TERM);
        }
        end(&mut self.child);
    }
}

/// Types of all shapes, in groups of about the same length.
pub const TYPES: [&str; 4] = [
    "test_msgs/msg/Arrays test_msgs/msg/BasicTypes test_msgs/msg/BoundedPlainSequences \
     test_msgs/msg/BoundedSequences test_msgs/msg/Builtins test_msgs/msg/Constants \
     test_msgs/msg/Defaults test_msgs/msg/Empty test_msgs/msg/MultiNested",
    "test_msgs/msg/Nested test_msgs/msg/Strings test_msgs/msg/UnboundedSequences test_msgs/msg/WStrings \
     std_msgs/msg/String std_msgs/msg/Bool std_msgs/msg/Header std_msgs/msg/ColorRGBA \
     std_msgs/msg/Float64",
    "std_msgs/msg/Int64 std_msgs/msg/UInt8MultiArray geometry_msgs/msg/Twist geometry_msgs/msg/Pose \
     geometry_msgs/msg/PoseWithCovarianceStamped geometry_msgs/msg/TransformStamped \
     geometry_msgs/msg/Polygon nav_msgs/msg/Odometry nav_msgs/msg/Path",
    "sensor_msgs/msg/Image sensor_msgs/msg/PointCloud2 sensor_msgs/msg/LaserScan sensor_msgs/msg/Imu \
     sensor_msgs/msg/JointState sensor_msgs/msg/CompressedImage diagnostic_msgs/msg/DiagnosticArray \
     trajectory_msgs/msg/JointTrajectory",
];

/// Random messages of one type, as many each way.
pub struct Values {
    /// Messages per type and direction.
    pub count: usize,
    /// Sent at once. Not more: Fast DDS has 512 KiB and 512 messages of shared memory for a writer, and what does not fit comes after
    /// its heartbeat of 3 s, on a busy machine perhaps never.
    pub at_once: usize,
    /// How much data a message has at most that has much.
    pub data_bytes: usize,
    pub depth: usize,
    seed: u64,
}

impl Values {
    /// Of a random seed, which is printed, or that of `TAUT_SEED`.
    pub fn new(name: &str) -> Self {
        let (at_once, data_bytes) = match name.rsplit('/').next() {
            Some("Image" | "CompressedImage" | "PointCloud2") => (8, 10 << 10),
            // Up to 15 kB each.
            Some("MultiNested") => (20, 0),
            _ => (50, 0),
        };
        let seed = std::env::var("TAUT_SEED");
        let seed = seed.map_or_else(|_| rand::random::<u32>().into(), |seed| seed.parse().unwrap());
        println!("{name}: TAUT_SEED={seed}");
        Values { count: 1000, at_once, data_bytes, depth: 1000, seed }
    }

    /// What tells a peer to make so many.
    pub fn prepare(&self, name: &str, count: usize) -> Value {
        let (seed, data_bytes) = (self.seed, self.data_bytes);
        json!({ "do": "prepare_random", "type": name, "count": count, "seed": seed, "data_bytes": data_bytes })
    }

    /// Each way between a node of rclpy and Tautline: equal values, in order, none lost. The topics are `/from_ros/<name>` and
    /// `/to_ros/<name>`.
    pub fn exchange(&self, peer: &mut Peer, participant: &Participant, packages: &mut Packages, name: &str) {
        let schema = Arc::new(packages.schema(&name.parse().unwrap()).unwrap());
        let text = |value: &Value| DynamicMessage::from_json(&schema, &value.to_string()).unwrap().to_json();
        let [from_ros, to_ros] = Self::topics(name);
        let qos = json!({ "depth": self.depth });
        let here = subscription(participant, &from_ros, name, Qos::keep_last(self.depth));
        let there = peer.publisher(&from_ros, name, qos.clone());
        peer.matched(there, 1);
        let said = peer.tell(self.prepare(name, self.count));
        let mut bodies = Vec::new();
        while bodies.len() < self.count {
            let count = self.at_once.min(self.count - bodies.len());
            peer.tell(json!({ "do": "publish_prepared", "end": there, "count": count }));
            bodies.extend(take(&here, count));
        }
        for (body, said) in bodies.iter().zip(said.as_array().unwrap()) {
            let message = DynamicMessage::from_body(&schema, body, Endian::Little).unwrap();
            assert_eq!((message.to_json(), message.trailing_bytes()), (text(said), 0), "{name}");
        }

        let here = publisher(participant, &to_ros, name, Qos::keep_last(self.depth));
        let there = peer.subscription(&to_ros, name, qos);
        let mut random = self.prepare(name, self.count);
        random["do"] = json!("random");
        random["seed"] = json!(self.seed + 1);
        let said = peer.tell(random);
        let said: Vec<&str> = said.as_array().unwrap().iter().map(|one| one[1].as_str().unwrap()).collect();
        matched(&here, 1);
        let mut received = Vec::new();
        for said in said.chunks(self.at_once) {
            let bodies = said.iter().map(|json| DynamicMessage::from_json(&schema, json).unwrap().to_body());
            bodies.for_each(|body| here.publish(&body).unwrap());
            received.extend(peer.take(there, said.len()));
        }
        for (received, said) in received.iter().zip(&said) {
            let said = DynamicMessage::from_json(&schema, said).unwrap().to_json();
            assert_eq!(text(received), said, "{name}");
        }
        assert_eq!((bodies.len(), received.len()), (self.count, self.count), "{name}");
    }

    pub fn topics(name: &str) -> [String; 2] {
        let name = name.rsplit('/').next().unwrap().to_lowercase();
        [format!("/from_ros/{name}"), format!("/to_ros/{name}")]
    }
}

/// Publishes one at a time until what is published arrives, and nothing is left on the way.
fn connect(from: &mut Peer, to: &mut Peer, publisher: u64, subscription: u64) {
    let (mut in_step, mut missing) = (0, 0_usize);
    wait_until("the way from end to end", || {
        from.tell(json!({ "do": "publish_prepared", "end": publisher, "count": 1 }));
        let end = Instant::now() + Duration::from_millis(500);
        let mut heard = 0;
        while heard == 0 && Instant::now() < end {
            heard = to.take(subscription, 0).len();
        }
        missing = (missing + 1).saturating_sub(heard);
        in_step = if heard == 1 { in_step + 1 } else { 0 };
        in_step == 3
    });
    // What relays hold until they know its publisher comes later than what follows it, or never.
    let end = Instant::now() + Duration::from_secs(5);
    while missing > 0 && Instant::now() < end {
        missing = missing.saturating_sub(to.take(subscription, 0).len());
    }
    assert!(to.take(subscription, 0).is_empty());
}

/// Random values of these types from one node of rclpy to another: equal, in order, none lost.
pub fn cross(from: &mut Peer, to: &mut Peer, packages: &mut Packages, types: &str, keeps_all: bool) {
    for name in types.split(' ') {
        let schema = Arc::new(packages.schema(&name.parse().unwrap()).unwrap());
        let text = |value: &Value| DynamicMessage::from_json(&schema, &value.to_string()).unwrap().to_json();
        let topic = format!("/{}", name.replace('/', "_").to_lowercase());
        let values = Values::new(name);
        let qos = json!({ "depth": values.depth, "keep_all": keeps_all });
        let subscription = to.subscription(&topic, name, qos.clone());
        let publisher = from.publisher(&topic, name, qos);
        from.tell(values.prepare(name, 300));
        connect(from, to, publisher, subscription);
        let said = from.tell(values.prepare(name, values.count));
        let said = said.as_array().unwrap();
        let mut received = Vec::new();
        while received.len() < values.count {
            let count = values.at_once.min(values.count - received.len());
            from.tell(json!({ "do": "publish_prepared", "end": publisher, "count": count }));
            received.extend(to.take(subscription, count));
        }
        assert_eq!((received.len(), said.len()), (values.count, values.count), "{name}");
        for (received, said) in received.iter().zip(said) {
            assert_eq!(text(received), text(said), "{name}");
        }
        assert!(to.take(subscription, 0).is_empty(), "{name}");
        from.tell(json!({ "do": "destroy", "end": publisher }));
        to.tell(json!({ "do": "destroy", "end": subscription }));
    }
}

pub const STRING: &str = "std_msgs/msg/String";

/// The CDR of a `std_msgs/msg/String`.
pub fn text_body(text: &str) -> Vec<u8> {
    let len = u32::try_from(text.len() + 1).unwrap();
    [&len.to_le_bytes()[..], text.as_bytes(), &[0]].concat()
}

/// The text of a body.
pub fn text_of(body: &[u8]) -> String {
    let len = u32::from_le_bytes(body[..4].try_into().unwrap()) as usize;
    String::from_utf8(body[4..4 + len - 1].to_vec()).unwrap()
}

pub fn publisher(participant: &Participant, topic: &str, type_name: &str, qos: Qos) -> RawPublisher {
    let topic_type = TopicType::new(type_name.to_owned());
    let limits = Limits { message_bytes: 64 << 10, ..Limits::default() };
    participant.create_raw_publisher(topic, &topic_type, qos, limits).unwrap()
}

pub fn publish_texts(publisher: &RawPublisher, texts: &[impl AsRef<str>]) {
    texts.iter().for_each(|text| publisher.publish(&text_body(text.as_ref())).unwrap());
}

pub fn subscription(participant: &Participant, topic: &str, type_name: &str, qos: Qos) -> RawSubscription {
    let topic_type = TopicType::new(type_name.to_owned());
    participant.create_raw_subscription(topic, &topic_type, qos, Limits::default()).unwrap()
}

/// Waits until the bridge listens.
pub fn matched(publisher: &RawPublisher, count: usize) {
    wait_until("subscriptions of a publisher", || publisher.subscription_count() == count);
}

/// Waits for so many messages.
pub fn take(subscription: &RawSubscription, count: usize) -> Vec<Vec<u8>> {
    let mut taken = Vec::new();
    wait_until(&format!("{count} messages of {}", subscription.topic()), || {
        while let Some(sample) = subscription.try_take().unwrap() {
            taken.push(sample.body().to_vec());
        }
        taken.len() >= count
    });
    taken
}

pub fn take_texts(subscription: &RawSubscription, count: usize) -> Vec<String> {
    take(subscription, count).iter().map(|body| text_of(body)).collect()
}

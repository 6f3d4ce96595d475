// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the tests share: bridges and gateways in processes of their own, rclpy in others, and patience.
#![allow(dead_code, reason = "no test uses all of it")]

pub mod gateway;
pub mod node;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::ops::{Deref, DerefMut};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tautline_transport::{Limits, Participant, Qos, RawPublisher, RawSubscription, TopicType};

/// Nothing takes so long unless it is broken: the end of every wait.
pub const PATIENCE: Duration = Duration::from_secs(120);

/// The scope of whoever runs the tests, or one that no user's programs are in.
pub fn scope() -> &'static str {
    if std::env::var_os("TAUT_SCOPE").is_none() {
        tautline_rt::domain::set_scope("test").unwrap();
    }
    tautline_rt::domain::scope().unwrap().unwrap()
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

/// After this a restarted bridge or node is expected to be heard.
const RECOVERY: Duration = Duration::from_secs(5);

/// Has something die and come back, up to three times, until it took less than [`RECOVERY`]: what takes longer each time is not
/// the machine. Required where CI is set: elsewhere the machine may be busy.
pub fn recovers(what: &str, mut die_and_come_back: impl FnMut()) {
    let mut times = Vec::new();
    while times.len() < 3 {
        let since = Instant::now();
        die_and_come_back();
        times.push(since.elapsed());
        println!("{what}: {:?}", since.elapsed());
        if times.last() < Some(&RECOVERY) {
            return;
        }
    }
    assert!(std::env::var_os("CI").is_none(), "{what}: {times:?}");
}

/// The Python environment with ROS 2 that `cargo xtask ros` makes; prints why a test is skipped without it.
pub fn ros() -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let target = std::env::var_os("CARGO_TARGET_DIR").map(PathBuf::from);
    let venvs = target.into_iter().chain([root.join("target")]).map(|target| target.join("ros/venv"));
    let found = venvs.into_iter().find(|venv| venv.join("wheels.txt").is_file());
    if found.is_none() {
        assert!(std::env::var_os("CI").is_none(), "CI needs a ROS 2: run `cargo xtask ros`");
        eprintln!("skipped: no ROS 2 under target/ros: run `cargo xtask ros`");
    }
    found
}

/// A program of the workspace's as `cargo xtask bridge` has built it, which is where the bridge is; prints why a test is skipped
/// without it.
pub fn built(program: &str, package: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_BIN_EXE_taut-bridge-ros")).with_file_name(program);
    if !path.is_file() {
        assert!(std::env::var_os("CI").is_none(), "CI needs {}: cargo build -p {package}", path.display());
        eprintln!("skipped: no {}: run `cargo xtask bridge`, or `cargo build -p {package}`", path.display());
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
        Self::start_script(venv, ros_domain, name, "ros_peer.py")
    }

    /// The same with services, actions and parameters.
    pub fn start_with_services(venv: &Path, ros_domain: u32, name: &str) -> Self {
        Self::start_script(venv, ros_domain, name, "ros_services_peer.py")
    }

    fn start_script(venv: &Path, ros_domain: u32, name: &str, script: &str) -> Self {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(script);
        let mut command = Command::new(venv.join("bin/python"));
        command.arg(script).arg(name).env_remove("LD_LIBRARY_PATH").env_remove("AMENT_PREFIX_PATH");
        command.env("ROS_DOMAIN_ID", ros_domain.to_string()).env("PYTHONDONTWRITEBYTECODE", "1");
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
    fn start(name: &'static str, command: Command) -> Self {
        let mut program = Self::spawn(name, command);
        program.wait_for_numbers();
        program
    }

    /// As [`start`](Self::start), but one that may have to wait before it has numbers.
    fn spawn(name: &'static str, mut command: Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (last, said) = (Arc::new(Mutex::new(Value::Null)), Arc::new(Mutex::new(String::new())));
        let (output, errors) = (child.stdout.take().unwrap(), child.stderr.take().unwrap());
        let (to_last, to_said) = (last.clone(), said.clone());
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                *to_last.lock().unwrap() = serde_json::from_str(&line).unwrap();
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
        self.last.lock().unwrap().clone()
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

/// `taut-bridge-ros`.
pub struct BridgeProcess(Program);

impl DerefMut for BridgeProcess {
    fn deref_mut(&mut self) -> &mut Program {
        &mut self.0
    }
}

impl Deref for BridgeProcess {
    type Target = Program;

    fn deref(&self) -> &Program {
        &self.0
    }
}

impl BridgeProcess {
    /// Without real-time priorities.
    pub fn start(domain: u32, ros_domain: u32, arguments: &[&str]) -> Self {
        Self::start_with(domain, ros_domain, arguments, |command| {
            command.arg("--no-rt");
        })
    }

    pub fn start_with(
        domain: u32,
        ros_domain: u32,
        arguments: &[&str],
        change: impl FnOnce(&mut Command),
    ) -> Self {
        BridgeProcess(Program::start("bridge", Self::command(domain, ros_domain, arguments, change)))
    }

    /// One that takes over when the one that runs ends.
    pub fn stand_by(domain: u32, ros_domain: u32) -> Self {
        let command = Self::command(domain, ros_domain, &["--standby", "--no-rt"], |_| {});
        BridgeProcess(Program::spawn("bridge on standby", command))
    }

    fn command(
        domain: u32,
        ros_domain: u32,
        arguments: &[&str],
        change: impl FnOnce(&mut Command),
    ) -> Command {
        [domain, ros_domain].into_iter().for_each(reserve);
        let mut command = Command::new(env!("CARGO_BIN_EXE_taut-bridge-ros"));
        command.args(["--domain", &domain.to_string(), "--ros-domain", &ros_domain.to_string()]);
        command.env("TAUT_SCOPE", scope());
        command.args(["--json", "--interval", "0.1"]).args(arguments);
        // What may be said on the terminal that runs the tests is no concern of theirs.
        command.env_remove("RUST_LOG").env_remove("ROS_DOMAIN_ID").env_remove("TAUT_DOMAIN");
        change(&mut command);
        command
    }

    /// The numbers of a service.
    pub fn service(&self, service: &str) -> Value {
        let services = self.stats()["services"].as_array().cloned().unwrap_or_default();
        services.into_iter().find(|numbers| numbers["service"] == service).unwrap_or_default()
    }

    /// `kill -9`.
    pub fn kill(self) {
        self.0.kill();
    }
}

/// What a bridge that cannot run says, and whether it failed.
pub fn failure_of(arguments: &[&str], change: impl FnOnce(&mut Command)) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_taut-bridge-ros"));
    command.args(arguments).env_remove("RUST_LOG").env_remove("ROS_DOMAIN_ID").env("TAUT_SCOPE", scope());
    change(&mut command);
    failure(command)
}

/// What a program says that fails.
pub fn failure(mut command: Command) -> String {
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut said = String::new();
    let end = Instant::now() + PATIENCE;
    while child.try_wait().unwrap().is_none() {
        if Instant::now() > end {
            let _ = child.kill();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(!child.wait().unwrap().success(), "it runs: {said}");
    said
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

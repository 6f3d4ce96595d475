// SPDX-License-Identifier: MIT OR Apache-2.0
//! Hosts that are network namespaces with a /dev/shm of their own, joined by a switch; and the nodes that run on them,
//! which are this test program once more.
#![allow(dead_code, reason = "each test uses a part")]

#[path = "../../../../cli/tests/support/schemas.rs"]
mod schemas;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};
use tautline_transport::{Limits, Participant, Qos, TopicType};

const ROLE: &str = "TAUT_TEST_ROLE";
const PATIENCE: Duration = Duration::from_secs(60);
pub const DOMAIN: u32 = 206;

/// Why there can be no such hosts here; `None`: there can.
pub fn reason_to_skip() -> Option<String> {
    let tried = Command::new("unshare").args(["-n", "-m", "ip", "link", "set", "lo", "up"]).output();
    let reason = match tried {
        Ok(output) if output.status.success() => return None,
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => format!("unshare: {error}"),
    };
    assert!(std::env::var_os("CI").is_none(), "namespaces are needed in CI: {reason}");
    Some(format!("skipped: network namespaces are not permitted here: {reason}"))
}

/// A switch, and hosts 10.77.0.1 and so on.
pub struct Lan {
    pub hosts: Vec<Namespace>,
    switch: Namespace,
}

impl Lan {
    pub fn new(hosts: usize) -> Self {
        let switch = Namespace::new("switch");
        switch.ip("link add br0 type bridge");
        switch.ip("link set br0 up");
        let hosts: Vec<_> = (0..hosts)
            .map(|n| {
                let host = Namespace::new(&format!("host {n}"));
                let (here, there) = (host.pid(), switch.pid());
                run(Command::new("ip").args(
                    format!("link add eth0 netns {here} type veth peer name port{n} netns {there}")
                        .split(' '),
                ));
                switch.ip(&format!("link set port{n} master br0"));
                switch.ip(&format!("link set port{n} up"));
                host.ip(&format!("addr add {}/24 dev eth0", address(n)));
                host.ip("link set eth0 up");
                host
            })
            .collect();
        Lan { hosts, switch }
    }
}

pub fn address(host: usize) -> String {
    format!("10.77.0.{}", host + 1)
}

pub fn endpoint(host: usize) -> String {
    format!("tcp/{}:7447", address(host))
}

/// A process that holds the namespaces.
pub struct Namespace {
    name: String,
    holder: Child,
}

impl Namespace {
    fn new(name: &str) -> Self {
        let script = "mount -t tmpfs tmpfs /dev/shm && ip link set lo up && echo ready && exec sleep 1000";
        let mut holder = Command::new("unshare")
            .args(["-n", "-m", "setpriv", "--pdeathsig", "KILL", "sh", "-c", script])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(holder.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n");
        Namespace { name: name.into(), holder }
    }

    fn pid(&self) -> u32 {
        self.holder.id()
    }

    /// A command that will run on this host, and die with this thread.
    pub fn command(&self, program: &str) -> Command {
        let mut command = Command::new("nsenter");
        command.args([
            "-t",
            &self.pid().to_string(),
            "-n",
            "-m",
            "--",
            "setpriv",
            "--pdeathsig",
            "KILL",
            program,
        ]);
        if std::env::var_os("TAUT_SCOPE").is_none() {
            // For what is not in /dev/shm: definitions of types.
            command.env("TAUT_SCOPE", "test");
        }
        command
    }

    pub fn ip(&self, arguments: &str) {
        run(self.command("ip").args(arguments.split(' ')));
    }

    /// Whether a shell command works here.
    pub fn try_sh(&self, script: &str) -> bool {
        self.command("sh").args(["-c", script]).output().unwrap().status.success()
    }

    /// Packets that went out so far.
    pub fn packets_sent(&self) -> u64 {
        let output = self.command("ip").args(["-s", "-j", "link", "show", "eth0"]).output().unwrap();
        let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        json[0]["stats64"]["tx"]["packets"].as_u64().unwrap()
    }

    pub fn gateway(&self, arguments: &[&str]) -> Gateway {
        let mut child = self
            .command(env!("CARGO_BIN_EXE_taut-gateway"))
            .args(["--domain", &DOMAIN.to_string(), "--no-rt", "--json", "--interval", "0.2"])
            .args(arguments)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = lines(child.stdout.take().unwrap());
        Gateway { child, lines, last: None }
    }

    pub fn publisher(&self, topic: &str, depth: usize) -> Node {
        self.node(&format!("publish {topic} {depth}"))
    }

    pub fn subscriber(&self, topic: &str, depth: usize) -> Node {
        self.node(&format!("subscribe {topic} {depth}"))
    }

    /// Forwards TCP from a port of this host, each byte later by `delay`.
    pub fn relay(&self, port: u16, to: &str, delay: Duration) -> Node {
        self.node(&format!("relay {port} {to} {}", delay.as_micros()))
    }

    fn node(&self, role: &str) -> Node {
        let program = std::env::current_exe().unwrap();
        let mut child = self
            .command(program.to_str().unwrap())
            .args(["role", "--exact", "--nocapture"])
            .env(ROLE, role)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (input, lines) = (child.stdin.take().unwrap(), lines(child.stdout.take().unwrap()));
        let node = Node { child, input, lines };
        node.expect("started");
        node
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        let _ = self.holder.kill();
        let _ = self.holder.wait();
    }
}

fn run(command: &mut Command) {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
}

fn lines(stream: impl Read + Send + 'static) -> mpsc::Receiver<String> {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
        }
    });
    receiver
}

pub struct Gateway {
    child: Child,
    lines: mpsc::Receiver<String>,
    last: Option<serde_json::Value>,
}

impl Gateway {
    /// The newest numbers.
    pub fn stats(&mut self) -> serde_json::Value {
        let _ = self.lines.try_iter().count();
        let line = self.lines.recv_timeout(PATIENCE).expect("the gateway has ended");
        schemas::check_as("gateway", line.as_bytes());
        self.last = Some(serde_json::from_str(&line).unwrap());
        self.last.clone().unwrap()
    }

    /// The numbers of a topic in one direction, once they are as wanted.
    pub fn wait_for(
        &mut self,
        topic: &str,
        way: &str,
        done: impl Fn(&serde_json::Value) -> bool,
    ) -> serde_json::Value {
        let start = Instant::now();
        loop {
            let stats = self.stats();
            let topics = stats["topics"].as_array().unwrap();
            let found = topics.iter().find(|t| t["topic"] == topic && t["direction"] == way);
            if let Some(found) = found.filter(|stats| done(stats)) {
                return found.clone();
            }
            assert!(start.elapsed() < PATIENCE, "{topic} {way}: {stats}");
        }
    }

    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        if std::thread::panicking() {
            println!("{:?}", self.lines.try_iter().last());
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub struct Node {
    child: Child,
    input: ChildStdin,
    lines: mpsc::Receiver<String>,
}

impl Node {
    pub fn tell(&mut self, line: &str) {
        writeln!(self.input, "{line}").unwrap();
    }

    pub fn line(&self) -> String {
        loop {
            // The test harness of the other program says things, too.
            let line = self.lines.recv_timeout(PATIENCE).expect("a node says nothing");
            if let Some(said) = line.split("> ").nth(1) {
                return said.to_owned();
            }
        }
    }

    pub fn expect(&self, word: &str) {
        while self.line() != word {}
    }

    /// Publishes `count` bodies of `bytes`, one every `period`. Returns the last one's number.
    pub fn publish(&mut self, bytes: usize, count: u64, period: Duration) -> u64 {
        self.tell(&format!("{bytes} {count} {}", period.as_micros()));
        loop {
            if let Some(number) = self.line().strip_prefix("published ") {
                return number.parse().unwrap();
            }
        }
    }

    /// What arrives next.
    pub fn sample(&self) -> Received {
        loop {
            if let Some(sample) = parse(&self.line()) {
                return sample;
            }
        }
    }

    /// What has arrived by now.
    pub fn arrived(&self) -> Vec<Received> {
        self.lines.try_iter().filter_map(|line| parse(line.split("> ").nth(1)?)).collect()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[derive(Debug, PartialEq, Eq, Clone, Copy)]
pub struct Received {
    pub bytes: usize,
    pub checksum: u64,
    pub number: u64,
}

fn parse(line: &str) -> Option<Received> {
    let mut parts = line.strip_prefix("sample ")?.split(' ').map(|part| part.parse::<u64>());
    let mut next = || parts.next()?.ok();
    Some(Received { bytes: next()? as usize, checksum: next()?, number: next()? })
}

/// The body of a message with this number.
pub fn body(bytes: usize, number: u64) -> Vec<u8> {
    (0..bytes as u64).map(|n| (n.wrapping_mul(31) ^ number ^ n >> 8) as u8).collect()
}

pub fn checksum(body: &[u8]) -> u64 {
    body.iter()
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3))
}

fn topic_type() -> TopicType {
    TopicType::new("sensor_msgs/msg/Image").with_hash(format!("RIHS01_{}", "5".repeat(64)))
}

/// What this program does when a test runs it as a node.
pub fn play() {
    let Ok(role) = std::env::var(ROLE) else { return };
    let parts: Vec<&str> = role.split(' ').collect();
    match parts[..] {
        ["publish", topic, depth] => publish(topic, depth.parse().unwrap()),
        ["subscribe", topic, depth] => subscribe(topic, depth.parse().unwrap()),
        ["relay", port, to, delay_us] => relay(port, to, Duration::from_micros(delay_us.parse().unwrap())),
        _ => panic!("{role}"),
    }
}

fn publish(topic: &str, depth: usize) {
    let participant = Participant::new(DOMAIN).unwrap();
    let (qos, limits) = (Qos::keep_last(depth), Limits::default());
    let publisher = participant.create_raw_publisher(topic, &topic_type(), qos, limits).unwrap();
    println!("> started");
    let mut number = 0;
    for line in std::io::stdin().lines().map_while(Result::ok) {
        let numbers: Vec<u64> = line.split(' ').map(|part| part.parse().unwrap()).collect();
        let [bytes, count, period_us] = numbers[..] else { panic!("{line}") };
        let start = Instant::now();
        for n in 0..count {
            let due = Duration::from_micros(period_us * n);
            std::thread::sleep(due.saturating_sub(start.elapsed()));
            number += 1;
            publisher.publish(&body(bytes as usize, number)).unwrap();
        }
        println!("> published {number}");
    }
}

fn subscribe(topic: &str, depth: usize) {
    let participant = Participant::new(DOMAIN).unwrap();
    let (qos, limits) = (Qos::keep_last(depth), Limits::default());
    let subscription = participant.create_raw_subscription(topic, &topic_type(), qos, limits).unwrap();
    println!("> started");
    loop {
        match subscription.try_take_valid().unwrap() {
            None => std::thread::sleep(Duration::from_micros(200)),
            Some(sample) => {
                let body = sample.body();
                println!("> sample {} {} {}", body.len(), checksum(body), sample.info().sequence_number);
            }
        }
    }
}

fn relay(port: &str, to: &str, delay: Duration) {
    let listener = TcpListener::bind(format!("127.0.0.1:{port}")).unwrap();
    println!("> started");
    for here in listener.incoming().map_while(Result::ok) {
        // Not there yet: who connected here will try again.
        let Ok(there) = TcpStream::connect(to) else { continue };
        for (mut from, mut to) in [(here.try_clone().unwrap(), there.try_clone().unwrap()), (there, here)] {
            let (sender, receiver) = mpsc::channel::<(Instant, Vec<u8>)>();
            std::thread::spawn(move || {
                let mut buffer = vec![0; 65_536];
                while let Ok(len @ 1..) = from.read(&mut buffer) {
                    let _ = sender.send((Instant::now() + delay, buffer[..len].to_vec()));
                }
            });
            std::thread::spawn(move || {
                for (due, bytes) in receiver {
                    std::thread::sleep(due.saturating_duration_since(Instant::now()));
                    if to.write_all(&bytes).is_err() {
                        break;
                    }
                }
                let _ = to.shutdown(std::net::Shutdown::Both);
            });
        }
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! A small talker and listener that records itself from its start, run in a process of its own, and what was recorded.
#![allow(dead_code, reason = "each test file uses its part")]

#[path = "../support/schemas.rs"]
pub mod schemas;

use futures::StreamExt;
use schemas::Checked;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicU64, Ordering};
use tautline::{CallbackGroup, CallbackOptions, Context, Message, Node, Qos, Realtime, Sample};

/// Messages that the program publishes, each when the one before has been dealt with.
pub const MESSAGES: usize = 200;

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "test_msgs/msg/Number")]
struct Number {
    value: u64,
}

pub fn taut(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_taut")).args(arguments).checked()
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

/// An empty directory of this test's own.
pub fn scratch(name: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&directory);
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

const CHILD: &str = "TAUT_TEST_CHILD";

/// The test `name` run again as the traced program.
pub struct Program {
    command: Command,
    name: &'static str,
    domain: u32,
}

/// What is left when it has ended and was recorded. The files go when this is dropped.
pub struct Run {
    pub directory: PathBuf,
    pub recording: PathBuf,
    /// What `taut trace record --json` printed.
    pub report: serde_json::Value,
    /// What the program printed.
    pub said: String,
}

impl Drop for Run {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            let _ = std::fs::remove_dir_all(&self.directory);
        }
    }
}

impl Program {
    pub fn new(name: &'static str, domain: u32) -> Program {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["--exact", name, "--nocapture", "--test-threads=1"]).env(CHILD, "1");
        command
            .env("TAUT_DOMAIN", domain.to_string())
            .env("TAUT_TRACE", "on")
            .env_remove("TAUT_TRACE_EVENTS");
        Program { command, name, domain }
    }

    /// Whether this process is the traced program.
    pub fn is_this() -> bool {
        std::env::var_os(CHILD).is_some()
    }

    pub fn variable(mut self, name: &str, value: &str) -> Program {
        self.command.env(name, value);
        self
    }

    /// Runs it to its end and records what it left. In the program itself: does its work and returns `None`.
    pub fn run(mut self) -> Option<Run> {
        if Self::is_this() {
            if std::env::var_os("TAUT_TEST_GROUP").is_some() {
                listen_as_a_group()
            } else {
                talk_and_listen()
            }
            return None;
        }
        let out = self.command.output().unwrap();
        let said = text(&out.stdout);
        assert!(out.status.success(), "{said}{}", text(&out.stderr));
        let directory = scratch(self.name);
        let recording = directory.join("run.trace");
        let (domain, file) = (self.domain.to_string(), recording.display().to_string());
        let out = taut(&["trace", "record", "--domain", &domain, "--seconds", "0", "-o", &file, "--json"]);
        assert!(out.status.success(), "{}", text(&out.stderr));
        let report = serde_json::from_slice(&out.stdout).unwrap();
        Some(Run { directory, recording, report, said })
    }
}

/// Two subscriptions share a thread. Both messages are there before it looks: it takes both, then handles one by one.
fn listen_as_a_group() {
    let context = Context::builder().realtime(Realtime::Off).build().unwrap();
    let mut node = Node::create(context.clone(), "traced", "").unwrap();
    let mut group = CallbackGroup::new();
    let mut publishers = Vec::new();
    for topic in ["~/first", "~/second"] {
        publishers.push(node.create_publisher::<Number>(topic, Qos::default()).unwrap());
        let numbers = node.subscribe::<Number>(topic, Qos::default()).unwrap();
        let release = |number: &Sample<Number>| number.info().released_ns;
        group.add(topic, numbers, release, async |_| {});
    }
    for publisher in &publishers {
        publisher.publish(&Number { value: 1 }).unwrap();
    }
    let callbacks = node.spawn_group(CallbackOptions::other().name("group"), group).unwrap();
    while callbacks.stats().completions() < publishers.len() as u64 {
        std::thread::yield_now();
    }
}

fn talk_and_listen() {
    static BURST: AtomicU64 = AtomicU64::new(0);
    let context = Context::builder().realtime(Realtime::Off).build().unwrap();
    let mut node = Node::create(context.clone(), "traced", "").unwrap();
    let qos = Qos::default();
    let publisher = node.create_publisher::<Number>("~/numbers", qos).unwrap();
    let numbers = node.subscribe::<Number>("~/numbers", qos).unwrap();
    let counters = numbers.counters();
    let listen = async |number: Sample<Number>| {
        // In a burst the first message lasts until all others have been published, which overwrites most of them.
        while number.value == 1 && BURST.load(Ordering::Acquire) == 1 {
            std::thread::yield_now();
        }
    };
    let options = CallbackOptions::other().name("numbers");
    let burst = std::env::var_os("TAUT_TEST_BURST").is_some();
    BURST.store(burst.into(), Ordering::Release);
    let callback = node.spawn_callback(options, numbers.for_each(listen)).unwrap();
    let sampler = std::thread::spawn({
        let context = context.clone();
        move || context.spin().unwrap()
    });
    for value in 1..=MESSAGES as u64 {
        publisher.publish(&Number { value }).unwrap();
        while !burst && callback.stats().completions() < value {
            std::thread::yield_now();
        }
    }
    BURST.store(0, Ordering::Release);
    while callback.stats().completions() + counters.lost() < MESSAGES as u64 {
        std::thread::yield_now();
    }
    println!("lost={}", counters.lost());
    context.shutdown();
    sampler.join().unwrap();
}

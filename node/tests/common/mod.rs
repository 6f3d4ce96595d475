// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the tests share: a message, an ordered log, a system file, a sampler on a thread, a test run again in a child process.
#![allow(dead_code, reason = "each test file uses its part")]

use std::path::PathBuf;
use std::process::{Command, Output};
use std::sync::{Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use futures::StreamExt;
use tautline::{CallbackOptions, Context, CoreSet, Message, Node, Qos, Realtime};
use tautline_rt::clock::test_time;
use tautline_rt::permission::{realtime_permitted, test_needs};

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[repr(C)]
#[message(name = "test_msgs/msg/Number")]
pub struct Number {
    pub value: u64,
}

/// An ordered log of events; a `static`, so that callbacks need no clone of it.
pub struct Log<T> {
    events: Mutex<Vec<T>>,
    more: Condvar,
}

impl<T: Clone> Log<T> {
    pub const fn new() -> Log<T> {
        Log { events: Mutex::new(Vec::new()), more: Condvar::new() }
    }

    pub fn add(&self, event: T) {
        self.events.lock().unwrap().push(event);
        self.more.notify_all();
    }

    pub fn events(&self) -> Vec<T> {
        self.events.lock().unwrap().clone()
    }

    /// Waits until there are `count` events; a test that would hang fails after a minute instead.
    pub fn wait_for(&self, count: usize) -> Vec<T> {
        let events = self.events.lock().unwrap();
        let few = |events: &mut Vec<T>| events.len() < count;
        let patience = test_time(Duration::from_secs(60));
        let (events, wait) = self.more.wait_timeout_while(events, patience, few).unwrap();
        assert!(!wait.timed_out(), "{} of {count} events came", events.len());
        events.clone()
    }
}

/// A gate that is closed until it is opened, once and for ever.
pub struct Gate(Log<()>);

impl Gate {
    pub const fn new() -> Gate {
        Gate(Log::new())
    }

    pub fn open(&self) {
        self.0.add(());
    }

    pub fn pass(&self) {
        self.0.wait_for(1);
    }
}

/// A context without real-time policies, where no user's programs are.
pub fn context(domain: u32) -> Context {
    isolate();
    Context::builder().domain(domain).realtime(Realtime::Off).build().unwrap()
}

/// Puts this process into the tests' scope, unless whoever runs them has chosen one.
pub fn isolate() {
    tautline_rt::domain::test_scope("test");
}

/// A system file, removed at its end.
pub struct File(pub PathBuf);

impl File {
    pub fn new(name: &str, text: &str) -> File {
        let file = File(std::env::temp_dir().join(format!("tautline-{}-{name}.toml", std::process::id())));
        file.write(text);
        file
    }

    pub fn write(&self, text: &str) {
        std::fs::write(&self.0, text).unwrap();
    }

    pub fn context(&self, domain: u32) -> tautline::Result<Context> {
        Context::builder().domain(domain).system(&self.0).build()
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// A context that spins on a thread of its own until this is dropped.
pub struct Spinning {
    context: Context,
    thread: Option<JoinHandle<()>>,
}

pub fn spin(context: &Context) -> Spinning {
    let context = context.clone();
    let sampler = context.clone();
    let thread = std::thread::spawn(move || sampler.spin().unwrap());
    Spinning { context, thread: Some(thread) }
}

impl Drop for Spinning {
    fn drop(&mut self) {
        self.context.shutdown();
        if let Some(thread) = self.thread.take() {
            let result = thread.join();
            assert!(result.is_ok() || std::thread::panicking());
        }
    }
}

/// A node whose context spins until the second is dropped.
pub fn spinning_node(domain: u32, name: &str) -> (Node, Spinning) {
    let context = context(domain);
    let spinning = spin(&context);
    (Node::create(context, name, "").unwrap(), spinning)
}

/// Waits for what another context or process does; a test that would hang fails after half a minute instead.
pub fn eventually(what: &str, mut condition: impl FnMut() -> bool) {
    let (start, patience) = (std::time::Instant::now(), test_time(Duration::from_secs(30)));
    while !condition() {
        assert!(start.elapsed() < patience, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Real-time tests need the privilege; with CI set they must run.
pub fn realtime() -> bool {
    test_needs(realtime_permitted(50)).is_some()
}

/// The cores this process may use, in ascending order.
pub fn cores() -> Vec<usize> {
    CoreSet::allowed().unwrap().iter().collect()
}

const CHILD: &str = "TAUT_TEST_CHILD";

/// Runs the test `name` of this file again in a child process, where this function returns `None`. The child has these
/// environment variables, and none of Tautline's or ROS's besides.
pub fn run_again(name: &str, variables: &[(&str, &str)]) -> Option<Output> {
    if std::env::var_os(CHILD).is_some() {
        return None;
    }
    let mut child = Command::new(std::env::current_exe().unwrap());
    child.args(["--exact", name, "--nocapture", "--test-threads=1"]).env(CHILD, "1");
    for variable in ["TAUT_DOMAIN", "ROS_DOMAIN_ID", "TAUT_REALTIME", "TAUT_CORE_TIME", "TAUT_HOLD_IDLE"] {
        child.env_remove(variable);
    }
    Some(child.envs(variables.iter().copied()).output().unwrap())
}

/// A subscription is polled on a thread of these options, then on an ordinary one: there the sampler wakes it.
pub fn leave_a_thread(domain: u32, options: CallbackOptions) {
    let log: &'static Log<u64> = Box::leak(Box::new(Log::new()));
    let context = context(domain);
    let mut node = Node::create(context.clone(), "mover", "").unwrap();
    let publisher = node.create_publisher::<Number>("/moved", Qos::default()).unwrap();
    let mut numbers = node.subscribe::<Number>("/moved", Qos::default()).unwrap();
    let (leave, left) = std::sync::mpsc::channel();
    let once = async move {
        log.add(numbers.next().await.unwrap().value);
        leave.send(numbers).unwrap();
    };
    node.spawn_callback(options, once).unwrap();
    publisher.publish(&Number { value: 1 }).unwrap();
    let numbers = left.recv().unwrap();
    let callback = numbers.for_each(move |sample| async move { log.add(sample.value) });
    node.spawn_callback(CallbackOptions::other(), callback).unwrap();
    let _spinning = spin(&context);
    for value in 2..=50 {
        publisher.publish(&Number { value }).unwrap();
        log.wait_for(value as usize);
    }
    assert_eq!(log.events(), (1..=50).collect::<Vec<_>>());
}

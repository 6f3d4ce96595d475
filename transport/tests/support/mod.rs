// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the integration tests share: message types, child processes, and a look at shared memory from outside.
#![allow(dead_code, reason = "each test file uses a part")]

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tautline_msgs::Message;
use tautline_rt::clock::test_time;
use tautline_transport::{Claim, Limits, Participant, Publisher, Qos, Subscription};

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "test_msgs/msg/Count", crate = "tautline_msgs")]
#[repr(C)]
pub struct Count {
    pub n: u64,
}

pub const IMAGE_BYTES: usize = 8 << 20;

#[derive(Message, Clone, Copy)]
#[message(name = "test_msgs/msg/Image", crate = "tautline_msgs")]
#[repr(C)]
pub struct Image {
    pub data: [u8; IMAGE_BYTES],
}

/// The default limits without spare memory.
pub const LIMITS: Limits =
    Limits { held: 4, loans: 4, message_bytes: 4096, may_grow: true, claim: Claim::Ahead, spare_bytes: 0 };

/// A domain in the tests' own scope, which no other test file uses. Reserved for this process until it ends: another run of the same
/// tests waits.
pub fn domain(number: u32) -> u32 {
    static RESERVED: Mutex<BTreeMap<u32, File>> = Mutex::new(BTreeMap::new());
    let mut reserved = RESERVED.lock().unwrap_or_else(PoisonError::into_inner);
    if reserved.contains_key(&number) {
        return number;
    }
    let _ = scope();
    let folder = tautline_rt::domain::kept_folder();
    // As the store of definitions makes it.
    let _ = std::fs::DirBuilder::new().mode(0o700).create(&folder);
    let file = File::create(folder.join(format!("test_{number}.lock"))).unwrap();
    rustix::fs::flock(&file, rustix::fs::FlockOperation::LockExclusive).unwrap();
    reserved.insert(number, file);
    number
}

/// That of whoever runs the tests, or one that no user's programs are in, nor the tests of other packages.
fn scope() -> &'static str {
    tautline_rt::domain::test_scope(env!("CARGO_PKG_NAME"))
}

pub fn publisher(participant: &Participant, topic: &str, qos: Qos) -> Publisher<Count> {
    participant.create_publisher(topic, qos, Limits::default()).unwrap()
}

pub fn subscription(participant: &Participant, topic: &str, qos: Qos) -> Subscription<Count> {
    participant.create_subscription(topic, qos, Limits::default()).unwrap()
}

/// Takes all that is there.
pub fn take_all(subscription: &Subscription<Count>) -> Vec<u64> {
    std::iter::from_fn(|| subscription.try_take().unwrap().map(|sample| sample.n)).collect()
}

/// Waits for what another thread or process does; a test that hangs fails after half a minute instead.
pub fn wait_for(what: &str, mut condition: impl FnMut() -> bool) {
    let (start, patience) = (Instant::now(), test_time(Duration::from_secs(30)));
    while !condition() {
        assert!(start.elapsed() < patience, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// As [`wait_for`], for something.
pub fn wait_for_some<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let mut found = None;
    wait_for(what, || {
        found = look();
        found.is_some()
    });
    found.unwrap()
}

/// Tells a thread to stop when it is dropped, so that a test that fails does not wait for it for ever.
pub struct Stop<'a>(pub &'a AtomicBool);

impl Drop for Stop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

/// Where an address lies: the file mapped there, its inode, and the offset in the file.
#[derive(Debug, PartialEq)]
pub struct Place {
    pub path: String,
    pub inode: u64,
    pub offset: usize,
}

pub fn place_of<T>(value: *const T) -> Place {
    let address = value.addr();
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    for line in maps.lines() {
        let fields: Vec<_> = line.split_whitespace().collect();
        let (start, end) = fields[0].split_once('-').unwrap();
        let [start, end] = [start, end].map(|hex| usize::from_str_radix(hex, 16).unwrap());
        if (start..end).contains(&address) {
            return Place {
                path: fields.get(5).copied().unwrap_or_default().to_owned(),
                inode: fields[4].parse().unwrap(),
                offset: usize::from_str_radix(fields[2], 16).unwrap() + (address - start),
            };
        }
    }
    panic!("{address:x} is not mapped");
}

/// Where the files of a domain are.
pub fn folder(domain: u32) -> PathBuf {
    scope();
    Path::new("/dev/shm").join(tautline_rt::domain::shared_folder(domain))
}

/// The files of a domain and the bytes of memory that each really has.
pub fn shared_memory(domain: u32) -> BTreeMap<String, u64> {
    let entries = std::fs::read_dir(folder(domain)).into_iter().flatten().flatten();
    let size = |entry: std::fs::DirEntry| {
        Some((entry.file_name().into_string().unwrap(), std::fs::metadata(entry.path()).ok()?.blocks() * 512))
    };
    entries.filter_map(size).collect()
}

/// The files of participants.
pub fn participants(domain: u32) -> Vec<String> {
    shared_memory(domain).into_keys().filter(|name| name.starts_with('p')).collect()
}

/// What the files of participants have claimed, in bytes: not the trace of a process, which is of all its threads.
pub fn claimed(domain: u32) -> u64 {
    let files = shared_memory(domain).into_iter();
    files.filter(|(name, _)| name.starts_with('p')).map(|(_, bytes)| bytes).sum()
}

/// Removes what killed processes left in a domain in which nobody lives any more.
pub fn clean(domain: u32) {
    // The kernel may hold a dead process's lock a moment longer than the process.
    wait_for("an empty folder", || {
        drop(Participant::new(domain).unwrap());
        // That of this process's trace may be there.
        shared_memory(domain).into_keys().all(|name| name.starts_with("trace_"))
    });
}

/// A child process that runs one test of this binary as its main function, told its part by an environment variable.
pub struct Part {
    child: Child,
    lines: std::io::Lines<BufReader<ChildStdout>>,
}

const PART: &str = "TAUT_TEST_PART";

/// The part that this process was given, in the child; `None` in the test run itself.
pub fn part() -> Option<(String, u32)> {
    let part = std::env::var(PART).ok()?;
    let (name, domain) = part.split_once(',').unwrap();
    Some((name.to_owned(), domain.parse().unwrap()))
}

/// Says something to the parent.
pub fn say(line: &str) {
    println!("\npart: {line}");
}

/// Waits until the parent kills this process, asks it to end, or has gone.
pub fn wait_for_the_end() {
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
}

impl Part {
    pub fn start(name: &str, domain: u32) -> Part {
        Part::start_by(&[], name, domain)
    }

    /// The same, started by a command that gives it other surroundings.
    pub fn start_by(command: &[&str], name: &str, domain: u32) -> Part {
        let program = std::env::current_exe().unwrap();
        let mut words = command.iter().map(std::ffi::OsStr::new).chain([program.as_os_str()]);
        let mut child = Command::new(words.next().unwrap())
            .args(words)
            .args(["--exact", "child_main", "--nocapture", "--test-threads=1"])
            .env(PART, format!("{name},{}", self::domain(domain)))
            .env("TAUT_SCOPE", scope())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Part { child, lines }
    }

    /// The next line that the child says.
    pub fn hear(&mut self) -> String {
        self.hear_or_end().expect("the child ended without a word")
    }

    /// The next line that the child says, if it says one before it ends.
    pub fn hear_or_end(&mut self) -> Option<String> {
        let mut lines = self.lines.by_ref().map_while(Result::ok);
        lines.find_map(|line| line.strip_prefix("part: ").map(str::to_owned))
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Stops the child with SIGSTOP: it lives, and does nothing.
    pub fn stop(&self) {
        self.signal(rustix::process::Signal::STOP);
    }

    /// The child goes on.
    pub fn go_on(&self) {
        self.signal(rustix::process::Signal::CONT);
    }

    fn signal(&self, signal: rustix::process::Signal) {
        rustix::process::kill_process(rustix::process::Pid::from_child(&self.child), signal).unwrap();
    }

    /// Ends the child with SIGKILL, as dropping does; [`clean`] what it leaves.
    pub fn kill(self) {}

    /// Asks the child to end and waits until it has, leaving nothing behind.
    pub fn end(mut self) -> std::process::ExitStatus {
        drop(self.child.stdin.take());
        self.signal(rustix::process::Signal::CONT);
        self.lines.by_ref().map_while(Result::ok).for_each(drop);
        self.child.wait().unwrap()
    }
}

impl Drop for Part {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Fetches what was traced in a domain, so that no file of it stays; returns the number of events.
pub fn traced(domain: u32) -> usize {
    use tautline_trace::Record;
    let mut events = 0;
    tautline_transport::start_recorder(domain).unwrap().finish(&mut |record| match record {
        Record::Events { events: some, .. } => events += some.len(),
        Record::Lost { events: some, .. } => events += some as usize,
        _ => {}
    });
    events
}

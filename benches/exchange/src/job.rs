// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's job, as JSON on its command line, and its output: one line of JSON each, on standard output.

use std::io::{Read, Write, stdin, stdout};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};
use tautline_rt::{CoreSet, MemoryLock, Policy, Realtime, ThreadBuilder, set_affinity, set_policy};

use crate::Result;

/// `SCHED_FIFO` priority of the network's threads: the gateway's.
pub const NETWORK_PRIORITY: u8 = 80;
/// Environment variable with the far processes' ids, separated by commas, for the near endpoint.
pub const PEERS: &str = "TAUTLINE_EXCHANGE_PEERS";
/// Payloads up to this size are small.
const SMALL_BYTES: usize = 64 << 10;
/// `SCHED_FIFO` priority of the thread that sends or runs callbacks.
pub const APPLICATION_PRIORITY: u8 = 50;
/// The warm-up lasts this fraction (1/8) of the measuring time.
pub(crate) const WARM_UP_SHARE: u32 = 8;

/// The endpoint of an exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Role {
    /// Sends first; measures round trips.
    #[default]
    Near,
    /// Answers, or receives a stream.
    Far,
}

/// The kind of exchange.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum Exchange {
    /// One message in each direction.
    #[default]
    RoundTrips,
    /// One way, at full speed with a bounded number of unconfirmed messages; `None`: with the system's own flow control.
    Stream {
        /// Maximum of messages sent and not yet confirmed.
        window: Option<u64>,
    },
    /// One way, at this many messages per second, without confirmations.
    Paced { rate: f64 },
}

/// A process's job.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Job {
    pub role: Role,
    pub exchange: Exchange,
    /// Length of the messages' data.
    pub payload_bytes: usize,
    /// The measuring time, after a warm-up of an eighth of it.
    pub budget: Duration,
    /// The core of all threads; `None`: any.
    pub core: Option<usize>,
    /// Whether the threads have real-time priorities.
    pub realtime: bool,
    /// The domain of Tautline and hiroz.
    pub domain: u32,
    /// Unique for each exchange of a run.
    pub topic: String,
    /// Where the near endpoint connects to the far one, for a direct link.
    pub endpoint: Option<String>,
    /// The variant, where a system has several.
    #[serde(default)]
    pub way: Way,
}

/// The variant of a system.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Way {
    /// The system's name for it.
    pub mode: String,
    /// Whether payloads are written and read completely; otherwise only their [`Stamp`](crate::Stamp).
    pub whole: bool,
    /// Topics of a flow.
    pub topics: usize,
    /// Subscriptions of each topic in this process.
    pub subscribers: usize,
    /// Processes with subscriptions, if there are more than some.
    #[serde(default)]
    pub processes: usize,
    /// For a flow at a rate: all topics get their message at the same instant, one after the other, as from one loop, instead of
    /// evenly over the period.
    pub at_once: bool,
    /// For a flow at a rate: the near endpoint times how long it takes to send each message.
    #[serde(default)]
    pub times_sending: bool,
    /// The core of the other endpoint, for threads that may run there.
    #[serde(default)]
    pub other_core: Option<usize>,
}

impl Job {
    /// Parses the job. From here on the process ends with its parent, and runs on its core.
    ///
    /// # Errors
    /// Text that is not a job; a core that does not exist.
    pub fn begin(text: &str) -> Result<Job> {
        set_parent_process_death_signal(Some(Signal::KILL))?;
        let job: Job = serde_json::from_str(text)?;
        if let Some(core) = job.core {
            set_affinity(CoreSet::one(core))?;
        }
        Ok(job)
    }

    /// The topics on which this endpoint sends and receives.
    pub fn topics(&self) -> [String; 2] {
        let (there, back) = (format!("{}/there", self.topic), format!("{}/back", self.topic));
        match self.role {
            Role::Near => [there, back],
            Role::Far => [back, there],
        }
    }

    /// Queue depth, the same for all systems: 10, for a stream of small messages 100, with a window twice the window.
    pub fn depth(&self) -> usize {
        match self.exchange {
            Exchange::Stream { window: Some(window) } => window as usize * 2,
            Exchange::Stream { .. } if self.payload_bytes <= SMALL_BYTES => 100,
            _ => 10,
        }
    }

    /// Runs `work` in a thread with the application's priority, in a process with locked memory that keeps freed memory, as in
    /// Tautline's contexts.
    ///
    /// # Errors
    /// A refused priority or memory lock, and errors of `work`.
    pub fn as_application<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T> + Send + 'static,
    ) -> Result<T> {
        tautline_rt::keep_freed_memory();
        let locked = tautline_rt::lock_memory(MemoryLock::OnFault);
        // Ignored without priorities: a process without them may not lock memory either.
        if self.realtime {
            locked?;
        }
        self.with_priority("application", APPLICATION_PRIORITY, work)
    }

    fn with_priority<T: Send + 'static>(
        &self,
        name: &str,
        priority: u8,
        work: impl FnOnce() -> Result<T> + Send + 'static,
    ) -> Result<T> {
        let builder = match self.realtime {
            true => ThreadBuilder::new(name).policy(Policy::Fifo(priority)).realtime(Realtime::Required),
            false => ThreadBuilder::new(name).realtime(Realtime::Off),
        };
        // Zenoh's builders need a deep stack.
        builder.stack_bytes(4 << 20).spawn(move || work)?.join()?
    }
}

/// The whole program of a system's endpoints; its job is the first argument.
pub fn program(name: &str, run: impl FnOnce(Job) -> Result<()>) -> ExitCode {
    let job = std::env::args().nth(1).unwrap_or_default();
    match Job::begin(&job).and_then(run) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{name}: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Opens a session whose threads inherit the priority of this one, as in the gateway.
///
/// # Errors
/// A refused priority, and errors of `open`.
pub fn on_network_thread<T: Send + 'static>(
    job: &Job,
    open: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    job.with_priority("open", NETWORK_PRIORITY, open)
}

/// A line of a process's output.
#[derive(Debug, Serialize, Deserialize)]
pub enum Line {
    /// The far endpoint can receive, here if the near one must connect to it.
    Ready(Option<String>),
    /// Every subscription of the far endpoint of a flow has received a message.
    Connected {
        /// When all had (`CLOCK_MONOTONIC`).
        all_ns: u64,
    },
    /// The far endpoint of a flow has received the first measured message.
    Warm,
    /// Every subscription of the far endpoint of a flow at a rate has received the last message.
    Complete,
    /// The results: of round trips from the near endpoint, of a stream from the far one.
    Measured(Measured),
}

impl Line {
    /// The address of the far endpoint.
    pub fn ready(self) -> Option<Option<String>> {
        if let Line::Ready(endpoint) = self { Some(endpoint) } else { None }
    }

    pub fn measured(self) -> Option<Measured> {
        if let Line::Measured(measured) = self { Some(measured) } else { None }
    }
}

/// The results of one endpoint.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Measured {
    /// Half round trips, or times between two arrivals of a stream; of the near endpoint of a flow, how long sending took.
    pub times_ns: Vec<u64>,
    /// Requests without an answer, or messages of a stream that did not arrive.
    pub lost: u64,
    pub seconds: f64,
    /// CPU time of this process while measuring.
    #[serde(default)]
    pub cpu_ns: u64,
    /// Page faults of the thread of the near endpoint of round trips while measuring.
    #[serde(default)]
    pub faults: u64,
    /// Of both endpoints, when the near one had finished.
    #[serde(default)]
    pub memory: Memory,
    /// Messages of a flow that were sent, or that arrived.
    #[serde(default)]
    pub messages: u64,
    /// Messages of a flow at a rate that were due before the previous one was sent; round trips of [`LATE`](crate::LATE) or more.
    #[serde(default)]
    pub late: u64,
    /// Messages of a flow that the system refused.
    #[serde(default)]
    pub refused: u64,
    /// The message number of each of `times_ns`, for a flow with one topic.
    #[serde(default)]
    pub numbers: Vec<u64>,
}

/// Prints a line. A closed output means that the parent has ended.
pub fn say(line: &impl Serialize) {
    if let Ok(text) = serde_json::to_string(line) {
        let mut out = stdout().lock();
        let _ = writeln!(out, "{text}").and_then(|()| out.flush());
    }
}

/// Set when standard input is closed: the parent no longer needs this process.
pub fn stop_flag() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let stop = flag.clone();
    on_stop(move || stop.store(true, Ordering::Relaxed));
    flag
}

/// Waits until standard input is closed: the parent no longer needs this process.
pub fn until_told() {
    // An error is an end, too.
    let _ = stdin().read_to_end(&mut Vec::new());
}

/// Waits for the flag of [`stop_flag`].
pub fn wait_for_stop(flag: &AtomicBool) {
    while !flag.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Runs `then` when standard input is closed, even if threads that start later are busy.
pub fn on_stop(then: impl FnOnce() + Send + 'static) {
    std::thread::spawn(move || {
        // Ignored: a process without this priority has no application threads with it either.
        let _ = set_policy(Policy::Fifo(APPLICATION_PRIORITY + 1));
        until_told();
        then();
    });
}

/// Resident memory; pages shared by several processes count proportionally.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Memory {
    /// All of it.
    pub kib: u64,
    /// The part in shared memory (`/dev/shm` and the like).
    pub shared_kib: u64,
}

impl Memory {
    /// A process's share; 0 if the kernel does not report it.
    pub fn of(process: &str) -> Self {
        let text = std::fs::read_to_string(format!("/proc/{process}/smaps_rollup")).unwrap_or_default();
        let number = |name: &str| {
            let line = text.lines().find_map(|line| line.strip_prefix(name));
            line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(0)
        };
        Memory { kib: number("Pss:"), shared_kib: number("Pss_Shmem:") }
    }

    /// Of this process and its [`PEERS`], now: after one of them has ended, their shared pages would count for the others.
    pub(crate) fn of_exchange() -> Self {
        let peers = std::env::var(PEERS).unwrap_or_default();
        let others = peers.split(',').filter(|peer| !peer.is_empty()).map(Memory::of);
        others.fold(Memory::of("self"), std::ops::Add::add)
    }
}

impl std::ops::Add for Memory {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Memory { kib: self.kib + other.kib, shared_kib: self.shared_kib + other.shared_kib }
    }
}

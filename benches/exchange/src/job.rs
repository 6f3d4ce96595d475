// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a process is told, as JSON on its command line, and what it says: a line of JSON each, on standard output.

use std::io::{Read, Write, stdin, stdout};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};
use tautline_rt::{CoreSet, MemoryLock, Policy, Realtime, ThreadBuilder, set_affinity, set_policy};

use crate::Result;

/// `SCHED_FIFO` priority of the network's threads: that of the gateway.
pub const NETWORK_PRIORITY: u8 = 80;
/// The environment variable that tells the near end the numbers of the far processes, with commas.
pub const PEERS: &str = "TAUTLINE_EXCHANGE_PEERS";
/// Payloads up to this count as small.
const SMALL_BYTES: usize = 64 << 10;
/// `SCHED_FIFO` priority of the thread that sends or is called back.
pub const APPLICATION_PRIORITY: u8 = 50;

/// Which end of an exchange.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Role {
    /// Sends first; holds the clock of round trips.
    Near,
    /// Answers, or receives a stream.
    Far,
}

/// What is exchanged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Exchange {
    /// One message to and fro.
    RoundTrips,
    /// One way, as fast as it goes with so many messages under way; `None`: as the system itself holds the sender back.
    Stream {
        /// Most messages that were sent and not yet confirmed.
        window: Option<u64>,
    },
    /// One way, so many messages a second, whatever becomes of them.
    Paced { rate: f64 },
}

/// What a process is told.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Job {
    pub role: Role,
    pub exchange: Exchange,
    /// Length of the messages' data.
    pub payload_bytes: usize,
    /// How long is measured, after a warm-up of an eighth of it.
    pub budget: Duration,
    /// The core of all threads of the process; `None`: any.
    pub core: Option<usize>,
    /// Whether the threads have their real-time priorities.
    pub realtime: bool,
    /// Tautline's domain; hiroz's.
    pub domain: u32,
    /// Different for each exchange of a run.
    pub topic: String,
    /// Where the near end finds the far one, if they link directly.
    pub endpoint: Option<String>,
    /// How, where a system has several ways.
    #[serde(default)]
    pub way: Way,
}

/// How a system does it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Way {
    /// The system's word for it.
    pub mode: String,
    /// Whether payloads are written and read whole; else only their [`Stamp`](crate::Stamp).
    pub whole: bool,
    /// Topics of a flow.
    pub topics: usize,
    /// Subscriptions of each topic in this process.
    pub subscribers: usize,
    /// Of a flow at a rate: all topics get their message one after the other at the same instant, as from one loop, instead of
    /// evenly over the period.
    pub at_once: bool,
    /// The core of the other end, for what may run there.
    #[serde(default)]
    pub other_core: Option<usize>,
}

impl Job {
    /// The job given as JSON. From here on the process ends with the one that started it, and runs on its core.
    ///
    /// # Errors
    /// Text that is no job; a core that there is not.
    pub fn begin(text: &str) -> Result<Job> {
        set_parent_process_death_signal(Some(Signal::KILL))?;
        let job: Job = serde_json::from_str(text)?;
        if let Some(core) = job.core {
            set_affinity(CoreSet::one(core))?;
        }
        Ok(job)
    }

    /// Topics on which this end sends and receives.
    pub fn topics(&self) -> [String; 2] {
        let (there, back) = (format!("{}/there", self.topic), format!("{}/back", self.topic));
        match self.role {
            Role::Near => [there, back],
            Role::Far => [back, there],
        }
    }

    /// Messages that a queue has room for, whatever the system: 10, of a stream of small ones 100, of one with a window twice that.
    pub fn depth(&self) -> usize {
        match self.exchange {
            Exchange::Stream { window: Some(window) } => window as usize * 2,
            Exchange::Stream { .. } if self.payload_bytes <= SMALL_BYTES => 100,
            _ => 10,
        }
    }

    /// Runs `work` in a thread with the application's priority, in a process whose memory is locked and kept as that of Tautline's
    /// contexts is.
    ///
    /// # Errors
    /// A priority or locked memory that is refused, and what `work` says.
    pub fn as_application<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T> + Send + 'static,
    ) -> Result<T> {
        tautline_rt::keep_freed_memory();
        let locked = tautline_rt::lock_memory(MemoryLock::OnFault);
        // Ignored without priorities: who may not have them may not lock memory either.
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
        // Zenoh's builders are deep.
        builder.stack_bytes(4 << 20).spawn(move || work)?.join()?
    }
}

/// The whole program of a system's ends, whose job is its first argument.
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

/// Opens a session, whose threads inherit the priority of this one: as the gateway does it.
///
/// # Errors
/// A priority that is refused, and what `open` says.
pub fn on_network_thread<T: Send + 'static>(
    job: &Job,
    open: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    job.with_priority("open", NETWORK_PRIORITY, open)
}

/// A line of a process.
#[derive(Debug, Serialize, Deserialize)]
pub enum Line {
    /// The far end can receive, here if the near one is to link to it.
    Ready(Option<String>),
    /// The far end of a flow has had a message on each of its subscriptions.
    Connected {
        /// When all had (`CLOCK_MONOTONIC`).
        all_ns: u64,
    },
    /// The far end of a flow has had the first message that is measured.
    Warm,
    /// The far end of a flow at a rate has had the last message on each of its subscriptions.
    Complete {
        /// When (`CLOCK_MONOTONIC`).
        last_ns: u64,
    },
    /// The end: of round trips from the near end, of a stream from the far one.
    Measured(Measured),
}

impl Line {
    /// Where the far end is linked to.
    pub fn ready(self) -> Option<Option<String>> {
        if let Line::Ready(endpoint) = self { Some(endpoint) } else { None }
    }

    pub fn measured(self) -> Option<Measured> {
        if let Line::Measured(measured) = self { Some(measured) } else { None }
    }
}

/// What one end measured.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Measured {
    /// Half round trips, or times between two arrivals of a stream.
    pub times_ns: Vec<u64>,
    /// Questions without an answer, or messages of a stream that did not arrive.
    pub lost: u64,
    pub seconds: f64,
    /// CPU time of this process meanwhile.
    #[serde(default)]
    pub cpu_ns: u64,
    /// Of both ends, when the near one was done.
    #[serde(default)]
    pub memory: Memory,
    /// Messages of a flow that were sent, or arrived.
    #[serde(default)]
    pub messages: u64,
    /// Messages of a flow at a rate that were due before the one before was sent; round trips of [`LATE`](crate::LATE) or more.
    #[serde(default)]
    pub late: u64,
    /// Messages of a flow that the system did not take.
    #[serde(default)]
    pub refused: u64,
    /// The number of the message that each of `times_ns` belongs to, of a flow with one topic.
    #[serde(default)]
    pub numbers: Vec<u64>,
}

/// Says a line. Nobody listening means that the starter died.
pub fn say(line: &Line) {
    if let Ok(text) = serde_json::to_string(line) {
        let mut out = stdout().lock();
        let _ = writeln!(out, "{text}").and_then(|()| out.flush());
    }
}

/// Set when standard input is closed: the starter needs this process no more.
pub fn stop_flag() -> Arc<AtomicBool> {
    let flag = Arc::new(AtomicBool::new(false));
    let stop = flag.clone();
    on_stop(move || stop.store(true, Ordering::Relaxed));
    flag
}

/// Until the flag of [`stop_flag`] is set.
pub fn wait_for_stop(flag: &AtomicBool) {
    while !flag.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Runs `then` when standard input is closed, however busy threads are that are started later.
pub fn on_stop(then: impl FnOnce() + Send + 'static) {
    std::thread::spawn(move || {
        // Ignored: who may not have this priority has no threads of the application's either.
        let _ = set_policy(Policy::Fifo(APPLICATION_PRIORITY + 1));
        let _ = stdin().read_to_end(&mut Vec::new());
        then();
    });
}

/// Resident memory: what several processes have mapped counts in part for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Memory {
    /// All of it.
    pub kib: u64,
    /// Of it, shared memory (`/dev/shm` and the like).
    pub shared_kib: u64,
}

impl Memory {
    /// A process's share; 0 if the kernel does not say.
    pub fn of(process: &str) -> Self {
        let text = std::fs::read_to_string(format!("/proc/{process}/smaps_rollup")).unwrap_or_default();
        let number = |name: &str| {
            let line = text.lines().find_map(|line| line.strip_prefix(name));
            line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(0)
        };
        Memory { kib: number("Pss:"), shared_kib: number("Pss_Shmem:") }
    }

    /// Of this process and of its [`PEERS`], now: later, when one of them has gone, what they shared would count for the others.
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

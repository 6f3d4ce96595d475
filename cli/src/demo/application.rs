// SPDX-License-Identifier: MIT OR Apache-2.0
//! The application: topics, message, priorities (ECRTS 2025, section 5), from examples/systems/paper.toml.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use tautline::{CallbackHandle, CallbackStats, Context, ContextBuilder, Message, Qos, Realtime};
use tautline_analysis::Task;
use tautline_analysis::file::{CheckedCallback, SystemFile};

use super::{DemoArgs, DemoError};
use crate::moment::Moment;

/// Priorities of the publisher's sampler and worker in the paper: above the subscriber's.
pub const PUBLISHER_SAMPLER_PRIORITY: u8 = 25;
pub const PUBLISHER_WORKER_PRIORITY: u8 = 24;

/// Topics, execution times and priorities, as `taut check` reads them.
const SYSTEM: &str = include_str!("../../../examples/systems/paper.toml");

/// What is taken from one job is noted if it is as long.
const PIECE: Duration = Duration::from_micros(1);

/// The message of every topic.
#[derive(Message, Clone, Copy, Default)]
#[repr(C)]
#[message(name = "demo_msgs/msg/Stamped")]
pub struct Stamped {
    /// Counts the topic's releases, from 1.
    pub counter: u64,
    /// When the message was due, on `CLOCK_MONOTONIC`.
    pub release_ns: u64,
}

/// One topic and its callback.
pub struct Topic {
    pub name: String,
    pub period: Duration,
    pub wcet: Duration,
    pub priority: u8,
}

/// The topics, fastest first.
pub fn topics() -> Result<Vec<Topic>, DemoError> {
    let topic = |callback: CheckedCallback| Topic {
        name: callback.entry.name,
        period: Duration::from_nanos(callback.period_ns),
        wcet: Duration::from_nanos(callback.wcet_ns),
        priority: callback.entry.priority,
    };
    Ok(SystemFile::parse(SYSTEM)?.check().callbacks.into_iter().map(topic).collect())
}

/// Priority of the subscriber's sampler.
pub fn sampler_priority(args: &DemoArgs) -> Result<u8, DemoError> {
    match args.sampler_priority {
        Some(priority) => Ok(priority),
        None => Ok(SystemFile::parse(SYSTEM)?.cores().first().map_or(99, |core| core.sampler_priority)),
    }
}

impl Topic {
    /// The callback as the analysis sees it.
    pub fn task(&self) -> Task {
        Task::new(self.name.as_str(), self.period, self.wcet, self.priority)
    }
}

/// The paper's quality of service.
pub fn qos() -> Qos {
    Qos::keep_last(100)
}

/// What both processes' contexts have in common.
pub fn context(args: &DemoArgs, sampler_priority: u8) -> ContextBuilder {
    let builder = Context::builder().realtime(realtime(args)).sampler_priority(sampler_priority);
    builder.account_core_time(Some(PIECE))
}

pub fn realtime(args: &DemoArgs) -> Realtime {
    if args.no_rt { Realtime::Off } else { Realtime::Required }
}

/// Collects what was taken from callbacks' cores, as their threads saw it: from a thread of its own while they run, for only the
/// latest moments are kept where they are noted.
pub struct MomentCollector {
    over: Arc<AtomicBool>,
    thread: JoinHandle<Vec<Moment>>,
}

impl MomentCollector {
    /// Calls `progress` each time before it collects.
    pub fn new<'a>(
        callbacks: impl IntoIterator<Item = &'a CallbackHandle>,
        progress: impl Fn() + Send + 'static,
    ) -> Self {
        // Of each callback, how many moments have been collected or were overwritten before.
        let mut known: Vec<_> =
            callbacks.into_iter().map(|callback| (Arc::clone(callback.stats()), 0)).collect();
        let over = Arc::new(AtomicBool::new(false));
        let ends = Arc::clone(&over);
        let thread = std::thread::spawn(move || {
            let mut moments = Vec::new();
            loop {
                let last = ends.load(Ordering::Acquire);
                known.iter_mut().for_each(|(stats, known)| moments.extend(new_moments(stats, known)));
                if last {
                    return moments;
                }
                std::thread::sleep(Duration::from_millis(200));
                progress();
            }
        });
        MomentCollector { over, thread }
    }

    /// All that was collected, when the callbacks have ended.
    pub fn end(self) -> Vec<Moment> {
        self.over.store(true, Ordering::Release);
        self.thread.join().unwrap_or_default()
    }
}

fn new_moments(stats: &CallbackStats, known: &mut u64) -> Vec<Moment> {
    let Some(seen) = stats.snapshot() else { return Vec::new() };
    let (older, latest) = (seen.older_moments, seen.moments);
    let seen_before = usize::try_from(known.saturating_sub(older)).unwrap_or(usize::MAX);
    *known = older + latest.len() as u64;
    latest.iter().skip(seen_before).map(Moment::from).collect()
}

/// Binds the whole process to the demo's core: threads inherit it.
pub fn bind(core: usize) -> Result<(), DemoError> {
    tautline::rt::set_affinity(tautline::CoreSet::one(core))
        .map_err(|source| DemoError::Core { core, source })
}

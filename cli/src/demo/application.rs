// SPDX-License-Identifier: MIT OR Apache-2.0
//! The application: topics, message, priorities (ECRTS 2025, section 5), from examples/systems/paper.toml.

use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;
use tautline::{CallbackHandle, CallbackStats, Context, ContextBuilder, CoreSet, Message, Qos, Realtime};
use tautline_analysis::Task;
use tautline_analysis::file::{CheckedCallback, SystemFile};
use tautline_rt::clock::thread_cpu_ns;
use tautline_rt::{current_affinity, set_affinity};

use super::args::{DemoArgs, unusable_core};
use crate::moment::Moment;
use crate::verb::{Failure, Outcome};

/// Priorities of the publisher's sampler and worker in the paper: above the subscriber's.
pub const PUBLISHER_SAMPLER_PRIORITY: u8 = 25;
pub const PUBLISHER_WORKER_PRIORITY: u8 = 24;

/// Topics, execution times and priorities, as `taut check` reads them.
const SYSTEM: &str = include_str!("paper.toml");

/// Shorter times that are taken from a job, or that the middleware uses, are not recorded.
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

fn system() -> Outcome<SystemFile> {
    let source = "examples/systems/paper.toml, from which this program was built";
    SystemFile::parse(SYSTEM).map_err(|problems| Failure::unusable(format!("{source}: {problems}")))
}

/// The callbacks of the topics, whose names they have, fastest first.
pub fn tasks() -> Outcome<Vec<Task>> {
    let task = |callback: CheckedCallback| {
        let [period, wcet] = [callback.period_ns, callback.wcet_ns].map(Duration::from_nanos);
        Task::new(callback.entry.name, period, wcet, callback.entry.priority)
    };
    Ok(system()?.check().callbacks.into_iter().map(task).collect())
}

/// Priority of the subscriber's sampler.
pub fn sampler_priority(args: &DemoArgs) -> Outcome<u8> {
    match args.sampler_priority {
        Some(priority) => Ok(priority),
        None => Ok(system()?.cores().first().map_or(99, |core| core.sampler_priority)),
    }
}

/// The paper's quality of service.
pub fn qos() -> Qos {
    Qos::keep_last(100)
}

/// The common settings of both processes' contexts.
pub fn context(args: &DemoArgs, sampler_priority: u8) -> ContextBuilder {
    let builder = Context::builder().realtime(realtime(args)).sampler_priority(sampler_priority);
    builder.account_core_time(Some(PIECE))
}

pub fn realtime(args: &DemoArgs) -> Realtime {
    if args.no_rt { Realtime::Off } else { Realtime::Required }
}

/// The moments that threads recorded: time that was taken from their core, and time that the middleware used.
#[derive(Serialize, Deserialize, Debug, Default)]
pub struct Collected {
    /// One list for each callback, in the order of the callbacks.
    pub by_callbacks: Vec<Vec<Moment>>,
    pub by_sampler: Vec<Moment>,
    /// The number of moments that were overwritten before they were collected.
    pub overwritten: u64,
    /// Processor time of collecting, which does not count as the middleware's.
    pub cpu_ns: u64,
}

/// Collects moments in a separate thread during the run, because each callback keeps only its latest ones.
pub struct MomentCollector {
    over: Arc<AtomicBool>,
    thread: JoinHandle<Collected>,
}

impl MomentCollector {
    /// Collects the moments of these callbacks and of the sampler. The thread runs on one of the cores `elsewhere`, if any, and calls
    /// `progress` before each collection.
    pub fn new<'a>(
        context: &'a Context,
        elsewhere: CoreSet,
        callbacks: impl IntoIterator<Item = &'a CallbackHandle>,
        progress: impl Fn() + Send + 'static,
    ) -> Self {
        // Each source has the number of its moments that were collected or overwritten before.
        let source = |stats: &Arc<CallbackStats>| (Arc::clone(stats), 0);
        let mut of_callbacks: Vec<_> =
            callbacks.into_iter().map(|callback| source(callback.stats())).collect();
        let mut of_sampler = context.sampler_statistics().map(source);
        let over = Arc::new(AtomicBool::new(false));
        let ends = Arc::clone(&over);
        let thread = std::thread::spawn(move || {
            // An empty set of cores is refused; then the thread runs on the demo's core.
            let _ = set_affinity(elsewhere);
            let mut collected =
                Collected { by_callbacks: vec![Vec::new(); of_callbacks.len()], ..Collected::default() };
            loop {
                let last = ends.load(Ordering::Acquire);
                let Collected { by_callbacks, by_sampler, overwritten, cpu_ns } = &mut collected;
                for (source, moments) in of_callbacks.iter_mut().zip(by_callbacks) {
                    *overwritten += collect(source, moments);
                }
                *overwritten += of_sampler.as_mut().map_or(0, |source| collect(source, by_sampler));
                *cpu_ns = thread_cpu_ns();
                if last {
                    return collected;
                }
                std::thread::sleep(Duration::from_millis(50));
                progress();
            }
        });
        MomentCollector { over, thread }
    }

    /// Returns everything that was collected; call it after the callbacks have ended.
    pub fn end(self) -> Collected {
        self.over.store(true, Ordering::Release);
        self.thread.join().unwrap_or_default()
    }
}

/// Adds the moments since the last call; returns how many were overwritten.
fn collect((stats, known): &mut (Arc<CallbackStats>, u64), moments: &mut Vec<Moment>) -> u64 {
    let Some(seen) = tautline_executor::CallbackSnapshot::of(stats) else { return 0 };
    let (older, latest) = (seen.older_moments, seen.moments);
    let known = std::mem::replace(known, older + latest.len() as u64);
    let seen_before = usize::try_from(known.saturating_sub(older)).unwrap_or(usize::MAX);
    moments.extend(latest.iter().skip(seen_before).map(Moment::from));
    older.saturating_sub(known)
}

/// Binds the whole process to the demo's core, which threads inherit. Returns the other cores that the process may use.
pub fn bind(core: Option<usize>) -> Outcome<CoreSet> {
    let Some(core) = core else { return Ok(CoreSet::empty()) };
    let elsewhere = current_affinity()?.iter().filter(|other| *other != core);
    set_affinity(CoreSet::one(core)).map_err(unusable_core(core))?;
    Ok(elsewhere.fold(CoreSet::empty(), CoreSet::with))
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The application: topics, message, priorities (ECRTS 2025, section 5), from examples/systems/paper.toml.

use std::sync::Arc;
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
const PIECE: Duration = Duration::from_micros(10);

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

/// Collects what was taken from a callback's core, as its thread sees it.
pub struct MomentCollector {
    stats: Arc<CallbackStats>,
    /// How many moments have been collected, or were overwritten before.
    known: u64,
    pub moments: Vec<Moment>,
}

impl MomentCollector {
    pub fn new(callback: &CallbackHandle) -> Self {
        MomentCollector { stats: callback.stats().clone(), known: 0, moments: Vec::new() }
    }

    /// Collects what was seen since the last time: often enough, for only the latest are kept.
    pub fn collect(&mut self) {
        let Some(seen) = self.stats.snapshot() else { return };
        let (older, latest) = (seen.older_moments, seen.moments);
        let known = usize::try_from(self.known.saturating_sub(older)).unwrap_or(usize::MAX);
        self.known = older + latest.len() as u64;
        self.moments.extend(latest.iter().skip(known).map(Moment::from));
    }
}

/// Binds the whole process to the demo's core: threads inherit it.
pub fn bind(core: usize) -> Result<(), DemoError> {
    tautline::rt::set_affinity(tautline::CoreSet::one(core))
        .map_err(|source| DemoError::Core { core, source })
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The application: topics, message, priorities (ECRTS 2025, section 5).

use std::time::Duration;
use tautline::{Context, ContextBuilder, Message, QosProfile, Realtime};
use tautline_analysis::Task;

use super::{DemoArgs, DemoError};

/// Priorities of the paper: the publisher's sampler and worker, the subscriber's sampler, the highest callback.
pub const PUBLISHER_SAMPLER_PRIORITY: u8 = 25;
pub const PUBLISHER_WORKER_PRIORITY: u8 = 24;
pub const SAMPLER_PRIORITY: u8 = 21;
pub const HIGHEST_CALLBACK_PRIORITY: u8 = 20;

/// Names, periods and execution times in milliseconds.
const TOPICS: [(&str, u64, u64); 5] =
    [("topic1", 10, 2), ("topic2", 20, 4), ("topic3", 50, 5), ("topic4", 100, 15), ("topic5", 200, 50)];

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
    pub name: &'static str,
    pub period: Duration,
    pub wcet: Duration,
    pub priority: u8,
}

/// The topics, with rate-monotonic priorities.
pub fn topics() -> Result<Vec<Topic>, DemoError> {
    let periods = TOPICS.map(|(_, period_ms, _)| Duration::from_millis(period_ms));
    let priorities = tautline::assign::rate_monotonic(&periods, HIGHEST_CALLBACK_PRIORITY)
        .map_err(tautline::Error::from)?;
    let topics = TOPICS.iter().zip(periods).zip(priorities);
    Ok(topics
        .map(|((&(name, _, wcet_ms), period), priority)| Topic {
            name,
            period,
            wcet: Duration::from_millis(wcet_ms),
            priority,
        })
        .collect())
}

impl Topic {
    /// The callback as the analysis sees it.
    pub fn task(&self) -> Task {
        Task::new(self.name, self.period, self.wcet, self.priority)
    }
}

/// The paper's quality of service.
pub fn qos() -> QosProfile {
    QosProfile::default().keep_last(100)
}

/// What both processes' contexts have in common.
pub fn context(args: &DemoArgs, sampler_priority: u8) -> ContextBuilder {
    Context::builder().realtime(realtime(args)).sampler_priority(sampler_priority)
}

pub fn realtime(args: &DemoArgs) -> Realtime {
    if args.no_rt { Realtime::Off } else { Realtime::Required }
}

/// Binds the whole process to the demo's core: threads inherit it.
pub fn bind(core: usize) -> Result<(), DemoError> {
    tautline::rt::set_affinity(tautline::CoreSet::one(core))
        .map_err(|source| DemoError::Core { core, source })
}

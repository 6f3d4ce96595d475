// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a process is told: JSON, as its only argument.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::Variant;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Releases the messages.
    Publisher,
    /// Runs the callbacks.
    Subscriber,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Job {
    pub role: Role,
    /// How the subscriber executes its callbacks.
    pub variant: Variant,
    pub topics: Vec<Topic>,
    /// The core on which both processes run.
    pub core: usize,
    /// For how long messages are released.
    pub seconds: f64,
    /// Namespace of the topics: a run hears no other.
    pub namespace: String,
    /// Whether priorities are set at all; without, nothing can be concluded.
    pub realtime: bool,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Topic {
    /// Its name, without namespace.
    pub name: String,
    pub period_ns: u64,
    /// CPU time of the callback for each message.
    pub wcet_ns: u64,
    /// `SCHED_FIFO` priority of the callback.
    pub priority: u8,
    /// Latest end of the callback after the release.
    pub deadline_ns: u64,
    /// Quality of service: keep the last this many messages.
    pub depth: usize,
}

impl Topic {
    pub fn wcet(&self) -> Duration {
        Duration::from_nanos(self.wcet_ns)
    }

    pub fn period(&self) -> Duration {
        Duration::from_nanos(self.period_ns)
    }

    pub fn full_name(&self, job: &Job) -> String {
        format!("{}/{}", job.namespace, self.name)
    }
}

impl Job {
    pub fn duration_ns(&self) -> u64 {
        (self.seconds * 1e9) as u64
    }

    pub fn releases(&self, topic: &Topic) -> u64 {
        self.duration_ns().div_ceil(topic.period_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_reaches_another_process_unchanged() {
        let topic = Topic {
            name: "topic1".into(),
            period_ns: 10_000_000,
            wcet_ns: 2_000_000,
            priority: 20,
            deadline_ns: 10_000_000,
            depth: 100,
        };
        let job = Job {
            role: Role::Subscriber,
            variant: Variant::FUTURES_RT,
            topics: vec![topic],
            core: 1,
            seconds: 0.025,
            namespace: "/run1".into(),
            realtime: true,
        };
        let text = serde_json::to_string(&job).unwrap();
        assert!(text.contains(r#""variant":"futures-rt""#), "{text}");
        assert_eq!(serde_json::from_str::<Job>(&text).unwrap(), job);
        assert_eq!(job.topics[0].full_name(&job), "/run1/topic1");
        assert_eq!(job.releases(&job.topics[0]), 3, "at 0, 10 and 20 ms");
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a process tells the one that started it: a line of JSON each, on standard output.
//!
//! What it is told in turn comes on standard input: the subscriber gets how many messages of each topic were published, a
//! JSON list. Closing it ends either process.

use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Line {
    /// The subscriber can receive.
    Ready,
    /// The end of the publisher.
    Published(Published),
    /// The end of the subscriber.
    Measured(Measured),
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Published {
    /// Messages of each topic.
    pub messages: Vec<u64>,
    /// Releases that came too late to be published: not lost, never sent.
    pub missed: u64,
    /// CPU time of the process while it published.
    pub cpu_ns: u64,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// CPU time of the process beyond the callbacks' own.
    pub overhead_cpu_ns: u64,
    pub topics: Vec<TopicMeasured>,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TopicMeasured {
    /// From scheduled release to end of callback, in the order of the callbacks.
    pub latencies_ns: Vec<u64>,
    /// Messages that the middleware itself counted as lost, if it counts.
    pub counted_lost: Option<u64>,
}

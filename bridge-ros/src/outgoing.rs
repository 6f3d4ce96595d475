// SPDX-License-Identifier: MIT OR Apache-2.0
//! From shared memory to ROS: one thread takes the samples of all topics and publishes them.
//!
//! rmw reads a sample where it is, in shared memory.

use crate::rcl::{RclError, RosPublisher, SerializedMessage};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tautline_relay::{EarlyLimits, Egress, Last, Outbound, OutboundSample, Relay, TopicKey};
use tautline_rt::clock::monotonic_ns;

/// XCDR1, little endian.
pub(crate) const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// The thread that publishes in ROS; dropping this ends it.
pub(crate) type Outgoing = Relay<Ros>;

/// Publishes samples in ROS.
pub(crate) struct Ros {
    buffer: SerializedMessage,
}

/// A publisher in ROS that mirrors one of the domain.
#[derive(Clone)]
pub(crate) struct Writer {
    pub(crate) publisher: Arc<RosPublisher>,
    /// Has the lifetime of the publisher in ROS, and is used by the relay's thread only.
    pub(crate) last: Arc<Mutex<Last>>,
}

impl Ros {
    pub(crate) fn new() -> Result<Self, RclError> {
        Ok(Ros { buffer: SerializedMessage::new()? })
    }
}

impl Egress for Ros {
    type Key = TopicKey;
    type Topic = Outbound;
    type Sender = Writer;

    // Samples are held until a publisher in ROS has matched its subscriptions.
    const EARLY: EarlyLimits = EarlyLimits { samples: 1000, bytes: 64 << 20, time: Duration::from_secs(3) };

    fn pass(&mut self, topic: &mut Outbound, writer: &mut Writer, sample: OutboundSample) {
        if !writer.last.lock().unwrap_or_else(PoisonError::into_inner).admits(&sample) {
            return;
        }
        if !topic.limiter.admits(monotonic_ns()) {
            return topic.counters.dropped("rate limit");
        }
        let (publisher, port) = (&writer.publisher, sample.port());
        let published = match sample.serialized() {
            Some(bytes) => publisher.publish_from(port, bytes),
            None => {
                let assigned = self.buffer.assign(&ENCAPSULATION, sample.body());
                assigned.and_then(|()| publisher.publish_from(port, self.buffer.bytes()))
            }
        };
        match published {
            Ok(()) => topic.counters.passed(sample.body().len(), sample.info().source_timestamp_ns),
            Err(error) => topic.counters.dropped(error.reason),
        }
    }

    fn dropped(topic: &Outbound) {
        topic.counters.dropped("publisher not in ROS yet");
    }

    fn lost(topic: &Outbound, samples: u64) {
        topic.counters.lost(samples);
    }
}

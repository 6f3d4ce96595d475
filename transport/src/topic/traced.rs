// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a mirror (a gateway, a bridge) tells a trace of the messages that it passes on. What it publishes in its domain
//! [`as`](crate::RawLoan::publish_as) another publisher's message is told by publishing.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]

use crate::topic::header::{Gid, MessageInfo};
use tautline_trace::{MessageId, Object, ObjectId};

/// What a mirror sends the messages of one publisher to a network through, as traces speak of it.
#[derive(Debug)]
pub struct TracedSender(Object);

impl TracedSender {
    /// `gid` is the publisher's on the network, where its messages are known by it and their number.
    ///
    /// # Real-time
    /// Setup only: takes a lock, allocates.
    pub fn new(topic: &str, gid: Gid) -> Self {
        TracedSender(tautline_trace::sender_init(topic, gid.words()))
    }

    /// The sample that came through the port `from` under a number there goes out under `sequence_number`.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn sample(&self, from: (Gid, u64), sequence_number: u64) -> TracedSample {
        TracedSample { sender: self.0.id(), from, sequence_number }
    }
}

/// One sample on its way out of the domain.
#[derive(Clone, Copy, Debug)]
pub struct TracedSample {
    sender: ObjectId,
    from: (Gid, u64),
    sequence_number: u64,
}

impl TracedSample {
    /// The sample is about to be handed to the network: by the thread that does so.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall, except in the first event of a thread while it is traced.
    pub fn record(&self) {
        let (port, number) = self.from;
        tautline_trace::pass(self.sender, self.sequence_number, port.words(), number);
    }
}

/// The port that a mirror publishes through, as traces speak of it.
#[derive(Clone, Copy, Debug)]
pub struct TracedPort(pub(crate) ObjectId);

impl TracedPort {
    /// A message has come from a network; `source` is what identifies it there.
    ///
    /// # Real-time
    /// As [`TracedSample::record`].
    pub fn received(self, source: &MessageInfo) {
        let MessageInfo { sequence_number, source_timestamp_ns, publisher_gid, .. } = *source;
        let message =
            MessageId { sequence_number, source_timestamp_ns, gid: publisher_gid.words(), address: 0 };
        tautline_trace::receive(self.0, &message);
    }
}

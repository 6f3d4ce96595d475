// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a mirror (a gateway or a bridge) records in a trace about the messages that it forwards. Messages that it
//! publishes in its domain [`as`](crate::RawLoan::publish_as) another publisher's are recorded by publishing.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]

use crate::memory::header::{Gid, MessageInfo};
use crate::topic::publisher::RawPublisher;
use tautline_trace::{MessageId, Object, ObjectId};

/// A mirror's sender of one publisher's messages to a network, as an object in traces.
#[derive(Debug)]
pub struct TracedSender(Object);

impl TracedSender {
    /// `gid` is the publisher's GID on the network. There it identifies a message together with the message's
    /// number.
    ///
    /// # Real-time
    /// Setup only: takes a lock, allocates.
    pub fn new(topic: &str, gid: Gid) -> Self {
        TracedSender(tautline_trace::sender_init(topic, gid.words()))
    }

    /// Describes a sample that came through the port `from`, with its number in that port, and is sent as number
    /// `sequence_number`.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn sample(&self, from: (Gid, u64), sequence_number: u64) -> TracedSample {
        TracedSample { sender: self.0.id(), from, sequence_number }
    }
}

/// One sample that is about to leave the domain.
#[derive(Clone, Copy, Debug)]
pub struct TracedSample {
    sender: ObjectId,
    from: (Gid, u64),
    sequence_number: u64,
}

impl TracedSample {
    /// Records that the sample is about to be passed to the network. Call it in the thread that does this.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall, except in the first event of a thread while it is traced.
    pub fn record(&self) {
        let (port, number) = self.from;
        tautline_trace::pass(self.sender, self.sequence_number, port.words(), number);
    }
}

/// The port through which a mirror publishes, as an object in traces.
#[derive(Clone, Copy, Debug)]
pub struct TracedPort(ObjectId);

impl RawPublisher {
    /// This port as an object in traces, for a mirror that records which messages it has received.
    pub fn traced(&self) -> TracedPort {
        TracedPort(self.trace_id())
    }
}

impl TracedPort {
    /// Records that a message has arrived from a network; `source` identifies it there.
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

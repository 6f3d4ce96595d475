// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much shared memory a topic takes.

use crate::qos::Limits;
use crate::topic::BODY_ALIGNMENT;

/// Bytes that iceoryx2 and Tautline put before a body.
const HEADERS_BYTES: usize = 128;

/// Shared memory of one publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicMemory {
    /// Address space reserved per publisher, in bytes. Sparse: only what was written is resident.
    pub reserved_bytes: usize,
    /// Most bytes resident with `subscriptions` subscriptions of `depth`, each holding one sample, and one loan.
    pub resident_bytes: usize,
}

/// The memory of one publisher of messages of `body_bytes`, given the topic's limits and its actual subscriptions.
pub fn topic_memory(body_bytes: usize, limits: Limits, subscriptions: usize, depth: usize) -> TopicMemory {
    let sample = (body_bytes + HEADERS_BYTES).next_multiple_of(BODY_ALIGNMENT);
    // Keepers of transient-local publishers are subscribers too.
    let subscribers = limits.subscribers + limits.publishers;
    let reserved = subscribers * (limits.depth + limits.held) + limits.loans;
    // All queues hold the same newest `depth` samples; each subscription may hold one older one.
    let in_flight = depth + subscriptions + 1;
    TopicMemory { reserved_bytes: reserved * sample, resident_bytes: in_flight.min(reserved) * sample }
}

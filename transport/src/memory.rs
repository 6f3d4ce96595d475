// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much shared memory a topic takes.

use crate::header::SampleHeader;
use crate::qos::Limits;
use crate::topic::{BODY_ALIGNMENT, padded};
use iceoryx2::service::header::publish_subscribe::Header;

/// Bytes that iceoryx2 and Tautline put before a body.
const HEADERS_BYTES: usize = (size_of::<Header>().next_multiple_of(align_of::<SampleHeader>())
    + size_of::<SampleHeader>())
.next_multiple_of(BODY_ALIGNMENT);
/// Samples start at multiples of this.
const SAMPLE_ALIGNMENT: usize =
    if align_of::<Header>() > BODY_ALIGNMENT { align_of::<Header>() } else { BODY_ALIGNMENT };
/// Segments that iceoryx2 keeps books of for memory that can grow, and what each costs a process that maps them, and a
/// connection in shared memory, besides its samples. Measured with 0.10.0.
const SEGMENTS: usize = 255;
const SEGMENT_BYTES: usize = 1216;
const SEGMENT_CONNECTION_BYTES: usize = 40;

/// Shared memory of one publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicMemory {
    /// Address space reserved per publisher, in bytes. Sparse: only what was written is resident.
    pub reserved_bytes: usize,
    /// Most bytes resident with `subscriptions` subscriptions of `depth`, each holding one sample, and one loan.
    pub resident_bytes: usize,
    /// iceoryx2's books of a publisher whose memory can grow, because its type has no fixed size and `Limits::may_grow` is
    /// set: heap of the publisher and of each subscription that is connected, and shared memory between them. Resident,
    /// besides what is above.
    pub growth_books_bytes: usize,
}

/// The memory of one publisher of messages of `body_bytes`, given the topic's limits and its actual subscriptions.
///
/// For a type without a fixed size `body_bytes` is the largest message, and `limits.message_bytes` is at least that. If it
/// is not, each larger message doubles the samples' size until it fits, in a new segment of as many samples; the old
/// segment goes when its last sample has come back.
pub fn topic_memory(body_bytes: usize, limits: Limits, subscriptions: usize, depth: usize) -> TopicMemory {
    let (sample, samples) = (sample_bytes(body_bytes), samples(limits));
    // All queues hold the same newest `depth` samples; each subscription may hold one older one.
    let in_flight = depth + subscriptions + 1;
    TopicMemory {
        reserved_bytes: samples * sample,
        resident_bytes: in_flight.min(samples) * sample,
        // A counter of 8 bytes in the publisher's heap and a byte in each connection, for each sample of each segment.
        growth_books_bytes: SEGMENTS
            * (samples * 8
                + SEGMENT_BYTES
                + subscriptions * (samples + SEGMENT_CONNECTION_BYTES + SEGMENT_BYTES)),
    }
}

/// Samples that one publisher can have in flight, so that no loan fails for want of memory.
///
/// Every queue was given the same samples and keeps the newest of them, so all queues together hold no more than the
/// newest `depth`. An older sample is one that a subscription or a keeper holds, or that the publisher has loaned: while
/// it loans it sends nothing, so meanwhile no sample grows old, and a subscription that gives one back and takes another
/// takes one of the newest. (iceoryx2's own number, which would do if each queue held other samples, is some 12 times this.)
pub(crate) fn samples(limits: Limits) -> usize {
    limits.depth + (limits.subscribers + limits.publishers) * limits.held + limits.loans
}

/// What a sample with a body of `body_bytes` takes.
fn sample_bytes(body_bytes: usize) -> usize {
    (HEADERS_BYTES + padded(body_bytes)).next_multiple_of(SAMPLE_ALIGNMENT)
}

/// The longest payload of a memory that was grown for one of `payload_bytes`: samples become a power of two.
pub(crate) fn grown_payload(payload_bytes: usize) -> usize {
    let sample = sample_bytes(payload_bytes).next_power_of_two();
    (sample - HEADERS_BYTES) / BODY_ALIGNMENT * BODY_ALIGNMENT
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn a_grown_sample_is_a_power_of_two() {
        for payload in (1..100_000).step_by(7) {
            let grown = grown_payload(payload);
            assert!(grown >= payload && sample_bytes(grown).is_power_of_two(), "{payload} {grown}");
            assert!(sample_bytes(grown + 1) > sample_bytes(grown));
        }
        assert_eq!(HEADERS_BYTES, 128, "docs/memory.md says so");
    }
}

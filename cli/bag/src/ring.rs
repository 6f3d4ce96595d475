// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ring of bytes between the thread that takes messages and the thread that writes them. Its memory is allocated at the start.

use rtrb::{Consumer, Producer, RingBuffer};
use std::sync::atomic::{Ordering, fence};
use taut_cli::verb::{Failure, Outcome};
use tautline_transport::Gid;

/// The header of each message in the ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Head {
    /// The number of the observer that took the message.
    pub topic: u32,
    /// Length of the body, including the encapsulation header.
    pub cdr_bytes: u32,
    pub sequence: u64,
    pub log_ns: u64,
    pub publish_ns: u64,
    /// The GID of the message's publisher, if it is recorded.
    pub publisher: Gid,
}

pub const HEAD_BYTES: usize = 48;

impl Head {
    pub fn to_bytes(self) -> [u8; HEAD_BYTES] {
        let mut bytes = [0; HEAD_BYTES];
        bytes[0..4].copy_from_slice(&self.topic.to_le_bytes());
        bytes[4..8].copy_from_slice(&self.cdr_bytes.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.log_ns.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.publish_ns.to_le_bytes());
        bytes[32..].copy_from_slice(&self.publisher.0);
        bytes
    }

    pub fn from_bytes(bytes: [u8; HEAD_BYTES]) -> Self {
        let four = |at: usize| bytes[at..at + 4].try_into().map_or(0, u32::from_le_bytes);
        let eight = |at: usize| bytes[at..at + 8].try_into().map_or(0, u64::from_le_bytes);
        Head {
            topic: four(0),
            cdr_bytes: four(4),
            sequence: eight(8),
            log_ns: eight(16),
            publish_ns: eight(24),
            publisher: Gid(bytes[32..].try_into().unwrap_or_default()),
        }
    }
}

/// Whether the producer has ended. If so, everything that it wrote is visible to later reads.
pub fn has_ended(consumer: &Consumer<u8>) -> bool {
    let has_ended = consumer.is_abandoned();
    // Pairs with the Release at the producer's end, which rtrb reads with Relaxed.
    fence(Ordering::Acquire);
    has_ended
}

/// A ring whose pages have been touched.
pub fn touched(bytes: u64) -> Outcome<(Producer<u8>, Consumer<u8>)> {
    let available = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| {
        let line = text.lines().find(|line| line.starts_with("MemAvailable:"))?;
        Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
    });
    if let Some(available) = available.filter(|available| bytes > available / 10 * 9) {
        let [wanted, there] = [bytes, available].map(|bytes| bytes / 1_000_000);
        return Err(Failure::unusable(format!(
            "--budget {wanted}MB is more than there is: {there} MB of memory are available"
        )));
    }
    let least = 1 << 16;
    let (mut producer, mut consumer) = RingBuffer::new(bytes.max(least) as usize);
    let capacity = producer.slots();
    let zeros = [0; 4096];
    while !producer.push_partial_slice(&zeros).0.is_empty() {}
    if let Ok(chunk) = consumer.read_chunk(capacity) {
        chunk.commit_all();
    }
    Ok((producer, consumer))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_come_back() {
        let head = Head {
            topic: 1,
            cdr_bytes: u32::MAX,
            sequence: 3,
            log_ns: u64::MAX,
            publish_ns: 5,
            publisher: Gid([6; 16]),
        };
        assert_eq!(Head::from_bytes(head.to_bytes()), head);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ring of bytes between the thread that takes messages and the thread that writes them. Its memory is allocated at the start.

use rtrb::chunks::ReadChunk;
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
/// The most memory for the messages that a topic keeps for late joiners.
pub const LATCHED_BYTES: usize = 64 << 20;

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

/// The content of the ring, in two parts if it wraps around.
#[derive(Clone, Copy)]
pub struct Ring<'r>(&'r [u8], &'r [u8]);

impl<'r> Ring<'r> {
    pub fn of(chunk: &'r ReadChunk<'_, u8>) -> Self {
        let (first, second) = chunk.as_slices();
        Ring(first, second)
    }

    /// The message at this offset and its length, if it is complete.
    pub fn message(self, at: usize) -> Option<(Head, usize)> {
        let mut head = [0; HEAD_BYTES];
        let there = self.0.len() + self.1.len();
        if there < at + HEAD_BYTES {
            return None;
        }
        self.copy(at, &mut head);
        let head = Head::from_bytes(head);
        let whole = HEAD_BYTES + head.cdr_bytes as usize;
        (there >= at + whole).then_some((head, whole))
    }

    /// Fills `to` with the bytes at an offset, which the ring must hold.
    pub fn copy(self, at: usize, to: &mut [u8]) {
        let from = &self.0[at.min(self.0.len())..];
        let (front, back) = to.split_at_mut(from.len().min(to.len()));
        front.copy_from_slice(&from[..front.len()]);
        let at = at.saturating_sub(self.0.len());
        back.copy_from_slice(&self.1[at..at + back.len()]);
    }

    /// The bytes at an offset, which the ring must hold: in place, or in `scratch` if they wrap around.
    pub fn bytes<'b>(self, at: usize, len: usize, scratch: &'b mut Vec<u8>) -> &'b [u8]
    where
        'r: 'b,
    {
        if let Some(bytes) = self.0.get(at..at + len) {
            return bytes;
        }
        scratch.resize(len, 0);
        self.copy(at, scratch);
        scratch
    }
}

/// The head of the oldest message, and the chunk to commit; `None` until the message is complete.
pub fn oldest(consumer: &mut Consumer<u8>) -> Option<(Head, ReadChunk<'_, u8>)> {
    let mut head = [0; HEAD_BYTES];
    Ring::of(&consumer.read_chunk(HEAD_BYTES).ok()?).copy(0, &mut head);
    let head = Head::from_bytes(head);
    Some((head, consumer.read_chunk(HEAD_BYTES + head.cdr_bytes as usize).ok()?))
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

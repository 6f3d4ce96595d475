// SPDX-License-Identifier: MIT OR Apache-2.0
//! The message: 4096 bytes that say which nodes they have passed.

use tautline_msgs::Message;

pub const STATS_CAPACITY: usize = 63;
/// The longest name is one byte shorter, for it ends with a zero.
const NAME_BYTES: usize = 48;

/// What a node enters into a message.
#[derive(Message, Clone, Copy, Debug, PartialEq, Eq)]
#[message(name = "reference_interfaces/msg/TransmissionStats", crate = "tautline_msgs")]
#[repr(C)]
pub struct TransmissionStats {
    /// When its run began, on the monotonic clock.
    pub timestamp: u64,
    /// How many messages it had published before.
    pub sequence_number: u32,
    /// Messages of its inputs that it missed before this run.
    pub dropped_samples: u32,
    /// Its name, and zeroes.
    pub node_name: [u8; NAME_BYTES],
}

#[derive(Message, Clone, Copy, Debug)]
#[message(name = "reference_interfaces/msg/Message4kb", crate = "tautline_msgs")]
#[repr(C)]
pub struct Message4kb {
    pub size: u64,
    /// The entries; what is behind them means nothing.
    pub stats: [TransmissionStats; STATS_CAPACITY],
    /// The result of the work, and zeroes.
    pub data: [i64; 7],
}

const _: () = assert!(size_of::<Message4kb>() == 4096);

impl TransmissionStats {
    pub fn new(name: &str, timestamp: u64, sequence_number: u32, dropped_samples: u32) -> Self {
        TransmissionStats { timestamp, sequence_number, dropped_samples, node_name: padded(name) }
    }
}

/// A name as it stands in messages; what is too long is cut off.
fn padded(name: &str) -> [u8; NAME_BYTES] {
    let mut bytes = [0; NAME_BYTES];
    // The last byte stays zero.
    bytes[..NAME_BYTES - 1].iter_mut().zip(name.bytes()).for_each(|(to, from)| *to = from);
    bytes
}

impl Message4kb {
    pub const EMPTY: Message4kb = Message4kb {
        size: 0,
        stats: [TransmissionStats {
            timestamp: 0,
            sequence_number: 0,
            dropped_samples: 0,
            node_name: [0; NAME_BYTES],
        }; STATS_CAPACITY],
        data: [0; 7],
    };

    /// The entries. More than there is room for are not believed.
    pub fn entries(&self) -> &[TransmissionStats] {
        &self.stats[..usize::try_from(self.size).map_or(STATS_CAPACITY, |size| size.min(STATS_CAPACITY))]
    }

    pub fn clear(&mut self) {
        self.size = 0;
        self.data = [0; 7];
    }

    /// Adds an entry, if there is room.
    pub fn append(&mut self, entry: TransmissionStats) {
        let used = self.entries().len();
        if let Some(free) = self.stats.get_mut(used) {
            *free = entry;
            self.size = used as u64 + 1;
        }
    }

    /// Adds the entries of `other`, but not of nodes that are in here.
    pub fn merge(&mut self, other: &Message4kb) {
        for entry in other.entries() {
            if !self.entries().iter().any(|own| own.node_name == entry.node_name) {
                self.append(*entry);
            }
        }
    }

    pub fn entry_of(&self, name: &str) -> Option<&TransmissionStats> {
        let name = padded(name);
        self.entries().iter().find(|entry| entry.node_name == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(nodes: &[(&str, u32)]) -> Message4kb {
        let mut message = Message4kb::EMPTY;
        nodes
            .iter()
            .for_each(|&(name, sequence)| message.append(TransmissionStats::new(name, 1, sequence, 0)));
        message
    }

    #[test]
    fn a_merged_message_has_each_node_once() {
        let mut fused = message(&[("lidar", 7), ("left", 1)]);
        fused.merge(&message(&[("lidar", 8), ("right", 2)]));
        let names = ["lidar", "left", "right"];
        assert!(fused.entries().iter().map(|entry| entry.node_name).eq(names.map(padded)));
        assert_eq!(fused.entry_of("lidar").unwrap().sequence_number, 7, "the first stays");
        assert_eq!(fused.entry_of("lid"), None);
    }

    #[test]
    fn a_full_message_takes_no_more_and_a_wrong_size_is_not_believed() {
        let mut full = Message4kb::EMPTY;
        for sequence in 0..70 {
            full.append(TransmissionStats::new(&"x".repeat(60), 1, sequence, 0));
        }
        assert_eq!((full.size, full.stats[62].sequence_number), (63, 62));
        assert_eq!(full.stats[0].node_name[46..], [b'x', 0], "a name ends with a zero");
        full.size = u64::MAX;
        assert_eq!(full.entries().len(), STATS_CAPACITY);
        full.clear();
        assert!(full.entries().is_empty());
    }
}

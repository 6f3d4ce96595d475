// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bags as rosbag2 writes them: a folder of MCAP files (profile `ros2`) and a `metadata.yaml`, or such a file alone. [`convert`] reads and
//! writes rosbag2's other storage, too: SQLite.
//!
//! Knows files, and nothing of Tautline's topics. What is written survives: a chunk is in the file when [`Writer::flush`] returns, the
//! space for what a file still needs to be whole is claimed before a message is written, and of what a killed process left
//! [`recover`] keeps every whole chunk. What is read is a claim: lengths are held against the file's, chunks against their checksum.
#![deny(unsafe_code)]

mod claim;
mod convert;
mod disk;
mod error;
mod index;
mod metadata;
mod ordered;
mod parts;
mod qos;
mod reader;
mod record;
mod recover;
mod rewrite;
mod sqlite;
mod unpack;
mod writer;

pub use convert::{Converted, Hooks, convert};
pub use error::BagError;
pub use index::{Metadata, index_of};
pub use ordered::{Ordered, OwnedMessage};
pub use parts::is_compressed;
pub use reader::{Damage, Event, FileReader, FileSummary, Message, files_of};
pub use recover::{Recovered, recover};
pub use rewrite::rewrite;
pub use writer::{Finished, Options, TopicId, Writer};

/// What holds the messages of a bag, as rosbag2 calls it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Storage {
    /// Chunks of messages, one behind the other: what is [recovered](recover) and played.
    #[default]
    Mcap,
    /// A database with a row for each message, rosbag2's default until ROS 2 Humble.
    Sqlite3,
}

/// How chunks are compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Compression {
    /// As the messages are.
    #[default]
    None,
    /// Small.
    Zstd,
    /// Fast.
    Lz4,
}

impl Compression {
    /// As a chunk names it.
    fn of_name(name: &str) -> Self {
        match name {
            "zstd" => Compression::Zstd,
            "lz4" => Compression::Lz4,
            _ => Compression::None,
        }
    }

    fn of_mcap(self) -> Option<mcap::Compression> {
        match self {
            Compression::None => None,
            Compression::Zstd => Some(mcap::Compression::Zstd),
            Compression::Lz4 => Some(mcap::Compression::Lz4),
        }
    }
}

/// What a bag says of a topic.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Default)]
pub struct Topic {
    /// The fully qualified name.
    pub name: String,
    /// `package/msg/Name`.
    pub type_name: String,
    /// `RIHS01_` and 64 digits; empty if nobody knows it.
    pub type_hash: String,
    /// The definition as ros2msg text, with those of the types that it needs, if somebody knows it.
    pub definition: Option<String>,
    /// The QoS profiles of its publishers, as rosbag2 writes them: a list in YAML.
    pub qos: String,
}

/// What a message has besides its bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Stamp {
    /// The publisher's number of it, or its lowest 32 bits.
    pub sequence: u32,
    /// When it was received, in nanoseconds since 1970.
    pub log_ns: u64,
    /// When it was published, in nanoseconds since 1970.
    pub publish_ns: u64,
}

/// The longest message that is written, and the longest chunk that is read: 1 GiB.
pub const MOST_BYTES: usize = 1 << 30;

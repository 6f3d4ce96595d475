// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bags as rosbag2 writes them: a folder of MCAP files (profile `ros2`) and a `metadata.yaml`, or such a file alone. [`convert`] reads and
//! writes rosbag2's other storage, too: SQLite.
//!
//! This crate knows files, not Tautline's topics. Written data survives: a chunk is in the file when [`Writer::flush`] returns, the
//! space that a file still needs to be complete is reserved before a message is written, and [`recover`] keeps every complete chunk of
//! a killed process's file. Files that are read are untrusted: lengths are checked against the file's length, chunks and
//! the summary against their checksums.
#![deny(unsafe_code)]

use std::borrow::Cow;
use std::collections::BTreeMap;

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
mod sqlite;
mod summary;
mod unpack;
mod writer;

pub use convert::{Converted, Hooks, convert};
pub use error::BagError;
pub use index::{Metadata, index_of};
pub use ordered::{Ordered, OwnedMessage};
pub use parts::{custom_data_of, is_compressed};
pub use qos::in_words;
pub use reader::{Attachment, Damage, Event, FileReader, FileSummary, Message, files_of};
pub use recover::{Recovered, is_being_written, recover};
pub use writer::{Finished, Options, TopicId, Writer};

/// The storage format of a bag, in rosbag2's term.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Storage {
    /// A sequence of chunks of messages. Bags in this format can be [recovered](recover) and played.
    #[default]
    Mcap,
    /// A database with a row for each message, rosbag2's default until ROS 2 Humble.
    Sqlite3,
}

/// How chunks are compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Compression {
    /// No compression.
    #[default]
    None,
    /// zstd: the smaller files.
    Zstd,
    /// lz4: the faster compression.
    Lz4,
}

impl Compression {
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

/// A bag's description of a topic: a channel and its schema, in MCAP's terms. A bag may have several for one name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Topic {
    /// The fully qualified name.
    pub name: String,
    /// `package/msg/Name`; empty if there is no schema.
    pub type_name: String,
    /// `RIHS01_` and 64 digits; empty if unknown.
    pub type_hash: String,
    /// How its messages are encoded: [`CDR`], or what another program wrote, such as `json` or `protobuf`.
    pub encoding: String,
    /// The definition of its type, if known.
    pub definition: Option<Definition>,
    /// The QoS profiles of its publishers, as rosbag2 writes them: a list in YAML.
    pub qos: String,
    /// The other metadata of the channel.
    pub metadata: BTreeMap<String, String>,
}

/// The encoding of ROS 2's messages.
pub const CDR: &str = "cdr";

/// The key of a channel's metadata that tells publishers of a topic apart: each of them keeps its own messages for late joiners.
pub const PUBLISHER: &str = "publisher";

/// The definition of a type, with those of the types that it needs.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Definition {
    /// `ros2msg`, `ros2idl`, or what another program wrote, such as `jsonschema`; empty if unknown.
    pub encoding: String,
    /// A text, or bytes, depending on the encoding.
    pub data: Vec<u8>,
}

impl Definition {
    /// A definition in ROS 2's `.msg` format.
    pub fn ros2msg(text: impl Into<String>) -> Self {
        Definition { encoding: "ros2msg".to_owned(), data: text.into().into_bytes() }
    }
}

impl Default for Topic {
    fn default() -> Self {
        let [name, type_name, type_hash, qos] = std::array::from_fn(|_| String::new());
        let (encoding, metadata) = (CDR.to_owned(), BTreeMap::new());
        Topic { name, type_name, type_hash, encoding, definition: None, qos, metadata }
    }
}

impl Topic {
    /// The topic without what does not change how its messages are read: QoS, metadata, and the definition if its hash is known.
    pub fn bare(&self) -> Topic {
        let definition = self.definition.clone().filter(|_| self.type_hash.is_empty());
        Topic { definition, qos: String::new(), metadata: BTreeMap::new(), ..self.clone() }
    }

    /// The definition, if it is in ROS 2's `.msg` format.
    pub fn ros2msg(&self) -> Option<Cow<'_, str>> {
        let definition = self.definition.as_ref().filter(|definition| definition.encoding == "ros2msg")?;
        Some(String::from_utf8_lossy(&definition.data))
    }
}

/// The metadata of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct Stamp {
    /// The sequence number that the publisher gave it, or its lowest 32 bits.
    pub sequence: u32,
    /// When it was received, in nanoseconds since 1970.
    pub log_ns: u64,
    /// When it was published, in nanoseconds since 1970.
    pub publish_ns: u64,
}

/// The longest message that is written: 1 GiB. A chunk that is read may be 1 MiB longer.
pub const MOST_BYTES: usize = 1 << 30;

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Finds the summary at the end of a file, checks it, and reads the topics that it repeats.

use crate::parts::{EIO, MAGIC};
use crate::record::{Records, parse};
use crate::{Definition, MOST_BYTES, Topic};
use mcap::records::{Footer, Record, op};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

/// Keys of a channel's metadata, as rosbag2 has them.
pub(crate) const TYPE_HASH: &str = "topic_type_hash";
pub(crate) const QOS: &str = "offered_qos_profiles";

/// The footer, a record of 29 bytes, and the magic bytes.
const END: u64 = 29 + 8;
/// The length of what is in front of the checksum in the footer's record. The checksum is of the summary and of that.
pub(crate) const BEFORE_CHECKSUM: u64 = 9 + 16;

/// The topics of a file's channels, by its summary; none if that is damaged.
pub(crate) fn topics_of(file: &File) -> io::Result<BTreeMap<u16, Topic>> {
    Ok(section(file)?.map_or_else(BTreeMap::new, |section| topics_in(&section)))
}

pub(crate) fn topics_in(section: &[u8]) -> BTreeMap<u16, Topic> {
    let (mut schemas, mut topics) = (HashMap::new(), BTreeMap::new());
    for (kind, body) in Records(section) {
        match parse(kind, body) {
            Ok(Some(Record::Schema { header, data })) => {
                schemas.insert(header.id, (header.name, definition(&header.encoding, &data)));
            }
            Ok(Some(Record::Channel(channel))) => {
                let schema = schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                topics.insert(channel.id, topic(&channel, schema));
            }
            _ => {}
        }
    }
    topics
}

/// The records of a file's summary. `None`: it has none, or they are damaged, longer than `MOST_BYTES`, or cannot be read from the disk.
pub(crate) fn section(file: &File) -> io::Result<Option<Vec<u8>>> {
    let bytes = file.metadata()?.len();
    let Some(end) = read(file, bytes.saturating_sub(END), bytes)? else { return Ok(None) };
    let Some(footer) = footer(&end) else { return Ok(None) };
    let section = read(file, footer.summary_start, bytes - END)?;
    let is_intact = |section: &Vec<u8>| {
        let mut checksum = crc32fast::Hasher::new();
        checksum.update(section);
        checksum.update(&end[..BEFORE_CHECKSUM as usize]);
        [0, checksum.finalize()].contains(&footer.summary_crc)
    };
    Ok(section.filter(is_intact))
}

/// The footer of a file with a summary, from its last [`END`] bytes.
fn footer(end: &[u8]) -> Option<Footer> {
    let is_whole = end.ends_with(MAGIC) && end.len() as u64 == END;
    match is_whole.then(|| Records(end).next()).flatten() {
        Some((op::FOOTER, body)) => match parse(op::FOOTER, body) {
            Ok(Some(Record::Footer(footer))) => (footer.summary_start > 0).then_some(footer),
            _ => None,
        },
        _ => None,
    }
}

/// Reads a range. `None`: it is not in the file, is longer than `MOST_BYTES`, or cannot be read from the disk.
pub(crate) fn read(file: &File, from: u64, to: u64) -> io::Result<Option<Vec<u8>>> {
    let bytes = file.metadata()?.len();
    let Some(len) = to.checked_sub(from).filter(|len| to <= bytes && *len <= MOST_BYTES as u64) else {
        return Ok(None);
    };
    let mut read = vec![0; len as usize];
    match file.read_exact_at(&mut read, from) {
        // A damaged sector.
        Err(error) if error.raw_os_error() == Some(EIO) => Ok(None),
        done => done.map(|()| Some(read)),
    }
}

/// The definition that a schema has.
pub fn definition(encoding: &str, data: &[u8]) -> Option<Definition> {
    let is_there = !encoding.is_empty() || !data.is_empty();
    is_there.then(|| Definition { encoding: encoding.to_owned(), data: data.to_vec() })
}

/// The topic of a channel whose type has this name and definition.
pub(crate) fn topic(channel: &mcap::records::Channel, schema: (String, Option<Definition>)) -> Topic {
    let mut metadata = channel.metadata.clone();
    let [type_hash, qos] = [TYPE_HASH, QOS].map(|key| metadata.remove(key).unwrap_or_default());
    let ((type_name, definition), encoding) = (schema, channel.message_encoding.clone());
    Topic { name: channel.topic.clone(), type_name, type_hash, encoding, definition, qos, metadata }
}

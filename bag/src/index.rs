// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads the summary at the end of a file without the rest.

use crate::parts::{EIO, MAGIC};
use crate::reader::{FileSummary, definition, topic};
use crate::record::{Records, parse};
use crate::{BagError, Compression, MOST_BYTES, Topic};
use mcap::records::{Footer, Record, op};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;

/// The footer, a record of 29 bytes, and the magic bytes.
const END: u64 = 29 + 8;
/// The length of what is in front of the checksum in the footer's record. The checksum is of the summary and of that.
pub(crate) const BEFORE_CHECKSUM: u64 = 9 + 16;
/// More messages than any disk has room for.
const MOST_MESSAGES: u64 = 1 << 45;

/// The name of a metadata record, and its keys and values.
pub type Metadata = (String, BTreeMap<String, String>);

/// The maximum length of all metadata of a file.
const MOST_METADATA: usize = 64 << 20;

/// The content of a file by its index, and its metadata records. `None`: it has no index, or only a damaged one.
///
/// # Errors
/// The file cannot be read.
pub fn index_of(path: &Path) -> Result<Option<(FileSummary, Vec<Metadata>)>, BagError> {
    let file = File::open(path).map_err(BagError::read(path))?;
    let found = file.metadata().map_err(BagError::read(path))?;
    if !found.is_file() {
        return Err(BagError::NoBag { path: path.to_owned(), reason: "it is not a file".to_owned() });
    }
    let bytes = found.len();
    let Some(section) = section(&file).map_err(BagError::read(path))? else { return Ok(None) };
    let read = |from, to| read(&file, from, to).map_err(BagError::read(path));
    let mut of_file = FileSummary { path: path.to_owned(), bytes, ..FileSummary::default() };
    let (mut is_compressed, mut counts) = (false, BTreeMap::new());
    let (mut metadata, mut metadata_bytes) = (Vec::new(), 0);
    for (kind, body) in Records(&section) {
        match parse(kind, body) {
            Ok(Some(Record::ChunkIndex(chunk))) if !is_compressed => {
                is_compressed = true;
                of_file.compression = Compression::of_name(&chunk.compression);
            }
            Ok(Some(Record::Statistics(stats))) => {
                of_file.messages = stats.message_count;
                of_file.start_ns = stats.message_start_time;
                of_file.end_ns = stats.message_end_time.max(stats.message_start_time);
                counts = stats.channel_message_counts;
                // Callers add the counts, and the sums must not overflow.
                if of_file.messages > MOST_MESSAGES || counts.values().any(|count| *count > MOST_MESSAGES) {
                    return Ok(None);
                }
            }
            Ok(Some(Record::AttachmentIndex(index))) => of_file.attachments.push(index.name),
            Ok(Some(Record::MetadataIndex(index))) => {
                let record =
                    read(index.offset, index.offset.saturating_add(index.length))?.unwrap_or_default();
                // Several indexes may refer to the same record.
                metadata_bytes += record.len();
                if metadata_bytes > MOST_METADATA {
                    return Ok(None);
                }
                if let Some((op::METADATA, body)) = Records(&record).next()
                    && let Ok(Some(Record::Metadata(found))) = parse(op::METADATA, body)
                {
                    metadata.push((found.name, found.metadata));
                }
            }
            Ok(_) => {}
            Err(_) => return Ok(None),
        }
    }
    for (id, topic) in topics_in(&section) {
        of_file.count(&topic, counts.get(&id).copied().unwrap_or(0));
    }
    Ok(Some((of_file, metadata)))
}

/// The topics of a file's channels, by its summary; none if that is damaged.
pub(crate) fn topics_of(file: &File) -> io::Result<BTreeMap<u16, Topic>> {
    Ok(section(file)?.map_or_else(BTreeMap::new, |section| topics_in(&section)))
}

fn topics_in(section: &[u8]) -> BTreeMap<u16, Topic> {
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
fn section(file: &File) -> io::Result<Option<Vec<u8>>> {
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
fn read(file: &File, from: u64, to: u64) -> io::Result<Option<Vec<u8>>> {
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a file has, by the summary at its end, without reading the rest.

use crate::parts::opened;
use crate::reader::FileSummary;
use crate::record::{Records, parse};
use crate::summary::{read, section, topics_in};
use crate::{BagError, Compression};
use mcap::records::{Record, op};
use std::collections::BTreeMap;
use std::path::Path;

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
    let (file, bytes) = opened(path)?;
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a file says of itself at its end, without reading the rest.

use crate::reader::{FileSummary, definition};
use crate::{BagError, Compression, MOST_BYTES, Topic};
use mcap::records::Record;
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek};
use std::os::unix::fs::FileExt;
use std::path::Path;

/// Keys and values of a record, and its name.
pub type Metadata = (String, BTreeMap<String, String>);

/// What the index of a file says is in it, and what the file says of itself. `None`: it has no index, or none that is whole.
///
/// # Errors
/// It cannot be read.
pub fn index_of(path: &Path) -> Result<Option<(FileSummary, Vec<Metadata>)>, BagError> {
    let mut file = File::open(path).map_err(BagError::read(path))?;
    let found = file.metadata().map_err(BagError::read(path))?;
    if !found.is_file() {
        return Err(BagError::NoBag { path: path.to_owned(), reason: "it is no file".to_owned() });
    }
    let bytes = found.len();
    let Some(summary) = summary(&mut file, bytes).map_err(BagError::read(path))? else { return Ok(None) };
    let stats = summary.stats.unwrap_or_default();
    let compression = match summary.chunk_indexes.first().map(|chunk| &*chunk.compression) {
        Some("zstd") => Compression::Zstd,
        Some("lz4") => Compression::Lz4,
        _ => Compression::None,
    };
    let mut of_file = FileSummary {
        path: path.to_owned(),
        bytes,
        messages: stats.message_count,
        start_ns: stats.message_start_time,
        end_ns: stats.message_end_time.max(stats.message_start_time),
        compression,
        ..FileSummary::default()
    };
    for (id, channel) in &summary.channels {
        let of = |key: &str| channel.metadata.get(key).cloned().unwrap_or_default();
        let schema = channel.schema.as_ref();
        let topic = Topic {
            name: channel.topic.clone(),
            type_name: schema.map(|schema| schema.name.clone()).unwrap_or_default(),
            type_hash: of("topic_type_hash"),
            definition: schema.and_then(|schema| definition(&schema.encoding, &schema.data)),
            qos: of("offered_qos_profiles"),
        };
        of_file.count(&topic, stats.channel_message_counts.get(id).copied().unwrap_or(0));
    }
    let metadata = summary.metadata_indexes.iter().filter_map(|index| metadata(&file, bytes, index));
    Ok(Some((of_file, metadata.collect())))
}

fn summary(file: &mut File, bytes: u64) -> std::io::Result<Option<mcap::Summary>> {
    let options = SummaryReaderOptions::default().with_file_size(bytes).with_record_length_limit(MOST_BYTES);
    let mut reader = SummaryReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event {
            Ok(SummaryReadEvent::ReadRequest(wanted)) => {
                let read = file.read(reader.insert(wanted))?;
                reader.notify_read(read);
            }
            // A place that is none is the file's fault.
            Ok(SummaryReadEvent::SeekRequest(to)) => match file.seek(to) {
                Ok(position) => reader.notify_seeked(position),
                Err(_) => return Ok(None),
            },
            Err(_) => return Ok(None),
        }
    }
    Ok(reader.finish())
}

fn metadata(file: &File, bytes: u64, index: &mcap::records::MetadataIndex) -> Option<Metadata> {
    let end = index.offset.checked_add(index.length).filter(|end| *end <= bytes)?;
    let mut record = vec![0; usize::try_from(end - index.offset).ok().filter(|len| *len <= MOST_BYTES)?];
    file.read_exact_at(&mut record, index.offset).ok()?;
    match mcap::parse_record(*record.first()?, record.get(9..)?) {
        Ok(Record::Metadata(metadata)) => Some((metadata.name, metadata.metadata)),
        _ => None,
    }
}

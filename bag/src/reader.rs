// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads a bag from its first byte to its last, with any content.

use crate::parts::{EIO, Form, MAGIC, form_of, in_order, opened};
use crate::qos::joined;
use crate::record::{Records, parse};
use crate::summary::{BEFORE_CHECKSUM, definition, topic, topics_of};
use crate::{BagError, Compression, Definition, MOST_BYTES, Stamp, Topic};
use mcap::records::{ChunkHeader, Record, op};
use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File};
use std::io::Read;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The length of the head of each record: its kind and its length.
const RECORD_HEAD: u64 = 9;
/// The number of damaged parts that are listed; further ones are only counted.
const MOST_DAMAGE: usize = 100;

/// The content of a file.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct FileSummary {
    /// The file.
    pub path: PathBuf,
    /// Its length.
    pub bytes: u64,
    /// Messages in it.
    pub messages: u64,
    /// The earliest time of reception, in nanoseconds since 1970; 0 without messages.
    pub start_ns: u64,
    /// The latest one.
    pub end_ns: u64,
    /// Topics by name and type, with the number of messages. The QoS is that of all channels of the topic.
    pub topics: BTreeMap<(String, String), (Topic, u64)>,
    /// The names of its attachments.
    pub attachments: Vec<String>,
    /// How its first chunk is compressed.
    pub compression: Compression,
    /// Messages that were received before one that is in front of them.
    pub disordered: u64,
}

impl FileSummary {
    /// Counts a message.
    pub(crate) fn count_message(&mut self, log_ns: u64) {
        self.start_ns = if self.messages == 0 { log_ns } else { self.start_ns.min(log_ns) };
        self.end_ns = self.end_ns.max(log_ns);
        self.messages += 1;
    }

    pub(crate) fn count(&mut self, topic: &Topic, messages: u64) {
        let key = (topic.name.clone(), topic.type_name.clone());
        let (known, count) = self.topics.entry(key).or_insert_with(|| (topic.clone(), 0));
        if known.qos != topic.qos {
            known.qos = joined(&known.qos, &topic.qos);
        }
        *count += messages;
    }

    /// The file's own name.
    pub fn name(&self) -> String {
        self.path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
    }
}

/// A damaged part of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Where, in bytes from the file's beginning.
    pub offset: u64,
    /// What is wrong.
    pub what: String,
}

/// A message of a bag.
#[derive(Debug)]
pub struct Message<'b> {
    /// Its topic.
    pub topic: &'b Arc<Topic>,
    /// Its number and times.
    pub stamp: Stamp,
    /// With the four bytes of encapsulation.
    pub cdr: &'b [u8],
}

/// A file that is in a bag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attachment<'b> {
    /// Its name.
    pub name: String,
    /// Its media type, such as `application/yaml`.
    pub media_type: String,
    /// When it was attached, in nanoseconds since 1970.
    pub log_ns: u64,
    /// When it was created, in nanoseconds since 1970; 0 if unknown.
    pub create_ns: u64,
    /// Its content.
    pub data: Cow<'b, [u8]>,
}

/// The next part of a file.
#[derive(Debug)]
pub enum Event<'b> {
    /// A topic, before its first message; topics without messages, too.
    Topic(&'b Arc<Topic>),
    /// A file.
    Attachment(Attachment<'b>),
    /// A message.
    Message(Message<'b>),
    /// A metadata record: its name, and its keys and values.
    Metadata(String, BTreeMap<String, String>),
}

/// Reads a file.
pub struct FileReader {
    file: File,
    path: PathBuf,
    /// The length of the file, or 0 if it has no beginning.
    bytes: u64,
    summary: FileSummary,
    damage: Vec<Damage>,
    damages: u64,
    is_ended: bool,
    schemas: HashMap<u16, (String, Option<Definition>)>,
    /// In order: the first of several channels of a topic determines its description.
    channels: BTreeMap<u16, (Arc<Topic>, u64)>,
    /// The summary's channels, which are read when a message's channel is not known.
    repeated: Option<BTreeMap<u16, Topic>>,
    latest_ns: u64,
    /// The buffer of the record that is read.
    record: Vec<u8>,
}

/// A chunk, or a message outside of any.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Extent {
    pub(crate) position: u64,
    pub(crate) whole: u64,
    /// The earliest time of reception in it, as the file states it.
    pub(crate) start_ns: u64,
    pub(crate) end_ns: u64,
    /// The extent was read, so its damage is counted.
    pub(crate) is_read: bool,
}

fn number(bytes: &[u8]) -> u64 {
    bytes.try_into().map_or(0, u64::from_le_bytes)
}

/// The MCAP files of a folder, in the order of the numbers in their names; or the file itself.
///
/// # Errors
/// There is none. If [`convert`](crate::convert) reads the files, the error says so.
pub fn files_of(path: &Path) -> Result<Vec<PathBuf>, BagError> {
    let is_folder = fs::metadata(path).map_err(BagError::read(path))?.is_dir();
    if !is_folder {
        return Ok(vec![path.to_owned()]);
    }
    let (mut files, mut others) = (Vec::new(), None);
    for entry in fs::read_dir(path).map_err(BagError::read(path))? {
        let file = entry.map_err(BagError::read(path))?.path();
        match file.extension().and_then(|extension| extension.to_str()) {
            Some("mcap") => files.push(file),
            Some("db3") => others = Some("its files are SQLite's (.db3)"),
            Some("zstd") => others = others.or(Some("its files are compressed as a whole (.zstd)")),
            _ => {}
        }
    }
    if files.is_empty() {
        let reason = match others {
            None => "there is no .mcap file in it".to_owned(),
            Some(others) => to_convert(others, path),
        };
        return Err(BagError::no_bag(path, reason));
    }
    in_order(&mut files);
    Ok(files)
}

/// Why a bag that is not MCAP is refused, with the command that converts it.
fn to_convert(what: &str, path: &Path) -> String {
    format!("{what}: `taut bag convert {} -o NEW` makes it one", path.display())
}

impl FileReader {
    /// Opens a file. A `.mcap` file whose beginning was never written is opened, too; all of it is damaged.
    ///
    /// # Errors
    /// It cannot be opened, or does not begin as an MCAP file.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let (file, mut bytes) = opened(path)?;
        let no_bag = |reason: &str| BagError::no_bag(path, reason);
        let path = path.to_owned();
        let summary = FileSummary { path: path.clone(), bytes, ..FileSummary::default() };
        let mut magic = [0; 8];
        if bytes < 8 || file.read_exact_at(&mut magic, 0).is_err() || magic != *MAGIC {
            match form_of(&path) {
                // Without the beginning, no record can be found.
                Ok(Form::Mcap) => bytes = 0,
                Ok(Form::Sqlite3) => return Err(no_bag(&to_convert("it is a database of SQLite", &path))),
                Ok(Form::Zstd) => return Err(no_bag(&to_convert("it is compressed as a whole", &path))),
                Err(_) => return Err(no_bag("it does not begin as an MCAP file")),
            }
        }
        Ok(FileReader {
            file,
            path,
            bytes,
            summary,
            damage: Vec::new(),
            damages: 0,
            is_ended: false,
            schemas: HashMap::new(),
            channels: BTreeMap::new(),
            repeated: None,
            latest_ns: 0,
            record: Vec::new(),
        })
    }

    /// Reads everything that is undamaged; the content of a chunk with a wrong checksum is skipped.
    ///
    /// # Errors
    /// The file cannot be read; an error of `visit`, which stops reading.
    pub fn read<E: From<BagError>>(
        &mut self,
        visit: &mut dyn FnMut(Event<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut position = MAGIC.len() as u64;
        while !self.is_ended {
            let Some((kind, whole)) = self.whole(position)? else { return Ok(()) };
            if !matches!(kind, op::MESSAGE_INDEX | op::CHUNK_INDEX) {
                self.read_at(position, whole, visit)?;
            }
            position += whole;
        }
        self.end(position)?;
        Ok(())
    }

    /// The extents of the messages, in no order, without reading them. The topics are known afterwards.
    ///
    /// # Errors
    /// The file cannot be read.
    pub(crate) fn extents(&mut self) -> Result<Vec<Extent>, BagError> {
        let (mut position, mut extents, mut is_whole) = (MAGIC.len() as u64, Vec::new(), false);
        while let Some((kind, whole)) = self.head(position)?.map(|(kind, len)| (kind, RECORD_HEAD + len)) {
            let mut times = [0; 24];
            match kind {
                _ if position + whole > self.bytes => break,
                op::CHUNK | op::MESSAGE if whole >= RECORD_HEAD + 24 && !self.is_ended => {
                    let is_there = self.fill(&mut times, position + RECORD_HEAD)?;
                    if !is_there {
                        self.note(position, "the disk cannot read it");
                    }
                    let [start_ns, end_ns, bytes] = match kind {
                        _ if !is_there => [0; 3],
                        op::CHUNK => [number(&times[..8]), number(&times[8..16]), number(&times[16..])],
                        // The channel and the sequence number are in front of the time.
                        _ => [number(&times[6..14]), number(&times[6..14]), whole],
                    };
                    if bytes > 0 {
                        let (end_ns, is_read) = (end_ns.max(start_ns), false);
                        extents.push(Extent { position, whole, start_ns, end_ns, is_read });
                    }
                }
                op::FOOTER => is_whole = self.ends(position + whole)?,
                op::SCHEMA | op::CHANNEL | op::DATA_END => {
                    self.read_at(position, whole, &mut |_| Ok::<_, BagError>(()))?;
                }
                _ => {}
            }
            position += whole;
        }
        // Channels are in the summary behind the data, or only where their messages are.
        if !self.is_ended || !is_whole || self.channels.is_empty() {
            self.is_ended = false;
            self.damage.clear();
            self.damages = 0;
            self.read(&mut |_| Ok::<_, BagError>(()))?;
            extents.iter_mut().for_each(|extent| extent.is_read = true);
        }
        Ok(extents)
    }

    /// Reads the record of `whole` bytes at `position`.
    pub(crate) fn read_at<E: From<BagError>>(
        &mut self,
        position: u64,
        whole: u64,
        visit: &mut dyn FnMut(Event<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        if whole > 2 * MOST_BYTES as u64 {
            self.note(position, &format!("a record of {} bytes is longer than any", whole - RECORD_HEAD));
            return Ok(());
        }
        let mut record = std::mem::take(&mut self.record);
        record.resize(whole as usize, 0);
        if !self.fill(&mut record, position)? {
            self.note(position, "the disk cannot read it");
            self.record = record;
            return Ok(());
        }
        let done = self.record(record.first().copied().unwrap_or_default(), &record, position, visit);
        self.record = record;
        done
    }

    /// Kind and whole length of the record that begins here, if all of it is there.
    fn whole(&mut self, position: u64) -> Result<Option<(u8, u64)>, BagError> {
        let head = self.head(position)?.map(|(kind, len)| (kind, RECORD_HEAD + len));
        let there = head.filter(|(_, whole)| position + whole <= self.bytes);
        if there.is_none() {
            let what = match head {
                _ if self.bytes == 0 => "nothing is in it: its beginning was never written",
                None if position + RECORD_HEAD <= self.bytes => "the disk cannot read it, nor find the rest",
                _ => "the file is cut off",
            };
            self.note(position.min(self.bytes), what);
        }
        Ok(there)
    }

    /// The topics that were read so far.
    pub(crate) fn topics(&self) -> impl Iterator<Item = &Arc<Topic>> {
        self.channels.values().map(|(topic, _)| topic)
    }

    /// The content of the file, after it was read.
    pub fn summary(&self) -> FileSummary {
        let mut summary = self.summary.clone();
        self.channels.values().for_each(|(topic, messages)| summary.count(topic, *messages));
        summary
    }

    /// The damage found after reading, and the total number of damaged parts.
    pub fn damage(&self) -> (&[Damage], u64) {
        (&self.damage, self.damages)
    }

    fn note(&mut self, offset: u64, what: &str) {
        self.damages += 1;
        if self.damage.len() < MOST_DAMAGE {
            self.damage.push(Damage { offset, what: what.to_owned() });
        }
    }

    /// Fills `bytes` from `position`. Returns `false` if the disk cannot read there.
    fn fill(&self, bytes: &mut [u8], position: u64) -> Result<bool, BagError> {
        match self.file.read_exact_at(bytes, position) {
            // A damaged sector.
            Err(error) if error.raw_os_error() == Some(EIO) => Ok(false),
            read => read.map(|()| true).map_err(BagError::read(&self.path)),
        }
    }

    /// Kind and length of the record that begins here; `None` behind the file's end, or if the disk cannot read it.
    fn head(&self, position: u64) -> Result<Option<(u8, u64)>, BagError> {
        if position + RECORD_HEAD > self.bytes {
            return Ok(None);
        }
        let mut head = [0; RECORD_HEAD as usize];
        if !self.fill(&mut head, position)? {
            return Ok(None);
        }
        let [kind, length @ ..] = head;
        Ok(Some((kind, u64::from_le_bytes(length).min(self.bytes))))
    }

    /// Reads what follows the data: the summary, which repeats what is known, the footer and the magic bytes again.
    fn end(&mut self, start: u64) -> Result<(), BagError> {
        let mut position = start;
        while let Some((kind, len_bytes)) = self.head(position)? {
            let checksum = position + BEFORE_CHECKSUM;
            position += RECORD_HEAD + len_bytes;
            if kind == op::FOOTER {
                if checksum + 4 <= position && self.ends(position)? {
                    return self.check_summary(start, checksum);
                }
                break;
            }
        }
        self.note(position.min(self.bytes), "the file's index is cut off");
        Ok(())
    }

    /// Compares the checksum of the summary, which is at `end`, with what it is of; 0 is none.
    fn check_summary(&mut self, start: u64, end: u64) -> Result<(), BagError> {
        let (mut position, mut checksum, mut piece) = (start, crc32fast::Hasher::new(), vec![0; 1 << 16]);
        let mut stated = [0; 4];
        let mut is_read = self.fill(&mut stated, end)?;
        while is_read && position < end {
            let len = (end - position).min(piece.len() as u64) as usize;
            is_read = self.fill(&mut piece[..len], position)?;
            checksum.update(&piece[..len]);
            position += len as u64;
        }
        if !is_read {
            self.note(start, "the disk cannot read the file's index");
        } else if ![0, checksum.finalize()].contains(&u32::from_le_bytes(stated)) {
            self.note(start, "the file's index: its checksum is another");
        }
        Ok(())
    }

    /// Whether the file ends here, behind the footer, as it should.
    fn ends(&self, position: u64) -> Result<bool, BagError> {
        let mut magic = [0; 8];
        let is_there = position + 8 == self.bytes && self.fill(&mut magic, position)?;
        Ok(is_there && magic == *MAGIC)
    }

    /// Reads a record; `record` is all of it, with kind and length.
    fn record<E: From<BagError>>(
        &mut self,
        kind: u8,
        record: &[u8],
        position: u64,
        visit: &mut dyn FnMut(Event<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        if kind == op::CHUNK {
            return self.chunk(record, position, visit);
        }
        match parse(kind, &record[RECORD_HEAD as usize..]) {
            Ok(Some(record)) => return self.parsed(&record, position, visit),
            Ok(None) => {}
            Err(error) => self.note(position, &error),
        }
        Ok(())
    }

    fn chunk<E: From<BagError>>(
        &mut self,
        record: &[u8],
        position: u64,
        visit: &mut dyn FnMut(Event<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let parsed = parse(op::CHUNK, &record[RECORD_HEAD as usize..]);
        let result = match &parsed {
            Ok(Some(Record::Chunk { header, data })) => unpack(header, data).map(|bytes| (header, bytes)),
            Ok(_) => return Ok(()),
            Err(error) => Err(error.clone()),
        };
        let (header, bytes) = match result {
            Ok(whole) => whole,
            Err(error) => {
                self.note(position, &format!("a chunk: {error}"));
                return Ok(());
            }
        };
        if self.summary.messages == 0 {
            self.summary.compression = Compression::of_name(&header.compression);
        }
        let (mut records, mut times) = (Records(&bytes), None);
        for (kind, body) in &mut records {
            match parse(kind, body) {
                Ok(Some(record @ (Record::Schema { .. } | Record::Channel(_) | Record::Message { .. }))) => {
                    if let Record::Message { header, .. } = &record {
                        let (first, last) = times.unwrap_or((header.log_time, header.log_time));
                        times = Some((header.log_time.min(first), header.log_time.max(last)));
                    }
                    self.parsed(&record, position, visit)?;
                }
                Ok(_) => self.note(position, &format!("a record of kind {kind} in a chunk")),
                Err(error) => self.note(position, &format!("in a chunk: {error}")),
            }
        }
        if !records.0.is_empty() {
            self.note(position, "a chunk ends in the middle of a record");
        }
        if times.is_some_and(|times| times != (header.message_start_time, header.message_end_time)) {
            self.note(position, "a chunk has messages of other times than it says");
        }
        Ok(())
    }

    fn parsed<E: From<BagError>>(
        &mut self,
        record: &Record<'_>,
        position: u64,
        visit: &mut dyn FnMut(Event<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        match record {
            Record::DataEnd(_) => self.is_ended = true,
            Record::Footer(_) => self.note(position, "the footer is before the end of the data"),
            Record::Schema { header, data } => {
                self.schemas.insert(header.id, (header.name.clone(), definition(&header.encoding, data)));
            }
            Record::Channel(channel) => {
                if let Some(topic) = self.channel(channel) {
                    return visit(Event::Topic(topic));
                }
            }
            Record::Attachment { header, data, .. } => {
                self.summary.attachments.push(header.name.clone());
                return visit(Event::Attachment(Attachment {
                    name: header.name.clone(),
                    media_type: header.media_type.clone(),
                    log_ns: header.log_time,
                    create_ns: header.create_time,
                    data: Cow::Borrowed(data),
                }));
            }
            Record::Metadata(metadata) => {
                return visit(Event::Metadata(metadata.name.clone(), metadata.metadata.clone()));
            }
            Record::Message { header, data } => {
                if !self.channels.contains_key(&header.channel_id)
                    && let Some(topic) = self.restored(header.channel_id)?
                {
                    visit(Event::Topic(topic))?;
                }
                let Some((topic, messages)) = self.channels.get_mut(&header.channel_id) else {
                    self.note(
                        position,
                        &format!("a message of channel {}, which there is not", header.channel_id),
                    );
                    return Ok(());
                };
                *messages += 1;
                self.summary.count_message(header.log_time);
                self.summary.disordered += u64::from(header.log_time < self.latest_ns);
                self.latest_ns = self.latest_ns.max(header.log_time);
                let (sequence, log_ns, publish_ns) = (header.sequence, header.log_time, header.publish_time);
                let stamp = Stamp { sequence, log_ns, publish_ns };
                return visit(Event::Message(Message { topic, stamp, cdr: data }));
            }
            _ => {}
        }
        Ok(())
    }

    /// The topic of a channel that was in a damaged part, if the summary repeats it.
    fn restored(&mut self, id: u16) -> Result<Option<&Arc<Topic>>, BagError> {
        if self.repeated.is_none() {
            self.repeated = Some(topics_of(&self.file).map_err(BagError::read(&self.path))?);
        }
        let Some(topic) = self.repeated.as_mut().and_then(|topics| topics.remove(&id)) else {
            return Ok(None);
        };
        let (topic, _) = self.channels.entry(id).or_insert((Arc::new(topic), 0));
        Ok(Some(&*topic))
    }

    /// The topic of a channel, if it was not known: each chunk may state it again.
    fn channel(&mut self, channel: &mcap::records::Channel) -> Option<&Arc<Topic>> {
        let topic = topic(channel, self.schemas.get(&channel.schema_id).cloned().unwrap_or_default());
        if self.channels.get(&channel.id).is_some_and(|(known, _)| **known == topic) {
            return None;
        }
        if let Some((before, messages)) = self.channels.insert(channel.id, (Arc::new(topic), 0)) {
            self.summary.count(&before, messages);
        }
        self.channels.get(&channel.id).map(|(topic, _)| topic)
    }
}

/// The records of a chunk, decompressed. Memory grows with the data, not with the length that the chunk states, to 1 GiB + 1 MiB at most.
fn unpack<'b>(header: &ChunkHeader, data: &'b [u8]) -> Result<Cow<'b, [u8]>, String> {
    if header.uncompressed_size > MOST_BYTES as u64 + (1 << 20) {
        return Err(format!(
            "it says that it is of {} bytes, which is more than any",
            header.uncompressed_size
        ));
    }
    let mut bytes = Vec::new();
    let mut unpack = |from: &mut dyn Read| from.take(header.uncompressed_size + 1).read_to_end(&mut bytes);
    let unpacked = match &*header.compression {
        "" => Ok(0),
        "zstd" => zstd::Decoder::with_buffer(data).and_then(|mut data| unpack(&mut data)),
        "lz4" => lz4::Decoder::new(data).and_then(|mut data| unpack(&mut data)),
        other => return Err(format!("its compression {other:?} is unknown: neither zstd nor lz4")),
    };
    unpacked.map_err(|error| format!("it cannot be decompressed: {error}"))?;
    let bytes = if header.compression.is_empty() { Cow::Borrowed(data) } else { Cow::Owned(bytes) };
    if bytes.len() as u64 != header.uncompressed_size {
        return Err(format!("it says that it is of {} bytes, and is not", header.uncompressed_size));
    }
    if header.uncompressed_crc != 0 && header.uncompressed_crc != crc32fast::hash(&bytes) {
        return Err("its checksum is another".to_owned());
    }
    Ok(bytes)
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes a bag: chunks of a file, files of a folder.

use crate::claim::{Claim, Claimed, Position, create};
use crate::metadata::{Description, write_metadata};
use crate::reader::{Attachment, FileSummary};
use crate::summary::{QOS, TYPE_HASH};
use crate::{BagError, Compression, Definition, MOST_BYTES, Stamp, Topic};
use mcap::records::{MessageHeader, Metadata};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The memory for data on their way to the disk: a chunk and a long message, twice.
const MEMORY_BYTES: usize = 32 << 20;
/// A chunk is written when it has this many bytes, if it is not [flushed](Writer::flush) before.
const CHUNK_BYTES: u64 = 4 << 20;

/// The number of bytes that a record takes besides its content: see <https://mcap.dev/spec>.
const OF_MESSAGE: u64 = 31 + 16;
const OF_TOPIC: u64 = 256;
const OF_CHUNK: u64 = 512;
const OF_CHUNK_AND_TOPIC: u64 = 32;
const OF_FILE: u64 = 8 << 10;

/// The metadata records about the recording: its session, and what was lost.
const SESSION: &str = "tautline:session";
const RECORDING: &str = "tautline:recording";

/// The options of a [`Writer`].
#[derive(Clone, Copy, Debug, Default)]
pub struct Options {
    /// The compression of the chunks.
    pub compression: Compression,
    /// A new file begins when the previous one has this number of bytes.
    pub split_bytes: Option<u64>,
    /// A new file begins when the messages of the previous one span this number of nanoseconds.
    pub split_ns: Option<u64>,
    /// The oldest file is removed when there are more files than this.
    pub keep_files: Option<NonZeroU32>,
    /// Memory for data that is not yet on the disk, in bytes. `None`: 32 MiB.
    pub memory_bytes: Option<usize>,
}

/// A topic of a [`Writer`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicId(pub(crate) usize);

/// A bag that is being written.
///
/// If the process is killed, complete chunks up to the last flush remain, for [`recover`](crate::recover).
pub struct Writer {
    folder: PathBuf,
    name: String,
    options: Options,
    /// The metadata of the recording, which are in each file.
    session: BTreeMap<String, String>,
    topics: Vec<Topic>,
    /// The custom data for `metadata.yaml`.
    custom_data: BTreeMap<String, String>,
    file: Option<Open>,
    number: u32,
    done: Vec<FileSummary>,
    /// Files that were removed again.
    removed: u32,
    is_behind: Arc<AtomicBool>,
}

/// What was written.
#[derive(Clone, Debug)]
pub struct Finished {
    /// The files that exist.
    pub files: Vec<FileSummary>,
    /// The number of files that were removed because there were more than should be kept.
    pub removed: u32,
}

pub(crate) struct Open {
    writer: mcap::Writer<Claimed>,
    claim: Claim,
    /// The end of the file, and that of the last complete chunk.
    end: Position,
    flushed: u64,
    summary: FileSummary,
    /// For each topic: the number of its channel in the file, and the number of its messages.
    channels: Vec<(u16, u64)>,
    /// The maximum length of the current chunk.
    pending: u64,
    /// The number of bytes that complete the file.
    ending: u64,
}

impl Writer {
    /// Creates a bag in a new folder, in files named as the folder. `session` is written into each of them.
    ///
    /// # Errors
    /// The folder exists or cannot be made.
    pub fn create(
        folder: &Path,
        options: Options,
        session: BTreeMap<String, String>,
    ) -> Result<Self, BagError> {
        if let Some(parent) = folder.parent().filter(|parent| !parent.as_os_str().is_empty()) {
            fs::create_dir_all(parent).map_err(BagError::write(parent))?;
        }
        fs::create_dir(folder).map_err(|source| match source.kind() {
            std::io::ErrorKind::AlreadyExists => BagError::Exists(folder.to_owned()),
            _ => BagError::Write { path: folder.to_owned(), source },
        })?;
        let name = folder.file_name().map_or("bag".into(), |name| name.to_string_lossy().into_owned());
        Self::create_in(folder, &name, options, session, BTreeMap::new())
    }

    /// Creates a bag in an existing folder, in files with this name.
    pub(crate) fn create_in(
        folder: &Path,
        name: &str,
        options: Options,
        session: BTreeMap<String, String>,
        custom_data: BTreeMap<String, String>,
    ) -> Result<Self, BagError> {
        let is_behind = Arc::default();
        let mut writer = Writer {
            folder: folder.to_owned(),
            name: name.to_owned(),
            options,
            session,
            topics: Vec::new(),
            custom_data,
            file: None,
            number: 0,
            done: Vec::new(),
            removed: 0,
            is_behind,
        };
        // Errors of creating a file come before the first message.
        writer.current()?;
        Ok(writer)
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Sets whether messages come faster than the disk can write them. If so, they go through the kernel's page cache, which accepts them
    /// at once and makes the writer wait later, if at all; otherwise they bypass it.
    pub fn set_behind(&self, is_behind: bool) {
        self.is_behind.store(is_behind, Ordering::Relaxed);
    }

    /// Adds a topic, which is in the current file and all later ones, with or without messages.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn add_topic(&mut self, topic: Topic) -> Result<TopicId, BagError> {
        let id = self.current()?.add_topic(&topic)?;
        self.topics.push(topic);
        Ok(id)
    }

    /// Adds a file.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn attach(&mut self, attachment: &Attachment<'_>) -> Result<(), BagError> {
        self.current()?.attach(attachment)
    }

    /// Adds a record of metadata.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn write_metadata(&mut self, name: &str, metadata: BTreeMap<String, String>) -> Result<(), BagError> {
        self.current()?.write_metadata(name, metadata)
    }

    fn current(&mut self) -> Result<&mut Open, BagError> {
        let file = match self.file.take() {
            Some(file) => file,
            None => self.opened()?,
        };
        Ok(self.file.insert(file))
    }

    /// Writes a message, with its four bytes of encapsulation in front.
    ///
    /// # Errors
    /// [`BagError::Full`]: it is not written, and the bag can be [finished](Self::finish). Others: flushed messages are safe.
    pub fn write(&mut self, topic: TopicId, stamp: Stamp, cdr: &[u8]) -> Result<(), BagError> {
        if cdr.len() > MOST_BYTES {
            let reason = format!("a message of {} bytes is longer than {MOST_BYTES}", cdr.len());
            return Err(BagError::Format { path: self.folder.clone(), reason });
        }
        if self.file.as_ref().is_some_and(|file| file.is_over(&self.options, stamp.log_ns)) {
            self.split()?;
        }
        self.current()?.write(topic, stamp, cdr)
    }

    /// After this call all messages are in the file, whatever happens to this process.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn flush(&mut self) -> Result<(), BagError> {
        let Some(file) = &mut self.file else { return Ok(()) };
        file.hand_over()?;
        file.claim.wait()
    }

    /// The number of bytes of all existing files, without what is not flushed.
    pub fn bytes(&self) -> u64 {
        let done: u64 = self.done.iter().map(|file| file.bytes).sum();
        done + self.file.as_ref().map_or(0, |file| file.flushed)
    }

    /// Completes the bag. `statement`, if it says anything, is written into the last file, as a record `tautline:recording`.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self, statement: BTreeMap<String, String>) -> Result<Finished, BagError> {
        if let Some(mut file) = self.file.take() {
            file.state(RECORDING, statement)?;
            self.done.push(file.finish(&self.topics)?);
        }
        self.describe()?;
        Ok(Finished { files: self.done, removed: self.removed })
    }

    /// Begins the next file, with all topics.
    fn opened(&self) -> Result<Open, BagError> {
        let path = self.folder.join(format!("{}_{}.mcap", self.name, self.number));
        let mut file = Open::create(&path, self.options, self.is_behind.clone())?;
        let begin = |file: &mut Open| {
            file.state(SESSION, self.session.clone())?;
            self.topics.iter().try_for_each(|topic| file.add_topic(topic).map(drop))?;
            file.hand_over()
        };
        begin(&mut file).inspect_err(|_| {
            // The file has no messages, and without its end the bag would look damaged.
            let _ = fs::remove_file(&path);
        })?;
        Ok(file)
    }

    /// Ends a file.
    fn split(&mut self) -> Result<(), BagError> {
        let Some(file) = self.file.take() else { return Ok(()) };
        self.done.push(file.finish(&self.topics)?);
        self.number += 1;
        // The file that is begun next counts, too.
        let keep = self.options.keep_files.map_or(usize::MAX, |keep| keep.get() as usize - 1);
        let oldest: Vec<_> = self.done.drain(..self.done.len().saturating_sub(keep)).collect();
        // Written before the files are removed, so that it never names a file that does not exist.
        self.describe()?;
        for FileSummary { path, .. } in oldest {
            match fs::remove_file(&path) {
                Ok(()) => self.removed += 1,
                // Another program has moved it away.
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
                Err(error) => return Err(BagError::write(&path)(error)),
            }
        }
        Ok(())
    }

    /// Writes `metadata.yaml`, which other programs read first.
    fn describe(&self) -> Result<(), BagError> {
        write_metadata(&self.folder, &Description::mcap(&self.custom_data), &self.done)
    }
}

impl Open {
    pub(crate) fn create(
        path: &Path,
        options: Options,
        is_behind: Arc<AtomicBool>,
    ) -> Result<Self, BagError> {
        let Options { compression, memory_bytes, .. } = options;
        let new = create(path, memory_bytes.unwrap_or(MEMORY_BYTES) / 2, is_behind)?;
        Self::begin(path, compression, new).inspect_err(|_| {
            // The file has no messages.
            let _ = fs::remove_file(path);
        })
    }

    fn begin(
        path: &Path,
        compression: Compression,
        (mut claim, claimed, end): (Claim, Claimed, Position),
    ) -> Result<Self, BagError> {
        claim.up_to(OF_FILE)?;
        let level = u32::from(compression == Compression::Zstd);
        let writer = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("tautline ", env!("CARGO_PKG_VERSION")))
            .compression(compression.of_mcap())
            .compression_level(level)
            .compression_threads(0)
            .chunk_size(None)
            .calculate_data_section_crc(false)
            .create(claimed)
            .map_err(BagError::mcap(path))?;
        let summary = FileSummary { path: path.to_owned(), ..FileSummary::default() };
        let (flushed, channels) = (end.get(), Vec::new());
        Ok(Open { writer, claim, end, flushed, summary, channels, pending: 0, ending: OF_FILE })
    }

    /// Whether the next message, which was received at `log_ns`, belongs to another file.
    fn is_over(&self, options: &Options, log_ns: u64) -> bool {
        let FileSummary { messages, start_ns, .. } = self.summary;
        let bytes = self.flushed + self.pending;
        messages > 0
            && (options.split_bytes.is_some_and(|most| bytes >= most)
                || options.split_ns.is_some_and(|most| log_ns.saturating_sub(start_ns) >= most))
    }

    /// Reserves space for `bytes` that are to be written, and for the end of the file, which grows by `ending`.
    fn claim(&mut self, bytes: u64, ending: u64) -> Result<(), BagError> {
        let (pending, ending) = (self.pending + bytes, self.ending + ending);
        let chunk = OF_CHUNK + OF_CHUNK_AND_TOPIC * self.channels.len() as u64;
        // Data that cannot be compressed become a little longer.
        self.claim.up_to(self.flushed + pending + pending / 64 + ending + 2 * chunk)?;
        (self.pending, self.ending) = (pending, ending);
        Ok(())
    }

    /// Writes what the recorder states. If there is no room for it, the bag is complete without it: the recorder prints it, too.
    fn state(&mut self, name: &str, metadata: BTreeMap<String, String>) -> Result<(), BagError> {
        if metadata.is_empty() {
            return Ok(());
        }
        match self.write_metadata(name, metadata) {
            Err(BagError::Full { .. }) => Ok(()),
            other => other,
        }
    }

    pub(crate) fn write_metadata(
        &mut self,
        name: &str,
        metadata: BTreeMap<String, String>,
    ) -> Result<(), BagError> {
        let bytes: usize = metadata.iter().map(|(key, value)| key.len() + value.len() + 8).sum();
        let ending = OF_TOPIC + name.len() as u64;
        self.claim(bytes as u64 + ending, ending)?;
        let record = Metadata { name: name.to_owned(), metadata };
        self.writer.write_metadata(&record).map_err(BagError::mcap(&self.summary.path))
    }

    pub(crate) fn attach(&mut self, attachment: &Attachment<'_>) -> Result<(), BagError> {
        let Attachment { name, media_type, log_ns, create_ns, data } = attachment;
        let ending = OF_TOPIC + (name.len() + media_type.len()) as u64;
        self.claim(data.len() as u64 + ending, ending)?;
        let record = mcap::Attachment {
            log_time: *log_ns,
            create_time: *create_ns,
            name: name.clone(),
            media_type: media_type.clone(),
            data: Cow::Borrowed(data),
        };
        self.writer.attach(&record).map_err(BagError::mcap(&self.summary.path))?;
        self.summary.attachments.push(name.clone());
        self.hand_over()
    }

    pub(crate) fn write(&mut self, topic: TopicId, stamp: Stamp, cdr: &[u8]) -> Result<(), BagError> {
        let bytes = cdr.len() as u64 + OF_MESSAGE;
        // Longer chunks are not read.
        if self.pending + bytes > MOST_BYTES as u64 {
            self.hand_over()?;
        }
        self.claim(bytes, 0)?;
        let (channel_id, messages) = &mut self.channels[topic.0];
        let Stamp { sequence, log_ns: log_time, publish_ns: publish_time } = stamp;
        let header = MessageHeader { channel_id: *channel_id, sequence, log_time, publish_time };
        self.writer.write_to_known_channel(&header, cdr).map_err(BagError::mcap(&self.summary.path))?;
        *messages += 1;
        self.summary.count_message(log_time);
        if self.pending >= CHUNK_BYTES { self.hand_over() } else { Ok(()) }
    }

    pub(crate) fn add_topic(&mut self, topic: &Topic) -> Result<TopicId, BagError> {
        let Topic { name, type_name, type_hash, encoding, definition, qos, metadata } = topic;
        let (of_definition, data) = match definition {
            Some(Definition { encoding, data }) => (&**encoding, &**data),
            None => ("", &[][..]),
        };
        let mut metadata = metadata.clone();
        for (key, value) in [(TYPE_HASH, type_hash), (QOS, qos)] {
            if !value.is_empty() {
                metadata.insert(key.to_owned(), value.clone());
            }
        }
        let texts = metadata.iter().map(|(key, value)| key.len() + value.len() + 8).sum::<usize>();
        let bytes = (texts + name.len() + type_name.len() + encoding.len() + data.len()) as u64 + OF_TOPIC;
        // Once in a chunk, once in the summary.
        self.claim(bytes, bytes)?;
        let path = &self.summary.path;
        let schema = match (&**type_name, of_definition, data) {
            ("", "", []) => Ok(0),
            _ => self.writer.add_schema(type_name, of_definition, data),
        };
        let channel = schema.and_then(|schema| self.writer.add_channel(schema, name, encoding, &metadata));
        self.channels.push((channel.map_err(BagError::mcap(path))?, 0));
        Ok(TopicId(self.channels.len() - 1))
    }

    /// Ends the chunk, for the disk's thread to write.
    fn hand_over(&mut self) -> Result<(), BagError> {
        if self.pending == 0 {
            return Ok(());
        }
        self.writer.flush().map_err(BagError::mcap(&self.summary.path))?;
        (self.pending, self.flushed) = (0, self.end.get());
        self.ending += OF_CHUNK + OF_CHUNK_AND_TOPIC * self.channels.len() as u64;
        Ok(())
    }

    pub(crate) fn finish(mut self, topics: &[Topic]) -> Result<FileSummary, BagError> {
        let path = self.summary.path.clone();
        self.hand_over()?;
        self.writer.finish().map_err(BagError::mcap(&path))?;
        let mut claimed = self.writer.into_inner();
        std::io::Write::flush(&mut claimed).map_err(BagError::write(&path))?;
        self.claim.release(self.end.get())?;
        self.summary.bytes = self.end.get();
        for (topic, (_, messages)) in topics.iter().zip(self.channels) {
            self.summary.count(topic, messages);
        }
        Ok(self.summary)
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writing a bag of `.db3` files as rosbag2 of ROS 2 Jazzy does (schema 4).

use crate::metadata::{Description, information, write_metadata};
use crate::qos::joined;
use crate::reader::FileSummary;
use crate::writer::TopicId;
use crate::{BagError, Compression, Definition, Options, Stamp, Storage, Topic};
use rusqlite::{Connection, params};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// The tables, as Jazzy's sqlite_storage.cpp creates them.
const SCHEMA: &str = "
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY,ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY,metadata_version INTEGER NOT NULL,metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,serialization_format TEXT NOT NULL,
  offered_qos_profiles TEXT NOT NULL,type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY,topic_type TEXT NOT NULL,encoding TEXT NOT NULL,
  encoded_message_definition TEXT NOT NULL,type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'jazzy');";
/// No journal and no syncs: nobody else uses the file before it is complete, and what a crash leaves of it is removed.
const PRAGMAS: &str =
    "PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; PRAGMA locking_mode = EXCLUSIVE; BEGIN;";
/// The number of bytes of one transaction.
const STEP: u64 = 4 << 20;
/// SQLite's own limit of a value, without what a row has besides.
const MOST_BLOB: usize = 999_999_000;
/// The number of bytes that a row takes besides its message, with its entry in the index; estimated.
const OF_ROW: u64 = 40;

/// A bag that is being written. It is not valid until it is [finished](Self::finish).
pub struct SqliteWriter {
    folder: PathBuf,
    name: String,
    options: Options,
    topics: Vec<Topic>,
    file: Option<Open>,
    done: Vec<FileSummary>,
    /// Types with two definitions, of which a file can hold only one.
    pub twice: BTreeMap<String, u64>,
}

struct Open {
    connection: Connection,
    summary: FileSummary,
    /// The number of messages of each topic of the file.
    counts: BTreeMap<TopicId, u64>,
    definitions: BTreeMap<String, Definition>,
    bytes: u64,
    pending: u64,
}

impl SqliteWriter {
    /// Creates a bag in an existing folder, in files with this name.
    ///
    /// # Errors
    /// The first file cannot be created; the compression is lz4, which rosbag2 does not have for this
    /// storage.
    pub fn create(folder: &Path, name: &str, options: Options) -> Result<Self, BagError> {
        if options.compression == Compression::Lz4 {
            let reason = "rosbag2 compresses messages in SQLite with zstd alone".to_owned();
            return Err(BagError::Format { path: folder.to_owned(), reason });
        }
        let (folder, name, topics) = (folder.to_owned(), name.to_owned(), Vec::new());
        let (done, twice) = (Vec::new(), BTreeMap::new());
        let mut writer = SqliteWriter { folder, name, options, topics, file: None, done, twice };
        writer.open()?;
        Ok(writer)
    }

    /// Adds a topic, which is in each file, with or without messages.
    ///
    /// # Errors
    /// The file cannot be written; [`BagError::Unkept`].
    pub fn add_topic(&mut self, topic: Topic) -> Result<TopicId, BagError> {
        if let Some(key) = topic.metadata.keys().next() {
            return Err(BagError::Unkept { what: format!("the metadata '{key}' of {}", topic.name) });
        }
        let id = TopicId(self.topics.len());
        self.topics.push(topic);
        self.declare(id)?;
        Ok(id)
    }

    /// Adds the profiles of other publishers of a topic.
    pub fn add_qos(&mut self, id: TopicId, qos: &str) {
        let topic = &mut self.topics[id.0];
        topic.qos = joined(&topic.qos, qos);
    }

    /// Adds the topic to the current file, unless it is there.
    fn declare(&mut self, id: TopicId) -> Result<(), BagError> {
        if self.file.is_none() {
            self.open()?;
        }
        let (Some(file), topic) = (&mut self.file, &self.topics[id.0]) else { return Ok(()) };
        if file.counts.contains_key(&id) {
            return Ok(());
        }
        file.counts.insert(id, 0);
        let fail = |error| failed(&file.summary.path, error);
        // The QoS is known at the file's end.
        let text = "INSERT INTO topics VALUES (?, ?, ?, ?, '[]', ?)";
        let Topic { name, type_name, encoding, type_hash, .. } = topic;
        let values = params![id.0 as i64 + 1, name, type_name, encoding, type_hash];
        file.connection.execute(text, values).map_err(fail)?;
        let Some(definition) = &topic.definition else { return Ok(()) };
        match file.definitions.get(type_name) {
            Some(known) => {
                if known != definition {
                    *self.twice.entry(type_name.clone()).or_default() += 1;
                }
            }
            None => {
                let Ok(data) = std::str::from_utf8(&definition.data) else {
                    let encoding = &definition.encoding;
                    return Err(BagError::Unkept {
                        what: format!("the {encoding} definition of {type_name}, which is no text,"),
                    });
                };
                let text = "INSERT INTO message_definitions \
                            (topic_type, encoding, encoded_message_definition, type_description_hash) VALUES (?, ?, ?, ?)";
                let values = params![type_name, definition.encoding, data, type_hash];
                file.connection.execute(text, values).map_err(fail)?;
                file.definitions.insert(type_name.clone(), definition.clone());
            }
        }
        Ok(())
    }

    /// Writes a message. Only the time of its reception is kept.
    ///
    /// # Errors
    /// The disk is full; the message is longer than SQLite's limit, or later than its numbers.
    pub fn write(&mut self, id: TopicId, stamp: Stamp, cdr: &[u8]) -> Result<(), BagError> {
        let wrong = |reason: String| BagError::Format { path: self.folder.clone(), reason };
        let packed = match self.options.compression {
            Compression::Zstd => {
                Some(zstd::bulk::compress(cdr, 1).map_err(|error| wrong(error.to_string()))?)
            }
            _ => None,
        };
        let data = packed.as_deref().unwrap_or(cdr);
        if data.len() > MOST_BLOB {
            return Err(wrong(format!(
                "a message of {} bytes is longer than SQLite takes, {MOST_BLOB}; --storage mcap takes it",
                data.len()
            )));
        }
        let Ok(log_ns) = i64::try_from(stamp.log_ns) else {
            return Err(wrong(format!("a message is of {} ns, later than SQLite's numbers", stamp.log_ns)));
        };
        if self.file.as_ref().is_some_and(|file| {
            file.summary.messages > 0 && self.options.split_bytes.is_some_and(|most| file.bytes >= most)
        }) {
            self.end_file()?;
        }
        self.declare(id)?;
        let Some(file) = &mut self.file else { return Ok(()) };
        let path = &file.summary.path;
        let fail = |error| failed(path, error);
        let text = "INSERT INTO messages (timestamp, topic_id, data) VALUES (?, ?, ?)";
        let mut statement = file.connection.prepare_cached(text).map_err(fail)?;
        statement.execute(params![log_ns, id.0 as i64 + 1, data]).map_err(fail)?;
        drop(statement);
        let bytes = data.len() as u64 + OF_ROW;
        file.bytes += bytes;
        file.pending += bytes;
        if file.pending >= STEP {
            file.connection.execute_batch("COMMIT; BEGIN;").map_err(fail)?;
            file.pending = 0;
        }
        *file.counts.entry(id).or_default() += 1;
        file.summary.count_message(stamp.log_ns);
        Ok(())
    }

    /// Completes the bag and writes its `metadata.yaml`.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn finish(mut self, custom_data: &BTreeMap<String, String>) -> Result<Vec<FileSummary>, BagError> {
        self.end_file()?;
        let storage = Storage::Sqlite3;
        let packs_messages = self.options.compression != Compression::None;
        write_metadata(&self.folder, &Description { storage, packs_messages, custom_data }, &self.done)?;
        Ok(self.done)
    }

    fn open(&mut self) -> Result<(), BagError> {
        let path = self.folder.join(format!("{}_{}.db3", self.name, self.done.len()));
        // Refuses a file that exists.
        File::options().write(true).create_new(true).open(&path).map_err(BagError::write(&path))?;
        let connection = Connection::open(&path).map_err(|error| failed(&path, error))?;
        connection
            .execute_batch(SCHEMA)
            .and_then(|()| connection.execute_batch(PRAGMAS))
            .map_err(|error| failed(&path, error))?;
        let summary = FileSummary { path, ..FileSummary::default() };
        let (counts, definitions) = (BTreeMap::new(), BTreeMap::new());
        self.file = Some(Open { connection, summary, counts, definitions, bytes: 0, pending: 0 });
        Ok(())
    }

    fn end_file(&mut self) -> Result<(), BagError> {
        let Some(mut file) = self.file.take() else { return Ok(()) };
        let path = file.summary.path.clone();
        let fail = |error| failed(&path, error);
        for (id, messages) in &file.counts {
            let topic = &self.topics[id.0];
            file.summary.count(topic, *messages);
            if !topic.qos.is_empty() {
                let text = "UPDATE topics SET offered_qos_profiles = ? WHERE id = ?";
                file.connection.execute(text, params![topic.qos, id.0 as i64 + 1]).map_err(fail)?;
            }
        }
        file.summary.compression = self.options.compression;
        let packs_messages = self.options.compression != Compression::None;
        let custom_data = &BTreeMap::new();
        let description = Description { storage: Storage::Sqlite3, packs_messages, custom_data };
        let text = information(&description, std::slice::from_ref(&file.summary));
        let insert = "INSERT INTO metadata (metadata_version, metadata) VALUES (9, ?)";
        file.connection.execute(insert, [text]).map_err(fail)?;
        file.connection.execute_batch("COMMIT;").map_err(fail)?;
        file.connection.close().map_err(|(_, error)| failed(&path, error))?;
        let synced = File::open(&path).and_then(|file| file.sync_all().map(|()| file));
        synced.map_err(BagError::write(&path))?;
        file.summary.bytes = fs::metadata(&path).map_err(BagError::write(&path))?.len();
        self.done.push(file.summary);
        Ok(())
    }
}

fn failed(path: &Path, error: rusqlite::Error) -> BagError {
    if error.sqlite_error_code() == Some(rusqlite::ErrorCode::DiskFull) {
        return BagError::NoRoom { path: path.to_owned(), bytes: STEP };
    }
    BagError::Write { path: path.to_owned(), source: std::io::Error::other(error) }
}

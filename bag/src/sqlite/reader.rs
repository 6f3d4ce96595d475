// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reading a `.db3` file of any rosbag2: schemas 1 (Dashing) to 4 (Iron and later). Its content is untrusted.

use crate::parts::opened;
use crate::reader::Message;
use crate::summary::definition;
use crate::{BagError, Definition, Stamp, Topic};
use rusqlite::config::DbConfig;
use rusqlite::types::ValueRef;
use rusqlite::{Connection, OpenFlags, Row};
use std::collections::{BTreeMap, HashMap};
use std::io::Read;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The last version of the schema that is known: ROS 2 Jazzy's.
const SCHEMA: i64 = 4;
/// The least number of bytes that a row takes besides its message.
const OF_ROW: u64 = 4;

/// A database that is open.
pub struct Database {
    connection: Connection,
    path: PathBuf,
    bytes: u64,
    topics: BTreeMap<i64, Arc<Topic>>,
    notes: Vec<String>,
}

impl Database {
    /// # Errors
    /// It cannot be opened, or is not a bag.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let mut bytes = whole(path)?;
        let beside = |end: &str| {
            let mut name = path.as_os_str().to_owned();
            name.push(end);
            std::fs::metadata(name).map_or(0, |file| file.len())
        };
        bytes += beside("-wal");
        // A file without a journal is not being written: it needs no locks, and no files beside it.
        let is_alone = beside("-wal") == 0 && beside("-journal") == 0;
        let uri = uri(path, if is_alone { "?immutable=1" } else { "" });
        let flags =
            OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let fail = |error| failed(path, error);
        let connection = Connection::open_with_flags(uri, flags).map_err(fail)?;
        // Code in the database is not run, and its pages are checked before they are used.
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false).map_err(fail)?;
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true).map_err(fail)?;
        connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_VIEW, false).map_err(fail)?;
        connection.pragma_update(None, "cell_size_check", true).map_err(fail)?;
        let (path, topics) = (path.to_owned(), BTreeMap::new());
        let mut database = Database { connection, path, bytes, topics, notes: Vec::new() };
        database.read_schema()?;
        Ok(database)
    }

    /// Its topics, with messages and without.
    pub fn topics(&self) -> impl Iterator<Item = &Arc<Topic>> {
        self.topics.values()
    }

    /// Notes on content that [`read`](Self::read) does not return.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Reads all messages, in the order in which they were written.
    ///
    /// # Errors
    /// The file is damaged; an error of `visit`, which stops reading.
    pub fn read<E: From<BagError>>(
        &mut self,
        visit: &mut dyn FnMut(Message<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let fail = |error| failed(&self.path, error);
        let text = "SELECT topic_id, timestamp, data, rowid FROM messages ORDER BY rowid";
        let mut statement = self.connection.prepare(text).map_err(fail)?;
        let mut rows = statement.query([]).map_err(fail)?;
        let (mut read, mut strays) = (0, 0);
        while let Some(row) = rows.next().map_err(fail)? {
            let (topic, log_ns) = (integer(row, 0, "topic_id"), integer(row, 1, "timestamp"));
            let data = match row.get_ref(2).map_err(fail)? {
                ValueRef::Blob(data) => Ok(data),
                other => Err(format!("data is {}, no blob", other.data_type())),
            };
            let parts = topic.and_then(|topic| Ok((topic, log_ns?, data?))).and_then(|(topic, at, data)| {
                let at = u64::try_from(at).map_err(|_| format!("timestamp is {at}, before 1970"))?;
                Ok((topic, at, data))
            });
            let (topic, log_ns, cdr) = parts.map_err(|reason| {
                let row: i64 = row.get(3).unwrap_or(-1);
                self.no_bag(format!("message {row}: {reason}"))
            })?;
            // In a valid file no two messages share bytes, so they have no more bytes than the file.
            read += cdr.len() as u64 + OF_ROW;
            if read > self.bytes {
                return Err(self.no_bag("its messages have more bytes than it has".to_owned()).into());
            }
            let Some(topic) = self.topics.get(&topic) else {
                strays += 1;
                continue;
            };
            let stamp = Stamp { sequence: 0, log_ns, publish_ns: log_ns };
            visit(Message { topic, stamp, cdr })?;
        }
        drop(rows);
        drop(statement);
        if strays > 0 {
            self.notes.push(format!("{}: {strays} messages of no topic are left out", self.path.display()));
        }
        Ok(())
    }

    /// Reads which tables and columns there are, and the content of all tables except that of the messages.
    fn read_schema(&mut self) -> Result<(), BagError> {
        let fail = |error| failed(&self.path, error);
        let mut statement = self.connection.prepare("PRAGMA main.table_list").map_err(fail)?;
        let mut tables = HashMap::new();
        let mut rows = statement.query([]).map_err(fail)?;
        while let Some(row) = rows.next().map_err(fail)? {
            if let (Ok(name), Ok(kind)) = (string(row, 1, "name"), string(row, 2, "type")) {
                tables.insert(name, kind);
            }
        }
        drop(rows);
        drop(statement);
        for name in ["topics", "messages"] {
            match tables.get(name).map(String::as_str) {
                Some("table") => {}
                None => return Err(self.no_bag(format!("it is a database without a table '{name}'"))),
                Some(other) => return Err(self.no_bag(format!("'{name}' in it is a {other}, no table"))),
            }
        }
        let is_there = |name: &str| tables.get(name).is_some_and(|kind| kind == "table");
        self.columns("messages", &["topic_id", "timestamp", "data"])?;
        let columns = self.columns("topics", &["id", "name", "type", "serialization_format"])?;
        let definitions = if is_there("message_definitions") { self.definitions()? } else { BTreeMap::new() };
        if is_there("schema") && self.columns("schema", &[])?.iter().any(|column| column == "schema_version")
        {
            let version: Option<i64> = self
                .connection
                .query_row("SELECT max(schema_version) FROM schema", [], |row| row.get(0))
                .ok();
            if let Some(version) = version.filter(|version| *version > SCHEMA) {
                let path = self.path.display();
                self.notes.push(format!(
                    "{path}: its schema is of version {version}, of which {SCHEMA} is known: what is new in it is not kept"
                ));
            }
        }
        self.topics = self.read_topics(&columns, &definitions)?;
        Ok(())
    }

    /// The columns of a table that are stored in the file. Fails if one of `needed` is missing.
    fn columns(&self, table: &str, needed: &[&str]) -> Result<Vec<String>, BagError> {
        let fail = |error| failed(&self.path, error);
        let mut statement =
            self.connection.prepare(&format!("PRAGMA main.table_xinfo({table})")).map_err(fail)?;
        let mut rows = statement.query([]).map_err(fail)?;
        let mut columns = Vec::new();
        while let Some(row) = rows.next().map_err(fail)? {
            let is_computed = row.get_ref(6).map_err(fail)? != ValueRef::Integer(0);
            if !is_computed {
                columns.push(string(row, 1, "name").map_err(|reason| self.no_bag(reason))?);
            }
        }
        match needed.iter().find(|needed| !columns.iter().any(|column| column == *needed)) {
            None => Ok(columns),
            Some(missing) => Err(self.no_bag(format!("its table '{table}' has no column '{missing}'"))),
        }
    }

    fn definitions(&self) -> Result<BTreeMap<String, Definition>, BagError> {
        self.columns("message_definitions", &["topic_type", "encoding", "encoded_message_definition"])?;
        let text =
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions ORDER BY rowid";
        let mut definitions = BTreeMap::new();
        self.each(text, "message_definitions", |row| {
            let name = string(row, 0, "topic_type")?;
            let encoding = string(row, 1, "encoding")?;
            let text = string(row, 2, "encoded_message_definition")?;
            if let Some(text) = definition(&encoding, text.as_bytes()) {
                definitions.entry(name).or_insert(text);
            }
            Ok(())
        })?;
        Ok(definitions)
    }

    fn read_topics(
        &self,
        columns: &[String],
        definitions: &BTreeMap<String, Definition>,
    ) -> Result<BTreeMap<i64, Arc<Topic>>, BagError> {
        let optional = |name: &str| {
            if columns.iter().any(|column| column == name) { name.to_owned() } else { "''".to_owned() }
        };
        let text = format!(
            "SELECT id, name, type, serialization_format, {}, {} FROM topics ORDER BY id",
            optional("offered_qos_profiles"),
            optional("type_description_hash")
        );
        let mut topics = BTreeMap::new();
        self.each(&text, "topics", |row| {
            let id = integer(row, 0, "id")?;
            let (name, type_name) = (string(row, 1, "name")?, string(row, 2, "type")?);
            let encoding = string(row, 3, "serialization_format")?;
            let (qos, type_hash) =
                (string(row, 4, "offered_qos_profiles")?, string(row, 5, "type_description_hash")?);
            let definition = definitions.get(&type_name).cloned();
            let metadata = BTreeMap::new();
            let topic = Topic { name, type_name, type_hash, encoding, definition, qos, metadata };
            topics.insert(id, Arc::new(topic));
            Ok(())
        })?;
        Ok(topics)
    }

    fn each(
        &self,
        text: &str,
        table: &str,
        mut visit: impl FnMut(&Row<'_>) -> Result<(), String>,
    ) -> Result<(), BagError> {
        let fail = |error| failed(&self.path, error);
        let mut statement = self.connection.prepare(text).map_err(fail)?;
        let mut rows = statement.query([]).map_err(fail)?;
        let mut read = 0;
        while let Some(row) = rows.next().map_err(fail)? {
            read += OF_ROW + length(row);
            if read > self.bytes {
                return Err(self.no_bag(format!("its table '{table}' has more bytes than it has")));
            }
            visit(row).map_err(|reason| self.no_bag(format!("in its table '{table}' {reason}")))?;
        }
        Ok(())
    }

    fn no_bag(&self, reason: String) -> BagError {
        BagError::no_bag(&self.path, reason)
    }
}

/// The length of a file. Fails if it is shorter than its header states.
fn whole(path: &Path) -> Result<u64, BagError> {
    let (file, bytes) = opened(path)?;
    let mut header = Vec::new();
    file.take(100).read_to_end(&mut header).map_err(BagError::read(path))?;
    let number = |at: usize, len: usize| -> Option<u64> {
        header.get(at..at + len).map(|bytes| bytes.iter().fold(0, |sum, byte| sum << 8 | u64::from(*byte)))
    };
    let page = number(16, 2).map(|page| if page == 1 { 1 << 16 } else { page });
    let page = page.filter(|page| page.is_power_of_two());
    // Old writers do not keep the number of pages.
    let is_kept = number(24, 4) == number(92, 4);
    if let (Some(page), Some(pages)) = (page, number(28, 4).filter(|_| is_kept))
        && page * pages > bytes
    {
        let reason = format!(
            "it is cut off: {bytes} bytes of {}; `sqlite3 {} .recover` prints what is left of it",
            page * pages,
            path.display()
        );
        return Err(BagError::no_bag(path, reason));
    }
    Ok(bytes)
}

/// The path as a URI of SQLite, with any character escaped that has a meaning there.
fn uri(path: &Path, options: &str) -> String {
    let mut uri = String::from(if path.is_absolute() { "file://" } else { "file:" });
    for byte in path.as_os_str().as_bytes() {
        if byte.is_ascii_alphanumeric() || b"/._-".contains(byte) {
            uri.push(char::from(*byte));
        } else {
            uri += &format!("%{byte:02X}");
        }
    }
    uri + options
}

/// The bytes of a row's texts.
fn length(row: &Row<'_>) -> u64 {
    let columns = 0..row.as_ref().column_count();
    let text = columns.filter_map(|column| row.get_ref(column).ok()?.as_bytes().ok());
    text.map(|text| text.len() as u64).sum()
}

fn string(row: &Row<'_>, column: usize, name: &str) -> Result<String, String> {
    match row.get_ref(column).map_err(|error| error.to_string())? {
        ValueRef::Text(text) => {
            String::from_utf8(text.to_vec()).map_err(|_| format!("{name} has bytes that are no UTF-8"))
        }
        other => Err(format!("{name} is {}, no text", other.data_type())),
    }
}

fn integer(row: &Row<'_>, column: usize, name: &str) -> Result<i64, String> {
    match row.get_ref(column).map_err(|error| error.to_string())? {
        ValueRef::Integer(number) => Ok(number),
        other => Err(format!("{name} is {}, no integer", other.data_type())),
    }
}

fn failed(path: &Path, error: rusqlite::Error) -> BagError {
    use rusqlite::ErrorCode::{CannotOpen, DatabaseBusy, DatabaseCorrupt, NotADatabase, ReadOnly};
    let hint = match error.sqlite_error_code() {
        Some(DatabaseCorrupt | NotADatabase) => {
            format!("; `sqlite3 {} .recover` prints what is left of it", path.display())
        }
        Some(CannotOpen | DatabaseBusy | ReadOnly) => {
            "; if it is being recorded, wait; a copy of it and of the files -wal and -journal beside it can be read where it can be written"
                .to_owned()
        }
        _ => String::new(),
    };
    BagError::no_bag(path, format!("SQLite says: {error}{hint}"))
}

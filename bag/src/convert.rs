// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes a new bag of other bags, in any storage and compression of rosbag2.

use crate::disk::rename_to_new;
use crate::parts::{Form, Parts, form_of, is_compressed, parts_of};
use crate::qos::in_words;
use crate::reader::{Attachment, Damage, Event, FileReader, FileSummary, Message};
use crate::sqlite::{Database, SqliteWriter};
use crate::unpack::{Allowance, room, unpack_file};
use crate::writer::{Options, TopicId, Writer};
use crate::{BagError, CDR, Definition, PUBLISHER, Storage, Topic};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::ops::Range;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The number of bytes between two checks of the free space.
const STEP: u64 = 16 << 20;
/// The record in which rosbag2 repeats its `metadata.yaml`. It is not copied: a new bag has its own.
const OF_ROSBAG2: &str = "rosbag2";

/// Finds the definition of a topic's type, with a message of the topic, if there is one.
type Define<'h> = Box<dyn FnMut(&Topic, Option<&[u8]>) -> Option<Definition> + 'h>;

/// Selects what a new bag has of the old ones, and holds the callbacks of [`convert`].
pub struct Hooks<'h> {
    /// Whether a topic is kept.
    pub wants: Box<dyn FnMut(&Topic) -> bool + 'h>,
    /// Messages that were received in this time are kept, in nanoseconds since 1970.
    pub span_ns: Range<u64>,
    /// Called for definitions that the bag itself does not contain. `None`: topics are kept as they are, with QoS in any form.
    pub define: Option<Define<'h>>,
    /// Called with each file before it is read.
    pub tell: Box<dyn FnMut(&Path) + 'h>,
    /// Called at each message; `false` stops the conversion.
    pub go_on: Box<dyn FnMut() -> bool + 'h>,
}

impl Default for Hooks<'_> {
    /// Everything is kept as it is.
    fn default() -> Self {
        let (wants, tell, go_on) = (Box::new(|_: &Topic| true), Box::new(|_: &Path| {}), Box::new(|| true));
        Hooks { wants, span_ns: 0..u64::MAX, define: None, tell, go_on }
    }
}

/// The result of a conversion.
#[derive(Clone, Debug)]
pub struct Converted {
    /// The files of the new bag.
    pub files: Vec<FileSummary>,
    /// The damaged parts of the bags that were read; all undamaged parts were converted.
    pub damage: Vec<(PathBuf, Damage)>,
    /// The total number of damaged parts; of each file the first hundred are listed.
    pub damages: u64,
    /// Sentences about what could not be kept or was not as it should be.
    pub notes: Vec<String>,
}

/// Writes what is in `bags`, folders of rosbag2 or files of them, into a new bag in the folder `to`: MCAP or SQLite, compressed as a whole,
/// message by message or not. Messages of any encoding, their order, their times, topics with their metadata and definitions, attachments
/// and metadata records are kept.
///
/// # Errors
/// A bag cannot be read, or the new one cannot be written; [`BagError::Unkept`]: SQLite has no place for something. Then there is no new
/// bag: it is written to a temporary path and renamed when it is complete.
pub fn convert(
    bags: &[PathBuf],
    to: &Path,
    storage: Storage,
    options: Options,
    hooks: Hooks<'_>,
) -> Result<Converted, BagError> {
    if fs::symlink_metadata(to).is_ok() {
        return Err(BagError::Exists(to.to_owned()));
    }
    let all = bags.iter().map(|bag| parts_of(bag)).collect::<Result<Vec<_>, _>>()?;
    let custom_data: BTreeMap<_, _> = all.iter().flat_map(|parts| parts.custom_data.clone()).collect();
    let work = Work::create(to)?;
    let name = to.file_name().map_or("bag".into(), |name| name.to_string_lossy().into_owned());
    let session = BTreeMap::new();
    let out = match storage {
        Storage::Mcap => {
            Out::Mcap(Box::new(Writer::create_in(&work.folder, &name, options, session, custom_data)?))
        }
        Storage::Sqlite3 => {
            Out::Sqlite3(Box::new(SqliteWriter::create(&work.folder, &name, options)?), custom_data)
        }
    };
    let conversion = Conversion {
        folder: work.folder.clone(),
        out,
        hooks,
        known: HashMap::new(),
        ids: HashMap::new(),
        type_hashes: BTreeMap::new(),
        metadata: BTreeSet::new(),
        damage: Vec::new(),
        damages: 0,
        notes: Vec::new(),
        are_publishers_lost: false,
        unkept: 0,
        unseen: STEP,
    };
    let converted = conversion.run(all).map_err(|error| match error {
        // `Full` promises a bag that is complete so far, but nothing is kept of this one.
        BagError::Full { bytes, .. } | BagError::NoRoom { bytes, .. } => {
            BagError::NoRoom { path: to.to_owned(), bytes }
        }
        other => other,
    })?;
    let files = work.keep(to, converted.files)?;
    Ok(Converted { files, ..converted })
}

/// The temporary folder of the new bag, which is removed unless it is [kept](Self::keep).
struct Work {
    folder: PathBuf,
    /// The lock of the folder, held while the bag is written.
    _lock: File,
}

impl Work {
    /// Creates and locks the folder. Folders that others have locked stay; what a killed conversion left is removed.
    fn create(to: &Path) -> Result<Self, BagError> {
        let parent = to.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::create_dir_all(parent).map_err(BagError::write(parent))?;
        let name = to.file_name().unwrap_or_default().to_string_lossy();
        for number in 0_u32.. {
            let end = if number == 0 { String::new() } else { format!(".{number}") };
            let folder = parent.join(format!(".{name}{end}.unfinished"));
            remove_leftover(&folder);
            match fs::create_dir(&folder).and_then(|()| locked(&folder)) {
                Ok(Some(lock)) => return Ok(Work { folder, _lock: lock }),
                Ok(None) => {}
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
                Err(error) => return Err(BagError::write(&folder)(error)),
            }
        }
        Err(BagError::Exists(to.to_owned()))
    }

    /// Renames the folder to `to`, unless something has that name by now.
    fn keep(mut self, to: &Path, files: Vec<FileSummary>) -> Result<Vec<FileSummary>, BagError> {
        rename_to_new(&self.folder, to).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => BagError::Exists(to.to_owned()),
            _ => BagError::Write { path: to.to_owned(), source },
        })?;
        // Another process may use the old name by now.
        self.folder = PathBuf::new();
        let moved = |file: FileSummary| FileSummary { path: to.join(file.name()), ..file };
        Ok(files.into_iter().map(moved).collect())
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.folder);
    }
}

/// Locks the new folder. `None`: another process removed it as a leftover before it was locked.
fn locked(folder: &Path) -> io::Result<Option<File>> {
    let lock = match File::open(folder) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        lock => lock?,
    };
    // On a file system without locks, no process removes the folder.
    let is_own = !matches!(lock.try_lock(), Err(TryLockError::WouldBlock)) && is_named(&lock, folder);
    Ok(is_own.then_some(lock))
}

/// Removes a leftover folder, unless it is locked, or its writer has renamed it since it was opened.
fn remove_leftover(folder: &Path) {
    let flags = libc::O_DIRECTORY | libc::O_NOFOLLOW;
    let lock = File::options().read(true).custom_flags(flags).open(folder);
    if lock.is_ok_and(|lock| lock.try_lock().is_ok() && is_named(&lock, folder)) {
        let _ = fs::remove_dir_all(folder);
    }
}

fn is_named(file: &File, path: &Path) -> bool {
    let [one, other] = [file.metadata(), fs::symlink_metadata(path)]
        .map(|found| found.ok().map(|found| (found.dev(), found.ino())));
    one.is_some() && one == other
}

enum Out {
    Mcap(Box<Writer>),
    /// With the custom data of its `metadata.yaml`.
    Sqlite3(Box<SqliteWriter>, BTreeMap<String, String>),
}

impl Out {
    fn add_topic(&mut self, topic: Topic) -> Result<TopicId, BagError> {
        match self {
            Out::Mcap(writer) => writer.add_topic(topic),
            Out::Sqlite3(writer, _) => writer.add_topic(topic),
        }
    }

    fn attach(&mut self, attachment: &Attachment<'_>) -> Result<(), BagError> {
        match self {
            Out::Mcap(writer) => writer.attach(attachment),
            Out::Sqlite3(..) => {
                Err(BagError::Unkept { what: format!("the attachment '{}'", attachment.name) })
            }
        }
    }

    /// Writes a record. In SQLite it is custom data, `name/key`, or `name#2/key` if `name/key` has another value.
    fn write_metadata(&mut self, name: &str, values: BTreeMap<String, String>) -> Result<(), BagError> {
        match self {
            Out::Mcap(writer) => writer.write_metadata(name, values),
            Out::Sqlite3(_, custom_data) => {
                for (key, value) in values {
                    let names = (1_u64..).map(|number| match number {
                        1 => format!("{name}/{key}"),
                        _ => format!("{name}#{number}/{key}"),
                    });
                    let mut free =
                        names.filter(|name| custom_data.get(name).is_none_or(|known| *known == value));
                    custom_data.extend(free.next().map(|name| (name, value.clone())));
                }
                Ok(())
            }
        }
    }
}

struct Conversion<'h> {
    folder: PathBuf,
    out: Out,
    hooks: Hooks<'h>,
    /// The topics of the file that is read, by their addresses; `None`: not wanted. Each topic comes before its messages.
    known: HashMap<usize, Option<TopicId>>,
    /// The topics of the new bag.
    ids: HashMap<Topic, TopicId>,
    /// The hashes in the `metadata.yaml` of the bag that is read.
    type_hashes: BTreeMap<(String, String), String>,
    /// The metadata records that were written. The files of a bag may repeat them.
    metadata: BTreeSet<(String, BTreeMap<String, String>)>,
    damage: Vec<(PathBuf, Damage)>,
    damages: u64,
    notes: Vec<String>,
    /// Topics had a channel for each publisher.
    are_publishers_lost: bool,
    /// Messages with a number or a time of publication, which SQLite has no column for.
    unkept: u64,
    /// Bytes that were written since the last check of the free space.
    unseen: u64,
}

/// The file that is read, and how its messages are packed.
struct Source<'p> {
    path: &'p Path,
    packs_messages: Option<bool>,
    allowance: Allowance,
    unpacked: Vec<u8>,
}

impl Conversion<'_> {
    fn run(mut self, all: Vec<Parts>) -> Result<Converted, BagError> {
        all.into_iter().try_for_each(|parts| self.take_in(parts))?;
        self.finish()
    }

    fn take_in(&mut self, parts: Parts) -> Result<(), BagError> {
        self.notes.extend(parts.notes);
        self.type_hashes = parts.type_hashes;
        let (allowance, unpacked) = (Allowance::default(), Vec::new());
        let mut source =
            Source { path: Path::new(""), packs_messages: parts.packs_messages, allowance, unpacked };
        for path in &parts.files {
            (self.hooks.tell)(path);
            source.path = path;
            if form_of(path)? != Form::Zstd {
                self.file(path, &mut source)?;
                continue;
            }
            let unpacked = self.folder.join("unpacked");
            unpack_file(path, &unpacked, &mut self.hooks.go_on)?;
            let form = form_of(&unpacked).map_err(|error| unpacked_is(error, path))?;
            if form == Form::Zstd {
                return Err(BagError::no_bag(path, "it is compressed twice; unpack it with `zstd -d`"));
            }
            self.file(&unpacked, &mut source).map_err(|error| unpacked_is(error, path))?;
            fs::remove_file(&unpacked).map_err(BagError::write(&unpacked))?;
        }
        Ok(())
    }

    /// Reads the file of `source`, or its decompressed content.
    fn file(&mut self, path: &Path, source: &mut Source<'_>) -> Result<(), BagError> {
        self.known.clear();
        if form_of(path)? == Form::Sqlite3 {
            let mut database = Database::open(path)?;
            // `define` gets a message of the topic, so topics without messages come last.
            database.read(&mut |message| self.message(&message, source))?;
            for topic in database.topics() {
                self.id(topic, None)?;
            }
            self.notes.extend_from_slice(database.notes());
            return Ok(());
        }
        let mut reader = FileReader::open(path)?;
        reader.read(&mut |event| match event {
            Event::Topic(topic) => {
                // The address may have been that of another topic.
                self.known.remove(&Arc::as_ptr(topic).addr());
                // `define` gets a message of the topic, so the topic is added with its first one.
                if self.hooks.define.is_none() { self.id(topic, None).map(drop) } else { Ok(()) }
            }
            Event::Message(message) => self.message(&message, source),
            Event::Attachment(attachment) => self.out.attach(&attachment),
            Event::Metadata(name, values) => self.metadata(name, values),
        })?;
        for topic in reader.topics() {
            self.id(topic, None)?;
        }
        let (some, all) = reader.damage();
        self.damages += all;
        self.damage.extend(some.iter().map(|damage| (source.path.to_owned(), damage.clone())));
        Ok(())
    }

    fn metadata(&mut self, name: String, values: BTreeMap<String, String>) -> Result<(), BagError> {
        let record = (name, values);
        if record.0 == OF_ROSBAG2 || self.metadata.contains(&record) {
            return Ok(());
        }
        self.out.write_metadata(&record.0, record.1.clone())?;
        self.metadata.insert(record);
        Ok(())
    }

    fn message(&mut self, message: &Message<'_>, source: &mut Source<'_>) -> Result<(), BagError> {
        if !(self.hooks.go_on)() {
            return Err(BagError::Interrupted);
        }
        if !self.hooks.span_ns.contains(&message.stamp.log_ns) {
            return Ok(());
        }
        let guess = || message.topic.encoding == CDR && is_compressed(message.cdr);
        let cdr = if source.packs_messages.unwrap_or_else(guess) {
            source.allowance.message(source.path, message.cdr, &mut source.unpacked)?;
            &*source.unpacked
        } else {
            message.cdr
        };
        let known = self.known.get(&Arc::as_ptr(message.topic).addr()).copied();
        let id = match known {
            Some(id) => id,
            None => self.id(message.topic, Some(cdr))?,
        };
        let Some(id) = id else { return Ok(()) };
        self.unseen += cdr.len() as u64;
        if self.unseen >= STEP {
            room(&self.folder.join("bag"), self.unseen.max(STEP))?;
            self.unseen = 0;
        }
        match &mut self.out {
            Out::Mcap(writer) => writer.write(id, message.stamp, cdr),
            Out::Sqlite3(writer, _) => {
                let stamp = message.stamp;
                self.unkept += u64::from(stamp.sequence != 0 || stamp.publish_ns != stamp.log_ns);
                writer.write(id, stamp, cdr)
            }
        }
    }

    /// The id of a topic in the new bag, to which it is added if it is new. `None`: it is not wanted.
    fn id(&mut self, topic: &Arc<Topic>, cdr: Option<&[u8]>) -> Result<Option<TopicId>, BagError> {
        let address = Arc::as_ptr(topic).addr();
        if let Some(id) = self.known.get(&address) {
            return Ok(*id);
        }
        let id = if (self.hooks.wants)(topic) { Some(self.wanted(topic, cdr)?) } else { None };
        self.known.insert(address, id);
        Ok(id)
    }

    fn wanted(&mut self, topic: &Topic, cdr: Option<&[u8]>) -> Result<TopicId, BagError> {
        let mut key = topic.clone();
        if let Out::Sqlite3(..) = self.out {
            // SQLite has one row for a topic, so the channels of its publishers are joined.
            key.qos.clear();
            if key.metadata.remove(PUBLISHER).is_some() {
                self.are_publishers_lost = true;
            }
        }
        if key.type_hash.is_empty() {
            let names = (key.name.clone(), key.type_name.clone());
            key.type_hash = self.type_hashes.get(&names).cloned().unwrap_or_default();
        }
        if let Some(id) = self.ids.get(&key) {
            if let Out::Sqlite3(writer, _) = &mut self.out {
                writer.add_qos(*id, &topic.qos);
            }
            return Ok(*id);
        }
        let new = self.as_written(Topic { qos: topic.qos.clone(), ..key.clone() }, cdr);
        let id = self.out.add_topic(new)?;
        self.ids.insert(key, id);
        Ok(id)
    }

    fn as_written(&mut self, mut topic: Topic, cdr: Option<&[u8]>) -> Topic {
        let Some(define) = &mut self.hooks.define else { return topic };
        topic.qos = in_words(&topic.qos).unwrap_or_else(|error| {
            let (name, error) = (&topic.name, error.lines().next().unwrap_or_default());
            self.notes.push(format!("{name}: its QoS cannot be read, so it is left out: {error}"));
            String::new()
        });
        if topic.encoding == CDR && topic.definition.as_ref().is_none_or(|known| known.data.is_empty()) {
            match define(&topic, cdr) {
                None => {
                    let Topic { name, type_name, .. } = &topic;
                    self.notes.push(format!("{name}: the definition of {type_name} is not known"));
                }
                known => topic.definition = known,
            }
        }
        topic
    }

    fn finish(mut self) -> Result<Converted, BagError> {
        let files = match self.out {
            Out::Mcap(writer) => writer.finish(BTreeMap::new())?.files,
            Out::Sqlite3(writer, custom_data) => {
                if self.unkept > 0 {
                    let unkept = self.unkept;
                    self.notes.push(format!(
                        "{unkept} messages lose their time of publication and sequence number: sqlite3 keeps the time of reception alone"
                    ));
                }
                if self.are_publishers_lost {
                    self.notes.push("sqlite3 does not keep which publisher a message is from".to_owned());
                }
                let twice = writer.twice.keys().map(|name| {
                    format!("two topics have different definitions of {name}: sqlite3 keeps the first one")
                });
                self.notes.extend(twice);
                writer.finish(&custom_data)?
            }
        };
        Ok(Converted { files, damage: self.damage, damages: self.damages, notes: self.notes })
    }
}

/// Makes errors name the compressed file.
fn unpacked_is(error: BagError, packed: &Path) -> BagError {
    match error {
        BagError::NoBag { reason, .. } => {
            BagError::no_bag(packed, format!("what is compressed in it: {reason}"))
        }
        other => other,
    }
}

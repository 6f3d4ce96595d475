// SPDX-License-Identifier: MIT OR Apache-2.0
//! Converts bags of rosbag2, in any storage and compression, to the wanted storage.

use crate::metadata::custom;
use crate::parts::{Form, Parts, form_of, is_compressed, parts_of};
use crate::qos::in_words;
use crate::reader::{Damage, Event, FileReader, FileSummary, Message};
use crate::sqlite::{Database, SqliteWriter};
use crate::unpack::{Allowance, room, unpack_file};
use crate::writer::{Options, TopicId, Writer};
use crate::{BagError, Storage, Topic, index_of};
use rustix::fs::{CWD, RenameFlags, renameat_with};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// How often is looked whether there is room.
const STEP: u64 = 16 << 20;

/// Finds the definition of a topic's type, with a message of the topic, if there is one.
type Define<'h> = dyn FnMut(&Topic, Option<&[u8]>) -> Option<String> + 'h;

/// The callbacks of [`convert`].
pub struct Hooks<'h> {
    /// Called for definitions that the bag itself does not contain.
    pub define: &'h mut Define<'h>,
    /// Called with each file before it is read.
    pub tell: &'h mut dyn FnMut(&Path),
    /// Called at each message; `false` stops the conversion.
    pub go_on: &'h mut dyn FnMut() -> bool,
}

/// The result of a conversion.
#[derive(Clone, Debug)]
pub struct Converted {
    /// Its files.
    pub files: Vec<FileSummary>,
    /// The damaged parts of the bags that were read; all undamaged parts were converted.
    pub damage: Vec<(PathBuf, Damage)>,
    /// Sentences about what could not be kept or was not as it should be.
    pub notes: Vec<String>,
}

/// Writes what is in `bags`, folders of rosbag2 or files of them, into a new bag in the folder `to`: MCAP or SQLite, compressed as a whole,
/// message by message or not. Messages, their order, their times, QoS, hashes and definitions of types are kept.
///
/// # Errors
/// A bag cannot be read, or the new one cannot be written. Then there is no new bag: it is written to a temporary path and renamed when it
/// is complete.
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
    all.iter().flat_map(|parts| &parts.files).try_for_each(|file| form_of(file).map(drop))?;
    let work = Work::create(to)?;
    let name = to.file_name().map_or("bag".into(), |name| name.to_string_lossy().into_owned());
    let out = match storage {
        Storage::Mcap => {
            Out::Mcap(Box::new(Writer::create_in(&work.folder, &name, options, BTreeMap::new())?))
        }
        Storage::Sqlite3 => Out::Sqlite3(Box::new(SqliteWriter::create(&work.folder, &name, options)?)),
    };
    let (known, ids, type_hashes) = (HashMap::new(), HashMap::new(), BTreeMap::new());
    let (said, damage, notes) = (BTreeMap::new(), Vec::new(), Vec::new());
    let (folder, unkept, unseen) = (work.folder.clone(), 0, STEP);
    let differing = BTreeSet::new();
    let conversion = Conversion {
        folder,
        out,
        hooks,
        known,
        ids,
        differing,
        type_hashes,
        said,
        damage,
        notes,
        unkept,
        unseen,
    };
    let converted = conversion.run(all).map_err(|error| match error {
        // Nothing is kept of what is whole up to there.
        BagError::Full { bytes, .. } | BagError::NoRoom { bytes, .. } => {
            BagError::NoRoom { path: to.to_owned(), bytes }
        }
        other => other,
    })?;
    let files = work.keep(to, converted.files)?;
    Ok(Converted { files, ..converted })
}

/// Where it is written, which is removed unless it is [kept](Self::keep).
struct Work {
    folder: PathBuf,
}

impl Work {
    fn create(to: &Path) -> Result<Self, BagError> {
        let parent = to.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::create_dir_all(parent).map_err(BagError::write(parent))?;
        let name = to.file_name().unwrap_or_default().to_string_lossy();
        let folder = parent.join(format!(".{name}.{}.unfinished", std::process::id()));
        fs::create_dir(&folder).map_err(BagError::write(&folder))?;
        Ok(Work { folder })
    }

    /// It is what it was written for, if nothing came there meanwhile.
    fn keep(self, to: &Path, files: Vec<FileSummary>) -> Result<Vec<FileSummary>, BagError> {
        let renamed = match renameat_with(CWD, &self.folder, CWD, to, RenameFlags::NOREPLACE) {
            // File systems that cannot do that refuse to replace a folder that has something in it.
            Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => fs::rename(&self.folder, to),
            other => other.map_err(Into::into),
        };
        renamed.map_err(|source| match source.kind() {
            std::io::ErrorKind::AlreadyExists => BagError::Exists(to.to_owned()),
            _ => BagError::Write { path: to.to_owned(), source },
        })?;
        let moved = |file: FileSummary| FileSummary { path: to.join(file.name()), ..file };
        Ok(files.into_iter().map(moved).collect())
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        // After `keep` there is nothing of this name.
        let _ = fs::remove_dir_all(&self.folder);
    }
}

enum Out {
    Mcap(Box<Writer>),
    Sqlite3(Box<SqliteWriter>),
}

impl Out {
    fn add_topic(&mut self, topic: Topic) -> TopicId {
        match self {
            Out::Mcap(writer) => writer.add_topic(topic),
            Out::Sqlite3(writer) => writer.add_topic(topic),
        }
    }

    fn declare(&mut self, id: TopicId) -> Result<(), BagError> {
        match self {
            Out::Mcap(writer) => writer.declare(id),
            Out::Sqlite3(writer) => writer.declare(id),
        }
    }
}

struct Conversion<'h> {
    /// The folder that is written.
    folder: PathBuf,
    out: Out,
    hooks: Hooks<'h>,
    /// The topics of what is read, by their addresses, which are not others' as long as they are here.
    known: HashMap<usize, (Arc<Topic>, TopicId)>,
    /// As they are written, with the QoS of whichever was first.
    ids: HashMap<Topic, (TopicId, String)>,
    /// Topics of which others have another QoS.
    differing: BTreeSet<String>,
    /// What `metadata.yaml` of the bag that is read says.
    type_hashes: BTreeMap<(String, String), String>,
    /// What the bags say of themselves.
    said: BTreeMap<String, String>,
    damage: Vec<(PathBuf, Damage)>,
    notes: Vec<String>,
    /// Messages with a number or a time of publication, which SQLite has no column for.
    unkept: u64,
    /// Bytes that were written since it was looked how much room there is.
    unseen: u64,
}

/// Where messages are from, and how they are packed.
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
        self.said.extend(custom(parts.custom_data));
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
            unpack_file(path, &unpacked, self.hooks.go_on)?;
            let form = form_of(&unpacked).map_err(|error| unpacked_is(error, path))?;
            if form == Form::Zstd {
                let reason = "it is compressed twice; unpack it with `zstd -d`".to_owned();
                return Err(BagError::NoBag { path: path.clone(), reason });
            }
            self.file(&unpacked, &mut source).map_err(|error| unpacked_is(error, path))?;
            fs::remove_file(&unpacked).map_err(BagError::write(&unpacked))?;
        }
        Ok(())
    }

    /// Reads a file that is `source`, or what is unpacked of it.
    fn file(&mut self, path: &Path, source: &mut Source<'_>) -> Result<(), BagError> {
        // What is read of the next file may come to lie where this one's was.
        self.known.clear();
        if form_of(path)? == Form::Sqlite3 {
            let mut database = Database::open(path)?;
            database.read(&mut |message| self.message(&message, source))?;
            for topic in database.topics() {
                self.id(topic, None)?;
            }
            self.notes.extend_from_slice(database.notes());
            return Ok(());
        }
        let mut reader = FileReader::open(path)?;
        reader.read(&mut |event| match event {
            Event::Message(message) => self.message(&message, source),
            Event::Metadata(name, values) => {
                // Later files of a recording say all that earlier ones do. rosbag2 has its metadata.yaml there.
                if name != "rosbag2" {
                    self.said.extend(values.into_iter().map(|(key, value)| (format!("{name}/{key}"), value)));
                }
                Ok::<_, BagError>(())
            }
        })?;
        let (some, _) = reader.damage();
        self.damage.extend(some.iter().map(|damage| (source.path.to_owned(), damage.clone())));
        // Those without a message are in the index alone.
        if let Some((summary, _)) = index_of(path)? {
            for (topic, _) in summary.topics.into_values() {
                self.id(&Arc::new(topic), None)?;
            }
        }
        Ok(())
    }

    fn message(&mut self, message: &Message<'_>, source: &mut Source<'_>) -> Result<(), BagError> {
        if !(self.hooks.go_on)() {
            return Err(BagError::Interrupted);
        }
        let is_packed = source.packs_messages.unwrap_or_else(|| is_compressed(message.cdr));
        let cdr = if is_packed {
            source.allowance.message(source.path, message.cdr, &mut source.unpacked)?;
            &*source.unpacked
        } else {
            message.cdr
        };
        let known = self.known.get(&Arc::as_ptr(message.topic).addr()).map(|(_, id)| *id);
        let id = match known {
            Some(id) => id,
            None => self.id(message.topic, Some(cdr))?,
        };
        self.unseen += cdr.len() as u64;
        if self.unseen >= STEP {
            room(&self.folder.join("bag"), self.unseen.max(STEP))?;
            self.unseen = 0;
        }
        match &mut self.out {
            Out::Mcap(writer) => writer.write(id, message.stamp, cdr),
            Out::Sqlite3(writer) => {
                let stamp = message.stamp;
                self.unkept += u64::from(stamp.sequence != 0 || stamp.publish_ns != stamp.log_ns);
                writer.write(id, stamp, cdr)
            }
        }
    }

    /// The topic as it is written, which is in the bag from now on.
    fn id(&mut self, topic: &Arc<Topic>, cdr: Option<&[u8]>) -> Result<TopicId, BagError> {
        let mut key = Topic { qos: String::new(), ..Topic::clone(topic) };
        if key.type_hash.is_empty() {
            let names = (key.name.clone(), key.type_name.clone());
            key.type_hash = self.type_hashes.get(&names).cloned().unwrap_or_default();
        }
        let id = match self.ids.get(&key) {
            Some((id, qos)) => {
                if *qos != topic.qos {
                    self.differing.insert(topic.name.clone());
                }
                *id
            }
            None => {
                let new = self.as_written(&key, &topic.qos, cdr);
                let id = self.out.add_topic(new);
                self.out.declare(id)?;
                self.ids.insert(key, (id, topic.qos.clone()));
                id
            }
        };
        self.known.insert(Arc::as_ptr(topic).addr(), (topic.clone(), id));
        Ok(id)
    }

    fn as_written(&mut self, topic: &Topic, qos: &str, cdr: Option<&[u8]>) -> Topic {
        let (name, of_type) = (&topic.name, &topic.type_name);
        let qos = in_words(qos).unwrap_or_else(|error| {
            let error = error.lines().next().unwrap_or_default();
            self.notes.push(format!("{name}: its QoS cannot be read, so it is left out: {error}"));
            String::new()
        });
        let definition = topic.definition.clone().filter(|text| !text.is_empty());
        let definition = definition.or_else(|| (self.hooks.define)(topic, cdr));
        if definition.is_none() {
            self.notes.push(format!("{name}: the definition of {of_type} is not known"));
        }
        Topic { qos, definition, ..topic.clone() }
    }

    fn finish(mut self) -> Result<Converted, BagError> {
        let differ =
            |name: &String| format!("{name}: its QoS differs between the files: that of the first is kept");
        self.notes.extend(self.differing.iter().map(differ));
        let files = match self.out {
            Out::Mcap(writer) => writer.finish(self.said)?.files,
            Out::Sqlite3(writer) => {
                if self.unkept > 0 {
                    let unkept = self.unkept;
                    self.notes.push(format!(
                        "{unkept} messages lose their time of publication and sequence number: sqlite3 keeps the time of reception alone"
                    ));
                }
                let twice = writer.twice.keys().map(|name| {
                    format!("two topics have different definitions of {name}: sqlite3 keeps the first one")
                });
                self.notes.extend(twice);
                writer.finish(&self.said)?
            }
        };
        Ok(Converted { files, damage: self.damage, notes: self.notes })
    }
}

/// Errors name the file that was there before.
fn unpacked_is(error: BagError, packed: &Path) -> BagError {
    match error {
        BagError::NoBag { reason, .. } => {
            BagError::NoBag { path: packed.to_owned(), reason: format!("what is compressed in it: {reason}") }
        }
        other => other,
    }
}

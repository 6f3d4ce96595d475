// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which files a bag of rosbag2 consists of, by its `metadata.yaml`, and how its messages are packed.

use crate::BagError;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::Read;
use std::path::{Component, Path, PathBuf};

/// The bytes with which every MCAP file begins and ends.
pub(crate) const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// The bytes with which every SQLite database begins.
const SQLITE_MAGIC: &[u8; 16] = b"SQLite format 3\0";
/// The bytes with which the output of zstd begins; no CDR begins with them.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
/// The maximum length of a `metadata.yaml`.
const MOST_METADATA: u64 = 64 << 20;
/// From this version on paths are relative to the folder that the file is in.
const PATHS_OF_FOLDER: u32 = 4;

/// The format of a file, detected by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    Mcap,
    Sqlite3,
    /// Compressed as a whole: its format is known after decompression.
    Zstd,
}

/// A bag that any tool wrote.
#[derive(Debug, Default)]
pub struct Parts {
    /// The files, in their order.
    pub files: Vec<PathBuf>,
    /// Whether each message is compressed. `None`: not stated; the messages themselves show it.
    pub packs_messages: Option<bool>,
    /// Hashes of types, by names of topics and types: not every writer has them in the files.
    pub type_hashes: BTreeMap<(String, String), String>,
    /// The user's custom data in `metadata.yaml`.
    pub custom_data: BTreeMap<String, String>,
    /// Deviations from the format.
    pub notes: Vec<String>,
}

#[derive(Deserialize)]
struct Document {
    rosbag2_bagfile_information: Information,
}

#[derive(Deserialize)]
struct Information {
    version: u32,
    #[serde(default)]
    storage_identifier: String,
    relative_file_paths: Vec<String>,
    #[serde(default)]
    compression_format: String,
    #[serde(default)]
    compression_mode: String,
    #[serde(default)]
    custom_data: Option<BTreeMap<String, String>>,
    #[serde(default)]
    topics_with_message_count: Vec<Counted>,
}

#[derive(Deserialize)]
struct Counted {
    topic_metadata: Described,
}

#[derive(Deserialize)]
struct Described {
    name: String,
    #[serde(rename = "type")]
    type_name: String,
    #[serde(default)]
    type_description_hash: String,
}

/// Whether a message is compressed by itself, an option of rosbag2: [`convert`](crate::convert()) decompresses it.
pub fn is_compressed(message: &[u8]) -> bool {
    message.starts_with(&ZSTD_MAGIC)
}

/// Linux's number of an error of the disk.
pub(crate) const EIO: i32 = 5;

/// Whether an MCAP file has no beginning: its writer was killed, or the disk was full or lost power, before that was written.
fn is_headless(path: &Path, begin: &[u8]) -> bool {
    let begin = &begin[..begin.len().min(MAGIC.len())];
    let is_short = begin.len() < MAGIC.len() && MAGIC.starts_with(begin);
    path.extension().is_some_and(|end| end == "mcap") && (is_short || begin.iter().all(|byte| *byte == 0))
}

/// A file, open for reading, and its length in bytes.
pub(crate) fn opened(path: &Path) -> Result<(File, u64), BagError> {
    let file = File::open(path).map_err(BagError::read(path))?;
    let metadata = file.metadata().map_err(BagError::read(path))?;
    match metadata.is_file() {
        true => Ok((file, metadata.len())),
        false => Err(BagError::no_bag(path, "it is not a file")),
    }
}

/// The format of a file; a `.mcap` file whose beginning was never written is MCAP, too.
///
/// # Errors
/// It cannot be read, or has none of these formats.
pub fn form_of(path: &Path) -> Result<Form, BagError> {
    let (file, _) = opened(path)?;
    let mut begin = Vec::new();
    match file.take(SQLITE_MAGIC.len() as u64).read_to_end(&mut begin) {
        // Data behind a damaged sector may still be found.
        Err(error) if error.raw_os_error() == Some(EIO) => begin.clear(),
        read => _ = read.map_err(BagError::read(path))?,
    }
    if begin.starts_with(MAGIC) || is_headless(path, &begin) {
        Ok(Form::Mcap)
    } else if begin.starts_with(SQLITE_MAGIC) {
        Ok(Form::Sqlite3)
    } else if begin.starts_with(&ZSTD_MAGIC) {
        Ok(Form::Zstd)
    } else if begin.is_empty() {
        Err(BagError::no_bag(path, "it is empty"))
    } else {
        Err(BagError::no_bag(path, "it begins neither as MCAP nor as SQLite nor as what zstd compressed"))
    }
}

/// The parts of a bag: the files that `metadata.yaml` names, or without one the files of the folder; or a file alone.
///
/// # Errors
/// There is no bag, or its `metadata.yaml` names a file that does not exist or is outside of the folder.
pub fn parts_of(path: &Path) -> Result<Parts, BagError> {
    if !fs::metadata(path).map_err(BagError::read(path))?.is_dir() {
        return Ok(Parts { files: vec![path.to_owned()], ..Parts::default() });
    }
    let described = path.join("metadata.yaml");
    let parts = match File::open(&described) {
        Ok(file) => described_parts(path, &described, file)?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Parts {
            files: files_in(path)?,
            notes: vec![format!("'{}' is not there: what is in the folder is taken", described.display())],
            ..Parts::default()
        },
        Err(error) => return Err(BagError::read(&described)(error)),
    };
    parts.files.iter().try_for_each(|file| form_of(file).map(drop))?;
    Ok(parts)
}

/// The custom data of a folder's `metadata.yaml`.
///
/// # Errors
/// It cannot be read, or is not as rosbag2 writes it.
pub fn custom_data_of(folder: &Path) -> Result<BTreeMap<String, String>, BagError> {
    let path = folder.join("metadata.yaml");
    let file = File::open(&path).map_err(BagError::read(&path))?;
    Ok(information(&path, file)?.custom_data.unwrap_or_default())
}

fn information(described: &Path, file: File) -> Result<Information, BagError> {
    let mut text = String::new();
    file.take(MOST_METADATA + 1).read_to_string(&mut text).map_err(BagError::read(described))?;
    if text.len() as u64 > MOST_METADATA {
        return Err(BagError::no_bag(described, format!("it is longer than {MOST_METADATA} bytes")));
    }
    let document: Document = serde_saphyr::from_str(&text).map_err(|error| {
        let first = error.to_string().lines().next().unwrap_or_default().to_owned();
        BagError::no_bag(described, format!("{first}; moved away, what is in the folder is taken"))
    })?;
    Ok(document.rosbag2_bagfile_information)
}

fn described_parts(folder: &Path, described: &Path, file: File) -> Result<Parts, BagError> {
    let wrong = |reason: String| BagError::no_bag(described, reason);
    let information = information(described, file)?;
    let mode = information.compression_mode.to_ascii_lowercase();
    if !matches!(&*mode, "" | "none" | "file" | "message" | "storage") {
        return Err(wrong(format!("the compression mode '{mode}' is unknown: none, file or message")));
    }
    if matches!(&*mode, "file" | "message") && information.compression_format != "zstd" {
        let format = information.compression_format;
        return Err(wrong(format!("the compression '{format}' is unknown: rosbag2 has zstd alone")));
    }
    if information.relative_file_paths.is_empty() {
        return Err(wrong("it names no file".to_owned()));
    }
    let mut files = Vec::new();
    for name in &information.relative_file_paths {
        let relative = Path::new(name);
        let relative = if information.version < PATHS_OF_FOLDER {
            // The path begins with the folder, which may have been renamed.
            relative.file_name().map_or(relative, Path::new)
        } else {
            relative
        };
        let is_inside = relative.components().all(|part| matches!(part, Component::Normal(_)));
        if !is_inside || relative.as_os_str().is_empty() {
            return Err(wrong(format!("it names '{name}', which is outside of its folder")));
        }
        let path = folder.join(relative);
        if !path.exists() {
            return Err(wrong(format!(
                "it names '{name}', which is not there; without metadata.yaml what is there is taken"
            )));
        }
        form_of(&path).map_err(|error| match error {
            BagError::NoBag { path, reason } => {
                let storage = &information.storage_identifier;
                BagError::NoBag { path, reason: format!("{reason}; its storage is called '{storage}'") }
            }
            other => other,
        })?;
        files.push(path);
    }
    let topics = information.topics_with_message_count.into_iter().map(|topic| topic.topic_metadata);
    let type_hashes =
        topics.map(|topic| ((topic.name, topic.type_name), topic.type_description_hash)).collect();
    let custom_data = information.custom_data.unwrap_or_default();
    // A recorder that was killed had not named its last file yet.
    let bare = |file: &PathBuf| file.to_string_lossy().trim_end_matches(".zstd").to_owned();
    // Decompressed files may be beside those that are named.
    let named: BTreeSet<_> = files.iter().map(bare).collect();
    let unnamed = files_in(folder).unwrap_or_default().into_iter();
    let end = |file: &Path| stem_and_end(file).map(|(_, end)| end);
    // A file of another kind is a converted copy; an empty file has no messages.
    let is_part = |file: &PathBuf| {
        !named.contains(&bare(file))
            && files.iter().any(|named| end(named) == end(file))
            && fs::metadata(file).is_ok_and(|file| file.len() > 0)
            && form_of(file).is_ok()
    };
    let unnamed: Vec<_> = unnamed.filter(is_part).collect();
    let note = |file: &PathBuf| format!("'{}' is taken, which metadata.yaml does not name", file.display());
    let notes = unnamed.iter().map(note).collect();
    files.extend(unnamed);
    Ok(Parts { files, packs_messages: Some(mode == "message"), type_hashes, custom_data, notes })
}

/// The files of a folder that have a bag's names, in the order of their numbers.
fn files_in(folder: &Path) -> Result<Vec<PathBuf>, BagError> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).map_err(BagError::read(folder))? {
        let file = entry.map_err(BagError::read(folder))?.path();
        if stem_and_end(&file).is_some() {
            files.push(file);
        }
    }
    if files.is_empty() {
        let reason = "there is neither metadata.yaml nor a .mcap or .db3 file in it";
        return Err(BagError::no_bag(folder, reason));
    }
    in_order(&mut files);
    Ok(files)
}

/// Sorts files by the numbers in their names.
pub(crate) fn in_order(files: &mut [PathBuf]) {
    files.sort_by_cached_key(|file| {
        let number = stem_and_end(file).and_then(|(stem, _)| stem.rsplit('_').next()?.parse::<u64>().ok());
        (number, file.clone())
    });
}

/// The name of a bag's file, divided in front of its end; both may have dots.
fn stem_and_end(file: &Path) -> Option<(String, &'static str)> {
    let name = file.file_name()?.to_string_lossy();
    let of = |end: &'static str| Some((name.strip_suffix(end)?.to_owned(), end));
    [".mcap", ".db3", ".mcap.zstd", ".db3.zstd"].into_iter().find_map(of)
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Makes a valid bag of what a killed process, a full disk or a bad sector left.

use crate::metadata::write_metadata;
use crate::reader::{Event, FileReader, FileSummary, files_of};
use crate::writer::{Open, TopicId};
use crate::{BagError, Damage, Options, Topic};
use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A file of a bag that was recovered.
#[derive(Clone, Debug)]
pub struct Recovered {
    /// Its content now.
    pub summary: FileSummary,
    /// The damage found; if empty, the file is unchanged.
    pub damage: Vec<Damage>,
    /// The path of the original file, if it was damaged.
    pub before: Option<PathBuf>,
}

/// Replaces each damaged file by a new one with all its undamaged messages, and writes the folder's `metadata.yaml` again. The original
/// file is kept next to it as `.damaged`: other tools may be able to read more of it. `tell` is called with each file before it is read.
///
/// # Errors
/// There is no bag; a file cannot be read or written: then it is unchanged.
pub fn recover(path: &Path, tell: &mut dyn FnMut(&Path)) -> Result<Vec<Recovered>, BagError> {
    let mut files = Vec::new();
    for file in files_of(path)? {
        tell(&file);
        files.push(one(&file)?);
    }
    if path.is_dir() {
        let summaries: Vec<_> = files.iter().map(|file| file.summary.clone()).collect();
        write_metadata(path, &summaries)?;
    }
    Ok(files)
}

fn one(path: &Path) -> Result<Recovered, BagError> {
    let mut reader = FileReader::open(path)?;
    reader.read(&mut |_| Ok::<_, BagError>(()))?;
    let summary = reader.summary();
    let damage = reader.damage().0.to_vec();
    if damage.is_empty() {
        return Ok(Recovered { summary, damage, before: None });
    }
    let unfinished = path.with_extension("mcap.recovering");
    // Of a recovery that was killed.
    let _ = fs::remove_file(&unfinished);
    let before = path.with_extension("mcap.damaged");
    let in_place = || fs::rename(path, &before).and_then(|()| fs::rename(&unfinished, path));
    let written = again(path, &unfinished, &summary);
    let renamed = written.and_then(|summary| in_place().map(|()| summary).map_err(BagError::write(path)));
    match renamed {
        Ok(summary) => {
            let summary = FileSummary { path: path.to_owned(), ..summary };
            Ok(Recovered { summary, damage, before: Some(before) })
        }
        Err(error) => {
            let _ = fs::remove_file(&unfinished);
            Err(error)
        }
    }
}

fn again(path: &Path, to: &Path, summary: &FileSummary) -> Result<FileSummary, BagError> {
    let mut out =
        Open::create(to, Options { compression: summary.compression, ..Options::default() }, Arc::default())?;
    let (mut ids, mut topics) = (HashMap::<Arc<Topic>, TopicId>::new(), Vec::<Topic>::new());
    FileReader::open(path)?.read(&mut |event| match event {
        Event::Metadata(name, metadata) => out.say(&name, metadata),
        Event::Message(message) => {
            let id = *ids.entry(message.topic.clone()).or_insert_with(|| {
                topics.push(Topic::clone(message.topic));
                TopicId(topics.len() - 1)
            });
            out.write(id, message.topic, message.stamp, message.cdr)
        }
    })?;
    out.finish(&topics)
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writes a new bag from messages of other bags.

use crate::reader::{Damage, Event, FileReader, Message, files_of};
use crate::writer::{Finished, Options, TopicId, Writer};
use crate::{BagError, Topic};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Writes the `wanted` messages of bags into a new bag, bag after bag, with the metadata of each; also returns the damage found in them.
/// `tell` is called with each file before it is read.
///
/// # Errors
/// A bag cannot be read, or the new one cannot be written. If the disk is full, the new bag is valid up to there; otherwise it has to
/// be removed.
pub fn rewrite(
    bags: &[PathBuf],
    to: &Path,
    options: Options,
    wanted: &mut dyn FnMut(&Message<'_>) -> bool,
    tell: &mut dyn FnMut(&Path),
) -> Result<(Finished, Vec<(PathBuf, Damage)>), BagError> {
    let (mut said, mut damage) = (BTreeMap::new(), Vec::new());
    let mut files = Vec::new();
    for bag in bags {
        files.extend(files_of(bag)?);
    }
    // What is no bag is known before there is a new one.
    files.iter().try_for_each(|file| FileReader::open(file).map(drop))?;
    let mut writer = Writer::create(to, options, BTreeMap::new())?;
    let mut ids = HashMap::<Arc<Topic>, TopicId>::new();
    for file in files {
        tell(&file);
        let mut reader = FileReader::open(&file)?;
        let result = reader.read(&mut |event| match event {
            Event::Metadata(name, values) => {
                // Later files of a recording say all that earlier ones do.
                said.extend(values.into_iter().map(|(key, value)| (format!("{name}/{key}"), value)));
                Ok(())
            }
            Event::Message(message) if wanted(&message) => {
                let known = ids.get(message.topic).copied();
                let id = known.unwrap_or_else(|| writer.add_topic(Topic::clone(message.topic)));
                if known.is_none() {
                    ids.insert(message.topic.clone(), id);
                }
                writer.write(id, message.stamp, message.cdr)
            }
            Event::Message(_) => Ok(()),
        });
        let (some, _) = reader.damage();
        damage.extend(some.iter().map(|damage| (file.clone(), damage.clone())));
        match result {
            Ok(()) => {}
            Err(error @ BagError::Full { .. }) => {
                writer.finish(said)?;
                return Err(error);
            }
            Err(error) => return Err(error),
        }
    }
    Ok((writer.finish(said)?, damage))
}

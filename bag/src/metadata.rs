// SPDX-License-Identifier: MIT OR Apache-2.0
//! `metadata.yaml`, as rosbag2 of ROS 2 Jazzy writes it (version 9).

use crate::qos::in_words;
use crate::reader::FileSummary;
use crate::{BagError, Storage, Topic};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs::{self, File};
use std::io;
use std::path::Path;

/// The properties of a bag that are not in its files.
pub struct Description<'d> {
    pub storage: Storage,
    /// Each message is compressed, by zstd.
    pub packs_messages: bool,
    /// Custom data from other tools.
    pub custom_data: &'d BTreeMap<String, String>,
}

impl<'d> Description<'d> {
    /// The description of an MCAP bag.
    pub fn mcap(custom_data: &'d BTreeMap<String, String>) -> Self {
        Description { storage: Storage::Mcap, packs_messages: false, custom_data }
    }
}

/// Replaces the `metadata.yaml` of a folder, at once or not at all.
pub fn write_metadata(
    folder: &Path,
    description: &Description<'_>,
    files: &[FileSummary],
) -> Result<(), BagError> {
    let path = folder.join("metadata.yaml");
    let unfinished = folder.join("metadata.yaml.unfinished");
    let write = || {
        let mut file = File::create(&unfinished)?;
        io::Write::write_all(&mut file, text(description, files).as_bytes())?;
        // Without this, a crash of the machine may leave an empty file.
        file.sync_all()?;
        fs::rename(&unfinished, &path)
    };
    write().map_err(|source| {
        let _ = fs::remove_file(&unfinished);
        BagError::Write { path, source }
    })
}

/// The content of `metadata.yaml`, as `.db3` files repeat it.
pub fn information(description: &Description<'_>, files: &[FileSummary]) -> String {
    let text = text(description, files);
    let lines = text.lines().skip(1).map(|line| line.strip_prefix("  ").unwrap_or(line));
    lines.flat_map(|line| [line, "\n"]).collect()
}

fn text(description: &Description<'_>, files: &[FileSummary]) -> String {
    let with_messages = || files.iter().filter(|file| file.messages > 0);
    let start_ns = with_messages().map(|file| file.start_ns).min().unwrap_or(0);
    let end_ns = with_messages().map(|file| file.end_ns).max().unwrap_or(0);
    let messages: u64 = files.iter().map(|file| file.messages).sum();
    let mut all = FileSummary::default();
    for (topic, count) in files.iter().flat_map(|file| file.topics.values()) {
        all.count(topic, *count);
    }
    let storage = match description.storage {
        Storage::Mcap => "mcap",
        Storage::Sqlite3 => "sqlite3",
    };
    let mut out = format!("rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: {storage}\n");
    // Writing to a String does not fail.
    let _ = write_all(&mut out, description, files, start_ns, end_ns, messages, all.topics.values());
    out
}

fn write_all<'t>(
    out: &mut String,
    description: &Description<'_>,
    files: &[FileSummary],
    start_ns: u64,
    end_ns: u64,
    messages: u64,
    topics: impl Iterator<Item = &'t (Topic, u64)>,
) -> std::fmt::Result {
    writeln!(out, "  duration:\n    nanoseconds: {}", end_ns - start_ns)?;
    writeln!(out, "  starting_time:\n    nanoseconds_since_epoch: {start_ns}")?;
    writeln!(out, "  message_count: {messages}")?;
    let mut topics = topics.peekable();
    writeln!(out, "  topics_with_message_count:{}", if topics.peek().is_none() { " []" } else { "" })?;
    for (topic, count) in topics {
        writeln!(out, "    - topic_metadata:")?;
        writeln!(out, "        name: {}", quoted(&topic.name))?;
        writeln!(out, "        type: {}", quoted(&topic.type_name))?;
        writeln!(out, "        serialization_format: {}", quoted(&topic.encoding))?;
        // A text that is not a list of profiles is kept in the channel's metadata only.
        let qos = in_words(&topic.qos).unwrap_or_default();
        if qos.is_empty() {
            writeln!(out, "        offered_qos_profiles: []")?;
        } else {
            writeln!(out, "        offered_qos_profiles:")?;
            qos.lines().try_for_each(|line| writeln!(out, "          {line}"))?;
        }
        writeln!(out, "        type_description_hash: {}", quoted(&topic.type_hash))?;
        writeln!(out, "      message_count: {count}")?;
    }
    let (format, mode) = if description.packs_messages { ("zstd", "MESSAGE") } else { ("", "") };
    writeln!(out, "  compression_format: \"{format}\"\n  compression_mode: \"{mode}\"")?;
    let list = |out: &mut String, name: &str| {
        writeln!(out, "  {name}:{}", if files.is_empty() { " []" } else { "" })
    };
    list(out, "relative_file_paths")?;
    files.iter().try_for_each(|file| writeln!(out, "    - {}", quoted(&file.name())))?;
    list(out, "files")?;
    for file in files {
        writeln!(out, "    - path: {}", quoted(&file.name()))?;
        writeln!(out, "      starting_time:\n        nanoseconds_since_epoch: {}", file.start_ns)?;
        writeln!(out, "      duration:\n        nanoseconds: {}", file.end_ns - file.start_ns)?;
        writeln!(out, "      message_count: {}", file.messages)?;
    }
    writeln!(out, "  custom_data:{}", if description.custom_data.is_empty() { " ~" } else { "" })?;
    let mut custom_data = description.custom_data.iter();
    custom_data.try_for_each(|(key, value)| writeln!(out, "    {}: {}", quoted(key), quoted(value)))?;
    writeln!(out, "  ros_distro: jazzy")
}

/// Puts any text into YAML's double quotes.
fn quoted(text: &str) -> String {
    let mut out = String::from('"');
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c.is_control() => {
                let _ = write!(out, "\\U{:08x}", u32::from(c));
            }
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

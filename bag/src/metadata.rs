// SPDX-License-Identifier: MIT OR Apache-2.0
//! `metadata.yaml`, as rosbag2 of ROS 2 Jazzy writes it (version 9).

use crate::reader::FileSummary;
use crate::{BagError, Topic};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;

/// Writes it anew, at once or not at all.
pub fn write_metadata(folder: &Path, files: &[FileSummary]) -> Result<(), BagError> {
    let path = folder.join("metadata.yaml");
    let unfinished = folder.join("metadata.yaml.unfinished");
    let written = fs::write(&unfinished, text(files)).and_then(|()| fs::rename(&unfinished, &path));
    written.map_err(|source| {
        let _ = fs::remove_file(&unfinished);
        BagError::Write { path, source }
    })
}

fn text(files: &[FileSummary]) -> String {
    let with_messages = || files.iter().filter(|file| file.messages > 0);
    let start_ns = with_messages().map(|file| file.start_ns).min().unwrap_or(0);
    let end_ns = with_messages().map(|file| file.end_ns).max().unwrap_or(0);
    let messages: u64 = files.iter().map(|file| file.messages).sum();
    let mut topics: BTreeMap<(&str, &str), (&Topic, u64)> = BTreeMap::new();
    for (topic, count) in files.iter().flat_map(|file| file.topics.values()) {
        topics.entry((&topic.name, &topic.type_name)).or_insert((topic, 0)).1 += count;
    }
    let mut out = String::from("rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n");
    // Writing to a String does not fail.
    let _ = write_all(&mut out, files, start_ns, end_ns, messages, topics.into_values());
    out
}

fn write_all<'t>(
    out: &mut String,
    files: &[FileSummary],
    start_ns: u64,
    end_ns: u64,
    messages: u64,
    topics: impl Iterator<Item = (&'t Topic, u64)>,
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
        writeln!(out, "        serialization_format: cdr")?;
        if topic.qos.is_empty() {
            writeln!(out, "        offered_qos_profiles: []")?;
        } else {
            writeln!(out, "        offered_qos_profiles:")?;
            topic.qos.lines().try_for_each(|line| writeln!(out, "          {line}"))?;
        }
        writeln!(out, "        type_description_hash: {}", quoted(&topic.type_hash))?;
        writeln!(out, "      message_count: {count}")?;
    }
    writeln!(out, "  compression_format: \"\"\n  compression_mode: \"\"")?;
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
    writeln!(out, "  custom_data: ~\n  ros_distro: jazzy")
}

/// A text as YAML's double quotes hold any.
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

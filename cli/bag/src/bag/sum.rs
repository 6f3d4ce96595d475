// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is in the files of a bag, all together.

use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;
use taut_cli::date::date;
use taut_cli::table::{count, write_table};
use tautline_bag::{CDR, FileSummary, Topic};

pub struct Sum {
    pub topics: BTreeMap<(String, String), (Topic, u64)>,
    pub attachments: Vec<String>,
    pub messages: u64,
    pub bytes: u64,
    pub start_ns: u64,
    pub end_ns: u64,
}

impl Sum {
    pub fn of(files: &[FileSummary]) -> Self {
        let with_messages = || files.iter().filter(|file| file.messages > 0);
        let mut topics = BTreeMap::new();
        for (key, (topic, messages)) in files.iter().flat_map(|file| &file.topics) {
            topics.entry(key.clone()).or_insert_with(|| (topic.clone(), 0)).1 += messages;
        }
        Sum {
            topics,
            attachments: files.iter().flat_map(|file| file.attachments.clone()).collect(),
            messages: files.iter().map(|file| file.messages).sum(),
            bytes: files.iter().map(|file| file.bytes).sum(),
            start_ns: with_messages().map(|file| file.start_ns).min().unwrap_or(0),
            end_ns: with_messages().map(|file| file.end_ns).max().unwrap_or(0),
        }
    }

    pub fn seconds(&self) -> f64 {
        self.end_ns.saturating_sub(self.start_ns) as f64 / 1e9
    }

    pub fn json(&self, files: &[FileSummary]) -> Value {
        let topic = |(Topic { name, type_name, type_hash, encoding, .. }, messages): &(Topic, u64)| json!({ "topic": name, "type": type_name, "hash": type_hash, "encoding": encoding, "messages": messages });
        let file = |file: &FileSummary| {
            json!({
                "file": file.name(), "bytes": file.bytes, "messages": file.messages,
                "start_ns": file.start_ns, "end_ns": file.end_ns,
            })
        };
        json!({
            "messages": self.messages, "bytes": self.bytes, "start_ns": self.start_ns, "end_ns": self.end_ns,
            "topics": self.topics.values().map(topic).collect::<Vec<_>>(), "files": files.iter().map(file).collect::<Vec<_>>(),
            "attachments": self.attachments,
        })
    }

    pub fn write(&self, bag: &Path, files: &[FileSummary], out: &mut impl Write) -> io::Result<()> {
        let seconds = self.seconds();
        if !self.topics.is_empty() {
            let row = |(Topic { name, type_name, encoding, .. }, messages): &(Topic, u64)| {
                let hz =
                    if seconds > 0.0 { format!("{:.1}", *messages as f64 / seconds) } else { "-".into() };
                let of_type =
                    if encoding == CDR { type_name.clone() } else { format!("{type_name} ({encoding})") };
                (true, vec![name.clone(), of_type, messages.to_string(), hz])
            };
            write_table(
                &["topic", "type", "messages", "mean/s"],
                2,
                self.topics.values().map(row).collect(),
                out,
            )?;
        }
        let (files, megabytes) = (count(files.len(), "file"), self.bytes as f64 / 1e6);
        write!(out, "{}: {} messages in {files}, {megabytes:.1} MB", bag.display(), self.messages)?;
        match self.messages {
            0 => writeln!(out)?,
            _ => writeln!(out, ", {seconds:.1} s from {} UTC", date(self.start_ns.cast_signed()))?,
        }
        match &*self.attachments {
            [] => Ok(()),
            names => writeln!(out, "attachments: {}", names.join(", ")),
        }
    }
}

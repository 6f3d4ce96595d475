// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reports at the end what was recorded and what was lost: on the terminal, as JSON, and in the file.

use super::bag_writer::Written;
use super::event::Part;
use super::observers::{Before, Observers, RecordedTopic};
use super::reader::{Harvest, Taken};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;
use std::time::Duration;
use taut_cli::table::write_table;
use taut_cli::verb::{Failure, Outcome};
use tautline_bag::BagError;

pub struct Statement {
    rows: Vec<Row>,
    absent: Vec<String>,
    waited: u64,
    time: Duration,
    period: Duration,
}

struct Row {
    topic: RecordedTopic,
    taken: Taken,
    /// Messages that new publishers sent before they were connected.
    missed: u64,
    /// Messages a second of the fastest publisher, in its fastest second.
    peak: u64,
}

impl Row {
    fn new(topic: RecordedTopic, taken: Taken, before: &Before) -> Self {
        // Responses have the numbers of the clients that they go to.
        let is_counted = topic.part != Part::Response;
        let new = taken.ports.iter().filter(|port| is_counted && !before.contains(port.gid));
        let missed = new.map(|port| port.first.saturating_sub(1)).sum();
        let peak = taken.ports.iter().map(|port| port.peak).max().unwrap_or(0);
        Row { topic, taken, missed, peak }
    }

    /// The number of messages that should be in the bag, and are not.
    fn lost(&self) -> u64 {
        self.taken.lost + self.taken.oversized + self.missed
    }

    /// The longest time between two polls that loses no messages.
    fn survives(&self) -> Option<Duration> {
        (self.peak > 0).then(|| Duration::from_secs_f64(self.topic.depth as f64 / self.peak as f64))
    }

    fn json(&self) -> Value {
        let Row { topic, taken, .. } = self;
        json!({
            "topic": topic.topic.name, "type": topic.topic.type_name, "part": topic.part.name(),
            "messages": taken.messages, "bytes": taken.bytes,
            "lost": self.lost(), "overwritten": taken.lost, "before_connected": self.missed, "oversized": taken.oversized,
            "throttled": taken.throttled, "paused": taken.paused, "publishers": taken.ports.len(), "peak_hz": self.peak,
            "depth": topic.depth, "longest_stall_ns": taken.stall_ns,
            "survives_stall_ns": self.survives().map(|time| time.as_nanos() as u64),
        })
    }
}

impl Statement {
    pub fn new(observers: Observers, harvest: Harvest, period: Duration) -> Self {
        let (topics, before, absent) = observers.end();
        let time = Duration::from_nanos(harvest.ended_ns - harvest.began_ns);
        // An observer that the reader did not admit any more took nothing.
        let taken = harvest.topics.into_iter().chain(std::iter::repeat_with(Taken::default));
        let rows = topics.into_iter().zip(taken).map(|(topic, taken)| Row::new(topic, taken, &before));
        Statement { rows: rows.collect(), absent, waited: harvest.waited, time, period }
    }

    pub fn lost(&self) -> u64 {
        self.rows.iter().map(Row::lost).sum()
    }

    /// A record of the last file.
    pub fn for_the_file(&self) -> BTreeMap<String, String> {
        let mut record: BTreeMap<_, _> =
            self.rows.iter().map(|row| (row.topic.name(), row.json().to_string())).collect();
        record.insert("lost".to_owned(), self.lost().to_string());
        record.insert("period_ns".to_owned(), self.period.as_nanos().to_string());
        record
    }

    pub fn print(&self, folder: &Path, written: Outcome<Written>, is_json: bool) -> Outcome {
        let Written { finished, failed: stopped, messages, stall } = written?;
        let finished = finished?;
        let taken: u64 = self.rows.iter().map(|row| row.taken.messages).sum();
        // Messages that were taken and not written: for lack of room on the disk, or because they are no requests of their service.
        let unwritten = taken - messages;
        let lost = self.lost() + unwritten;
        let bytes: u64 = finished.files.iter().map(|file| file.bytes).sum();
        let out = &mut taut_cli::print::stdout();
        let printed = if is_json {
            let report = json!({
                "bag": folder.display().to_string(), "seconds": self.time.as_secs_f64(), "messages": messages, "bytes": bytes,
                "files": finished.files.iter().map(|file| file.name()).collect::<Vec<_>>(), "files_removed": finished.removed,
                "lost": lost, "unwritten": unwritten, "absent": self.absent, "period_ns": self.period.as_nanos() as u64,
                "longest_write_ns": stall.as_nanos() as u64, "budget_exhausted": self.waited,
                "topics": self.rows.iter().map(Row::json).collect::<Vec<_>>(),
            });
            writeln!(out, "{report}")
        } else {
            let (seconds, megabytes) = (self.time.as_secs_f64(), bytes as f64 / 1e6);
            let loss = if lost == 0 { "nothing lost".to_owned() } else { format!("{lost} LOST") };
            let slow = match self.waited {
                0 => String::new(),
                times => format!("the disk was slower than the topics: --budget had no room {times} times\n"),
            };
            let folder = folder.display();
            self.table(out).and_then(|()| {
                writeln!(out, "{folder}: {messages} messages, {megabytes:.1} MB in {seconds:.1} s, {loss}")?;
                write!(out, "{slow}")
            })
        };
        // Errors and losses take precedence over an error of printing.
        if let Some(error) = stopped {
            let recover = match error {
                BagError::Full { .. } => String::new(),
                _ => format!("; `taut bag recover {}` makes a bag of what was written", folder.display()),
            };
            return Err(Failure::unusable(format!("{error}{recover}")));
        }
        if !self.absent.is_empty() {
            return Err(Failure::no(format!(
                "not recorded, for they did not come or could not be: {}",
                self.absent.join(", ")
            )));
        }
        if lost > 0 {
            return Err(Failure::no(format!(
                "{lost} messages are missing; a greater --depth survives longer stalls, a greater --budget slower disks"
            )));
        }
        printed.map_err(Failure::from)
    }

    /// Writes the table of topics.
    pub fn table(&self, out: &mut impl Write) -> io::Result<()> {
        if self.rows.is_empty() {
            return Ok(());
        }
        let head = ["topic", "type", "messages", "lost", "peak/s", "depth", "survives", "longest stall"];
        let ms = |time: Duration| format!("{:.1} ms", time.as_secs_f64() * 1e3);
        let row = |row: &Row| {
            let stall = Duration::from_nanos(row.taken.stall_ns);
            let cells = vec![
                row.topic.name(),
                row.topic.topic.type_name.clone(),
                row.taken.messages.to_string(),
                row.lost().to_string(),
                row.peak.to_string(),
                row.topic.depth.to_string(),
                row.survives().map_or("-".to_owned(), ms),
                ms(stall),
            ];
            (row.lost() == 0, cells)
        };
        write_table(&head, 2, self.rows.iter().map(row).collect(), out)
    }
}

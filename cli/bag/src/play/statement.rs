// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reports at the end what was played, what was not, and how late.

use super::args::PlayArgs;
use super::feeder::{Fed, Part};
use super::player::Played;
use crate::ring::LATCHED_BYTES;
use serde_json::json;
use std::io::{self, Write};
use std::sync::Arc;
use std::time::Duration;
use taut_cli::table::write_table;
use taut_cli::times::Times;
use taut_cli::verb::{Failure, Outcome};
use tautline_bag::Topic;
use tautline_transport::{Qos, TopicType};

/// A topic as it is played.
pub struct Role {
    pub name: String,
    pub topic: Arc<Topic>,
    pub topic_type: TopicType,
    pub qos: Qos,
    pub part: Part,
}

pub struct Statement<'a> {
    pub args: &'a PlayArgs,
    pub roles: &'a [Role],
    /// Topics that cannot be played, with the reason.
    pub unplayable: Vec<String>,
    pub played: Played,
    pub fed: Fed,
    pub is_interrupted: bool,
}

impl Statement<'_> {
    pub fn print(self) -> Outcome {
        let out = &mut taut_cli::print::stdout();
        let printed = if self.args.common.json { self.json(out) } else { self.table(out) };
        // The verdict takes precedence over an error of printing.
        self.verdict()?;
        printed.map_err(Failure::from)
    }

    fn published(&self) -> u64 {
        self.played.published.iter().sum()
    }

    /// One row for each topic, summed over its publishers.
    fn rows(&self) -> Vec<(&Role, u64, u64)> {
        let mut rows: Vec<(&Role, u64, u64)> = Vec::new();
        let counts = self.played.published.iter().zip(&self.fed.unplayable);
        for (role, (published, (unplayable, _))) in self.roles.iter().zip(counts) {
            let is_same = |(row, ..): &&mut (&Role, u64, u64)| {
                row.name == role.name && row.topic.type_name == role.topic.type_name
            };
            match rows.iter_mut().find(is_same) {
                Some(row) => (row.1, row.2) = (row.1 + published, row.2 + unplayable),
                None => rows.push((role, *published, *unplayable)),
            }
        }
        rows
    }

    fn json(&self, out: &mut impl Write) -> io::Result<()> {
        let topic = |(role, published, unplayable): (&Role, u64, u64)| {
            json!({
                "topic": role.name, "recorded_as": role.topic.name, "type": role.topic.type_name, "published": published,
                "unplayable": unplayable,
            })
        };
        let report = json!({
            "bag": self.args.bag.display().to_string(), "published": self.published(), "rate": self.args.rate, "interrupted": self.is_interrupted,
            "late_ms": self.played.late.to_json(), "timer_late_ms": self.played.timer.to_json(),
            "starved": self.played.starved, "refused": self.played.refused, "damaged_parts": self.fed.damaged,
            "topics": self.rows().into_iter().map(topic).collect::<Vec<_>>(), "unplayable_topics": self.unplayable,
        });
        writeln!(out, "{report}")
    }

    fn table(&self, out: &mut impl Write) -> io::Result<()> {
        let row = |(role, published, unplayable): (&Role, u64, u64)| {
            let cells = vec![
                role.name.clone(),
                role.topic.type_name.clone(),
                published.to_string(),
                unplayable.to_string(),
            ];
            (unplayable == 0, cells)
        };
        write_table(
            &["topic", "type", "published", "unplayable"],
            2,
            self.rows().into_iter().map(row).collect(),
            out,
        )?;
        let interrupted = if self.is_interrupted { "interrupted: " } else { "" };
        write!(out, "{interrupted}{} messages", self.published())?;
        let words = |times: &Times| {
            times.ms().map(|[p50, p99, max]| format!("{p50:.3} ms (p50), {p99:.3} (p99), {max:.3} at most"))
        };
        if let Some(late) = words(&self.played.late) {
            write!(out, ", late by {late}")?;
        }
        if let Some(timer) = words(&self.played.timer) {
            write!(out, "; of that the timer: {timer}")?;
        }
        writeln!(out)?;
        if self.played.starved > 0 {
            writeln!(
                out,
                "the disk was slower than the bag: {} messages were not read yet when they were due",
                self.played.starved
            )?;
        }
        Ok(())
    }

    fn verdict(self) -> Outcome {
        if let Some(error) = self.fed.failed {
            return Err(error.into());
        }
        let unplayable: u64 = self.fed.unplayable.iter().map(|(count, _)| count).sum();
        let first = self
            .fed
            .unplayable
            .into_iter()
            .zip(self.roles)
            .find_map(|((_, why), role)| why.map(|why| format!("{}: {why}", role.topic.name)));
        let late = Duration::from_nanos(self.played.late.max_ns());
        let is_late = self.args.max_jitter.filter(|most| late > *most);
        let fault = if let Some(first) = first {
            format!("{unplayable} messages were not played, the first for: {first}")
        } else if self.fed.untold > 0 {
            format!(
                "{} messages of topics that the damaged bag did not tell of before were not played; `taut bag recover` it",
                self.fed.untold
            )
        } else if self.fed.unkept > 0 {
            format!(
                "{} messages that publishers had kept were not played: of more than {} MiB of one publisher the oldest are left out",
                self.fed.unkept,
                LATCHED_BYTES >> 20
            )
        } else if let Some(refusal) = self.played.refusal {
            format!("{} messages were not published, the first for: {refusal}", self.played.refused)
        } else if let Some(first) = self.fed.damage {
            format!("{} parts of the bag are damaged; {first}", self.fed.damaged)
        } else if let Some(first) = self.unplayable.first() {
            format!("{} topics were not played; the first: {first}", self.unplayable.len())
        } else if let Some(most) = is_late {
            format!("a message was {late:?} late, more than {most:?}; see `taut doctor`")
        } else {
            return Ok(());
        };
        Err(Failure::no(fault))
    }
}

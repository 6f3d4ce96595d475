// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is shown while it runs: a line on the terminal that renews itself, or JSON.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::{self, Write};
use tautline_gateway::{Direction, Stats};

pub struct Status {
    is_json: bool,
    /// Draws on a terminal only.
    line: ProgressBar,
}

impl Status {
    pub fn new(is_json: bool) -> Self {
        let line = if is_json { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
        // A template without placeholders that could fail.
        line.set_style(
            ProgressStyle::with_template("{wide_msg}").unwrap_or_else(|_| ProgressStyle::default_spinner()),
        );
        Status { is_json, line }
    }

    pub fn show(&self, stats: &Stats) -> io::Result<()> {
        if self.is_json {
            let text = serde_json::to_string(stats).map_err(io::Error::other)?;
            let mut out = io::stdout().lock();
            writeln!(out, "{text}")?;
            return out.flush();
        }
        self.line.set_message(line(stats));
        self.line.tick();
        Ok(())
    }
}

impl Drop for Status {
    fn drop(&mut self) {
        self.line.finish_and_clear();
    }
}

/// `2 links, 3 nodes elsewhere | out 4 topics 1.2 MB/s 100/s | in 1 topic 80 kB/s 10/s | lost 0, dropped 0`
fn line(stats: &Stats) -> String {
    let way = |direction, name| {
        let of = || stats.topics.iter().filter(move |topic| topic.active && topic.direction == direction);
        // Not `sum`, which begins with -0.
        let bytes = of().map(|topic| topic.reading.bytes_per_s).fold(0.0, |sum, rate| sum + rate);
        let samples = of().map(|topic| topic.reading.samples_per_s).fold(0.0, |sum, rate| sum + rate);
        format!("{name} {} {samples:.0}/s", counted(of().count(), "topic", "topics", rate(bytes)))
    };
    let lost: u64 = stats.topics.iter().map(|topic| topic.reading.lost).sum();
    let dropped: u64 = stats.topics.iter().flat_map(|topic| topic.reading.dropped.values()).sum();
    let mut text = format!(
        "{}, {} elsewhere | {} | {} | lost {lost}, dropped {dropped}",
        counted(stats.links, "link", "links", String::new()).trim_end(),
        counted(stats.remote_nodes, "node", "nodes", String::new()).trim_end(),
        way(Direction::Out, "out"),
        way(Direction::In, "in"),
    );
    let unauthorized: u64 = stats.unauthorized.values().sum();
    if let Some(refusal) = stats.unauthorized.keys().next() {
        text += &format!(" | {unauthorized} unauthorized: {refusal}");
    }
    if let Some((topic, reason)) = stats.not_mirrored.iter().next() {
        text += &format!(" | {} not mirrored: {topic}: {reason}", stats.not_mirrored.len());
    }
    text
}

fn counted(count: usize, one: &str, many: &str, rest: String) -> String {
    format!("{count} {} {rest}", if count == 1 { one } else { many })
}

fn rate(bytes_per_s: f64) -> String {
    match bytes_per_s {
        b if b >= 1e6 => format!("{:.1} MB/s", b / 1e6),
        b if b >= 1e3 => format!("{:.1} kB/s", b / 1e3),
        b => format!("{b:.0} B/s"),
    }
}

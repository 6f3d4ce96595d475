// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is shown while it runs: a line on the terminal that renews itself, or JSON.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::{self, Write};
use tautline_bridge_ros::{Direction, Stats};

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

/// `3 nodes in ROS | to ROS 4 topics 1.2 MB/s 100/s | from ROS 1 topic 80 kB/s 10/s | lost 0, dropped 0`
fn line(stats: &Stats) -> String {
    let way = |direction, name| {
        let of = || stats.topics.iter().filter(move |topic| topic.active && topic.direction == direction);
        // Not `sum`, which begins with -0.
        let bytes = of().map(|topic| topic.numbers.bytes_per_s).fold(0.0, |sum, rate| sum + rate);
        let messages = of().map(|topic| topic.numbers.messages_per_s).fold(0.0, |sum, rate| sum + rate);
        format!("{name} {} {} {messages:.0}/s", counted(of().count(), "topic", "topics"), rate(bytes))
    };
    let lost: u64 = stats.topics.iter().map(|topic| topic.numbers.lost).sum();
    let dropped: u64 = stats.topics.iter().flat_map(|topic| topic.numbers.dropped.values()).sum();
    let mut text = format!(
        "{} in ROS | {} | {} | lost {lost}, dropped {dropped}",
        counted(stats.ros_nodes, "node", "nodes"),
        way(Direction::ToRos, "to ROS"),
        way(Direction::FromRos, "from ROS"),
    );
    if let Some((topic, incompatible)) = stats.incompatible_qos.iter().next() {
        text += &format!(" | incompatible QoS: {topic}: {}", incompatible.last_policy);
    }
    let services = stats.services.iter().filter(|service| service.active).count();
    if services > 0 {
        let failed: u64 = stats.services.iter().flat_map(|service| service.failed.values()).sum();
        text += &format!(" | {}, {failed} requests failed", counted(services, "service", "services"));
    }
    let not_bridged = || stats.not_bridged.iter().chain(&stats.services_not_bridged);
    if let Some((name, reason)) = not_bridged().next() {
        text += &format!(" | {} not bridged: {name}: {reason}", not_bridged().count());
    }
    text
}

fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

fn rate(bytes_per_s: f64) -> String {
    match bytes_per_s {
        b if b >= 1e6 => format!("{:.1} MB/s", b / 1e6),
        b if b >= 1e3 => format!("{:.1} kB/s", b / 1e3),
        b => format!("{b:.0} B/s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_bridge_ros::{TopicNumbers, TopicStats};

    #[test]
    fn a_line_says_what_matters() {
        let numbers =
            TopicNumbers { messages_per_s: 10.0, bytes_per_s: 80e3, lost: 2, ..TopicNumbers::default() };
        let topic = TopicStats {
            topic: "/a".into(),
            ros_topic: "/a".into(),
            type_name: "a/msg/A".into(),
            direction: Direction::FromRos,
            active: true,
            numbers,
        };
        let not_bridged = [("/b".to_owned(), "no".to_owned())].into();
        let stats = Stats { ros_nodes: 1, topics: vec![topic], not_bridged, ..Stats::default() };
        assert_eq!(
            line(&stats),
            "1 node in ROS | to ROS 0 topics 0 B/s 0/s | from ROS 1 topic 80.0 kB/s 10/s | lost 2, dropped 0 | 1 not bridged: /b: no"
        );
    }
}

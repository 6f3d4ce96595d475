// SPDX-License-Identifier: MIT OR Apache-2.0
//! The line that is shown while it runs.

use tautline_gateway::{Direction, Stats};
use tautline_relay::{counted, rate};

/// `2 links, 3 nodes elsewhere | out 4 topics 1.2 MB/s 100/s | in 1 topic 80 kB/s 10/s | lost 0, dropped 0`
pub fn line(stats: &Stats) -> String {
    let way = |direction, name| {
        let of = || stats.topics.iter().filter(move |topic| topic.active && topic.direction == direction);
        // Not `sum`, which begins with -0.
        let bytes = of().map(|topic| topic.reading.bytes_per_s).fold(0.0, |sum, rate| sum + rate);
        let samples = of().map(|topic| topic.reading.samples_per_s).fold(0.0, |sum, rate| sum + rate);
        format!("{name} {} {} {samples:.0}/s", counted(of().count(), "topic", "topics"), rate(bytes))
    };
    let lost: u64 = stats.topics.iter().map(|topic| topic.reading.lost).sum();
    let dropped: u64 = stats.topics.iter().flat_map(|topic| topic.reading.dropped.values()).sum();
    let mut text = format!(
        "{}, {} elsewhere | {} | {} | lost {lost}, dropped {dropped}",
        counted(stats.links, "link", "links"),
        counted(stats.remote_nodes, "node", "nodes"),
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

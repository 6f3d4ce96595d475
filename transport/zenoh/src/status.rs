// SPDX-License-Identifier: MIT OR Apache-2.0
//! The status line.

use tautline_gateway::{Direction, Stats};
use tautline_relay::{counted, passing};

/// `2 links, 3 nodes elsewhere | out 4 topics 1.2 MB/s 100/s | in 1 topic 80 kB/s 10/s | lost 0, dropped 0`
pub fn line(stats: &Stats) -> String {
    let ways = [(Direction::Out, "out"), (Direction::In, "in")];
    let mut text = format!(
        "{}, {} elsewhere | {}",
        counted(stats.links, "link", "links"),
        counted(stats.remote_nodes, "node", "nodes"),
        passing(&stats.topics, ways),
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

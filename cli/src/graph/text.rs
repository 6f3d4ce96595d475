// SPDX-License-Identifier: MIT OR Apache-2.0
//! Output as text, by topic.

use super::picture::{Edge, Picture, Topic, TopicKind, clean};
use crate::table::BAD;
use std::fmt::{self, Write};

/// Writes with colours, which the stream removes if it is not a terminal.
pub fn write(picture: &Picture, text: &mut String) -> fmt::Result {
    for (index, topic) in picture.topics.iter().enumerate() {
        write_topic(picture, index, topic, text)?;
    }
    let has_ends = |index: usize| picture.edges.iter().any(|edge| edge.node == index);
    let alone = (0..picture.nodes.len()).filter(|index| !has_ends(*index));
    let alone: Vec<String> = alone.map(|index| label(picture, index)).collect();
    if !alone.is_empty() {
        line(true, &format!("without any of these: {}", alone.join(", ")), text)?;
        writeln!(text)?;
    }
    picture.caption().into_iter().try_for_each(|(is_good, said)| line(is_good, &said, text))
}

fn write_topic(picture: &Picture, index: usize, topic: &Topic, text: &mut String) -> fmt::Result {
    let rate = topic.rate.text().map_or_else(String::new, |rate| format!("  {rate}"));
    let kind = match topic.kind {
        TopicKind::Topic => String::new(),
        kind => format!("{} ", kind.word()),
    };
    let types = topic.types.join(" and ");
    line(topic.types.len() < 2, &format!("{kind}{}  {types}{rate}", topic.name), text)?;
    let mut edges = picture.edges.iter().filter(|edge| edge.topic == index);
    edges.try_for_each(|edge| write_edge(picture, edge, text))?;
    writeln!(text)
}

fn write_edge(picture: &Picture, edge: &Edge, text: &mut String) -> fmt::Result {
    let qos = if edge.qos.is_empty() { String::new() } else { format!("  {}", edge.qos) };
    let more = edge.lines().iter().map(|line| format!("  {line}")).collect::<String>();
    let (word, node) = (edge.kind.word(), label(picture, edge.node));
    line(!edge.is_bad(), &format!("  {word:<12}  {node}{qos}{more}"), text)
}

fn label(picture: &Picture, index: usize) -> String {
    let node = &picture.nodes[index];
    match &node.name {
        Some(name) => format!("{name} ({})", node.whereabouts()),
        None => format!("{} {}", node.label(), node.whereabouts()),
    }
}

fn line(is_good: bool, line: &str, text: &mut String) -> fmt::Result {
    let line = clean(line);
    match is_good {
        true => writeln!(text, "{line}"),
        false => writeln!(text, "{BAD}{line}{BAD:#}"),
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Output as text, by topic.

use super::picture::{Edge, Picture, Topic, TopicKind, clean};
use crate::table::BAD;

/// Writes with colours, which the stream removes if it is not a terminal.
pub fn write(picture: &Picture) -> String {
    let mut text = String::new();
    for (index, topic) in picture.topics.iter().enumerate() {
        write_topic(picture, index, topic, &mut text);
    }
    let has_ends = |index: usize| picture.edges.iter().any(|edge| edge.node == index);
    let alone = picture.nodes.iter().enumerate().filter(|(index, _)| !has_ends(*index));
    let alone: Vec<String> = alone.map(|(index, _)| label(picture, index)).collect();
    if !alone.is_empty() {
        line(true, &format!("without any of these: {}", alone.join(", ")), &mut text);
        text.push('\n');
    }
    for (is_good, said) in picture.caption() {
        line(is_good, &said, &mut text);
    }
    text
}

fn write_topic(picture: &Picture, index: usize, topic: &Topic, text: &mut String) {
    let rate = topic.rate.text().map_or_else(String::new, |rate| format!("  {rate}"));
    let kind = match topic.kind {
        TopicKind::Topic => String::new(),
        kind => format!("{} ", kind.word()),
    };
    let types = topic.types.join(" and ");
    line(topic.types.len() < 2, &format!("{kind}{}  {types}{rate}", topic.name), text);
    for edge in picture.edges.iter().filter(|edge| edge.topic == index) {
        write_edge(picture, edge, text);
    }
    text.push('\n');
}

fn write_edge(picture: &Picture, edge: &Edge, text: &mut String) {
    let qos = if edge.qos.is_empty() { String::new() } else { format!("  {}", edge.qos) };
    let more = edge.lines().iter().map(|line| format!("  {line}")).collect::<String>();
    line(
        !edge.is_bad(),
        &format!("  {:<12}  {}{qos}{more}", edge.kind.word(), label(picture, edge.node)),
        text,
    );
}

fn label(picture: &Picture, index: usize) -> String {
    let node = &picture.nodes[index];
    match &node.name {
        Some(name) => format!("{name} ({})", node.whereabouts()),
        None => format!("{} {}", node.label(), node.whereabouts()),
    }
}

fn line(is_good: bool, line: &str, text: &mut String) {
    let line = clean(line);
    match is_good {
        true => text.push_str(&line),
        false => text.push_str(&format!("{BAD}{line}{BAD:#}")),
    }
    text.push('\n');
}

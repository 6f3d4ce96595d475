// SPDX-License-Identifier: MIT OR Apache-2.0
//! Output as a Mermaid flowchart.

use super::picture::{Edge, Picture, TopicKind, clean};
use std::fmt::{self, Write};

/// A whole flowchart.
pub fn write(picture: &Picture, chart: &mut String) -> fmt::Result {
    writeln!(chart, "flowchart LR")?;
    let caption = picture.caption();
    writeln!(chart, "  caption[\"{}\"]:::caption", join(caption.into_iter().map(|(_, line)| line)))?;
    for (index, node) in picture.nodes.iter().enumerate() {
        writeln!(chart, "  n{index}(\"{}\"):::node", join(node.text()))?;
    }
    for (index, topic) in picture.topics.iter().enumerate() {
        let class = if topic.kind == TopicKind::Topic { "topic" } else { "service" };
        writeln!(chart, "  t{index}[\"{}\"]:::{class}", join(topic.text()))?;
    }
    picture.edges.iter().try_for_each(|edge| write_edge(edge, chart))?;
    let bad = picture.edges.iter().enumerate().filter(|(_, edge)| edge.is_bad());
    let bad: Vec<String> = bad.map(|(index, _)| index.to_string()).collect();
    if !bad.is_empty() {
        writeln!(chart, "  linkStyle {} stroke:#c01c28,stroke-width:2px,color:#c01c28", bad.join(","))?;
    }
    writeln!(chart, "  classDef node fill:#dbe6f3,stroke:#4c84c4,color:#222831")?;
    writeln!(chart, "  classDef topic fill:#f4f1e6,stroke:#a08a3c,color:#222831")?;
    writeln!(chart, "  classDef service fill:#eeeaf5,stroke:#7d63b0,color:#222831,stroke-dasharray:5 3")?;
    writeln!(chart, "  classDef caption fill:none,stroke:none,text-align:left")
}

fn write_edge(edge: &Edge, chart: &mut String) -> fmt::Result {
    let (from, to) = edge.directed(format!("n{}", edge.node), format!("t{}", edge.topic));
    let arrow = if edge.is_service() { "-.->" } else { "-->" };
    let lines = edge.lines();
    let label = if lines.is_empty() { String::new() } else { format!("|\"{}\"|", join(lines)) };
    writeln!(chart, "  {from} {arrow}{label} {to}")
}

fn join(lines: impl IntoIterator<Item = String>) -> String {
    lines.into_iter().map(|line| escape(&line)).collect::<Vec<_>>().join("<br/>")
}

/// Replaces characters that Mermaid, HTML or Markdown interpret by their numbers.
fn escape(text: &str) -> String {
    let mut escaped = String::new();
    let text: Vec<char> = clean(text).chars().collect();
    for (index, &c) in text.iter().enumerate() {
        let is_inside =
            |at: Option<usize>| at.and_then(|at| text.get(at)).is_some_and(|c| c.is_alphanumeric());
        match c {
            // Within a word, Markdown does not interpret it.
            '_' if is_inside(index.checked_sub(1)) && is_inside(Some(index + 1)) => escaped.push('_'),
            '"' | '#' | '<' | '>' | '&' | '`' | '\\' | '*' | ';' | '{' | '}' | '%' | '_' => {
                escaped.push_str(&format!("#{};", u32::from(c)));
            }
            c => escaped.push(c),
        }
    }
    escaped
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Output in Graphviz's language.

use super::picture::{Edge, Picture, TopicKind, clean};
use std::fmt::{self, Write};

const RED: &str = "#c01c28";

/// A whole `digraph`.
pub fn write(picture: &Picture, dot: &mut String) -> fmt::Result {
    writeln!(dot, "digraph taut {{")?;
    writeln!(dot, "  graph [rankdir=LR, fontname=\"sans-serif\", labelloc=t, labeljust=l];")?;
    writeln!(dot, "  node [fontname=\"sans-serif\", fontsize=11, style=filled];")?;
    writeln!(dot, "  edge [fontname=\"sans-serif\", fontsize=10];")?;
    let caption = picture.caption();
    let lines = caption.iter().map(|(_, line)| format!("{}\\l", escape(line)));
    writeln!(dot, "  label=\"{}\";", lines.collect::<String>())?;
    for (index, node) in picture.nodes.iter().enumerate() {
        let style = if node.name.is_some() { "filled,rounded" } else { "filled,rounded,dashed" };
        let label = join(node.text());
        writeln!(
            dot,
            "  n{index} [shape=box, style=\"{style}\", fillcolor=\"#dbe6f3\", label=\"{label}\"];"
        )?;
    }
    for (index, topic) in picture.topics.iter().enumerate() {
        let look = match topic.kind {
            TopicKind::Topic => "shape=box, fillcolor=\"#f4f1e6\"",
            _ => "shape=box, style=\"filled,dashed\", fillcolor=\"#eeeaf5\"",
        };
        writeln!(dot, "  t{index} [{look}, label=\"{}\"];", join(topic.text()))?;
    }
    picture.edges.iter().try_for_each(|edge| write_edge(edge, dot))?;
    writeln!(dot, "}}")
}

fn write_edge(edge: &Edge, dot: &mut String) -> fmt::Result {
    let (from, to) = edge.directed(format!("n{}", edge.node), format!("t{}", edge.topic));
    let mut with = vec![format!("edgetooltip=\"{}\"", escape(&format!("{} {}", edge.kind.word(), edge.qos)))];
    let lines = edge.lines();
    if !lines.is_empty() {
        with.push(format!("label=\"{}\"", join(lines)));
    }
    if edge.is_service() {
        with.push("style=dashed".into());
    }
    if edge.is_bad() {
        with.push(format!("color=\"{RED}\", fontcolor=\"{RED}\", penwidth=2"));
    }
    writeln!(dot, "  {from} -> {to} [{}];", with.join(", "))
}

fn join(lines: impl IntoIterator<Item = String>) -> String {
    lines.into_iter().map(|line| escape(&line)).collect::<Vec<_>>().join("\\n")
}

/// Escapes text for Graphviz, which interprets backslashes and HTML entities.
fn escape(text: &str) -> String {
    clean(text).replace('\\', "\\\\").replace('"', "\\\"").replace('&', "&amp;")
}

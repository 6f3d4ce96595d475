// SPDX-License-Identifier: MIT OR Apache-2.0
//! Output as SVG: nodes are rounded boxes, topics plain ones, from publishers on the left to subscriptions on the right.

use super::layout::{Layout, Link, Point, Size, lay_out};
use super::picture::{Edge, EdgeKind, Picture, TopicKind, clean};
use crate::table::wrap;
use std::fmt::{self, Write};

const MARGIN: f64 = 24.0;
/// The height of a line of text, and the padding around it.
const LINE: f64 = 16.0;
const PADDING: f64 = 9.0;
const NAME: f64 = 13.0;
const SMALL: f64 = 11.0;
/// The maximum length of a name; the middle of a longer one is omitted.
const MOST_CHARS: usize = 48;

const STYLE: &str = "text{font-family:system-ui,'DejaVu Sans',sans-serif;font-size:11px;fill:#222831}.t{font-size:13px;font-weight:600}\
.m{text-anchor:middle}.f{fill:#5a626e}.r{fill:#c01c28}.p{fill:#fff}.n{fill:#dbe6f3;stroke:#4c84c4}.o{fill:#f4f1e6;stroke:#a08a3c}\
.s{fill:#eeeaf5;stroke:#7d63b0;stroke-dasharray:5 3}.n.x{stroke-dasharray:2 2}.l{fill:none;stroke:#5a626e;stroke-width:1.3}\
.d{stroke-dasharray:5 3}.l.b{stroke:#c01c28;stroke-width:2}.h{fill:#5a626e}.h.b{fill:#c01c28}\
@media(prefers-color-scheme:dark){text{fill:#e4e7eb}.f{fill:#a9b1bc}.r{fill:#ff7b72}.p{fill:#14181d}.n{fill:#1f3550;stroke:#6ea3e0}\
.o{fill:#35301c;stroke:#c0a850}.s{fill:#2c2440;stroke:#a48cd8}.l{stroke:#a9b1bc}.l.b{stroke:#ff7b72}.h{fill:#a9b1bc}.h.b{fill:#ff7b72}}";

/// The text of a box or of a line.
struct Label {
    name: Option<String>,
    lines: Vec<String>,
}

impl Label {
    fn size(&self) -> Size {
        let name = self.name.as_ref().map_or(0.0, |name| 1.06 * width(name, NAME));
        let lines = self.lines.iter().map(|line| width(line, SMALL)).fold(name, f64::max);
        let count = self.lines.len() + usize::from(self.name.is_some());
        Size { width: lines, height: LINE * count as f64 }
    }
}

/// The whole document.
pub fn write(picture: &Picture, svg: &mut String) -> fmt::Result {
    let boxes = labels(picture);
    let texts: Vec<Label> =
        picture.edges.iter().map(|edge| Label { name: None, lines: short(edge.lines()) }).collect();
    let padded = |size: Size| Size { width: size.width + 2.5 * PADDING, height: size.height + 2.0 * PADDING };
    let sizes: Vec<Size> = boxes.iter().map(|label| padded(label.size())).collect();
    let link = |(edge, text): (&Edge, &Label)| {
        let (from, to) = edge.directed(edge.node, picture.nodes.len() + edge.topic);
        let label = (!text.lines.is_empty()).then(|| text.size());
        // A topic is to the right of its publishers, even if it also has an edge back.
        let weight = if edge.kind == EdgeKind::Publishes { 3 } else { 1 };
        Link { from, to, weight, label: label.map(|size| Size { width: size.width + PADDING, ..size }) }
    };
    let links: Vec<Link> = picture.edges.iter().zip(&texts).map(link).collect();
    let layout = lay_out(&sizes, &links);

    let mut caption: Vec<(bool, String)> = Vec::new();
    for (is_good, text) in picture.caption() {
        caption.extend(wrap(&clean(&text)).lines().map(|line| (is_good, line.to_owned())));
    }
    let legend = legend(picture);
    let legend_width: f64 = legend.iter().map(|(_, text)| 40.0 + width(text, SMALL)).sum();
    let widest = caption
        .iter()
        .map(|(_, line)| 1.06 * width(line, NAME))
        .fold(layout.size.width.max(legend_width), f64::max);
    let top = MARGIN + LINE * 1.5 * caption.len() as f64 + 2.0 * LINE;
    let (wide, high) = (widest + 2.0 * MARGIN, top + layout.size.height + MARGIN);
    writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {wide:.0} {high:.0}\" width=\"{wide:.0}\" height=\"{high:.0}\">\
         <style>{STYLE}</style>\n<defs>{}{}</defs>\n<rect class=\"p\" width=\"100%\" height=\"100%\"/>",
        marker("h", "a"),
        marker("h b", "ab"),
    )?;
    let mut y = MARGIN + 2.0;
    for (index, (is_good, line)) in caption.iter().enumerate() {
        let class = match (index, is_good) {
            (0, _) => "t",
            (_, true) => "",
            (_, false) => "r",
        };
        text(svg, (MARGIN, y), class, line)?;
        y += 1.5 * LINE;
    }
    draw_legend(svg, &legend, y)?;

    writeln!(svg, "<g transform=\"translate({MARGIN} {top:.0})\">")?;
    for ((edge, line), link) in picture.edges.iter().zip(&layout.lines).zip(&links) {
        if link.from != link.to {
            draw_line(svg, picture, edge, line)?;
        }
    }
    for ((edge, text), centre) in picture.edges.iter().zip(&texts).zip(&layout.labels) {
        let Some(centre) = centre else { continue };
        let Size { width, height } = text.size();
        let (x, y) = (centre.0 - width / 2.0 - 2.0, centre.1 - height / 2.0);
        writeln!(
            svg,
            "<rect class=\"p\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{height:.1}\"/>",
            width + 4.0
        )?;
        write_label(svg, text, *centre, if edge.is_bad() { "r" } else { "f" })?;
    }
    draw_boxes(svg, picture, &boxes, &layout)?;
    writeln!(svg, "</g>\n</svg>")
}

fn labels(picture: &Picture) -> Vec<Label> {
    let node = picture
        .nodes
        .iter()
        .map(|node| Label { name: Some(elide(node.label())), lines: short(vec![node.whereabouts()]) });
    let topic = picture
        .topics
        .iter()
        .map(|topic| Label { name: Some(elide(&topic.name)), lines: short(topic.lines()) });
    node.chain(topic).collect()
}

fn draw_boxes(svg: &mut String, picture: &Picture, labels: &[Label], layout: &Layout) -> fmt::Result {
    let nodes = picture.nodes.iter().map(|node| {
        let class = if node.name.is_some() { "n" } else { "n x" };
        (class, 10, node.text())
    });
    let topics = picture.topics.iter().map(|topic| {
        let class = if topic.kind == TopicKind::Topic { "o" } else { "s" };
        (class, 0, topic.text())
    });
    for (((class, radius, title), label), (centre, size)) in
        nodes.chain(topics).zip(labels).zip(&layout.boxes)
    {
        let (x, y) = (centre.0 - size.width / 2.0, centre.1 - size.height / 2.0);
        writeln!(
            svg,
            "<g><title>{}</title><rect class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{:.1}\" rx=\"{radius}\"/>",
            title.iter().map(|line| escape(line)).collect::<Vec<_>>().join("\n"),
            size.width,
            size.height
        )?;
        write_label(svg, label, *centre, "f")?;
        writeln!(svg, "</g>")?;
    }
    Ok(())
}

fn write_label(svg: &mut String, label: &Label, centre: Point, class: &str) -> fmt::Result {
    let name = label.name.iter().map(|name| ("t m".to_owned(), name));
    let all = name.chain(label.lines.iter().map(|line| (format!("m {class}"), line)));
    let mut y = centre.1 - label.size().height / 2.0 + LINE - 4.0;
    for (class, line) in all {
        text(svg, (centre.0, y), &class, line)?;
        y += LINE;
    }
    Ok(())
}

fn draw_line(svg: &mut String, picture: &Picture, edge: &Edge, points: &[Point]) -> fmt::Result {
    let Some((first, rest)) = points.split_first() else { return Ok(()) };
    let mut path = format!("M{:.1} {:.1}", first.0, first.1);
    let mut before = *first;
    // A link is straight within a column and curved between two.
    for &(x, y) in rest {
        match y == before.1 {
            true => write!(path, "L{x:.1} {y:.1}")?,
            false => {
                let middle = f64::midpoint(before.0, x);
                write!(path, "C{middle:.1} {:.1} {middle:.1} {y:.1} {x:.1} {y:.1}", before.1)?;
            }
        }
        before = (x, y);
    }
    let (dashed, bad, head) = (
        if edge.is_service() { " d" } else { "" },
        if edge.is_bad() { " b" } else { "" },
        if edge.is_bad() { "ab" } else { "a" },
    );
    let (from, to) =
        edge.directed(picture.nodes[edge.node].label(), picture.topics[edge.topic].name.as_str());
    let qos = if edge.qos.is_empty() { String::new() } else { format!(": {}", edge.qos) };
    writeln!(
        svg,
        "<path class=\"l{dashed}{bad}\" d=\"{path}\" marker-end=\"url(#{head})\"><title>{}</title></path>",
        escape(&format!("{} {from} → {to}{qos}", edge.kind.word()))
    )
}

fn marker(class: &str, id: &str) -> String {
    format!(
        "<marker id=\"{id}\" viewBox=\"0 0 8 8\" refX=\"8\" refY=\"4\" markerWidth=\"8\" markerHeight=\"8\" \
         markerUnits=\"userSpaceOnUse\" orient=\"auto\"><path class=\"{class}\" d=\"M0 0.5L8 4L0 7.5z\"/></marker>"
    )
}

/// The entries of the legend for the kinds of things in the picture.
fn legend(picture: &Picture) -> Vec<(&'static str, &'static str)> {
    let is_bad = |what: fn(&Edge) -> bool| picture.edges.iter().any(what);
    let all = [
        ("n", "node", true),
        ("o", "topic", true),
        ("s", "service or action", picture.topics.iter().any(|topic| topic.kind != TopicKind::Topic)),
        ("l", "publishes, subscribes", true),
        ("l d", "client asks server", is_bad(Edge::is_service)),
        ("l b", "QoS or type does not fit", is_bad(|edge| edge.problem.is_some())),
        ("l b", "deadline may be missed", is_bad(|edge| edge.bound.as_ref().is_some_and(|bound| !bound.met))),
    ];
    all.into_iter().filter(|(.., is_there)| *is_there).map(|(class, text, _)| (class, text)).collect()
}

fn draw_legend(svg: &mut String, legend: &[(&str, &str)], y: f64) -> fmt::Result {
    let mut x = MARGIN;
    for (class, words) in legend {
        if class.starts_with('l') {
            writeln!(svg, "<path class=\"{class}\" d=\"M{x:.1} {:.1}h22\"/>", y - 4.0)?;
        } else {
            let radius = if *class == "n" { 4 } else { 0 };
            writeln!(
                svg,
                "<rect class=\"{class}\" x=\"{x:.1}\" y=\"{:.1}\" width=\"22\" height=\"12\" rx=\"{radius}\"/>",
                y - 10.0
            )?;
        }
        text(svg, (x + 28.0, y), "f", words)?;
        x += 40.0 + width(words, SMALL);
    }
    Ok(())
}

fn text(svg: &mut String, (x, y): Point, class: &str, words: &str) -> fmt::Result {
    writeln!(svg, "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\">{}</text>", escape(words))
}

fn escape(text: &str) -> String {
    clean(text).replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Omits the middle of a long text.
fn elide(text: &str) -> String {
    let all: Vec<char> = clean(text).chars().collect();
    if all.len() <= MOST_CHARS {
        return all.into_iter().collect();
    }
    let half = MOST_CHARS / 2;
    all[..half].iter().chain(&['…']).chain(&all[all.len() - half..]).collect()
}

fn short(lines: Vec<String>) -> Vec<String> {
    lines.iter().map(|line| elide(line)).collect()
}

/// A generous estimate of a text's width in common fonts.
fn width(text: &str, size: f64) -> f64 {
    let em = |c: char| match c {
        'i' | 'j' | 'l' | '.' | ',' | ':' | ';' | '|' | '\'' | 'I' => 0.36,
        'f' | 't' | 'r' | '/' | ' ' | '(' | ')' | '[' | ']' | '-' => 0.46,
        'm' | 'w' | 'M' | 'W' | '@' | '%' => 0.98,
        'A'..='Z' => 0.76,
        '\0'..='\u{7f}' => 0.64,
        '\u{80}'..='\u{10ff}' => 0.8,
        _ => 1.1,
    };
    size * text.chars().map(em).sum::<f64>()
}

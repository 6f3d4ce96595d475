// SPDX-License-Identifier: MIT OR Apache-2.0
//! A layered layout, from left to right: boxes in columns, lines between them. Equal graphs have equal layouts.
//!
//! Each connected part is laid out separately. Some edges are reversed to remove cycles, columns are longest paths, long edges
//! have a place in every column between, barycentre sweeps order the columns, and least squares position the ordered boxes. In very large graphs the longest edges are straight lines.

mod part;

pub use part::{Link, Point, Size};

use part::Part;
use std::collections::BTreeMap;

const PART_GAP: f64 = 36.0;

/// The positions of everything; the upper left corner is (0, 0).
#[derive(Debug, Default)]
pub struct Layout {
    pub size: Size,
    /// Centre and size of each box, which may be higher than necessary.
    pub boxes: Vec<(Point, Size)>,
    /// The points of each link; every second section is horizontal. Empty for a link from a box to itself.
    pub lines: Vec<Vec<Point>>,
    /// The centre of each link's text.
    pub labels: Vec<Option<Point>>,
}

/// Places boxes and the links between them.
pub fn lay_out(boxes: &[Size], links: &[Link]) -> Layout {
    let mut layout = Layout {
        boxes: vec![Default::default(); boxes.len()],
        lines: vec![Vec::new(); links.len()],
        labels: vec![None; links.len()],
        ..Layout::default()
    };
    let mut parts: Vec<(Part, Vec<usize>, Vec<usize>)> = Vec::new();
    for (members, inner) in connected(boxes.len(), links) {
        let at: BTreeMap<usize, usize> = members.iter().copied().zip(0..).collect();
        let own = inner.iter().map(|&link| Link {
            from: at[&links[link].from],
            to: at[&links[link].to],
            ..links[link]
        });
        let part = Part::new(members.iter().map(|&index| boxes[index]).collect(), own.collect());
        parts.push((part, members, inner));
    }
    // Parts by falling height, in rows about as wide as the whole is high.
    parts.sort_by(|one, other| other.0.size.height.total_cmp(&one.0.size.height));
    let area: f64 =
        parts.iter().map(|part| (part.0.size.width + PART_GAP) * (part.0.size.height + PART_GAP)).sum();
    let widest = parts.iter().map(|part| part.0.size.width).fold(1.5 * area.sqrt(), f64::max);
    let (mut x, mut y, mut row) = (0.0, 0.0, 0.0_f64);
    for (part, members, inner) in parts {
        if x > 0.0 && x + part.size.width > widest {
            (x, y, row) = (0.0, y + row + PART_GAP, 0.0);
        }
        let moved = |(px, py): Point| (px + x, py + y);
        for (local, &index) in members.iter().enumerate() {
            layout.boxes[index] = (moved(part.centre(local)), part.spots[local].size);
        }
        for (local, &link) in inner.iter().enumerate() {
            layout.lines[link] = part.line(local).into_iter().map(moved).collect();
            layout.labels[link] = part.chains[local].label.map(|spot| moved(part.centre(spot)));
        }
        row = row.max(part.size.height);
        layout.size.width = layout.size.width.max(x + part.size.width);
        layout.size.height = y + row;
        x += part.size.width + PART_GAP;
    }
    layout
}

/// The connected parts: their boxes and their links.
fn connected(n: usize, links: &[Link]) -> Vec<(Vec<usize>, Vec<usize>)> {
    fn root(of: &mut [usize], mut index: usize) -> usize {
        while of[index] != index {
            of[index] = of[of[index]];
            index = of[index];
        }
        index
    }
    let mut of: Vec<usize> = (0..n).collect();
    for link in links {
        let (one, other) = (root(&mut of, link.from), root(&mut of, link.to));
        of[one.max(other)] = one.min(other);
    }
    let mut parts: BTreeMap<usize, (Vec<usize>, Vec<usize>)> = BTreeMap::new();
    (0..n).for_each(|index| parts.entry(root(&mut of, index)).or_default().0.push(index));
    for (index, link) in links.iter().enumerate().filter(|(_, link)| link.from != link.to) {
        parts.entry(root(&mut of, link.from)).or_default().1.push(index);
    }
    parts.into_values().collect()
}

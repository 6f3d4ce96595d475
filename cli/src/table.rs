// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tables and colours of the output for people.

use std::collections::BTreeSet;
use std::fmt;
use std::io::{self, Write};

use crate::print::Colour;
use crate::verb::{Failure, Outcome};
use comfy_table::{CellAlignment, LineStyle, Table, TableStyle};
use tautline::Policy;
use tautline_transport::{NodeInfo, Origin};

pub const GOOD: Colour = Colour::Green;
pub const BAD: Colour = Colour::Red;
pub const WARNING: Colour = Colour::Yellow;

/// The width at which text wraps.
const WIDTH: usize = 100;

/// Writes a table whose first `left` columns are text and whose failed rows are red.
pub fn write_table(
    head: &[&str],
    left: usize,
    rows: Vec<(bool, Vec<String>)>,
    out: &mut impl Write,
) -> io::Result<()> {
    write_spaced_table(2, head, left, rows, out)
}

/// As [`write_table`], with `gap` spaces between columns.
pub fn write_spaced_table(
    gap: u16,
    head: &[&str],
    left: usize,
    rows: Vec<(bool, Vec<String>)>,
    out: &mut impl Write,
) -> io::Result<()> {
    let style = TableStyle::new().header_separator(LineStyle::none().fill('─').junction('─'));
    let mut table = Table::new();
    table.load_style(style).set_header(head.iter().copied());
    for (_, row) in &rows {
        table.add_row(row.clone());
    }
    for (i, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, gap));
        if i >= left {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    let lines: Vec<_> = table.lines().collect();
    let heading = lines.len() - rows.len();
    for (i, line) in lines.iter().enumerate() {
        let line = line.trim_end();
        let failed = i.checked_sub(heading).is_some_and(|row| !rows[row].0);
        match failed {
            true => writeln!(out, "{BAD}{line}{BAD:#}")?,
            false => writeln!(out, "{line}")?,
        }
    }
    Ok(())
}

/// A real-time priority, or `reserved` for a SCHED_DEADLINE reservation.
pub fn priority(priority: u8) -> String {
    if priority < Policy::RESERVATION { priority.to_string() } else { "reserved".into() }
}

/// Writes names, one on each line or as one JSON array.
pub fn write_names(is_json: bool, names: &[&str], out: &mut impl Write) -> io::Result<()> {
    if is_json {
        return writeln!(out, "{}", serde_json::json!(names));
    }
    names.iter().try_for_each(|name| writeln!(out, "{name}"))
}

/// Writes the names of a kind of things that are `wanted`, as [`write_names`] does. `all` has pairs of a kind and a name.
///
/// # Errors
/// There is none: the error says so of `what`, and suggests the nearest of the kinds, which `taut LIST` prints.
pub fn write_wanted(
    is_json: bool,
    wanted: &str,
    all: &[(&str, &str)],
    (what, list): (&str, &str),
) -> Outcome {
    let names: Vec<&str> = all.iter().filter(|(kind, _)| *kind == wanted).map(|(_, name)| *name).collect();
    if names.is_empty() {
        return Err(Failure::unknown(what, wanted, all.iter().map(|(kind, _)| *kind), list));
    }
    Ok(write_names(is_json, &names, &mut crate::print::stdout())?)
}

/// The places of several endpoints, this host first.
pub fn places<'o>(origins: impl Iterator<Item = &'o Origin>) -> String {
    let places: BTreeSet<(bool, &str)> =
        origins.map(|origin| (!origin.is_here(), place(origin).unwrap_or("here"))).collect();
    places.into_iter().map(|(_, place)| place).collect::<Vec<_>>().join(",")
}

/// The place of an endpoint; `None` on this host, `elsewhere` if its announcer did not name the place.
pub fn place(origin: &Origin) -> Option<&str> {
    match &*origin.place {
        _ if origin.is_here() => None,
        "" => Some("elsewhere"),
        place => Some(place),
    }
}

/// The process of a node, or its place on another host.
pub fn whereabouts(node: &NodeInfo) -> String {
    match node.pid {
        Some(pid) => format!("process {pid}"),
        None => format!("on {}", place(&node.origin).unwrap_or("this host")),
    }
}

/// Milliseconds, rounded up as a bound must be; "-" without a bound.
pub fn ms(ns: Option<u64>) -> String {
    ns.map_or("-".into(), |ns| format!("{:.3}", ns.div_ceil(1_000) as f64 / 1e3))
}

/// A number of things: `1 node`, `2 nodes`.
pub fn count<N: fmt::Display + From<u8> + PartialEq>(n: N, what: &str) -> String {
    format!("{n} {what}{}", if n == N::from(1_u8) { "" } else { "s" })
}

/// `once` or `2 times`.
pub fn times(n: u64) -> String {
    if n == 1 { "once".into() } else { format!("{n} times") }
}

/// Breaks a text between words.
pub fn wrap(text: &str) -> String {
    let (mut wrapped, mut column) = (String::new(), 0);
    for word in text.split(' ') {
        let length = word.chars().count();
        if column > 0 {
            let fits = column + 1 + length <= WIDTH;
            wrapped.push(if fits { ' ' } else { '\n' });
            column = if fits { column + 1 } else { 0 };
        }
        wrapped.push_str(word);
        column += length;
    }
    wrapped
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rows as a table, for the terminal and for a page.

use std::fmt::{self, Write};

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{Cell, CellAlignment, Table};

use crate::page::escape;
use crate::rows::Row;

struct Column {
    title: &'static str,
    is_number: bool,
    /// Empty where a row has nothing.
    text: fn(&Row) -> String,
}

const fn words(title: &'static str, text: fn(&Row) -> String) -> Column {
    Column { title, is_number: false, text }
}

const fn number(title: &'static str, text: fn(&Row) -> String) -> Column {
    Column { title, is_number: true, text }
}

/// Those of which no row has anything are left out.
const COLUMNS: [Column; 15] = [
    words("experiment", |row| row.experiment.clone()),
    number("payload", |row| size(row.payload_bytes)),
    words("system", |row| row.system.clone()),
    words("mode", |row| row.mode.clone()),
    number("n", |row| row.n.to_string()),
    number("p50", |row| digits(row.p50_us)),
    number("p99", |row| digits(row.p99_us)),
    number("p99.9", |row| digits(row.p999_us)),
    number("max µs", |row| digits(row.max_us)),
    number(LOST, |row| row.lost.to_string()),
    number("throttled", |row| row.throttled.map_or(String::new(), |times| times.to_string())),
    number("CPU µs", |row| digits(row.cpu_us_per_msg)),
    number("MiB", |row| digits(row.rss_mib)),
    number("MB/s", |row| digits(row.mb_per_s)),
    words("note", |row| row.note.clone()),
];
const LOST: &str = "lost";
/// The first so many columns are said once for the rows that share them.
const SHARED: usize = 2;

fn columns(rows: &[&Row]) -> Vec<&'static Column> {
    COLUMNS.iter().filter(|column| rows.iter().any(|row| !(column.text)(row).is_empty())).collect()
}

/// Each row, and whether its experiment or its payload is another than that of the row before.
fn marked<'a>(rows: &'a [&Row]) -> impl Iterator<Item = (&'a Row, bool)> {
    let key = |row: &'a Row| (row.experiment.as_str(), row.payload_bytes);
    rows.iter().enumerate().map(move |(at, row)| (*row, at == 0 || key(rows[at - 1]) != key(row)))
}

/// For the terminal.
pub fn text(rows: &[&Row]) -> Table {
    let columns = columns(rows);
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header(columns.iter().map(|column| column.title));
    for (row, is_first) in marked(rows) {
        let cell = |(at, column): (usize, &&Column)| {
            let is_said = !is_first && at < SHARED;
            let cell = Cell::new(if is_said { String::new() } else { (column.text)(row) });
            if column.is_number { cell.set_alignment(CellAlignment::Right) } else { cell }
        };
        table.add_row(columns.iter().enumerate().map(cell));
    }
    table
}

/// For a page.
///
/// # Errors
/// The writer's.
pub fn html(out: &mut String, rows: &[&Row]) -> fmt::Result {
    let columns = columns(rows);
    let left = |column: &Column| if column.is_number { "" } else { " class=\"l\"" };
    out.push_str("<div class=\"scroll\"><table><tr>");
    for column in &columns {
        write!(out, "<th{}>{}</th>", left(column), column.title)?;
    }
    out.push_str("</tr>\n");
    for (row, is_first) in marked(rows) {
        out.push_str(if is_first { "<tr class=\"first\">" } else { "<tr>" });
        for column in &columns {
            let class = if column.title == LOST && row.lost > 0 { " class=\"late\"" } else { left(column) };
            write!(out, "<td{class}>{}</td>", escape(&(column.text)(row)))?;
        }
        out.push_str("</tr>\n");
    }
    out.push_str("</table></div>\n");
    Ok(())
}

fn digits(number: Option<f64>) -> String {
    number.map_or(String::new(), short)
}

/// Three digits.
pub fn short(number: f64) -> String {
    match number {
        number if number < 10.0 => format!("{number:.2}"),
        number if number < 100.0 => format!("{number:.1}"),
        number => format!("{number:.0}"),
    }
}

/// Bytes with their unit.
pub fn size(bytes: usize) -> String {
    match bytes {
        0 => "-".to_owned(),
        bytes if bytes >= 1 << 20 => format!("{} MiB", bytes >> 20),
        bytes if bytes >= 1 << 10 => format!("{} KiB", bytes >> 10),
        bytes => format!("{bytes} B"),
    }
}

/// The inverse of [`size`].
pub(crate) fn bytes_of(size: &str) -> Option<usize> {
    let (number, unit) = size.split_once(' ')?;
    let shift = match unit {
        "B" => 0,
        "KiB" => 10,
        "MiB" => 20,
        _ => return None,
    };
    number.parse::<usize>().ok()?.checked_shl(shift)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_those_that_say_something_and_what_rows_share_is_said_once() {
        let row = |system: &str, lost| Row {
            experiment: "latency".to_owned(),
            system: system.to_owned(),
            payload_bytes: 1 << 20,
            p50_us: Some(123.4),
            lost,
            ..Row::default()
        };
        let (ours, theirs) = (row("tautline", 0), row("a <rival>", 2));
        let table = text(&[&ours, &theirs]).to_string();
        let count = |words: &str| table.matches(words).count();
        assert_eq!((count("latency"), count("1 MiB"), count("123"), count("MB/s")), (1, 1, 2, 0), "{table}");
        let mut page = String::new();
        html(&mut page, &[&ours, &theirs]).unwrap();
        assert!(page.contains("a &lt;rival&gt;") && page.contains("<td class=\"late\">2</td>"), "{page}");
        assert_eq!((page.matches("class=\"first\"").count(), page.contains("p99")), (1, false), "{page}");
    }

    #[test]
    fn sizes_are_read_as_they_are_written() {
        for bytes in [64, 4 << 10, 1 << 20, 8 << 20] {
            assert_eq!(bytes_of(&size(bytes)), Some(bytes));
        }
        assert_eq!((bytes_of("64"), bytes_of("1 GB"), bytes_of("x B")), (None, None, None));
    }
}

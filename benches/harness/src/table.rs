// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tables, for the terminal, for a page and for the documents; rows as a table.

use std::fmt::{self, Display, Write};

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table as Terminal};

use crate::page::escape;
use crate::rows::Row;

/// What stands in a column, and its title.
#[derive(Clone, Copy, Debug)]
pub enum Column {
    Number(&'static str),
    Words(&'static str),
    /// Words that are broken into lines.
    Text(&'static str),
}
use Column::{Number, Text, Words};

impl Column {
    fn title(self) -> &'static str {
        match self {
            Number(title) | Words(title) | Text(title) => title,
        }
    }

    /// Its class on a page.
    fn class(self) -> &'static str {
        match self {
            Number(_) => "",
            Words(_) => " class=\"l\"",
            Text(_) => " class=\"l w\"",
        }
    }
}

/// What stands in one place.
#[derive(Clone, Debug)]
pub struct Cell {
    text: String,
    /// Something that should not be.
    is_bad: bool,
}

impl<T: Display> From<T> for Cell {
    fn from(text: T) -> Self {
        Cell { text: text.to_string(), is_bad: false }
    }
}

impl Cell {
    /// How often something happened that should not.
    pub fn bad(count: u64) -> Self {
        Cell::marked(count.to_string(), count > 0)
    }

    pub fn marked(text: impl Into<String>, is_bad: bool) -> Self {
        Cell { text: text.into(), is_bad }
    }
}

/// A table. Of its first `shared` columns the terminal does not repeat what stands above.
#[derive(Clone, Debug)]
pub struct Table {
    columns: Vec<Column>,
    shared: usize,
    rows: Vec<Vec<Cell>>,
}

impl Table {
    /// Without rows.
    pub fn new(shared: usize, columns: impl Into<Vec<Column>>) -> Self {
        Table { columns: columns.into(), shared, rows: Vec::new() }
    }

    pub fn add(&mut self, cells: impl IntoIterator<Item = Cell>) {
        self.rows.push(cells.into_iter().collect());
    }

    /// How many of the first columns are as in the row above.
    fn repeated(&self, at: usize) -> usize {
        let Some(above) = at.checked_sub(1) else { return 0 };
        let pairs = self.rows[above].iter().zip(&self.rows[at]).take(self.shared);
        pairs.take_while(|(above, here)| above.text == here.text).count()
    }

    /// Writes it for a page.
    pub fn html(&self, out: &mut String) -> fmt::Result {
        out.push_str("<div class=\"scroll\"><table><tr>");
        for column in &self.columns {
            write!(out, "<th{}>{}</th>", column.class(), column.title())?;
        }
        out.push_str("</tr>\n");
        for (at, cells) in self.rows.iter().enumerate() {
            let is_first = self.shared > 0 && self.repeated(at) < self.shared;
            out.push_str(if is_first { "<tr class=\"first\">" } else { "<tr>" });
            for (column, Cell { text, is_bad }) in self.columns.iter().zip(cells) {
                let class = if *is_bad { " class=\"late\"" } else { column.class() };
                write!(out, "<td{class}>{}</td>", escape(text))?;
            }
            out.push_str("</tr>\n");
        }
        out.push_str("</table></div>\n");
        Ok(())
    }
}

impl Table {
    /// For the documents.
    pub fn markdown(&self) -> String {
        let aligned =
            self.columns.iter().map(|column| (column.title().to_owned(), matches!(column, Number(_))));
        let cells = |row: &Vec<Cell>| row.iter().map(|cell| cell.text.clone()).collect();
        lines(aligned.collect(), self.rows.iter().map(cells))
    }
}

/// For the terminal.
impl Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut terminal = Terminal::new();
        terminal.load_style(UTF8_FULL_CONDENSED);
        terminal.set_header(self.columns.iter().map(|column| column.title()));
        for (at, cells) in self.rows.iter().enumerate() {
            let (repeated, texts) = (self.repeated(at), cells.iter().map(|cell| cell.text.as_str()));
            terminal.add_row(texts.enumerate().map(|(at, text)| if at < repeated { "" } else { text }));
        }
        for (column, shown) in self.columns.iter().zip(terminal.column_iter_mut()) {
            if matches!(column, Number(_)) {
                shown.set_cell_alignment(CellAlignment::Right);
            }
        }
        terminal.fmt(f)
    }
}

/// A table of the documents. Its first `words` columns hold words, the others numbers.
pub fn markdown<T: Display>(
    titles: impl IntoIterator<Item = T>,
    words: usize,
    rows: impl IntoIterator<Item = Vec<String>>,
) -> String {
    let titles = titles.into_iter().enumerate().map(|(at, title)| (title.to_string(), at >= words));
    lines(titles.collect(), rows)
}

/// The titles say which columns hold numbers.
fn lines(titles: Vec<(String, bool)>, rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let rule: String = titles.iter().map(|(_, is_number)| if *is_number { "--:|" } else { "---|" }).collect();
    let titles: Vec<String> = titles.into_iter().map(|(title, _)| title).collect();
    let rows: String = rows.into_iter().map(|row| line(&row)).collect();
    format!("{}|{rule}\n{rows}", line(&titles))
}

/// Each of them once, in the order in which they first appear.
pub fn distinct<T: PartialEq>(all: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut found = Vec::new();
    for one in all {
        if !found.contains(&one) {
            found.push(one);
        }
    }
    found
}

/// What is shown of something, by columns.
pub type Shown<R> = (Column, fn(&R) -> Cell);

/// A table of such things; a column in which nothing would stand is left out.
pub fn shown_of<'r, R: 'r>(
    shared: usize,
    shown: &[Shown<R>],
    rows: impl IntoIterator<Item = &'r R>,
) -> Table {
    let rows: Vec<&R> = rows.into_iter().collect();
    let is_said = |(_, cell): &&Shown<R>| rows.iter().any(|row| !cell(row).text.is_empty());
    let shown: Vec<&Shown<R>> = shown.iter().filter(is_said).collect();
    let mut table = Table::new(shared, shown.iter().map(|(column, _)| *column).collect::<Vec<_>>());
    rows.iter().for_each(|row| table.add(shown.iter().map(|(_, cell)| cell(row))));
    table
}

const SHOWN: [Shown<Row>; 15] = [
    (Words("experiment"), |row| row.experiment.as_str().into()),
    (Number("payload"), |row| size(row.payload_bytes).into()),
    (Words("system"), |row| row.system.as_str().into()),
    (Words("mode"), |row| row.mode.as_str().into()),
    (Number("n"), |row| row.n.into()),
    (Number("p50"), |row| digits(row.p50_us)),
    (Number("p99"), |row| digits(row.p99_us)),
    (Number("p99.9"), |row| digits(row.p999_us)),
    (Number("max µs"), |row| digits(row.max_us)),
    (Number("lost"), |row| Cell::bad(row.lost)),
    (Number("throttled"), |row| row.throttled.map_or("".into(), Cell::from)),
    (Number("CPU µs"), |row| digits(row.cpu_us_per_msg)),
    (Number("MiB"), |row| digits(row.rss_mib)),
    (Number("MB/s"), |row| digits(row.mb_per_s)),
    (Words("note"), |row| row.note.as_str().into()),
];

pub fn of_rows<'a>(rows: impl IntoIterator<Item = &'a Row>) -> Table {
    shown_of(2, &SHOWN, rows)
}

fn digits(number: Option<f64>) -> Cell {
    number.map_or(String::new(), short).into()
}

/// Three digits.
pub fn short(number: f64) -> String {
    match number {
        number if number > 0.0 && number < 0.1 => format!("{number:.4}"),
        number if number < 10.0 => format!("{number:.2}"),
        number if number < 100.0 => format!("{number:.1}"),
        number => format!("{number:.0}"),
    }
}

/// As many digits as the documents show.
pub fn figure(number: Option<f64>) -> String {
    match number {
        Some(number) if number < 100.0 => format!("{number:.2}"),
        Some(number) => format!("{number:.0}"),
        None => "-".to_owned(),
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
        let table = of_rows([&ours, &theirs]);
        let text = table.to_string();
        let count = |words: &str| text.matches(words).count();
        assert_eq!((count("latency"), count("1 MiB"), count("123"), count("MB/s")), (1, 1, 2, 0), "{text}");
        let markdown = table.markdown();
        assert!(
            markdown.starts_with(
                "| experiment | payload | system | n | p50 | lost |\n|---|--:|---|--:|--:|--:|\n"
            ),
            "{markdown}"
        );
        assert!(markdown.ends_with("| latency | 1 MiB | a <rival> | 0 | 123 | 2 |\n"), "{markdown}");
        let mut page = String::new();
        table.html(&mut page).unwrap();
        assert!(page.contains("a &lt;rival&gt;") && page.contains("<td class=\"late\">2</td>"), "{page}");
        assert_eq!((page.matches("class=\"first\"").count(), page.contains("p99")), (1, false), "{page}");
    }
}

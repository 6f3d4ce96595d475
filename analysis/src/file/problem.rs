// SPDX-License-Identifier: MIT OR Apache-2.0
use std::cell::{Cell, RefCell};
use std::fmt;

/// What is wrong with a system file, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Line, counted from 1.
    pub line: usize,
    /// Column in characters, counted from 1.
    pub column: usize,
    /// What is wrong and how to fix it, in one sentence.
    pub message: String,
}

/// Everything that is wrong with a system file, in the order of the file; never empty.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problems(pub Vec<Problem>);

impl fmt::Display for Problems {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, Problem { line, column, message }) in self.0.iter().enumerate() {
            let newline = if i > 0 { "\n" } else { "" };
            write!(f, "{newline}{line}:{column}: {message}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Problems {}

/// Collects problems by their place in the text.
pub struct Collector<'a> {
    text: &'a str,
    found: RefCell<Vec<(usize, String)>>,
    hints: Cell<u32>,
}

/// Adds a problem at a place in the text.
pub struct Adder<'c>(&'c Collector<'c>, usize);

impl Adder<'_> {
    /// Adds what is wrong there, and how to fix it.
    pub fn add(&self, message: impl Into<String>) {
        // Text of the file may reach a terminal, so unprintable characters are escaped.
        let mut shown = String::new();
        for c in message.into().chars() {
            match is_unprintable(c) {
                true => shown.extend(c.escape_unicode()),
                false => shown.push(c),
            }
        }
        self.0.found.borrow_mut().push((self.1, shown));
    }
}

impl<'a> Collector<'a> {
    pub(super) fn new(text: &'a str) -> Self {
        Self { text, found: RefCell::default(), hints: Cell::new(0) }
    }

    /// For a problem at this place: `problems.at(at).add(...)`.
    pub(super) fn at(&self, at: usize) -> Adder<'_> {
        Adder(self, at)
    }

    /// Returns `: did you mean ...?` if a known name is close to the one given, else nothing. A file gets a limited number of hints,
    /// because each compares all names.
    pub(super) fn suggestion<'n>(&self, given: &str, known: impl IntoIterator<Item = &'n str>) -> String {
        const MOST_HINTS: u32 = 50;
        self.hints.update(|hints| hints.saturating_add(1));
        if self.hints.get() > MOST_HINTS { String::new() } else { suggestion(given, known) }
    }

    /// Ends with all problems that were found, if there are any.
    pub(super) fn check(&self) -> Result<(), Problems> {
        if self.found.borrow().is_empty() { Ok(()) } else { Err(self.take()) }
    }

    pub(super) fn take(&self) -> Problems {
        let mut found = self.found.take();
        found.sort();
        found.dedup();
        let lines: Vec<usize> =
            std::iter::once(0).chain(self.text.match_indices('\n').map(|(newline, _)| newline + 1)).collect();
        let locate = |(at, message): (usize, String)| {
            let line = lines.partition_point(|start| *start <= at);
            let before = self.text.get(lines[line - 1]..at).unwrap_or_default();
            Problem { line, column: before.chars().count() + 1, message }
        };
        Problems(found.into_iter().map(locate).collect())
    }
}

/// Whether a terminal would interpret a character instead of showing it: control characters, and those that turn the direction of text.
pub(super) fn is_unprintable(c: char) -> bool {
    c.is_control() || matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// `: did you mean ...?` if a known name is close to the one given, else nothing.
fn suggestion<'n>(given: &str, known: impl IntoIterator<Item = &'n str>) -> String {
    let length = given.chars().count();
    let most = |name: &str| 1 + name.chars().count() / 4;
    let known = known.into_iter().filter(|name| name.chars().count().abs_diff(length) <= most(name));
    let near = known.map(|name| (strsim::osa_distance(given, name), name)).min();
    match near.filter(|(distance, name)| *distance <= most(name)) {
        Some((_, name)) => format!(": did you mean `{name}`?"),
        None => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::{Collector, suggestion};

    #[test]
    fn near_names_are_suggested() {
        for wrong in ["perid", "peroid"] {
            assert_eq!(suggestion(wrong, ["wcet", "period"]), ": did you mean `period`?");
        }
        assert_eq!(suggestion("colour", ["wcet", "period"]), "");
    }

    #[test]
    fn places_are_lines_and_columns() {
        let collector = Collector::new("a = 1\nµ = 2\n");
        collector.at(9).add("second");
        collector.at(0).add("first");
        let problems = collector.take();
        assert_eq!(problems.to_string(), "1:1: first\n2:3: second");
    }
}

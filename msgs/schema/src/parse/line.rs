// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lines with their numbers, and a line that is read from left to right and knows its column.

/// A line after its number, from 1.
pub(crate) type Numbered<'a> = (u32, &'a str);

/// The lines as Python reads them from a file: they end with `\n`, `\r\n` or `\r`.
pub(crate) fn lines(text: &str) -> Vec<Numbered<'_>> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    (1..).zip(text.lines().flat_map(|line| line.split('\r'))).collect()
}

/// What is left of a line.
#[derive(Clone, Copy)]
pub struct Line<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Line<'a> {
    /// A line without its comment.
    pub fn new(text: &'a str) -> Self {
        let mut line = Self { text: text.trim_end(), at: 0 };
        line.skip_spaces();
        line
    }

    pub fn is_empty(&self) -> bool {
        self.rest().is_empty()
    }

    pub fn rest(&self) -> &'a str {
        self.text.get(self.at..).unwrap_or_default()
    }

    /// The column in characters, from 1.
    pub fn column(&self) -> u32 {
        let before = self.text.get(..self.at).unwrap_or_default().chars().count();
        u32::try_from(before).unwrap_or(u32::MAX).saturating_add(1)
    }

    /// Takes what comes before the next space, and the space.
    pub fn word(&mut self) -> &'a str {
        self.take(char::is_whitespace)
    }

    /// Takes what comes before the next space or `=`, and the space.
    pub fn name(&mut self) -> &'a str {
        self.take(|next| next.is_whitespace() || next == '=')
    }

    /// The value, if what follows is `=` and a value.
    pub fn constant_value(&self) -> Option<Self> {
        self.rest().starts_with('=').then(|| {
            let mut value = Self { text: self.text, at: self.at + 1 };
            value.skip_spaces();
            value
        })
    }

    fn take(&mut self, end: impl Fn(char) -> bool) -> &'a str {
        let rest = self.rest();
        let len = rest.find(end).unwrap_or(rest.len());
        self.at += len;
        self.skip_spaces();
        rest.get(..len).unwrap_or_default()
    }

    fn skip_spaces(&mut self) {
        let rest = self.rest();
        self.at += rest.len() - rest.trim_start().len();
    }
}

/// The start of a text, for an error message.
pub(crate) fn shortened(text: &str) -> String {
    match text.char_indices().nth(60) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}

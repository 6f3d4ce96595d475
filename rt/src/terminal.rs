// SPDX-License-Identifier: MIT OR Apache-2.0
//! Escapes untrusted text for a terminal: from other hosts, from other users' bags, from messages.

use std::borrow::Cow;
use std::io::{self, Write};

/// Writes text in which control characters are escaped, except line ends and tabs: untrusted text moves no cursor, changes no title
/// and rings no bell. `ESC` becomes `\u001b`, as in JSON; a carriage return before a line feed is left out.
#[derive(Debug)]
pub struct Escaped<W: Write> {
    to: W,
    /// The end of the written bytes, if the next bytes decide what it is: part of a character, or a carriage return.
    pending: Vec<u8>,
}

impl<W: Write> Escaped<W> {
    /// Escapes the text that is written to `to`.
    pub fn new(to: W) -> Self {
        Escaped { to, pending: Vec::new() }
    }
}

impl<W: Write> Write for Escaped<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.pending.extend_from_slice(bytes);
        let (text, rest) = escape(&self.pending, false);
        self.pending.drain(..self.pending.len() - rest);
        self.to.write_all(text.as_bytes())?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

impl<W: Write> Drop for Escaped<W> {
    fn drop(&mut self) {
        let (text, _) = escape(&self.pending, true);
        // Ignored, as by other writers.
        let _ = self.to.write_all(text.as_bytes());
    }
}

/// The text with its control characters escaped, as [`Escaped`] does.
pub fn escaped(text: &str) -> Cow<'_, str> {
    match text.contains(is_escaped) {
        true => escape(text.as_bytes(), true).0.into(),
        false => text.into(),
    }
}

fn is_escaped(c: char) -> bool {
    c.is_control() && !matches!(c, '\n' | '\t')
}

/// Escapes bytes. Unless `is_all`, also returns how many bytes at the end are left for the next call.
fn escape(bytes: &[u8], is_all: bool) -> (String, usize) {
    let mut text = String::with_capacity(bytes.len());
    let mut left = bytes.len();
    for chunk in bytes.utf8_chunks() {
        let mut chars = chunk.valid().chars().peekable();
        while let Some(c) = chars.next() {
            let is_last = chars.peek().is_none() && left == c.len_utf8();
            match c {
                '\r' if chars.peek() == Some(&'\n') => {}
                '\r' if is_last && !is_all => return (text, left),
                '\r' => text.push_str("\\r"),
                c if is_escaped(c) => text.push_str(&format!("\\u{:04x}", u32::from(c))),
                c => text.push(c),
            }
            left -= c.len_utf8();
        }
        let invalid = chunk.invalid();
        let is_incomplete = std::str::from_utf8(invalid).is_err_and(|error| error.error_len().is_none());
        if is_incomplete && left == invalid.len() && !is_all {
            return (text, left);
        }
        invalid.iter().for_each(|byte| text.push_str(&format!("\\x{byte:02x}")));
        left -= invalid.len();
    }
    (text, 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_others_wrote_moves_no_cursor() {
        for (text, expected) in [
            ("plain é漢 text\n\tand a tab", "plain é漢 text\n\tand a tab"),
            ("\x1b]0;title\x07\x1b[2J", "\\u001b]0;title\\u0007\\u001b[2J"),
            ("over\rwritten\r\nnext\r", "over\\rwritten\nnext\\r"),
            ("\u{9b}31m\u{7f}\0", "\\u009b31m\\u007f\\u0000"),
        ] {
            assert_eq!(escaped(text), expected);
            // However it is divided.
            for size in 1..=text.len() {
                let mut out = Vec::new();
                let mut writer = Escaped::new(&mut out);
                text.as_bytes().chunks(size).for_each(|chunk| writer.write_all(chunk).unwrap());
                drop(writer);
                assert_eq!(String::from_utf8(out).unwrap(), expected, "{size}");
            }
        }
    }

    #[test]
    fn what_is_no_text_is_written_in_figures() {
        let mut out = Vec::new();
        Escaped::new(&mut out).write_all(b"a\x9b1m\xe6\xbc").unwrap();
        assert_eq!(out, b"a\\x9b1m\\xe6\\xbc");
    }
}

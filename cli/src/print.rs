// SPDX-License-Identifier: MIT OR Apache-2.0
//! The only code that prints. Names, messages, logs and errors may come from other hosts or a bag, so their control characters are escaped.
//! Until this escaping, colours are therefore represented by Unicode's noncharacters, which no text contains.

use std::fmt;
use std::io::{self, IsTerminal, Write};
use tautline_rt::terminal::Escaped;

/// A colour: `format!("{BAD}text{BAD:#}")`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Colour {
    Plain,
    Green,
    Yellow,
    Red,
}

const END: char = '\u{fdd0}';
/// Moves the cursor to the upper left and clears a terminal's screen; removed from output without colours.
pub const CLEAR: char = '\u{fdd4}';

const SEQUENCES: [(char, &str); 5] = [
    (END, "\x1b[0m"),
    ('\u{fdd1}', "\x1b[32m"),
    ('\u{fdd2}', "\x1b[33m"),
    ('\u{fdd3}', "\x1b[31m"),
    (CLEAR, "\x1b[H\x1b[J"),
];

impl fmt::Display for Colour {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let start = match self {
            Colour::Plain => return Ok(()),
            Colour::Green => '\u{fdd1}',
            Colour::Yellow => '\u{fdd2}',
            Colour::Red => '\u{fdd3}',
        };
        write!(f, "{}", if f.alternate() { END } else { start })
    }
}

/// The text with the terminal's escape sequences for colours, or without colours.
pub fn painted(text: &str, is_coloured: bool) -> String {
    SEQUENCES.iter().fold(text.to_owned(), |text, (mark, sequence)| {
        text.replace(*mark, if is_coloured { sequence } else { "" })
    })
}

/// Replaces colours in the text that is written to `to`. Each write must consist of whole characters.
struct Painted<W: Write> {
    to: W,
    is_coloured: bool,
}

impl<W: Write> Write for Painted<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let text = std::str::from_utf8(bytes).map_err(io::Error::other)?;
        match text.contains(|c| SEQUENCES.iter().any(|(mark, _)| *mark == c)) {
            true => self.to.write_all(painted(text, self.is_coloured).as_bytes())?,
            false => self.to.write_all(bytes)?,
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

fn printer<W: Write + IsTerminal + anstream::stream::RawStream>(to: W) -> Escaped<impl Write> {
    let is_coloured = anstream::AutoStream::choice(&to) != anstream::ColorChoice::Never;
    Escaped::new(Painted { to, is_coloured })
}

/// Standard output.
pub fn stdout() -> Escaped<impl Write> {
    printer(io::stdout().lock())
}

/// Standard error.
pub fn stderr() -> Escaped<impl Write> {
    printer(io::stderr().lock())
}

#[doc(hidden)]
pub fn line_to(mut to: impl Write, line: fmt::Arguments<'_>) {
    // Written in one piece, so that lines of several threads do not mix. An error means that the reader has closed the pipe.
    let _ = to.write_all(format!("{line}\n").as_bytes());
    let _ = to.flush();
}

/// The standard library's `println!`, but through [`stdout`].
#[macro_export]
macro_rules! println {
    () => { $crate::print::line_to($crate::print::stdout(), format_args!("")) };
    ($($text:tt)*) => { $crate::print::line_to($crate::print::stdout(), format_args!($($text)*)) };
}

/// The standard library's `eprintln!`, but through [`stderr`].
#[macro_export]
macro_rules! eprintln {
    () => { $crate::print::line_to($crate::print::stderr(), format_args!("")) };
    ($($text:tt)*) => { $crate::print::line_to($crate::print::stderr(), format_args!($($text)*)) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_our_own_colours_are_painted() {
        for is_coloured in [false, true] {
            let mut out = Vec::new();
            let mut printer = Escaped::new(Painted { to: &mut out, is_coloured });
            let red = Colour::Red;
            writeln!(printer, "{red}of others: \x1b[2J\u{9b}31m{red:#}").unwrap();
            drop(printer);
            let text = "of others: \\u001b[2J\\u009b31m";
            let expected = if is_coloured { format!("\x1b[31m{text}\x1b[0m\n") } else { format!("{text}\n") };
            assert_eq!(String::from_utf8(out).unwrap(), expected);
        }
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The only code that prints. Names, messages, logs and errors may come from other hosts or a bag, so their control characters are escaped.
//! Until this escaping, colours are therefore represented by marks that no other text contains.

use std::fmt;
use std::hash::{BuildHasher, Hasher, RandomState};
use std::io::{self, IsTerminal, Write};
use std::sync::LazyLock;
use tautline_rt::terminal::Escaped;

/// A colour: `format!("{BAD}text{BAD:#}")`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Colour {
    Plain,
    Green,
    Yellow,
    Red,
}

/// The escape sequences: the end of a colour, the colours, and the cleared screen.
const SEQUENCES: [&str; 5] = ["\x1b[0m", "\x1b[32m", "\x1b[33m", "\x1b[31m", "\x1b[H\x1b[J"];
/// The beginning of each mark: one of Unicode's noncharacters, which others may send nevertheless.
const BEGIN: char = '\u{fdd0}';
/// The marks of the sequences. Others do not know this process's random number.
static MARKS: LazyLock<[String; SEQUENCES.len()]> = LazyLock::new(|| {
    let number = RandomState::new().build_hasher().finish();
    std::array::from_fn(|sequence| format!("{BEGIN}{number:016x}{sequence}"))
});

impl fmt::Display for Colour {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sequence = match self {
            Colour::Plain => return Ok(()),
            _ if f.alternate() => 0,
            Colour::Green => 1,
            Colour::Yellow => 2,
            Colour::Red => 3,
        };
        f.write_str(&MARKS[sequence])
    }
}

/// Moves the cursor to the upper left and clears a terminal's screen; removed from output without colours.
pub fn clear() -> &'static str {
    &MARKS[4]
}

/// The text with the terminal's escape sequences for colours, or without colours.
pub fn painted(text: &str, is_coloured: bool) -> String {
    MARKS.iter().zip(SEQUENCES).fold(text.to_owned(), |text, (mark, sequence)| {
        text.replace(mark.as_str(), if is_coloured { sequence } else { "" })
    })
}

/// Replaces colours in the text that is written to `to`. Each write must consist of whole marks.
struct Painted<W: Write> {
    to: W,
    is_coloured: bool,
}

impl<W: Write> Write for Painted<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let text = std::str::from_utf8(bytes).map_err(io::Error::other)?;
        match text.contains(BEGIN) {
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
            writeln!(printer, "{red}of others: \x1b[2J\u{9b}31m a\u{fdd4}b\u{fdd0}{red:#}").unwrap();
            drop(printer);
            let text = "of others: \\u001b[2J\\u009b31m a\u{fdd4}b\u{fdd0}";
            let expected = if is_coloured { format!("\x1b[31m{text}\x1b[0m\n") } else { format!("{text}\n") };
            assert_eq!(String::from_utf8(out).unwrap(), expected);
        }
    }
}

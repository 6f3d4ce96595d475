// SPDX-License-Identifier: MIT OR Apache-2.0
//! A line of the log, and its fixed-size form.

use super::severity::LogSeverity;
use std::fmt::{self, Write};

/// Bytes for a line's logger and text where it must not allocate.
const CAPACITY: usize = 464;
const CUT: &str = "...";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Line<'t> {
    /// On the system's clock.
    pub(super) time_ns: i64,
    pub(super) severity: LogSeverity,
    pub(super) logger: &'t str,
    pub(super) text: &'t str,
    pub(super) file: &'static str,
    pub(super) line: u32,
}

/// A line in 512 bytes. What is too long is cut off, and ends with `...`.
#[derive(Clone)]
pub(super) struct FixedLine {
    time_ns: i64,
    file: &'static str,
    line: u32,
    severity: LogSeverity,
    is_cut: bool,
    logger_bytes: u16,
    used: u16,
    bytes: [u8; CAPACITY],
}

impl FixedLine {
    /// # Real-time
    /// Wait-free; no allocation, unless what is formatted allocates; no syscall.
    pub(super) fn new(line: Line<'_>, text: fmt::Arguments<'_>) -> FixedLine {
        let Line { time_ns, severity, logger, file, line, .. } = line;
        let bytes = [0; CAPACITY];
        let mut fixed =
            FixedLine { time_ns, file, line, severity, is_cut: false, logger_bytes: 0, used: 0, bytes };
        fixed.append(logger);
        fixed.logger_bytes = fixed.used;
        // A truncated line is not an error; errors of a `Display` are ignored.
        let _ = fixed.write_fmt(text);
        if fixed.is_cut {
            fixed.is_cut = false;
            fixed.append_up_to(CUT, CAPACITY);
        }
        fixed
    }

    pub(super) fn as_line(&self) -> Line<'_> {
        let (logger, text) = self.bytes[..usize::from(self.used)].split_at(self.logger_bytes.into());
        Line {
            time_ns: self.time_ns,
            severity: self.severity,
            // Only whole characters were put in.
            logger: str::from_utf8(logger).unwrap_or_default(),
            text: str::from_utf8(text).unwrap_or_default(),
            file: self.file,
            line: self.line,
        }
    }

    fn append(&mut self, text: &str) {
        self.append_up_to(text, CAPACITY - CUT.len());
    }

    fn append_up_to(&mut self, text: &str, capacity: usize) {
        let used = usize::from(self.used);
        let room = if self.is_cut { 0 } else { capacity - used };
        let len = floor_char_boundary(text, room);
        self.is_cut |= len < text.len();
        self.bytes[used..used + len].copy_from_slice(&text.as_bytes()[..len]);
        self.used += len as u16;
    }
}

/// The end of the longest prefix of `text` that has at most `bytes`. (`str`'s own function needs a newer Rust than Tautline does.)
pub(super) fn floor_char_boundary(text: &str, bytes: usize) -> usize {
    (0..=bytes.min(text.len())).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0)
}

impl Write for FixedLine {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.append(text);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixed(logger: &str, text: fmt::Arguments<'_>) -> FixedLine {
        let line = Line { time_ns: 7, severity: LogSeverity::Warn, logger, text: "", file: "a.rs", line: 3 };
        FixedLine::new(line, text)
    }

    #[test]
    fn what_is_too_long_is_cut_between_characters() {
        assert!(size_of::<FixedLine>() <= 512);
        let short = fixed("robot.arm", format_args!("{} of {:>3}", 1, 2));
        let line = short.as_line();
        assert_eq!((line.logger, line.text, line.file, line.line), ("robot.arm", "1 of   2", "a.rs", 3));

        let exact = "x".repeat(CAPACITY - CUT.len() - 1);
        assert_eq!(fixed("l", format_args!("{exact}")).as_line().text, exact);
        let long = fixed("l", format_args!("{exact}{}{}", 1, "after"));
        assert_eq!(long.as_line().text, format!("{exact}..."));
        let wide = "ä".repeat(CAPACITY);
        let text = fixed("l", format_args!("{wide}!"));
        let text = text.as_line().text;
        assert!(text.ends_with("ä...") && text.len() <= CAPACITY, "{text}");
        assert!(fixed(&wide, format_args!("text")).as_line().logger.ends_with('ä'));
    }
}

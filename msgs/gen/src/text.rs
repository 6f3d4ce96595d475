// SPDX-License-Identifier: MIT OR Apache-2.0

/// The width of lines in rustfmt without a configuration.
const MAX_WIDTH: usize = 100;

/// Code, line by line.
#[derive(Default)]
pub struct Text {
    code: String,
    depth: usize,
}

impl Text {
    /// A line at the current depth. A line that opens a block makes it deeper, one that closes it less deep.
    pub fn line(&mut self, line: &str) {
        let closes = line.starts_with(['}', ')', ']']);
        self.depth -= usize::from(closes);
        if !line.is_empty() {
            self.code.extend(std::iter::repeat_n("    ", self.depth));
            self.code.push_str(line);
        }
        self.code.push('\n');
        self.depth += usize::from(line.ends_with(['{', '(', '[']) && !line.starts_with("//"));
    }

    /// Whether rustfmt would leave this line as one.
    pub fn fits(&self, line: &str) -> bool {
        4 * self.depth + line.chars().count() <= MAX_WIDTH
    }

    /// Two parts of a line, in two lines if rustfmt would write two.
    pub fn pair(&mut self, first: &str, second: &str) {
        let line = format!("{first} {second}");
        if self.fits(&line) {
            return self.line(&line);
        }
        self.broken(first, second);
    }

    /// Two parts of a line in two lines.
    pub fn broken(&mut self, first: &str, second: &str) {
        self.line(first);
        self.depth += 1;
        self.line(second);
        self.depth -= 1;
    }

    /// A line of documentation.
    pub fn doc(&mut self, line: &str) {
        self.line(format!("/// {line}").trim_end());
    }

    /// A comment of a definition. It stays Markdown only if that makes no code, link or tag of it; else it is put into a text block.
    pub fn comment(&mut self, comment: &str) {
        let is_direction = |c| matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
        let comment: String = comment
            .chars()
            .map(|c| if is_direction(c) || (c.is_control() && c != '\n') { ' ' } else { c })
            .collect();
        let is_prose = |line: &str| {
            let starts_block = line.starts_with([' ', '#', '>', '=', '|', '+', '*', '-']);
            !starts_block && !line.contains(['`', '[', ']', '<', '\\', '~']) && !line.contains("://")
        };
        if comment.lines().all(is_prose) {
            return comment.lines().for_each(|line| self.doc(line));
        }
        // Longer than every run of backticks in the comment.
        let runs = comment.split(|c| c != '`').map(str::len);
        let fence = "`".repeat(runs.max().unwrap_or(0).max(2) + 1);
        self.doc("");
        self.doc(&format!("{fence}text"));
        comment.lines().for_each(|line| self.doc(line));
        self.doc(&fence);
    }

    /// An empty line, unless a block was just opened or there is none above.
    pub fn gap(&mut self) {
        if !self.code.is_empty() && !self.code.ends_with("{\n") {
            self.code.push('\n');
        }
    }

    pub fn finish(self) -> String {
        self.code
    }
}

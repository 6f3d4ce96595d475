// SPDX-License-Identifier: MIT OR Apache-2.0
//! The user's incomplete command line, and how the shell takes candidates.

use super::line::Line;
use std::sync::OnceLock;
use std::time::Instant;

/// The word to complete, and the arguments before it.
pub struct Asked {
    pub line: Line,
    pub since: Instant,
    /// The shell replaces the word by the candidate, and does not require that the candidate begins with the word.
    pub replaces: bool,
    /// The shell inserts candidates unchanged; other shells quote them if necessary.
    pub is_raw: bool,
}

impl Asked {
    /// Whether a name, which another process may have chosen, is safe on a command line: it must be one word without special characters.
    pub fn shell_takes(&self, name: &str) -> bool {
        let is_word = |c: char| c.is_alphanumeric() || "/_-.,:+=@%~[]".contains(c);
        !name.chars().any(char::is_control) && (!self.is_raw || name.chars().all(is_word))
    }
}

pub static ASKED: OnceLock<Asked> = OnceLock::new();

#[cfg(test)]
mod tests {
    use super::*;

    /// Names of parameters and transitions come from a node and may be any text.
    #[test]
    fn a_name_is_nothing_but_a_word() {
        let taken = |is_raw, name: &str| {
            let line = Line::default();
            Asked { line, since: Instant::now(), replaces: false, is_raw }.shell_takes(name)
        };
        for name in ["/robot/imu", "arm.speed", "--field=parts[2].at", "größe", "std_msgs/msg/String"] {
            assert!(taken(true, name) && taken(false, name), "{name}");
        }
        for name in ["$(touch x)", "a b", "a;b", "a'b", "`a`", "a|b", "a>b", "{a,b}", "*", "a\\b", "!a"] {
            assert!(!taken(true, name) && taken(false, name), "{name}");
        }
        for name in ["a\nb", "\u{1b}[2J", "a\tb"] {
            assert!(!taken(true, name) && !taken(false, name), "{name:?}");
        }
    }
}

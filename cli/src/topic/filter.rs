// SPDX-License-Identifier: MIT OR Apache-2.0
//! Selects messages by a program in jq's language, which `taut-filter` runs.

use crate::sibling::FILTER;
use crate::verb::{Failure, Outcome};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use tautline_rt::host::with_former_open_files;
use tautline_schema::DynamicMessage;

/// The process `taut-filter`. It ends when its input is closed.
pub struct Filter {
    messages: ChildStdin,
    answers: BufReader<ChildStdout>,
    child: Child,
}

impl Filter {
    /// Starts the process.
    ///
    /// # Errors
    /// It is not installed, or `text` is not a jq program.
    pub fn new(text: &str) -> Outcome<Self> {
        let path = FILTER.path();
        let mut command = Command::new(&path);
        command.arg(text).stdin(Stdio::piped()).stdout(Stdio::piped());
        let started = with_former_open_files(&mut command).spawn();
        let mut child = started.map_err(|error| FILTER.error(&path, &error))?;
        let (Some(messages), Some(answers)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(ended());
        };
        let mut filter = Filter { messages, answers: BufReader::new(answers), child };
        match filter.answer()?.as_str() {
            "" => Ok(filter),
            wrong => Err(Failure::unusable(wrong)),
        }
    }

    /// Whether the program selects a message.
    ///
    /// # Errors
    /// The program cannot be applied to it.
    pub fn accepts(&mut self, message: &DynamicMessage) -> Outcome<bool> {
        writeln!(self.messages, "{}", message.to_extended_json()).map_err(|_| ended())?;
        match self.answer()?.as_str() {
            "true" => Ok(true),
            "false" => Ok(false),
            refused => Err(Failure::unusable(refused)),
        }
    }

    fn answer(&mut self) -> Outcome<String> {
        let mut line = String::new();
        match self.answers.read_line(&mut line) {
            Ok(1..) => Ok(line.trim_end().to_owned()),
            _ => Err(ended()),
        }
    }
}

impl Drop for Filter {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn ended() -> Failure {
    Failure::unusable(format!("{} ended by itself", FILTER.program))
}

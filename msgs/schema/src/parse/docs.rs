// SPDX-License-Identifier: MIT OR Apache-2.0
//! Assigns comments to the message, its fields and constants by the rules of `rosidl_adapter`.

use super::line::Numbered;
use crate::Definition;

/// The comments of a definition while it is parsed.
pub struct Docs {
    message: Vec<String>,
    /// Above the next field or constant.
    pending: Vec<String>,
    members: Vec<(Member, Vec<String>)>,
}

#[derive(Clone, Copy)]
enum Member {
    Field(usize),
    Constant(usize),
}

impl Docs {
    /// Takes the comment lines at the very start, which are the message's; gives the other lines back.
    pub fn start<'a, 'b>(lines: &'a [Numbered<'b>]) -> (Self, &'a [Numbered<'b>]) {
        let count = lines.iter().take_while(|(_, line)| line.starts_with('#')).count();
        let (comments, rest) = lines.split_at(count);
        let message = comments.iter().map(|(_, line)| comment(line)).collect();
        (Self { message, pending: vec![], members: vec![] }, rest)
    }

    /// Keeps a line's comment; gives the line without it back.
    pub fn strip<'a>(&mut self, line: &'a str) -> &'a str {
        let Some((content, text)) = line.split_once('#') else { return line };
        match (content.trim().is_empty() && !content.is_empty(), self.members.last_mut()) {
            // An indented comment line continues the comment of the member above it.
            (true, Some((_, lines))) => lines.push(comment(text)),
            (true, None) => {}
            (false, _) => self.pending.push(comment(text)),
        }
        content
    }

    /// The comments above belong to this field.
    pub fn field(&mut self, index: usize) {
        self.members.push((Member::Field(index), std::mem::take(&mut self.pending)));
    }

    /// The comments above belong to this constant.
    pub fn constant(&mut self, index: usize) {
        self.members.push((Member::Constant(index), std::mem::take(&mut self.pending)));
    }

    /// Writes the comments to the message, the fields and the constants.
    pub fn attach(self, definition: &mut Definition) {
        definition.docs = joined(&self.message);
        for (member, lines) in self.members {
            let docs = match member {
                Member::Field(index) => definition.fields.get_mut(index).map(|field| &mut field.docs),
                Member::Constant(index) => {
                    definition.constants.get_mut(index).map(|constant| &mut constant.docs)
                }
            };
            if let Some(docs) = docs {
                *docs = joined(&lines);
            }
        }
    }
}

fn comment(text: &str) -> String {
    let text = text.trim_start_matches('#').trim_end();
    text.strip_prefix(' ').unwrap_or(text).to_owned()
}

/// The lines without empty ones at either end.
fn joined(lines: &[String]) -> String {
    lines.join("\n").trim_matches('\n').to_owned()
}

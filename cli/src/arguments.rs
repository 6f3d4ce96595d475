// SPDX-License-Identifier: MIT OR Apache-2.0
//! Names, types and messages on the command line, as ROS 2's tools take them.

use crate::verb::{Failure, Outcome};
use std::sync::Arc;
use tautline_rt::clock::wall_ns;
use tautline_schema::{DynamicMessage, Schema};

/// The full name; a relative name belongs to the namespace `/`.
pub fn full_name(name: &str) -> String {
    if name.starts_with('/') { name.to_owned() } else { format!("/{name}") }
}

/// The full name of a type. As in ROS 2's tools, the kind (`msg`, `srv`, `action`) may be omitted.
pub fn full_type(name: &str, kind: &str) -> String {
    match name.split('/').collect::<Vec<_>>()[..] {
        [package, name] => format!("{package}/{kind}/{name}"),
        _ => name.to_owned(),
    }
}

/// Splits `[TYPE] [VALUES]`. A single argument that is not a type's name is the values.
pub fn type_and_values<'a>(arguments: &'a [String], kind: &str) -> (Option<String>, &'a str) {
    let is_type = |text: &str| {
        text.contains('/') && text.chars().all(|c| c.is_ascii_alphanumeric() || "_/".contains(c))
    };
    match arguments {
        [type_name, values] => (Some(full_type(type_name, kind)), values),
        [type_name] if is_type(type_name) => (Some(full_type(type_name, kind)), "{}"),
        rest => (None, rest.first().map_or("{}", String::as_str)),
    }
}

/// A message from values in YAML or JSON. Headers that are `auto` and times that are `now` get the time of the last [`stamp`](Self::stamp).
pub struct WrittenMessage {
    pub message: DynamicMessage,
    stamps: Vec<String>,
}

impl WrittenMessage {
    /// Reads the values, and stamps the message.
    pub fn new(schema: &Arc<Schema>, values: &str) -> Outcome<Self> {
        let (message, stamps) = DynamicMessage::from_yaml_with_stamps(schema, values)?;
        let mut written = WrittenMessage { message, stamps };
        written.stamp()?;
        Ok(written)
    }

    /// Makes [`stamp`](Self::stamp) set `header.stamp` or `stamp`, too.
    pub fn add_stamp(&mut self) -> Outcome {
        let is_time = |path: &&str| self.message.get(&format!("{path}.nanosec")).is_ok();
        let Some(path) = ["header.stamp", "stamp"].into_iter().find(is_time) else {
            return Err(Failure::unusable(format!(
                "{} has neither header.stamp nor stamp that could be set",
                self.message.schema().name()
            )));
        };
        self.stamps.push(path.to_owned());
        Ok(())
    }

    /// Whether the message changes with the time.
    pub fn has_stamps(&self) -> bool {
        !self.stamps.is_empty()
    }

    /// Sets the stamps to the current time.
    pub fn stamp(&mut self) -> Outcome {
        let now_ns = wall_ns();
        let sec = i32::try_from(now_ns / 1_000_000_000).unwrap_or(i32::MAX);
        for path in &self.stamps {
            let prefix = if path.is_empty() { String::new() } else { format!("{path}.") };
            self.message.set(&format!("{prefix}sec"), sec)?;
            self.message.set(&format!("{prefix}nanosec"), (now_ns % 1_000_000_000) as u32)?;
        }
        Ok(())
    }
}

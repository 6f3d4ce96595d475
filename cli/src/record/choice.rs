// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which topics are recorded.

use super::RecordArgs;
use crate::asking::{full_name, full_type};
use crate::manners::{Failure, Outcome};
use regex::Regex;

pub struct Choice {
    topics: Vec<String>,
    all: bool,
    regex: Option<Regex>,
    types: Vec<String>,
    exclude: Option<Regex>,
}

impl Choice {
    pub fn new(args: &RecordArgs) -> Outcome<Self> {
        let regex = |text: &Option<String>| {
            text.as_deref().map(Regex::new).transpose().map_err(|error| Failure::unusable(error.to_string()))
        };
        let choice = Choice {
            topics: args.topics.iter().map(|topic| full_name(topic)).collect(),
            all: args.all,
            regex: regex(&args.regex)?,
            types: args.types.iter().map(|name| full_type(name, "msg")).collect(),
            exclude: regex(&args.exclude)?,
        };
        if !choice.all && choice.topics.is_empty() && choice.regex.is_none() && choice.types.is_empty() {
            return Err(Failure::unusable(
                "nothing to record: name topics, or give -a, --regex or --type; `taut topic list` prints which there are",
            ));
        }
        Ok(choice)
    }

    /// Topics that were asked for by their names.
    pub fn named(&self) -> &[String] {
        &self.topics
    }

    pub fn takes(&self, topic: &str, type_name: &str) -> bool {
        let is_named = self.topics.iter().any(|name| name == topic);
        let is_chosen = self.all
            || self.regex.as_ref().is_some_and(|regex| regex.is_match(topic))
            || self.types.iter().any(|name| name == type_name);
        let is_excluded = self.exclude.as_ref().is_some_and(|regex| regex.is_match(topic));
        is_named || is_chosen && !is_excluded
    }
}

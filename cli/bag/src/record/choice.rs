// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which topics are recorded.

use super::args::RecordArgs;
use super::event::EVENTS;
use regex::Regex;
use taut_cli::arguments::{full_name, full_type};
use taut_cli::verb::{Failure, Outcome};

pub struct Choice {
    topics: Vec<String>,
    all: bool,
    regex: Option<Regex>,
    types: Vec<String>,
    exclude: Option<Regex>,
}

impl Choice {
    pub fn new(args: &RecordArgs) -> Outcome<Self> {
        let regex = |text: &Option<String>| text.as_deref().map(Regex::new).transpose();
        let events = |service: &str| format!("{}{EVENTS}", full_name(service));
        let of_action = |action: &String| {
            let of = |part: &str| format!("{}/_action/{part}", full_name(action));
            let services = ["send_goal", "cancel_goal", "get_result"].map(|part| events(&of(part)));
            services.into_iter().chain(["feedback", "status"].map(of))
        };
        let topics = args.topics.iter().map(|topic| full_name(topic));
        let topics = topics.chain(args.service.iter().map(|service| events(service)));
        let choice = Choice {
            topics: topics.chain(args.action.iter().flat_map(of_action)).collect(),
            all: args.all,
            regex: regex(&args.regex)?,
            types: args.types.iter().map(|name| full_type(name, "msg")).collect(),
            exclude: regex(&args.exclude)?,
        };
        if !choice.all && choice.topics.is_empty() && choice.regex.is_none() && choice.types.is_empty() {
            return Err(Failure::unusable(
                "nothing to record: name topics, or give -a, --regex, --type, --service or --action; `taut topic list` prints which there are",
            ));
        }
        Ok(choice)
    }

    /// The topics that the command names, including those of services' events.
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

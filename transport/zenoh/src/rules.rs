// SPDX-License-Identifier: MIT OR Apache-2.0
//! Priorities on a busy link: by a rule for the topic, else by size. Small samples go first, so that images do not delay
//! commands.

use std::str::FromStr;
use tautline_analysis::file::{LinkPriority, SystemFile, TopicEntry};
use tautline_relay::{Pattern, PatternError};
use zenoh::qos::Priority;

/// How a topic's samples are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Urgency {
    /// Zenoh's priority: samples of a higher one go first.
    pub priority: Priority,
    /// Sent at once, not batched with samples of the next millisecond.
    pub express: bool,
}

/// Bodies up to this size are small: they fit into one packet with their headers.
pub const SMALL_BYTES: usize = 1024;
/// Bodies from this size on are bulk: they are split into fragments.
pub const BULK_BYTES: usize = 64 << 10;

impl Urgency {
    /// The urgency of a topic without a rule, by the size of a body.
    pub fn by_size(bytes: usize) -> Self {
        match bytes {
            // Not express: an idle link sends at once anyway, and batches use a busy one better.
            0..=SMALL_BYTES => Urgency { priority: Priority::InteractiveHigh, express: false },
            BULK_BYTES.. => Urgency { priority: Priority::DataLow, express: false },
            _ => Urgency { priority: Priority::Data, express: false },
        }
    }
}

/// `PATTERN=PRIORITY[,express]`: the priority of matching topics, whatever their size.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rule {
    topics: Pattern,
    urgency: Urgency,
}

/// An invalid rule.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RuleError {
    /// No `=`, or an unknown priority.
    #[error(
        "'{0}' is not a rule: write PATTERN=PRIORITY or PATTERN=PRIORITY,express with real_time, interactive_high, interactive_low, data_high, data, data_low or background"
    )]
    Form(String),
    /// An invalid pattern.
    #[error(transparent)]
    Pattern(#[from] PatternError),
}

impl FromStr for Rule {
    type Err = RuleError;

    fn from_str(text: &str) -> Result<Self, RuleError> {
        let malformed = || RuleError::Form(text.into());
        let (pattern, how) = text.rsplit_once('=').ok_or_else(malformed)?;
        let (name, express) = how.strip_suffix(",express").map_or((how, false), |name| (name, true));
        let named = LinkPriority::ALL.into_iter().find(|priority| priority.as_str() == name);
        // Zenoh's priorities start at 1.
        let priority = Priority::try_from(named.ok_or_else(malformed)? as u8 + 1).map_err(|_| malformed())?;
        Ok(Rule { topics: pattern.parse()?, urgency: Urgency { priority, express } })
    }
}

impl Rule {
    /// The rules of a system file, in its order: `priority` and `express` of topics.
    ///
    /// # Errors
    /// An invalid topic name.
    pub fn of_system(file: &SystemFile) -> Result<Vec<Rule>, RuleError> {
        let stated = file.topics().iter().filter_map(|topic| Some((topic, topic.priority?)));
        let rule = |(topic, priority): (&TopicEntry, LinkPriority)| {
            let name = topic.name.trim_start_matches('/');
            format!("/{name}={}{}", priority.as_str(), if topic.express { ",express" } else { "" }).parse()
        };
        stated.map(rule).collect()
    }
}

/// The urgency of the first rule that matches `topic`.
pub(crate) fn urgency_of(rules: &[Rule], topic: &str) -> Option<Urgency> {
    rules.iter().find(|rule| rule.topics.matches(topic)).map(|rule| rule.urgency)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_rule_counts_and_else_the_size() {
        let rules: Vec<Rule> = ["/imu=real_time,express", "/camera/**=background", "/**=data"]
            .map(|text| text.parse().unwrap())
            .into();
        let urgency = |priority, express| Some(Urgency { priority, express });
        assert_eq!(urgency_of(&rules, "/imu"), urgency(Priority::RealTime, true));
        assert_eq!(urgency_of(&rules, "/camera/left/image"), urgency(Priority::Background, false));
        assert_eq!(urgency_of(&rules, "/odom"), urgency(Priority::Data, false));
        assert_eq!(urgency_of(&rules[..2], "/odom"), None);
        let order = [0, SMALL_BYTES, SMALL_BYTES + 1, BULK_BYTES - 1, BULK_BYTES, usize::MAX];
        let priorities = order.map(|bytes| Urgency::by_size(bytes).priority as u8);
        assert!(priorities.is_sorted() && priorities[0] < priorities[2] && priorities[3] < priorities[4]);
    }

    #[test]
    fn a_system_file_has_rules() {
        let priorities = LinkPriority::ALL.map(|priority| {
            format!("\"/{0}\" = {{ priority = \"{0}\", express = true }}\n", priority.as_str())
        });
        let text = format!(
            "[hosts.robot]\ncores = 1\n[nodes.n]\n[callbacks.c]\nperiod = \"10ms\"\nwcet = \"1ms\"\n[topics]\nimu = {{ priority = \"data\" }}\n\"/odom\" = {{ remote = true }}\n{}",
            priorities.concat()
        );
        let rules = Rule::of_system(&SystemFile::parse(&text).unwrap()).unwrap();
        let of = |topic: &str| urgency_of(&rules, topic);
        assert_eq!(of("/imu"), Some(Urgency { priority: Priority::Data, express: false }));
        assert_eq!(of("/odom"), None);
        let order = LinkPriority::ALL.map(|priority| of(&format!("/{}", priority.as_str())).unwrap());
        assert!(order.iter().all(|urgency| urgency.express), "every name is known");
        assert!(order.map(|urgency| urgency.priority as u8).is_sorted());
    }

    #[test]
    fn rules_that_are_none() {
        for text in ["", "/imu", "/imu=", "/imu=fast", "/imu=data,expres", "imu=data"] {
            let error = text.parse::<Rule>().unwrap_err().to_string();
            assert!(error.contains("imu") || text.is_empty(), "{error}");
        }
    }
}

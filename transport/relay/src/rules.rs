// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which topics and services are mirrored, which way, and how: what the configuration and the command line say.

use crate::pattern::{Filter, Pattern};
use serde::Serialize;
use std::time::Duration;
use tautline_transport::{Durability, History, Qos, Reliability};

/// Which way messages go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// From the domain to the far side.
    Out,
    /// From the far side to the domain.
    In,
}

/// What is said of the topics that match.
#[derive(Clone, Debug, PartialEq)]
pub struct Rule {
    /// The domain's names.
    pub topic: Pattern,
    /// What they are called on the far side, if not the same: a name for a name, `/b/**` for `/a/**`.
    pub far_topic: Option<Pattern>,
    /// One way only.
    pub direction: Option<Direction>,
    /// The type that is expected.
    pub type_name: Option<String>,
    /// What the end on the far side offers or requests in place of what is there.
    pub qos: QosOverride,
    /// Shortest time between two messages; what comes sooner is dropped and counted.
    pub min_period: Option<Duration>,
    /// Only what actions consist of: what is below `_action`.
    pub is_of_actions: bool,
}

impl Rule {
    /// Everything of `topic`, as it is there.
    pub fn new(topic: Pattern) -> Self {
        let (far_topic, direction, type_name, min_period) = (None, None, None, None);
        let qos = QosOverride::default();
        Rule { topic, far_topic, direction, type_name, qos, min_period, is_of_actions: false }
    }

    fn matches(&self, topic: &str) -> bool {
        self.topic.matches(topic) && (!self.is_of_actions || topic.contains("/_action/"))
    }
}

/// Fields of a QoS that are set in place of what is there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[allow(missing_docs, reason = "as those of Qos")]
pub struct QosOverride {
    pub reliability: Option<Reliability>,
    pub durability: Option<Durability>,
    pub history: Option<History>,
    pub depth: Option<usize>,
}

impl QosOverride {
    /// `qos` with what is set here.
    #[must_use = "it returns the changed QoS"]
    pub fn applied_to(&self, qos: Qos) -> Qos {
        Qos {
            reliability: self.reliability.unwrap_or(qos.reliability),
            durability: self.durability.unwrap_or(qos.durability),
            history: self.history.unwrap_or(qos.history),
            depth: self.depth.unwrap_or(qos.depth),
            ..qos
        }
    }
}

/// All that is said of all topics.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rules {
    /// The first one that matches counts.
    pub rules: Vec<Rule>,
    /// Whether topics that no rule speaks of are mirrored too.
    pub auto: bool,
    /// Of those, which; what it denies is not mirrored whatever a rule says.
    pub filter: Filter,
}

/// What is said of one topic.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Choice {
    /// What it is called on the far side.
    pub far_topic: String,
    /// See [`Rule::direction`].
    pub direction: Option<Direction>,
    /// See [`Rule::type_name`].
    pub type_name: Option<String>,
    /// See [`Rule::qos`].
    pub qos: QosOverride,
    /// See [`Rule::min_period`].
    pub min_period: Option<Duration>,
}

impl Choice {
    /// Whether messages go this way.
    pub fn goes(&self, direction: Direction) -> bool {
        self.direction.is_none_or(|only| only == direction)
    }
}

impl Rules {
    /// What is said of the domain's `topic`; `None` if it is not mirrored.
    pub fn choice(&self, topic: &str) -> Option<Choice> {
        if self.filter.denies(topic) {
            return None;
        }
        if let Some(rule) = self.rules.iter().find(|rule| rule.matches(topic)) {
            let far_topic = rule.far_topic.as_ref().and_then(|far| translated(topic, &rule.topic, far));
            return Some(Choice {
                far_topic: far_topic.unwrap_or_else(|| topic.to_owned()),
                direction: rule.direction,
                type_name: rule.type_name.clone(),
                qos: rule.qos,
                min_period: rule.min_period,
            });
        }
        (self.auto && self.filter.allows(topic))
            .then(|| Choice { far_topic: topic.to_owned(), ..Choice::default() })
    }

    /// What the topic `far_topic` of the far side is called here; `None` if it is not mirrored.
    pub fn here_name(&self, far_topic: &str) -> Option<String> {
        let renamed = self.rules.iter().find_map(|rule| {
            let topic = translated(far_topic, rule.far_topic.as_ref()?, &rule.topic)?;
            self.choice(&topic).filter(|choice| choice.far_topic == far_topic).map(|_| topic)
        });
        renamed.or_else(|| {
            self.choice(far_topic)
                .filter(|choice| choice.far_topic == far_topic)
                .map(|_| far_topic.to_owned())
        })
    }
}

/// `/b/x` for `/a/x`, by `/a/**` and `/b/**`; `/b` for `/a`, by `/a` and `/b`.
fn translated(name: &str, from: &Pattern, to: &Pattern) -> Option<String> {
    if let (Some(from), Some(to)) = (from.exact(), to.exact()) {
        return (name == from).then(|| to.to_owned());
    }
    let rest = name.strip_prefix(from.prefix()?)?;
    let to = to.prefix()?;
    (rest.starts_with('/') && rest.len() > 1).then(|| format!("{to}{rest}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(text: &str) -> Pattern {
        text.parse().unwrap()
    }

    fn renaming(topic: &str, far_topic: &str) -> Rule {
        Rule { far_topic: Some(pattern(far_topic)), ..Rule::new(pattern(topic)) }
    }

    #[test]
    fn names_go_both_ways() {
        let rules = Rules {
            rules: vec![renaming("/a", "/b"), renaming("/robot/**", "/r1/**"), Rule::new(pattern("/same"))],
            ..Rules::default()
        };
        for (here, there) in [("/a", "/b"), ("/robot/x/y", "/r1/x/y"), ("/same", "/same")] {
            assert_eq!(rules.choice(here).unwrap().far_topic, there);
            assert_eq!(rules.here_name(there).as_deref(), Some(here));
        }
        for name in ["/b", "/r1/x", "/other"] {
            assert_eq!(rules.choice(name), None, "{name}");
        }
        for name in ["/a", "/robot/x", "/other"] {
            assert_eq!(rules.here_name(name), None, "{name}");
        }
    }

    #[test]
    fn auto_allow_and_deny() {
        let filter = Filter { deny: vec![pattern("/camera/**")], ..Filter::default() };
        let auto = Rules { auto: true, filter, ..Rules::default() };
        assert!(auto.choice("/x").is_some() && auto.choice("/camera/raw").is_none());
        let filter = Filter { allow: vec![pattern("/a/*")], ..auto.filter };
        let only = Rules { filter, rules: vec![Rule::new(pattern("/b"))], ..auto };
        let bridged = ["/a/x", "/b"].map(|name| only.choice(name).is_some());
        assert_eq!((bridged, only.choice("/x")), ([true, true], None));
        assert_eq!(Rules { auto: false, ..only }.choice("/a/x"), None);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rules of the configuration and the command line: which topics and services are mirrored, in which direction, and how.

use crate::pattern::{Filter, Pattern};
use serde::Serialize;
use std::time::Duration;
use tautline_transport::{Durability, History, Qos, Reliability};

/// Direction of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// From the domain to the far side.
    Out,
    /// From the far side to the domain.
    In,
}

/// A rule for matching topics.
#[derive(Clone, Debug, PartialEq)]
pub struct Rule {
    /// The names in the domain.
    pub topic: Pattern,
    /// The names on the far side, if different: a name for a name, `/b/**` for `/a/**`.
    pub far_topic: Option<Pattern>,
    /// The direction to mirror; `None`: both.
    pub direction: Option<Direction>,
    /// The expected type.
    pub type_name: Option<String>,
    /// QoS overrides of the endpoint on the far side.
    pub qos: QosOverride,
    /// Shortest time between two messages; earlier ones are dropped and counted.
    pub min_period: Option<Duration>,
    /// Matches only names below `_action`.
    pub is_of_actions: bool,
}

impl Rule {
    /// Mirrors `topic` unchanged.
    pub fn new(topic: Pattern) -> Self {
        let (far_topic, direction, type_name, min_period) = (None, None, None, None);
        let qos = QosOverride::default();
        Rule { topic, far_topic, direction, type_name, qos, min_period, is_of_actions: false }
    }

    fn matches(&self, topic: &str) -> bool {
        self.topic.matches(topic) && (!self.is_of_actions || topic.contains("/_action/"))
    }
}

/// QoS policies to override.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[allow(missing_docs, reason = "like those of Qos")]
pub struct QosOverride {
    pub reliability: Option<Reliability>,
    pub durability: Option<Durability>,
    pub history: Option<History>,
    pub depth: Option<usize>,
}

impl QosOverride {
    /// `qos` with these overrides.
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

/// All rules.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rules {
    /// Rules for topics, of which the first match counts.
    pub rules: Vec<Rule>,
    /// Whether topics without a rule are mirrored too.
    pub auto: bool,
    /// Selects topics without a rule. Topics that it denies are never mirrored, even if a rule matches.
    pub filter: Filter,
}

/// How one topic is mirrored.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Choice {
    /// Its name on the far side.
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
    /// Whether messages go in this direction.
    pub fn allows(&self, direction: Direction) -> bool {
        self.direction.is_none_or(|only| only == direction)
    }
}

impl Rules {
    /// How the domain's `topic` is mirrored; `None`: not at all.
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

    /// The domain's name for the topic `far_topic`; `None` if it is not mirrored.
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

/// Translates a name: `/a/x` to `/b/x` and `/a` to `/b` by the patterns `/a/**` and `/b/**`; `/a` to `/b` by `/a` and `/b`.
fn translated(name: &str, from: &Pattern, to: &Pattern) -> Option<String> {
    if let (Some(from), Some(to)) = (from.exact(), to.exact()) {
        return (name == from).then(|| to.to_owned());
    }
    let rest = name.strip_prefix(from.prefix()?)?;
    let is_whole = rest.is_empty() || (rest.starts_with('/') && rest.len() > 1);
    let translated = format!("{}{rest}", to.prefix()?);
    (is_whole && !translated.is_empty()).then_some(translated)
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
        for (here, there) in [("/a", "/b"), ("/robot/x/y", "/r1/x/y"), ("/robot", "/r1"), ("/same", "/same")]
        {
            assert_eq!(rules.choice(here).unwrap().far_topic, there);
            assert_eq!(rules.here_name(there).as_deref(), Some(here));
        }
        for name in ["/b", "/r1/x", "/other"] {
            assert_eq!(rules.choice(name), None, "{name}");
        }
        for name in ["/a", "/robot/x", "/other"] {
            assert_eq!(rules.here_name(name), None, "{name}");
        }
        // No name is left of it without the prefix.
        let rules = Rules { rules: vec![renaming("/r1/**", "/**")], ..Rules::default() };
        assert_eq!(["/r1/x", "/r1"].map(|name| rules.choice(name).unwrap().far_topic), ["/x", "/r1"]);
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

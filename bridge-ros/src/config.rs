// SPDX-License-Identifier: MIT OR Apache-2.0
//! The configuration file: which topics are bridged, and how. All errors are reported at once, with their lines.

use crate::rcl::{is_message_type, is_service_type};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_relay::{Direction, Filter, Pattern, QosOverride, Rule, Rules};
use tautline_transport::{Durability, History, Limits, MAX_DOMAIN, Reliability};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// The content of a configuration file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Config {
    /// Tautline's domain.
    pub domain: Option<u32>,
    /// ROS's domain.
    pub ros_domain: Option<u32>,
    /// Rules for topics.
    pub rules: Rules,
    /// Rules for services.
    pub services: Rules,
    /// Whether endpoints that gateways and other bridges announce in Tautline's domain are mirrored into ROS; `None`: yes.
    pub transit: Option<bool>,
}

/// An error in a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {message}")]
pub struct Problem {
    /// Counted from 1.
    pub line: usize,
    /// The error and the fix.
    pub message: String,
}

/// Why a file cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum ConfigError {
    /// It cannot be read.
    #[error("{} cannot be read: {source}", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    /// Its content is invalid.
    #[error("{} has {} problem(s):\n{}", path.display(), problems.len(), listed(problems))]
    Content { path: PathBuf, problems: Vec<Problem> },
}

fn listed(problems: &[Problem]) -> String {
    problems.iter().map(|problem| format!("  {problem}")).collect::<Vec<_>>().join("\n")
}

impl Config {
    /// Reads a file.
    ///
    /// # Errors
    /// [`ConfigError`], with all errors of the file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, ConfigError> {
        let path = path.as_ref().to_owned();
        match std::fs::read_to_string(&path) {
            Err(source) => Err(ConfigError::Read { path, source }),
            Ok(text) => Self::parse(&text).map_err(|problems| ConfigError::Content { path, problems }),
        }
    }

    /// Reads the text of a file.
    ///
    /// ```
    /// let text = "[[topic]]\ntopic = '/odom'\ndirection = 'to_ross'\nmax_rate_hz = 0\n";
    /// let problems = tautline_bridge_ros::Config::parse(text).unwrap_err();
    /// assert_eq!(problems[0].to_string(), "line 3: `direction` is \"to_ross\": write \"to_ros\", \"from_ros\" or \"both\"");
    /// assert_eq!(problems[1].line, 4);
    /// ```
    ///
    /// # Errors
    /// All errors of the file, in the order of the lines.
    pub fn parse(text: &str) -> Result<Self, Vec<Problem>> {
        let (root, broken) = DeTable::parse_recoverable(text);
        let mut reader = Reader { text, problems: Vec::new() };
        for error in broken {
            let at = error.span().map_or(0, |span| span.start);
            reader.add(at, error.message().trim().replace('\n', ", "));
        }
        let config = reader.config(root.get_ref());
        reader.problems.sort_by_key(|problem| problem.line);
        if reader.problems.is_empty() { Ok(config) } else { Err(reader.problems) }
    }
}

type Value<'t> = Spanned<DeValue<'t>>;

struct Reader<'t> {
    text: &'t str,
    problems: Vec<Problem>,
}

/// A table that records which keys were read; the others are unknown.
struct Section<'t> {
    table: &'t DeTable<'t>,
    title: &'static str,
    asked: BTreeSet<&'static str>,
}

impl<'t> Section<'t> {
    fn new(table: &'t DeTable<'t>, title: &'static str) -> Self {
        Section { table, title, asked: BTreeSet::new() }
    }

    fn get(&mut self, key: &'static str) -> Option<&'t Value<'t>> {
        self.asked.insert(key);
        self.table.get(key)
    }
}

impl<'t> Reader<'t> {
    fn add(&mut self, at: usize, message: String) {
        let line = self.text.bytes().take(at).filter(|&byte| byte == b'\n').count() + 1;
        self.problems.push(Problem { line, message });
    }

    /// Reports an error of `value`, which is not used.
    fn refuse<T>(&mut self, value: &Value<'_>, message: String) -> Option<T> {
        self.add(value.span().start, message);
        None
    }

    fn config(&mut self, root: &'t DeTable<'t>) -> Config {
        let mut root = Section::new(root, "the file");
        let domain = self.integer(&mut root, "domain", 0, MAX_DOMAIN.into());
        let ros_domain = self.integer(&mut root, "ros_domain", 0, MAX_DOMAIN.into());
        let auto = self.flag(&mut root, "auto").unwrap_or(false);
        let transit = self.flag(&mut root, "transit");
        let (allow, deny) = (self.patterns(&mut root, "allow"), self.patterns(&mut root, "deny"));
        let mut rules = self.rules(&mut root, "topic", Self::rule);
        let mut services = self.rules(&mut root, "service", Self::service);
        for action in self.rules(&mut root, "action", Self::action) {
            rules.push(action.clone());
            services.push(action);
        }
        self.unknown(&root);
        let filter = Filter { allow, deny };
        let services = Rules { rules: services, auto, filter: filter.clone() };
        Config { domain, ros_domain, rules: Rules { rules, auto, filter }, services, transit }
    }

    /// The tables `[[name]]`.
    fn rules(
        &mut self,
        root: &mut Section<'t>,
        name: &'static str,
        read: fn(&mut Self, &'t Value<'t>) -> Option<Rule>,
    ) -> Vec<Rule> {
        let mut rules: Vec<Rule> = Vec::new();
        let Some(value) = root.get(name) else { return rules };
        let DeValue::Array(tables) = value.get_ref() else {
            self.add(value.span().start, format!("`{name}` must be tables: write [[{name}]] above each"));
            return rules;
        };
        for table in tables.iter() {
            let Some(rule) = read(self, table) else { continue };
            if rules.iter().any(|before| before.topic == rule.topic) {
                let topic = &rule.topic;
                let message =
                    format!("`{name}` \"{topic}\" is listed twice: the first one counts; remove the other");
                self.add(table.span().start, message);
            }
            rules.push(rule);
        }
        rules
    }

    fn rule(&mut self, value: &'t Value<'t>) -> Option<Rule> {
        let (mut section, rule) = self.entry(value, "[[topic]]", "topic", "ros_topic")?;
        let what = "messages: write package/msg/Name, such as \"std_msgs/msg/String\"";
        let type_name = self.type_name(&mut section, is_message_type, what);
        let max_rate_hz = self.rate(&mut section);
        let qos = self.qos(&mut section);
        self.unknown(&section);
        let min_period = max_rate_hz.map(|rate| Duration::from_secs_f64(1.0 / rate));
        Some(Rule { type_name, qos, min_period, ..rule? })
    }

    fn service(&mut self, value: &'t Value<'t>) -> Option<Rule> {
        let (mut section, rule) = self.entry(value, "[[service]]", "service", "ros_service")?;
        let what = "services: write package/srv/Name, such as \"std_srvs/srv/SetBool\"";
        let type_name = self.type_name(&mut section, is_service_type, what);
        self.unknown(&section);
        Some(Rule { type_name, ..rule? })
    }

    /// One rule for the services and topics of an action.
    fn action(&mut self, value: &'t Value<'t>) -> Option<Rule> {
        let (section, rule) = self.entry(value, "[[action]]", "action", "ros_action")?;
        self.unknown(&section);
        let parts = |action: Pattern| match action.exact() {
            Some(name) => format!("{name}/_action/**").parse().ok(),
            None => Some(action),
        };
        let Rule { topic, far_topic, direction, .. } = rule?;
        let far_topic = far_topic.and_then(parts);
        Some(Rule { far_topic, direction, is_of_actions: true, ..Rule::new(parts(topic)?) })
    }

    /// The common keys of all entries: names and a direction. The rule is `None` if the name is missing.
    fn entry(
        &mut self,
        value: &'t Value<'t>,
        title: &'static str,
        key: &'static str,
        ros_key: &'static str,
    ) -> Option<(Section<'t>, Option<Rule>)> {
        let DeValue::Table(table) = value.get_ref() else {
            return self.refuse(value, format!("{title} must be tables, not {}", kind(value.get_ref())));
        };
        let mut section = Section::new(table, title);
        let name = match section.get(key) {
            Some(value) => self.pattern(key, value),
            None => {
                let example = format!("{key} = \"/name\" or a pattern such as \"/camera/**\"");
                self.refuse(value, format!("{title} has no `{key}`: add {example}"))
            }
        };
        let far_topic = section.get(ros_key).and_then(|value| {
            let ros_name = self.pattern(ros_key, value)?;
            let name = name.as_ref()?;
            let can_be = match (name.exact(), name.prefix()) {
                (Some(_), _) => ros_name.exact().is_some(),
                (_, Some(_)) => ros_name.prefix().is_some(),
                _ => false,
            };
            if can_be {
                return Some(ros_name);
            }
            let message = format!(
                "`{ros_key}` \"{ros_name}\" does not rename \"{name}\": a name can be renamed to a name, \"/a/**\" to \"/b/**\""
            );
            self.refuse(value, message)
        });
        let direction = self.direction(&mut section);
        Some((section, name.map(|name| Rule { far_topic, direction, ..Rule::new(name) })))
    }

    fn type_name(
        &mut self,
        section: &mut Section<'t>,
        is_one: fn(&str) -> bool,
        what: &str,
    ) -> Option<String> {
        let value = section.get("type")?;
        let name = self.text_of("type", value)?;
        if is_one(name) {
            return Some(name.to_owned());
        }
        self.refuse(value, format!("`type` \"{name}\" is not a type of {what}"))
    }

    fn direction(&mut self, section: &mut Section<'t>) -> Option<Direction> {
        let choices = [("to_ros", Some(Direction::Out)), ("from_ros", Some(Direction::In)), ("both", None)];
        self.one_of(section, "direction", &choices).flatten()
    }

    fn qos(&mut self, section: &mut Section<'t>) -> QosOverride {
        let Some(value) = section.get("qos") else { return QosOverride::default() };
        let DeValue::Table(table) = value.get_ref() else {
            let kind = kind(value.get_ref());
            let message = format!("`qos` must be a table, not {kind}: write qos = {{ depth = 10 }}");
            return self.refuse(value, message).unwrap_or_default();
        };
        let mut qos = Section::new(table, "`qos`");
        let reliability = [("reliable", Reliability::Reliable), ("best_effort", Reliability::BestEffort)];
        let durability =
            [("volatile", Durability::Volatile), ("transient_local", Durability::TransientLocal)];
        let history = [("keep_last", History::KeepLast), ("keep_all", History::KeepAll)];
        let read = QosOverride {
            reliability: self.one_of(&mut qos, "reliability", &reliability),
            durability: self.one_of(&mut qos, "durability", &durability),
            history: self.one_of(&mut qos, "history", &history),
            depth: self.integer(&mut qos, "depth", 1, Limits::MAX_DEPTH as i64),
        };
        self.unknown(&qos);
        read
    }

    fn flag(&mut self, section: &mut Section<'t>, key: &'static str) -> Option<bool> {
        let value = section.get(key)?;
        if let DeValue::Boolean(flag) = value.get_ref() {
            return Some(*flag);
        }
        self.refuse(value, format!("`{key}` must be true or false, not {}", kind(value.get_ref())))
    }

    fn integer<T: TryFrom<i64>>(
        &mut self,
        section: &mut Section<'t>,
        key: &'static str,
        least: i64,
        most: i64,
    ) -> Option<T> {
        let value = section.get(key)?;
        let number = match value.get_ref() {
            DeValue::Integer(number) => {
                i64::from_str_radix(&number.as_str().replace('_', ""), number.radix()).ok()
            }
            _ => None,
        };
        let number = number.filter(|number| (least..=most).contains(number));
        number.and_then(|number| number.try_into().ok()).or_else(|| {
            let message =
                format!("`{key}` is {}: write a whole number from {least} to {most}", described(value));
            self.refuse(value, message)
        })
    }

    fn rate(&mut self, section: &mut Section<'t>) -> Option<f64> {
        let value = section.get("max_rate_hz")?;
        let number: Option<f64> = match value.get_ref() {
            DeValue::Integer(number) => number.as_str().replace('_', "").parse().ok(),
            DeValue::Float(number) => number.as_str().replace('_', "").parse().ok(),
            _ => None,
        };
        number.filter(|rate| (1e-3..=1e6).contains(rate)).or_else(|| {
            let what = "messages per second, from 0.001 to 1000000";
            self.refuse(value, format!("`max_rate_hz` is {}: write {what}", described(value)))
        })
    }

    fn one_of<T: Copy>(
        &mut self,
        section: &mut Section<'t>,
        key: &'static str,
        choices: &[(&str, T)],
    ) -> Option<T> {
        let value = section.get(key)?;
        let chosen = match value.get_ref() {
            DeValue::String(text) => choices.iter().find(|(name, _)| *name == &**text),
            _ => None,
        };
        chosen.map(|(_, chosen)| *chosen).or_else(|| {
            let names: Vec<String> = choices.iter().map(|(name, _)| format!("\"{name}\"")).collect();
            let (last, others) = names.split_last()?;
            self.refuse(
                value,
                format!("`{key}` is {}: write {} or {last}", described(value), others.join(", ")),
            )
        })
    }

    fn text_of(&mut self, key: &'static str, value: &'t Value<'t>) -> Option<&'t str> {
        if let DeValue::String(text) = value.get_ref() {
            return Some(text);
        }
        self.refuse(value, format!("`{key}` must be a string in quotes, not {}", kind(value.get_ref())))
    }

    fn pattern(&mut self, key: &'static str, value: &'t Value<'t>) -> Option<Pattern> {
        let text = self.text_of(key, value)?;
        text.parse().map_err(|error| self.add(value.span().start, format!("`{key}`: {error}"))).ok()
    }

    fn patterns(&mut self, section: &mut Section<'t>, key: &'static str) -> Vec<Pattern> {
        let Some(value) = section.get(key) else { return Vec::new() };
        match value.get_ref() {
            DeValue::Array(array) => array.iter().filter_map(|value| self.pattern(key, value)).collect(),
            _ => self.pattern(key, value).into_iter().collect(),
        }
    }

    fn unknown(&mut self, section: &Section<'t>) {
        for key in section.table.keys() {
            if !section.asked.contains(&**key.get_ref()) {
                let known: Vec<&str> = section.asked.iter().copied().collect();
                let message =
                    format!("{} has no `{}`: it can have {}", section.title, key.get_ref(), known.join(", "));
                self.add(key.span().start, message);
            }
        }
    }
}

fn described(value: &Value<'_>) -> String {
    match value.get_ref() {
        DeValue::String(text) => format!("\"{text}\""),
        DeValue::Integer(number) => number.as_str().to_owned(),
        DeValue::Float(number) => number.as_str().to_owned(),
        other => kind(other).to_owned(),
    }
}

fn kind(value: &DeValue<'_>) -> &'static str {
    match value {
        DeValue::String(_) => "a string",
        DeValue::Integer(_) => "a number",
        DeValue::Float(_) => "a number with a fraction",
        DeValue::Boolean(_) => "true or false",
        DeValue::Datetime(_) => "a date",
        DeValue::Array(_) => "an array",
        DeValue::Table(_) => "a table",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_file_says() {
        let text = r#"
            domain = 5
            ros_domain = 0x10
            auto = true
            deny = ["/camera/**", "/tmp"]
            allow = "/**"
            [[topic]]
            topic = "/robot/**"
            ros_topic = "/r1/**"
            direction = "to_ros"
            type = "nav_msgs/msg/Odometry"
            qos = { reliability = "best_effort", durability = "transient_local", history = "keep_last", depth = 5 }
            max_rate_hz = 12.5
            [[topic]]
            topic = "/plain"
            direction = "both"
            max_rate_hz = 1
            [[service]]
            service = "/set"
            ros_service = "/r1/set"
            direction = "from_ros"
            type = "std_srvs/srv/SetBool"
            [[action]]
            action = "/dock"
            ros_action = "/r1/dock"
            [[action]]
            action = "/arm/**"
            ros_action = "/ros_arm/**"
            direction = "to_ros"
        "#;
        let config = Config::parse(text).unwrap();
        assert_eq!((config.domain, config.ros_domain), (Some(5), Some(16)));
        let choice = config.rules.choice("/robot/odom").unwrap();
        assert_eq!((&*choice.far_topic, choice.direction), ("/r1/odom", Some(Direction::Out)));
        assert_eq!(choice.min_period, Some(Duration::from_millis(80)));
        assert_eq!(choice.qos.depth, Some(5));
        assert_eq!(choice.type_name.as_deref(), Some("nav_msgs/msg/Odometry"));
        let plain = config.rules.choice("/plain").unwrap();
        assert_eq!((plain.direction, plain.min_period), (None, Some(Duration::from_secs(1))));
        assert!(config.rules.choice("/camera/rgb").is_none() && config.rules.choice("/other").is_some());
        let choice = config.services.choice("/set").unwrap();
        assert_eq!((&*choice.far_topic, choice.direction), ("/r1/set", Some(Direction::In)));
        assert_eq!(choice.type_name.as_deref(), Some("std_srvs/srv/SetBool"));
        for rules in [&config.rules, &config.services] {
            let dock = rules.choice("/dock/_action/feedback").unwrap();
            assert_eq!((&*dock.far_topic, dock.direction), ("/r1/dock/_action/feedback", None));
            let arm = rules.choice("/arm/left/_action/status").unwrap();
            assert_eq!(
                (&*arm.far_topic, arm.direction),
                ("/ros_arm/left/_action/status", Some(Direction::Out))
            );
            // Not of an action: as if there were no rule.
            let other = rules.choice("/arm/joint_states").unwrap();
            assert_eq!((&*other.far_topic, other.direction), ("/arm/joint_states", None));
            assert_eq!(
                rules.here_name("/ros_arm/left/_action/status").as_deref(),
                Some("/arm/left/_action/status")
            );
        }
        assert!(
            config.services.choice("/camera/set").is_none() && config.services.choice("/other").is_some()
        );
        assert_eq!(Config::parse("").unwrap(), Config::default());
    }

    #[test]
    fn all_that_is_wrong_is_said_at_once_with_its_line() {
        let text = r#"domain = 233
auto = "yes"
allow = ["camera"]
colour = 1
[[topic]]
ros_topic = "/x"
[[topic]]
topic = "/*/a"
ros_topic = "/b"
direction = "out"
type = "String"
max_rate_hz = 0
qos = { depth = 0, reliability = "yes", deadline = 1 }
[[topic]]
topic = "/same"
[[topic]]
topic = "/same"
[[service]]
service = "/a"
type = "std_srvs/msg/SetBool"
[[action]]
direction = 7
"#;
        let problems = Config::parse(text).unwrap_err();
        let lines: Vec<usize> = problems.iter().map(|problem| problem.line).collect();
        assert_eq!(lines, [1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 13, 13, 16, 20, 21, 22]);
        let said = problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n");
        for part in [
            "`domain` is 233: write a whole number from 0 to 232",
            "`auto` must be true or false, not a string",
            "'camera' is not a pattern",
            "the file has no `colour`: it can have action, allow, auto, deny, domain, ros_domain, service, topic, transit",
            "[[topic]] has no `topic`",
            "`ros_topic` \"/b\" does not rename \"/*/a\"",
            "`direction` is \"out\": write \"to_ros\", \"from_ros\" or \"both\"",
            "`type` \"String\" is not a type",
            "`max_rate_hz` is 0",
            "`depth` is 0",
            "`reliability` is \"yes\": write \"reliable\" or \"best_effort\"",
            "`qos` has no `deadline`: it can have depth, durability, history, reliability",
            "\"/same\" is listed twice",
            "`type` \"std_srvs/msg/SetBool\" is not a type of services",
            "[[action]] has no `action`",
            "`direction` is 7",
        ] {
            assert!(said.contains(part), "{part}\n{said}");
        }
    }

    #[test]
    fn what_is_no_toml_has_its_line_too() {
        let problems = Config::parse("[[topic]]\ntopic = \n").unwrap_err();
        assert_eq!(problems[0].line, 2, "{problems:?}");
        let message = Config::read("/no/such.toml").unwrap_err().to_string();
        assert!(message.contains("/no/such.toml"), "{message}");
    }
}

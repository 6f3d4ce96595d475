// SPDX-License-Identifier: MIT OR Apache-2.0
//! The file that says which topics are bridged, and how. All that is wrong with it is said at once, with its line.

use crate::rcl::{is_message_type, is_service_type};
use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_relay::{Direction, Filter, Pattern, QosOverride, Rule, Rules};
use tautline_transport::{Durability, History, Limits, MAX_DOMAIN, Reliability};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// What a file says.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Config {
    /// Tautline's domain.
    pub domain: Option<u32>,
    /// ROS's domain.
    pub ros_domain: Option<u32>,
    /// Which topics.
    pub rules: Rules,
    /// Which services.
    pub services: Rules,
    /// Whether what others tell of in Tautline's domain is put into ROS too: it is, unless it says otherwise.
    pub transit: Option<bool>,
}

/// Something that is wrong with a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Counted from 1.
    pub line: usize,
    /// What is wrong, and what to write.
    pub message: String,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "line {}: {}", self.line, self.message)
    }
}

/// Why a file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// It cannot be read.
    #[error("{} cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It says what cannot be meant.
    #[error("{} has {} problem(s):\n{}", path.display(), problems.len(), listed(problems))]
    Content {
        /// The file.
        path: PathBuf,
        /// All of them, in the order of the lines.
        problems: Vec<Problem>,
    },
}

fn listed(problems: &[Problem]) -> String {
    problems.iter().map(|problem| format!("  {problem}")).collect::<Vec<_>>().join("\n")
}

impl Config {
    /// Reads a file.
    ///
    /// # Errors
    /// [`ConfigError`], with all that is wrong with it.
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
    /// All that is wrong with it, in the order of the lines.
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

/// A table whose keys are asked for one by one; what nobody asked for is unknown.
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

    fn config(&mut self, root: &'t DeTable<'t>) -> Config {
        let mut root = Section::new(root, "the file");
        let domain = self.domain(&mut root, "domain");
        let ros_domain = self.domain(&mut root, "ros_domain");
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
        match root.get(name).map(|value| (value.span().start, value.get_ref())) {
            None => {}
            Some((_, DeValue::Array(tables))) => {
                for table in tables.iter() {
                    let rule = read(self, table);
                    if let Some(rule) = &rule
                        && rules.iter().any(|before| before.topic == rule.topic)
                    {
                        let message = format!(
                            "`{name}` \"{}\" is spoken of before: only that counts; remove one of both",
                            rule.topic
                        );
                        self.add(table.span().start, message);
                    }
                    rules.extend(rule);
                }
            }
            Some((at, _)) => self.add(at, format!("`{name}` must be tables: write [[{name}]] above each")),
        }
        rules
    }

    fn rule(&mut self, value: &'t Value<'t>) -> Option<Rule> {
        let mut section = self.table(value, "[[topic]]")?;
        let (topic, ros_topic) = self.names(&mut section, value.span().start, "topic", "ros_topic");
        let direction = self.direction(&mut section);
        let type_name = section.get("type").and_then(|value| {
            let name = self.text_of("type", value)?;
            let is_one = is_message_type(name);
            if !is_one {
                let message = format!("`type` \"{name}\" is no type of messages: write package/msg/Name, such as \"std_msgs/msg/String\"");
                self.add(value.span().start, message);
            }
            is_one.then(|| name.to_owned())
        });
        let max_rate_hz = section.get("max_rate_hz").and_then(|value| self.rate(value));
        let qos = self.qos(&mut section);
        self.unknown(&section);
        Some(Rule {
            topic: topic?,
            far_topic: ros_topic,
            direction,
            type_name,
            qos,
            min_period: max_rate_hz.map(|rate| Duration::from_secs_f64(1.0 / rate)),
            is_of_actions: false,
        })
    }

    fn service(&mut self, value: &'t Value<'t>) -> Option<Rule> {
        let mut section = self.table(value, "[[service]]")?;
        let (service, ros_service) = self.names(&mut section, value.span().start, "service", "ros_service");
        let direction = self.direction(&mut section);
        let type_name = section.get("type").and_then(|value| {
            let name = self.text_of("type", value)?;
            let is_one = is_service_type(name);
            if !is_one {
                let message = format!("`type` \"{name}\" is no type of services: write package/srv/Name, such as \"std_srvs/srv/SetBool\"");
                self.add(value.span().start, message);
            }
            is_one.then(|| name.to_owned())
        });
        self.unknown(&section);
        Some(Rule { far_topic: ros_service, direction, type_name, ..Rule::new(service?) })
    }

    /// What an action consists of: a rule for its services and its topics alike.
    fn action(&mut self, value: &'t Value<'t>) -> Option<Rule> {
        let mut section = self.table(value, "[[action]]")?;
        let (action, ros_action) = self.names(&mut section, value.span().start, "action", "ros_action");
        let direction = self.direction(&mut section);
        self.unknown(&section);
        let parts = |action: Pattern| match action.exact() {
            Some(name) => format!("{name}/_action/**").parse().ok(),
            None => Some(action),
        };
        let far_topic = ros_action.and_then(parts);
        Some(Rule { far_topic, direction, is_of_actions: true, ..Rule::new(action.and_then(parts)?) })
    }

    fn table(&mut self, value: &'t Value<'t>, title: &'static str) -> Option<Section<'t>> {
        if let DeValue::Table(table) = value.get_ref() {
            return Some(Section::new(table, title));
        }
        let message = format!("{title} must be tables, not {}", kind(value.get_ref()));
        self.add(value.span().start, message);
        None
    }

    /// A name or pattern, and what it is called in ROS.
    fn names(
        &mut self,
        section: &mut Section<'t>,
        at: usize,
        key: &'static str,
        ros_key: &'static str,
    ) -> (Option<Pattern>, Option<Pattern>) {
        let name = match section.get(key) {
            Some(value) => self.pattern(key, value),
            None => {
                let title = section.title;
                self.add(
                    at,
                    format!(
                        "{title} has no `{key}`: add {key} = \"/name\" or a pattern such as \"/camera/**\""
                    ),
                );
                None
            }
        };
        let ros_name = section.get(ros_key).and_then(|value| {
            let ros_name = self.pattern(ros_key, value)?;
            let name = name.as_ref()?;
            let can_be = match (name.exact(), name.prefix()) {
                (Some(_), _) => ros_name.exact().is_some(),
                (_, Some(_)) => ros_name.prefix().is_some(),
                _ => false,
            };
            if !can_be {
                let message = format!(
                    "`{ros_key}` \"{ros_name}\" does not rename \"{name}\": a name can be renamed to a name, \"/a/**\" to \"/b/**\""
                );
                self.add(value.span().start, message);
            }
            can_be.then_some(ros_name)
        });
        (name, ros_name)
    }

    fn direction(&mut self, section: &mut Section<'t>) -> Option<Direction> {
        let choices = [("to_ros", Some(Direction::Out)), ("from_ros", Some(Direction::In)), ("both", None)];
        self.one_of(section, "direction", &choices).flatten()
    }

    fn qos(&mut self, section: &mut Section<'t>) -> QosOverride {
        let Some(value) = section.get("qos") else { return QosOverride::default() };
        let DeValue::Table(table) = value.get_ref() else {
            let message =
                format!("`qos` must be a table, not {}: write qos = {{ depth = 10 }}", kind(value.get_ref()));
            self.add(value.span().start, message);
            return QosOverride::default();
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
            depth: self
                .integer(&mut qos, "depth", 1, Limits::MAX_DEPTH as i64)
                .and_then(|depth| usize::try_from(depth).ok()),
        };
        self.unknown(&qos);
        read
    }

    fn domain(&mut self, section: &mut Section<'t>, key: &'static str) -> Option<u32> {
        self.integer(section, key, 0, i64::from(MAX_DOMAIN)).and_then(|domain| u32::try_from(domain).ok())
    }

    fn flag(&mut self, section: &mut Section<'t>, key: &'static str) -> Option<bool> {
        let value = section.get(key)?;
        if let DeValue::Boolean(flag) = value.get_ref() {
            return Some(*flag);
        }
        self.add(value.span().start, format!("`{key}` must be true or false, not {}", kind(value.get_ref())));
        None
    }

    fn integer(
        &mut self,
        section: &mut Section<'t>,
        key: &'static str,
        least: i64,
        most: i64,
    ) -> Option<i64> {
        let value = section.get(key)?;
        let number = match value.get_ref() {
            DeValue::Integer(number) => {
                i64::from_str_radix(&number.as_str().replace('_', ""), number.radix()).ok()
            }
            _ => None,
        };
        let number = number.filter(|number| (least..=most).contains(number));
        if number.is_none() {
            let message = format!("`{key}` is {}: write a whole number from {least} to {most}", shown(value));
            self.add(value.span().start, message);
        }
        number
    }

    fn rate(&mut self, value: &'t Value<'t>) -> Option<f64> {
        let number: Option<f64> = match value.get_ref() {
            DeValue::Integer(number) => number.as_str().replace('_', "").parse().ok(),
            DeValue::Float(number) => number.as_str().replace('_', "").parse().ok(),
            _ => None,
        };
        let rate = number.filter(|rate| (1e-3..=1e6).contains(rate));
        if rate.is_none() {
            let message = format!(
                "`max_rate_hz` is {}: write messages per second, from 0.001 to 1000000",
                shown(value)
            );
            self.add(value.span().start, message);
        }
        rate
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
        if chosen.is_none() {
            let names: Vec<String> = choices.iter().map(|(name, _)| format!("\"{name}\"")).collect();
            let (last, others) = names.split_last()?;
            let message = format!("`{key}` is {}: write {} or {last}", shown(value), others.join(", "));
            self.add(value.span().start, message);
        }
        chosen.map(|(_, chosen)| *chosen)
    }

    fn text_of(&mut self, key: &'static str, value: &'t Value<'t>) -> Option<&'t str> {
        if let DeValue::String(text) = value.get_ref() {
            return Some(text);
        }
        self.add(
            value.span().start,
            format!("`{key}` must be a text in quotes, not {}", kind(value.get_ref())),
        );
        None
    }

    fn pattern(&mut self, key: &'static str, value: &'t Value<'t>) -> Option<Pattern> {
        let text = self.text_of(key, value)?;
        text.parse().map_err(|error| self.add(value.span().start, format!("`{key}`: {error}"))).ok()
    }

    fn patterns(&mut self, section: &mut Section<'t>, key: &'static str) -> Vec<Pattern> {
        match section.get(key).map(|value| (value, value.get_ref())) {
            None => Vec::new(),
            Some((_, DeValue::Array(array))) => {
                array.iter().filter_map(|value| self.pattern(key, value)).collect()
            }
            Some((value, _)) => self.pattern(key, value).into_iter().collect(),
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

fn shown(value: &Value<'_>) -> String {
    match value.get_ref() {
        DeValue::String(text) => format!("\"{text}\""),
        DeValue::Integer(number) => number.as_str().to_owned(),
        DeValue::Float(number) => number.as_str().to_owned(),
        other => kind(other).to_owned(),
    }
}

fn kind(value: &DeValue<'_>) -> &'static str {
    match value {
        DeValue::String(_) => "a text",
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
            // No action's: as if nothing were said of it.
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
            "`auto` must be true or false, not a text",
            "'camera' is no pattern",
            "the file has no `colour`: it can have action, allow, auto, deny, domain, ros_domain, service, topic, transit",
            "[[topic]] has no `topic`",
            "`ros_topic` \"/b\" does not rename \"/*/a\"",
            "`direction` is \"out\": write \"to_ros\", \"from_ros\" or \"both\"",
            "`type` \"String\" is no type",
            "`max_rate_hz` is 0",
            "`depth` is 0",
            "`reliability` is \"yes\": write \"reliable\" or \"best_effort\"",
            "`qos` has no `deadline`: it can have depth, durability, history, reliability",
            "\"/same\" is spoken of before",
            "`type` \"std_srvs/msg/SetBool\" is no type of services",
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

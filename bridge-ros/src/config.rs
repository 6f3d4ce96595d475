// SPDX-License-Identifier: MIT OR Apache-2.0
//! The configuration file: which topics are bridged, and how. All errors are reported at once, with their lines.

use crate::rcl::{is_message_type, is_service_type};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_analysis::file::Problems;
use tautline_analysis::file::reader::{self, At, Section};
use tautline_relay::{Direction, Filter, Pattern, QosOverride, Rule, Rules};
use tautline_transport::{Durability, History, Limits, MAX_DOMAIN, Reliability};

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
    /// Its content is invalid.
    #[error("{} has {} problem(s):\n{source}", path.display(), source.0.len())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Problems,
    },
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
            Ok(text) => Self::parse(&text).map_err(|source| ConfigError::Content { path, source }),
        }
    }

    /// Reads the text of a file.
    ///
    /// ```
    /// let text = "[[topic]]\ntopic = '/odom'\ndirection = 'to_ross'\nmax_rate_hz = 0\n";
    /// let problems = tautline_bridge_ros::Config::parse(text).unwrap_err();
    /// assert_eq!(
    ///     problems.to_string(),
    ///     "3:13: unknown `direction` \"to_ross\" in [[topic]]: did you mean `to_ros`?\n\
    ///      4:15: `max_rate_hz` is 0: write messages per second, from 0.001 to 1000000"
    /// );
    /// ```
    ///
    /// # Errors
    /// All errors of the file, in the order of the lines.
    pub fn parse(text: &str) -> Result<Self, Problems> {
        reader::read(text, "`topic = \"/odom\"` below `[[topic]]`", config)
    }
}

fn config(mut root: Section<'_>) -> Config {
    let domain = root.integer_in("domain", 0..=MAX_DOMAIN.into());
    let ros_domain = root.integer_in("ros_domain", 0..=MAX_DOMAIN.into());
    let auto = root.flag("auto");
    let transit = root.optional_flag("transit");
    let (allow, deny) = (patterns(&mut root, "allow"), patterns(&mut root, "deny"));
    let mut rules = read_rules(&mut root, "topic", topic);
    let mut services = read_rules(&mut root, "service", service);
    let actions = read_rules(&mut root, "action", action);
    for rules in [&mut rules, &mut services] {
        rules.extend_from_slice(&actions);
        rules.sort_by_key(order);
    }
    root.finish();
    let filter = Filter { allow, deny };
    let services = Rules { rules: services, auto, filter: filter.clone() };
    Config { domain, ros_domain, rules: Rules { rules, auto, filter }, services, transit }
}

/// Sorts rules for single parts of actions before those for actions, and these before others: `/**` would rename an action's
/// topics and not its services.
fn order(rule: &Rule) -> u8 {
    match rule.is_of_actions {
        true => 1,
        false if rule.topic.to_string().contains("/_action/") => 0,
        false => 2,
    }
}

/// Reads the tables `[[name]]`. A rule is `None` if its name is missing.
fn read_rules<'t>(
    root: &mut Section<'t>,
    name: &'static str,
    read: fn(&mut Section<'t>) -> Option<Rule>,
) -> Vec<Rule> {
    let mut rules: Vec<Rule> = Vec::new();
    for table in root.array(name) {
        let at = table.span().start;
        let Some(mut section) = root.inner(format!("[[{name}]]"), at, table) else { continue };
        let rule = read(&mut section);
        section.finish();
        let Some(rule) = rule else { continue };
        if rules.iter().any(|before| before.topic == rule.topic) {
            let message = "is listed twice: the first one counts; remove the other";
            root.problem(at).add(format!("`{name}` \"{}\" {message}", rule.topic));
        }
        rules.push(rule);
    }
    rules
}

fn topic(section: &mut Section<'_>) -> Option<Rule> {
    let rule = names(section, "topic", "ros_topic");
    let what = "messages: write package/msg/Name, such as \"std_msgs/msg/String\"";
    let type_name = type_name(section, is_message_type, what);
    let max_rate_hz = section.number_in("max_rate_hz", 1e-3..=1e6, "messages per second,");
    let min_period = max_rate_hz.map(|rate| Duration::from_secs_f64(1.0 / rate));
    Some(Rule { type_name, qos: qos(section), min_period, ..rule? })
}

fn service(section: &mut Section<'_>) -> Option<Rule> {
    let rule = names(section, "service", "ros_service");
    let what = "services: write package/srv/Name, such as \"std_srvs/srv/SetBool\"";
    Some(Rule { type_name: type_name(section, is_service_type, what), ..rule? })
}

/// Reads one rule for the services and topics of an action.
fn action(section: &mut Section<'_>) -> Option<Rule> {
    let Rule { topic, far_topic, direction, .. } = names(section, "action", "ros_action")?;
    let parts = |action: Pattern| match action.prefix() {
        Some(_) => Some(action),
        None => format!("{action}/_action/**").parse().ok(),
    };
    let far_topic = far_topic.and_then(parts);
    Some(Rule { far_topic, direction, is_of_actions: true, ..Rule::new(parts(topic)?) })
}

/// Reads the common keys of all entries: names and a direction.
fn names(section: &mut Section<'_>, key: &'static str, ros_key: &'static str) -> Option<Rule> {
    if !section.has(key) {
        let example = format!("add {key} = \"/name\" or a pattern such as \"/camera/**\"");
        section.problem(section.at).add(format!("{} has no `{key}`: {example}", section.title));
    }
    let name = section.text(key).and_then(|text| pattern(section, key, text));
    let ros_at = section.at(ros_key);
    let ros_name = section.text(ros_key).and_then(|text| pattern(section, ros_key, text));
    let direction = section.choice(
        "direction",
        &[("to_ros", Some(Direction::Out)), ("from_ros", Some(Direction::In)), ("both", None)],
    );
    let name = name?;
    let renames = |ros_name: &Pattern| match (name.exact(), name.prefix()) {
        (Some(_), _) => ros_name.exact().is_some(),
        (_, Some(_)) => ros_name.prefix().is_some(),
        _ => false,
    };
    if let (Some(at), Some(ros_name)) = (ros_at, ros_name.as_ref().filter(|ros_name| !renames(ros_name))) {
        section.problem(at).add(format!(
            "`{ros_key}` \"{ros_name}\" does not rename \"{name}\": a name can be renamed to a name, \"/a/**\" to \"/b/**\""
        ));
    }
    let far_topic = ros_name.filter(renames);
    Some(Rule { far_topic, direction: direction.and_then(|way| way.value), ..Rule::new(name) })
}

fn type_name(section: &mut Section<'_>, is_one: fn(&str) -> bool, what: &str) -> Option<String> {
    let At { value: name, at } = section.text("type")?;
    if is_one(&name) {
        return Some(name);
    }
    section.problem(at).add(format!("`type` \"{name}\" is not a type of {what}"));
    None
}

fn qos(section: &mut Section<'_>) -> QosOverride {
    let Some(mut qos) = section.table("qos") else { return QosOverride::default() };
    let reliability = [("reliable", Reliability::Reliable), ("best_effort", Reliability::BestEffort)];
    let durability = [("volatile", Durability::Volatile), ("transient_local", Durability::TransientLocal)];
    let history = [("keep_last", History::KeepLast), ("keep_all", History::KeepAll)];
    let read = QosOverride {
        reliability: qos.choice("reliability", &reliability).map(|choice| choice.value),
        durability: qos.choice("durability", &durability).map(|choice| choice.value),
        history: qos.choice("history", &history).map(|choice| choice.value),
        depth: qos.integer_in("depth", 1..=Limits::MAX_DEPTH as i64),
    };
    qos.finish();
    read
}

fn pattern(section: &Section<'_>, key: &str, text: At<String>) -> Option<Pattern> {
    text.value.parse().map_err(|error| section.problem(text.at).add(format!("`{key}`: {error}"))).ok()
}

fn patterns(section: &mut Section<'_>, key: &'static str) -> Vec<Pattern> {
    let texts = section.texts(key).into_iter();
    texts.filter_map(|text| pattern(section, key, text)).collect()
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
            [[topic]]
            topic = "/**"
            [[topic]]
            topic = "/dock/_action/status"
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
            [[action]]
            action = "/*/lift"
            direction = "from_ros"
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
            let lift = rules.choice("/left/lift/_action/status").unwrap();
            assert_eq!(
                (&*lift.far_topic, lift.direction),
                ("/left/lift/_action/status", Some(Direction::In))
            );
            // Not of an action: as if there were no rule.
            let other = rules.choice("/arm/joint_states").unwrap();
            assert_eq!((&*other.far_topic, other.direction), ("/arm/joint_states", None));
            assert_eq!(
                rules.here_name("/ros_arm/left/_action/status").as_deref(),
                Some("/arm/left/_action/status")
            );
        }
        let status = config.rules.choice("/dock/_action/status").unwrap();
        assert_eq!(status.min_period, Some(Duration::from_secs(1)), "a rule for a part of an action");
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
        let lines: Vec<usize> = problems.0.iter().map(|problem| problem.line).collect();
        assert_eq!(lines, [1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 13, 13, 16, 20, 21, 22]);
        let said = problems.to_string();
        for part in [
            "`domain` is 233: write a whole number from 0 to 232",
            "`auto` must be true or false, not a string",
            "'camera' is not a pattern",
            "unknown key `colour` in the file (known: domain, ros_domain, auto, transit, allow, deny, topic, service, action)",
            "[[topic]] has no `topic`",
            "`ros_topic` \"/b\" does not rename \"/*/a\"",
            "unknown `direction` \"out\" in [[topic]] (known: to_ros, from_ros, both)",
            "`type` \"String\" is not a type",
            "`max_rate_hz` is 0",
            "`depth` is 0",
            "unknown `reliability` \"yes\" in `qos` (known: reliable, best_effort)",
            "unknown key `deadline` in `qos`",
            "\"/same\" is listed twice",
            "`type` \"std_srvs/msg/SetBool\" is not a type of services",
            "[[action]] has no `action`",
            "`direction` must be a string, not a number",
        ] {
            assert!(said.contains(part), "{part}\n{said}");
        }
    }

    #[test]
    fn what_is_no_toml_has_its_line_too() {
        let problems = Config::parse("[[topic]]\ntopic = \n").unwrap_err();
        assert_eq!(problems.0[0].line, 2, "{problems:?}");
        let message = Config::read("/no/such.toml").unwrap_err().to_string();
        assert!(message.contains("/no/such.toml"), "{message}");
    }
}

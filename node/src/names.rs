// SPDX-License-Identifier: MIT OR Apache-2.0
//! ROS 2's rules for names (<https://design.ros2.org/articles/topic_and_service_names.html>).

use crate::error::{Error, Result};

/// ROS 2's limits for names of nodes, and of topics, less the length of what Tautline adds to names of services.
const MAX_NODE_NAME: usize = 255;
const MAX_TOPIC_NAME: usize = 240;

fn invalid(name: &str, kind: &'static str, reason: impl Into<String>) -> Error {
    Error::Name { name: name.into(), kind, reason: reason.into() }
}

/// Letters, digits and underscores, not beginning with a digit: what ROS 2's `rmw_validate_full_topic_name` accepts.
fn check_token(token: &str) -> Result<(), String> {
    if token.is_empty() {
        return Err("there is nothing between two '/'".into());
    }
    if let Some(bad) = token.chars().find(|c| !c.is_ascii_alphanumeric() && *c != '_') {
        return Err(format!("'{bad}' is not allowed; use letters, digits, '_' and '/'"));
    }
    if token.starts_with(|c: char| c.is_ascii_digit()) {
        return Err(format!("'{token}' begins with a digit"));
    }
    Ok(())
}

fn check_length(name: &str, kind: &'static str, max: usize) -> Result<()> {
    if name.len() <= max {
        return Ok(());
    }
    Err(invalid(name, kind, format!("it has {} characters, the limit is {max}", name.len())))
}

pub(crate) fn check_node(name: &str) -> Result<()> {
    let refuse = |reason: String| invalid(name, "node name", reason);
    if name.is_empty() {
        return Err(refuse("it is empty".into()));
    }
    check_length(name, "node name", MAX_NODE_NAME)?;
    if name.contains('/') {
        return Err(refuse("it has a '/'; put what comes before it into the namespace".into()));
    }
    check_token(name).map_err(refuse)
}

/// The absolute form of a namespace: `""` is `/`, `robot` is `/robot`.
pub(crate) fn absolute_namespace(namespace: &str) -> Result<String> {
    let absolute = if namespace.starts_with('/') { namespace.into() } else { format!("/{namespace}") };
    if absolute == "/" {
        return Ok(absolute);
    }
    check_length(&absolute, "namespace", MAX_TOPIC_NAME)?;
    check_tokens(&absolute, namespace, "namespace")?;
    Ok(absolute)
}

/// The fully qualified name of a topic: absolute names stay, `~/x` and `~` are below the node, others below the
/// namespace; `{node}`, `{ns}` and `{namespace}` are replaced.
pub(crate) fn expand_topic(topic: &str, node: &str, namespace: &str) -> Result<String> {
    let refuse = |reason: String| invalid(topic, "topic name", reason);
    if topic.is_empty() {
        return Err(refuse("it is empty".into()));
    }
    let mut replaced = topic.to_owned();
    for (pattern, value) in [("{node}", node), ("{ns}", namespace), ("{namespace}", namespace)] {
        replaced = replaced.replace(pattern, value);
    }
    if replaced.contains(['{', '}']) {
        return Err(refuse("only {node}, {ns} and {namespace} can stand between braces".into()));
    }
    let prefix = if namespace == "/" { "" } else { namespace };
    let full = match replaced.strip_prefix('~') {
        Some("") => format!("{prefix}/{node}"),
        Some(rest) if rest.starts_with('/') => format!("{prefix}/{node}{rest}"),
        Some(_) => return Err(refuse("'~' must be followed by '/'".into())),
        // A substitution at the start may have made it absolute.
        None if replaced.starts_with('/') => {
            replaced.replacen("//", "/", usize::from(topic.starts_with('{')))
        }
        None => format!("{prefix}/{replaced}"),
    };
    if full.contains('~') {
        return Err(refuse("'~' can only be its first character".into()));
    }
    check_length(&full, "topic name", MAX_TOPIC_NAME)?;
    check_tokens(&full, topic, "topic name")?;
    Ok(full)
}

fn check_tokens(absolute: &str, given: &str, kind: &'static str) -> Result<()> {
    if absolute.ends_with('/') {
        return Err(invalid(given, kind, "it ends with '/'"));
    }
    absolute[1..].split('/').try_for_each(check_token).map_err(|reason| invalid(given, kind, reason))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_expanded() {
        for (topic, namespace, expected) in [
            ("chatter", "/", "/chatter"),
            ("chatter", "/robot", "/robot/chatter"),
            ("/chatter", "/robot", "/chatter"),
            ("~/image", "/", "/cam/image"),
            ("~/image", "/robot/left", "/robot/left/cam/image"),
            ("~", "/robot", "/robot/cam"),
            ("{node}/raw", "/robot", "/robot/cam/raw"),
            ("{ns}/raw", "/robot", "/robot/raw"),
            ("{ns}/raw", "/", "/raw"),
            ("/a/{node}", "/robot", "/a/cam"),
            ("a_b/C9", "/", "/a_b/C9"),
            // The article forbids it, ROS 2 does not.
            ("a__b", "/", "/a__b"),
        ] {
            assert_eq!(expand_topic(topic, "cam", namespace).unwrap(), expected, "{topic} in {namespace}");
        }
    }

    #[test]
    fn bad_topics_are_refused_with_the_rule() {
        for (topic, reason) in [
            ("", "empty"),
            ("/", "ends with '/'"),
            ("a/", "ends with '/'"),
            ("a//b", "between two '/'"),
            ("9a", "begins with a digit"),
            ("a/9", "begins with a digit"),
            ("a b", "' ' is not allowed"),
            ("a-b", "'-' is not allowed"),
            ("~image", "followed by '/'"),
            ("a/~/b", "first character"),
            ("{foo}/a", "between braces"),
            ("ä", "not allowed"),
        ] {
            let error = expand_topic(topic, "cam", "/").unwrap_err().to_string();
            assert!(error.contains(reason), "{topic}: {error}");
        }
        assert!(expand_topic(&"a".repeat(300), "cam", "/").unwrap_err().to_string().contains("limit is 240"));
    }

    #[test]
    fn nodes_and_namespaces() {
        assert!(check_node("talker_1").is_ok());
        for bad in ["", "a/b", "1a", "a-b", "~"] {
            assert!(check_node(bad).is_err(), "{bad}");
        }
        assert_eq!(absolute_namespace("").unwrap(), "/");
        assert_eq!(absolute_namespace("robot/left").unwrap(), "/robot/left");
        assert!(absolute_namespace("/robot/").is_err());
    }
}

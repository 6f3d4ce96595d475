// SPDX-License-Identifier: MIT OR Apache-2.0
//! ROS 2's remapping rules (<https://design.ros2.org/articles/static_remapping.html>): as `-r from:=to` on a command line.

use crate::error::{Error, Result};
use crate::names;

/// Rules that give nodes, topics and services names other than those in the program, each as after `-r` on a ROS 2
/// command line. The first matching rule counts.
///
/// | rule | changes the name of |
/// |---|---|
/// | `chatter:=/talk` | the topic or service `chatter` of a node |
/// | `~/image:=camera/image` | both sides are expanded in the node: private, relative, absolute, `{node}` and `{ns}` |
/// | `rostopic://a:=b`, `rosservice://a:=b` | only topics, only services |
/// | `__node:=left`, `__name:=left` | every node |
/// | `__ns:=/robot` | every node's namespace |
/// | `talker:chatter:=talk` | only in nodes called `talker`; rules for the node's name are applied before all others |
///
/// ```
/// use tautline::{Context, Node, Realtime, RemapRules};
///
/// let rules = RemapRules::parse(&["__ns:=/robot", "camera:~/image:=/front"])?;
/// let ctx = Context::builder().domain(101).realtime(Realtime::Off).remap(rules).build()?;
/// let node = Node::create(ctx, "camera", "")?;
/// assert_eq!(node.fully_qualified_name(), "/robot/camera");
/// assert_eq!(node.resolve_topic_name("~/image")?, "/front");
/// # Ok::<(), tautline::Error>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RemapRules {
    rules: Vec<Rule>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Rule {
    /// The node to which it applies; `None`: all nodes.
    node: Option<String>,
    effect: Effect,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Effect {
    NodeName(String),
    Namespace(String),
    /// For topics or services only, if the kind is stated.
    Name {
        kind: Option<NameKind>,
        from: String,
        to: String,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NameKind {
    Topic,
    Service,
}

impl RemapRules {
    /// Parses rules such as `from:=to`.
    ///
    /// # Errors
    /// [`Error::Remap`] with the invalid rule.
    pub fn parse(rules: &[impl AsRef<str>]) -> Result<RemapRules> {
        let rules = rules.iter().map(|rule| parse(rule.as_ref())).collect::<Result<_>>()?;
        Ok(RemapRules { rules })
    }

    /// Whether there is no rule.
    pub fn is_empty(&self) -> bool {
        self.rules.is_empty()
    }

    /// These rules, followed by `others` where none of these matches.
    #[must_use = "it returns the changed RemapRules"]
    pub fn then(mut self, others: &RemapRules) -> RemapRules {
        self.rules.extend_from_slice(&others.rules);
        self
    }

    /// The new name of the node that the program calls `name`.
    pub(crate) fn node_name<'a>(&'a self, name: &'a str) -> &'a str {
        let new = self.of_node(name).find_map(|effect| match effect {
            Effect::NodeName(new) => Some(&**new),
            _ => None,
        });
        new.unwrap_or(name)
    }

    /// The namespace of the node called `node`, if a rule changes it.
    pub(crate) fn namespace(&self, node: &str) -> Option<&str> {
        self.of_node(node).find_map(|effect| match effect {
            Effect::Namespace(new) => Some(&**new),
            _ => None,
        })
    }

    /// The new name in the node of `full`, a fully qualified name.
    pub(crate) fn name(&self, full: String, kind: NameKind, node: &str, namespace: &str) -> Result<String> {
        for effect in self.of_node(node) {
            let Effect::Name { kind: of, from, to } = effect else { continue };
            // A rule whose left side is not a valid name in this node matches nothing in it.
            let is_meant = of.is_none_or(|of| of == kind)
                && names::expand_topic(from, node, namespace).is_ok_and(|from| from == full);
            if is_meant {
                return names::expand_topic(to, node, namespace);
            }
        }
        Ok(full)
    }

    fn of_node<'a, 'n>(&'a self, name: &'n str) -> impl Iterator<Item = &'a Effect> + use<'a, 'n> {
        let is_meant = move |rule: &&Rule| rule.node.as_deref().is_none_or(|node| node == name);
        self.rules.iter().filter(is_meant).map(|rule| &rule.effect)
    }
}

fn parse(rule: &str) -> Result<Rule> {
    let refuse = |reason: String| Error::Remap { rule: rule.into(), reason };
    let (left, to) = rule.split_once(":=").ok_or_else(|| refuse("it has no ':='".into()))?;
    if to.contains(":=") {
        return Err(refuse("it has more than one ':='".into()));
    }
    if left.is_empty() || to.is_empty() {
        return Err(refuse("there is nothing on one side of ':='".into()));
    }
    // The colon of a scheme does not follow a node's name.
    let (node, from) = match left.split_once(':') {
        Some((node, from)) if !from.starts_with("//") => {
            names::check_node(node).map_err(|error| refuse(error.to_string()))?;
            (Some(node.to_owned()), from)
        }
        _ => (None, left),
    };
    let effect = match from {
        "__node" | "__name" => {
            names::check_node(to).map_err(|error| refuse(error.to_string()))?;
            Effect::NodeName(to.into())
        }
        "__ns" if !to.starts_with('/') => return Err(refuse("a namespace begins with '/'".into())),
        "__ns" => {
            Effect::Namespace(names::absolute_namespace(to).map_err(|error| refuse(error.to_string()))?)
        }
        _ => {
            let (kind, from) = without_scheme(from);
            let (of_target, to) = without_scheme(to);
            if of_target.is_some_and(|of| kind != Some(of)) {
                return Err(refuse("its sides name different kinds of things".into()));
            }
            for name in [from, to] {
                names::expand_topic(name, "node", "/").map_err(|error| refuse(error.to_string()))?;
            }
            Effect::Name { kind, from: from.into(), to: to.into() }
        }
    };
    Ok(Rule { node, effect })
}

fn without_scheme(name: &str) -> (Option<NameKind>, &str) {
    if let Some(topic) = name.strip_prefix("rostopic://") {
        (Some(NameKind::Topic), topic)
    } else if let Some(service) = name.strip_prefix("rosservice://") {
        (Some(NameKind::Service), service)
    } else {
        (None, name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(rules: &[&str], full: &str) -> String {
        RemapRules::parse(rules).unwrap().name(full.into(), NameKind::Topic, "cam", "/robot").unwrap()
    }

    #[test]
    fn topics_get_other_names() {
        for (rule, full, expected) in [
            ("chatter:=talk", "/robot/chatter", "/robot/talk"),
            ("chatter:=/talk", "/robot/chatter", "/talk"),
            ("/chatter:=talk", "/robot/chatter", "/robot/chatter"),
            ("/robot/chatter:=talk", "/robot/chatter", "/robot/talk"),
            ("~/image:=image", "/robot/cam/image", "/robot/image"),
            ("image:=~/image", "/robot/image", "/robot/cam/image"),
            ("{node}/image:={ns}/image", "/robot/cam/image", "/robot/image"),
            ("cam:chatter:=talk", "/robot/chatter", "/robot/talk"),
            ("other:chatter:=talk", "/robot/chatter", "/robot/chatter"),
            ("rostopic://chatter:=talk", "/robot/chatter", "/robot/talk"),
            ("cam:rostopic://chatter:=rostopic://talk", "/robot/chatter", "/robot/talk"),
            ("rosservice://chatter:=talk", "/robot/chatter", "/robot/chatter"),
        ] {
            assert_eq!(topic(&[rule], full), expected, "{rule}");
        }
        // The first that matches, once.
        assert_eq!(topic(&["x:=y", "a:=b", "a:=c", "b:=d"], "/robot/a"), "/robot/b");
    }

    #[test]
    fn services_have_rules_of_their_own() {
        let rules = RemapRules::parse(&["rostopic://a:=b", "rosservice://a:=c"]).unwrap();
        let name = |kind| rules.name("/a".into(), kind, "n", "/").unwrap();
        assert_eq!((name(NameKind::Topic), name(NameKind::Service)), ("/b".into(), "/c".into()));
    }

    #[test]
    fn nodes_are_renamed_before_other_rules_look() {
        let rules = ["talker:__node:=left", "talker:__ns:=/never", "left:__ns:=/robot", "__ns:=/all"];
        let rules = RemapRules::parse(&rules).unwrap();
        let name = rules.node_name("talker");
        assert_eq!((name, rules.namespace(name)), ("left", Some("/robot")));
        assert_eq!((rules.node_name("other"), rules.namespace("other")), ("other", Some("/all")));
        let first = RemapRules::parse(&["__name:=one"]).unwrap().then(&rules);
        assert_eq!(first.node_name("talker"), "one");
        assert!(RemapRules::default().is_empty() && RemapRules::default().namespace("n").is_none());
    }

    #[test]
    fn what_is_no_rule_is_refused() {
        for (rule, reason) in [
            ("a", "no ':='"),
            ("a=b", "no ':='"),
            (":=b", "nothing on one side"),
            ("a:=", "nothing on one side"),
            ("a:=b:=c", "more than one"),
            ("1n:a:=b", "begins with a digit"),
            ("__node:=a/b", "namespace"),
            ("__ns:=robot", "begins with '/'"),
            ("__ns:=/robot/", "ends with '/'"),
            ("a b:=c", "' ' is not allowed"),
            ("a:=b c", "' ' is not allowed"),
            ("a:=/", "ends with '/'"),
            ("a:={x}", "between braces"),
            ("rostopic://a:=rosservice://b", "different kinds"),
            ("n:=", "nothing on one side"),
            ("n::=b", "empty"),
        ] {
            let error = RemapRules::parse(&[rule]).unwrap_err().to_string();
            assert!(error.contains(reason) && error.contains(rule), "{rule}: {error}");
        }
    }
}

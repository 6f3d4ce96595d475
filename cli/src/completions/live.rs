// SPDX-License-Identifier: MIT OR Apache-2.0
//! Completes arguments with the names that exist now.
//!
//! Each completion is fast: names are read from shared memory, or requested from a node with a time limit. Late answers and errors
//! yield no candidates.

use super::asked::{ASKED, Asked};
use super::paths;
use crate::arguments::full_name;
use crate::call::{Caller, MANAGER, action_of, node_serving, nodes_serving};
use crate::find::Finder;
use crate::verb::End;
use clap_complete::engine::{ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::PathBuf;
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Duration;
use tautline::composition_interfaces::srv::ListNodes;
use tautline::lifecycle_msgs::srv::GetAvailableTransitions;
use tautline::rcl_interfaces::srv::ListParameters;
use tautline_definitions::find_schema;
use tautline_msgs::Service;
use tautline_rt::clock::test_time;
use tautline_schema::{Kind, TypeName};
use tautline_transport::{GraphSnapshot, ServiceKind, graph_of};

/// The time after its start at which this process answers at the latest: people notice 100 ms, and the shell needs a part of that.
const LIMIT: Duration = Duration::from_millis(80);
/// The time after its start until which this process waits for a node; leaving the domain takes the rest.
const PATIENCE: Duration = Duration::from_millis(60);

/// Names, each with a description for shells that show one.
type Names = BTreeMap<String, String>;

/// Completes a word by `find`, which may leave out names that do not begin with the word.
fn completer(
    find: impl Fn(&'static Asked, &str) -> Option<Names> + Copy + Send + Sync + 'static,
) -> ArgValueCompleter {
    ArgValueCompleter::new(move |word: &OsStr| offered(find, word).unwrap_or_default())
}

/// Names without descriptions.
fn bare(names: impl IntoIterator<Item = impl ToString>) -> Names {
    names.into_iter().map(|name| (name.to_string(), String::new())).collect()
}

impl Asked {
    fn graph(&self) -> Option<Arc<GraphSnapshot>> {
        graph_of(self.line.domain()?).ok()
    }
}

fn offered(
    find: impl Fn(&'static Asked, &str) -> Option<Names> + Send + 'static,
    word: &OsStr,
) -> Option<Vec<CompletionCandidate>> {
    let (asked, word) = (ASKED.get()?, word.to_str()?);
    let (tell, told) = mpsc::channel();
    let typed = word.to_owned();
    thread::spawn(move || tell.send(find(asked, &typed)));
    let names = told.recv_timeout(test_time(LIMIT).saturating_sub(asked.since.elapsed())).ok()??;
    let candidate = |(name, of_type): (String, String)| {
        if !asked.shell_takes(&name) {
            return None;
        }
        let value = if name.starts_with(word) {
            name.clone()
        } else {
            let shorter = shorter(&name).filter(|shorter| !word.is_empty() && shorter.starts_with(word))?;
            if asked.replaces { name.clone() } else { shorter }
        };
        // ROS hides these names.
        let is_hidden = name.contains("/_");
        let of_type = Some(of_type).filter(|of_type| !of_type.is_empty());
        Some(CompletionCandidate::new(value).help(of_type.map(Into::into)).hide(is_hidden))
    };
    Some(names.into_iter().filter_map(candidate).collect())
}

/// Other spellings of a name: without the first slash, or a type without its kind.
fn shorter(name: &str) -> Option<String> {
    match name.split('/').collect::<Vec<_>>()[..] {
        [package, "msg" | "srv" | "action", name] => Some(format!("{package}/{name}")),
        _ => name.strip_prefix('/').map(str::to_owned),
    }
}

pub fn topics() -> ArgValueCompleter {
    completer(|asked, _| {
        let graph = asked.graph()?;
        let named = graph.endpoints.iter().map(|end| (end.topic.clone(), end.topic_type.name.to_string()));
        Some(named.collect())
    })
}

pub fn topic_types() -> ArgValueCompleter {
    completer(|asked, _| Some(bare(asked.graph()?.endpoints.iter().map(|end| &end.topic_type.name))))
}

/// The types of the topic on the line; if it does not exist, of all topics and of the installed packages.
pub fn message_types() -> ArgValueCompleter {
    completer(|asked, _| {
        let [topic] = &asked.line.words[..asked.line.place] else { return None };
        let (graph, topic) = (asked.graph()?, full_name(topic));
        let its_own = graph.endpoints.iter().filter(|end| end.topic == topic);
        let its_own = bare(its_own.map(|end| &end.topic_type.name));
        if !its_own.is_empty() {
            return Some(its_own);
        }
        Some(bare(known_types(asked)?.filter(|name| name.kind() == Kind::Msg)))
    })
}

/// The paths of the fields of the topic on the line.
pub fn fields() -> ArgValueCompleter {
    completer(|asked, word| {
        let (graph, topic) = (asked.graph()?, full_name(asked.line.words.first()?));
        let end = graph.endpoints.iter().find(|end| end.topic == topic)?;
        let schema = find_schema(&topic, &end.topic_type.name.parse().ok()?, Some(&end.topic_type)).ok()?;
        Some(paths::of(&schema, word).into_iter().collect())
    })
}

pub fn nodes() -> ArgValueCompleter {
    completer(|asked, _| Some(bare(asked.graph()?.nodes.iter().map(|node| node.name.full_name()))))
}

/// The nodes that serve `<node>/<service>`.
pub fn nodes_with(service: &'static str) -> ArgValueCompleter {
    completer(move |asked, _| Some(bare(nodes_serving(asked.line.domain()?, service).ok()?)))
}

/// The services or actions of the domain. `of` selects them by the name and type of a service.
fn ends(
    asked: &Asked,
    with_servers: bool,
    of: impl Fn(&str, &str) -> Option<(String, String)>,
) -> Option<Names> {
    let graph = asked.graph()?;
    let ends = graph.services.iter().filter(|end| !with_servers || end.kind == ServiceKind::Server);
    Some(ends.filter_map(|end| of(&end.name, &end.type_name)).collect())
}

fn service(name: &str, type_name: &str) -> Option<(String, String)> {
    Some((name.to_owned(), type_name.to_owned()))
}

fn action(name: &str, type_name: &str) -> Option<(String, String)> {
    action_of(name, type_name).map(|(name, type_name)| (name.to_owned(), type_name.to_owned()))
}

pub fn services() -> ArgValueCompleter {
    completer(|asked, _| ends(asked, false, service))
}

/// The services with a server.
pub fn servers() -> ArgValueCompleter {
    completer(|asked, _| ends(asked, true, service))
}

pub fn service_types() -> ArgValueCompleter {
    completer(|asked, _| ends(asked, false, |_, type_name| Some((type_name.to_owned(), String::new()))))
}

pub fn actions() -> ArgValueCompleter {
    completer(|asked, _| ends(asked, false, action))
}

pub fn action_servers() -> ArgValueCompleter {
    completer(|asked, _| ends(asked, true, action))
}

/// The types with which the service or action on the line is served.
fn types_served(asked: &Asked, of: fn(&str, &str) -> Option<(String, String)>) -> Option<Names> {
    let [name] = &asked.line.words[..asked.line.place] else { return None };
    let name = full_name(name);
    let of_this = |service: &str, type_name: &str| {
        let (_, type_name) = of(service, type_name).filter(|(service, _)| *service == name)?;
        Some((type_name, String::new()))
    };
    ends(asked, true, of_this)
}

/// The types of the service on the line.
pub fn types_of_service() -> ArgValueCompleter {
    completer(|asked, _| types_served(asked, service))
}

/// The types of the action on the line.
pub fn action_types() -> ArgValueCompleter {
    completer(|asked, _| types_served(asked, action))
}

/// The types that `taut interface list` lists.
fn known_types(asked: &Asked) -> Option<impl Iterator<Item = TypeName> + use<>> {
    let folders: Vec<PathBuf> = asked.line.options("path").map(PathBuf::from).collect();
    Some(Finder::new(&folders).in_domain(asked.line.domain()?).list().ok()?.into_iter())
}

/// The packages that have types.
pub fn packages() -> ArgValueCompleter {
    completer(|asked, _| Some(bare(known_types(asked)?.map(|name| name.package().to_owned()))))
}

/// Known types, or files with definitions.
pub fn interfaces() -> ArgValueCompleter {
    ArgValueCompleter::new(|word: &OsStr| match word.to_str() {
        Some(text) if !text.starts_with(['.', '/', '~']) => {
            let found = offered(|asked, _| Some(bare(known_types(asked)?)), word).unwrap_or_default();
            if found.is_empty() { PathCompleter::any().complete(word) } else { found }
        }
        _ => PathCompleter::any().complete(word),
    })
}

/// The response of a node's service, if it arrives in time.
fn answer<T: Service>(asked: &Asked, node: &str, service: &str, request: T::Request) -> Option<T::Response> {
    let domain = asked.line.domain()?;
    let node = node_serving(domain, node, service, "").ok()?;
    let mut caller = Caller::new(domain, End::at(asked.since + test_time(PATIENCE)).ok()?).ok()?;
    caller.call::<T>(&format!("{node}/{service}"), request).ok()
}

/// The parameters of the node on the line, requested from the node.
pub fn parameters() -> ArgValueCompleter {
    completer(|asked, _| {
        let (node, named) = asked.line.words.split_first()?;
        let request = ListParameters::Request::default();
        let answer = answer::<ListParameters::Service>(asked, node, "list_parameters", request)?;
        Some(bare(answer.result.names.into_iter().filter(|name| !named.contains(name))))
    })
}

/// The transitions that are possible for the node on the line.
pub fn transitions() -> ArgValueCompleter {
    completer(|asked, _| {
        let node = asked.line.words.first()?;
        let (service, request) = ("get_available_transitions", GetAvailableTransitions::Request::default());
        let answer = answer::<GetAvailableTransitions::Service>(asked, node, service, request)?;
        let all = answer.available_transitions.into_iter();
        Some(all.map(|one| (one.transition.label, format!("to {}", one.goal_state.label))).collect())
    })
}

/// The numbers of a container's components.
pub fn components() -> ArgValueCompleter {
    completer(|asked, _| {
        let container = asked.line.option("container").unwrap_or(MANAGER);
        let request = ListNodes::Request::default();
        let listed = answer::<ListNodes::Service>(asked, container, "_container/list_nodes", request)?;
        Some(listed.unique_ids.iter().map(u64::to_string).zip(listed.full_node_names).collect())
    })
}

#[cfg(test)]
mod tests {
    use super::shorter;

    #[test]
    fn names_have_shorter_ones() {
        let short = |name| shorter(name).unwrap_or_default();
        assert_eq!(
            ["/image", "/robot/arm", "std_msgs/msg/String", "gain", "/a/msg/B"].map(short),
            ["image", "robot/arm", "std_msgs/String", "", "a/msg/B"]
        );
    }
}

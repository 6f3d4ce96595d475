// SPDX-License-Identifier: MIT OR Apache-2.0
//! Completes arguments with the names that exist now.
//!
//! Each completion is fast: names are read from shared memory, or requested from a node with a time limit. Late answers and errors
//! yield no candidates.

use super::{ASKED, Asked, paths};
use crate::arguments::full_name;
use crate::call::{Caller, action_of, node_serving, nodes_serving};
use crate::component::MANAGER;
use crate::msg::Finder;
use crate::verb::{End, Outcome};
use clap_complete::engine::{
    ArgValueCandidates, ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter,
};
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::PathBuf;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;
use tautline::composition_interfaces::srv::ListNodes;
use tautline::lifecycle_msgs::srv::GetAvailableTransitions;
use tautline::rcl_interfaces::srv::ListParameters;
use tautline_definitions::find_schema;
use tautline_msgs::Service;
use tautline_rt::clock::test_time;
use tautline_schema::{Kind, TypeName};
use tautline_transport::{ServiceKind, graph_of};

/// The time after its start at which this process answers: people notice 100 ms, and the shell needs a part of them.
const LIMIT: Duration = Duration::from_millis(80);
/// The time after its start until which this process waits for a node; leaving the domain takes the rest.
const PATIENCE: Duration = Duration::from_millis(60);

/// Names, each with a description for shells that show one.
type Names = BTreeMap<String, String>;
type Found<T = Names> = Outcome<Option<T>>;
/// The source may return only names that begin with the word.
type Find = fn(asked: &'static Asked, word: &str) -> Found;

fn completer(find: Find) -> ArgValueCompleter {
    ArgValueCompleter::new(move |word: &OsStr| offered(find, word).unwrap_or_default())
}

fn offered(find: Find, word: &OsStr) -> Option<Vec<CompletionCandidate>> {
    let (asked, word) = (ASKED.get()?, word.to_str()?);
    let (tell, told) = mpsc::channel();
    let typed = word.to_owned();
    thread::spawn(move || tell.send(find(asked, &typed)));
    let names = told.recv_timeout(test_time(LIMIT).saturating_sub(asked.since.elapsed())).ok()?.ok()??;
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
        let Some(domain) = asked.line.domain() else { return Ok(None) };
        let graph = graph_of(domain)?;
        let name = |end: &std::sync::Arc<tautline_transport::TopicEndpoint>| {
            (end.topic.clone(), end.topic_type.name.to_string())
        };
        Ok(Some(graph.endpoints.iter().map(name).collect()))
    })
}

pub fn topic_types() -> ArgValueCompleter {
    completer(|asked, _| {
        let Some(domain) = asked.line.domain() else { return Ok(None) };
        let graph = graph_of(domain)?;
        Ok(Some(graph.endpoints.iter().map(|end| (end.topic_type.name.to_string(), String::new())).collect()))
    })
}

/// The types of the topic on the line; if it does not exist, of all topics and of the installed packages.
pub fn message_types() -> ArgValueCompleter {
    completer(|asked, _| {
        let (Some(domain), [topic]) = (asked.line.domain(), &asked.line.words[..asked.line.place]) else {
            return Ok(None);
        };
        let (graph, topic) = (graph_of(domain)?, full_name(topic));
        let its_own = graph.endpoints.iter().filter(|end| end.topic == topic);
        let its_own: Names = its_own.map(|end| (end.topic_type.name.to_string(), String::new())).collect();
        if !its_own.is_empty() {
            return Ok(Some(its_own));
        }
        let messages = known(asked)?.map(|types| types.filter(|name| name.kind() == Kind::Msg));
        Ok(messages.map(|types| types.map(|name| (name.to_string(), String::new())).collect()))
    })
}

/// The paths of the fields of the topic on the line.
pub fn fields() -> ArgValueCompleter {
    completer(|asked, word| {
        let (Some(domain), Some(topic)) = (asked.line.domain(), asked.line.words.first()) else {
            return Ok(None);
        };
        let (graph, topic) = (graph_of(domain)?, full_name(topic));
        let Some(end) = graph.endpoints.iter().find(|end| end.topic == topic) else { return Ok(None) };
        let schema = find_schema(&topic, &end.topic_type.name.parse()?, Some(&end.topic_type))?;
        Ok(Some(paths::of(&schema, word).into_iter().collect()))
    })
}

pub fn nodes() -> ArgValueCompleter {
    completer(|asked, _| {
        let Some(domain) = asked.line.domain() else { return Ok(None) };
        let graph = graph_of(domain)?;
        Ok(Some(graph.nodes.iter().map(|node| (node.name.full_name(), String::new())).collect()))
    })
}

fn having(asked: &Asked, service: &str) -> Found {
    let Some(domain) = asked.line.domain() else { return Ok(None) };
    Ok(Some(nodes_serving(domain, service)?.into_iter().map(|node| (node, String::new())).collect()))
}

pub fn parameter_nodes() -> ArgValueCompleter {
    completer(|asked, _| having(asked, "list_parameters"))
}

pub fn lifecycle_nodes() -> ArgValueCompleter {
    completer(|asked, _| having(asked, "get_state"))
}

/// The nodes whose loggers' levels can be set.
pub fn logging_nodes() -> ArgValueCompleter {
    completer(|asked, _| having(asked, "set_logger_levels"))
}

pub fn containers() -> ArgValueCompleter {
    completer(|asked, _| having(asked, "_container/list_nodes"))
}

/// The services or actions of the domain. `of` selects them by the name and type of a service.
fn ends(asked: &Asked, with_servers: bool, of: impl Fn(&str, &str) -> Option<(String, String)>) -> Found {
    let Some(domain) = asked.line.domain() else { return Ok(None) };
    let graph = graph_of(domain)?;
    let ends = graph.services.iter().filter(|end| !with_servers || end.kind == ServiceKind::Server);
    Ok(Some(ends.filter_map(|end| of(&end.name, &end.type_name)).collect()))
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
fn types_served(asked: &Asked, of: fn(&str, &str) -> Option<(String, String)>) -> Found {
    let [name] = &asked.line.words[..asked.line.place] else { return Ok(None) };
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
fn known(asked: &Asked) -> Found<impl Iterator<Item = TypeName> + use<>> {
    let Some(domain) = asked.line.domain() else { return Ok(None) };
    let folders: Vec<PathBuf> = asked.line.options("path").map(PathBuf::from).collect();
    Ok(Some(Finder::new(&folders).in_domain(domain).list()?.into_iter()))
}

/// The packages that have types.
pub fn packages() -> ArgValueCompleter {
    completer(|asked, _| {
        let packages = |types: &mut dyn Iterator<Item = TypeName>| {
            types.map(|name| (name.package().to_owned(), String::new())).collect()
        };
        Ok(known(asked)?.map(|mut types| packages(&mut types)))
    })
}

/// Known types, or files with definitions.
pub fn interfaces() -> ArgValueCompleter {
    let types: Find = |asked, _| {
        let names = known(asked)?.map(|types| types.map(|name| (name.to_string(), String::new())));
        Ok(names.map(Iterator::collect))
    };
    ArgValueCompleter::new(move |word: &OsStr| match word.to_str() {
        Some(text) if !text.starts_with(['.', '/', '~']) => {
            let mut found = offered(types, word).unwrap_or_default();
            if found.is_empty() {
                found = PathCompleter::any().complete(word);
            }
            found
        }
        _ => PathCompleter::any().complete(word),
    })
}

/// The response of a node's service, if it arrives in time.
fn answer<T: Service>(asked: &Asked, node: &str, service: &str, request: T::Request) -> Found<T::Response> {
    let Some(domain) = asked.line.domain() else { return Ok(None) };
    let node = node_serving(domain, node, service, "")?;
    let mut caller = Caller::new(domain, End::at(asked.since + test_time(PATIENCE))?)?;
    caller.call::<T>(&format!("{node}/{service}"), request).map(Some)
}

/// The parameters of the node on the line, requested from the node.
pub fn parameters() -> ArgValueCompleter {
    completer(|asked, _| {
        let Some((node, named)) = asked.line.words.split_first() else { return Ok(None) };
        let request = ListParameters::Request::default();
        let answer = answer::<ListParameters::Service>(asked, node, "list_parameters", request)?;
        let names = answer.map(|answer| answer.result.names).unwrap_or_default();
        let others = names.into_iter().filter(|name| !named.contains(name));
        Ok(Some(others.map(|name| (name, String::new())).collect()))
    })
}

/// The transitions that are possible for the node on the line.
pub fn transitions() -> ArgValueCompleter {
    completer(|asked, _| {
        let Some(node) = asked.line.words.first() else { return Ok(None) };
        let (service, request) = ("get_available_transitions", GetAvailableTransitions::Request::default());
        let answer = answer::<GetAvailableTransitions::Service>(asked, node, service, request)?;
        let all = answer.map(|answer| answer.available_transitions).unwrap_or_default();
        let goal = |goal: &str| format!("to {goal}");
        Ok(Some(all.into_iter().map(|one| (one.transition.label, goal(&one.goal_state.label))).collect()))
    })
}

/// The numbers of a container's components.
pub fn components() -> ArgValueCompleter {
    completer(|asked, _| {
        let container = asked.line.option("container").unwrap_or(MANAGER);
        let request = ListNodes::Request::default();
        let answer = answer::<ListNodes::Service>(asked, container, "_container/list_nodes", request)?;
        let Some(listed) = answer else { return Ok(None) };
        let ids = listed.unique_ids.iter().map(u64::to_string);
        Ok(Some(ids.zip(listed.full_node_names).collect()))
    })
}

pub fn levels() -> ArgValueCandidates {
    ArgValueCandidates::new(|| {
        ["debug", "info", "warn", "error", "fatal"].map(CompletionCandidate::new).into()
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

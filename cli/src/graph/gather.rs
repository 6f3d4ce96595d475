// SPDX-License-Identifier: MIT OR Apache-2.0
//! Selects the part of a domain to draw.

use super::picture::{Edge, EdgeKind, Mismatch, Node, Picture, Rate, Topic, TopicKind};
use crate::arguments::full_name;
use crate::call::{action_of, node_named};
use crate::compatibility;
use crate::rates::Rates;
use crate::table::place;
use crate::topic::info::qos_line;
use crate::topic::tap;
use crate::verb::Outcome;
use std::collections::{BTreeMap, BTreeSet};
use tautline_transport::{EndpointKind, Gid, GraphSnapshot, NodeName, Origin, ServiceKind};

#[derive(Debug, Default)]
pub struct Wanted<'a> {
    /// This node, its topics, and the nodes that it is connected to.
    pub node: Option<&'a str>,
    pub topic: Option<&'a str>,
    pub services: bool,
    /// Also the endpoints that every node has.
    pub all: bool,
}

/// An endpoint of a topic or a service.
struct End {
    key: (TopicKind, String),
    type_name: String,
    kind: EdgeKind,
    node: Node,
    qos: String,
    rate: Rate,
    problem: Option<String>,
}

/// Selects the parts of a domain. Without `rates` the rates are unknown.
///
/// # Errors
/// The node or topic does not exist.
pub fn gather(
    domain: u32,
    graph: &GraphSnapshot,
    rates: Option<(&Rates, f64)>,
    wanted: &Wanted,
) -> Outcome<Picture> {
    let full = |name: Option<&str>| name.map(full_name);
    let (node, topic) = (full(wanted.node), full(wanted.topic));
    if let Some(node) = &node {
        node_named(graph, node)?;
    }
    if let Some(topic) = topic.as_ref().filter(|topic| tap::ends(graph, topic).next().is_none()) {
        return Err(tap::unknown(graph, topic));
    }

    let mismatches = compatibility::mismatches(graph);
    let mut ends: Vec<End> = topic_ends(graph, rates.map(|(rates, _)| rates), &mismatches);
    if wanted.services {
        ends.extend(service_ends(graph));
    }
    let is_named =
        |end: &End| topic.as_ref().is_some_and(|topic| end.key == (TopicKind::Topic, topic.clone()));
    let is_left_out = |end: &&End| !wanted.all && !is_named(end) && is_everywhere(&end.key.1);
    if let Some(node) = &node {
        let own = ends.iter().filter(|end| end.node.name.as_ref() == Some(node));
        let own: BTreeSet<_> = own.map(|end| end.key.clone()).collect();
        ends.retain(|end| own.contains(&end.key));
    }
    if topic.is_some() {
        ends.retain(is_named);
    }
    let left_out = ends.iter().filter(is_left_out).map(|end| &end.key).collect::<BTreeSet<_>>().len();
    ends.retain(|end| !is_left_out(&end));

    let is_part = node.is_some() || topic.is_some();
    let shown = graph.nodes.iter().map(|info| of_node(Some(&info.name), info.pid, &info.origin));
    let shown = shown.filter(|one| {
        !is_part || node.is_some() && one.name == node || ends.iter().any(|end| end.node == *one)
    });
    let mut nodes: Vec<Node> = shown.collect();
    let nameless: BTreeSet<&Node> =
        ends.iter().map(|end| &end.node).filter(|one| !nodes.contains(one)).collect();
    nodes.extend(nameless.into_iter().cloned().collect::<Vec<_>>());
    let keys: BTreeSet<&(TopicKind, String)> = ends.iter().map(|end| &end.key).collect();
    let found = mismatches.iter().map(|found| Mismatch {
        topic: found.publisher.topic.clone(),
        publisher: compatibility::label(found.publisher),
        subscription: compatibility::label(found.subscription),
        reason: found.reason(),
    });
    let found = found.filter(|found| keys.contains(&(TopicKind::Topic, found.topic.clone())));
    Ok(Picture {
        domain,
        seconds: rates.map(|(_, seconds)| seconds),
        mismatches: found.collect::<BTreeSet<_>>().into_iter().collect(),
        topics: topics(&ends),
        edges: edges(&ends, &nodes),
        nodes,
        chains: Vec::new(),
        left_out,
    })
}

fn of_node(name: Option<&NodeName>, pid: Option<u32>, origin: &Origin) -> Node {
    Node { name: name.map(NodeName::full_name), pid, place: place(origin).map(str::to_owned) }
}

fn topic_ends(
    graph: &GraphSnapshot,
    rates: Option<&Rates>,
    mismatches: &[compatibility::Mismatch],
) -> Vec<End> {
    let mut problems: BTreeMap<Gid, BTreeSet<String>> = BTreeMap::new();
    for found in mismatches {
        problems.entry(found.subscription.gid).or_default().insert(found.words());
    }
    let end = |end: &std::sync::Arc<tautline_transport::TopicEndpoint>| {
        let (kind, rate) = match (end.kind, rates) {
            (EndpointKind::Subscription, _) => (EdgeKind::Subscribes, Rate::None),
            (EndpointKind::Publisher, None) => (EdgeKind::Publishes, Rate::None),
            (EndpointKind::Publisher, Some(rates)) => {
                let rate = rates.get(&end.gid).copied().flatten();
                (EdgeKind::Publishes, rate.map_or(Rate::Unknown, |rate| Rate::Hz(rate.messages_hz)))
            }
        };
        let problem = problems.get(&end.gid).filter(|_| kind == EdgeKind::Subscribes);
        End {
            key: (TopicKind::Topic, end.topic.clone()),
            type_name: end.topic_type.name.to_string(),
            kind,
            node: of_node(end.node.as_ref(), end.pid, &end.origin),
            qos: qos_line(&end.qos),
            rate,
            problem: problem.map(|words| words.iter().cloned().collect::<Vec<_>>().join(", ")),
        }
    };
    graph.endpoints.iter().map(end).collect()
}

fn service_ends(graph: &GraphSnapshot) -> impl Iterator<Item = End> {
    graph.services.iter().map(|end| {
        let (key, type_name) = match action_of(&end.name, &end.type_name) {
            Some((name, type_name)) => ((TopicKind::Action, name.to_owned()), type_name),
            None => ((TopicKind::Service, end.name.clone()), &*end.type_name),
        };
        End {
            key,
            type_name: type_name.to_owned(),
            kind: if end.kind == ServiceKind::Client { EdgeKind::Asks } else { EdgeKind::Serves },
            node: of_node(end.node.as_ref(), end.pid, &end.origin),
            qos: String::new(),
            rate: Rate::None,
            problem: None,
        }
    })
}

/// Whether every node has such an endpoint, or it is a part of an action.
fn is_everywhere(name: &str) -> bool {
    const OF_PARAMETERS: [&str; 7] = [
        "describe_parameters",
        "get_parameters",
        "get_parameter_types",
        "list_parameters",
        "set_parameters",
        "set_parameters_atomically",
        "get_type_description",
    ];
    let last = name.rsplit('/').next().unwrap_or(name);
    ["/rosout", "/parameter_events"].contains(&name)
        || OF_PARAMETERS.contains(&last)
        || name.contains("/_action/")
}

fn topics(ends: &[End]) -> Vec<Topic> {
    let mut found: BTreeMap<&(TopicKind, String), (BTreeSet<&str>, Rate)> = BTreeMap::new();
    for end in ends {
        let (types, rate) = found.entry(&end.key).or_insert((BTreeSet::new(), Rate::None));
        types.insert(&end.type_name);
        *rate = rate.plus(end.rate);
    }
    let topic = |((kind, name), (types, rate)): (&(TopicKind, String), (BTreeSet<&str>, Rate))| Topic {
        kind: *kind,
        name: name.clone(),
        types: types.into_iter().map(str::to_owned).collect(),
        rate,
    };
    found.into_iter().map(topic).collect()
}

/// Merges equal endpoints of a node. If a process has several nodes of one name, the first one gets all their endpoints, because the graph
/// does not distinguish them.
fn edges(ends: &[End], nodes: &[Node]) -> Vec<Edge> {
    let keys: BTreeSet<&(TopicKind, String)> = ends.iter().map(|end| &end.key).collect();
    let at: BTreeMap<_, usize> = keys.into_iter().zip(0..).collect();
    let mut place: BTreeMap<&Node, usize> = BTreeMap::new();
    for (index, node) in nodes.iter().enumerate() {
        place.entry(node).or_insert(index);
    }
    let mut found = BTreeMap::new();
    for end in ends {
        let key = (at[&end.key], end.kind, place[&end.node], &end.qos, &end.problem);
        let (count, rate) = found.entry(key).or_insert((0, Rate::None));
        (*count, *rate) = (*count + 1, rate.plus(end.rate));
    }
    let edge =
        |((topic, kind, node, qos, problem), (count, rate)): ((_, _, _, &String, &Option<String>), _)| Edge {
            kind,
            node,
            topic,
            count,
            qos: qos.clone(),
            rate,
            problem: problem.clone(),
            bound: None,
        };
    found.into_iter().map(edge).collect()
}

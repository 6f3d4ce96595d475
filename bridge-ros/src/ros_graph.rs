// SPDX-License-Identifier: MIT OR Apache-2.0
//! What exists in ROS, without what bridges made; and the same in Tautline's terms, for its nodes and tools.

use crate::rcl::{Node, RclError, RosEndpoint, RosNode};
use crate::rules::Rules;
use std::collections::{BTreeSet, HashMap};
use std::time::{Duration, Instant};
use tautline_transport::{
    EndpointKind, Gid, NodeName, RemoteGraph, ServiceEndpoint, ServiceKind, TopicEndpoint, TopicType,
};

/// How the names of bridges' nodes begin: what these nodes have stands for others' ends.
pub const BRIDGE_PREFIX: &str = "taut_bridge_";

/// Whose node an endpoint is comes later than the endpoint; what stays without one for so long is no ROS node's. Longer than two
/// heartbeats of Fast DDS (3 s), after which it sends again what got lost: another bridge's end must not be taken for a node's.
pub(crate) const NAME_TIME: Duration = Duration::from_secs(7);

/// What exists in ROS.
#[derive(Default)]
pub(crate) struct RosGraph {
    /// All nodes, bridges' too.
    pub(crate) nodes: Vec<RosNode>,
    /// Publishers and subscriptions, but for bridges'.
    pub(crate) endpoints: Vec<TopicEndpoint>,
    /// By topic, all publishers that it is known of whether they are a bridge's.
    pub(crate) publishers: HashMap<String, BTreeSet<Gid>>,
    unknown: HashMap<Gid, Instant>,
}

impl RosGraph {
    /// Reads it anew.
    pub(crate) fn read(&mut self, node: &Node) -> Result<(), RclError> {
        let (mut endpoints, mut publishers) = (Vec::new(), HashMap::<String, BTreeSet<Gid>>::new());
        let before = std::mem::take(&mut self.unknown);
        for topic in node.topics()?.into_keys() {
            for kind in [EndpointKind::Publisher, EndpointKind::Subscription] {
                for end in node.endpoints(&topic, kind)? {
                    if end.node.is_none() {
                        let since = before.get(&end.gid).copied().unwrap_or_else(Instant::now);
                        self.unknown.insert(end.gid, since);
                        if since.elapsed() < NAME_TIME {
                            continue;
                        }
                    }
                    if kind == EndpointKind::Publisher {
                        publishers.entry(topic.clone()).or_default().insert(end.gid);
                    }
                    let is_bridge =
                        end.node.as_ref().is_some_and(|node| node.name.starts_with(BRIDGE_PREFIX));
                    if !is_bridge {
                        endpoints.push(endpoint(&topic, end));
                    }
                }
            }
        }
        (self.endpoints, self.publishers) = (endpoints, publishers);
        self.nodes = node.nodes()?;
        Ok(())
    }

    /// Whether there are endpoints whose node is waited for.
    pub(crate) fn has_unknown(&self) -> bool {
        self.unknown.values().any(|since| since.elapsed() < 2 * NAME_TIME)
    }
}

fn endpoint(topic: &str, end: RosEndpoint) -> TopicEndpoint {
    let topic_type = TopicType::new(end.type_name);
    TopicEndpoint {
        kind: end.kind,
        topic: topic.to_owned(),
        topic_type: match end.type_hash {
            Some(hash) => topic_type.with_hash(hash),
            None => topic_type,
        },
        gid: end.gid,
        qos: end.qos,
        node: end.node.as_ref().map(node_name),
        pid: None,
        is_remote: true,
        is_own: false,
    }
}

pub(crate) fn node_name(node: &RosNode) -> NodeName {
    NodeName { namespace: node.namespace.clone(), name: node.name.clone() }
}

/// What Tautline's tools are to list: nodes but for bridges and `own`, the endpoints of bridged topics by Tautline's names.
pub(crate) fn as_remote(graph: &RosGraph, own: &[RosNode], rules: &Rules) -> RemoteGraph {
    let mut own = own.to_vec();
    let mut remote = RemoteGraph::default();
    let listed = graph.nodes.iter().filter(|node| !node.name.starts_with(BRIDGE_PREFIX)).filter(|node| {
        // One of each name is this bridge's; another is somebody else's.
        let at = own.iter().position(|own| own == *node);
        at.map(|at| own.swap_remove(at)).is_none()
    });
    remote.nodes.extend(listed.map(node_name));
    for end in &graph.endpoints {
        if let Some(topic) = rules.tautline_name(&end.topic) {
            remote.endpoints.push(TopicEndpoint { topic, ..end.clone() });
        }
    }
    // The same graph is the same list.
    remote.nodes.sort();
    remote.endpoints.sort_by(|one, other| (&one.topic, one.gid).cmp(&(&other.topic, other.gid)));
    remote
}

/// Says in `ends` which servers of `service` there are, as far as `found` tells: a node that was started anew has the name of the
/// one before.
pub(crate) fn identify(ends: &mut Vec<ServiceEndpoint>, service: &str, found: &[RosEndpoint]) {
    let is_server = |end: &ServiceEndpoint| end.kind == ServiceKind::Server && end.name == service;
    let (servers, others): (Vec<_>, Vec<_>) = std::mem::take(ends).into_iter().partition(is_server);
    *ends = others;
    for server in servers {
        let of_node =
            |end: &&RosEndpoint| end.node.is_some() && end.node.as_ref().map(node_name) == server.node;
        let mut gids: Vec<Gid> = found.iter().filter(of_node).map(|end| end.gid).collect();
        if gids.is_empty() {
            gids.push(server.gid);
        }
        ends.extend(gids.into_iter().map(|gid| ServiceEndpoint { gid, ..server.clone() }));
    }
}

/// The services and clients of `nodes`, but for bridges'. A name that two nodes have is there twice, and so is what they have.
pub(crate) fn services<'n>(node: &Node, nodes: impl Iterator<Item = &'n RosNode>) -> Vec<ServiceEndpoint> {
    let mut ends = Vec::new();
    for of in nodes.filter(|node| !node.name.starts_with(BRIDGE_PREFIX)) {
        let lists = [(ServiceKind::Server, node.services_of(of)), (ServiceKind::Client, node.clients_of(of))];
        for (kind, list) in lists {
            // What a node that has just gone had is nothing.
            for (name, types) in list.unwrap_or_default() {
                ends.extend(types.into_iter().map(|type_name| ServiceEndpoint {
                    kind,
                    name: name.clone(),
                    type_name,
                    type_hash: None,
                    gid: Gid::default(),
                    node: Some(node_name(of)),
                    pid: None,
                    is_remote: true,
                }));
            }
        }
    }
    ends.sort_by(|one, other| (&one.name, one.kind, &one.node).cmp(&(&other.name, other.kind, &other.node)));
    ends
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_transport::Qos;

    #[test]
    fn servers_are_told_apart_by_where_they_take_requests() {
        let node = |name: &str| RosNode { name: name.into(), namespace: "/".into() };
        let end = |name: &str, kind, of| ServiceEndpoint {
            kind,
            name: name.into(),
            type_name: "a/srv/B".into(),
            type_hash: None,
            gid: Gid::default(),
            node: Some(node_name(&node(of))),
            pid: None,
            is_remote: true,
        };
        let found = |of, gid| RosEndpoint {
            kind: EndpointKind::Subscription,
            node: Some(node(of)),
            type_name: "a/srv/B".into(),
            type_hash: None,
            gid: Gid([gid; 16]),
            qos: Qos::default(),
        };
        let mut ends = vec![
            end("/x", ServiceKind::Client, "one"),
            end("/x", ServiceKind::Server, "one"),
            end("/x", ServiceKind::Server, "two"),
            end("/y", ServiceKind::Server, "one"),
        ];
        // A bridge's is none of ours; that of `two` is not told yet.
        identify(&mut ends, "/x", &[found("one", 1), found("taut_bridge_1", 3)]);
        let told = |end: &ServiceEndpoint| (end.name.clone(), end.node.clone().unwrap().name, end.gid.0[0]);
        let servers = ends.iter().filter(|end| end.kind == ServiceKind::Server).map(told);
        let expected = [("/y", "one", 0), ("/x", "one", 1), ("/x", "two", 0)];
        assert_eq!(
            servers.collect::<Vec<_>>(),
            expected.map(|(name, of, gid)| (name.into(), of.into(), gid))
        );
        assert_eq!(ends.len(), 4);
    }
}

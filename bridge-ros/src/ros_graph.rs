// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ROS graph without this bridge's endpoints, also in Tautline's terms, for nodes and tools.

use crate::rcl::{Node, RclError, RosEndpoint};
use crate::table::{self, NAME_TIME, OriginTable, Tables};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Instant;
use tautline_transport::{
    EndpointKind, Gid, NodeName, Origin, Qos, RemoteNode, ServiceEndpoint, ServiceKind, TopicEndpoint,
    TopicType,
};

/// Prefix of bridges' node names: the endpoints of such a node mirror others.
pub const BRIDGE_PREFIX: &str = "taut_bridge_";

/// The ROS graph.
#[derive(Default)]
pub(crate) struct RosGraph {
    /// All nodes, including bridges', with their enclaves.
    pub(crate) nodes: Vec<(NodeName, String)>,
    /// ROS nodes' publishers and subscriptions, and those that other bridges mirror, each with its announcer; see [`Transit`](tautline_relay::Transit).
    pub(crate) endpoints: Vec<(TopicEndpoint, u128)>,
    /// By topic, all publishers that are identified.
    pub(crate) publishers: HashMap<String, BTreeSet<Gid>>,
    /// Other bridges' tables.
    pub(crate) tables: Vec<Arc<OriginTable>>,
    /// GID prefixes of nodes' endpoints.
    processes: HashMap<NodeName, [u8; 12]>,
    unknown: HashMap<Gid, Instant>,
}

impl RosGraph {
    /// Reads the graph. `place` is the ROS domain's name for users.
    pub(crate) fn read(&mut self, node: &Node, place: &str, tables: &Tables) -> Result<(), RclError> {
        let (mut endpoints, mut publishers) = (Vec::new(), HashMap::<String, BTreeSet<Gid>>::new());
        let before = std::mem::take(&mut self.unknown);
        node.context().refresh();
        let tellers = node.endpoints(table::TOPIC, EndpointKind::Publisher)?;
        self.tables = tables.of(&tellers.iter().map(|end| end.gid).collect());
        let told = self
            .tables
            .iter()
            .flat_map(|table| table.graph.endpoints.iter().map(|end| (end, u128::from(table.bridge))));
        let (publishers_told, subscriptions_told): (Vec<_>, Vec<_>) =
            told.partition(|(end, _)| end.kind == EndpointKind::Publisher);
        let stand_ins: HashMap<Gid, (&TopicEndpoint, u128)> =
            publishers_told.into_iter().map(|(end, bridge)| (end.gid, (end, bridge))).collect();
        self.processes.clear();
        for topic in node.topics()?.into_keys().filter(|topic| topic != table::TOPIC) {
            for kind in [EndpointKind::Publisher, EndpointKind::Subscription] {
                for end in node.endpoints(&topic, kind)? {
                    let is_own = node.context().is_own(&end.gid);
                    let is_bridge =
                        is_own || end.node.as_ref().is_some_and(|node| node.name.starts_with(BRIDGE_PREFIX));
                    let stands_for = stand_ins.get(&end.gid);
                    let is_told = is_own || kind == EndpointKind::Subscription || stands_for.is_some();
                    if !is_own && (end.node.is_none() || (is_bridge && !is_told)) {
                        let since = before.get(&end.gid).copied().unwrap_or_else(Instant::now);
                        self.unknown.insert(end.gid, since);
                        if since.elapsed() < NAME_TIME {
                            continue;
                        }
                    }
                    if kind == EndpointKind::Publisher {
                        publishers.entry(topic.clone()).or_default().insert(end.gid);
                    }
                    match (is_bridge, stands_for) {
                        (false, _) => {
                            if let Some(node) = &end.node {
                                let process = std::array::from_fn(|at| end.gid.0[at]);
                                self.processes.insert(node.clone(), process);
                            }
                            endpoints.push((endpoint(&topic, end, place), 0));
                        }
                        (true, Some((told, bridge))) => {
                            // ROS has the current topic name and the QoS that decides about matching.
                            let qos = Qos { depth: told.qos.depth, history: told.qos.history, ..end.qos };
                            let told = TopicEndpoint { topic: topic.clone(), qos, ..(*told).clone() };
                            endpoints.push((told, *bridge));
                        }
                        (true, None) => {}
                    }
                }
            }
        }
        endpoints.extend(subscriptions_told.into_iter().map(|(end, bridge)| (end.clone(), bridge)));
        (self.endpoints, self.publishers) = (endpoints, publishers);
        self.nodes = node.nodes()?;
        Ok(())
    }

    /// Nodes without bridges', those that bridges show, and `own`, each with its announcer.
    pub(crate) fn others(&self, own: &[NodeName], domain: u64, place: &str) -> Vec<(RemoteNode, u128)> {
        let mut shown = own.to_vec();
        let mut nodes = Vec::new();
        for table in &self.tables {
            for node in &table.graph.nodes {
                shown.push(node.name.clone());
                nodes.push((node.clone(), u128::from(table.bridge)));
            }
        }
        let mut count = BTreeMap::<&NodeName, usize>::new();
        for (node, enclave) in self.nodes.iter().filter(|(node, _)| !node.name.starts_with(BRIDGE_PREFIX)) {
            // One node per name is a bridge's; any other is a ROS node.
            if let Some(at) = shown.iter().position(|shown| shown == node) {
                shown.swap_remove(at);
                continue;
            }
            let count = count.entry(node).or_default();
            *count += 1;
            // Without an endpoint the node's process is unknown, and another bridge announces it as a different node.
            let of = self
                .processes
                .get(node)
                .map_or_else(|| format!("{domain:x}"), |process| format!("{process:02x?}"));
            let tag = Origin::tag_of(&format!("{of} {node} {count}"));
            let origin = Origin { tag, ..Origin::here(Gid::default(), place) };
            nodes.push((RemoteNode { name: node.clone(), enclave: enclave.clone(), origin }, 0));
        }
        nodes
    }

    /// Whether endpoints still wait for the name of their node.
    pub(crate) fn has_unknown(&self) -> bool {
        self.unknown.values().any(|since| since.elapsed() < 2 * NAME_TIME)
    }
}

fn endpoint(topic: &str, end: RosEndpoint, place: &str) -> TopicEndpoint {
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
        node: end.node,
        pid: None,
        is_remote: true,
        is_own: false,
        origin: Origin::here(end.gid, place),
        teller: None,
    }
}

/// Sets the tag of each of ROS's own services and clients. With other bridges it is the GID of the request endpoint, where the
/// RMW announces it; otherwise it is derived from this `domain`, whether or not there are clients.
pub(crate) fn mark(ends: &mut [ServiceEndpoint], domain: u64, is_alone: bool) {
    let mut count = HashMap::<String, usize>::new();
    for end in ends {
        end.origin.tag = end.gid.tag();
        if is_alone || end.gid == Gid::default() {
            let node = end.node.as_ref().map(NodeName::full_name).unwrap_or_default();
            let text = format!("{domain:x} {:?} {} {} {node}", end.kind, end.name, end.type_name);
            let count = count.entry(text.clone()).or_default();
            *count += 1;
            end.origin.tag = Origin::tag_of(&format!("{count} {text}"));
        }
    }
}

/// The GID that announces the service or client with this tag in the domain.
pub(crate) fn announced_gid(tag: u64) -> Gid {
    let halves = ["a", "b"].map(|half| Origin::tag_of(&format!("{half} {tag:x}")).to_le_bytes());
    Gid(std::array::from_fn(|at| halves[at / 8][at % 8]))
}

/// Replaces the servers of `service` in `ends` by those in `found`: a restarted node has the name of the previous one.
pub(crate) fn identify(ends: &mut Vec<ServiceEndpoint>, service: &str, found: &[RosEndpoint]) {
    let is_server = |end: &ServiceEndpoint| end.kind == ServiceKind::Server && end.name == service;
    let (servers, others): (Vec<_>, Vec<_>) = std::mem::take(ends).into_iter().partition(is_server);
    *ends = others;
    for server in servers {
        let of_node = |end: &&RosEndpoint| end.node.is_some() && end.node == server.node;
        let mut gids: Vec<Gid> = found.iter().filter(of_node).map(|end| end.gid).collect();
        if gids.is_empty() {
            gids.push(server.gid);
        }
        ends.extend(gids.into_iter().map(|gid| ServiceEndpoint { gid, ..server.clone() }));
    }
}

/// The services and clients of `nodes`, without bridges'. For a name that two nodes have, they are listed twice.
pub(crate) fn services<'n>(
    node: &Node,
    nodes: impl Iterator<Item = &'n NodeName>,
    place: &str,
) -> Vec<ServiceEndpoint> {
    let mut ends = Vec::new();
    for of in nodes.filter(|node| !node.name.starts_with(BRIDGE_PREFIX)) {
        for kind in [ServiceKind::Server, ServiceKind::Client] {
            // A node that has just ended has no services.
            for (name, types) in node.services_of(of, kind).unwrap_or_default() {
                ends.extend(types.into_iter().map(|type_name| ServiceEndpoint {
                    kind,
                    name: name.clone(),
                    type_name,
                    type_hash: None,
                    gid: Gid::default(),
                    node: Some(of.clone()),
                    pid: None,
                    is_remote: true,
                    origin: Origin::here(Gid::default(), place),
                    teller: None,
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

    #[test]
    fn servers_are_told_apart_by_where_they_take_requests() {
        let node = |name: &str| NodeName { name: name.into(), namespace: "/".into() };
        let end = |name: &str, kind, of| ServiceEndpoint {
            kind,
            name: name.into(),
            type_name: "a/srv/B".into(),
            type_hash: None,
            gid: Gid::default(),
            node: Some(node(of)),
            pid: None,
            is_remote: true,
            origin: Origin::default(),
            teller: None,
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
        // A bridge's server is ignored; that of `two` is not announced yet.
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

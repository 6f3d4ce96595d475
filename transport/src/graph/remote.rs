// SPDX-License-Identifier: MIT OR Apache-2.0
//! Entities elsewhere, as a gateway or bridge announces them, and as text.

use crate::graph::entities::{NodeName, ServiceEndpoint, TopicEndpoint};
use crate::graph::origin::Origin;
use crate::graph::record::{NodeRecord, RemotePortRecord, RemoteServiceRecord, is_enclave, root};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeSet, HashMap};

/// A node elsewhere.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RemoteNode {
    /// Its name. Two nodes may have the same.
    pub name: NodeName,
    /// Its SROS 2 enclave; `/` for the root.
    pub enclave: String,
    /// Its origin.
    pub origin: Origin,
}

/// The entities of other hosts: see [`Participant::set_remote`](crate::Participant::set_remote). Invalid entities, such as names with
/// control characters, are left out, and so are endpoints without a node. `pid`, `is_remote`, `is_own` and `teller` are ignored.
///
/// Its text form, for relays that announce it further, is read as untrusted data: the same entities are left
/// out there.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(into = "Text", from = "Text")]
pub struct RemoteGraph {
    /// Nodes. The node of an endpoint need not be listed here.
    pub nodes: Vec<RemoteNode>,
    /// Publishers and subscriptions.
    pub endpoints: Vec<TopicEndpoint>,
    /// Services and clients.
    pub services: Vec<ServiceEndpoint>,
    /// The tags of publishers that ended normally; publishers that disappear without being listed here have died. Not part
    /// of the text.
    pub ended: BTreeSet<u64>,
}

impl RemoteGraph {
    /// The listed nodes, each once, and a node without an origin for each node name that only endpoints have.
    pub(crate) fn all_nodes(&self) -> Vec<RemoteNode> {
        let nodes = self.nodes.iter().filter(|node| node.origin.is_valid() && is_enclave(&node.enclave));
        let nodes: BTreeSet<&RemoteNode> = nodes.collect();
        let listed: BTreeSet<&NodeName> = nodes.iter().map(|node| &node.name).collect();
        let of_ends = self.endpoints.iter().filter_map(|end| end.node.as_ref());
        let of_ends = of_ends.chain(self.services.iter().filter_map(|end| end.node.as_ref()));
        let unlisted: BTreeSet<&NodeName> = of_ends.filter(|name| !listed.contains(name)).collect();
        let unlisted = unlisted.into_iter().map(|name| RemoteNode {
            name: name.clone(),
            enclave: root(),
            origin: Origin::default(),
        });
        nodes.into_iter().cloned().chain(unlisted).filter(|node| node.name.is_valid()).collect()
    }

    /// The records of its endpoints; `nodes` maps the names of nodes to their numbers.
    pub(crate) fn records(
        &self,
        nodes: &HashMap<NodeName, u64>,
    ) -> (Vec<RemotePortRecord>, Vec<RemoteServiceRecord>) {
        let number = |node: &Option<NodeName>| nodes.get(node.as_ref()?).copied();
        let port = |end: &TopicEndpoint| Some(RemotePortRecord::new(number(&end.node)?, end));
        let service = |end: &ServiceEndpoint| Some(RemoteServiceRecord::new(number(&end.node)?, end));
        (
            self.endpoints.iter().filter_map(port).filter(RemotePortRecord::is_valid).collect(),
            self.services.iter().filter_map(service).filter(RemoteServiceRecord::is_valid).collect(),
        )
    }
}

/// The text form: the records of all nodes, whose indices the endpoints refer to, and of all endpoints.
#[derive(Serialize, Deserialize)]
struct Text {
    #[serde(default)]
    nodes: Vec<NodeRecord>,
    #[serde(default)]
    ends: Vec<RemotePortRecord>,
    #[serde(default)]
    services: Vec<RemoteServiceRecord>,
}

impl From<RemoteGraph> for Text {
    fn from(graph: RemoteGraph) -> Self {
        let nodes = graph.all_nodes();
        let mut places = HashMap::new();
        for (place, node) in nodes.iter().enumerate() {
            places.entry(node.name.clone()).or_insert(place as u64);
        }
        let (ends, services) = graph.records(&places);
        // A node that only endpoints name has no origin; readers do not list it as a node either.
        let record = |RemoteNode { name, enclave, origin }| {
            let origin = (origin != Origin::default()).then_some(origin);
            NodeRecord { name, enclave, origin }
        };
        Text { nodes: nodes.into_iter().map(record).collect(), ends, services }
    }
}

impl From<Text> for RemoteGraph {
    fn from(Text { nodes, ends, services }: Text) -> Self {
        let node_at = |place: u64| {
            let node = nodes.get(usize::try_from(place).ok()?)?;
            node.is_valid().then_some(&node.name)
        };
        let endpoints = ends.iter().filter(|end| end.is_valid());
        let endpoints = endpoints.filter_map(|end| Some(end.endpoint(node_at(end.node)?, None))).collect();
        let services = services.iter().filter(|end| end.is_valid());
        let services = services.filter_map(|end| Some(end.endpoint(node_at(end.node)?, None))).collect();
        let nodes = nodes.into_iter().filter(NodeRecord::is_valid);
        let nodes = nodes
            .filter_map(|NodeRecord { name, enclave, origin }| {
                Some(RemoteNode { name, enclave, origin: origin? })
            })
            .collect();
        RemoteGraph { nodes, endpoints, services, ended: BTreeSet::new() }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::graph::entities::{EndpointKind, ServiceKind};
    use crate::graph::topic_type::TopicType;
    use crate::memory::header::Gid;
    use crate::qos::Qos;

    fn graph() -> RemoteGraph {
        let node = |name: &str| NodeName { namespace: "/a".into(), name: name.into() };
        let origin = |gid| Origin::here(Gid([gid; 16]), "host").told_by(7);
        let end = TopicEndpoint {
            kind: EndpointKind::Subscription,
            topic: "/x".into(),
            topic_type: TopicType::new("a/msg/B").with_hash(format!("RIHS01_{:064x}", 7)),
            gid: Gid([2; 16]),
            qos: Qos::keep_last(7).transient_local().best_effort(),
            node: Some(node("unlisted")),
            pid: None,
            is_remote: true,
            is_own: false,
            origin: origin(2),
            teller: None,
        };
        let service = ServiceEndpoint {
            kind: ServiceKind::Client,
            name: "/a/add".into(),
            type_name: "a/srv/B".into(),
            type_hash: None,
            gid: Gid([3; 16]),
            node: Some(node("n")),
            pid: None,
            is_remote: true,
            origin: origin(3),
            teller: None,
        };
        let nodes = vec![RemoteNode { name: node("n"), enclave: "/front".into(), origin: origin(1) }];
        RemoteGraph { nodes, endpoints: vec![end], services: vec![service], ..RemoteGraph::default() }
    }

    fn read(text: &[u8]) -> Option<RemoteGraph> {
        serde_json::from_slice(text).ok()
    }

    #[test]
    fn what_is_told_is_read() {
        let text = serde_json::to_vec(&graph()).unwrap();
        assert_eq!(read(&text), Some(graph()));
        for end in 0..text.len() {
            assert_eq!(read(&text[..end]), None, "{end}");
        }
    }

    #[test]
    fn what_no_honest_host_tells_is_left_out() {
        let text = serde_json::to_string(&graph()).unwrap();
        let changed = |from: &str, to: &str| {
            assert!(text.contains(from), "{from} in {text}");
            read(text.replacen(from, to, 1).as_bytes()).unwrap()
        };
        let RemoteGraph { nodes, endpoints, services, ended } = graph();
        let without_end = RemoteGraph { endpoints: vec![], nodes, services, ended };
        for (from, to) in [
            ("\"/x\"", "\"/x\\u001b[2J\""),
            ("a/msg/B", "a msg"),
            ("\"name\":\"unlisted\"", "\"name\":\"un listed\""),
            ("\"depth\":7", "\"depth\":0"),
            ("\"node\":1", "\"node\":9"),
        ] {
            assert_eq!(changed(from, to), without_end, "{to}");
        }
        let far = Origin { path: vec![1; Origin::MOST_HOPS + 1], ..Origin::default() };
        let hostile = RemoteGraph { endpoints, ..RemoteGraph::default() };
        let hostile = RemoteGraph {
            endpoints: vec![TopicEndpoint { origin: far, ..hostile.endpoints[0].clone() }],
            ..hostile
        };
        let text = serde_json::to_vec(&hostile).unwrap();
        assert_eq!(read(&text), Some(RemoteGraph::default()), "nor is it written");
    }
}

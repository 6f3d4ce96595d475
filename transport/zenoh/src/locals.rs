// SPDX-License-Identifier: MIT OR Apache-2.0
//! What exists on this host, in the network's terms.

use crate::mirror::LocalEndpoint;
use crate::wire::{EndpointKind, NodeName, TypeId, WireDuration, WireQos};
use std::collections::{BTreeMap, HashMap};
use tautline_schema::{TypeHash, TypeName};
use tautline_transport::{Liveliness, Participant, Qos, ServiceKind, TransportError};

/// The nodes; the endpoints that can be mirrored, and the topics and services that cannot, with the reason.
#[derive(Default)]
pub(crate) struct Locals {
    pub(crate) nodes: Vec<NodeName>,
    pub(crate) endpoints: Vec<LocalEndpoint>,
    pub(crate) refused: BTreeMap<String, String>,
}

/// Lists them. `hash_of` finds the hash of a type that a topic does not state, from its topic's and type's name.
pub(crate) fn list(
    participant: &Participant,
    mut hash_of: impl FnMut(&str, &TypeName) -> Option<TypeHash>,
) -> Result<Locals, TransportError> {
    let graph = participant.graph()?;
    let mut locals = Locals::default();
    let mut processes = HashMap::new();
    locals.nodes.extend(graph.nodes.iter().filter(|node| !node.is_remote).map(|node| wire_node(&node.name)));
    for end in graph.endpoints.into_iter().filter(|end| !end.is_remote) {
        let kind = match end.kind {
            tautline_transport::EndpointKind::Publisher => EndpointKind::Publisher,
            tautline_transport::EndpointKind::Subscription => EndpointKind::Subscription,
        };
        let node = match &end.node {
            Some(node) => wire_node(node),
            None => processes.entry(end.pid).or_insert_with(|| node_of(end.pid)).clone(),
        };
        let (type_name, hash) = (&end.topic_type.name, end.topic_type.hash.as_deref());
        match type_id(&end.topic, type_name, hash, &mut hash_of) {
            Err(reason) => drop(locals.refused.insert(end.topic, reason)),
            Ok(type_id) => {
                let (gid, topic, qos) = (end.gid, end.topic, wire_qos(&end.qos));
                locals.endpoints.push(LocalEndpoint { gid, kind, topic, type_id, qos, node });
            }
        }
    }
    for end in graph.services.into_iter().filter(|end| !end.is_remote) {
        let kind = match end.kind {
            ServiceKind::Server => EndpointKind::Service,
            ServiceKind::Client => EndpointKind::Client,
        };
        match type_id(&end.name, &end.type_name, end.type_hash.as_deref(), &mut hash_of) {
            Err(reason) => drop(locals.refused.insert(end.name, reason)),
            Ok(type_id) => {
                // As ROS 2's services have it.
                let (gid, topic, qos) = (end.gid, end.name, wire_qos(&Qos::keep_last(10)));
                let node = wire_node(&end.node);
                locals.endpoints.push(LocalEndpoint { gid, kind, topic, type_id, qos, node });
            }
        }
    }
    Ok(locals)
}

fn type_id(
    topic: &str,
    name: &str,
    hash: Option<&str>,
    hash_of: &mut impl FnMut(&str, &TypeName) -> Option<TypeHash>,
) -> Result<TypeId, String> {
    let name: TypeName = name.parse().map_err(|_| format!("'{name}' is no ROS 2 type name"))?;
    let hash = match hash {
        Some(text) => text.parse().ok(),
        None => hash_of(topic, &name),
    };
    let hash = hash.ok_or_else(|| {
        format!("no hash is known of type {name}: give the type one, or set AMENT_PREFIX_PATH to where it is defined")
    })?;
    Ok(TypeId { name, hash })
}

fn wire_node(node: &tautline_transport::NodeName) -> NodeName {
    NodeName::new(&node.namespace, &node.name)
}

/// What is nobody's node's is its process's, which is called by its own name.
fn node_of(pid: Option<u32>) -> NodeName {
    let name = pid.and_then(|pid| Some((pid, std::fs::read_to_string(format!("/proc/{pid}/comm")).ok()?)));
    let Some((pid, name)) = name else { return NodeName::new("/", "unnamed") };
    let mut name: String =
        name.trim().chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    if !name.starts_with(|first: char| first.is_ascii_alphabetic()) {
        name.insert_str(0, "process_");
    }
    NodeName::new("/", &format!("{name}_{pid}"))
}

fn wire_qos(qos: &Qos) -> WireQos {
    WireQos {
        reliability: qos.reliability,
        durability: qos.durability,
        history: qos.history,
        depth: qos.depth as u64,
        deadline: WireDuration::from_duration(qos.deadline),
        lifespan: WireDuration::from_duration(qos.lifespan),
        manual_liveliness: qos.liveliness == Liveliness::ManualByTopic,
        lease: WireDuration::from_duration(qos.liveliness_lease_duration),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_that_an_end_states_is_in_its_token() {
        let seconds = |n| Some(std::time::Duration::from_secs(n));
        let (deadline, lifespan, liveliness_lease_duration) = (seconds(1), seconds(2), seconds(3));
        let qos = Qos { deadline, lifespan, liveliness_lease_duration, ..Qos::keep_last(7) };
        let manual = Qos { liveliness: Liveliness::ManualByTopic, ..qos };
        assert_eq!(wire_qos(&qos).to_string(), "::,7:1,0:2,0:,3,0");
        assert_eq!(wire_qos(&manual).to_string(), "::,7:1,0:2,0:3,3,0");
        assert_eq!(wire_qos(&Qos::keep_last(42)), WireQos::default());
        // As another process lists it.
        let [one, other] = [(); 2].map(|()| Participant::new(216).unwrap());
        let topic_type = tautline_transport::TopicType::new("std_msgs/msg/Empty");
        let _port = one.create_raw_publisher("/stated", &topic_type, manual, Default::default()).unwrap();
        let listed = other.topics().unwrap();
        let listed = listed.iter().find(|topic| topic.name == "/stated").unwrap();
        assert_eq!(wire_qos(&listed.publishers[0].qos), wire_qos(&manual));
    }

    #[test]
    fn processes_have_names_that_nodes_can_have() {
        let me = node_of(Some(std::process::id()));
        assert!(me.name.ends_with(&std::process::id().to_string()) && me.namespace == "/", "{me:?}");
        assert_eq!(node_of(None), node_of(Some(u32::MAX)));
    }
}

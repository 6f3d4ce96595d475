// SPDX-License-Identifier: MIT OR Apache-2.0
//! What exists on this host, in the network's terms.

use crate::mirror::LocalEndpoint;
use crate::wire::{EndpointKind, NodeName, TypeId, WireDuration, WireQos};
use std::collections::hash_map::DefaultHasher;
use std::collections::{BTreeMap, HashMap};
use std::hash::{Hash, Hasher};
use tautline_schema::{TypeHash, TypeName};
use tautline_transport::{
    EndpointInfo, Gid, Participant, Qos, ServiceEndpoint, ServiceKind, TopicInfo, TransportError,
};

/// The endpoints that can be mirrored, and the topics that cannot, with the reason.
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
    let mut locals = Locals::default();
    let mut names = HashMap::new();
    for topic in participant.topics()? {
        let ends = topic.publishers.iter().chain(&topic.subscriptions);
        if ends.clone().all(|end| end.is_own) {
            continue;
        }
        match type_id(&topic, &mut hash_of) {
            Err(reason) => drop(locals.refused.insert(topic.name.clone(), reason)),
            Ok(type_id) => {
                let mut add = |end: &EndpointInfo, kind| {
                    if end.is_own {
                        return;
                    }
                    let node = names.entry(end.pid).or_insert_with(|| node_of(end.pid)).clone();
                    let (topic, type_id, qos) = (topic.name.clone(), type_id.clone(), wire_qos(&end.qos));
                    locals.endpoints.push(LocalEndpoint { gid: end.gid, kind, topic, type_id, qos, node });
                };
                topic.publishers.iter().for_each(|end| add(end, EndpointKind::Publisher));
                topic.subscriptions.iter().for_each(|end| add(end, EndpointKind::Subscription));
            }
        }
    }
    let services = participant.graph()?.services;
    for (number, service) in services.iter().enumerate().filter(|(_, service)| !service.is_remote) {
        let end = service_endpoint(service, number);
        match end.ok_or_else(|| format!("no hash is known of type {}", service.type_name)) {
            Ok(end) => locals.endpoints.push(end),
            Err(reason) => drop(locals.refused.insert(service.name.clone(), reason)),
        }
    }
    Ok(locals)
}

/// A server or a client of a service; `number` tells those of one node apart.
fn service_endpoint(service: &ServiceEndpoint, number: usize) -> Option<LocalEndpoint> {
    let kind = match service.kind {
        ServiceKind::Server => EndpointKind::Service,
        ServiceKind::Client => EndpointKind::Client,
    };
    let name: TypeName = service.type_name.parse().ok()?;
    let type_id = TypeId { name, hash: service.type_hash.as_ref()?.parse().ok()? };
    // It has no gid of its own.
    let part = |salt: u64| {
        let mut hasher = DefaultHasher::new();
        (salt, service.kind, &service.name, &service.node.namespace, &service.node.name).hash(&mut hasher);
        (service.pid, &service.type_name, number).hash(&mut hasher);
        u128::from(hasher.finish())
    };
    Some(LocalEndpoint {
        gid: Gid((part(0) | part(1) << 64).to_le_bytes()),
        kind,
        topic: service.name.clone(),
        type_id,
        qos: WireQos { depth: 10, ..WireQos::default() },
        node: NodeName::new(&service.node.namespace, &service.node.name),
    })
}

fn type_id(
    topic: &TopicInfo,
    hash_of: &mut impl FnMut(&str, &TypeName) -> Option<TypeHash>,
) -> Result<TypeId, String> {
    let stated = &topic.topic_type;
    let name: TypeName =
        stated.name.parse().map_err(|_| format!("'{}' is no ROS 2 type name", stated.name))?;
    let hash = match &stated.hash {
        Some(text) => text.parse().ok(),
        None => hash_of(&topic.name, &name),
    };
    let hash = hash.ok_or_else(|| {
        format!("no hash is known of type {name}: give the message type one, or set AMENT_PREFIX_PATH to where it is defined")
    })?;
    Ok(TypeId { name, hash })
}

/// A process that says no node's name is called by its own.
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
        ..WireQos::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processes_have_names_that_nodes_can_have() {
        let me = node_of(Some(std::process::id()));
        assert!(me.name.ends_with(&std::process::id().to_string()) && me.namespace == "/", "{me:?}");
        assert_eq!(node_of(None), node_of(Some(u32::MAX)));
    }
}

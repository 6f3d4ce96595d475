// SPDX-License-Identifier: MIT OR Apache-2.0
//! The domain's endpoints in terms of the network, including those that bridges and other gateways announce in it.

use crate::tokens::LocalEndpoint;
use crate::wire::{
    EndpointKind, MAX_NAME_BYTES, NodeName, TopicKey, TypeId, WireDuration, WireQos, is_absolute,
};
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use tautline_relay::{LocalGraph, process_node};
use tautline_schema::{TypeHash, TypeName};
use tautline_transport::{Gid, Liveliness, Origin, Qos, ServiceEndpoint, ServiceKind, TopicEndpoint};

/// An endpoint of a topic or service, from the graph.
struct EndpointView<'a> {
    kind: EndpointKind,
    name: &'a str,
    type_name: &'a str,
    hash: Option<&'a str>,
    gid: Gid,
    qos: WireQos,
    node: Option<&'a tautline_transport::NodeName>,
    pid: Option<u32>,
    teller: Option<u64>,
    origin: &'a Origin,
}

impl<'a> EndpointView<'a> {
    fn of_topic(end: &'a TopicEndpoint) -> Self {
        EndpointView {
            kind: match end.kind {
                tautline_transport::EndpointKind::Publisher => EndpointKind::Publisher,
                tautline_transport::EndpointKind::Subscription => EndpointKind::Subscription,
            },
            name: &end.topic,
            type_name: &end.topic_type.name,
            hash: end.topic_type.hash.as_deref(),
            gid: end.gid,
            qos: wire_qos(&end.qos),
            node: end.node.as_ref(),
            pid: end.pid,
            teller: end.teller,
            origin: &end.origin,
        }
    }

    fn of_service(end: &'a ServiceEndpoint) -> Self {
        EndpointView {
            kind: match end.kind {
                ServiceKind::Server => EndpointKind::Service,
                ServiceKind::Client => EndpointKind::Client,
            },
            name: &end.name,
            type_name: &end.type_name,
            hash: end.type_hash.as_deref(),
            gid: end.gid,
            // ROS 2's default for services.
            qos: wire_qos(&Qos::keep_last(10)),
            node: end.node.as_ref(),
            pid: end.pid,
            teller: end.teller,
            origin: &end.origin,
        }
    }
}

/// The endpoints in terms of the network. Endpoints that cannot be mirrored are removed from `here`, and `here.problems` gets the reasons;
/// the rest of `here` gets type hashes. `hash_of` finds the hash, by topic and type, where no local endpoint states it.
pub(crate) fn list(
    here: &mut LocalGraph,
    mut hash_of: impl FnMut(&str, &TypeName) -> Option<TypeHash>,
) -> Vec<LocalEndpoint> {
    let topics = here.endpoints.iter().map(|end| EndpointView::of_topic(end));
    let ends: Vec<EndpointView> =
        topics.chain(here.services.iter().map(|end| EndpointView::of_service(end))).collect();
    let mut stated = HashMap::new();
    for end in &ends {
        if let Some(hash) = end.hash {
            // If the hashes differ, none is reliable.
            let known = stated.entry((end.name, end.type_name)).or_insert(Some(hash));
            *known = known.filter(|known| *known == hash);
        }
    }
    let (mut processes, mut problems) = (HashMap::new(), BTreeMap::new());
    let enclaves: HashMap<_, &str> =
        here.nodes.iter().map(|node| ((&node.name, node.pid, node.teller), &*node.enclave)).collect();
    // Once per topic: the look-up is slow.
    let mut found = HashMap::<(String, TypeName), Option<TypeHash>>::new();
    let mut hash_of = |topic: &str, name: &TypeName| {
        *found.entry((topic.to_owned(), name.clone())).or_insert_with(|| hash_of(topic, name))
    };
    let mut listed: Vec<Option<LocalEndpoint>> = Vec::with_capacity(ends.len());
    for end in ends {
        let hash = end.hash.or_else(|| stated.get(&(end.name, end.type_name)).copied().flatten());
        let type_id = type_id(end.name, end.type_name, hash, &mut hash_of);
        let type_id = type_id.map_err(|reason| drop(problems.insert(end.name.to_owned(), reason)));
        listed.push(type_id.ok().map(|type_id| LocalEndpoint {
            gid: end.gid,
            kind: end.kind,
            topic: end.name.to_owned(),
            type_id,
            qos: end.qos,
            node: match end.node {
                Some(node) => {
                    wire_node(node, enclaves.get(&(node, end.pid, end.teller)).copied().unwrap_or("/"))
                }
                None => {
                    processes.entry(end.pid).or_insert_with(|| wire_node(&process_node(end.pid), "/")).clone()
                }
            },
            origin: end.origin.clone(),
        }));
    }
    here.problems = problems;
    let mut next = listed.iter();
    let mut hash = || Some(next.next()?.as_ref()?.type_id.hash.to_string());
    here.endpoints.retain_mut(|end| {
        let hash = hash();
        if hash.is_some() && end.topic_type.hash.is_none() {
            let topic_type = end.topic_type.clone().with_hash(hash.clone().unwrap_or_default());
            *end = Arc::new(TopicEndpoint { topic_type, ..(**end).clone() });
        }
        hash.is_some()
    });
    here.services.retain_mut(|end| {
        let hash = hash();
        if hash.is_some() && end.type_hash.is_none() {
            *end = Arc::new(ServiceEndpoint { type_hash: hash.clone(), ..(**end).clone() });
        }
        hash.is_some()
    });
    listed.into_iter().flatten().collect()
}

fn type_id(
    topic: &str,
    name: &str,
    hash: Option<&str>,
    hash_of: &mut impl FnMut(&str, &TypeName) -> Option<TypeHash>,
) -> Result<TypeId, String> {
    // Other hosts refuse the tokens of others, or take them for those of another topic: `/a%b` is `/a/b` there.
    if !is_absolute(topic) {
        return Err(format!(
            "it has no name of ROS 2: write '/' before each part, and only letters, digits and '_', at most {MAX_NAME_BYTES} bytes"
        ));
    }
    let name: TypeName = name.parse().map_err(|_| format!("'{name}' is not a ROS 2 type name"))?;
    let hash = match hash {
        Some(text) => text.parse().ok(),
        None => hash_of(topic, &name),
    };
    let hash = hash.ok_or_else(|| {
        format!("no hash is known for type {name}: declare the type with one, or add its definition to AMENT_PREFIX_PATH")
    })?;
    Ok(TypeId { name, hash })
}

pub(crate) fn wire_key(domain: u32, key: &tautline_relay::TopicKey) -> Result<TopicKey, String> {
    let type_id =
        || Some(TypeId { name: key.type_name.parse().ok()?, hash: key.type_hash.as_ref()?.parse().ok()? });
    let type_id = type_id().ok_or_else(|| format!("'{}' is not a ROS 2 type name", key.type_name))?;
    Ok(TopicKey { domain, topic: key.far_topic.clone(), type_id })
}

pub(crate) fn wire_node(node: &tautline_transport::NodeName, enclave: &str) -> NodeName {
    NodeName { enclave: enclave.to_owned(), ..NodeName::new(&node.namespace, &node.name) }
}

pub(crate) fn wire_qos(qos: &Qos) -> WireQos {
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
    use std::collections::BTreeSet;
    use tautline_transport::{Limits, Participant, TopicType};

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
        crate::tests::isolated();
        let [one, other] = [(); 2].map(|()| Participant::new(215).unwrap());
        let _port = one.create_raw_publisher("/stated", &empty(), manual, Limits::default()).unwrap();
        let listed = other.topics().unwrap();
        let listed = listed.iter().find(|topic| topic.name == "/stated").unwrap();
        assert_eq!(wire_qos(&listed.publishers[0].qos), wire_qos(&manual));
    }

    /// One endpoint states the hash of the type, another does not; on another topic two hashes differ.
    #[test]
    fn a_hash_is_the_whole_topics() {
        crate::tests::isolated();
        let participant = Participant::new(214).unwrap();
        let hash = |digit: &str| format!("RIHS01_{}", digit.repeat(64));
        let [one, two] = ["1", "2"].map(|digit| empty().with_hash(hash(digit)));
        let ends = [
            ("/agreed", empty()),
            ("/agreed", one.clone()),
            ("/torn", empty()),
            ("/torn", one),
            ("/torn", two),
        ];
        let _ports = ends.map(|(topic, topic_type)| {
            participant.create_raw_publisher(topic, &topic_type, Qos::default(), Limits::default()).unwrap()
        });
        let endpoints = participant.graph().unwrap().endpoints.clone();
        let mut here = LocalGraph { endpoints, ..LocalGraph::default() };
        let locals = list(&mut here, |_, _| None);
        let mut listed: Vec<_> =
            locals.iter().map(|end| (&*end.topic, end.type_id.hash.to_string())).collect();
        listed.sort();
        let expected = [("/agreed", "1"), ("/agreed", "1"), ("/torn", "1"), ("/torn", "2")];
        assert_eq!(listed, expected.map(|(topic, digit)| (topic, hash(digit))));
        assert!(here.problems["/torn"].starts_with("no hash is known"), "{:?}", here.problems);
        let told = here.endpoints.iter().map(|end| (&*end.topic, end.topic_type.hash.clone().unwrap()));
        let mut told: Vec<_> = told.map(|(topic, hash)| (topic, hash.to_string())).collect();
        told.sort();
        assert_eq!(told, listed);
    }

    /// Topics of one host may have names that no other host accepts, or takes for another topic's.
    #[test]
    fn what_no_other_host_would_accept_is_named() {
        crate::tests::isolated();
        let participant = Participant::new(213).unwrap();
        let topic_type = empty().with_hash(format!("RIHS01_{}", "1".repeat(64)));
        let others = ["/a%b", "/robot-1/x", "/a b", "/é", "x", "/x/", "/x//y", "/*", "/x#"];
        let create = |topic| {
            participant.create_raw_publisher(topic, &topic_type, Qos::default(), Limits::default()).unwrap()
        };
        let _ports: Vec<_> = others.into_iter().chain(["/x/y_1"]).map(create).collect();
        let endpoints = participant.graph().unwrap().endpoints.clone();
        let mut here = LocalGraph { endpoints, ..LocalGraph::default() };
        let listed = list(&mut here, |_, _| None);
        assert_eq!(listed.iter().map(|end| &*end.topic).collect::<Vec<_>>(), ["/x/y_1"]);
        assert_eq!(here.endpoints.len(), 1);
        let named: BTreeSet<&str> = here.problems.keys().map(String::as_str).collect();
        assert_eq!(named, BTreeSet::from(others));
    }

    fn empty() -> TopicType {
        TopicType::new("std_msgs/msg/Empty")
    }
}

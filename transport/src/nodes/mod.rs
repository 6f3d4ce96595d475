// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes: who has which publishers, subscriptions, services and clients, in this process, on this host, on others.
//!
//! iceoryx2 knows the ports of a topic, and of each its process. What it does not know, each participant says in a file
//! of its own in /dev/shm: its nodes, which port is whose, its services and clients. A gateway says there what other hosts
//! have. Whoever asks for the [`GraphSnapshot`] reads the files of all, beside iceoryx2's books. A file counts as long as
//! its process lives; the janitor removes it afterwards.

mod events;
mod file;
mod record;
mod registry;

pub use events::GraphEvents;
pub(crate) use events::Watchers;
pub use registry::ServiceRegistration;
pub(crate) use registry::{Entry, Ownership, Registry, remove_dead_files};

use crate::error::TransportError;
use crate::header::Gid;
use crate::participant::Participant;
use crate::qos::Qos;
use crate::topic_type::TopicType;
use record::Record;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;

/// A node's name and its namespace.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct NodeName {
    /// Absolute; `/` for the root.
    pub namespace: String,
    /// Without the namespace.
    pub name: String,
}

impl NodeName {
    /// `/namespace/name`.
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }
}

impl fmt::Display for NodeName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.namespace.trim_end_matches('/'), self.name)
    }
}

/// A node of the domain.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct NodeInfo {
    /// Its name. Two nodes may have the same.
    pub name: NodeName,
    /// Its process, if it is on this host.
    pub pid: Option<u32>,
    /// Whether it is on another host.
    pub is_remote: bool,
}

/// Which end of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EndpointKind {
    /// It publishes.
    Publisher,
    /// It subscribes.
    Subscription,
}

/// A publisher or a subscription of the domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicEndpoint {
    /// Which of both.
    pub kind: EndpointKind,
    /// The topic's fully qualified name.
    pub topic: String,
    /// What is known of the topic's type.
    pub topic_type: TopicType,
    /// Its identifier.
    pub gid: Gid,
    /// The quality of service that was asked for.
    pub qos: Qos,
    /// Its node; `None` if it was made without one.
    pub node: Option<NodeName>,
    /// Its process, if it is on this host.
    pub pid: Option<u32>,
    /// Whether it is on another host.
    pub is_remote: bool,
    /// Whether it belongs to the participant that asked.
    pub is_own: bool,
}

/// Which end of a service.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ServiceKind {
    /// It answers requests.
    Server,
    /// It makes requests.
    Client,
}

/// A service or a client of the domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceEndpoint {
    /// Which of both.
    pub kind: ServiceKind,
    /// The service's fully qualified name.
    pub name: String,
    /// The ROS 2 name of its type, `package/srv/Name`.
    pub type_name: String,
    /// The type's hash, if it is known.
    pub type_hash: Option<String>,
    /// Its identifier.
    pub gid: Gid,
    /// Its node.
    pub node: NodeName,
    /// Its process, if it is on this host.
    pub pid: Option<u32>,
    /// Whether it is on another host.
    pub is_remote: bool,
}

/// What exists in a domain, on this host and, if it has a gateway, on others. What a gateway opens here for other hosts'
/// publishers and subscriptions is left out: those are listed themselves.
#[derive(Clone, Debug, Default)]
pub struct GraphSnapshot {
    /// Nodes, sorted by namespace and name.
    pub nodes: Vec<NodeInfo>,
    /// Publishers and subscriptions, sorted by topic.
    pub endpoints: Vec<TopicEndpoint>,
    /// Services and clients, sorted by name.
    pub services: Vec<ServiceEndpoint>,
    /// Publishers that gateways and bridges opened here: they stand for others' and are in no list above.
    pub relays: Vec<Gid>,
}

/// What other hosts have: see [`Participant::set_remote`]. `pid`, `is_remote` and `is_own` are not looked at, nor is an
/// endpoint without a node.
#[derive(Clone, Debug, Default)]
pub struct RemoteGraph {
    /// Nodes.
    pub nodes: Vec<NodeName>,
    /// Publishers and subscriptions.
    pub endpoints: Vec<TopicEndpoint>,
    /// Services and clients.
    pub services: Vec<ServiceEndpoint>,
}

/// A node that others see until this, its clones and everything that was made for it are dropped.
#[derive(Clone)]
pub struct NodeHandle {
    pub(crate) entry: Arc<Entry>,
}

impl NodeHandle {
    /// The node's name.
    pub fn name(&self) -> &NodeName {
        &self.entry.node
    }

    /// Says that the node answers requests to `service`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: a name or hash that cannot be one, no shared memory.
    pub fn register_service(
        &self,
        service: &str,
        type_name: &str,
        type_hash: Option<&str>,
    ) -> Result<ServiceRegistration, TransportError> {
        self.entry.add_service(ServiceKind::Server, service, type_name, type_hash)
    }

    /// Says that the node makes requests to `service`, a fully qualified name.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`register_service`](Self::register_service).
    pub fn register_client(
        &self,
        service: &str,
        type_name: &str,
        type_hash: Option<&str>,
    ) -> Result<ServiceRegistration, TransportError> {
        self.entry.add_service(ServiceKind::Client, service, type_name, type_hash)
    }
}

impl fmt::Debug for NodeHandle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("NodeHandle").field("name", &self.entry.node).finish_non_exhaustive()
    }
}

impl Participant {
    /// Makes a node known to the domain.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: names that break ROS 2's rules, no shared memory.
    pub fn create_node(&self, name: &str, namespace: &str) -> Result<NodeHandle, TransportError> {
        let node = NodeName { namespace: namespace.into(), name: name.into() };
        Ok(NodeHandle { entry: self.shared.registry.add_node(node)? })
    }

    /// The same membership; publishers and subscriptions that are created through this one are the node's.
    #[must_use]
    pub fn for_node(&self, node: &NodeHandle) -> Participant {
        Participant { shared: self.shared.clone(), node: Some(node.entry.clone()) }
    }

    /// The nodes of the domain, sorted by namespace and name, those of other hosts too.
    ///
    /// # Real-time
    /// Not for real-time threads: reads files.
    pub fn nodes(&self) -> Vec<NodeInfo> {
        nodes(&self.shared.registry.records())
    }

    /// Everything that exists in the domain.
    ///
    /// # Real-time
    /// Not for real-time threads: opens each topic, with files and allocations.
    ///
    /// # Errors
    /// As [`topics`](Self::topics).
    pub fn graph(&self) -> Result<GraphSnapshot, TransportError> {
        let topics = self.topics()?;
        // After the topics: a port that is listed has said before whose it is.
        let records = self.shared.registry.records();
        let owners: HashMap<Gid, &NodeName> = (records.iter())
            .flat_map(|record| record.owners.iter().map(|(gid, node)| (*gid, record.nodes.get(node))))
            .filter_map(|(gid, node)| Some((gid, node?)))
            .collect();
        let is_relay = |arena| records.iter().any(|record| record.is_relay && record.arena == arena);
        let (mut endpoints, mut relays) = (Vec::new(), Vec::new());
        for topic in &topics {
            relays.extend(topic.publishers.iter().filter(|end| is_relay(end.arena.0)).map(|end| end.gid));
            let kinds = [
                (EndpointKind::Publisher, &topic.publishers),
                (EndpointKind::Subscription, &topic.subscriptions),
            ];
            for (kind, ends) in kinds {
                let ends = ends.iter().filter(|end| !is_relay(end.arena.0));
                endpoints.extend(ends.map(|end| TopicEndpoint {
                    kind,
                    topic: topic.name.clone(),
                    topic_type: topic.topic_type.clone(),
                    gid: end.gid,
                    qos: end.qos,
                    node: owners.get(&end.gid).map(|node| (*node).clone()),
                    pid: end.pid,
                    is_remote: false,
                    is_own: end.is_own,
                }));
            }
        }
        for record in records.iter().filter(|record| record.is_relay) {
            endpoints.extend(record.endpoints.iter().filter_map(|end| record.endpoint(end)));
        }
        endpoints.sort_by(|one, other| (&one.topic, one.kind).cmp(&(&other.topic, other.kind)));
        let of_record = |record: &'_ Record| {
            record.services.values().filter_map(|service| record.service(service)).collect::<Vec<_>>()
        };
        let mut services: Vec<ServiceEndpoint> = records.iter().flat_map(of_record).collect();
        services.sort_by(|one, other| (&one.name, one.kind).cmp(&(&other.name, other.kind)));
        Ok(GraphSnapshot { nodes: nodes(&records), endpoints, services, relays })
    }

    /// Says what other hosts have, in place of what it said before, and that this participant's own ports stand for
    /// their ends. For a gateway: it has a participant for itself.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::Graph`] if there is no shared memory for it; what was said before stays.
    pub fn set_remote(&self, remote: &RemoteGraph) -> Result<(), TransportError> {
        self.shared.registry.set_remote(remote)
    }

    /// Wakes a task when something of the domain appears or goes. What happens between two polls is one event.
    ///
    /// # Real-time
    /// Setup only: the first one starts a thread, an ordinary one of low priority, which sleeps until something changes.
    ///
    /// # Errors
    /// [`TransportError::Janitor`] if the thread cannot be started.
    pub fn graph_events(&self) -> Result<GraphEvents, TransportError> {
        self.shared.watchers.subscribe()
    }
}

/// The publishers and subscriptions of other hosts.
pub(crate) fn remote_endpoints(registry: &Registry) -> Vec<TopicEndpoint> {
    let records = registry.records();
    let relays = records.iter().filter(|record| record.is_relay);
    relays.flat_map(|record| record.endpoints.iter().filter_map(|end| record.endpoint(end))).collect()
}

/// The type that a topic has on other hosts, if all agree on it.
pub(crate) fn remote_topic_type(registry: &Registry, topic: &str) -> Option<TopicType> {
    let ends = remote_endpoints(registry).into_iter();
    let mut types = ends.filter(|end| end.topic == topic).map(|end| end.topic_type);
    let first = types.next()?;
    types.all(|other| other == first).then_some(first)
}

fn nodes(records: &[Record]) -> Vec<NodeInfo> {
    let of_record = |record: &'_ Record| {
        let (pid, is_remote) = ((!record.is_relay).then_some(record.pid), record.is_relay);
        let info = move |name: &NodeName| NodeInfo { name: name.clone(), pid, is_remote };
        record.nodes.values().map(info).collect::<Vec<_>>()
    };
    let mut nodes: Vec<NodeInfo> = records.iter().flat_map(of_record).collect();
    nodes.sort();
    nodes
}

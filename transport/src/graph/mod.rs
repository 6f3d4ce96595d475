// SPDX-License-Identifier: MIT OR Apache-2.0
//! What exists in a domain: nodes, topics, services, and their endpoints, in this process, on this host and on other hosts.
//!
//! The graph is maintained state, not the result of a query. Each participant keeps one record of its nodes and ports ([`log`],
//! [`own`]). Other participants map the record and continue to read from their last position ([`model`] for the whole graph, the
//! topics' matching for single entries). One file lists the participants of the domain and counts changes ([`domain`]). Reading
//! the graph opens no topic, occupies nothing and waits for no process.
//!
//! A gateway announces the entities of other hosts in its record.

pub(crate) mod domain;
mod events;
pub(crate) mod log;
mod model;
mod origin;
pub(crate) mod own;
pub(crate) mod record;
mod remote;
mod visitor;

pub use domain::{is_dead_domain, remove_dead_domain};
pub use events::GraphEvents;
pub(crate) use events::GraphWatcher;
pub(crate) use model::Model;
pub use origin::{Origin, Rank};
pub(crate) use own::{NodeEntry, OwnRecord};
pub use remote::{RemoteGraph, RemoteNode};
pub use visitor::{Death, Visitor, graph_of};

use crate::error::TransportError;
use crate::participant::Participant;
use crate::qos::Qos;
use crate::topic::header::Gid;
use crate::topic::topic_type::TopicType;
use record::{REQUESTS, RESPONSES};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use tautline_doorbell::Slot;

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
        self.to_string()
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
    /// Whether it is on another host, or in ROS.
    pub is_remote: bool,
    /// Its origin.
    pub origin: Origin,
    /// The participant that announces it, if it is elsewhere.
    pub teller: Option<u64>,
}

/// The kind of a topic's endpoint.
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
    /// Its kind.
    pub kind: EndpointKind,
    /// The topic's fully qualified name.
    pub topic: String,
    /// What this endpoint knows about the type of its messages. Endpoints of one topic with different types
    /// do not match.
    pub topic_type: TopicType,
    /// Its identifier.
    pub gid: Gid,
    /// The requested quality of service.
    pub qos: Qos,
    /// Its node; `None` if it was created without one.
    pub node: Option<NodeName>,
    /// Its process, if it is on this host.
    pub pid: Option<u32>,
    /// Whether it is on another host, or in ROS.
    pub is_remote: bool,
    /// Whether it belongs to the participant that asked.
    pub is_own: bool,
    /// Its origin.
    pub origin: Origin,
    /// The participant that announces it, if it is elsewhere.
    pub teller: Option<u64>,
}

/// The kind of a service's endpoint.
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
    /// Its kind.
    pub kind: ServiceKind,
    /// The service's fully qualified name.
    pub name: String,
    /// The ROS 2 name of its type, `package/srv/Name`.
    pub type_name: String,
    /// The type's hash, if it is known.
    pub type_hash: Option<String>,
    /// Its identifier.
    pub gid: Gid,
    /// Its node; `None` if it was created without one.
    pub node: Option<NodeName>,
    /// Its process, if it is on this host.
    pub pid: Option<u32>,
    /// Whether it is on another host, or in ROS.
    pub is_remote: bool,
    /// Its origin.
    pub origin: Origin,
    /// The participant that announces it, if it is elsewhere.
    pub teller: Option<u64>,
}

/// What exists in a domain: on this host and, if it has gateways or bridges, on other hosts and in ROS. The local ports that
/// gateways and bridges open for remote publishers and subscriptions are not listed. The remote endpoints themselves are listed,
/// each once, as announced by the participant with the least [`Rank`].
#[derive(Clone, Debug, Default)]
pub struct GraphSnapshot {
    /// Nodes, sorted by namespace and name.
    pub nodes: Vec<Arc<NodeInfo>>,
    /// Publishers and subscriptions, sorted by topic.
    pub endpoints: Vec<Arc<TopicEndpoint>>,
    /// Services and clients, sorted by name.
    pub services: Vec<Arc<ServiceEndpoint>>,
    /// For gateways and bridges: for each tag the least rank with which other participants announce it.
    pub rivals: HashMap<u64, Rank>,
    /// For gateways and bridges: the tags of the latest publishers that ended normally. A publisher that has disappeared and is not
    /// listed here has died.
    pub ended: Vec<u64>,
}

impl GraphSnapshot {
    /// The type of a topic, as far as its endpoints know it, if they all agree; `None` if they do not, or if there is no such
    /// topic.
    pub fn topic_type(&self, topic: &str) -> Option<TopicType> {
        let from = self.endpoints.partition_point(|end| end.topic.as_str() < topic);
        let mut ends = self.endpoints[from..].iter().take_while(|end| end.topic == topic);
        let first = ends.next()?.topic_type.clone();
        ends.try_fold(first, |known, end| known.join(&end.topic_type))
    }
}

/// A topic of a domain.
#[derive(Clone, Debug)]
pub struct TopicInfo {
    /// The fully qualified name.
    pub name: String,
    /// Its publishers.
    pub publishers: Vec<Arc<TopicEndpoint>>,
    /// Its subscriptions.
    pub subscriptions: Vec<Arc<TopicEndpoint>>,
}

/// A node that other processes see until this handle, its clones and everything that was created for the node
/// are dropped.
#[derive(Clone)]
pub struct NodeHandle {
    pub(crate) entry: Arc<NodeEntry>,
}

impl NodeHandle {
    /// The node's name.
    pub fn name(&self) -> &NodeName {
        &self.entry.node
    }

    /// Ends everything that was created for the node, or is created for it from now on: streams end after they have delivered
    /// what had arrived, and publishing and requests return errors. Other processes see the node until all of this is dropped.
    ///
    /// # Real-time
    /// Not for real-time threads: waits for a lock; O(objects created for the node), one syscall for each thread that waits for
    /// one of them.
    pub fn end(&self) {
        self.entry.end();
    }

    /// Whether it was [ended](Self::end).
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn has_ended(&self) -> bool {
        self.entry.has_ended()
    }

    /// The owner of this slot ends with the node.
    ///
    /// # Real-time
    /// Setup only.
    pub fn adopt(&self, slot: &Arc<Slot>) {
        self.entry.adopt(slot);
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
        self.state.domain.check_process()?;
        let node = NodeName { namespace: namespace.into(), name: name.into() };
        Ok(NodeHandle { entry: self.state.record.add_node(node)? })
    }

    /// The same membership; publishers and subscriptions that are created through the result belong to the
    /// node.
    #[must_use = "only what is created through the returned participant is the node's"]
    pub fn for_node(&self, node: &NodeHandle) -> Participant {
        Participant { state: self.state.clone(), node: Some(node.entry.clone()) }
    }

    /// Everything that exists in the domain. If nothing has changed since the last call, returns the same snapshot after
    /// one check.
    ///
    /// # Real-time
    /// Not for real-time threads: waits for a lock, maps files, allocates.
    ///
    /// # Errors
    /// [`TransportError`]: the system refuses to map another participant's record, at the limit of open files for one. A record that
    /// is damaged or of another version is skipped, and logged once.
    pub fn graph(&self) -> Result<Arc<GraphSnapshot>, TransportError> {
        self.state.domain.check_process()?;
        self.state.model().look(&self.state.domain)
    }

    /// How many nodes of the domain have this name. Cheaper than [`graph`](Self::graph), which takes time and memory in proportion
    /// to the size of the whole graph.
    ///
    /// # Real-time
    /// As [`graph`](Self::graph).
    pub fn node_count(&self, name: &NodeName) -> usize {
        self.state.matcher.nodes(log::hash_of(&name.full_name()))
    }

    /// The topics of the domain, sorted by name, without the topics that services consist of.
    ///
    /// # Real-time
    /// As [`graph`](Self::graph).
    ///
    /// # Errors
    /// As [`graph`](Self::graph).
    pub fn topics(&self) -> Result<Vec<TopicInfo>, TransportError> {
        let graph = self.graph()?;
        let mut topics: Vec<TopicInfo> = Vec::new();
        for end in &graph.endpoints {
            if topics.last().is_none_or(|topic| topic.name != end.topic) {
                let (publishers, subscriptions) = Default::default();
                topics.push(TopicInfo { name: end.topic.clone(), publishers, subscriptions });
            }
            if let Some(topic) = topics.last_mut() {
                match end.kind {
                    EndpointKind::Publisher => topic.publishers.push(end.clone()),
                    EndpointKind::Subscription => topic.subscriptions.push(end.clone()),
                }
            }
        }
        Ok(topics)
    }

    /// The type of a topic: see [`GraphSnapshot::topic_type`].
    ///
    /// # Real-time
    /// As [`graph`](Self::graph).
    ///
    /// # Errors
    /// As [`graph`](Self::graph).
    pub fn topic_type(&self, topic: &str) -> Result<Option<TopicType>, TransportError> {
        Ok(self.graph()?.topic_type(topic))
    }

    /// The type of a service, as far as its servers and clients know it; `None` if it has none of these, or if they
    /// disagree.
    ///
    /// # Real-time
    /// As [`graph`](Self::graph).
    ///
    /// # Errors
    /// As [`graph`](Self::graph).
    pub fn service_type(&self, service: &str) -> Result<Option<TopicType>, TransportError> {
        let graph = self.graph()?;
        let of = |end: &Arc<ServiceEndpoint>| TopicType {
            hash: end.type_hash.clone().map(Into::into),
            ..TopicType::new(end.type_name.clone())
        };
        let mut types = graph.services.iter().filter(|end| end.name == service).map(of);
        let Some(first) = types.next() else { return Ok(None) };
        Ok(types.try_fold(first, |known, other| known.join(&other)))
    }

    /// A number that changes when a node, publisher, subscription, service or client of the domain appears or disappears.
    /// Read it before [`graph`](Self::graph): if it is the same later, so is the graph.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn graph_epoch(&self) -> u32 {
        self.state.domain.epoch()
    }

    /// Sleeps until [`graph_epoch`](Self::graph_epoch) differs from `since`, at most for `timeout`. Returns the
    /// epoch.
    ///
    /// # Real-time
    /// Waits.
    pub fn wait_for_graph_change(&self, since: u32, timeout: Duration) -> u32 {
        self.state.domain.wait(since, Some(timeout))
    }

    /// Distinguishes this domain from domains of other hosts, users and scopes, and from the same domain at another time: a
    /// random number, created with the domain's first participant.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn domain_id(&self) -> u64 {
        self.state.domain.id()
    }

    /// This participant's own number. It is the [`teller`](TopicEndpoint::teller) of everything that this
    /// participant announces.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn id(&self) -> u64 {
        self.state.memory.id()
    }

    /// Announces the entities of other hosts, in place of the previous announcement, and marks this participant's
    /// own ports as proxies for them. For gateways and bridges, which have a participant of their own.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::File`] if there is no shared memory for it; a part may have been announced by then.
    pub fn set_remote(&self, remote: &RemoteGraph) -> Result<(), TransportError> {
        self.state.matcher.set_remote(remote)
    }

    /// Wakes a task when something in the domain appears or disappears. All changes between two polls are one
    /// event.
    ///
    /// # Real-time
    /// Setup only: the first call starts an ordinary thread of low priority, which sleeps until something changes.
    ///
    /// # Errors
    /// [`TransportError::Thread`] if the thread cannot be started.
    pub fn graph_events(&self) -> Result<GraphEvents, TransportError> {
        self.state.graph_watcher.subscribe()
    }
}

/// The service whose requests go over this topic.
pub(crate) fn service_of(topic: &str) -> Option<&str> {
    topic.strip_prefix(REQUESTS)
}

/// Whether a topic carries a service's requests or responses.
pub(crate) fn is_of_service(topic: &str) -> bool {
    topic.starts_with(REQUESTS) || topic.starts_with(RESPONSES)
}

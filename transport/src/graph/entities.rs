// SPDX-License-Identifier: MIT OR Apache-2.0
//! The entities of a domain, as the public interface reports them: nodes, endpoints of topics and services, deaths, and a snapshot.

use crate::graph::origin::{Origin, Rank};
use crate::graph::topic_type::TopicType;
use crate::memory::header::Gid;
use crate::qos::Qos;
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
    /// Its SROS 2 enclave; `/` for the root.
    pub enclave: String,
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum EndpointKind {
    /// It publishes.
    #[serde(rename = "pub")]
    Publisher,
    /// It subscribes.
    #[serde(rename = "sub")]
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

/// A process that ended without ending its entities in the domain: it was killed, crashed, or called `exit`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Death {
    /// The process.
    pub pid: u32,
    /// Its nodes, without those of other hosts that a gateway or bridge announced.
    pub nodes: Vec<NodeName>,
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the gateway says of itself.

use serde::Serialize;
use std::collections::BTreeMap;
pub use tautline_relay::Direction;
use tautline_relay::TopicKey;

/// What a topic is called.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct TopicNames {
    /// The topic.
    pub topic: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
}

impl TopicNames {
    pub(crate) fn of(key: TopicKey) -> Self {
        TopicNames { topic: key.topic, type_name: key.type_name }
    }
}

/// One topic in one direction.
pub type TopicStats = tautline_relay::TopicStats<TopicNames, Direction>;

/// The gateway at one moment.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Stats {
    /// The domain on this host.
    pub domain: u32,
    /// The domain on the network.
    pub network_domain: u32,
    /// Zenoh's id of the session.
    pub zid: String,
    /// Since it started.
    pub uptime_s: f64,
    /// Zenoh peers and routers that are linked to.
    pub links: usize,
    /// Nodes of other hosts.
    pub remote_nodes: usize,
    /// Publishers and subscriptions of other hosts.
    pub remote_endpoints: usize,
    /// Tokens refused: over the limit, or malformed by reason.
    pub refused_tokens: BTreeMap<String, u64>,
    /// Topics of this host that cannot be mirrored, and why.
    pub not_mirrored: BTreeMap<String, String>,
    /// How often types were asked for of other hosts or by them, by outcome.
    pub type_descriptions: BTreeMap<String, u64>,
    /// What access control refused in this process, if [`access_layer`](crate::access_layer) is installed, such as
    /// `Put (ingress) on /secret`.
    pub unauthorized: BTreeMap<String, u64>,
    /// How often the processor budget of the network's threads was used up.
    pub throttled: u64,
    /// Every topic that is or was mirrored.
    pub topics: Vec<TopicStats>,
    /// Every service that is or was mirrored.
    pub services: Vec<ServiceStats>,
}

/// A service, of which the gateway stands for the server.
pub type ServiceStats = tautline_relay::ServiceStats<ServiceNames, Direction>;

/// What a service is called.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct ServiceNames {
    /// The service.
    pub service: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
}

impl ServiceNames {
    pub(crate) fn of(key: TopicKey) -> Self {
        ServiceNames { service: key.topic, type_name: key.type_name }
    }
}

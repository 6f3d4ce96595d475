// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics of the gateway.

use crate::wire::Token;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
pub use tautline_relay::Direction;
use tautline_relay::{Latest, TopicKey};

/// The names of a topic.
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

/// A snapshot of the gateway.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Stats {
    /// The domain on this host.
    pub domain: u32,
    /// The domain on the network.
    pub network_domain: u32,
    /// Zenoh's session id.
    pub zid: String,
    /// Seconds since start.
    pub uptime_s: f64,
    /// Connected Zenoh peers and routers.
    pub links: usize,
    /// Nodes of other hosts.
    pub remote_nodes: usize,
    /// Publishers, subscriptions, services and clients of other hosts.
    pub remote_endpoints: usize,
    /// Tokens refused: over the limit, or malformed by reason.
    pub refused_tokens: BTreeMap<String, u64>,
    /// Topics of this host that cannot be mirrored, and why.
    pub not_mirrored: BTreeMap<String, String>,
    /// Requests for type descriptions from and to other hosts, by outcome.
    pub type_descriptions: BTreeMap<String, u64>,
    /// Refusals of access control in this process, such as `Put (ingress) on /secret`, if [`access_layer`](crate::access_layer)
    /// is installed.
    pub unauthorized: BTreeMap<String, u64>,
    /// How often the network's threads exceeded the processor budget.
    pub throttled: u64,
    /// Every topic that is mirrored, or was until a minute ago.
    pub topics: Vec<TopicStats>,
    /// Every service that is mirrored, or was until a minute ago.
    pub services: Vec<ServiceStats>,
}

/// A service whose server the gateway mirrors.
pub type ServiceStats = tautline_relay::ServiceStats<ServiceNames, Direction>;

/// The names of a service.
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

/// State that the control thread shares with the [`Gateway`](crate::Gateway).
pub(crate) struct GatewayState {
    pub(crate) stop: AtomicBool,
    /// Whether an event was dropped since the last resync.
    pub(crate) has_missed: AtomicBool,
    pub(crate) stats: Latest<Stats>,
    /// Nodes and endpoints of other hosts.
    pub(crate) remote: Latest<Vec<Token>>,
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics of the bridge.

use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64};
use tautline_relay::{Latest, TopicKey};

/// A topic in one direction.
pub type TopicStats = tautline_relay::TopicStats<TopicNames, Direction>;

/// The names of a topic.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct TopicNames {
    /// Its name in Tautline.
    pub topic: String,
    /// Its name in ROS.
    pub ros_topic: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
}

impl TopicNames {
    pub(crate) fn of(key: TopicKey) -> Self {
        TopicNames { topic: key.topic, ros_topic: key.far_topic, type_name: key.type_name }
    }
}

/// A service whose server the bridge mirrors.
pub type ServiceStats = tautline_relay::ServiceStats<ServiceNames, Direction>;

/// The names of a service.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct ServiceNames {
    /// Its name in Tautline.
    pub service: String,
    /// Its name in ROS.
    pub ros_service: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
}

impl ServiceNames {
    pub(crate) fn of(key: TopicKey) -> Self {
        ServiceNames { service: key.topic, ros_service: key.far_topic, type_name: key.type_name }
    }
}

/// Direction of messages, or of a service: from server to client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// From Tautline to ROS.
    ToRos,
    /// From ROS to Tautline.
    FromRos,
}

impl From<tautline_relay::Direction> for Direction {
    fn from(direction: tautline_relay::Direction) -> Self {
        match direction {
            tautline_relay::Direction::Out => Direction::ToRos,
            tautline_relay::Direction::In => Direction::FromRos,
        }
    }
}

/// Endpoints that are QoS-incompatible with the bridge's, as counted by ROS.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct IncompatibleQos {
    /// How many.
    pub count: u64,
    /// Policy of the last incompatible endpoint.
    pub last_policy: String,
}

/// A snapshot of the bridge.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Stats {
    /// Tautline's domain.
    pub domain: u32,
    /// ROS's domain.
    pub ros_domain: u32,
    /// The RMW, such as `rmw_fastrtps_cpp`.
    pub rmw: String,
    /// Seconds since start.
    pub uptime_s: f64,
    /// How often the threads exceeded the processor budget.
    pub throttled: u64,
    /// The bridge's own messages that came back from ROS: none with Fast DDS, unless a profile of the user's lets them.
    pub returned: u64,
    /// Nodes in ROS.
    pub ros_nodes: usize,
    /// Publishers and subscriptions in ROS, without those of bridges.
    pub ros_endpoints: usize,
    /// Topics that cannot be bridged, and why.
    pub not_bridged: BTreeMap<String, String>,
    /// Topics with QoS-incompatible endpoints in ROS.
    pub incompatible_qos: BTreeMap<String, IncompatibleQos>,
    /// Every topic that is bridged, or was until a minute ago.
    pub topics: Vec<TopicStats>,
    /// Services that cannot be bridged, and why.
    pub services_not_bridged: BTreeMap<String, String>,
    /// Every service that is bridged, or was until a minute ago.
    pub services: Vec<ServiceStats>,
}

/// The state that a running bridge publishes to its callers.
pub(crate) struct BridgeState {
    pub(crate) stop: AtomicBool,
    /// [`Stats::returned`].
    pub(crate) returned: AtomicU64,
    pub(crate) stats: Latest<Stats>,
}

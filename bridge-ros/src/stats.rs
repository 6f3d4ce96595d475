// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the bridge says of itself.

use serde::Serialize;
use std::collections::BTreeMap;
use tautline_relay::TopicKey;

/// A topic in one direction.
pub type TopicStats = tautline_relay::TopicStats<TopicNames, Direction>;

/// What a topic is called.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct TopicNames {
    /// Tautline's name of it.
    pub topic: String,
    /// ROS's name of it.
    pub ros_topic: String,
    /// What it carries.
    #[serde(rename = "type")]
    pub type_name: String,
}

impl TopicNames {
    pub(crate) fn of(key: TopicKey) -> Self {
        TopicNames { topic: key.topic, ros_topic: key.far_topic, type_name: key.type_name }
    }
}

/// A service, of which the bridge stands for the server.
pub type ServiceStats = tautline_relay::ServiceStats<ServiceNames, Direction>;

/// What a service is called.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct ServiceNames {
    /// Tautline's name of it.
    pub service: String,
    /// ROS's name of it.
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

/// Which way messages go, or to whom a service is offered.
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

/// Ends that do not fit a bridge's, as ROS counts them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct IncompatibleQos {
    /// How many.
    pub count: u64,
    /// Why the last one does not.
    pub last_policy: String,
}

/// The bridge at one moment.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Stats {
    /// Tautline's domain.
    pub domain: u32,
    /// ROS's domain.
    pub ros_domain: u32,
    /// The RMW, such as `rmw_fastrtps_cpp`.
    pub rmw: String,
    /// Since it started.
    pub uptime_s: f64,
    /// How often the processor budget of the bridge's threads was used up.
    pub throttled: u64,
    /// Nodes in ROS.
    pub ros_nodes: usize,
    /// Publishers and subscriptions in ROS, but for bridges'.
    pub ros_endpoints: usize,
    /// Topics that cannot be bridged, and why.
    pub not_bridged: BTreeMap<String, String>,
    /// Topics with ends in ROS whose QoS does not fit.
    pub incompatible_qos: BTreeMap<String, IncompatibleQos>,
    /// Every topic that is or was bridged.
    pub topics: Vec<TopicStats>,
    /// Services that cannot be bridged, and why.
    pub services_not_bridged: BTreeMap<String, String>,
    /// Every service that is or was bridged.
    pub services: Vec<ServiceStats>,
}

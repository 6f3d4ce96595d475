// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge: topics and services joined with a ROS 2 graph, as raw CDR.
//!
//! [`Bridge::spawn`] joins a domain of Tautline with one of ROS and carries messages until it is dropped. [`Options`] selects the
//! topics and services; [`Bridge::stats`] counts what was forwarded, lost and dropped, and why. Bodies are forwarded unchanged
//! between shared memory and the RMW. Types are found at run time, in the sourced ROS 2.
//!
//! `ros-in` takes messages from ROS, `ros-out` publishes there, `ros-services` carries requests and responses, all at
//! `SCHED_FIFO` 80 unless [`Options`] set another priority. The RMW's threads run one below; `ros-control`, `ros-here` and
//! `ros-there`, which follow both graphs, two below. The program is `taut-bridge-ros`; `docs/bridge.md` and
//! `docs/bridge-services.md` describe its use, QoS, late joiners and losses.

mod bridge;
mod config;
mod error;
mod incoming;
mod options;
mod outgoing;
mod qos;
mod rcl;
mod ros;
mod ros_graph;
mod services;
mod shown;
mod stats;
mod table;
mod threads;
mod types;

pub use bridge::Bridge;
pub use config::{Config, ConfigError};
pub use error::BridgeError;
pub use options::Options;
pub use rcl::{RclError, ignore_own_endpoints};
pub use ros_graph::BRIDGE_PREFIX;
pub use stats::{Direction, IncompatibleQos, ServiceNames, ServiceStats, Stats, TopicNames, TopicStats};
pub use tautline_relay::{
    Budget, Filter, Instance, InstanceError, InstanceLock, Latency, Pattern, PatternError, QosOverride,
    Reading, Rule, Rules,
};

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge: topics and services joined with a ROS 2 graph, as raw CDR.
//!
//! [`Bridge::spawn`] joins a domain of Tautline's with one of ROS's and carries messages until it is dropped; [`Options`] says
//! which, and [`Bridge::stats`] what went through and what did not, and why. A message's bytes are passed on as they are: from shared memory
//! into the RMW, and back. Types are found at run time, in the ROS 2 that is sourced.
//!
//! `ros-in` and `ros-out` take messages from ROS and publish them there, `ros-services` carries requests and responses, all at
//! `SCHED_FIFO` 80 unless [`Options`] say otherwise; the RMW's threads are one below, and `ros-control`, `ros-here` and `ros-there`,
//! which follow both graphs, two. The program around it is `taut-bridge-ros`; `docs/bridge.md` and `docs/bridge-services.md` say how
//! it is used, and what it does with QoS, late joiners and losses.

mod bridge;
mod config;
mod incoming;
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

pub use bridge::{Bridge, BridgeError, Options};
pub use config::{Config, ConfigError, Problem};
pub use rcl::RclError;
pub use ros_graph::BRIDGE_PREFIX;
pub use stats::{Direction, IncompatibleQos, ServiceNames, ServiceStats, Stats, TopicNames, TopicStats};
pub use tautline_relay::{
    Budget, Filter, Instance, InstanceError, InstanceLock, Latency, Pattern, PatternError, QosOverride,
    Reading, Rule, Rules,
};

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bridge: topics and services joined with a ROS 2 graph, as raw CDR.

mod bridge;
mod config;
mod control;
mod incoming;
mod mirror;
mod outgoing;
mod pattern;
mod qos;
mod rate;
mod rcl;
mod ros_graph;
mod rules;
mod services;
mod stats;
mod threads;
mod types;

pub use bridge::{Bridge, BridgeError, Options};
pub use config::{Config, ConfigError, Problem};
pub use pattern::{Pattern, PatternError};
pub use rcl::RclError;
pub use ros_graph::BRIDGE_PREFIX;
pub use rules::{Choice, Direction, QosOverride, Rule, Rules};
pub use services::ServiceStats;
pub use stats::{IncompatibleQos, Stats, TopicNumbers, TopicStats};

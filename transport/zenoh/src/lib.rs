// SPDX-License-Identifier: MIT OR Apache-2.0
//! The gateway: topics of a host mirrored over Zenoh, on the rmw_zenoh wire.
//!
//! [`Gateway`] joins a domain and a Zenoh network. It announces the host's nodes and endpoints on the network, and those of other
//! hosts in the domain; samples travel while a topic has endpoints on both sides. [`Options`] sets endpoints, topics and priorities;
//! [`Gateway::stats`] counts what was forwarded, lost and dropped, and why.
//!
//! `gw-out` takes the host's samples and puts them on Zenoh; `gw-wait` and `gw-bulk` put samples that may wait for a link;
//! `gw-services` carries requests and responses; `gw-control` and `gw-watch` follow both graphs. They and Zenoh's own threads run
//! at `SCHED_FIFO` 80 unless [`Options`] set another priority, within the processor [`Budget`]; `gw-claim`, which claims shared memory
//! for what arrives, at `SCHED_OTHER`. No default build uses Zenoh. The program is `taut-gateway`; `docs/deployment.md` describes its
//! use.
#![forbid(unsafe_code)]

mod access;
mod config;
mod descriptions;
mod events;
mod gateway;
mod graph;
mod incoming;
mod kept;
mod locals;
mod options;
mod origin;
mod outgoing;
mod remote;
mod rules;
mod services;
mod session;
mod side;
mod stats;
#[cfg(test)]
mod tests;
mod tokens;
mod types;
mod unclaimed;

pub use access::access_layer;
pub use config::{ConfigError, MAX_MESSAGE_BYTES, Mode, Network, SessionConfig};
pub use gateway::{Gateway, GatewayError};
pub use graph::GraphLimits;
pub use options::Options;
pub use rules::{Rule, RuleError, Urgency};
pub use session::{SessionError, network_threads};
pub use stats::{Direction, ServiceNames, ServiceStats, Stats, TopicNames, TopicStats};
pub use tautline_relay::{
    Budget, Filter, Instance, InstanceError, InstanceLock, Latency, PatternError, Reading,
};
pub use tautline_wire as wire;

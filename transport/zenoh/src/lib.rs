// SPDX-License-Identifier: MIT OR Apache-2.0
//! The gateway: topics of a host mirrored over Zenoh, on the rmw_zenoh wire.

mod access;
mod budget;
mod config;
mod control;
mod descriptions;
mod filter;
mod gateway;
mod graph;
mod incoming;
mod lifespans;
mod locals;
mod mirror;
mod outgoing;
mod remote;
mod rules;
mod seat;
mod services;
mod session;
mod stats;
mod types;

pub use access::access_layer;
pub use budget::Budget;
pub use config::{ConfigError, MAX_MESSAGE_BYTES, Mode, Network, SessionConfig};
pub use filter::{Filter, PatternError};
pub use gateway::{Gateway, GatewayError, Options};
pub use graph::{Change, Graph, GraphLimits, Refused, RemoteEndpoint};
pub use mirror::{Action, InQos, LocalEndpoint, Mirror, OutQos, Writer};
pub use rules::{Rule, RuleError, Urgency};
pub use seat::{Seat, SeatError};
pub use session::{SessionError, network_threads};
pub use stats::{Direction, Latency, Reading, Stats, TopicStats};
pub use tautline_wire as wire;

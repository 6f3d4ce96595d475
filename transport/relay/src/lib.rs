// SPDX-License-Identifier: MIT OR Apache-2.0
//! The common part of the gateway and the ROS 2 bridge: mirrors between a domain and a [`FarSide`].
//!
//! The mirror decides from both graphs what is mirrored, and [`Transit`] which endpoints are announced and carried, so that no
//! message arrives twice or loops; both are pure. [`MirrorControl`] is the thread that executes their decisions. A [`Relay`] is the
//! thread that takes samples of all topics, waiting on the doorbell like a sampler, and passes each to an [`Egress`]; samples are
//! held until their publisher's counterpart exists. Messages from the far side pass an [`Ingress`]. Local publishers are not
//! affected. [`show_until`] is the main loop of such a program.
#![forbid(unsafe_code)]

mod budget;
mod control;
mod ingress;
mod instance;
mod limiter;
mod mirror;
mod pattern;
mod process;
mod program;
mod relay;
mod route;
mod rules;
mod services;
mod stats;
#[cfg(test)]
mod tests;
mod transit;
mod waker;
mod worker;
mod writers;

pub use budget::{Budget, Guard, ThreadLister};
pub use control::{
    Event, FarGraph, FarSide, FoundType, LocalGraph, MirrorControl, Parts, Publisher, Report, watch_domain,
};
pub use ingress::{Body, Delivery, Ingress, IngressUpdate, MessageMeta, Refused};
pub use instance::{Instance, InstanceError, InstanceLock};
pub use limiter::Limiter;
pub use mirror::{InKey, Inward, Side, TopicKey};
pub use pattern::{Filter, Pattern, PatternError};
pub use process::process_node;
pub use program::{
    DomainError, SignalError, counted, domain_of, parse_interval, say, show_until, stderr, stop_on_signals,
};
pub use relay::{Relay, RelayError};
pub use route::{EarlyLimits, Egress, Last, Outbound, OutboundSample};
pub use rules::{Direction, QosOverride, Rule, Rules};
pub use services::{
    Arrived, FarClient, FarServer, FarServices, OfferedService, Pending, Response, ServerId, ServiceStats,
    Services, SoughtService, TakenRequest,
};
pub use stats::{Latency, Latest, Reading, TopicCounters, TopicStats, passing};
pub use transit::Transit;
pub use worker::{Job, Worker, commanded};
pub use writers::{FarWriter, Writers};

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the gateway and the bridge to ROS 2 are: mirrors between a domain and what is on the other side, a [`FarSide`].
//!
//! The mirror decides what is mirrored from what exists on both sides, [`Transit`] what is told and carried, so that nothing comes twice
//! or goes in circles: both are pure. [`Control`] is the thread that does it. A [`Relay`] is the thread that takes the samples of all
//! topics, waiting on the doorbell as a sampler does, and gives each to an [`Egress`]; what a publisher sent before its counterpart
//! elsewhere was known waits for it. What comes from elsewhere goes through an [`Ingress`]. A local publisher notices nothing of it.
//! [`show_until`] is what such a program does meanwhile.

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
    Control, Event, FarGraph, FarSide, FoundType, LocalGraph, Parts, Publisher, Report, watch_domain,
};
pub use ingress::{Body, Delivery, Ingress, IngressUpdate, Source};
pub use instance::{Instance, InstanceError, InstanceLock};
pub use limiter::Limiter;
pub use mirror::{InKey, Inward, Side, TopicKey};
pub use pattern::{Filter, Pattern, PatternError};
pub use process::process_node;
pub use program::{
    DomainError, SignalError, counted, domain_of, parse_interval, show_until, stop_on_signals,
};
pub use relay::{Relay, RelayError};
pub use route::{EarlyLimits, Egress, Last, Outbound, Taken};
pub use rules::{Direction, QosOverride, Rule, Rules};
pub use services::{
    Arrived, FarClient, FarServer, FarServices, OfferedService, Response, ServerId, ServiceStats, Services,
    SoughtService, TakenRequest,
};
pub use stats::{Latency, Reading, TopicCounters, TopicStats, passing};
pub use transit::Transit;
pub use worker::{Job, Worker, commanded};
pub use writers::{FarWriter, Writers};

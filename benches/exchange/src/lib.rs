// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two processes exchange messages: round trips, a stream, or a flow. The part common to all middleware.
//!
//! | module | holds |
//! |---|---|
//! | `job` | a process's job and output |
//! | `near` | the endpoint that sends first: measures round trips, bounds a stream |
//! | `far` | the endpoint that answers: the received messages of a stream |
//! | `flow` | both endpoints of a one-way flow, at a rate or at full speed, to any number of subscriptions |
//! | `payload` | the content of messages |
//! | `log` | times that a callback writes down |
//! | `futex` | the lower bounds for all: memory shared by two processes, and one futex wake per message |
#![allow(missing_docs, reason = "most names are self-explanatory")]

mod far;
mod flow;
mod futex;
mod job;
mod log;
mod near;
mod payload;

pub use far::Arrivals;
pub use flow::{Inlet, Sink, Source, to_the_last};
pub use futex::{FutexPair, FutexRing};
pub use job::{
    APPLICATION_PRIORITY, Exchange, Job, Line, Measured, Memory, NETWORK_PRIORITY, PEERS, Role, Way,
    on_network_thread, on_stop, program, say, stop_flag, until_told, wait_for_stop,
};
pub use log::Log;
pub use near::{LATE, Link, PATIENCE, RoundTrips, Window, drive, play};
pub use payload::Stamp;

/// An error for people only.
pub type Error = Box<dyn std::error::Error + Send + Sync>;
/// With an [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two processes exchange messages: round trips, a stream, or a flow. What both ends of any middleware have in common.
//!
//! | module | holds |
//! |---|---|
//! | `job` | what a process is told, and what it says |
//! | `near` | the end that sends first: the clock of round trips, the window of a stream |
//! | `far` | the end that answers: what arrived of a stream |
//! | `flow` | both ends of what is sent one way, at a rate or as fast as it goes, to any number of subscriptions |
//! | `payload` | what a message contains |
//! | `futex` | the floors below all of them: memory that two processes share, and a futex wake for each message |
#![allow(missing_docs, reason = "many names say it all")]

mod far;
mod flow;
mod futex;
mod job;
mod near;
mod payload;

pub use far::Arrivals;
pub use flow::{Inlet, Sink, Source, to_the_last};
pub use futex::{FutexPair, FutexRing};
pub use job::{
    APPLICATION_PRIORITY, Exchange, Job, Line, Measured, Memory, NETWORK_PRIORITY, PEERS, Role, Way,
    on_network_thread, on_stop, program, say, stop_flag, wait_for_stop,
};
pub use near::{LATE, Link, PATIENCE, RoundTrips, Window, drive, play};
pub use payload::Stamp;

/// What nobody handles but the person who reads it.
pub type Error = Box<dyn std::error::Error + Send + Sync>;
/// With an [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

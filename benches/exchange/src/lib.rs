// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two processes exchange messages: round trips, or a stream. What both ends of any middleware have in common.
//!
//! | module | holds |
//! |---|---|
//! | `job` | what a process is told, and what it says |
//! | `near` | the end that sends first: the clock of round trips, the window of a stream |
//! | `far` | the end that answers: what arrived of a stream |

mod far;
mod job;
mod near;

pub use far::{Answer, Arrivals};
pub use job::{
    APPLICATION_PRIORITY, Exchange, Job, Line, Measured, NETWORK_PRIORITY, Role, on_network_thread, say,
    stop_flag,
};
pub use near::{Link, PATIENCE, RoundTrips, Window, drive};

/// What nobody handles but the person who reads it.
pub type Error = Box<dyn std::error::Error + Send + Sync>;
/// With an [`Error`].
pub type Result<T> = std::result::Result<T, Error>;

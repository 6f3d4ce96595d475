// SPDX-License-Identifier: MIT OR Apache-2.0
//! The application of 'A first look at ROS 2 applications written in asynchronous Rust' (ECRTS 2025), section 5, and the
//! ways to execute its callbacks, for any middleware.
//!
//! A publisher process releases messages at absolute times; a subscriber process, on the same core, runs a callback of
//! fixed execution time for each. What the two middlewares measured have in common is here: what a process is told
//! ([`Job`]) and tells ([`Line`]), the callbacks with their logs, and the [`structures`], which see a middleware only
//! as a [`Sampler`]. A middleware adds a node with subscriptions, and its publisher.
#![forbid(unsafe_code)]
#![allow(missing_docs, reason = "many names say it all")]

mod callback;
mod job;
mod line;
mod subscriber;
mod variant;

pub mod structures;

pub use callback::{Callback, callback};
pub use job::{Job, Role, Topic};
pub use line::{Line, Measured, Published, TopicMeasured};
pub use structures::Sampler;
pub use subscriber::{Subscriber, set_up_publisher};
pub use tautline_exchange::say;
pub use variant::{Scheduling, Structure, Variant};

/// `SCHED_FIFO` priorities of the paper, other than the callbacks'.
pub mod priorities {
    /// The publisher's main thread and middleware.
    pub const PUBLISHER: u8 = 25;
    /// The publisher's worker, which publishes.
    pub const PUBLISHER_WORKER: u8 = 24;
    /// The subscriber's sampler and middleware: above its callbacks, which have 20 to 16.
    pub const SAMPLER: u8 = 21;
    /// Sampler and middleware in the ablation that puts them below the callbacks.
    pub const SAMPLER_BELOW: u8 = 15;
    /// Threads that run callbacks of any topic, below the sampler.
    pub const WORKER: u8 = 20;
}

impl PaperError {
    fn start(what: &'static str) -> impl FnOnce(std::io::Error) -> PaperError {
        move |source| PaperError::Start { what, source }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum PaperError {
    /// The system refuses a real-time setting; the message names the fix.
    #[error(transparent)]
    Realtime(#[from] tautline_rt::RtError),
    #[error("cannot start {what}: {source}")]
    Start { what: &'static str, source: std::io::Error },
    #[error("the sampler's thread has panicked")]
    Panicked,
    #[error("there is no variant '{name}'; there are: {known}")]
    UnknownVariant { name: String, known: String },
}

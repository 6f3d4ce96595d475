// SPDX-License-Identifier: MIT OR Apache-2.0
//! The Autoware reference system of the ROS real-time working group (`ros-realtime/reference-system`), for any middleware:
//! 24 nodes in one process, which do artificial work, and what is measured of them.
//!
//! The nodes are a table, [`graph::CALLBACKS`]. What a node does with its messages is here ([`run`]); a middleware adds its
//! [`Input`], its [`Output`] and its timers, and decides which thread runs what. What comes of a run are its [`Kpis`].
//!
//! As in the original every queue keeps one message ([`DEPTH`]), every node enters itself into the message that it
//! passes on, and nodes that neither begin nor end a path count primes before they publish ([`number_cruncher`]).
#![forbid(unsafe_code)]
#![allow(missing_docs, reason = "many names say it all")]

mod conduct;
mod cruncher;
mod kpis;
mod message;
mod node;
mod records;

pub mod graph;

pub use conduct::{Job, Placement, Usage, conduct, window};
pub use cruncher::{CRUNCHER_LIMIT, Load, number_cruncher};
pub use kpis::{CallbackKpis, Kpis};
pub use message::{Message4kb, STATS_CAPACITY, TransmissionStats};
pub use node::{Input, Output, run};
pub use records::{Records, Window};

pub const DEPTH: usize = 1;

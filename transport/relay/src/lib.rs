// SPDX-License-Identifier: MIT OR Apache-2.0
//! What programs have in common that pass on the samples of topics, such as the gateway and the bridge to ROS 2.
//!
//! A [`Relay`] is the thread that takes the samples of all topics, waiting on the doorbell as a sampler does, and gives each to
//! an [`Outlet`]. What a publisher sent before its counterpart elsewhere was known waits for it. A local publisher notices
//! nothing of it. [`show_until`] is what such a program does meanwhile.

mod budget;
mod pattern;
mod process;
mod program;
mod relay;
mod route;
mod seat;
mod stats;
mod transit;
mod waker;

pub use budget::{Budget, Guard, WatchedThreads};
pub use pattern::{Filter, Pattern, PatternError};
pub use process::process_node;
pub use program::{counted, parse_interval, show_until, stop_on_signals};
pub use relay::{PassedOver, Relay, RelayError};
pub use route::{EarlyLimits, Last, Outlet, Taken};
pub use seat::{Office, Seat, SeatError};
pub use stats::{Book, Counters, Latency, Numbers, Reading, TopicStats, passing};
pub use transit::{RELAYED_DEPTH, Transit};

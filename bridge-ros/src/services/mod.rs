// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of both sides, and with them actions and parameters, which consist of services and topics.
//!
//! - *Of Tautline's servers* each has a server in ROS, whether or not anybody asks: clients there look for it before
//!   they ask. A request goes on as one of a client here.
//! - *Of ROS's servers* each that a client here waits for has a server here. It appears once requests reach the one in
//!   ROS, and goes with it: what it was asked then ends with an error.
//!
//! One thread does both, and is woken by both: rcl wakes it for requests and responses in ROS; for those here a guard
//! condition of rcl's does. It decides nothing: [`Routes`] says which services go which way.

mod exchange;
mod offered;
mod pending;
mod routes;
mod sought;
mod stats;
mod types;

pub(crate) use exchange::{Services, ServicesError};
pub(crate) use routes::Routes;
pub use stats::ServiceStats;

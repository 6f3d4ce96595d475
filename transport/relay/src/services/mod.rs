// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of both sides, and with them actions and parameters, which consist of services and topics.
//!
//! - *Of the domain's servers* each has one on the far side, whether or not anybody asks: clients there look for it before they ask. A
//!   request goes on as one of a client here.
//! - *Of the far side's servers* each that a client here waits for has one here, while requests reach the one there: with it what it was
//!   asked ends with an error.
//!
//! One thread does both, and is woken by both. It decides nothing: [`Routes`] says which services go which way. What is particular to the
//! far side is a [`FarServices`].

mod exchange;
mod offered;
mod routes;
mod sought;
mod stats;

pub use exchange::{Arrived, FarServices, Services};
pub use offered::{FarServer, TakenRequest};
pub use routes::{OfferedService, Routes, ServerId, SoughtService};
pub use sought::{FarClient, Response};
pub use stats::ServiceStats;

use tautline_transport::{Claim, Limits};

/// Of an end here: most services are asked seldom, and how long requests and responses are is not known before they come.
fn limits() -> Limits {
    Limits { claim: Claim::OnUse, ..Limits::default() }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of both sides, and thereby actions and parameters, which consist of services and topics.
//!
//! - *Each of the domain's servers* has a server on the far side, even without clients, because clients there wait for a server
//!   before they send requests. A client here forwards the requests.
//! - *Each of the far side's servers* that a client here (in the domain) needs has a server here while the far one is available. When
//!   the far server ends, pending requests end with an error.
//!
//! One thread carries both, and is woken by both sides. [`Routes`] decides which services are carried; [`FarServices`] is the far
//! side's part.

mod exchange;
mod limits;
mod offered;
mod pending;
mod routes;
mod sought;
mod stats;

pub use exchange::{Arrived, FarServices, Services};
pub use offered::{FarServer, TakenRequest};
pub use pending::Pending;
pub use routes::{OfferedService, Routes, ServerId, SoughtService};
pub use sought::{FarClient, Response};
pub use stats::ServiceStats;

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services: a request goes to every server, and the first response comes back to the requesting client.
//!
//! A service consists of two topics: one for requests, which all its clients publish and all its servers subscribe to, and one for
//! responses, the other way round. A server's publisher sends each response to the subscription of one client, so a response wakes
//! only the requesting client. A request carries its client's identifier and its number in its header, like every sample; the
//! response repeats both, as on the ROS 2 wire. Queues keep all: a full queue is an error, and nothing is lost.
//!
//! A client creates its subscription to responses before its publisher of requests, and counts a server only when both of the
//! server's endpoints are connected. So every server that gets a request can respond. A request whose servers have all ended
//! fails with [`ServiceError::ServerGone`](error::ServiceError::ServerGone).
//!
//! In: requests and responses, as bytes or typed ([`typed`]). Out: each response once, to the task that waits for it ([`pending`]).
//! Who may touch it: one thread at a time uses a client or a server. This module uses topics, and no other module uses it.

pub(crate) mod client;
pub(crate) mod error;
pub(crate) mod hot;
pub(crate) mod pending;
pub(crate) mod queued;
pub(crate) mod server;
pub(crate) mod service_type;
pub(crate) mod typed;

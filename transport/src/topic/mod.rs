// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics: publishers and subscriptions, and how they find each other.
//!
//! In: messages as bytes ([`publisher`]) or typed ([`typed`]). Out: samples, read in place ([`subscription`]). Setup code ([`matching`])
//! creates and removes connections, by the records in the graph; each side has a half for setup and a half for its thread ([`writer`],
//! [`reader`]), which are handed over ([`hand_over`]). The [`participant`] owns all of it.
//! Locks: one thread at a time publishes or takes, without a lock; setup code holds the participant's lock.

pub(crate) mod chunks;
pub(crate) mod compatibility;
pub(crate) mod declaration;
pub(crate) mod endpoints;
pub(crate) mod hand_over;
pub(crate) mod matching;
pub(crate) mod participant;
pub(crate) mod publisher;
pub(crate) mod reader;
pub(crate) mod subscription;
pub(crate) mod typed;
pub(crate) mod writer;

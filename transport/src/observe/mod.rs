// SPDX-License-Identifier: MIT OR Apache-2.0
//! Observe: reads a domain, a publisher or a subscription without taking part.
//!
//! In: a domain's number ([`visitor`], [`recorder`]), a participant ([`graph`]), a publisher or a subscription ([`monitor`], [`traced`]).
//! Out: the graph and its changes, counts, deaths, QoS events, trace events of mirrors.
//! Who may touch it: users and tools. It reads state that the modules below maintain; they do not depend on it, and nothing waits for it.

pub(crate) mod graph;
pub(crate) mod monitor;
pub(crate) mod recorder;
pub(crate) mod traced;
pub(crate) mod visitor;

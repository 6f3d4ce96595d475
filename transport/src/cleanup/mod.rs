// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cleanup: handles processes that join, leave and die, in threads of low priority, for which no real-time thread waits.
//!
//! In: the kernel's report that a file was closed, and calls by other participants. Out: files of dead participants removed, calls to
//! the janitors of the living. Each participant's [`janitor`] sleeps until it is called, and then does what is necessary for its
//! ports. One participant's [`warden`] watches all others, and cleans up ([`dead_participant`]); the others' wardens watch this one.
//! Who may touch it: the participant starts and stops both; anybody may call a janitor, through the domain.

pub(crate) mod dead_domains;
mod dead_participant;
pub(crate) mod janitor;
pub(crate) mod warden;

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Memory: a participant's file in /dev/shm, and the layout of everything that lies in it.
//!
//! In: lengths and counts from the modules above. Out: parts of files, mapped: a publisher's samples ([`pool`]), its queues to each
//! subscription ([`connection`]), where both lie ([`control`]), and the same parts of other participants ([`file`](mod@file)).
//! Who may touch it: setup code reserves, claims and maps; threads that publish and take use what is mapped. A file has one owner, who
//! alone changes its layout; what another process wrote is checked here. This module knows no names, no topics and no threads.

pub(crate) mod connection;
pub(crate) mod control;
pub(crate) mod file;
pub(crate) mod free_list;
pub(crate) mod header;
pub(crate) mod pool;
pub(crate) mod ranges;
pub(crate) mod references;
pub(crate) mod sizes;

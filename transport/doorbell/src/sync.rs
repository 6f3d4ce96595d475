// SPDX-License-Identifier: MIT OR Apache-2.0
//! Atomics, or loom's models of them (`--cfg taut_loom`).

#[cfg(not(taut_loom))]
pub(crate) use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, AtomicU64, Ordering, fence};

#[cfg(taut_loom)]
pub(crate) use loom::sync::atomic::{AtomicBool, AtomicPtr, AtomicU32, AtomicU64, Ordering, fence};

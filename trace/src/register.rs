// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a thread gets its ring before it becomes real-time.

use crate::process;
use crate::thread::{self, EventSink};

/// Claims a ring for the current thread under its name, and touches all of it: after that its events cost no syscall. A
/// thread that creates a publisher or a subscription, and a callback's thread, do this automatically; any other thread
/// does it with its first event, if a ring is free.
///
/// # Real-time
/// Setup: some syscalls and page faults. Once the thread has a ring: wait-free, no syscall.
pub fn register_thread() {
    register_thread_as("");
}

/// Like [`register_thread`], with a name of at most 15 bytes.
///
/// # Real-time
/// As [`register_thread`].
pub fn register_thread_as(name: &str) {
    if !matches!(thread::cached(), Some(EventSink::Ring(_))) {
        process::with_spare_ring(|| _ = thread::place());
    }
    if let EventSink::Ring(ring) = thread::place()
        && !name.is_empty()
    {
        thread::set_name(ring, name.as_bytes());
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Atomics, or loom's models of them (`--cfg taut_loom`).

#[cfg(not(taut_loom))]
pub(crate) use core::sync::atomic::{AtomicI64, AtomicU64, AtomicUsize, Ordering, fence};
#[cfg(not(taut_loom))]
pub(crate) use futures::task::AtomicWaker;

#[cfg(taut_loom)]
pub(crate) use loom::sync::atomic::{AtomicI64, AtomicU64, AtomicUsize, Ordering, fence};

/// As `futures`': the next call wakes the task that registered last.
#[cfg(taut_loom)]
pub(crate) struct AtomicWaker(loom::sync::Mutex<Option<std::task::Waker>>);

#[cfg(taut_loom)]
impl AtomicWaker {
    pub(crate) fn new() -> AtomicWaker {
        AtomicWaker(loom::sync::Mutex::new(None))
    }

    pub(crate) fn register(&self, waker: &std::task::Waker) {
        *self.0.lock().unwrap() = Some(waker.clone());
    }

    pub(crate) fn take(&self) -> Option<std::task::Waker> {
        self.0.lock().unwrap().take()
    }

    pub(crate) fn wake(&self) {
        if let Some(waker) = self.take() {
            waker.wake();
        }
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What wait sets sleep on, and the flags that wake them.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::Wake;
use tautline_rt::FutexWord;
use tautline_transport::{ThreadBell, Wakeable};

/// A flag that wakes wait sets.
pub(crate) type Signal = tautline_transport::Signal<Waiter>;

/// One thread at a time sleeps on this.
pub(crate) enum Waiter {
    /// Rung by publishers directly.
    Bell(Arc<ThreadBell>),
    /// Woken by the helper, when a context's bells are all in use; counts wakes.
    Word(FutexWord),
}

impl Wakeable for Waiter {
    fn wake(&self) {
        match self {
            Waiter::Bell(bell) => bell.wake(),
            Waiter::Word(word) => {
                word.0.fetch_add(1, Ordering::Release);
                word.wake();
            }
        }
    }
}

impl Waiter {
    /// The bell that publishers ring; `None` if the helper wakes the waiter.
    pub(crate) fn bell(&self) -> Option<&Arc<ThreadBell>> {
        match self {
            Waiter::Bell(bell) => Some(bell),
            Waiter::Word(_) => None,
        }
    }

    /// Read this before the check that precedes the sleep.
    pub(crate) fn count(&self) -> u32 {
        match self {
            Waiter::Bell(_) => 0,
            Waiter::Word(word) => word.0.load(Ordering::Acquire),
        }
    }

    /// Sleeps until woken since `count` was read, or until the `CLOCK_MONOTONIC` time `deadline_ns`. May return early.
    ///
    /// # Real-time
    /// One syscall, none if already woken; no allocation; no lock.
    pub(crate) fn sleep(&self, count: u32, deadline_ns: Option<u64>) {
        match self {
            Waiter::Bell(bell) => {
                bell.wait_until(deadline_ns);
            }
            Waiter::Word(word) => word.wait(count, deadline_ns),
        }
    }
}

impl Wake for Waiter {
    fn wake(self: Arc<Self>) {
        Wakeable::wake(&*self);
    }

    fn wake_by_ref(self: &Arc<Self>) {
        Wakeable::wake(&**self);
    }
}

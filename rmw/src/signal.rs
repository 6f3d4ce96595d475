// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a wait set sleeps on, and flags that wake it.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::Wake;
use tautline_rt::FutexWord;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{ThreadBell, Wakeable};

/// A flag that wakes wait sets.
pub(crate) type Signal = tautline_transport::Signal<Waiter>;

/// What one thread at a time sleeps on.
pub(crate) enum Waiter {
    /// Which publishers ring themselves.
    Bell(Arc<ThreadBell>),
    /// Which the helper wakes, when a context's bells are all taken: it counts wakes.
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
    /// To be asked before the look after which it sleeps.
    pub(crate) fn count(&self) -> u32 {
        match self {
            Waiter::Bell(_) => 0,
            Waiter::Word(word) => word.0.load(Ordering::Acquire),
        }
    }

    /// Sleeps until it was woken since `count` was asked for, or until the `CLOCK_MONOTONIC` time `deadline_ns`. May return early.
    ///
    /// # Real-time
    /// One syscall, none if it was woken; no allocation; no lock.
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

/// The `CLOCK_MONOTONIC` time after which a wait of this length is over.
pub(crate) fn deadline_ns(sec: u64, nsec: u64) -> u64 {
    monotonic_ns().saturating_add(sec.saturating_mul(1_000_000_000).saturating_add(nsec))
}

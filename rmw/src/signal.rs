// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a wait set sleeps on, and flags that wake it.
//!
//! ```text
//!  who triggers                              rmw_wait
//!  1 flag = true                             1 waiters[i] = mine
//!  2 fence                                   2 fence
//!  3 wakes each of waiters                   3 no flag? sleep until woken
//! ```
//!
//! Either who triggers sees the waiter, or that one sees the flag. Triggering takes no lock and allocates nothing: ROS does it in signal
//! handlers.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicPtr, Ordering, fence};
use std::task::Wake;
use tautline_rt::FutexWord;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::ThreadBell;

/// What one thread at a time sleeps on.
pub(crate) enum Waiter {
    /// Which publishers ring themselves.
    Bell(Arc<ThreadBell>),
    /// Which the helper wakes, when a context's bells are all taken: it counts wakes.
    Word(FutexWord),
}

impl Waiter {
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake.
    pub(crate) fn wake(&self) {
        match self {
            Waiter::Bell(bell) => bell.wake(),
            Waiter::Word(word) => {
                word.0.fetch_add(1, Ordering::Release);
                word.wake();
            }
        }
    }

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
        Waiter::wake(&self);
    }

    fn wake_by_ref(self: &Arc<Self>) {
        Waiter::wake(self);
    }
}

/// Wait sets that can wait for one flag at once.
const PLACES: usize = 8;

/// A flag that wakes wait sets.
#[derive(Default)]
pub(crate) struct Signal {
    is_set: AtomicBool,
    waiters: [AtomicPtr<Waiter>; PLACES],
}

impl Signal {
    /// Sets the flag. May be called in a signal handler.
    ///
    /// # Real-time
    /// Wait-free; no allocation; a futex wake for each wait set that sleeps for it.
    pub(crate) fn set(&self) {
        self.is_set.store(true, Ordering::Release);
        fence(Ordering::SeqCst);
        for place in &self.waiters {
            let waiter = place.load(Ordering::Acquire);
            // SAFETY: null, or what `attach` was given, which lives as long as the context that both are of.
            if let Some(waiter) = unsafe { waiter.as_ref() } {
                waiter.wake();
            }
        }
    }

    /// # Real-time
    /// Wait-free: one load.
    pub(crate) fn is_set(&self) -> bool {
        self.is_set.load(Ordering::Acquire)
    }

    /// Takes the flag back, and says whether it was set.
    ///
    /// # Real-time
    /// Wait-free.
    pub(crate) fn take(&self) -> bool {
        self.is_set.swap(false, Ordering::AcqRel)
    }

    /// Has `waiter` woken from now on; the caller looks at the flag after this. False if all places are taken.
    ///
    /// # Safety
    /// `waiter` lives until it is detached, and as long after that as a call of [`set`](Self::set) may take: it is its context's.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) unsafe fn attach(&self, waiter: &Waiter) -> bool {
        let waiter = std::ptr::from_ref(waiter).cast_mut();
        let free = std::ptr::null_mut();
        let is_taken = self
            .waiters
            .iter()
            .any(|place| place.compare_exchange(free, waiter, Ordering::AcqRel, Ordering::Relaxed).is_ok());
        fence(Ordering::SeqCst);
        is_taken
    }

    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn detach(&self, waiter: &Waiter) {
        let waiter = std::ptr::from_ref(waiter).cast_mut();
        for place in &self.waiters {
            let free = std::ptr::null_mut();
            if place.compare_exchange(waiter, free, Ordering::AcqRel, Ordering::Relaxed).is_ok() {
                return;
            }
        }
    }
}

/// The `CLOCK_MONOTONIC` time after which a wait of this length is over.
pub(crate) fn deadline_ns(sec: u64, nsec: u64) -> u64 {
    monotonic_ns().saturating_add(sec.saturating_mul(1_000_000_000).saturating_add(nsec))
}

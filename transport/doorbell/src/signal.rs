// SPDX-License-Identifier: MIT OR Apache-2.0
//! A flag of this process that wakes its waiters. Several waiters may be attached and detached.
//!
//! ```text
//!  setter                                    waiter
//!  1 flag = true                             1 waiters[i] = mine
//!  2 fence                                   2 fence
//!  3 wake each of waiters                    3 no flag? sleep until woken
//! ```
//!
//! Either the thread that sets the flag sees the waiter, or the waiter sees the flag. Setting takes no lock and allocates nothing, so it
//! may be done in a signal handler.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::sync::{AtomicBool, AtomicPtr, Ordering, fence};
use core::ptr::null_mut;

/// A waiter that can be woken from any thread. If it is not asleep, it will check again before it falls
/// asleep.
pub trait Wakeable {
    /// Wakes it.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake.
    fn wake(&self);
}

/// Waiters that one flag can have at once. Fewer in the model, which looks at every interleaving.
const PLACES: usize = if cfg!(taut_loom) { 1 } else { 8 };

/// A flag that wakes waiters.
pub struct Signal<W> {
    is_set: AtomicBool,
    waiters: [AtomicPtr<W>; PLACES],
}

impl<W> Default for Signal<W> {
    fn default() -> Self {
        let waiters = core::array::from_fn(|_| AtomicPtr::new(null_mut()));
        Signal { is_set: AtomicBool::new(false), waiters }
    }
}

impl<W: Wakeable> Signal<W> {
    /// Sets the flag, and wakes its waiters. May be called in a signal handler.
    ///
    /// # Real-time
    /// Wait-free; no allocation; a futex wake for each waiter that sleeps.
    pub fn set(&self) {
        // An exchange, as on the other side: loom's model knows which of two exchanges was first, but not which of two stores.
        self.is_set.swap(true, Ordering::AcqRel);
        fence(Ordering::SeqCst);
        for place in &self.waiters {
            // SAFETY: null, or what `attach` was given, which lives long enough.
            if let Some(waiter) = unsafe { place.load(Ordering::Acquire).as_ref() } {
                waiter.wake();
            }
        }
    }

    /// Whether the flag is set.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn is_set(&self) -> bool {
        self.is_set.load(Ordering::Acquire)
    }

    /// Clears the flag, and returns whether it was set.
    ///
    /// # Real-time
    /// Wait-free.
    pub fn take(&self) -> bool {
        self.is_set.swap(false, Ordering::AcqRel)
    }

    /// Wakes `waiter` from now on, until it is [detached](Self::detach). Check the flag after this call. Returns false if the flag
    /// already has its maximum number of waiters.
    ///
    /// # Safety
    /// `waiter` lives until it is detached, and after that as long as a call of [`set`](Self::set) may last.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub unsafe fn attach(&self, waiter: &W) -> bool {
        let is_attached = self.change(null_mut(), core::ptr::from_ref(waiter).cast_mut());
        fence(Ordering::SeqCst);
        is_attached
    }

    /// Detaches `waiter`, once, if it is attached.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn detach(&self, waiter: &W) {
        self.change(core::ptr::from_ref(waiter).cast_mut(), null_mut());
    }

    /// Puts `to` into the first place that has `from`, if there is one.
    fn change(&self, from: *mut W, to: *mut W) -> bool {
        self.waiters
            .iter()
            .any(|place| place.compare_exchange(from, to, Ordering::AcqRel, Ordering::Relaxed).is_ok())
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bell of one callback thread: publishers wake that thread directly, without a sampler in between.
//!
//! Each subscription that is polled by this thread has a bit of the bell; its slot's route points to this
//! bit. The thread sleeps only on this bell, so everything else that wakes its tasks rings the bell's last
//! bit.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::arena::{Sleeper, THREADS};
use crate::hot::{Bell, BellBit};
use crate::{Doorbell, DoorbellError, Slot};
use core::time::Duration;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_rt::full_fence;

/// The bit of wakes that come from no publisher.
const OTHERS: usize = 63;
/// Stands in the place of a slot for a bit that is not in use.
const FREE: usize = usize::MAX;

/// A bell on which one thread sleeps.
pub struct ThreadBell {
    doorbell: Arc<Doorbell>,
    thread: usize,
    /// The slots of the bits.
    slots: [AtomicUsize; OTHERS],
}

impl ThreadBell {
    /// Claims a bell of `doorbell`'s arena. It is free again when the last reference is dropped.
    ///
    /// # Errors
    /// [`DoorbellError::ThreadBells`] if all are taken.
    #[allow(clippy::disallowed_methods, reason = "set-up")]
    pub(crate) fn claim(doorbell: &Arc<Doorbell>) -> Result<Arc<Self>, DoorbellError> {
        let thread = doorbell.threads().take().ok_or(DoorbellError::ThreadBells { limit: THREADS })?;
        let bell = ThreadBell {
            doorbell: doorbell.clone(),
            thread,
            slots: std::array::from_fn(|_| AtomicUsize::new(FREE)),
        };
        // Discards what was rung for the bell's former owner.
        if let Some(bell) = bell.bell() {
            bell.drain(|_| {});
        }
        Ok(Arc::new(bell))
    }

    fn bell(&self) -> Option<&Bell<1>> {
        self.doorbell.arena().thread_bell(self.thread)
    }

    /// Wakes the thread if it sleeps. If it does not, it will check again before it falls asleep.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake.
    pub fn wake(&self) {
        if let Some(bell) = self.bell() {
            bell.mark(OTHERS);
            full_fence();
            self.doorbell.arena().wake(Sleeper::Thread(self.thread));
        }
    }

    /// Polls for the time `spin` whether something has rung since the last return, then sleeps until something rings. Wakes the
    /// tasks that were rung for. Only for the thread that owns this bell.
    ///
    /// # Real-time
    /// O(subscriptions that were rung for), at most 63; no allocation; no lock; one syscall to sleep, none if something becomes
    /// pending before `spin` is over.
    pub fn wait(&self, spin: Duration) {
        let Some(bell) = self.bell() else { return };
        while !self.take(bell) {
            if !is_rung_within(bell, spin) {
                bell.sleep(None);
            }
        }
    }

    /// Like [`wait`](Self::wait), but at most until the `CLOCK_MONOTONIC` time `deadline_ns`. Returns whether
    /// something rang.
    ///
    /// # Real-time
    /// As [`wait`](Self::wait).
    pub fn wait_until(&self, deadline_ns: Option<u64>) -> bool {
        let Some(bell) = self.bell() else { return false };
        while !self.take(bell) {
            if deadline_ns.is_some_and(|deadline_ns| monotonic_ns() >= deadline_ns) {
                return false;
            }
            bell.sleep(deadline_ns);
        }
        true
    }

    /// Wakes the tasks that were rung for. Returns whether something rang.
    fn take(&self, bell: &Bell<1>) -> bool {
        let wake = |bit: usize| match self.slots.get(bit).map(|slot| slot.load(Ordering::Relaxed)) {
            None | Some(FREE) => {}
            Some(slot) => self.doorbell.wake(slot),
        };
        if bell.drain(wake) == 0 {
            return false;
        }
        // The tasks just woken have rung this bit, too; they will be polled, and so will tasks that ring from here on.
        bell.take(OTHERS);
        true
    }

    /// Routes the rings for `slot` to this bell. `None`: all bits are in use, or the slot belongs to another arena, whose publishers do not
    /// know this bell.
    pub fn route(self: &Arc<Self>, slot: &Slot) -> Option<BellRoute> {
        if !Arc::ptr_eq(&self.doorbell, slot.doorbell()) {
            return None;
        }
        let slot = slot.index();
        let is_claimed = |place: &AtomicUsize| {
            place.compare_exchange(FREE, slot, Ordering::Relaxed, Ordering::Relaxed).is_ok()
        };
        let bit = self.slots.iter().position(is_claimed)?;
        self.doorbell.arena().set_route(slot, Some(BellBit { thread: self.thread, bit }));
        Some(BellRoute { bell: self.clone(), bit, slot })
    }
}

/// Polls the bell for at most `spin`. Returns whether something rang.
fn is_rung_within(bell: &Bell<1>, spin: Duration) -> bool {
    if spin.is_zero() {
        return false;
    }
    let give_up_ns = monotonic_ns().saturating_add(nanoseconds(spin));
    while !bell.is_pending() {
        if monotonic_ns() >= give_up_ns {
            return false;
        }
        core::hint::spin_loop();
    }
    true
}

impl Drop for ThreadBell {
    #[allow(clippy::disallowed_methods, reason = "the thread's end")]
    fn drop(&mut self) {
        self.doorbell.threads().give_back(self.thread);
    }
}

/// Routes the rings of a slot to a thread's bell; dropping it routes them to the sampler again.
#[must_use = "dropping it routes the rings to the sampler again"]
pub struct BellRoute {
    bell: Arc<ThreadBell>,
    bit: usize,
    slot: usize,
}

impl Drop for BellRoute {
    fn drop(&mut self) {
        self.bell.doorbell.arena().set_route(self.slot, None);
        if let Some(place) = self.bell.slots.get(self.bit) {
            place.store(FREE, Ordering::Relaxed);
        }
    }
}

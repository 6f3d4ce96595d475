// SPDX-License-Identifier: MIT OR Apache-2.0
//! The bell: a bitmap of pending slots and an eventcount, in shared memory.
//!
//! ```text
//!  ringer (any process)                       sampler (the one sleeper)
//!  1 pending[slot] |= bit                     1 state |= SLEEPING
//!  2 fence                                    2 fence
//!  3 state has SLEEPING? count it, wake       3 nothing pending? sleep while state is what step 1 left
//!                                             4 state &= !SLEEPING, take the bits
//! ```
//!
//! The fences order each side's store before its load: either the ringer sees SLEEPING and wakes, or the sampler sees
//! the bit and does not sleep. Counting in step 3 changes the state, so that a sampler between its steps 2 and 3 does
//! not fall asleep. Only the sampler takes SLEEPING away: a ringer never relies on another one, who may have been
//! preempted, or killed, anywhere before its wake.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use super::SLOTS;
use crate::sync::{AtomicU64, FutexWord, Ordering, fence};

const WORDS: usize = SLOTS / 64;
/// The state's lowest bit; above it, the rings that found it set are counted (wrapping).
const SLEEPING: u32 = 1;
const ONE_RING: u32 = 2;

/// One bell per sampler. All-zero memory is a bell with nothing pending and nobody asleep.
#[repr(C, align(64))]
pub(crate) struct Bell {
    state: FutexWord,
    pending: Pending,
}

#[repr(C, align(64))]
struct Pending([AtomicU64; WORDS]);

impl Bell {
    /// Marks `slot` pending and wakes the sampler if it sleeps.
    ///
    /// # Real-time
    /// Wait-free; no allocation; one futex wake if the sampler sleeps, else no syscall.
    pub(crate) fn ring(&self, slot: usize) {
        // An index out of range can come from another process's memory: it rings nothing.
        let Some(word) = self.pending.0.get(slot / 64) else { return };
        // Release: pairs with the Acquire in `drain`; what was written before the ring is seen after the drain.
        word.fetch_or(1 << (slot % 64), Ordering::Release);
        fence(Ordering::SeqCst);
        self.wake_if_sleeping();
    }

    fn wake_if_sleeping(&self) {
        if self.state.0.load(Ordering::Relaxed) & SLEEPING != 0 {
            self.wake();
        }
    }

    fn wake(&self) {
        self.state.0.fetch_add(ONE_RING, Ordering::AcqRel);
        self.state.wake();
    }

    /// Takes every pending slot and hands it to `each`, lowest first; returns how many there were.
    ///
    /// # Real-time
    /// Wait-free, O(pending + 16); no allocation; no syscall.
    pub(crate) fn drain(&self, mut each: impl FnMut(usize)) -> usize {
        let mut count = 0;
        for (index, word) in self.pending.0.iter().enumerate() {
            if word.load(Ordering::Relaxed) == 0 {
                continue;
            }
            // Acquire: pairs with the Release in `ring`.
            let mut bits = word.swap(0, Ordering::Acquire);
            while bits != 0 {
                each(index * 64 + bits.trailing_zeros() as usize);
                bits &= bits - 1;
                count += 1;
            }
        }
        count
    }

    /// Whether a slot is pending.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn is_pending(&self) -> bool {
        self.pending.0.iter().any(|word| word.load(Ordering::Relaxed) != 0)
    }

    /// Sleeps until a slot is pending or the absolute `CLOCK_MONOTONIC` time `deadline_ns`. Only the sampler calls this.
    /// May return early.
    ///
    /// # Real-time
    /// At most one syscall; no allocation.
    pub(crate) fn sleep(&self, deadline_ns: Option<u64>) {
        let asleep = self.state.0.fetch_or(SLEEPING, Ordering::AcqRel) | SLEEPING;
        fence(Ordering::SeqCst);
        if !self.is_pending() {
            self.state.wait(asleep, deadline_ns);
        }
        self.state.0.fetch_and(!SLEEPING, Ordering::AcqRel);
    }

    /// Finishes the ring of a process that was killed between setting the bit and waking. Waking who is awake is
    /// harmless.
    ///
    /// # Real-time
    /// For a low-priority thread, now and then. Wait-free; at most one futex wake.
    pub(crate) fn rescue(&self) {
        if self.is_pending() {
            self.wake();
        }
    }
}

#[cfg(taut_loom)]
#[allow(clippy::indexing_slicing)]
impl Bell {
    pub(crate) fn new() -> Self {
        Bell { state: FutexWord::new(0), pending: Pending(core::array::from_fn(|_| AtomicU64::new(0))) }
    }

    /// The first step of `ring` alone, or all but the wake: a ringer that was killed there.
    pub(crate) fn ring_and_die(&self, slot: usize, before_wake: bool) {
        self.pending.0[slot / 64].fetch_or(1 << (slot % 64), Ordering::Release);
        if before_wake {
            fence(Ordering::SeqCst);
            self.state.0.fetch_add(ONE_RING, Ordering::AcqRel);
        }
    }
}

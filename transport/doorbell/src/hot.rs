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
//! the bit and does not sleep. The count in step 3 changes the state, so that a sampler between its steps 2 and 3
//! does not fall asleep. Only the sampler clears SLEEPING: a ringer never relies on another ringer, which may have
//! been preempted or killed at any point before its wake. But a process need not wake the sampler twice from one sleep: sleeps are counted,
//! and each process [remembers](Woken) the one from which a wake of its own, which is over, has woken the sampler. While the count is
//! that one, the sampler still has its step 2 before it.
//!
//! Slots beyond the first [`NEAR_SLOTS`](crate::NEAR_SLOTS) lie in further windows, each with its own bitmap: step 1 then sets
//! the bit there, and after that the window's bit here.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::NEAR_SLOTS;
use crate::sync::{AtomicU32, AtomicU64, Ordering};
use tautline_rt::{FutexWord, full_fence};

/// The words of a sampler's bell.
const SAMPLED: usize = NEAR_SLOTS / 64;
/// The state's lowest bit; above it, the rings that found it set are counted (wrapping).
const SLEEPING: u32 = 1;
const ONE_RING: u32 = 2;

/// One bell per sampler, and small ones of `WORDS` 1 for callback threads that are woken directly: below, the thread that sleeps
/// on a bell is called its sampler. All-zero memory is a bell with nothing pending and nobody asleep.
#[repr(C, align(64))]
pub(crate) struct Bell<const WORDS: usize = SAMPLED> {
    state: FutexWord,
    /// One bit for each window in which something is pending.
    far: AtomicU32,
    /// How often the sampler has begun to sleep.
    sleeps: AtomicU64,
    pending: Pending<WORDS>,
}

/// The sleep from which this process last woke a bell's sampler. One `Woken` may serve several bells, each with a number of its own.
#[derive(Debug)]
pub(crate) struct Woken(AtomicU64);

impl Woken {
    pub(crate) fn new() -> Self {
        Woken(AtomicU64::new(0))
    }

    fn key(bell: usize, sleep: u64) -> u64 {
        (bell as u64) << 48 | sleep & ((1 << 48) - 1)
    }
}

#[repr(C, align(64))]
struct Pending<const WORDS: usize>([AtomicU64; WORDS]);

impl<const WORDS: usize> Bell<WORDS> {
    /// Marks `slot` pending and wakes the sampler if it sleeps.
    ///
    /// # Real-time
    /// Wait-free; no allocation; one futex wake if the sampler sleeps, else no syscall.
    #[cfg(taut_loom)]
    pub(crate) fn ring(&self, slot: usize) {
        self.mark(slot);
        full_fence();
        self.wake_if_sleeping(0, &Woken::new());
    }

    /// The first step of a ring, possibly for several slots: a sequentially consistent fence and
    /// [`wake_if_sleeping`](Self::wake_if_sleeping) must follow.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn mark(&self, slot: usize) {
        mark_in(&self.pending.0, slot);
    }

    /// Records that something was marked in the bitmap of `window`: part of the first step.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn mark_window(&self, window: usize) {
        // Release: pairs with the Acquire in `take_windows`, after which the window's bitmap is read.
        self.far.fetch_or(1 << (window % u32::BITS as usize), Ordering::Release);
    }

    /// The last step of a ring. `bell` is the number of this bell among those that `woken` serves.
    ///
    /// # Real-time
    /// Wait-free; one futex wake if the sampler sleeps and this process has not woken it from that sleep, else no syscall.
    pub(crate) fn wake_if_sleeping(&self, bell: usize, woken: &Woken) {
        if self.state.0.load(Ordering::Relaxed) & SLEEPING == 0 {
            return;
        }
        // Acquire: pairs with the Release in `fall_asleep`; the sleep before that one is over when the state is read again.
        let sleep = Woken::key(bell, self.sleeps.load(Ordering::Acquire));
        // Acquire: pairs with the Release below; that wake is over.
        if woken.0.load(Ordering::Acquire) == sleep {
            return;
        }
        // The sampler was in that sleep, or in a later one: then that one is over, too. The count is not read again, because the
        // sampler, which runs by now, writes to its cache line.
        if self.wake() {
            woken.0.store(sleep, Ordering::Release);
        }
    }

    /// Wakes the sampler. Returns whether it was asleep.
    fn wake(&self) -> bool {
        let state = self.state.0.fetch_add(ONE_RING, Ordering::AcqRel);
        self.state.wake();
        state & SLEEPING != 0
    }

    /// Takes every pending slot and hands it to `each`, lowest first; returns how many there were. Slots in windows are taken by
    /// [`drain_bits`], for the windows that [`take_windows`](Self::take_windows) returns.
    ///
    /// # Real-time
    /// Wait-free, O(pending + 16); no allocation; no syscall.
    pub(crate) fn drain(&self, each: impl FnMut(usize)) -> usize {
        drain_bits(&self.pending.0, each)
    }

    /// Takes the windows in which something is pending, a bit for each.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn take_windows(&self) -> u32 {
        if self.far.load(Ordering::Relaxed) == 0 {
            return 0;
        }
        self.far.swap(0, Ordering::Acquire)
    }

    /// Clears the bit of one slot, if it is pending. What was written before its ring is seen after this.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn take(&self, slot: usize) {
        if let Some(word) = self.pending.0.get(slot / 64) {
            word.fetch_and(!(1 << (slot % 64)), Ordering::Acquire);
        }
    }

    /// Whether a slot is pending.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn is_pending(&self) -> bool {
        has_bits(&self.pending.0) || self.far.load(Ordering::Relaxed) != 0
    }

    /// Sleeps until a slot is pending or the absolute `CLOCK_MONOTONIC` time `deadline_ns`. Only the sampler calls this.
    /// May return early.
    ///
    /// # Real-time
    /// At most one syscall; no allocation.
    pub(crate) fn sleep(&self, deadline_ns: Option<u64>) {
        let asleep = self.fall_asleep();
        full_fence();
        if !self.is_pending() {
            self.state.wait(asleep, deadline_ns);
        }
        self.state.0.fetch_and(!SLEEPING, Ordering::AcqRel);
    }

    /// The first step of a sleep; returns the state that it leaves.
    fn fall_asleep(&self) -> u32 {
        // Only the sampler writes the count. Release: a thread that sees it sees that the sleep before is over.
        self.sleeps.store(self.sleeps.load(Ordering::Relaxed).wrapping_add(1), Ordering::Release);
        self.state.0.fetch_or(SLEEPING, Ordering::AcqRel) | SLEEPING
    }

    /// Finishes the ring of a process that was killed between setting the bit and waking. Waking a sampler that is awake is
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

/// # Real-time
/// Wait-free; no syscall.
pub(crate) fn mark_in(pending: &[AtomicU64], slot: usize) {
    // An index out of range can come from another process's memory: it rings nothing.
    let Some(word) = pending.get(slot / 64) else { return };
    // Release: pairs with the Acquire in `drain_bits`; what was written before the ring is seen after the drain.
    word.fetch_or(1 << (slot % 64), Ordering::Release);
}

/// Takes every bit that is set and hands its index to `each`, lowest first; returns how many there were.
///
/// # Real-time
/// Wait-free, O(bits set + words); no allocation; no syscall.
pub(crate) fn drain_bits(pending: &[AtomicU64], mut each: impl FnMut(usize)) -> usize {
    let mut count = 0;
    for (index, word) in pending.iter().enumerate() {
        if word.load(Ordering::Relaxed) == 0 {
            continue;
        }
        // Acquire: pairs with the Release in `mark_in`.
        let mut bits = word.swap(0, Ordering::Acquire);
        while bits != 0 {
            each(index * 64 + bits.trailing_zeros() as usize);
            bits &= bits - 1;
            count += 1;
        }
    }
    count
}

pub(crate) fn has_bits(pending: &[AtomicU64]) -> bool {
    pending.iter().any(|word| word.load(Ordering::Relaxed) != 0)
}

/// A slot's properties that other processes must know. Only its owner writes them; zero means no special
/// property.
///
/// A subscription that finds sample after sample need not be rung for each of them: it is *draining*. Before it sleeps, it
/// clears this flag and checks its queue once more:
///
/// ```text
///  publisher                                  subscription
///  1 queue the sample                         1 flags &= !DRAINING
///  2 fence                                    2 fence
///  3 flags have no DRAINING? ring             3 nothing queued? sleep until rung
/// ```
///
/// As with the bell, either the publisher sees that it must ring, or the subscription sees the sample. The same holds for a
/// subscription that stops busy polling (`QUIET`).
#[repr(transparent)]
pub struct Flags(AtomicU32);

impl Flags {
    /// The subscription polls by itself: publishers need not ring.
    const QUIET: u32 = 1;
    /// The subscription has a deadline: publishers note when they send.
    const DEADLINE: u32 = 2;
    /// The subscription takes what is queued, and checks its queue again before it sleeps.
    const DRAINING: u32 = 4;
    /// Threads that publish through the subscription's own arena check its queue afterwards: these publishers need not ring.
    const OWN_LOOK: u32 = 8;

    fn has(&self, flag: u32) -> bool {
        self.0.load(Ordering::Relaxed) & flag != 0
    }

    /// Clears all flags. For the slot's owner.
    pub(crate) fn clear(&self) {
        self.0.store(0, Ordering::Relaxed);
    }

    fn put(&self, flag: u32, is_set: bool) {
        let flags = self.0.load(Ordering::Relaxed);
        self.0.store(if is_set { flags | flag } else { flags & !flag }, Ordering::Relaxed);
    }

    /// Sets whether the subscription has a deadline. For the slot's owner.
    pub fn set_deadline(&self, has_deadline: bool) {
        self.put(Self::DEADLINE, has_deadline);
    }

    /// Whether publishers record when they send: see [`Activity`](crate::Activity).
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn has_deadline(&self) -> bool {
        self.has(Self::DEADLINE)
    }

    /// Sets whether publishers need not ring, because the subscription polls without a doorbell. For the slot's owner, which must
    /// check its queue once more after it has cleared this flag.
    ///
    /// # Real-time
    /// Wait-free: a load, a store and a fence.
    pub fn set_quiet(&self, is_quiet: bool) {
        self.put(Self::QUIET, is_quiet);
        full_fence();
    }

    /// Sets whether publishers of the subscription's own arena need not ring, because the thread that publishes checks the queue
    /// afterwards. For the slot's owner, which must check its queue once more after each change.
    ///
    /// # Real-time
    /// Wait-free: a load, a store and a fence.
    pub fn set_own_look(&self, is_looked: bool) {
        self.put(Self::OWN_LOOK, is_looked);
        full_fence();
    }

    /// Whether a publisher, of the slot's own arena or of another one, must ring. Call it after the sample was queued, with a
    /// sequentially consistent fence in between.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn wants_ring(&self, is_own: bool) -> bool {
        !self.has(Self::QUIET | Self::DRAINING | if is_own { Self::OWN_LOOK } else { 0 })
    }

    /// Publishers need not ring until [`stop_draining`](Self::stop_draining). For the slot's owner.
    ///
    /// # Real-time
    /// Wait-free: a load and a store.
    pub fn start_draining(&self) {
        self.put(Self::DRAINING, true);
    }

    /// Publishers ring again. The owner must check its queue after this, before it sleeps.
    ///
    /// # Real-time
    /// Wait-free: a load, a store and a fence.
    pub fn stop_draining(&self) {
        self.put(Self::DRAINING, false);
        full_fence();
    }
}

/// Which bell is rung for a slot: its arena's, or that of a callback thread, which then sleeps on no other. Written by the
/// slot's owner alone; zero is the arena's.
///
/// The owner changes it as it stops [draining](Flags), and checks its queue after that. A publisher that still rings the former
/// bell had queued its sample by then.
#[repr(transparent)]
pub(crate) struct BellRouting(AtomicU32);

/// A place at a callback thread's bell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BellBit {
    pub(crate) thread: usize,
    pub(crate) bit: usize,
}

impl BellRouting {
    /// # Real-time
    /// Wait-free: one load.
    pub(crate) fn get(&self) -> Option<BellBit> {
        let place = self.0.load(Ordering::Relaxed).checked_sub(1)? as usize;
        Some(BellBit { thread: place / 64, bit: place % 64 })
    }

    /// For the slot's owner, which must check its queue after this.
    ///
    /// # Real-time
    /// Wait-free: a store and a fence.
    pub(crate) fn set(&self, bell_bit: Option<BellBit>) {
        let place = bell_bit.map_or(0, |bell_bit| (bell_bit.thread * 64 + bell_bit.bit) as u32 + 1);
        self.0.store(place, Ordering::Relaxed);
        full_fence();
    }
}

#[cfg(not(taut_loom))]
impl<const WORDS: usize> Bell<WORDS> {
    /// How often the sleeper of this bell is woken while `meanwhile` runs.
    pub(crate) fn count_wakes(&self, meanwhile: impl FnOnce()) -> u32 {
        let before = self.fall_asleep();
        meanwhile();
        let after = self.state.0.fetch_and(!SLEEPING, Ordering::AcqRel);
        after.wrapping_sub(before) / ONE_RING
    }
}

#[cfg(all(test, taut_loom))]
impl Flags {
    pub(crate) fn new() -> Self {
        Flags(AtomicU32::new(0))
    }
}

#[cfg(all(test, taut_loom))]
impl BellRouting {
    pub(crate) fn new() -> Self {
        BellRouting(AtomicU32::new(0))
    }
}

#[cfg(all(test, taut_loom))]
#[allow(clippy::indexing_slicing)]
impl<const WORDS: usize> Bell<WORDS> {
    pub(crate) fn new() -> Self {
        Bell {
            state: FutexWord::new(0),
            far: AtomicU32::new(0),
            sleeps: AtomicU64::new(0),
            pending: Pending(core::array::from_fn(|_| AtomicU64::new(0))),
        }
    }

    /// The first step of `ring` alone, or all but the wake: a ringer that was killed there.
    pub(crate) fn ring_and_die(&self, slot: usize, before_wake: bool) {
        self.pending.0[slot / 64].fetch_or(1 << (slot % 64), Ordering::Release);
        if before_wake {
            full_fence();
            self.state.0.fetch_add(ONE_RING, Ordering::AcqRel);
        }
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a doorbell is in shared memory, and typed access to its words.
//!
//! Memory is given: the participant's own, or a peer's that was mapped. The first [`MAIN_BYTES`] have the bells and the first
//! slots; each further window of slots, twice as many as all before it, is memory of its own that comes when it is needed.

use crate::hot::{Bell, BellBit, Flags, Route, drain_bits, has_bits, mark_in};
use crate::sync::{AtomicU32, AtomicU64, Ordering, fence};
use crate::{ArenaId, DoorbellError, NEAR_SLOTS};
use std::slice;
use std::sync::OnceLock;
use tautline_rt::shm::Region;

const MAGIC: u64 = u64::from_le_bytes(*b"tautbell");
const VERSION: u32 = 6;

/// Windows of an arena, the first one included.
pub const WINDOWS: usize = 12;

/// Slots of an arena whose windows are all there.
pub const MAX_SLOTS: usize = NEAR_SLOTS << (WINDOWS - 1);

/// Callback threads of a context that publishers can wake themselves.
pub(crate) const THREADS: usize = 256;

/// Bytes of an arena's first part.
pub const MAIN_BYTES: usize = size_of::<Main>();

/// Who sleeps on a bell of an arena.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sleeper {
    /// The sampler.
    Sampler,
    /// The callback thread with this bell.
    Thread(usize),
}

/// Every field is an atomic whose zero is a valid idle state, so fresh pages need no set-up, and whatever another process writes
/// is a value, never undefined behaviour.
#[repr(C)]
struct Main {
    magic: AtomicU64,
    version: AtomicU32,
    bell: Bell,
    threads: [Bell<1>; THREADS],
    slots: [SlotWords; NEAR_SLOTS],
}

#[repr(C)]
struct SlotWords {
    flags: Flags,
    /// The slot that is rung for the events of what is here, and 1. 0: there is none.
    events: AtomicU32,
    /// Which bell publishers ring for what is here.
    route: Route,
    /// When each kind of [`Activity`] was last seen.
    activities: [AtomicU64; ACTIVITIES],
}

/// Kinds of an [`Activity`].
const ACTIVITIES: usize = 2;

/// Something that a publisher or a subscription shows by storing the time: of which slot, and what. The time is in
/// `CLOCK_MONOTONIC` nanoseconds; 0 is never.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Activity {
    /// The slot's index.
    pub slot: usize,
    /// What happened.
    pub kind: ActivityKind,
}

/// Kinds of an [`Activity`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActivityKind {
    /// A sample was published by this publisher, or for this subscription.
    Sample,
    /// This publisher showed that it is alive.
    Liveliness,
}

impl Activity {
    /// As one number that is not 0.
    pub fn to_word(self) -> u64 {
        (self.slot * ACTIVITIES + self.kind as usize) as u64 + 1
    }

    /// What [`to_word`](Self::to_word) gave the number for.
    pub fn from_word(word: u64) -> Option<Self> {
        let index = usize::try_from(word.checked_sub(1)?).ok()?;
        let kind = if index % ACTIVITIES == 0 { ActivityKind::Sample } else { ActivityKind::Liveliness };
        Some(Activity { slot: index / ACTIVITIES, kind })
    }
}

/// The window that `slot` lies in, and its index there.
pub fn place(slot: usize) -> (usize, usize) {
    match slot / NEAR_SLOTS {
        0 => (0, slot),
        turns => {
            let window = turns.ilog2() as usize + 1;
            (window, slot - first_slot(window))
        }
    }
}

/// The first slot of a window. A window but the first has as many slots as there are before it.
pub fn first_slot(window: usize) -> usize {
    if window == 0 { 0 } else { NEAR_SLOTS << (window - 1) }
}

/// How many slots a window has.
pub fn window_slots(window: usize) -> usize {
    if window == 0 { NEAR_SLOTS } else { first_slot(window) }
}

/// Bytes of a window but the first, which lies in the main part.
pub fn window_bytes(window: usize) -> usize {
    window_slots(window) / 8 + window_slots(window) * size_of::<SlotWords>()
}

/// The window that `slot` lies in.
pub fn window_of(slot: usize) -> usize {
    place(slot).0
}

/// An arena: this process's own, or a peer's. What a peer's holds are claims; indices are checked wherever they are used.
#[derive(Debug)]
pub struct Arena {
    id: ArenaId,
    main: Region,
    windows: [OnceLock<Region>; WINDOWS],
}

impl Arena {
    /// Makes an arena in fresh memory, which is zeros and at least [`MAIN_BYTES`] long, at the start of a page.
    ///
    /// # Panics
    /// If the memory is too short.
    pub fn create(id: ArenaId, main: Region) -> Self {
        assert!(main.len_bytes() >= MAIN_BYTES, "too short for an arena");
        let arena = Arena { id, main, windows: Default::default() };
        arena.main().version.store(VERSION, Ordering::Relaxed);
        // Release: pairs with the Acquire in `open`; the version is there when the magic is.
        arena.main().magic.store(MAGIC, Ordering::Release);
        arena
    }

    /// A peer's arena.
    ///
    /// # Errors
    /// [`DoorbellError::Version`]: there is none here, or one of another version.
    pub fn open(id: ArenaId, main: Region) -> Result<Self, DoorbellError> {
        if main.len_bytes() < MAIN_BYTES {
            return Err(DoorbellError::Version);
        }
        let arena = Arena { id, main, windows: Default::default() };
        let main = arena.main();
        if main.magic.load(Ordering::Acquire) != MAGIC || main.version.load(Ordering::Relaxed) != VERSION {
            return Err(DoorbellError::Version);
        }
        Ok(arena)
    }

    /// Gives the arena the memory of a window; one that it has already stays. Memory that is too short is not taken.
    pub fn add_window(&self, window: usize, memory: Region) {
        if window != 0
            && memory.len_bytes() >= window_bytes(window)
            && let Some(place) = self.windows.get(window)
        {
            // What is there already is the same.
            let _ = place.set(memory);
        }
    }

    /// Whether `slot` can be rung: the memory of its window is there.
    pub fn has(&self, slot: usize) -> bool {
        self.words(slot).is_some()
    }

    /// Which arena it is.
    pub fn id(&self) -> ArenaId {
        self.id
    }

    fn main(&self) -> &Main {
        // SAFETY: the region is at least MAIN_BYTES of a live mapping, at the start of a page, and every bit pattern of a Main is
        // valid (atomics only).
        unsafe { self.main.start().cast().as_ref() }
    }

    /// The bitmap and the slots of a window but the first.
    fn window(&self, window: usize) -> Option<(&[AtomicU64], &[SlotWords])> {
        let (memory, slots) = (self.windows.get(window)?.get()?, window_slots(window));
        let pending = memory.start().cast::<AtomicU64>();
        // SAFETY: the region is as long as both together, as `add_window` checked, in a live mapping at the start of a page; every
        // bit pattern is valid (atomics only), and the bitmap's length is a multiple of the slots' alignment.
        unsafe {
            let words = pending.add(slots / 64).cast::<SlotWords>();
            Some((
                slice::from_raw_parts(pending.as_ptr(), slots / 64),
                slice::from_raw_parts(words.as_ptr(), slots),
            ))
        }
    }

    /// A slot's words; none if a peer's claim is no slot, or its window is not here.
    fn words(&self, slot: usize) -> Option<&SlotWords> {
        match place(slot) {
            (0, index) => self.main().slots.get(index),
            (window, index) => self.window(window)?.1.get(index),
        }
    }

    pub(crate) fn bell(&self) -> &Bell {
        &self.main().bell
    }

    /// The bell of a callback thread; none if a peer's claim is no thread.
    pub(crate) fn thread_bell(&self, thread: usize) -> Option<&Bell<1>> {
        self.main().threads.get(thread)
    }

    /// Finishes the rings of processes that were killed within them.
    ///
    /// # Real-time
    /// For a low-priority thread, now and then.
    pub fn rescue(&self) {
        for window in 1..WINDOWS {
            if self.window(window).is_some_and(|(pending, _)| has_bits(pending)) {
                self.bell().mark_window(window);
            }
        }
        self.bell().rescue();
        self.main().threads.iter().for_each(Bell::rescue);
    }

    /// Marks `slot` pending for the sampler, and wakes it if it sleeps.
    ///
    /// # Real-time
    /// Wait-free; no allocation; one futex wake if the sampler sleeps, else no syscall.
    pub fn ring(&self, slot: usize) {
        self.mark(slot);
        fence(Ordering::SeqCst);
        self.bell().wake_if_sleeping();
    }

    /// The first step of [`ring`](Self::ring), of several slots maybe: [`wake`](Self::wake) follows, after a sequentially
    /// consistent fence.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn mark(&self, slot: usize) {
        match place(slot) {
            (0, index) => self.bell().mark(index),
            (window, index) => {
                if let Some((pending, _)) = self.window(window) {
                    mark_in(pending, index);
                    self.bell().mark_window(window);
                }
            }
        }
    }

    /// Takes every pending slot and hands it to `each`; returns how many there were. For the sampler.
    ///
    /// # Real-time
    /// Wait-free, O(pending + 16), and O(slots / 64) of each further window in which something is pending; no allocation; no syscall.
    pub(crate) fn drain(&self, mut each: impl FnMut(usize)) -> usize {
        let mut count = self.bell().drain(&mut each);
        let mut windows = self.bell().take_windows();
        while windows != 0 {
            let window = windows.trailing_zeros() as usize;
            windows &= windows - 1;
            if let Some((pending, _)) = self.window(window) {
                count += drain_bits(pending, |index| each(first_slot(window) + index));
            }
        }
        count
    }

    /// Marks the sample that was just queued at the subscription behind `slot`, if it wants to be rung for it. Returns which bell's
    /// sleeper [`wake`](Self::wake) is to wake, after a sequentially consistent fence.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn mark_sample(&self, slot: usize) -> Option<Sleeper> {
        let words = self.words(slot).filter(|words| words.flags.wants_ring())?;
        Some(match words.route.get() {
            None => {
                self.mark(slot);
                Sleeper::Sampler
            }
            Some(BellBit { thread, bit }) => {
                self.thread_bell(thread)?.mark(bit);
                Sleeper::Thread(thread)
            }
        })
    }

    /// Wakes whoever sleeps on a bell that was marked.
    ///
    /// # Real-time
    /// Wait-free; at most one futex wake.
    pub fn wake(&self, sleeper: Sleeper) {
        match sleeper {
            Sleeper::Sampler => self.bell().wake_if_sleeping(),
            Sleeper::Thread(thread) => {
                if let Some(bell) = self.thread_bell(thread) {
                    bell.wake_if_sleeping();
                }
            }
        }
    }

    /// Leads the rings for `slot` to a callback thread's bell, or to the sampler's.
    pub(crate) fn set_route(&self, slot: usize, bell_bit: Option<BellBit>) {
        if let Some(words) = self.words(slot) {
            words.route.set(bell_bit);
        }
    }

    /// A slot's flags; none if a peer's claim is no slot.
    pub fn flags(&self, slot: usize) -> Option<&Flags> {
        self.words(slot).map(|words| &words.flags)
    }

    /// Rings the events of what is behind `slot`, if somebody wants to know of them.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake, and none if nobody wants to know.
    pub fn ring_events(&self, slot: usize) {
        // What happened is visible before the word is read: whoever sets it either is rung or sees it.
        fence(Ordering::SeqCst);
        let events = self.words(slot).map_or(0, |words| words.events.load(Ordering::Relaxed));
        if events != 0 {
            self.ring(events as usize - 1);
        }
    }

    /// The slot to ring for the events of what is behind `slot`. The caller looks for what happened before after this.
    pub fn set_events(&self, slot: usize, events: usize) {
        if let Some(words) = self.words(slot) {
            words.events.store(events as u32 + 1, Ordering::Relaxed);
            fence(Ordering::SeqCst);
        }
    }

    /// Nobody wants to know of the events any more, unless another one does by now.
    pub fn clear_events(&self, slot: usize, events: usize) {
        if let Some(words) = self.words(slot) {
            let ours = events as u32 + 1;
            let _ = words.events.compare_exchange(ours, 0, Ordering::Relaxed, Ordering::Relaxed);
        }
    }

    /// Stores when an activity was last seen.
    ///
    /// # Real-time
    /// Wait-free: one store; no syscall.
    pub fn set_activity(&self, activity: Activity, now_ns: u64) {
        if let Some(words) = self.words(activity.slot) {
            words.activities[activity.kind as usize].store(now_ns, Ordering::Relaxed);
        }
    }

    /// When it was last seen.
    ///
    /// # Real-time
    /// Wait-free: one load; no syscall.
    pub fn activity_ns(&self, activity: Activity) -> u64 {
        self.words(activity.slot)
            .map_or(0, |words| words.activities[activity.kind as usize].load(Ordering::Relaxed))
    }

    /// Makes a slot look never used.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn reset(&self, slot: usize) {
        let Some(words) = self.words(slot) else { return };
        words.flags.clear();
        words.route.set(None);
        words.events.store(0, Ordering::Relaxed);
        words.activities.iter().for_each(|activity| activity.store(0, Ordering::Relaxed));
    }

    /// How often whoever sleeps on a bell is woken by what happens `meanwhile`. For tests.
    #[doc(hidden)]
    #[cfg(not(taut_loom))]
    pub fn count_wakes(&self, sleeper: Sleeper, meanwhile: impl FnOnce()) -> u32 {
        match sleeper {
            Sleeper::Sampler => self.bell().count_wakes(meanwhile),
            Sleeper::Thread(thread) => self.main().threads[thread].count_wakes(meanwhile),
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::tests::memory;

    #[test]
    fn slots_lie_in_windows_that_double() {
        let mut next = 0;
        for window in 0..WINDOWS {
            assert_eq!(first_slot(window), next);
            assert_eq!(place(next), (window, 0));
            next += window_slots(window);
            assert_eq!(place(next - 1), (window, window_slots(window) - 1));
        }
        assert_eq!(next, MAX_SLOTS);
    }

    #[test]
    fn what_is_no_arena_is_refused() {
        let id = ArenaId(7);
        assert!(matches!(Arena::open(id, memory(MAIN_BYTES)), Err(DoorbellError::Version)));
        assert!(matches!(Arena::open(id, memory(64)), Err(DoorbellError::Version)));
        let arena = Arena::create(id, memory(MAIN_BYTES));
        arena.main().version.store(VERSION + 1, Ordering::Relaxed);
        assert!(matches!(Arena::open(id, arena.main.clone()), Err(DoorbellError::Version)));
    }

    #[test]
    fn indices_from_other_processes_are_harmless() {
        let arena = Arena::create(ArenaId(7), memory(MAIN_BYTES));
        for slot in [NEAR_SLOTS, MAX_SLOTS, usize::MAX] {
            arena.ring(slot);
            arena.ring_events(slot);
            arena.set_activity(Activity { slot, kind: ActivityKind::Sample }, 1);
            assert!(arena.mark_sample(slot).is_none() && arena.flags(slot).is_none() && !arena.has(slot));
        }
        assert!(!arena.bell().is_pending());
        arena.add_window(WINDOWS, memory(64));
        arena.add_window(1, memory(64));
        assert!(!arena.has(NEAR_SLOTS), "too short");
    }

    #[test]
    fn a_slot_of_a_window_is_rung_and_rescued() {
        let arena = Arena::create(ArenaId(7), memory(MAIN_BYTES));
        arena.add_window(1, memory(window_bytes(1)));
        arena.add_window(2, memory(window_bytes(2)));
        let slots = [3, NEAR_SLOTS, 2 * NEAR_SLOTS - 1, 4 * NEAR_SLOTS - 1];
        slots.iter().for_each(|slot| arena.ring(*slot));
        let mut drained = Vec::new();
        assert_eq!(arena.drain(|slot| drained.push(slot)), 4);
        assert_eq!(drained, slots);
        assert!(!arena.bell().is_pending());
        // As by a ringer that was killed after its first store.
        mark_in(arena.window(2).unwrap().0, 5);
        assert!(!arena.bell().is_pending());
        arena.rescue();
        assert_eq!(arena.drain(|slot| assert_eq!(slot, 2 * NEAR_SLOTS + 5)), 1);
    }
}

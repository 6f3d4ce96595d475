// SPDX-License-Identifier: MIT OR Apache-2.0
//! A doorbell's layout in shared memory, and typed access to its words.
//!
//! The caller provides the memory: the participant's own, or a mapped part of a peer's. The first [`MAIN_BYTES`] contain the
//! bells and the first slots. Each further window has as many slots as all windows before it; it is separate memory, which is
//! added when it is needed.

use crate::hot::{Bell, BellBit, BellRouting, Flags, Woken, drain_bits, has_bits, mark_in};
use crate::sync::{AtomicU32, AtomicU64, Ordering};
use crate::{ArenaId, DoorbellError, NEAR_SLOTS};
use std::slice;
use std::sync::OnceLock;
use tautline_rt::full_fence;
use tautline_rt::shm::Region;

const MAGIC: u64 = u64::from_le_bytes(*b"tautbell");
const VERSION: u32 = 7;

/// Number of windows of an arena, including the first one.
pub const WINDOWS: usize = 12;

/// Number of slots of an arena with all its windows.
pub const MAX_SLOTS: usize = NEAR_SLOTS << (WINDOWS - 1);

/// Callback threads of a context that publishers can wake themselves.
pub(crate) const THREADS: usize = 256;

/// Size of an arena's first part in bytes.
pub const MAIN_BYTES: usize = size_of::<Main>();

/// The thread that sleeps on a bell of an arena.
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
    /// Index + 1 of the slot that is rung for the events of this slot's owner. 0: there is none.
    events: AtomicU32,
    /// The bell that publishers ring for this slot.
    route: BellRouting,
    /// The time when each kind of [`Activity`] was last seen.
    activities: [AtomicU64; ACTIVITIES],
}

/// Kinds of an [`Activity`].
const ACTIVITIES: usize = 2;

/// An activity of a publisher or a subscription, which is recorded by storing the time: its slot, and its kind.
/// The time is in `CLOCK_MONOTONIC` nanoseconds; 0 means never.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Activity {
    /// The slot's index.
    pub slot: usize,
    /// The kind of activity.
    pub kind: ActivityKind,
}

/// Kinds of an [`Activity`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActivityKind {
    /// A sample was published by this publisher, or for this subscription.
    Sample,
    /// This publisher asserted its liveliness.
    Liveliness,
}

impl Activity {
    /// Packs it into one number that is not 0.
    pub fn to_word(self) -> u64 {
        (self.slot * ACTIVITIES + self.kind as usize) as u64 + 1
    }

    /// Unpacks a number from [`to_word`](Self::to_word).
    pub fn from_word(word: u64) -> Option<Self> {
        let index = usize::try_from(word.checked_sub(1)?).ok()?;
        let kind = if index % ACTIVITIES == 0 { ActivityKind::Sample } else { ActivityKind::Liveliness };
        Some(Activity { slot: index / ACTIVITIES, kind })
    }
}

/// The window of `slot`, and the slot's index there.
pub fn place(slot: usize) -> (usize, usize) {
    match slot / NEAR_SLOTS {
        0 => (0, slot),
        turns => {
            let window = turns.ilog2() as usize + 1;
            (window, slot - first_slot(window))
        }
    }
}

/// The first slot of a window. Every window except the first has as many slots as all windows before it.
pub fn first_slot(window: usize) -> usize {
    if window == 0 { 0 } else { NEAR_SLOTS << (window - 1) }
}

/// The number of slots of a window.
pub fn window_slots(window: usize) -> usize {
    if window == 0 { NEAR_SLOTS } else { first_slot(window) }
}

/// Size in bytes of a window other than the first, which lies in the main part.
pub fn window_bytes(window: usize) -> usize {
    window_slots(window) / 8 + window_slots(window) * size_of::<SlotWords>()
}

/// The window of `slot`.
pub fn window_of(slot: usize) -> usize {
    place(slot).0
}

/// An arena: this process's own, or a peer's. The content of a peer's arena is untrusted; indices are checked wherever
/// they are used.
#[derive(Debug)]
pub struct Arena {
    id: ArenaId,
    main: Region,
    windows: [OnceLock<Region>; WINDOWS],
    /// The sampler's last wake by this process, and that of a callback thread.
    woken: [Woken; 2],
}

impl Arena {
    fn of(id: ArenaId, main: Region) -> Self {
        Arena { id, main, windows: Default::default(), woken: [Woken::new(), Woken::new()] }
    }

    /// Creates an arena in new memory, which is zero, at least [`MAIN_BYTES`] long, and starts at a
    /// multiple of 64 bytes.
    ///
    /// # Panics
    /// If the memory is too short, or not aligned.
    pub fn create(id: ArenaId, main: Region) -> Self {
        assert!(main.len_bytes() >= MAIN_BYTES, "too short for an arena");
        assert!(main.start().cast::<Main>().is_aligned(), "not aligned to what it holds");
        let arena = Arena::of(id, main);
        arena.main().version.store(VERSION, Ordering::Relaxed);
        // Release: pairs with the Acquire in `open`; the version is there when the magic is.
        arena.main().magic.store(MAGIC, Ordering::Release);
        arena
    }

    /// A peer's arena.
    ///
    /// # Errors
    /// [`DoorbellError::Version`]: the memory contains no arena, or one of another version.
    pub fn open(id: ArenaId, main: Region) -> Result<Self, DoorbellError> {
        if main.len_bytes() < MAIN_BYTES {
            return Err(DoorbellError::Version);
        }
        let arena = Arena::of(id, main);
        let main = arena.main();
        if main.magic.load(Ordering::Acquire) != MAGIC || main.version.load(Ordering::Relaxed) != VERSION {
            return Err(DoorbellError::Version);
        }
        Ok(arena)
    }

    /// Adds the memory of a window to the arena. A window that it already has is kept. Memory that is too short is
    /// ignored.
    pub fn add_window(&self, window: usize, memory: Region) {
        if window != 0
            && memory.len_bytes() >= window_bytes(window)
            && let Some(place) = self.windows.get(window)
        {
            // A window that is there already is the same memory.
            let _ = place.set(memory);
        }
    }

    /// Whether `slot` can be rung, because the memory of its window exists.
    pub fn has(&self, slot: usize) -> bool {
        self.words(slot).is_some()
    }

    /// The arena's id.
    pub fn id(&self) -> ArenaId {
        self.id
    }

    fn main(&self) -> &Main {
        // SAFETY: the region is at least MAIN_BYTES of a live mapping, aligned as `create` says, and every bit pattern of a Main
        // is valid (atomics only).
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

    /// A slot's words; `None` if the index, which may come from a peer, is not a slot, or if its window is not here.
    fn words(&self, slot: usize) -> Option<&SlotWords> {
        match place(slot) {
            (0, index) => self.main().slots.get(index),
            (window, index) => self.window(window)?.1.get(index),
        }
    }

    pub(crate) fn bell(&self) -> &Bell {
        &self.main().bell
    }

    /// The bell of a callback thread; `None` if the index, which may come from a peer, is not a thread.
    pub(crate) fn thread_bell(&self, thread: usize) -> Option<&Bell<1>> {
        self.main().threads.get(thread)
    }

    /// Completes the rings of processes that were killed while they rang.
    ///
    /// # Real-time
    /// Call it occasionally in a low-priority thread.
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
        full_fence();
        self.wake(Sleeper::Sampler);
    }

    /// The first step of [`ring`](Self::ring), also for several slots. [`wake`](Self::wake) must follow, after a
    /// sequentially consistent fence.
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

    /// Marks the sample that a publisher of this arena, or of another one, has just queued for the subscription of `slot`, if that wants to
    /// be rung. Returns the sleeper that [`wake`](Self::wake) must wake, after a sequentially consistent fence.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn mark_sample(&self, slot: usize, is_own: bool) -> Option<Sleeper> {
        let words = self.words(slot).filter(|words| words.flags.wants_ring(is_own))?;
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

    /// Wakes the thread that sleeps on a marked bell, unless this process has woken it from that sleep.
    ///
    /// # Real-time
    /// Wait-free; at most one futex wake.
    pub fn wake(&self, sleeper: Sleeper) {
        let [sampler, threads] = &self.woken;
        match sleeper {
            Sleeper::Sampler => self.bell().wake_if_sleeping(0, sampler),
            Sleeper::Thread(thread) => {
                if let Some(bell) = self.thread_bell(thread) {
                    bell.wake_if_sleeping(thread, threads);
                }
            }
        }
    }

    /// Routes the rings for `slot` to a callback thread's bell, or to the sampler's.
    pub(crate) fn set_route(&self, slot: usize, bell_bit: Option<BellBit>) {
        if let Some(words) = self.words(slot) {
            words.route.set(bell_bit);
        }
    }

    /// A slot's flags; `None` if the index, which may come from a peer, is not a slot.
    pub fn flags(&self, slot: usize) -> Option<&Flags> {
        self.words(slot).map(|words| &words.flags)
    }

    /// Rings the event slot of `slot`, if its events are monitored.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake, and none if its events are not monitored.
    pub fn ring_events(&self, slot: usize) {
        // The event is visible before the word is read: a thread that sets the word is rung, or sees the event.
        full_fence();
        let events = self.words(slot).map_or(0, |words| words.events.load(Ordering::Relaxed));
        if events != 0 {
            self.ring(events as usize - 1);
        }
    }

    /// Sets the slot to ring for the events of `slot`. After this call, check for events that happened before.
    pub fn set_events(&self, slot: usize, events: usize) {
        if let Some(words) = self.words(slot) {
            words.events.store(events as u32 + 1, Ordering::Relaxed);
            full_fence();
        }
    }

    /// Removes the event slot, unless another one has been set meanwhile.
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

    /// When an activity was last seen.
    ///
    /// # Real-time
    /// Wait-free: one load; no syscall.
    pub fn activity_ns(&self, activity: Activity) -> u64 {
        self.words(activity.slot)
            .map_or(0, |words| words.activities[activity.kind as usize].load(Ordering::Relaxed))
    }

    /// Resets a slot to the state of one that was never used.
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

    /// How often the sleeper of a bell is woken while `meanwhile` runs. For tests.
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
            assert!(
                arena.mark_sample(slot, false).is_none() && arena.flags(slot).is_none() && !arena.has(slot)
            );
        }
        assert!(!arena.bell().is_pending());
        arena.add_window(WINDOWS, memory(64));
        arena.add_window(1, memory(64));
        assert!(!arena.has(NEAR_SLOTS), "too short");
    }

    #[test]
    fn a_process_wakes_a_sleeper_once() {
        let arena = Arena::create(ArenaId(7), memory(MAIN_BYTES));
        let threads = [Sleeper::Thread(0), Sleeper::Thread(255)];
        for sleeper in threads.into_iter().chain([Sleeper::Sampler, Sleeper::Sampler]) {
            let ring = || match sleeper {
                Sleeper::Sampler => arena.ring(3),
                thread => arena.wake(thread),
            };
            assert_eq!(arena.count_wakes(sleeper, || (0..3).for_each(|_| ring())), 1, "{sleeper:?}");
            assert_eq!(arena.count_wakes(sleeper, || ()), 0);
        }
        // Others rely on no wake of this process.
        let other = Arena::open(ArenaId(7), arena.main.clone()).unwrap();
        let both = || [&arena, &other, &arena, &other].into_iter().for_each(|arena| arena.ring(3));
        assert_eq!(arena.count_wakes(Sleeper::Sampler, both), 2);
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

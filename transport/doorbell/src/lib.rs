// SPDX-License-Identifier: MIT OR Apache-2.0
//! The doorbell: how a publisher in any process notifies a sampler, or a callback's thread, of new data.
//!
//! Each sampler owns one [`Arena`], shared memory that any process of its user may map:
//!
//! - a bell: a bitmap of pending slots and an eventcount on which the sampler sleeps;
//! - small bells for callback threads that publishers wake themselves: see [`ThreadBell`];
//! - per slot some words: flags, the bell that is rung for it, the slot that is rung for its events.
//!
//! A subscription, a publisher, a timer and a guard condition each own a [`Slot`] of a [`Doorbell`]. The caller provides the
//! memory of an arena as [`Region`]s, and determines how other processes find it.
//!
//! Ringing is wait-free: one or two atomic operations set bits, a fence follows, and one futex wake if the sleeper sleeps and this process
//! has not woken it from that sleep. No wake-up is lost, even if a process is preempted or killed meanwhile: `hot.rs` has the
//! protocol, `loom.rs` its model.

mod arena;
mod hot;
#[cfg(all(test, taut_loom))]
mod loom;
mod places;
mod signal;
#[cfg(all(test, not(taut_loom)))]
mod stress;
mod sync;
mod thread_bell;

pub use arena::{
    Activity, ActivityKind, Arena, MAIN_BYTES, MAX_SLOTS, Sleeper, WINDOWS, first_slot, place, window_bytes,
    window_of, window_slots,
};
pub use hot::Flags;
pub use signal::{Signal, Wakeable};
pub use thread_bell::{BellRoute, ThreadBell};

use arena::THREADS;
use futures::task::AtomicWaker;
use places::FreePlaces;
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use tautline_rt::shm::Region;

/// Number of slots that an arena has initially.
#[cfg(not(taut_loom))]
pub const NEAR_SLOTS: usize = 1024;
#[cfg(taut_loom)]
#[allow(missing_docs)]
pub const NEAR_SLOTS: usize = 64;

/// Identifies an arena in a domain, by its participant. The number is random, because process ids repeat, and containers
/// share `/dev/shm`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ArenaId(pub u64);

/// Why a doorbell, or a part of it, is not available.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum DoorbellError {
    /// The memory is not an arena of this version.
    #[error("its doorbell is of another version of Tautline: use the same one in all processes")]
    Version,
    /// All slots are in use.
    #[error(
        "this context already has {limit} subscriptions, publishers, timers and guard conditions, its limit; make a second Context for more"
    )]
    Slots { limit: usize },
    /// There is no memory for more slots.
    #[error(
        "no memory for more subscriptions, publishers, timers and guard conditions of this context: {source}; is /dev/shm full?"
    )]
    Memory { source: io::Error },
    /// All bells of callback threads are in use.
    #[error(
        "this context already has {limit} callback threads that publishers wake directly, its limit; let others be woken by the sampler, or make a second Context for more"
    )]
    ThreadBells { limit: usize },
    /// The doorbell already has a sampler.
    #[error("this participant already has a sampler: use that one, or drop it first")]
    SecondSampler,
}

/// Provides the memory of a further window of an arena: see [`window_bytes`].
pub type GrowArena = Box<dyn Fn(usize) -> io::Result<Region> + Send + Sync>;

/// A sampler's own doorbell: its arena, and the wakers of its slots.
pub struct Doorbell {
    arena: Arena,
    windows: [OnceLock<Window>; WINDOWS],
    grow: Mutex<GrowArena>,
    free_threads: FreePlaces,
    sampled: AtomicBool,
}

/// This process's state of the slots of a window.
struct Window {
    wakers: Box<[AtomicWaker]>,
    free: FreePlaces,
}

impl Window {
    fn new(window: usize) -> Self {
        let slots = window_slots(window);
        Window { wakers: (0..slots).map(|_| AtomicWaker::new()).collect(), free: FreePlaces::new(slots) }
    }
}

impl Doorbell {
    /// The doorbell of a new sampler. `grow` is called for more memory when all slots are in use.
    ///
    /// # Real-time
    /// Setup only: allocates.
    pub fn new(arena: Arena, grow: GrowArena) -> Arc<Self> {
        let windows: [OnceLock<Window>; WINDOWS] = Default::default();
        let _ = windows[0].set(Window::new(0));
        Arc::new(Doorbell {
            arena,
            windows,
            grow: Mutex::new(grow),
            free_threads: FreePlaces::new(THREADS),
            sampled: AtomicBool::new(false),
        })
    }

    /// The part that other processes see.
    pub fn arena(&self) -> &Arena {
        &self.arena
    }

    fn threads(&self) -> &FreePlaces {
        &self.free_threads
    }

    /// Claims a bell for a callback thread that publishers wake themselves.
    ///
    /// # Errors
    /// [`DoorbellError::ThreadBells`] if all are in use.
    pub fn claim_thread_bell(self: &Arc<Self>) -> Result<Arc<ThreadBell>, DoorbellError> {
        ThreadBell::claim(self)
    }

    /// Claims a slot, without its previous owner's state. It is free again when the returned guard is dropped.
    ///
    /// # Real-time
    /// Wait-free, O(slots); no allocation; no syscall. Allocates and maps memory when the number of slots in use is as high as ever
    /// before and is [`NEAR_SLOTS`], or a power of two times that.
    ///
    /// # Errors
    /// [`DoorbellError::Slots`], [`DoorbellError::Memory`].
    pub fn claim(self: &Arc<Self>) -> Result<Slot, DoorbellError> {
        loop {
            let (mut next, mut taken) = (0, None);
            while let Some(window) = self.windows.get(next).and_then(OnceLock::get) {
                taken = window.free.take().map(|index| first_slot(next) + index);
                if taken.is_some() {
                    break;
                }
                next += 1;
            }
            if let Some(index) = taken {
                self.arena.reset(index);
                return Ok(Slot { doorbell: self.clone(), index, retired: AtomicBool::new(false) });
            }
            self.add_window(next)?;
        }
    }

    #[cold]
    fn add_window(&self, window: usize) -> Result<(), DoorbellError> {
        let Some(place) = self.windows.get(window) else {
            return Err(DoorbellError::Slots { limit: MAX_SLOTS });
        };
        let grow = self.grow.lock().unwrap_or_else(PoisonError::into_inner);
        if place.get().is_none() {
            self.arena.add_window(window, grow(window).map_err(|source| DoorbellError::Memory { source })?);
            let _ = place.set(Window::new(window));
        }
        Ok(())
    }

    /// Claims the exclusive right to drain this doorbell and to sleep on it.
    ///
    /// # Errors
    /// [`DoorbellError::SecondSampler`] if there is already a sampler.
    pub fn claim_sampler(self: &Arc<Self>) -> Result<SamplerSeat, DoorbellError> {
        if self.sampled.swap(true, Ordering::AcqRel) {
            return Err(DoorbellError::SecondSampler);
        }
        Ok(SamplerSeat { doorbell: self.clone() })
    }

    /// Whether something is pending.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn is_pending(&self) -> bool {
        self.arena.bell().is_pending()
    }

    /// When `activity` was last seen.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn activity_ns(&self, activity: Activity) -> u64 {
        self.arena.activity_ns(activity)
    }

    fn waker(&self, slot: usize) -> Option<&AtomicWaker> {
        let (window, index) = place(slot);
        self.windows.get(window)?.get()?.wakers.get(index)
    }

    /// Wakes the task registered at `slot`.
    ///
    /// # Real-time
    /// Wait-free; no allocation; a syscall if the task's thread sleeps.
    pub fn wake(&self, slot: usize) {
        if let Some(waker) = self.waker(slot) {
            waker.wake();
        }
    }
}

/// The exclusive right of one sampler to drain a doorbell; released when dropped.
pub struct SamplerSeat {
    doorbell: Arc<Doorbell>,
}

impl SamplerSeat {
    /// Takes every pending slot: wakes the task registered there and calls `each` with the slot. Returns their number.
    ///
    /// # Real-time
    /// O(pending + 16), and O(slots / 64) beyond the first [`NEAR_SLOTS`] slots; no allocation; a syscall for each waker whose thread
    /// sleeps.
    pub fn drain(&self, mut each: impl FnMut(usize)) -> usize {
        self.doorbell.arena.drain(|index| {
            self.doorbell.wake(index);
            each(index);
        })
    }

    /// Sleeps until something is pending or the absolute `CLOCK_MONOTONIC` time `deadline_ns`; may return early.
    ///
    /// # Real-time
    /// One syscall; no allocation.
    pub fn sleep(&self, deadline_ns: Option<u64>) {
        self.doorbell.arena.bell().sleep(deadline_ns);
    }
}

impl Drop for SamplerSeat {
    fn drop(&mut self) {
        self.doorbell.sampled.store(false, Ordering::Release);
    }
}

/// A claimed slot of this process's own arena.
pub struct Slot {
    doorbell: Arc<Doorbell>,
    index: usize,
    retired: AtomicBool,
}

impl Slot {
    /// Index of the slot, below [`MAX_SLOTS`].
    pub fn index(&self) -> usize {
        self.index
    }

    /// The waker that a ring of this slot wakes. Register it before you check the source.
    ///
    /// # Panics
    /// Never: a claimed slot has one.
    pub fn waker(&self) -> &AtomicWaker {
        self.doorbell.waker(self.index).expect("a claimed slot has a waker")
    }

    /// Marks this slot pending and wakes the sampler if it sleeps.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake.
    pub fn ring(&self) {
        self.doorbell.arena.ring(self.index);
    }

    /// An activity of this slot, for a watchdog.
    pub fn activity(&self, kind: ActivityKind) -> Activity {
        Activity { slot: self.index, kind }
    }

    /// Records that the activity was seen at `now_ns`.
    ///
    /// # Real-time
    /// Wait-free: one store; no syscall.
    pub fn note(&self, kind: ActivityKind, now_ns: u64) {
        self.doorbell.arena.set_activity(self.activity(kind), now_ns);
    }

    /// Marks the slot's owner as ended, even if others still hold the slot: they see the mark, and the task that waits
    /// there is woken.
    pub fn retire(&self) {
        self.retired.store(true, Ordering::Release);
        self.doorbell.wake(self.index);
        self.doorbell.arena.ring_events(self.index);
    }

    /// Whether the slot's owner has ended.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn is_retired(&self) -> bool {
        self.retired.load(Ordering::Acquire)
    }

    /// The doorbell of this slot.
    pub fn doorbell(&self) -> &Arc<Doorbell> {
        &self.doorbell
    }

    /// The slot's properties that other processes must know.
    ///
    /// # Panics
    /// Never: a claimed slot has them.
    pub fn flags(&self) -> &Flags {
        self.doorbell.arena.flags(self.index).expect("a claimed slot is one of its arena's")
    }
}

impl Drop for Slot {
    /// # Real-time
    /// Wait-free; no syscall. Drops the waker that is registered.
    fn drop(&mut self) {
        let (window, index) = place(self.index);
        if let Some(window) = self.doorbell.windows.get(window).and_then(OnceLock::get) {
            if let Some(waker) = window.wakers.get(index) {
                waker.take();
            }
            window.free.give_back(index);
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use std::task::{Wake, Waker};
    use tautline_rt::shm::{Mapping, OwnFile};

    /// Shared memory that nobody finds.
    pub(crate) fn memory(len_bytes: usize) -> Region {
        let file = OwnFile::create("taut_doorbell_test_").unwrap();
        file.claim(0, len_bytes as u64).unwrap();
        let map = Arc::new(Mapping::new(&file, 0, len_bytes, true).unwrap());
        file.retire();
        Region::new(&map, 0, len_bytes).unwrap()
    }

    pub(crate) fn doorbell() -> Arc<Doorbell> {
        let arena = Arena::create(ArenaId(1), memory(MAIN_BYTES));
        Doorbell::new(arena, Box::new(|window| Ok(memory(window_bytes(window)))))
    }

    #[test]
    fn there_is_a_slot_more() {
        struct Count(std::sync::atomic::AtomicUsize);
        impl Wake for Count {
            fn wake(self: Arc<Self>) {
                self.0.fetch_add(1, Ordering::Relaxed);
            }
        }
        let doorbell = doorbell();
        let seat = doorbell.claim_sampler().unwrap();
        let slots: Vec<_> = (0..3 * NEAR_SLOTS).map(|_| doorbell.claim().unwrap()).collect();
        let mut indices: Vec<_> = slots.iter().map(Slot::index).collect();
        indices.sort_unstable();
        indices.dedup();
        assert_eq!(indices.len(), slots.len());
        let count = Arc::new(Count(0.into()));
        let far = slots.last().unwrap();
        far.waker().register(&Waker::from(count.clone()));
        far.ring();
        let mut rung = Vec::new();
        assert_eq!(seat.drain(|slot| rung.push(slot)), 1);
        assert_eq!((rung, count.0.load(Ordering::Relaxed)), (vec![far.index()], 1));
        let last = far.index();
        drop(slots);
        let again: Vec<_> = (0..3 * NEAR_SLOTS).map(|_| doorbell.claim().unwrap().index()).collect();
        assert!(again.iter().all(|index| *index <= last), "what came back is used again");
    }

    #[test]
    fn memory_that_is_refused_is_an_error_with_the_reason() {
        let arena = Arena::create(ArenaId(1), memory(MAIN_BYTES));
        let doorbell = Doorbell::new(arena, Box::new(|_| Err(io::Error::other("full"))));
        let slots: Vec<_> = (0..NEAR_SLOTS).map(|_| doorbell.claim().unwrap()).collect();
        let error = doorbell.claim().map(drop).unwrap_err().to_string();
        assert!(error.contains("full") && error.contains("/dev/shm"), "{error}");
        drop(slots);
        assert!(doorbell.claim().is_ok());
    }

    #[test]
    fn one_sampler_at_a_time() {
        let doorbell = doorbell();
        let seat = doorbell.claim_sampler().unwrap();
        assert!(matches!(doorbell.claim_sampler(), Err(DoorbellError::SecondSampler)));
        drop(seat);
        assert!(doorbell.claim_sampler().is_ok());
    }
}

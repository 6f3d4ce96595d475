// SPDX-License-Identifier: MIT OR Apache-2.0
//! The doorbell: how a publisher in any process tells a sampler that something is there.
//!
//! Each sampler owns one *arena*, a file in `/dev/shm` that any process of the domain may map:
//!
//! - the [`Bell`](hot::Bell): a bitmap of pending slots and an eventcount on which the sampler sleeps;
//! - small bells for callback threads that publishers wake themselves: see [`ThreadBell`];
//! - per slot some words: flags, which bell is rung for it, an epoch that others advance when a topic's participants change;
//! - per slot of a subscription two pages of links: what one publisher and it tell each other (sent, taken, waiting).
//!
//! A subscription, a publisher, a timer and a guard condition each own a slot. Only the owner of an arena creates or
//! removes it; a file whose owner died is unlocked and is removed by whoever finds it.

mod arena;
pub(crate) mod hot;
mod link;
#[cfg(all(test, taut_loom))]
mod loom;
mod places;
#[cfg(all(test, not(taut_loom)))]
mod stress;
mod thread_bell;

pub(crate) use arena::{Arena, ArenaId, Sleeper, THREADS, remove_stale_arenas};
pub use arena::{Pulse, PulseOf};
pub(crate) use hot::Flags;
pub(crate) use link::{KILLED, LINKS, Link, NONE_FOR_IT, Owner};
pub(crate) use thread_bell::Joined;
pub use thread_bell::ThreadBell;

use crate::error::TransportError;
use crate::sync::Ordering;
use futures::task::AtomicWaker;
use places::FreePlaces;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Slots of an arena: the most subscriptions, publishers, timers and guard conditions that one context can have.
#[cfg(not(taut_loom))]
pub const SLOTS: usize = 1024;
#[cfg(taut_loom)]
#[allow(missing_docs)]
pub const SLOTS: usize = 64;

/// A sampler's own doorbell: its arena, and the wakers behind the slots.
pub struct Doorbell {
    arena: Arena,
    wakers: Box<[AtomicWaker]>,
    /// Of which slots the janitor is to open what their owners could not: see [`Slot::leave_to_janitor`].
    left: Box<[AtomicBool]>,
    free: FreePlaces,
    free_threads: FreePlaces,
    sampled: AtomicBool,
}

impl Doorbell {
    /// Creates the arena of a new sampler in `domain`.
    ///
    /// # Errors
    /// [`TransportError::Arena`] if `/dev/shm` cannot hold it.
    pub(crate) fn create(domain: u32) -> Result<Arc<Self>, TransportError> {
        Ok(Arc::new(Doorbell {
            arena: Arena::create(domain)?,
            wakers: (0..SLOTS).map(|_| AtomicWaker::new()).collect(),
            left: (0..SLOTS).map(|_| AtomicBool::new(false)).collect(),
            free: FreePlaces::new(SLOTS),
            free_threads: FreePlaces::new(THREADS),
            sampled: AtomicBool::new(false),
        }))
    }

    pub(crate) fn arena(&self) -> &Arena {
        &self.arena
    }

    fn threads(&self) -> &FreePlaces {
        &self.free_threads
    }

    /// Claims a bell for a callback thread that publishers wake themselves.
    ///
    /// # Errors
    /// [`TransportError::ThreadBells`] if all are taken.
    pub fn claim_thread_bell(self: &Arc<Self>) -> Result<Arc<ThreadBell>, TransportError> {
        ThreadBell::claim(self)
    }

    /// Claims a slot, clean of its previous owner's state. It is free again when the returned guard is dropped.
    ///
    /// # Real-time
    /// Wait-free, O([`SLOTS`]); no allocation; no syscall.
    ///
    /// # Errors
    /// [`TransportError::Slots`] if all are taken.
    pub fn claim(self: &Arc<Self>) -> Result<Slot, TransportError> {
        let index = self.free.take().ok_or(TransportError::Slots { limit: SLOTS })?;
        self.arena.reset(index);
        self.left[index].store(false, Ordering::Relaxed);
        Ok(Slot { doorbell: self.clone(), index, retired: AtomicBool::new(false) })
    }

    /// Claims a slot for a subscription, with memory for what it and its publishers tell each other.
    pub(crate) fn claim_with_links(self: &Arc<Self>) -> Result<Slot, TransportError> {
        let slot = self.claim()?;
        self.arena.claim_links(slot.index)?;
        Ok(slot)
    }

    /// For the janitor: whether it is to open what the owner of `slot` could not. It then sees what the owner saw.
    pub(crate) fn take_left(&self, slot: usize) -> bool {
        // Acquire: pairs with the Release of `leave_to_janitor` and `is_left_to_janitor`.
        self.left
            .get(slot)
            .is_some_and(|left| left.load(Ordering::Relaxed) && left.swap(false, Ordering::Acquire))
    }

    /// For the janitor: it could not either.
    pub(crate) fn leave_again(&self, slot: usize) {
        if let Some(left) = self.left.get(slot) {
            left.store(true, Ordering::Release);
        }
    }

    /// Claims the right to drain this doorbell and to sleep on it, which one sampler has.
    ///
    /// # Errors
    /// [`TransportError::SecondSampler`] if another one lives.
    pub fn claim_sampler(self: &Arc<Self>) -> Result<SamplerSeat, TransportError> {
        if self.sampled.swap(true, std::sync::atomic::Ordering::AcqRel) {
            return Err(TransportError::SecondSampler);
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

    /// When what `pulse` tells of happened last.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub fn pulse_ns(&self, pulse: Pulse) -> u64 {
        self.arena.pulse_ns(pulse)
    }

    /// Wakes the task registered at `slot`.
    ///
    /// # Real-time
    /// Wait-free; no allocation; a syscall if the task's thread sleeps.
    pub fn wake(&self, slot: usize) {
        if let Some(waker) = self.wakers.get(slot) {
            waker.wake();
        }
    }
}

/// The right of one sampler to drain a doorbell; free again when dropped.
pub struct SamplerSeat {
    doorbell: Arc<Doorbell>,
}

impl SamplerSeat {
    /// Takes every pending slot: wakes the task registered there and tells `each` which slot it was. Returns how many.
    ///
    /// # Real-time
    /// O(pending + 16); no allocation; a syscall for each waker whose thread sleeps.
    pub fn drain(&self, mut each: impl FnMut(usize)) -> usize {
        self.doorbell.arena.bell().drain(|index| {
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
        self.doorbell.sampled.store(false, std::sync::atomic::Ordering::Release);
    }
}

/// A claimed slot of this process's own arena.
pub struct Slot {
    doorbell: Arc<Doorbell>,
    index: usize,
    retired: AtomicBool,
}

impl Slot {
    /// Index of the slot, below [`SLOTS`].
    pub fn index(&self) -> usize {
        self.index
    }

    /// The waker that a ring of this slot wakes. Register before looking at the source.
    pub fn waker(&self) -> &AtomicWaker {
        &self.doorbell.wakers[self.index]
    }

    /// Marks this slot pending and wakes the sampler if it sleeps.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake.
    pub fn ring(&self) {
        self.doorbell.arena.bell().ring(self.index);
    }

    /// Where the time of what happened last here is kept.
    pub fn pulse(&self, of: PulseOf) -> Pulse {
        Pulse { slot: self.index, of }
    }

    /// Notes that it happened at `now_ns`.
    ///
    /// # Real-time
    /// Wait-free: one store; no syscall.
    pub fn note(&self, of: PulseOf, now_ns: u64) {
        self.doorbell.arena.set_pulse(self.pulse(of), now_ns);
    }

    /// What the slot belonged to has ended, though others still hold it: they are told.
    pub(crate) fn retire(&self) {
        self.retired.store(true, std::sync::atomic::Ordering::Release);
        self.doorbell.arena.ring_events(self.index);
    }

    pub(crate) fn is_retired(&self) -> bool {
        self.retired.load(std::sync::atomic::Ordering::Acquire)
    }

    /// The owner could not open another process's doorbell: the janitor tries again at each of its looks, says why not, and rings
    /// there.
    ///
    /// # Real-time
    /// Wait-free: one store; no syscall.
    pub(crate) fn leave_to_janitor(&self) {
        self.doorbell.left[self.index].store(true, Ordering::Release);
    }

    /// Whether that is still to come. The janitor then sees what this thread has seen.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn is_left_to_janitor(&self) -> bool {
        // It writes what it reads, for its Release.
        let left = &self.doorbell.left[self.index];
        left.compare_exchange(true, true, Ordering::AcqRel, Ordering::Relaxed).is_ok()
    }

    pub(crate) fn doorbell(&self) -> &Arc<Doorbell> {
        &self.doorbell
    }

    pub(crate) fn flags(&self) -> &Flags {
        self.doorbell.arena.flags(self.index).expect("a claimed slot is one of its arena's")
    }

    /// The epoch that others advance when the topic's participants change. Acquire: pairs with `advance_epoch`.
    pub(crate) fn epoch(&self) -> u32 {
        self.doorbell.arena.epoch(self.index).load(Ordering::Acquire)
    }
}

impl Drop for Slot {
    /// # Real-time
    /// Wait-free; no syscall. Drops the waker that is registered.
    fn drop(&mut self) {
        self.doorbell.wakers[self.index].take();
        self.doorbell.free.give_back(self.index);
    }
}

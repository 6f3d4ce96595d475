// SPDX-License-Identifier: MIT OR Apache-2.0
//! The file behind a doorbell: creating, mapping, locking and removing it; typed access to its words.

use super::SLOTS;
use super::hot::{Bell, Flags, Route, Spot};
use super::link::{LINKS, Link};
use crate::error::TransportError;
use crate::header::Gid;
use crate::sync::{AtomicU32, AtomicU64, FutexWord, Ordering, fence};
use std::fmt;
use std::io;
use std::mem::offset_of;
use std::path::{Path, PathBuf};
use tautline_rt::shm::{self, Mapping, OwnFile, PeerFile, ShmError};

const MAGIC: u64 = u64::from_le_bytes(*b"tautline");
const VERSION: u32 = 4;

/// Identifies an arena among all of a domain. Random: process ids repeat, and containers share `/dev/shm`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct ArenaId(pub(crate) u64);

impl fmt::Display for ArenaId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

/// Who sleeps on a bell of an arena.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sleeper {
    Sampler,
    /// The callback thread with this bell.
    Thread(usize),
}

/// What lies in the file. Every field is an atomic whose zero is a valid idle state, so fresh pages need no set-up, and
/// whatever another process writes is a value, never undefined behaviour.
#[repr(C)]
struct Layout {
    magic: AtomicU64,
    version: AtomicU32,
    janitor: FutexWord,
    bell: Bell,
    threads: [Bell<1>; THREADS],
    slots: [SlotWords; SLOTS],
    links: [[Link; LINKS]; SLOTS],
}

#[repr(C)]
struct SlotWords {
    flags: Flags,
    epoch: AtomicU32,
    /// The slot that is rung besides when the epoch advances, and 1: that of the events of what is here. 0: there is none.
    events: AtomicU32,
    /// Which bell publishers ring for what is here.
    route: Route,
    /// See [`Pulse`].
    pulses: [AtomicU64; PULSES],
}

const PULSES: usize = 2;

/// Callback threads of a context that publishers can wake themselves.
pub(crate) const THREADS: usize = 128;

/// Where the time of what happened last is kept: which slot's, and of what. What it says is in `CLOCK_MONOTONIC` nanoseconds;
/// 0 is never.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pulse {
    pub(crate) slot: usize,
    pub(crate) of: PulseOf,
}

/// What a [`Pulse`] tells of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PulseOf {
    /// A sample was published by this publisher, or for this subscription.
    Sample,
    /// This publisher showed that it is alive.
    Liveliness,
}

impl Pulse {
    /// The pulse as one number that is not 0.
    pub fn to_word(self) -> u64 {
        (self.slot * PULSES + self.of as usize) as u64 + 1
    }

    /// The pulse of a number that [`to_word`](Self::to_word) gave.
    pub fn from_word(word: u64) -> Option<Self> {
        let index = usize::try_from(word.checked_sub(1)?).ok()?;
        let of = if index % PULSES == 0 { PulseOf::Sample } else { PulseOf::Liveliness };
        Some(Pulse { slot: index / PULSES, of })
    }
}

/// A mapped arena: this process's own, or a peer's. Unmapped when dropped; the owner's file is removed as well.
pub(crate) struct Arena {
    id: ArenaId,
    map: Mapping,
    /// The owner's; a peer needs no descriptor.
    own: Option<OwnFile>,
}

impl Arena {
    /// Claims memory for all but the links, which most slots never have: see [`claim_links`](Self::claim_links).
    pub(crate) fn create(domain: u32) -> Result<Self, TransportError> {
        let own = OwnFile::create(&file_prefix(domain)).map_err(arena_error)?;
        let make = || -> Result<Mapping, ShmError> {
            own.set_len(size_of::<Layout>() as u64)?;
            own.claim(0, offset_of!(Layout, links) as u64)?;
            map(&own).map_err(|source| ShmError { path: own.path().to_owned(), source })
        };
        let map = match make() {
            Ok(map) => map,
            Err(error) => {
                own.retire();
                return Err(arena_error(error));
            }
        };
        let arena = Arena { id: ArenaId(own.id()), map, own: Some(own) };
        arena.layout().version.store(VERSION, Ordering::Relaxed);
        // Release: pairs with the Acquire in `open`; the version is there when the magic is.
        arena.layout().magic.store(MAGIC, Ordering::Release);
        Ok(arena)
    }

    /// Maps a peer's arena. What it holds are claims: indices are checked wherever they are used.
    pub(crate) fn open(domain: u32, id: ArenaId) -> Result<Self, TransportError> {
        let file = PeerFile::open(path(domain, id), true).map_err(arena_error)?;
        let named = || file.path().to_owned();
        if file.size_bytes().map_err(arena_error)? < size_of::<Layout>() as u64 {
            return Err(TransportError::ArenaVersion { path: named() });
        }
        let map = map(&file).map_err(|source| TransportError::Arena { path: named(), source })?;
        let arena = Arena { id, map, own: None };
        let layout = arena.layout();
        if layout.magic.load(Ordering::Acquire) != MAGIC || layout.version.load(Ordering::Relaxed) != VERSION
        {
            return Err(TransportError::ArenaVersion { path: named() });
        }
        Ok(arena)
    }

    /// Gives a slot of this process's own arena memory for its links, and makes these look never used. Without it they are not to
    /// be touched: where /dev/shm is full, that kills the process.
    pub(crate) fn claim_links(&self, slot: usize) -> Result<(), TransportError> {
        if let Some(own) = &self.own {
            let links = size_of::<[Link; LINKS]>();
            let start = offset_of!(Layout, links) + slot * links;
            own.claim(start as u64, links as u64).map_err(arena_error)?;
        }
        self.links(slot).iter().for_each(Link::reset);
        Ok(())
    }

    pub(crate) fn id(&self) -> ArenaId {
        self.id
    }

    fn layout(&self) -> &Layout {
        // SAFETY: `map` is a live mapping of size_of::<Layout>() bytes of a file that is at least as long, page-aligned, and
        // every bit pattern of a Layout is valid (atomics only).
        unsafe { self.map.start().cast().as_ref() }
    }

    pub(crate) fn bell(&self) -> &Bell {
        &self.layout().bell
    }

    /// The word on which this process's janitor sleeps.
    pub(crate) fn janitor(&self) -> &FutexWord {
        &self.layout().janitor
    }

    /// Asks the owner's janitor to look after its topics now.
    pub(crate) fn call_janitor(&self) {
        self.janitor().0.fetch_add(1, Ordering::Release);
        self.janitor().wake();
    }

    /// The bell of a callback thread; none if a peer's claim is no thread.
    pub(crate) fn thread_bell(&self, thread: usize) -> Option<&Bell<1>> {
        self.layout().threads.get(thread)
    }

    /// Finishes the rings of processes that were killed within them.
    ///
    /// # Real-time
    /// For a low-priority thread, now and then.
    pub(crate) fn rescue(&self) {
        self.bell().rescue();
        self.layout().threads.iter().for_each(Bell::rescue);
    }

    /// Marks the sample that was just queued at the subscription behind `slot`, if it wants to be rung for it. Returns which bell's
    /// sleeper [`wake`](Self::wake) is to wake, after a sequentially consistent fence.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn mark_sample(&self, slot: usize) -> Option<Sleeper> {
        let words = self.layout().slots.get(slot).filter(|words| words.flags.wants_ring())?;
        Some(match words.route.get() {
            None => {
                self.bell().mark(slot);
                Sleeper::Sampler
            }
            Some(Spot { thread, bit }) => {
                self.thread_bell(thread)?.mark(bit);
                Sleeper::Thread(thread)
            }
        })
    }

    /// Wakes whoever sleeps on a bell that was marked.
    ///
    /// # Real-time
    /// Wait-free; at most one futex wake.
    pub(crate) fn wake(&self, sleeper: Sleeper) {
        match sleeper {
            Sleeper::Sampler => self.bell().wake_if_sleeping(),
            Sleeper::Thread(thread) => {
                if let Some(bell) = self.thread_bell(thread) {
                    bell.wake_if_sleeping();
                }
            }
        }
    }

    /// Which bell publishers ring for what is behind `slot`.
    ///
    /// # Panics
    /// If `slot` is not below [`SLOTS`].
    pub(crate) fn route(&self, slot: usize) -> &Route {
        &self.layout().slots[slot].route
    }

    /// A slot's flags; none if a peer's claim is no slot.
    pub(crate) fn flags(&self, slot: usize) -> Option<&Flags> {
        self.layout().slots.get(slot).map(|words| &words.flags)
    }

    /// # Panics
    /// If `slot` is not below [`SLOTS`]: check a claim first.
    pub(crate) fn epoch(&self, slot: usize) -> &AtomicU32 {
        &self.layout().slots[slot].epoch
    }

    /// Tells what is behind `slot`, and its events, that its topic's participants changed.
    pub(crate) fn advance_epoch(&self, slot: usize) {
        if let Some(words) = self.layout().slots.get(slot) {
            words.epoch.fetch_add(1, Ordering::Release);
        }
        self.ring_events(slot);
    }

    /// Rings the events of what is behind `slot`, if somebody wants to know of them.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake, and none if nobody wants to know.
    pub(crate) fn ring_events(&self, slot: usize) {
        // What happened is visible before the word is read: whoever sets it either is rung or sees it.
        fence(Ordering::SeqCst);
        let events = self.layout().slots.get(slot).map_or(0, |words| words.events.load(Ordering::Relaxed));
        if events != 0 {
            self.bell().ring(events as usize - 1);
        }
    }

    /// The slot to ring for the events of what is behind `slot`. The caller looks for what happened before after this.
    pub(crate) fn set_events(&self, slot: usize, events: usize) {
        self.layout().slots[slot].events.store(events as u32 + 1, Ordering::Relaxed);
        fence(Ordering::SeqCst);
    }

    /// Nobody wants to know of the events any more, unless another one does by now.
    pub(crate) fn clear_events(&self, slot: usize, events: usize) {
        let word = &self.layout().slots[slot].events;
        let _ = word.compare_exchange(events as u32 + 1, 0, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// Notes when something happened last.
    ///
    /// # Real-time
    /// Wait-free: one store; no syscall.
    pub(crate) fn set_pulse(&self, pulse: Pulse, now_ns: u64) {
        if let Some(words) = self.layout().slots.get(pulse.slot) {
            words.pulses[pulse.of as usize].store(now_ns, Ordering::Relaxed);
        }
    }

    pub(crate) fn pulse_ns(&self, pulse: Pulse) -> u64 {
        let words = self.layout().slots.get(pulse.slot);
        words.map_or(0, |words| words.pulses[pulse.of as usize].load(Ordering::Relaxed))
    }

    pub(crate) fn links(&self, slot: usize) -> &[Link] {
        self.layout().links.get(slot).map_or(&[], |links| links)
    }

    /// Claims a link of the subscription behind `slot` for a publisher; `None` if all are taken.
    pub(crate) fn claim_link(
        &self,
        slot: usize,
        gid: Gid,
        start: u64,
        waiter: (ArenaId, usize),
    ) -> Option<usize> {
        Link::claim_one_of(self.links(slot), gid, start, waiter)
    }

    /// Makes a slot look never used, but for its links.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn reset(&self, slot: usize) {
        let words = &self.layout().slots[slot];
        words.flags.set(0);
        words.route.set(None);
        words.events.store(0, Ordering::Relaxed);
        words.pulses.iter().for_each(|pulse| pulse.store(0, Ordering::Relaxed));
    }
}

impl Drop for Arena {
    fn drop(&mut self) {
        if let Some(own) = &self.own {
            own.retire();
        }
    }
}

/// Removes the arenas of `domain` whose owners died.
pub(crate) fn remove_stale_arenas(domain: u32) {
    let paths = shm::list(&file_prefix(domain)).unwrap_or_default();
    for file in paths.into_iter().filter_map(|path| PeerFile::open(path, true).ok()) {
        file.remove_if_orphaned();
    }
}

fn arena_error(ShmError { path, source }: ShmError) -> TransportError {
    TransportError::Arena { path, source }
}

fn map(file: impl std::os::fd::AsFd) -> io::Result<Mapping> {
    Mapping::new(file, 0, size_of::<Layout>(), true)
}

fn path(domain: u32, id: ArenaId) -> PathBuf {
    Path::new(shm::DIRECTORY).join(format!("{}{id}", file_prefix(domain)))
}

fn file_prefix(domain: u32) -> String {
    format!("{}arena_", crate::participant::file_prefix(domain))
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    const DOMAIN: u32 = 116;

    #[test]
    fn a_file_that_is_no_arena_is_refused() {
        for len_bytes in [16, size_of::<Layout>() as u64] {
            let file = OwnFile::create(&file_prefix(DOMAIN)).unwrap();
            file.set_len(len_bytes).unwrap();
            let refused = Arena::open(DOMAIN, ArenaId(file.id())).err();
            file.retire();
            let refused = refused.map(|error| error.to_string()).unwrap_or_default();
            assert!(refused.ends_with("use the same one in all processes"), "{len_bytes} bytes: {refused}");
        }
    }

    #[test]
    fn indices_from_other_processes_are_harmless() {
        let arena = Arena::create(DOMAIN).unwrap();
        arena.bell().ring(SLOTS);
        arena.advance_epoch(SLOTS);
        assert!(!arena.bell().is_pending());
        assert!(arena.flags(SLOTS).is_none() && arena.links(usize::MAX).is_empty());
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The file behind a doorbell: creating, mapping, locking and removing it; typed access to its words.

use super::SLOTS;
use super::hot::{Bell, Flags, Route, Spot};
use crate::error::TransportError;
use crate::header::Gid;
use crate::sync::{AtomicU32, AtomicU64, FutexWord, Ordering, fence};
use std::fmt;
use std::io;
use std::mem::offset_of;
use std::path::{Path, PathBuf};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::shm::{self, Mapping, OwnFile, PeerFile, ShmError};

/// Publishers that one subscription can tell apart: the most publishers of a topic.
pub(crate) const LINKS: usize = 64;
const MAGIC: u64 = u64::from_le_bytes(*b"tautline");
const VERSION: u32 = 4;

/// Owner word of a link nobody uses.
const FREE: u64 = 0;
/// Owner word of a link whose publisher has ended; its numbers stay until the subscription has settled them.
const ENDED: u64 = 1;

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

/// One publisher seen from one subscription. Two cache lines, one for each writer.
#[repr(C)]
pub(crate) struct Link {
    pub(crate) out: LinkOut,
    pub(crate) taken: Taken,
}

/// Written by the publisher.
#[repr(C, align(64))]
pub(crate) struct LinkOut {
    owner: AtomicU64,
    gid: [AtomicU64; 2],
    start: AtomicU64,
    pub(crate) sent: AtomicU64,
    waiter_arena: AtomicU64,
    waiter_slot: AtomicU32,
    pub(crate) waiting: AtomicU32,
    /// When it last showed that it is alive; [`KILLED`] once it was found dead.
    pub(crate) alive_ns: AtomicU64,
}

/// Where the count of a publisher starts whose samples are not for the subscription: one that does not fit it.
pub(crate) const NONE_FOR_IT: u64 = u64::MAX;

/// What `alive_ns` says of a publisher that ended without a word.
pub(crate) const KILLED: u64 = 0;

/// Written by the subscription: the sequence number it took last.
#[repr(C, align(64))]
pub(crate) struct Taken(pub(crate) AtomicU64);

impl Link {
    /// Claims the link, if its owner word is `from`, for a publisher whose next sample will be number `start`, or
    /// [`NONE_FOR_IT`].
    fn claim(&self, from: u64, gid: Gid, start: u64, waiter: (ArenaId, usize)) -> bool {
        if !self.begin_claim(from, Owner::of(gid)) {
            return false;
        }
        let [low, high] = gid.words();
        self.out.start.store(start, Ordering::Relaxed);
        self.out.sent.store(start.saturating_sub(1), Ordering::Relaxed);
        self.taken.0.store(start.saturating_sub(1), Ordering::Relaxed);
        self.out.waiting.store(0, Ordering::Relaxed);
        self.out.alive_ns.store(monotonic_ns(), Ordering::Relaxed);
        self.out.waiter_arena.store(waiter.0.0, Ordering::Relaxed);
        self.out.waiter_slot.store(waiter.1 as u32, Ordering::Relaxed);
        self.out.gid[0].store(low, Ordering::Relaxed);
        // Release: pairs with the Acquire in `gid`; who reads this gid reads this claim's start.
        self.out.gid[1].store(high, Ordering::Release);
        true
    }

    /// The first step: nobody's until the claim is complete. Should this process be killed within, the numbers are no publisher's:
    /// see [`is_incomplete`](Self::is_incomplete).
    fn begin_claim(&self, from: u64, owner: Owner) -> bool {
        if self.out.owner.compare_exchange(from, owner.0, Ordering::AcqRel, Ordering::Relaxed).is_err() {
            return false;
        }
        self.out.gid[1].store(0, Ordering::Relaxed);
        self.out.gid[0].store(0, Ordering::Release);
        true
    }

    pub(crate) fn gid(&self) -> Gid {
        let high = self.out.gid[1].load(Ordering::Acquire);
        Gid::from_words([self.out.gid[0].load(Ordering::Relaxed), high])
    }

    pub(crate) fn start(&self) -> u64 {
        self.out.start.load(Ordering::Relaxed)
    }

    pub(crate) fn waiter(&self) -> (ArenaId, usize) {
        let arena = ArenaId(self.out.waiter_arena.load(Ordering::Relaxed));
        (arena, self.out.waiter_slot.load(Ordering::Relaxed) as usize)
    }

    /// The publisher `owner` ends, or was killed. Its numbers stay, so that samples still queued are counted rightly. Does nothing if the
    /// link is another's by now: a publisher may learn late that a subscription went, and its slot was claimed again.
    pub(crate) fn release(&self, owner: Owner) {
        let _ = self.out.owner.compare_exchange(owner.0, ENDED, Ordering::Release, Ordering::Relaxed);
    }

    /// The publisher `owner` was killed.
    pub(crate) fn release_killed(&self, owner: Owner) {
        if self.owner() == Some(owner) {
            self.out.alive_ns.store(KILLED, Ordering::Relaxed);
            self.release(owner);
        }
    }

    /// Whose the link is, if a publisher claimed it. Not its gid: that comes after the claim, and perhaps never.
    pub(crate) fn owner(&self) -> Option<Owner> {
        let owner = self.out.owner.load(Ordering::Acquire);
        (owner > ENDED).then_some(Owner(owner))
    }

    pub(crate) fn is_claimed(&self) -> bool {
        self.out.owner.load(Ordering::Acquire) > ENDED
    }

    /// Whether the publisher has ended and the subscription has not settled what it sent.
    pub(crate) fn has_ended(&self) -> bool {
        // Acquire: pairs with the Release in `release`; the publisher's last numbers are seen.
        self.out.owner.load(Ordering::Acquire) == ENDED
    }

    /// Whether a claim was begun and its end is not seen: one of the gid's words is 0, as no publisher's is. If the link has ended
    /// by now, the claimer was killed, and what else stands here is of the publisher before it.
    pub(crate) fn is_incomplete(&self) -> bool {
        self.gid().words().contains(&0)
    }

    /// The subscription has settled what the ended publisher `gid` sent.
    pub(crate) fn settle(&self, gid: Gid) {
        if self.gid() == gid {
            let _ = self.out.owner.compare_exchange(ENDED, FREE, Ordering::AcqRel, Ordering::Relaxed);
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
impl Link {
    /// A publisher that is killed while it claims the link.
    pub(crate) fn claim_and_die(&self, gid: Gid) -> Owner {
        let owner = Owner::of(gid);
        assert!(self.begin_claim(FREE, owner));
        owner
    }
}

/// Who claimed a link: a word made of all of a publisher's gid. Those of gids that have one half in common differ; else two are the
/// same by a chance of 1 in 2^64.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Owner(u64);

impl Owner {
    pub(crate) fn of(gid: Gid) -> Self {
        let [low, high] = gid.words();
        match mixed(mixed(low) ^ high) {
            reserved @ (FREE | ENDED) => Owner(!reserved),
            owner => Owner(owner),
        }
    }
}

/// One to one, and each bit depends on all: the last steps of SplitMix64 (Steele, Lea, Flood, 2014).
const fn mixed(word: u64) -> u64 {
    let word = (word ^ word >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let word = (word ^ word >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ word >> 31
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
        self.reset_links(slot);
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
        let claim = |from| self.links(slot).iter().position(|link| link.claim(from, gid, start, waiter));
        // Of a subscription that never takes, links of ended publishers are never settled: better uncounted than none.
        claim(FREE).or_else(|| claim(ENDED))
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

    fn reset_links(&self, slot: usize) {
        for link in self.links(slot).iter().filter(|link| link.out.owner.load(Ordering::Relaxed) != FREE) {
            link.out.gid[0].store(0, Ordering::Relaxed);
            link.out.gid[1].store(0, Ordering::Relaxed);
            link.out.owner.store(FREE, Ordering::Release);
        }
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
    fn a_link_is_released_by_its_owner_alone() {
        let arena = Arena::create(DOMAIN).unwrap();
        let (old, new, third) = (Gid([4; 16]), Gid([8; 16]), Gid([12; 16]));
        assert_eq!(arena.claim_link(0, old, 1, (arena.id(), 7)), Some(0));
        // The subscription behind the slot goes, another comes, and a publisher matches it before `old` has noticed.
        arena.reset_links(0);
        assert_eq!(arena.claim_link(0, new, 5, (arena.id(), 8)), Some(0));
        let link = &arena.links(0)[0];
        link.release(Owner::of(old));
        assert!(link.is_claimed());
        assert_eq!(arena.claim_link(0, third, 1, (arena.id(), 9)), Some(1));
        link.release(Owner::of(new));
        assert!(!link.is_claimed());
        assert_eq!((link.gid(), link.start()), (new, 5), "readable until it is claimed again");
    }

    #[test]
    fn owners_whose_gids_share_a_half_differ() {
        let of = |low: u64, high: u64| Owner::of(Gid::from_words([low, high]));
        // Seconds and nanoseconds below, process and counter above, as iceoryx2 numbers its ports.
        let (time, process) = (17_u64 | 123_456_789 << 32, 4242_u64 | 5 << 32);
        for bit in 0..64 {
            assert_ne!(of(time, process), of(time ^ 1 << bit, process), "bit {bit} of the low half");
            assert_ne!(of(time, process), of(time, process ^ 1 << bit), "bit {bit} of the high half");
        }
        let owners: Vec<_> =
            (0..100).flat_map(|n| [of(time, process + (n << 32)), of(time + n + 1, process)]).collect();
        let is_twice = |(index, owner): (usize, &Owner)| owners[..index].contains(owner);
        assert!(!owners.iter().enumerate().any(is_twice));
        assert!(of(0, 0).0 > ENDED, "what mixes to a reserved value is moved away from it");
    }

    #[test]
    fn a_publisher_of_the_same_instant_does_not_release_anothers_link() {
        let arena = Arena::create(DOMAIN).unwrap();
        let gid = |counter: u64| Gid::from_words([7, 4242 | counter << 32]);
        let (old, new) = (gid(1), gid(2));
        assert_eq!(arena.claim_link(0, old, 1, (arena.id(), 7)), Some(0));
        arena.reset_links(0);
        assert_eq!(arena.claim_link(0, new, 5, (arena.id(), 8)), Some(0));
        let link = &arena.links(0)[0];
        link.release(Owner::of(old));
        link.release_killed(Owner::of(old));
        assert!(link.is_claimed() && link.owner() == Some(Owner::of(new)));
    }

    #[test]
    fn all_links_taken() {
        let arena = Arena::create(DOMAIN).unwrap();
        for n in 0..LINKS {
            assert_eq!(arena.claim_link(3, Gid([4 * n as u8; 16]), 1, (arena.id(), 0)), Some(n));
        }
        assert_eq!(arena.claim_link(3, Gid([255; 16]), 1, (arena.id(), 0)), None);
    }

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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reader proxies: one subscription as its publisher sees it, and the table of all subscriptions.
//!
//! Setup code adds and removes subscriptions under the publisher's setup lock. The thread that publishes takes no lock: it finds a new
//! table ([`ReaderTable`]) when it next publishes. A sender's [`HandOver`] states who may use its sending half (the publisher's end of the
//! queues, and the list of samples in use). Setup code holds a new one if the publisher has meanwhile published something that a late
//! joiner must get; a retired one is drained by its present owner.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::graph::record::PortRecord;
use crate::memory::connection::{Block, Connection, Out, Shape, UNLOOKED};
use crate::memory::control::ConnectionPlace;
use crate::memory::file::ArenaOwner;
use crate::memory::header::Gid;
use crate::memory::pool::Pool;
use crate::qos::History as KeepWhat;
use crate::topic::chunks::{Chunks, Keyed};
use crate::topic::hand_over::HandOver;
use crate::topic::writer::history::History;
use core::cell::UnsafeCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use tautline_doorbell::{Activity, ActivityKind, Flags, Sleeper};
use tautline_rt::{LatestReader, clock::monotonic_ns, full_fence};

/// What a publisher knows about a subscription.
pub(crate) struct ReaderChannel {
    pub(crate) subscription: Gid,
    pub(crate) depth: u64,
    /// The number of samples for which its queues have memory (of the longer queue).
    places: usize,
    /// A publisher that keeps all must not overwrite in its queue.
    pub(crate) keeps_all: bool,
    /// It is an observer: it also gets samples that are sent to one subscription only, and the publisher
    /// never waits for it.
    pub(crate) is_observer: bool,
    /// For a client's responses: the number of the port of its requests.
    pub(crate) partner: Option<u64>,
    owner: ArenaOwner,
    slot: usize,
    /// It belongs to the publisher's participant.
    is_own: bool,
    connection: Connection,
    turn: HandOver,
    /// The subscription has ended, and some of its samples are still in use.
    leaving: AtomicBool,
    /// The number of the last sample that was preloaded; `u64::MAX` if it gets no sample that was published before.
    loaded: AtomicU64,
    /// The capacity of the list of samples in use.
    room: AtomicUsize,
    half: UnsafeCell<SendHalf>,
}

struct SendHalf {
    /// The samples that were submitted and not returned yet: one bit for each number.
    out: Box<[u64]>,
    /// The number of the last sample that was submitted, or that existed when it was preloaded.
    last: u64,
    /// It gets the samples kept for late joiners.
    wants_history: bool,
    submitted: u64,
    /// The number of loans since its returned samples were last taken back.
    unlooked: usize,
    /// The number of the last sample that the subscription had taken when that was last read.
    taken: u64,
    /// The number of samples for which the queues' memory is claimed, if it is claimed on use.
    claimed: usize,
    /// The sleeper to wake for the sample that is being published.
    sleeper: Option<Sleeper>,
}

// SAFETY: `half` is used by one side at a time: `turn` says whose it is, and hands it over with Release and Acquire. The rest is
// atomics and what does not change.
unsafe impl Sync for ReaderChannel {}
// SAFETY: as above; nothing in it belongs to a thread.
unsafe impl Send for ReaderChannel {}

/// A subscription that is connected.
#[derive(Clone)]
pub(super) struct ReaderProxy {
    pub(super) subscription: Gid,
    pub(super) sender: Arc<ReaderChannel>,
    pub(super) place: ConnectionPlace,
    /// A longer list for the publishing thread to take, if it has not done so.
    pub(super) spare: Option<Arc<SpareList>>,
}

impl Keyed for ReaderProxy {
    fn key(&self) -> Gid {
        self.subscription
    }
}

/// The working table of the publishing thread: replaced when subscriptions or segments are added or removed.
pub(crate) struct ReaderTable {
    /// Grouped by participant.
    pub(super) proxies: Chunks<ReaderProxy>,
    /// With the list of free samples.
    pub(crate) pool: Pool,
    /// Whether memory of queues is claimed on use.
    pub(crate) claims_on_use: bool,
}

/// A longer list of samples in use for the thread that publishes, which leaves its former list there.
pub(crate) struct SpareList {
    list: UnsafeCell<Box<[u64]>>,
}

// SAFETY: `list` is touched by the thread that publishes alone.
unsafe impl Sync for SpareList {}

impl SpareList {
    #[allow(clippy::disallowed_macros, reason = "set-up")]
    pub(crate) fn new(words: usize) -> Self {
        SpareList { list: UnsafeCell::new(vec![0; words].into_boxed_slice()) }
    }
}

/// The memory of queues is claimed for this many more samples at once, and then up to the end of a page.
const CLAIMED_AT_ONCE: usize = 512;

/// Samples of up to this size do not displace each other from the caches if some more of them are in use; longer ones are taken back with
/// each loan.
const SMALL_BYTES: usize = 1 << 10;

/// The number of words in a list of this many samples.
pub(crate) fn words_for(samples: usize) -> usize {
    samples.div_ceil(64)
}

impl ReaderChannel {
    #[allow(clippy::too_many_arguments, clippy::disallowed_macros, reason = "set-up")]
    pub(crate) fn new(
        subscription: Gid,
        is_own: bool,
        shape: Shape,
        port: &PortRecord,
        (owner, slot): (ArenaOwner, usize),
        connection: Connection,
        samples: usize,
    ) -> Self {
        connection.block().out.alive_ns.store(monotonic_ns(), Ordering::Relaxed);
        let out = vec![0; words_for(samples)].into_boxed_slice();
        let half = SendHalf {
            out,
            last: 0,
            wants_history: false,
            submitted: 0,
            // Staggered, so that not all subscriptions are looked at with the same loan.
            unlooked: subscription.number() as usize % UNLOOKED,
            taken: 0,
            claimed: 0,
            sleeper: None,
        };
        ReaderChannel {
            subscription,
            depth: shape.depth as u64,
            places: shape.returned_len(),
            keeps_all: port.qos.qos().history == KeepWhat::KeepAll,
            is_observer: port.observer,
            partner: port.partner,
            owner,
            slot,
            is_own,
            connection,
            turn: HandOver::new(),
            leaving: AtomicBool::new(false),
            loaded: AtomicU64::new(u64::MAX),
            room: AtomicUsize::new(words_for(samples) * 64),
            half: UnsafeCell::new(half),
        }
    }

    pub(crate) fn block(&self) -> &Block {
        self.connection.block()
    }

    #[cfg(all(test, not(taut_loom)))]
    pub(crate) fn samples_out(&self) -> u32 {
        // SAFETY: tests call this in the thread that publishes.
        unsafe { &*self.half.get() }.out.iter().map(|bits| bits.count_ones()).sum()
    }

    pub(crate) fn connection(&self) -> &Connection {
        &self.connection
    }

    pub(crate) fn room(&self) -> usize {
        self.room.load(Ordering::Acquire)
    }

    pub(crate) fn process(&self) -> u32 {
        match &self.owner {
            ArenaOwner::Own(_) => std::process::id(),
            ArenaOwner::Peer(peer) => peer.pid(),
        }
    }

    fn flags(&self) -> Option<&Flags> {
        self.owner.arena().flags(self.slot)
    }

    /// Whether its sending half belongs to the publishing thread; also true for a leaving subscription, to which no samples go.
    pub(crate) fn is_live(&self) -> bool {
        self.turn.is_live()
    }

    /// Whether it was retired and setup may forget it.
    pub(crate) fn is_drained(&self) -> bool {
        self.turn.is_done()
    }

    pub(crate) fn is_retired(&self) -> bool {
        self.turn.is_retired()
    }

    /// Setup: marks that the subscription has gone, and that some of its samples are still in use.
    pub(crate) fn leave(&self) {
        self.leaving.store(true, Ordering::Release);
    }

    pub(crate) fn is_leaving(&self) -> bool {
        self.leaving.load(Ordering::Relaxed) && !self.is_retired()
    }

    /// Setup: retires a subscription that has gone. Its samples are released at once if the publishing thread has not adopted it, otherwise
    /// when that thread next publishes. Returns false if it was retired before.
    pub(crate) fn retire(&self, pool: &Pool) -> bool {
        let retired = self.turn.retire();
        if retired.is_setups {
            // SAFETY: it was setup's, and stays so.
            unsafe { self.drain(pool) };
        }
        retired.is_first
    }

    /// Setup: as [`retire`](Self::retire), when no thread publishes any more.
    pub(crate) fn retire_finally(&self, pool: &Pool) -> bool {
        let retired = self.turn.retire_finally();
        if retired.is_setups {
            // SAFETY: nobody publishes.
            unsafe { self.drain(pool) };
        }
        retired.is_first
    }

    /// Releases every sample in use.
    ///
    /// # Safety
    /// The caller owns the sending half.
    unsafe fn drain(&self, pool: &Pool) {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        for (word, bits) in half.out.iter_mut().enumerate() {
            while *bits != 0 {
                let number = word * 64 + bits.trailing_zeros() as usize;
                *bits &= *bits - 1;
                pool.release_number(number);
            }
        }
    }

    /// The number of the next sample, where each subscription has its own numbers.
    ///
    /// # Safety
    /// The caller owns the sending half.
    pub(crate) unsafe fn next_own(&self) -> u64 {
        // SAFETY: as the caller promises.
        unsafe { (*self.half.get()).last + 1 }
    }

    /// Submits a sample; the oldest comes back if the queue is full.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Safety
    /// The caller owns the sending half. The sample has a reference for this.
    pub(crate) unsafe fn submit(&self, number: u64, chunk: u64, pool: &Pool) {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        let block = self.connection.block();
        if block.out.start.load(Ordering::Relaxed) == 0 {
            block.out.start.store(number, Ordering::Relaxed);
        }
        block.out.sent.store(number, Ordering::Relaxed);
        half.last = number;
        half.submitted += 1;
        if let Some((segment, index)) = pool.find(chunk) {
            set(&mut half.out, segment.number(index), true);
        }
        // SAFETY: the sending half.
        if let Some(oldest) = unsafe { self.connection.submit(chunk) } {
            let overwritten = &block.out.overwritten;
            // The subscription's process can write there, too.
            overwritten.store(overwritten.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
            release(&mut half.out, oldest, pool);
        }
    }

    /// Takes back what the subscription has returned, `most` samples at most.
    ///
    /// # Real-time
    /// Wait-free, O(min(most, depth + held + loans)); no allocation; no syscall.
    ///
    /// # Safety
    /// The caller owns the sending half.
    unsafe fn reclaim(&self, most: usize, pool: &Pool) {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        // At most as many as there can be: more would be another process's false claim.
        for _ in 0..most.min(half.out.len() * 64 + 1) {
            // SAFETY: the sending half.
            let Some(chunk) = (unsafe { self.connection.take_back() }) else { return };
            release(&mut half.out, chunk, pool);
        }
    }

    /// Whether its queue has room for one more sample. If it has none and the subscription `is_asked`, the subscription rings when it has.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    ///
    /// # Safety
    /// The caller owns the sending half.
    pub(crate) unsafe fn has_room(&self, is_asked: bool) -> bool {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        let (Out { start, sent, .. }, back) = (&self.block().out, &self.block().back);
        let sent = sent.load(Ordering::Relaxed);
        // Until the first take `taken` is 0: then the samples before the first one of this queue do not count.
        let before = start.load(Ordering::Relaxed).saturating_sub(1);
        let is_full = |taken: u64| sent != 0 && sent.saturating_sub(taken.max(before)) >= self.depth;
        // `taken` is read again only if the queue seems full: each read disturbs the subscription.
        if !is_full(half.taken) {
            return true;
        }
        let mut is_full_now = || {
            // Acquire: pairs with the Release of the subscription's take.
            half.taken = back.taken.load(Ordering::Acquire);
            is_full(half.taken)
        };
        !is_full_now() || is_asked && !back.room.request(is_full_now)
    }

    /// Records the time of a sample for a subscription that has a deadline.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn note_sample(&self, now_ns: u64) {
        if !self.is_observer && self.flags().is_some_and(Flags::has_deadline) {
            self.owner.arena().set_activity(Activity { slot: self.slot, kind: ActivityKind::Sample }, now_ns);
        }
    }

    /// Has `claim` claim the memory of the queues for as many samples as will have gone through after the next one, unless that was done.
    /// Returns false if there is no memory.
    ///
    /// # Safety
    /// The caller owns the sending half.
    pub(crate) unsafe fn claim(&self, claim: impl FnOnce(usize) -> bool) -> bool {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        let needed = half.submitted as usize + 1;
        if needed <= half.claimed {
            return true;
        }
        // A page of each queue at a time.
        let wanted = needed.saturating_add(CLAIMED_AT_ONCE);
        let is_claimed = claim(wanted);
        if is_claimed {
            half.claimed = if wanted >= self.places { usize::MAX } else { wanted };
        }
        is_claimed
    }

    /// Setup: gives a new subscription the newest `depth` samples kept for late joiners, unless it has them. `None`: it belongs to the
    /// publishing thread by now, which does the same. True if there was a sample to give.
    pub(crate) fn preload(&self, history: &History, published: u64, pool: &Pool) -> Option<bool> {
        if !self.turn.hold() {
            return None;
        }
        // SAFETY: it is this function's until it is given back.
        let last = unsafe { (*self.half.get()).last };
        let mut count = 0;
        history.each_kept(last, published, self.depth, pool, |number, chunk| {
            // SAFETY: as above; `each_kept` has pinned the sample.
            unsafe { self.submit(number, chunk, pool) };
            count += 1;
        });
        // SAFETY: as above. A sample that was not found was overwritten meanwhile: it is lost, or a newer one comes in its place.
        unsafe { (*self.half.get()).last = last.max(published) };
        // SAFETY: as above.
        unsafe { (*self.half.get()).wants_history = true };
        self.loaded.store(published, Ordering::Relaxed);
        self.turn.give_back();
        Some(count > 0)
    }

    /// Setup: makes the list of samples in use longer. Returns false if it belongs to the publishing thread.
    #[allow(clippy::disallowed_macros, reason = "set-up")]
    pub(crate) fn enlarge(&self, words: usize) -> bool {
        if !self.turn.hold() {
            return false;
        }
        // SAFETY: it is this function's until it is given back.
        unsafe { (*self.half.get()).enlarge(&mut vec![0; words].into_boxed_slice()) };
        self.room.store(words * 64, Ordering::Release);
        self.turn.give_back();
        true
    }

    /// Setup: whether it is new, gets the samples kept for late joiners, and does not have all of them.
    pub(crate) fn lacks(&self, published: u64) -> bool {
        self.turn.is_new() && self.loaded.load(Ordering::Relaxed) < published
    }

    /// Rings the subscription, after it was [preloaded](Self::preload).
    pub(crate) fn ring(&self) {
        self.owner.arena().ring(self.slot);
    }
}

impl SendHalf {
    /// Takes a longer list in place of its own, and leaves its own in `longer`.
    fn enlarge(&mut self, longer: &mut Box<[u64]>) {
        if longer.len() > self.out.len() {
            longer.iter_mut().zip(&self.out).for_each(|(new, old)| *new = *old);
            core::mem::swap(longer, &mut self.out);
        }
    }
}

fn set(out: &mut [u64], number: usize, is_out: bool) -> bool {
    let Some(word) = out.get_mut(number / 64) else { return false };
    let (bit, before) = (1 << (number % 64), *word);
    *word = if is_out { before | bit } else { before & !bit };
    before & bit != 0
}

/// Releases the reference to a sample that came back, if it was in use.
fn release(out: &mut [u64], chunk: u64, pool: &Pool) {
    let Some((segment, index)) = pool.find(chunk) else { return };
    if set(out, segment.number(index), false) {
        pool.release(segment, index);
    }
}

/// Which sleepers of an arena were woken for a sample.
#[derive(Default)]
struct WokenSleepers {
    sampler: bool,
    /// A bit for each thread.
    threads: [u64; 4],
}

impl WokenSleepers {
    /// Adds a sleeper. Returns whether it is new.
    fn add(&mut self, sleeper: Sleeper) -> bool {
        match sleeper {
            Sleeper::Sampler => !core::mem::replace(&mut self.sampler, true),
            Sleeper::Thread(thread) => !set(&mut self.threads, thread, true),
        }
    }
}

impl ReaderTable {
    /// The subscriptions that a sample goes to: all, or one and the observers; not those that have gone and only hold samples.
    ///
    /// # Real-time
    /// O(subscriptions).
    pub(crate) fn receiving(&self, to: Option<Gid>) -> impl Iterator<Item = &ReaderChannel> {
        let is_meant = move |sender: &&ReaderChannel| {
            to.is_none_or(|to| sender.subscription == to || sender.is_observer)
                && !sender.leaving.load(Ordering::Relaxed)
        };
        self.live().filter(is_meant)
    }

    /// The subscriptions whose sending half belongs to the publishing thread.
    pub(crate) fn live(&self) -> impl Iterator<Item = &ReaderChannel> {
        self.proxies.iter().map(|proxy| &*proxy.sender).filter(|sender| sender.is_live())
    }

    pub(crate) fn empty(sample_bytes: usize, claims_on_use: bool) -> Self {
        let pool = Pool::default().for_publishing(sample_bytes, 1);
        ReaderTable { proxies: Default::default(), pool, claims_on_use }
    }
}

/// What the thread that publishes knows of subscriptions and samples.
pub(crate) struct PublishState {
    table: LatestReader<Arc<ReaderTable>>,
    /// The number of the last sample that was published.
    pub(crate) sequence_number: u64,
}

impl PublishState {
    pub(crate) fn new(table: LatestReader<Arc<ReaderTable>>) -> Self {
        PublishState { table, sequence_number: 0 }
    }

    /// Checks whether subscriptions or segments were added or removed, and takes the changes over.
    ///
    /// # Real-time
    /// Wait-free: one load. When they have: O(samples), O(subscriptions x samples / 64) and, for each late joiner, O(history); no
    /// allocation; no syscall.
    #[inline]
    pub(crate) fn refresh(&mut self, history: Option<&History>) {
        if self.table.is_fresh() {
            self.adopt(history);
        }
    }

    #[cold]
    fn adopt(&mut self, history: Option<&History>) {
        let sequence_number = self.sequence_number;
        let table = self.table.read();
        table.pool.list_free();
        for ReaderProxy { sender, spare, .. } in table.proxies.iter() {
            if sender.turn.adopt()
                && let Some(history) = history
            {
                // SAFETY: it is this thread's now.
                unsafe { sender.catch_up(history, sequence_number, &table.pool) };
            }
            if !sender.is_live() {
                continue;
            }
            if let Some(spare) = spare {
                // SAFETY: this is the thread that publishes, and the sender is its own.
                let (longer, half) = unsafe { (&mut *spare.list.get(), &mut *sender.half.get()) };
                half.enlarge(longer);
                sender.room.store(half.out.len() * 64, Ordering::Release);
            }
            if sender.is_retired() {
                // SAFETY: it is this thread's.
                unsafe { sender.drain(&table.pool) };
                sender.turn.finish();
            }
        }
    }

    /// The number of the next sample: a subscription has its own numbers for samples that go to it alone.
    pub(crate) fn next_number(&mut self, to: Option<Gid>) -> u64 {
        self.sequence_number += 1;
        match to {
            None => self.sequence_number,
            Some(to) => {
                let mut receiving = self.table().receiving(Some(to));
                receiving.find(|sender| sender.subscription == to).map_or(0, |sender| {
                    // SAFETY: it is live, so its sending half is this thread's.
                    unsafe { sender.next_own() }
                })
            }
        }
    }

    /// The table. Call [`refresh`](Self::refresh) before.
    #[inline]
    pub(crate) fn table(&self) -> &ReaderTable {
        // A table that was handed over since is adopted by the next `refresh`.
        self.table.current()
    }

    /// Rings every subscription that got the sample, except those that poll by themselves, as observers do, and those that are still taking
    /// what they were rung for. All are marked before any is woken: a sleeper that sleeps for several of them is woken once.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; at most one futex wake per sampler that sleeps, and per callback thread that
    /// sleeps and is woken directly.
    pub(crate) fn ring(&self, to: Option<Gid>) {
        let table = self.table();
        let ringing = || table.receiving(to).filter(|sender| !sender.is_observer);
        let mut is_any_marked = false;
        for sender in ringing() {
            // SAFETY: it is live, so its sending half is this thread's.
            let half = unsafe { &mut *sender.half.get() };
            half.sleeper = sender.owner.arena().mark_sample(sender.slot, sender.is_own);
            is_any_marked |= half.sleeper.is_some();
        }
        if !is_any_marked {
            return;
        }
        full_fence();
        let (mut last, mut woken) = (None, WokenSleepers::default());
        for sender in ringing() {
            // SAFETY: as above.
            let Some(sleeper) = (unsafe { (*sender.half.get()).sleeper }) else { continue };
            let arena = sender.owner.arena();
            // Subscriptions of one arena are next to each other. The bells that their slots lead to may change at any time.
            if last.replace(arena.id()) != Some(arena.id()) {
                woken = WokenSleepers::default();
            }
            if woken.add(sleeper) {
                arena.wake(sleeper);
            }
        }
    }

    /// Before a loan: takes samples back from the subscriptions whose turn it is, from each at most twice as many as were loaned since its
    /// last turn.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions + samples taken back); no allocation; no syscall.
    pub(crate) fn reclaim_some(&self) {
        let table = self.table();
        let unlooked = if table.pool.sample_bytes <= SMALL_BYTES { UNLOOKED } else { 1 };
        for sender in table.live() {
            // SAFETY: it is live, so it is this thread's.
            let half = unsafe { &mut *sender.half.get() };
            half.unlooked += 1;
            if half.unlooked >= unlooked {
                half.unlooked = 0;
                // SAFETY: as above.
                unsafe { sender.reclaim(2 * unlooked, &table.pool) };
            }
        }
    }

    /// Takes back all that subscriptions have returned.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions + samples taken back); no allocation; no syscall.
    pub(crate) fn reclaim_all(&self) {
        let table = self.table();
        for sender in table.live() {
            // SAFETY: it is live, so it is this thread's.
            unsafe { sender.reclaim(usize::MAX, &table.pool) };
        }
    }
}

impl ReaderChannel {
    /// Submits the kept samples that were published after the preload, and that the subscription has missed.
    ///
    /// # Safety
    /// The caller owns the sending half.
    unsafe fn catch_up(&self, history: &History, published: u64, pool: &Pool) {
        // SAFETY: as the caller promises.
        let (last, wants_history) = unsafe { ((*self.half.get()).last, (*self.half.get()).wants_history) };
        if !wants_history {
            return;
        }
        for number in history.first_kept(published).max(last.saturating_add(1))..=published {
            if let Some(chunk) = history.kept(number) {
                if let Some((segment, index)) = pool.find(chunk) {
                    segment.add(index);
                }
                // SAFETY: as the caller promises; the reference was added just now.
                unsafe { self.submit(number, chunk, pool) };
            }
        }
    }
}

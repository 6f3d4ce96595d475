// SPDX-License-Identifier: MIT OR Apache-2.0
//! Writer proxies: one publisher as its subscription sees it, and the table of all publishers.
//!
//! As on the publishing side, setup code adds and removes publishers, and the thread that takes finds a new [`WriterTable`] at its
//! next take. A receiver belongs to the taking thread from the time when that thread has seen it until the thread has settled
//! the samples of an ended publisher. Setup code may remove an ended publisher that no take has seen. [`HandOver`] states the
//! owner.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::memory::connection::{Block, Connection};
use crate::memory::control::MappedControl;
use crate::memory::file::ArenaOwner;
use crate::memory::header::{Gid, HEADER_BYTES, SampleHeader};
use crate::memory::pool::{ChunkOffset, SegmentView, SegmentViews};
use crate::memory::sizes::SAMPLE_ALIGNMENT;
use crate::topic::chunks::{Chunks, Keyed};
use crate::topic::hand_over::HandOver;
use crate::topic::reader::source::PublisherMemory;
use core::cell::UnsafeCell;
use core::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{Ordering, fence};
use tautline_rt::shm::Mapping;
use tautline_rt::{LatestReader, fetch_to_read};

/// What a subscription knows of a publisher.
pub(crate) struct Receiver {
    pub(crate) publisher: Gid,
    connection: Arc<Connection>,
    is_others: bool,
    /// How many samples are taken out of the queue at a time.
    at_a_time: usize,
    /// Shows whether the segments have changed since they were mapped.
    head: Option<MappedControl>,
    /// Where the publisher is rung when it waits for room.
    owner: ArenaOwner,
    slot: usize,
    turn: HandOver,
    half: UnsafeCell<TakeHalf>,
}

/// What a subscription gets of a publisher's samples.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum ReceiverKind {
    /// All that it takes in time.
    Overwritten,
    /// All: the publisher waits for room in its queue of this depth.
    KeepsAll { depth: usize },
    /// Those that are addressed to other subscriptions, each sample to one of them: its number counts only that subscription's samples.
    Others,
}

/// The maximum number of samples taken at a time out of a queue in which nothing is overwritten: each time costs both sides a fetch
/// of a cache line from the other's core.
const AT_A_TIME: usize = 8;

/// The taking thread's half.
struct TakeHalf {
    /// The number of the sample that is expected next; 0 before the first one.
    next: u64,
    /// A sample that was taken from the queue, but lies in a segment that is not mapped here yet.
    parked: Option<u64>,
    /// Samples that were taken out of the queue and come next, the first one last.
    stash: [u64; AT_A_TIME],
    stashed: usize,
    /// The number of samples that were left in the queue, until the first one of the stash is given out.
    queued: usize,
    /// For samples that are addressed to other subscriptions: the number of overwritten ones that were counted.
    overwritten: u64,
}

// SAFETY: `half` is used by the thread that takes, once it has adopted the receiver; by nobody before, and by nobody after it is done.
// The rest is atomics and what does not change.
unsafe impl Sync for Receiver {}
// SAFETY: as above; nothing in it belongs to a thread.
unsafe impl Send for Receiver {}

/// The working table of the taking thread: replaced when publishers, or their segments, are added or removed.
#[derive(Default)]
pub(crate) struct WriterTable {
    pub(super) proxies: Chunks<WriterProxy>,
}

impl WriterTable {
    fn entries(&self) -> impl Iterator<Item = &WriterEntry> {
        self.proxies.iter().map(|proxy| &proxy.entry)
    }
}

/// A publisher that is connected.
#[derive(Clone)]
pub(super) struct WriterProxy {
    pub(super) publisher: Gid,
    pub(super) source: PublisherMemory,
    pub(super) entry: WriterEntry,
}

impl Keyed for WriterProxy {
    fn key(&self) -> Gid {
        self.publisher
    }
}

/// A publisher in the table.
#[derive(Clone)]
pub(crate) struct WriterEntry {
    pub(crate) receiver: Arc<Receiver>,
    pub(crate) segments: SegmentViews,
    /// The change count of the segments at which this list was complete.
    pub(crate) grown: u32,
    /// All its samples are in its queue, and all segments that could be mapped are mapped.
    pub(crate) has_ended: bool,
}

/// A borrowed sample: it returns to its publisher when it is dropped.
pub(crate) struct BorrowedChunk {
    /// Keeps the sample's segment mapped. Dropped before the receiver: set-up code keeps the mapping as long as others have the receiver.
    _map: Arc<Mapping>,
    receiver: Arc<Receiver>,
    chunk: u64,
}

impl BorrowedChunk {
    pub(crate) fn publisher(&self) -> Gid {
        self.receiver.publisher
    }
}

impl Drop for BorrowedChunk {
    /// # Real-time
    /// Wait-free; no syscall: whoever sets up has the receiver and the mapping as long as one of these is left.
    fn drop(&mut self) {
        // SAFETY: samples are dropped by the subscription's thread, or, when the subscription has gone, by the last thread that has one.
        unsafe { self.receiver.connection.give_back(self.chunk) };
    }
}

pub(crate) struct TakenSample {
    pub(crate) held: BorrowedChunk,
    pub(crate) header: SampleHeader,
    /// The whole sample after its header.
    pub(crate) payload: NonNull<[u8]>,
    /// Samples missing before this one.
    pub(crate) lost: u64,
    /// Samples of this publisher that waited, this one included.
    pub(crate) waiting: u64,
}

/// The result of a check of a publisher's queue.
pub(crate) enum TakeOutcome {
    Taken(TakenSample),
    /// A sample exists, but cannot be reached yet: setup code maps its segment and rings. There may be more samples behind
    /// it.
    Parked,
    /// A sample that could never be reached was skipped. There may be more samples behind it.
    Passed,
    Empty,
    /// The publisher has ended and nothing of it is left; this number of its samples never arrived.
    Settled(u64),
}

impl Receiver {
    #[allow(clippy::disallowed_methods, reason = "set-up")]
    pub(crate) fn new(
        publisher: Gid,
        kind: ReceiverKind,
        connection: Connection,
        head: Option<MappedControl>,
        owner: ArenaOwner,
        slot: usize,
    ) -> Self {
        let at_a_time = match kind {
            ReceiverKind::KeepsAll { depth } => (depth / 8).clamp(1, AT_A_TIME),
            ReceiverKind::Overwritten | ReceiverKind::Others => 1,
        };
        Receiver {
            publisher,
            is_others: kind == ReceiverKind::Others,
            at_a_time,
            connection: Arc::new(connection),
            head,
            owner,
            slot,
            turn: HandOver::new(),
            half: UnsafeCell::new(TakeHalf {
                next: 0,
                parked: None,
                stash: [0; AT_A_TIME],
                stashed: 0,
                queued: 0,
                overwritten: 0,
            }),
        }
    }

    pub(crate) fn block(&self) -> &Block {
        self.connection.block()
    }

    pub(crate) fn connection(&self) -> &Arc<Connection> {
        &self.connection
    }

    /// Whether no more samples arrive from it, and only the borrowed samples still have to be returned to it.
    pub(crate) fn is_done(&self) -> bool {
        self.turn.is_done()
    }

    /// Setup: forgets an ended publisher that no take has seen, with its samples. Returns the number of these.
    pub(crate) fn forget(&self) -> Option<u64> {
        self.turn.retire().is_setups.then(|| self.unseen())
    }

    /// The number of samples that it has sent, of which none was taken.
    fn unseen(&self) -> u64 {
        let (start, sent) = (&self.block().out.start, &self.block().out.sent);
        match start.load(Ordering::Relaxed) {
            0 => 0,
            start => sent.load(Ordering::Relaxed).saturating_add(1).saturating_sub(start),
        }
    }

    /// Whether no take has seen it.
    pub(crate) fn is_new(&self) -> bool {
        self.turn.is_new()
    }

    /// Setup: whether something is queued.
    pub(crate) fn has_samples(&self) -> bool {
        !self.connection.is_empty()
    }

    /// Takes the oldest sample.
    ///
    /// # Real-time
    /// Lock-free: a publisher that overwrites what is to be taken makes it take the next one; no allocation; no syscall.
    ///
    /// # Safety
    /// For the thread that takes, of a live receiver.
    unsafe fn take_oldest(self: &Arc<Self>, segments: &SegmentViews, has_ended: bool) -> TakeOutcome {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        // SAFETY: as the caller promises.
        let Some(chunk) = half.parked.take().or_else(|| unsafe { self.next_chunk(half, segments) }) else {
            return if has_ended { self.settle(half) } else { TakeOutcome::Empty };
        };
        let Some((view, payload)) = locate(chunk, segments) else {
            if has_ended {
                // It will never be reached: the samples after it, or its end, show that it is lost.
                // SAFETY: as the caller promises.
                unsafe { self.connection.give_back(chunk) };
                return TakeOutcome::Passed;
            }
            half.parked = Some(chunk);
            return TakeOutcome::Parked;
        };
        // SAFETY: a sample that was submitted is not written before it was returned, and lies within the mapping.
        let header = unsafe { payload.cast::<u8>().byte_sub(HEADER_BYTES).cast::<SampleHeader>().read() };
        if half.next == 0 {
            half.next = self.block().out.start.load(Ordering::Relaxed);
        }
        let number = match self.is_others {
            false => header.sequence_number,
            true => {
                let overwritten = self.block().out.overwritten.load(Ordering::Relaxed);
                let before = core::mem::replace(&mut half.overwritten, overwritten);
                half.next.saturating_add(overwritten.saturating_sub(before))
            }
        };
        let lost = number.saturating_sub(half.next);
        // Numbers are another process's claims: too large a one is a wrong count, not an overflow.
        half.next = half.next.max(number.saturating_add(1));
        let queued = core::mem::take(&mut half.queued) as u64;
        let waiting = match self.at_a_time {
            1 => queued.saturating_add(1),
            _ => self.block().out.sent.load(Ordering::Relaxed).saturating_add(1).saturating_sub(number),
        };
        // Release: pairs with the Acquire in the publisher's check for room.
        self.block().back.taken.store(number, Ordering::Release);
        let held = BorrowedChunk { receiver: self.clone(), chunk, _map: view.map.clone() };
        TakeOutcome::Taken(TakenSample { held, header, payload, lost, waiting })
    }

    /// Removes the oldest sample that was not given out.
    ///
    /// # Safety
    /// For the thread that takes; the receiver is live, and `half` is its half.
    unsafe fn next_chunk(&self, half: &mut TakeHalf, segments: &SegmentViews) -> Option<u64> {
        if half.stashed == 0 {
            let mut places = half.stash.iter_mut().take(self.at_a_time);
            // SAFETY: as the caller promises.
            let take = || unsafe { self.connection.take() };
            while let Some(place) = places.next()
                && let Some(chunk) = take()
            {
                *place = chunk;
                half.stashed += 1;
                // The fetch proceeds while the samples before it are read.
                if let Some((_, payload)) = locate(chunk, segments).filter(|_| half.stashed > 1) {
                    fetch_to_read(payload.cast());
                    // SAFETY: a header is before it.
                    fetch_to_read(unsafe { payload.cast::<u8>().byte_sub(HEADER_BYTES) });
                }
            }
            half.stash.get_mut(..half.stashed)?.reverse();
            // The queue's positions are on the cache line that was fetched just now.
            half.queued = if half.stashed > 0 { self.connection.queued() } else { 0 };
        }
        half.stashed = half.stashed.checked_sub(1)?;
        half.stash.get(half.stashed).copied()
    }

    /// Whether there is something to take. `None`: there is, but it cannot be reached yet.
    ///
    /// If the publisher has segments that are not mapped here, only the sample itself shows whether it lies in one: it is taken out of the
    /// queue for that, and parked for the next take.
    ///
    /// # Real-time
    /// Lock-free: as [`take_oldest`](Self::take_oldest); no allocation; no syscall.
    ///
    /// # Safety
    /// For the thread that takes, of a live receiver.
    unsafe fn is_ready(&self, WriterEntry { segments, grown, has_ended, .. }: &WriterEntry) -> Option<bool> {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        if half.parked.is_none() && half.stashed > 0 {
            // SAFETY: as the caller promises.
            half.parked = unsafe { self.next_chunk(half, segments) };
        } else if half.parked.is_none() {
            if !self.has_samples() {
                return Some(false);
            }
            // Acquire: segments that the publisher added before it sent this sample are seen.
            fence(Ordering::Acquire);
            if *has_ended || self.head.as_ref().is_none_or(|head| head.grown() == *grown) {
                return Some(true);
            }
            // SAFETY: as the caller promises.
            half.parked = unsafe { self.connection.take() };
            half.queued = self.connection.queued();
        }
        match half.parked {
            None => Some(false),
            Some(chunk) => (*has_ended || locate(chunk, segments).is_some()).then_some(true),
        }
    }

    /// When its oldest sample was released, on `CLOCK_MONOTONIC`: the sample is parked for the next take. `None`: there is none that can be
    /// reached.
    ///
    /// # Real-time
    /// As [`take_oldest`](Self::take_oldest).
    ///
    /// # Safety
    /// For the thread that takes, of a live receiver.
    unsafe fn oldest_released_ns(&self, segments: &SegmentViews) -> Option<u64> {
        // SAFETY: as the caller promises.
        let half = unsafe { &mut *self.half.get() };
        if half.parked.is_none() {
            // SAFETY: as the caller promises.
            half.parked = unsafe { self.next_chunk(half, segments) };
        }
        let (_, payload) = locate(half.parked?, segments)?;
        // SAFETY: as in `take_oldest`.
        Some(unsafe { payload.cast::<u8>().byte_sub(HEADER_BYTES).cast::<SampleHeader>().read() }.released_ns)
    }

    /// How many samples came that were neither taken nor found to be lost.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Safety
    /// For the thread that takes, of a live receiver.
    unsafe fn waiting(&self) -> u64 {
        // SAFETY: as the caller promises.
        match unsafe { (*self.half.get()).next } {
            0 => self.unseen(),
            next => self.block().out.sent.load(Ordering::Relaxed).saturating_add(1).saturating_sub(next),
        }
    }

    /// Settles an ended publisher whose queue is empty: samples that it sent and that never arrived are lost.
    fn settle(&self, half: &TakeHalf) -> TakeOutcome {
        let sent = self.block().out.sent.load(Ordering::Relaxed);
        let lost =
            if half.next == 0 { self.unseen() } else { sent.saturating_add(1).saturating_sub(half.next) };
        self.turn.finish();
        TakeOutcome::Settled(lost)
    }

    /// Rings the publisher if it waits for room, after a take.
    ///
    /// # Real-time
    /// Wait-free; no allocation; one futex wake if the publisher waits and its sampler sleeps.
    pub(crate) fn ring_if_waiting(&self) {
        if self.block().back.room.take() {
            self.owner.arena().ring(self.slot);
        }
    }
}

impl TakenSample {
    pub(crate) fn receiver(&self) -> &Receiver {
        &self.held.receiver
    }
}

/// A sample's segment, and its bytes after the header. `None`: its segment is not mapped here, or there is no such sample.
fn locate(chunk: u64, segments: &SegmentViews) -> Option<(&SegmentView, NonNull<[u8]>)> {
    let ChunkOffset { segment, offset_bytes } = ChunkOffset::from_word(chunk);
    let view = segments.get(segment)?.as_ref()?;
    let end = offset_bytes.checked_add(view.sample_bytes)?;
    if end > view.map.len_bytes()
        || !offset_bytes.is_multiple_of(view.sample_bytes)
        || view.sample_bytes <= HEADER_BYTES
        || !view.sample_bytes.is_multiple_of(SAMPLE_ALIGNMENT)
    {
        return None;
    }
    // SAFETY: within the mapping, as checked.
    let start = unsafe { view.map.start().byte_add(offset_bytes + HEADER_BYTES).cast::<u8>() };
    Some((view, NonNull::slice_from_raw_parts(start, view.sample_bytes - HEADER_BYTES)))
}

/// What the thread that takes knows of publishers.
pub(crate) struct TakeState {
    table: LatestReader<Arc<WriterTable>>,
    /// The receiver with which the next take begins.
    next: usize,
    /// How many samples in a row were taken from it.
    in_a_row: usize,
}

/// After this many samples of one publisher in a row, other publishers have a turn.
const IN_A_ROW: usize = 16;

impl TakeState {
    pub(crate) fn new(table: LatestReader<Arc<WriterTable>>) -> Self {
        TakeState { table, next: 0, in_a_row: 0 }
    }

    /// Checks whether publishers were added or removed, and takes the changes over.
    ///
    /// # Real-time
    /// Wait-free: one load; O(publishers) when they have.
    pub(crate) fn refresh(&mut self) {
        if self.table.is_fresh() {
            // A receiver that was adopted before, or forgotten, is not adopted.
            self.table.read().entries().for_each(|entry| _ = entry.receiver.turn.adopt());
            (self.next, self.in_a_row) = (0, 0);
        }
    }

    /// Takes the oldest sample of a publisher; calls `each` with the other outcomes on the way.
    ///
    /// # Real-time
    /// O(publishers); no allocation; no syscall.
    pub(crate) fn take(&mut self, mut each: impl FnMut(&TakeOutcome)) -> Option<TakenSample> {
        let table = self.table.current();
        let count = table.proxies.len();
        for (place, WriterProxy { entry, .. }) in table.proxies.iter_from(self.next) {
            if !entry.receiver.turn.is_live() {
                continue;
            }
            // SAFETY: it is live, and this is the thread that takes.
            match unsafe { entry.receiver.take_oldest(&entry.segments, entry.has_ended) } {
                TakeOutcome::Taken(taken) => {
                    self.in_a_row = if place == self.next { self.in_a_row + 1 } else { 1 };
                    self.next = place;
                    if self.in_a_row >= IN_A_ROW {
                        (self.next, self.in_a_row) = ((place + 1) % count, 0);
                    }
                    return Some(taken);
                }
                TakeOutcome::Empty => {}
                other => each(&other),
            }
        }
        None
    }

    /// Lets the next take begin with the publisher whose oldest sample was released first.
    ///
    /// # Real-time
    /// O(publishers); no allocation; no syscall.
    pub(crate) fn turn_to_oldest(&mut self) {
        let is_live = |(_, entry): &(usize, &WriterEntry)| entry.receiver.turn.is_live();
        let entries = self.table.current().entries().enumerate();
        let oldest = entries.filter(is_live).filter_map(|(place, entry)| {
            // SAFETY: it is live, and this is the thread that takes.
            Some((unsafe { entry.receiver.oldest_released_ns(&entry.segments) }?, place))
        });
        if let Some((_, place)) = oldest.min() {
            (self.next, self.in_a_row) = (place, 0);
        }
    }

    /// Whether this publisher is connected, and has not ended.
    ///
    /// # Real-time
    /// O(publishers); no allocation; no syscall.
    pub(crate) fn has(&self, publisher: Gid) -> bool {
        self.table.current().entries().any(|entry| entry.receiver.publisher == publisher && !entry.has_ended)
    }

    /// How many samples of all publishers came that were neither taken nor found to be lost.
    ///
    /// # Real-time
    /// O(publishers); no allocation; no syscall.
    pub(crate) fn waiting(&self) -> u64 {
        let live = self.table.current().entries().filter(|entry| entry.receiver.turn.is_live());
        // SAFETY: it is live, and this is the thread that takes.
        live.map(|entry| unsafe { entry.receiver.waiting() }).fold(0, u64::saturating_add)
    }

    /// Whether a publisher has a sample that can be taken; calls `each` for samples that cannot be reached yet.
    ///
    /// # Real-time
    /// Lock-free, O(publishers); no allocation; no syscall.
    pub(crate) fn has_samples(&self, mut each: impl FnMut(&TakeOutcome)) -> bool {
        self.table.current().entries().any(|entry| {
            if !entry.receiver.turn.is_live() {
                return false;
            }
            // SAFETY: it is live, and this is the thread that takes.
            unsafe { entry.receiver.is_ready(entry) }.unwrap_or_else(|| {
                each(&TakeOutcome::Parked);
                false
            })
        })
    }
}

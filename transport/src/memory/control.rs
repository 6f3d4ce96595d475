// SPDX-License-Identifier: MIT OR Apache-2.0
//! The memory that a publisher shares with its subscriptions in addition to its samples: a head, from which everything else
//! is found, and the connections. It lies in its participant's file, in one or more parts: more subscriptions need more
//! parts.
//!
//! Only the publisher's participant creates and changes this memory. The subscriptions' participants read it, and write only into
//! their connections.

use crate::memory::connection::{BLOCK_BYTES, Connection, Shape};
use crate::memory::file::{OwnMemory, PackedRange};
use crate::memory::header::Gid;
use crate::memory::pool::{SEGMENTS, Segment};
use crate::memory::ranges::{Range, Ranges};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};
use tautline_rt::shm::Mapping;

pub(super) const MAGIC: u64 = u64::from_le_bytes(*b"tautpub1");
/// Maximum number of parts of a publisher's control memory.
pub(crate) const PARTS: usize = 10;
/// Address space of the first part, at least; each further one is four times as long. Memory is claimed as it is used.
const FIRST_PART_BYTES: u64 = 32 << 10;
const ALIGNMENT: u64 = 64;
const FIRST_ENTRIES: usize = 8;

/// The beginning of the first part. All bit patterns are valid values; peers treat its content as untrusted.
#[repr(C)]
pub(crate) struct PublisherHead {
    magic: AtomicU64,
    gid: [AtomicU64; 2],
    ended: AtomicU32,
    /// Changes when a segment is added or removed.
    pub(crate) grown: AtomicU32,
    /// Where the parts lie: see [`PackedRange`].
    pub(crate) parts: [AtomicU64; PARTS],
    /// The position of the directory: its offset in the file (high bits) and the number of its entries (low
    /// bits).
    directory: AtomicU64,
    pub(crate) segments: [SegmentWords; SEGMENTS],
    traffic: TrafficWords,
}

/// Counts what the publisher has sent. On cache lines of its own: subscriptions read the other words with every message.
#[repr(C, align(64))]
struct TrafficWords {
    messages: AtomicU64,
    bytes: AtomicU64,
    last_ns: AtomicU64,
}

/// Where a segment of samples lies, and how long a sample is.
#[repr(C)]
pub(crate) struct SegmentWords {
    pub(crate) place: AtomicU64,
    pub(crate) sample_bytes: AtomicU64,
}

const HEAD_BYTES: u64 = size_of::<PublisherHead>().next_multiple_of(ALIGNMENT as usize) as u64;

/// An entry of the directory: which subscription's connection lies where.
#[repr(C)]
struct DirectoryEntry {
    key: AtomicU64,
    /// The offset of the block in the file; 0: the entry is free.
    block: AtomicU64,
}

/// Bits for the number of entries in the word with the directory's position.
const ENTRIES_BITS: u32 = 20;

fn directory_word(offset: u64, entries: usize) -> u64 {
    (offset / ALIGNMENT) << ENTRIES_BITS | entries as u64
}

fn directory_place(word: u64) -> (u64, usize) {
    ((word >> ENTRIES_BITS) * ALIGNMENT, (word & ((1 << ENTRIES_BITS) - 1)) as usize)
}

/// A hash of a subscription's gid, which is not 0. That two subscriptions have the same is unlikely, and harmless.
fn key(subscription: Gid) -> u64 {
    let [low, high] = subscription.words();
    low.wrapping_add(high.wrapping_mul(0x9e37_79b9_7f4a_7c15)) | 1
}

fn head(first: &Mapping) -> &PublisherHead {
    // SAFETY: callers pass the first part of a publisher's memory, which is longer than a head, mapped at the start of a page; any
    // bytes are a valid head.
    unsafe { first.start().cast().as_ref() }
}

/// The entries of the directory at the position `word`; `None` if it does not lie within a part.
fn directory(parts: &[(Range, Arc<Mapping>)], word: u64) -> Option<&[DirectoryEntry]> {
    let (offset, entries) = directory_place(word);
    let (part, at) = find(parts, offset)?;
    let end = at.checked_add(entries.checked_mul(size_of::<DirectoryEntry>())?)?;
    if end > part.len_bytes() || entries == 0 {
        return None;
    }
    // SAFETY: within the mapping, as checked, and aligned to 64 bytes; any bytes are atomics.
    Some(unsafe {
        std::slice::from_raw_parts(part.start().byte_add(at).cast::<DirectoryEntry>().as_ptr(), entries)
    })
}

/// The part that contains an offset of the file, and the offset within the part.
fn find(parts: &[(Range, Arc<Mapping>)], offset: u64) -> Option<(&Arc<Mapping>, usize)> {
    let (range, map) = parts.iter().find(|(range, _)| (range.offset..range.end()).contains(&offset))?;
    Some((map, (offset - range.offset) as usize))
}

/// The publisher's side.
pub(crate) struct PublisherControl {
    memory: Arc<OwnMemory>,
    parts: Vec<(Range, Arc<Mapping>)>,
    free: Vec<Ranges>,
    /// The pages of each part for which memory is claimed.
    claimed: Vec<Vec<bool>>,
}

#[derive(Clone, Copy, Debug)]
struct Stretch {
    part: usize,
    range: Range,
}

/// The memory of a connection, to give it back.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ConnectionPlace {
    block: Stretch,
    queues: Stretch,
    pub(crate) shape: Shape,
    subscription: Gid,
}

impl PublisherControl {
    pub(crate) fn create(memory: &Arc<OwnMemory>, gid: Gid) -> io::Result<Self> {
        let (parts, free, claimed) = Default::default();
        let mut control = PublisherControl { memory: memory.clone(), parts, free, claimed };
        match control.begin(gid) {
            Ok(()) => Ok(control),
            Err(error) => {
                control.give_back_parts();
                Err(error)
            }
        }
    }

    fn begin(&mut self, gid: Gid) -> io::Result<()> {
        self.add_part()?;
        // The head is the first stretch of the first part.
        let head_stretch = self.take(0, HEAD_BYTES).ok_or_else(|| io::Error::other("no room for a head"))?;
        let entries = self.take(0, (FIRST_ENTRIES * size_of::<DirectoryEntry>()) as u64);
        let entries = entries.ok_or_else(|| io::Error::other("no room for a directory"))?;
        self.claim(head_stretch, 0, HEAD_BYTES)?;
        self.claim(entries, 0, entries.range.len)?;
        let head = self.head();
        let [low, high] = gid.words();
        head.gid[0].store(low, Ordering::Relaxed);
        head.gid[1].store(high, Ordering::Relaxed);
        head.parts[0].store(PackedRange::to_word(self.parts[0].0), Ordering::Relaxed);
        let offset = self.parts[0].0.offset + entries.range.offset;
        head.directory.store(directory_word(offset, FIRST_ENTRIES), Ordering::Relaxed);
        // Release: pairs with the Acquire in `View::open`.
        head.magic.store(MAGIC, Ordering::Release);
        Ok(())
    }

    pub(crate) fn head(&self) -> &PublisherHead {
        head(&self.parts[0].1)
    }

    /// The position of the first part, as the publisher's entry in the record has it.
    pub(crate) fn place(&self) -> u64 {
        PackedRange::to_word(self.parts[0].0)
    }

    /// The counters of what is sent; not to be used after [`release`](Self::release).
    pub(crate) fn traffic(&self) -> Traffic {
        Traffic(self.parts[0].1.clone())
    }

    /// All parts, and their positions in the file: for subscriptions of the same process.
    pub(crate) fn parts(&self) -> Vec<(Range, Arc<Mapping>)> {
        self.parts.clone()
    }

    fn add_part(&mut self) -> io::Result<()> {
        let index = self.parts.len();
        if index >= PARTS {
            let most = FIRST_PART_BYTES * ((1 << (2 * PARTS)) - 1) / 3;
            return Err(io::Error::other(format!(
                "queues of all its subscriptions are {} MiB at most: lower their depth, or let some of them end",
                most >> 20
            )));
        }
        let len = FIRST_PART_BYTES << (2 * index);
        let range = self.memory.reserve(len)?;
        let map = self.memory.map(range).inspect_err(|_| self.memory.release(range))?;
        self.parts.push((range, map));
        self.free.push(Ranges::new(Range { offset: 0, len: range.len }, ALIGNMENT));
        self.claimed.push(vec![false; (range.len / self.memory.page_bytes()) as usize]);
        if index > 0 {
            // Release: pairs with the Acquire of the participant that maps it.
            self.head().parts[index].store(PackedRange::to_word(range), Ordering::Release);
        }
        Ok(())
    }

    /// Takes a stretch at the beginning of a part: for memory that is written at once.
    fn take(&mut self, part: usize, len: u64) -> Option<Stretch> {
        Some(Stretch { part, range: self.free[part].take(len)? })
    }

    /// Takes a stretch at the end of a part: for the memory of queues, most of which may never be used.
    fn take_last(&mut self, part: usize, len: u64) -> Option<Stretch> {
        Some(Stretch { part, range: self.free[part].take_last(len)? })
    }

    fn give_back(&mut self, stretch: Stretch) {
        self.free[stretch.part].give_back(stretch.range);
    }

    /// Claims memory for `len` bytes of a stretch, from `at` on, and brings it in.
    fn claim(&mut self, stretch: Stretch, at: u64, len: u64) -> io::Result<()> {
        if len == 0 {
            return Ok(());
        }
        let (range, map) = &self.parts[stretch.part];
        let page_bytes = self.memory.page_bytes();
        let from = stretch.range.offset + at;
        let pages = (from / page_bytes) as usize..((from + len).div_ceil(page_bytes)) as usize;
        // Adjacent pages that are not claimed yet are claimed together.
        let mut page = pages.start as u64;
        for row in self.claimed[stretch.part][pages].chunk_by_mut(|one, next| one == next) {
            let (offset, len) = (page * page_bytes, row.len() as u64 * page_bytes);
            page += row.len() as u64;
            if !row[0] {
                self.memory.claim(Range { offset: range.offset + offset, len })?;
                map.populate(offset as usize, len as usize, true)?;
                row.fill(true);
            }
        }
        Ok(())
    }

    /// Calls `take` for each part until one has room, and adds parts until then.
    fn find_room<T>(&mut self, take: impl Fn(&mut Self, usize) -> Option<T>) -> io::Result<T> {
        let mut part = 0;
        loop {
            while part < self.parts.len() {
                if let Some(taken) = take(self, part) {
                    return Ok(taken);
                }
                part += 1;
            }
            self.add_part()?;
        }
    }

    /// Makes a connection for a subscription, and enters it into the directory. Memory is claimed for `samples` samples that go through
    /// it; for any number of them if that is `usize::MAX`.
    pub(crate) fn connect(
        &mut self,
        subscription: Gid,
        shape: Shape,
        samples: usize,
    ) -> io::Result<(Connection, ConnectionPlace)> {
        // Both lie in one part, because the queues refer to their memory by its distance.
        let (block, queues) = self.find_room(|control, part| {
            let (block, queues_bytes) =
                (control.take(part, BLOCK_BYTES as u64)?, shape.queues_bytes() as u64);
            // Queues whose memory is claimed at once share pages with other memory that is.
            let queues = match samples {
                usize::MAX => control.take(part, queues_bytes),
                _ => control.take_last(part, queues_bytes),
            };
            if queues.is_none() {
                control.give_back(block);
            }
            Some((block, queues?))
        })?;
        let place = ConnectionPlace { block, queues, shape, subscription };
        let made = self.make(&place, samples).and_then(|connection| {
            self.enter(&place)?;
            Ok((connection, place))
        });
        made.inspect_err(|_| {
            self.give_back(block);
            self.give_back(queues);
        })
    }

    /// Claims the memory of a connection, and makes it.
    fn make(&mut self, place: &ConnectionPlace, samples: usize) -> io::Result<Connection> {
        let ConnectionPlace { block, queues, shape, subscription } = *place;
        self.claim(block, 0, BLOCK_BYTES as u64)?;
        self.claim_queues(place, samples)?;
        let map = &self.parts[block.part].1;
        let (block_at, queues_at) = (block.range.offset as usize, queues.range.offset as usize);
        // SAFETY: both stretches lie within the part, and were free; the memory that is written has been claimed.
        let connection = unsafe { Connection::create(map, block_at, queues_at, subscription, shape) }?;
        if samples == usize::MAX {
            connection.note_claimed(queues_at, shape);
        }
        Ok(connection)
    }

    /// Claims the memory of the queues that `samples` samples touch.
    pub(crate) fn claim_queues(&mut self, place: &ConnectionPlace, samples: usize) -> io::Result<()> {
        for (at, len) in place.shape.touched(samples) {
            self.claim(place.queues, at as u64, len as u64)?;
        }
        Ok(())
    }

    fn enter(&mut self, place: &ConnectionPlace) -> io::Result<()> {
        let offset = self.parts[place.block.part].0.offset + place.block.range.offset;
        let enter = |entry: &DirectoryEntry| {
            entry.key.store(key(place.subscription), Ordering::Relaxed);
            // Release: pairs with the Acquire in `View::find`; the connection is made.
            entry.block.store(offset, Ordering::Release);
        };
        let word = self.head().directory.load(Ordering::Relaxed);
        let entries = directory(&self.parts, word).unwrap_or(&[]);
        if let Some(entry) = entries.iter().find(|entry| entry.block.load(Ordering::Relaxed) == 0) {
            enter(entry);
            return Ok(());
        }
        let (former, wanted) = (entries.len(), 2 * entries.len());
        let bytes = (wanted * size_of::<DirectoryEntry>()) as u64;
        let larger = self.find_room(|control, part| control.take(part, bytes))?;
        self.claim(larger, 0, bytes).inspect_err(|_| self.free[larger.part].give_back(larger.range))?;
        let new_word = directory_word(self.parts[larger.part].0.offset + larger.range.offset, wanted);
        let (Some(old), Some(new)) = (directory(&self.parts, word), directory(&self.parts, new_word)) else {
            return Err(io::Error::other("the directory is not where it was"));
        };
        for (index, entry) in new.iter().enumerate() {
            let of = |get: fn(&DirectoryEntry) -> &AtomicU64| {
                old.get(index).map_or(0, |old| get(old).load(Ordering::Relaxed))
            };
            entry.key.store(of(|entry| &entry.key), Ordering::Relaxed);
            entry.block.store(of(|entry| &entry.block), Ordering::Relaxed);
        }
        enter(&new[former]);
        // Release: as above. The former directory may be overwritten from here on, while other processes still read it.
        self.head().directory.store(new_word, Ordering::Release);
        // Orders this store before those into the former directory: pairs with the fence in `View::find`.
        fence(Ordering::Release);
        let (offset, _) = directory_place(word);
        let part = self.parts.iter().position(|(range, _)| (range.offset..range.end()).contains(&offset));
        if let Some(part) = part {
            let range = Range {
                offset: offset - self.parts[part].0.offset,
                len: (former * size_of::<DirectoryEntry>()) as u64,
            };
            self.free[part].give_back(range);
        }
        Ok(())
    }

    /// Frees a connection, which its subscription does not use any more.
    pub(crate) fn disconnect(&mut self, connection: &Connection, place: ConnectionPlace) {
        let offset = self.parts[place.block.part].0.offset + place.block.range.offset;
        let entries = directory(&self.parts, self.head().directory.load(Ordering::Relaxed)).unwrap_or(&[]);
        for entry in entries.iter().filter(|entry| entry.block.load(Ordering::Relaxed) == offset) {
            entry.block.store(0, Ordering::Release);
        }
        connection.erase();
        self.give_back(place.block);
        self.give_back(place.queues);
    }

    pub(crate) fn show_segment(&self, segment: &Segment) {
        if let Some(words) = self.head().segments.get(segment.id()) {
            words.sample_bytes.store(segment.sample_bytes() as u64, Ordering::Relaxed);
            // Release: pairs with the Acquire of the participant that maps it.
            words.place.store(PackedRange::to_word(segment.range), Ordering::Release);
            self.head().grown.fetch_add(1, Ordering::Release);
        }
    }

    pub(crate) fn hide_segment(&self, id: usize) {
        if let Some(words) = self.head().segments.get(id) {
            words.place.store(0, Ordering::Release);
            self.head().grown.fetch_add(1, Ordering::Release);
        }
    }

    /// Marks the publisher as ended; its samples can still be taken.
    pub(crate) fn end(&self) {
        self.head().ended.store(1, Ordering::Release);
    }

    /// Gives all parts back to the file; no subscription uses them any more.
    pub(crate) fn release(self) {
        self.head().magic.store(0, Ordering::Release);
        self.give_back_parts();
    }

    fn give_back_parts(&self) {
        self.parts.iter().for_each(|(range, _)| self.memory.release(*range));
    }
}

/// What a publisher has sent since it was created, by its own count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sent {
    /// Messages; for a service's responses, those to all clients.
    pub messages: u64,
    /// Bytes of their bodies, as CDR without its header of 4 bytes.
    pub bytes: u64,
    /// Time of the last message, in `CLOCK_MONOTONIC` nanoseconds; 0: there was none.
    pub last_ns: u64,
}

/// The counters of what a publisher sends. Any process may read them without the publisher's help.
pub(crate) struct Traffic(Arc<Mapping>);

impl Traffic {
    /// Counts a message that was sent. For the thread that publishes; no other thread writes.
    ///
    /// # Real-time
    /// Wait-free: two loads and three stores, of a cache line that is this thread's unless another process reads it.
    #[inline]
    pub(crate) fn note(&self, len_bytes: usize, now_ns: u64) {
        let TrafficWords { messages, bytes, last_ns } = &head(&self.0).traffic;
        bytes.store(bytes.load(Ordering::Relaxed).wrapping_add(len_bytes as u64), Ordering::Relaxed);
        last_ns.store(now_ns, Ordering::Relaxed);
        // Release: pairs with the Acquire in `sent`; a reader of this number reads the other words of this message or of a later one.
        messages.store(messages.load(Ordering::Relaxed).wrapping_add(1), Ordering::Release);
    }
}

/// The head of a publisher's memory, mapped.
pub(crate) struct MappedControl(Arc<Mapping>);

impl MappedControl {
    /// How often its segments have changed.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub(crate) fn grown(&self) -> u32 {
        head(&self.0).grown.load(Ordering::Acquire)
    }

    /// What the publisher has sent: of one instant, unless the publisher sends more often meanwhile than this reads again.
    pub(crate) fn sent(&self) -> Sent {
        let TrafficWords { messages, bytes, last_ns } = &head(&self.0).traffic;
        let mut sent = Sent::default();
        for _ in 0..4 {
            sent.messages = messages.load(Ordering::Acquire);
            sent.bytes = bytes.load(Ordering::Relaxed);
            sent.last_ns = last_ns.load(Ordering::Relaxed);
            // Orders the loads above before the one below.
            fence(Ordering::Acquire);
            if messages.load(Ordering::Relaxed) == sent.messages {
                break;
            }
        }
        sent
    }
}

fn gid_of(head: &PublisherHead) -> Gid {
    Gid::from_words([0, 1].map(|word| head.gid[word].load(Ordering::Relaxed)))
}

/// The directory was replaced while it was read, or lies in a part that is not mapped yet.
pub(crate) struct Moved;

/// A publisher's memory as a subscription's participant sees it.
pub(crate) struct View {
    parts: Vec<(Range, Arc<Mapping>)>,
    publisher: Gid,
}

impl View {
    /// Opens the memory at the position that a publisher's entry states. `None`: it is not that publisher's memory.
    pub(crate) fn open(first: Range, map: Arc<Mapping>, gid: Gid) -> Option<Self> {
        if map.len_bytes() < HEAD_BYTES as usize {
            return None;
        }
        let view = View { parts: vec![(first, map)], publisher: gid };
        view.is_of_its_publisher().then_some(view)
    }

    pub(crate) fn of_own(control: &PublisherControl) -> Self {
        View { parts: control.parts(), publisher: gid_of(control.head()) }
    }

    /// Whether the memory is not another publisher's by now.
    fn is_of_its_publisher(&self) -> bool {
        self.head().magic.load(Ordering::Acquire) == MAGIC && gid_of(self.head()) == self.publisher
    }

    pub(crate) fn head(&self) -> &PublisherHead {
        head(&self.parts[0].1)
    }

    pub(crate) fn head_map(&self) -> MappedControl {
        MappedControl(self.parts[0].1.clone())
    }

    /// Parts that exist and are not mapped yet.
    pub(crate) fn missing(&self) -> Vec<Range> {
        let words = self.head().parts.iter().map(|place| place.load(Ordering::Acquire));
        let places = words.filter_map(PackedRange::from_word);
        places.filter(|place| !self.parts.iter().any(|(range, _)| range == place)).collect()
    }

    pub(crate) fn add(&mut self, range: Range, map: Arc<Mapping>) {
        self.parts.push((range, map));
    }

    /// The connection of a subscription, if the publisher's participant has made one.
    ///
    /// # Errors
    /// [`Moved`]: it may be in a directory that replaced this one.
    pub(crate) fn find(&self, subscription: Gid) -> Result<Option<Connection>, Moved> {
        // Acquire: pairs with the Release in `PublisherControl::enter`.
        self.find_in(self.head().directory.load(Ordering::Acquire), subscription)
    }

    fn find_in(&self, word: u64, subscription: Gid) -> Result<Option<Connection>, Moved> {
        let wanted = key(subscription);
        let mut entries = directory(&self.parts, word).ok_or(Moved)?.iter();
        // What overwrote an entry is refused by its magic and gid.
        let found = entries.find_map(|entry| {
            let is_wanted = entry.key.load(Ordering::Relaxed) == wanted;
            let (map, at) = find(&self.parts, is_wanted.then(|| entry.block.load(Ordering::Acquire))?)?;
            Connection::open(map, at).filter(|connection| connection.subscription() == subscription)
        });
        // Orders the loads above before the one below.
        fence(Ordering::Acquire);
        let is_same = self.head().directory.load(Ordering::Relaxed) == word;
        match found {
            // The publisher's GID was written before the entry that was found.
            Some(_) if !self.is_of_its_publisher() => Ok(None),
            None if !is_same => Err(Moved),
            found => Ok(found),
        }
    }

    pub(crate) fn connections(&self) -> Vec<Connection> {
        let word = self.head().directory.load(Ordering::Acquire);
        let entries = directory(&self.parts, word).unwrap_or(&[]);
        let open = |entry: &DirectoryEntry| {
            let (map, at) = find(&self.parts, entry.block.load(Ordering::Acquire))?;
            Connection::open(map, at)
        };
        entries.iter().filter_map(open).collect()
    }

    /// Whether the publisher ended in an orderly way.
    pub(crate) fn has_ended(&self) -> bool {
        self.head().ended.load(Ordering::Acquire) != 0
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::graph::domain::Domain;
    use crate::memory::file::{FileLayout, Peer};
    use crate::tests::isolated;

    const SHAPE: Shape = Shape { depth: 10, held: 4, loans: 1, is_observer: false };

    fn gid(n: u64) -> Gid {
        Gid::of(5, n)
    }

    /// A participant's memory, and how another participant sees it.
    fn shared(domain: u32, layout: FileLayout) -> (Arc<Domain>, Arc<OwnMemory>, Peer) {
        isolated();
        let joined = Domain::join(domain).unwrap();
        let memory = Arc::new(OwnMemory::create_as(domain, layout).unwrap());
        memory.create_arena();
        let peer = Peer::open(domain, memory.id()).unwrap().unwrap();
        (joined, memory, peer)
    }

    fn view(peer: &Peer, place: u64, of: Gid) -> View {
        let first = PackedRange::from_word(place).unwrap();
        let map = peer.map(first, true).unwrap().unwrap();
        View::open(first, map, of).unwrap()
    }

    fn found(view: &View, subscription: u64) -> Option<Connection> {
        view.find(gid(subscription)).ok().flatten()
    }

    fn map_missing(view: &mut View, peer: &Peer) {
        for range in view.missing() {
            let map = peer.map(range, true).unwrap().unwrap();
            view.add(range, map);
        }
    }

    #[test]
    fn a_thousand_connections_are_found_from_outside_whatever_a_page_is() {
        // This machine maps no parts of its own pages.
        for page_bytes in [4 << 10, 16 << 10, 64 << 10]
            .into_iter()
            .filter(|bytes| *bytes >= tautline_rt::shm::page_bytes() as u64)
        {
            a_thousand_connections(FileLayout::of_pages(page_bytes));
        }
    }

    fn a_thousand_connections(layout: FileLayout) {
        let (_domain, memory, peer) = shared(220, layout);
        let mut control = PublisherControl::create(&memory, gid(1)).unwrap();
        let mut early = view(&peer, control.place(), gid(1));
        assert!(found(&early, 100).is_none());
        let mut made: Vec<_> =
            (100..1100).map(|n| control.connect(gid(n), SHAPE, 10).map(|made| (n, made)).unwrap()).collect();
        let mut late = view(&peer, control.place(), gid(1));
        for view in [&mut early, &mut late] {
            map_missing(view, &peer);
            for (n, (connection, _)) in &made {
                let found = found(view, *n).unwrap();
                connection.block().out.sent.store(*n, Ordering::Relaxed);
                assert_eq!(found.block().out.sent.load(Ordering::Relaxed), *n);
            }
            assert!(found(view, 99).is_none());
            assert_eq!(view.connections().len(), 1000);
        }
        for (range, _) in control.parts() {
            let is_whole = |bytes: u64| bytes.is_multiple_of(memory.page_bytes());
            assert!(is_whole(range.offset) && is_whole(range.len), "{layout:?}: {range:?}");
        }
        // What is given back is used again.
        let parts = control.parts().len();
        for _ in 0..3 {
            for (_, (connection, place)) in made.drain(..) {
                control.disconnect(&connection, place);
            }
            assert!(late.connections().is_empty());
            made = (100..1100).map(|n| (n, control.connect(gid(n), SHAPE, 10).unwrap())).collect();
            assert_eq!(control.parts().len(), parts);
        }
        assert!(!late.has_ended());
        control.end();
        assert!(late.has_ended());
        let place = PackedRange::from_word(control.place()).unwrap();
        drop(made);
        control.release();
        let map = peer.map(place, true).unwrap().unwrap();
        assert!(View::open(place, map, gid(1)).is_none(), "it is nobody's");
        memory.retire();
    }

    #[test]
    fn a_connection_of_the_publisher_that_has_the_memory_now_is_not_found() {
        let (_domain, memory, peer) = shared(65, FileLayout::of_host());
        let former = PublisherControl::create(&memory, gid(1)).unwrap();
        let (place, view) = (former.place(), view(&peer, former.place(), gid(1)));
        former.release();
        let mut next = PublisherControl::create(&memory, gid(3)).unwrap();
        assert_eq!(next.place(), place);
        let _made = next.connect(gid(2), SHAPE, 0).unwrap();
        assert!(found(&view, 2).is_none());
        memory.retire();
    }

    #[test]
    fn what_is_missed_in_a_former_directory_is_looked_for_in_the_next() {
        let (_domain, memory, peer) = shared(163, FileLayout::of_host());
        let mut control = PublisherControl::create(&memory, gid(1)).unwrap();
        let mut view = view(&peer, control.place(), gid(1));
        let mut made: Vec<_> = (2..514).map(|n| control.connect(gid(n), SHAPE, 0).unwrap()).collect();
        map_missing(&mut view, &peer);
        let former = view.head().directory.load(Ordering::Acquire);
        assert!(view.find_in(former, gid(2)).is_ok_and(|found| found.is_some()));
        // The first takes another directory; the others have the memory of the former one.
        made.extend((514..540).map(|n| control.connect(gid(n), SHAPE, 0).unwrap()));
        assert!(view.find_in(former, gid(2)).is_err());
        map_missing(&mut view, &peer);
        assert!(found(&view, 2).is_some());
        memory.retire();
    }

    #[test]
    fn deep_queues_take_memory_as_they_are_used() {
        isolated();
        let _domain = Domain::join(221).unwrap();
        let memory = Arc::new(OwnMemory::create(221).unwrap());
        let blocks =
            || std::os::unix::fs::MetadataExt::blocks(&std::fs::metadata(memory.path()).unwrap()) * 512;
        let mut control = PublisherControl::create(&memory, gid(1)).unwrap();
        let before = blocks();
        let shape = Shape { depth: 1000, held: 4, loans: 1, is_observer: false };
        let made: Vec<_> = (0..100).map(|n| control.connect(gid(n), shape, 0).unwrap()).collect();
        let unused = blocks() - before;
        assert!(unused < 200 << 10, "{unused} bytes for 100 connections");
        made.iter().for_each(|(_, place)| control.claim_queues(place, 1000).unwrap());
        assert!(blocks() - before >= 100 * shape.queues_bytes() as u64);
        memory.retire();
    }

    #[test]
    fn lies_are_no_connections() {
        let (_domain, memory, peer) = shared(219, FileLayout::of_host());
        let mut control = PublisherControl::create(&memory, gid(1)).unwrap();
        let _made = control.connect(gid(7), SHAPE, 10).unwrap();
        let view = view(&peer, control.place(), gid(1));
        let head = control.head();
        let truth = head.directory.load(Ordering::Relaxed);
        for lie in [0, u64::MAX, 1, truth | 0xffff, truth << 1] {
            head.directory.store(lie, Ordering::Relaxed);
            assert!(found(&view, 7).is_none() || lie == truth | 0xffff, "{lie:x}");
            let _ = view.connections();
        }
        head.directory.store(truth, Ordering::Relaxed);
        let entry = &directory(&control.parts, truth).unwrap()[0];
        let block = entry.block.load(Ordering::Relaxed);
        for lie in [u64::MAX, block + 1, block + 64, 8] {
            entry.block.store(lie, Ordering::Relaxed);
            assert!(found(&view, 7).is_none() && view.connections().is_empty(), "{lie:x}");
        }
        for lie in [u64::MAX, 1 << 63, (1 << 40) + 3] {
            head.parts[3].store(lie, Ordering::Relaxed);
            assert!(view.missing().iter().all(|range| peer.map(*range, true).unwrap().is_none()));
        }
        memory.retire();
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The file of a participant: everything that it shares with other participants.
//!
//! | from | holds |
//! |---|---|
//! | 0 | the [`ParticipantHeader`]: type and version, and the positions of the other parts |
//! | [`ARENA_AT`] | the arena: its doorbell |
//! | the next page | dynamic parts, each of whole pages: the record, more slots, publishers' memory |
//!
//! The participant holds the file's lock as long as it lives. Peers map what they need of it, and keep no descriptor.

use crate::error::TransportError;
use crate::memory::ranges::{Range, Ranges};
use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Once, Weak};
use tautline_doorbell::{
    Arena, ArenaId, Doorbell, DoorbellError, MAIN_BYTES, WINDOWS, window_bytes, window_of,
};
use tautline_rt::PiMutex;
use tautline_rt::domain::{shared_folder, shared_path};
use tautline_rt::shm::{self, Mapping, OwnFile, PeerFile, Region, ShmError, page_bytes};

const MAGIC: u64 = u64::from_le_bytes(*b"tautpart");
/// The version of the layout of a participant's file: raised with any change, which a test of `connection` detects.
pub(crate) const VERSION: u32 = 5;
/// Starts the names of participants' files in the folder of their domain.
pub(crate) const PREFIX: &str = "p";
/// Starts the names of files that stand for participants whose own file was removed.
const STAND_IN: &str = "r";
/// The position of the arena for any page size: the head is shorter, and this is a multiple of the arena's alignment.
const ARENA_AT: usize = 4096;
/// The maximum length of a file: more than any machine's memory.
const END: u64 = 1 << 46;

/// The head of a participant's file. All bit patterns are valid values; peers treat its content as untrusted.
#[repr(C)]
pub(crate) struct ParticipantHeader {
    magic: AtomicU64,
    version: AtomicU32,
    pub(crate) pid: AtomicU32,
    /// The position of the record: see [`PackedRange`].
    pub(crate) record: crate::sync::AtomicU64,
    /// The positions of all windows of slots except the first.
    windows: [AtomicU64; WINDOWS],
}

/// The position of a part of a file, packed into one word: offset (high bits) and length in units of 4 KiB, of which a page of any
/// system has a whole number. 0 means none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PackedRange;

impl PackedRange {
    const UNIT: u64 = 4 << 10;
    const LEN_BITS: u32 = 24;
    /// The maximum length of a part: 64 GiB less one unit.
    const MAX_LEN: u64 = ((1 << Self::LEN_BITS) - 1) * Self::UNIT;

    pub(crate) fn to_word(range: Range) -> u64 {
        (range.offset / Self::UNIT) << Self::LEN_BITS | (range.len / Self::UNIT) & ((1 << Self::LEN_BITS) - 1)
    }

    /// Unpacks a word of another process, which is untrusted.
    pub(crate) fn from_word(word: u64) -> Option<Range> {
        let units = |count: u64| count * Self::UNIT;
        let (offset, len) = (units(word >> Self::LEN_BITS), units(word & ((1 << Self::LEN_BITS) - 1)));
        (len != 0 && offset + len <= END).then_some(Range { offset, len })
    }
}

/// Where the parts of a file lie, for pages of a given size. All participants of a domain are on one host, whose pages have one size.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FileLayout {
    page_bytes: u64,
}

impl FileLayout {
    pub(crate) fn of_host() -> Self {
        Self::of_pages(page_bytes() as u64)
    }

    pub(crate) fn of_pages(page_bytes: u64) -> Self {
        assert!(
            page_bytes.is_multiple_of(PackedRange::UNIT),
            "a page is a multiple of 4 KiB on every system"
        );
        FileLayout { page_bytes }
    }

    /// Bytes of the head and the arena, which peers map first.
    fn first_bytes(self) -> usize {
        (ARENA_AT + MAIN_BYTES).next_multiple_of(self.page_bytes as usize)
    }

    /// The free ranges, from which dynamic parts are taken.
    fn ranges(self) -> Ranges {
        let offset = self.first_bytes() as u64;
        Ranges::new(Range { offset, len: END - offset }, self.page_bytes)
    }
}

fn head(first: &Mapping) -> &ParticipantHeader {
    // SAFETY: the first part of a file, which is longer than a head, mapped at the start of a page; any bytes are a valid head.
    unsafe { first.start().cast().as_ref() }
}

/// This participant's own file.
pub(crate) struct OwnMemory {
    file: OwnFile,
    first: Arc<Mapping>,
    ranges: PiMutex<Ranges>,
    layout: FileLayout,
    /// The length of the file.
    len: PiMutex<u64>,
    stand_in: PiMutex<Option<OwnFile>>,
}

impl OwnMemory {
    /// Creates the file of a new participant of `domain`, whose folder exists.
    pub(crate) fn create(domain: u32) -> Result<Self, TransportError> {
        Self::create_as(domain, FileLayout::of_host())
    }

    pub(crate) fn create_as(domain: u32, layout: FileLayout) -> Result<Self, TransportError> {
        let first_bytes = layout.first_bytes();
        let file = OwnFile::create(&format!("{}/{PREFIX}", shared_folder(domain))).map_err(file_error)?;
        let make = || -> Result<Arc<Mapping>, ShmError> {
            file.claim(0, first_bytes as u64)?;
            let named = |source| ShmError { path: file.path().to_owned(), source };
            let first = Mapping::new(&file, 0, first_bytes, true).map_err(named)?;
            first.populate(0, first_bytes, true).map_err(named)?;
            Ok(Arc::new(first))
        };
        let first = match make() {
            Ok(first) => first,
            Err(error) => {
                file.retire();
                return Err(file_error(error));
            }
        };
        head(&first).pid.store(std::process::id(), Ordering::Relaxed);
        head(&first).version.store(VERSION, Ordering::Relaxed);
        // Release: pairs with the Acquire in `Peer::open`.
        head(&first).magic.store(MAGIC, Ordering::Release);
        Ok(OwnMemory {
            file,
            first,
            ranges: PiMutex::new(layout.ranges()),
            layout,
            len: PiMutex::new(first_bytes as u64),
            stand_in: PiMutex::default(),
        })
    }

    /// This participant's id, which is the number in the file's name.
    pub(crate) fn id(&self) -> u64 {
        self.file.id()
    }

    pub(crate) fn path(&self) -> &std::path::Path {
        self.file.path()
    }

    /// The size of the pages of which parts consist.
    pub(crate) fn page_bytes(&self) -> u64 {
        self.layout.page_bytes
    }

    pub(crate) fn head(&self) -> &ParticipantHeader {
        head(&self.first)
    }

    pub(crate) fn create_arena(&self) -> Arena {
        let memory = Region::new(&self.first, ARENA_AT, MAIN_BYTES).expect("it is part of the first bytes");
        Arena::create(ArenaId(self.id()), memory)
    }

    /// Allocates the memory of a further window of slots, and shows it to peers.
    pub(crate) fn grow_arena(&self, window: usize) -> io::Result<Region> {
        let bytes = window_bytes(window);
        let range = self.reserve(bytes as u64)?;
        let make = || -> io::Result<Arc<Mapping>> {
            self.claim(range)?;
            let map = self.map(range)?;
            map.populate(0, map.len_bytes(), true)?;
            Ok(map)
        };
        let memory = make().inspect_err(|_| self.release(range))?;
        let memory = Region::new(&memory, 0, bytes).ok_or_else(|| io::Error::other("too short"))?;
        if let Some(place) = self.head().windows.get(window) {
            // Release: pairs with the Acquire in `Peer::reach`; the memory is there.
            place.store(PackedRange::to_word(range), Ordering::Release);
        }
        Ok(memory)
    }

    /// Takes a part of the file that is at least `len` bytes long, without memory yet. It reads as zeros.
    pub(crate) fn reserve(&self, len: u64) -> io::Result<Range> {
        if len > PackedRange::MAX_LEN {
            return Err(io::Error::other("a piece of shared memory is shorter than 64 GiB"));
        }
        let none = || io::Error::other("the file of this participant is at its greatest length");
        let range = self.ranges.lock().take(len).ok_or_else(none)?;
        let mut file_len = self.len.lock();
        if range.end() > *file_len {
            if let Err(error) = self.file.set_len(range.end()) {
                self.ranges.lock().give_back(range);
                return Err(error.source);
            }
            *file_len = range.end();
        }
        Ok(range)
    }

    /// Claims memory for a part of the file, or for some pages of one.
    pub(crate) fn claim(&self, range: Range) -> io::Result<()> {
        self.file.claim(range.offset, range.len).map_err(|error| error.source)
    }

    /// Maps a part, for writing.
    pub(crate) fn map(&self, range: Range) -> io::Result<Arc<Mapping>> {
        Ok(Arc::new(Mapping::new(&self.file, range.offset, range.len as usize, true)?))
    }

    /// Releases a part, which no process uses any more.
    pub(crate) fn release(&self, range: Range) {
        // If this fails, the part keeps its memory until it is used again.
        let _ = self.file.give_back(range.offset, range.len);
        self.ranges.lock().give_back(range);
    }

    /// Whether somebody removed the file, as systemd-logind does when a user logs out: nobody finds this participant then.
    pub(crate) fn is_removed(&self) -> bool {
        !shm::has_name(&self.file)
    }

    /// Creates an empty file in place of the removed one; its lock shows whether this participant is alive.
    ///
    /// # Errors
    /// The folder was removed, too, or the system refuses, or another process took the file for a dead participant's: try again.
    pub(crate) fn make_stand_in(&self) -> Result<(), TransportError> {
        let path = self.path().with_file_name(format!("{STAND_IN}{:016x}", self.id()));
        *self.stand_in.lock() = Some(OwnFile::create_at(path, self.id()).map_err(file_error)?);
        Ok(())
    }

    /// Removes the file.
    pub(crate) fn retire(&self) {
        if let Some(stand_in) = self.stand_in.lock().take() {
            stand_in.retire();
        }
        self.file.retire();
    }
}

/// Another participant's file, or this participant's file as other participants see it.
#[derive(Debug)]
pub(crate) struct Peer {
    pub(crate) id: u64,
    path: PathBuf,
    first: Arc<Mapping>,
    arena: Arena,
    brought_in: Once,
}

impl Peer {
    /// Maps the head and the doorbell of a participant. `None`: its file no longer exists.
    ///
    /// # Errors
    /// The file is of another version or damaged, or the system refuses: see [`TransportError::is_passing`].
    pub(crate) fn open(domain: u32, id: u64) -> Result<Option<Peer>, TransportError> {
        let path = path(domain, id);
        let Some(file) = open(&path)? else { return Ok(None) };
        let first_bytes = FileLayout::of_host().first_bytes();
        if file.size_bytes().map_err(file_error)? < first_bytes as u64 {
            return Err(TransportError::Version { path });
        }
        let map = Mapping::new(&file, 0, first_bytes, true);
        let first = Arc::new(map.map_err(|source| TransportError::File { path: path.clone(), source })?);
        let found = head(&first);
        if found.magic.load(Ordering::Acquire) != MAGIC || found.version.load(Ordering::Relaxed) != VERSION {
            return Err(TransportError::Version { path });
        }
        let memory = Region::new(&first, ARENA_AT, MAIN_BYTES).expect("it is part of the first bytes");
        let arena = Arena::open(ArenaId(id), memory).map_err(|error| match error {
            DoorbellError::Version => TransportError::Version { path: path.clone() },
            other => TransportError::Doorbell(other),
        })?;
        Ok(Some(Peer { id, path, first, arena, brought_in: Once::new() }))
    }

    /// Whether a participant is alive. For visitors: all participants may have died, with nobody left to clean up after them.
    pub(crate) fn is_alive(domain: u32, id: u64) -> bool {
        match PeerFile::open(path(domain, id), false) {
            Ok(file) => file.is_owned(),
            // A file that the system does not let this process open is not that of a dead one: opening it states the error.
            Err(error) => error.source.kind() != std::io::ErrorKind::NotFound,
        }
    }

    pub(crate) fn head(&self) -> &ParticipantHeader {
        head(&self.first)
    }

    pub(crate) fn path(&self) -> &std::path::Path {
        &self.path
    }

    /// Its process's id, as the participant states it.
    pub(crate) fn pid(&self) -> u32 {
        self.head().pid.load(Ordering::Relaxed)
    }

    pub(crate) fn arena(&self) -> &Arena {
        &self.arena
    }

    /// Makes sure that `slot` can be rung, without a page fault. False if there is no such slot.
    pub(crate) fn reach(&self, slot: usize) -> Result<bool, TransportError> {
        // If this fails, the first rings cause page faults.
        self.brought_in.call_once(|| _ = self.first.populate(0, self.first.len_bytes(), true));
        if self.arena.has(slot) {
            return Ok(true);
        }
        let window = window_of(slot);
        let Some(place) = self.head().windows.get(window).filter(|_| window != 0) else { return Ok(false) };
        let Some(range) = PackedRange::from_word(place.load(Ordering::Acquire)) else { return Ok(false) };
        let Some(map) = self.map(range, true)? else { return Ok(false) };
        if let Some(memory) = Region::new(&map, 0, window_bytes(window)) {
            let _ = map.populate(0, map.len_bytes(), true);
            self.arena.add_window(window, memory);
        }
        Ok(self.arena.has(slot))
    }

    /// Maps a part of the file. `None`: the file has gone, or is not as long as its owner says, or the part begins within a page.
    pub(crate) fn map(&self, range: Range, writable: bool) -> Result<Option<Arc<Mapping>>, TransportError> {
        let Some(file) = open(&self.path)? else { return Ok(None) };
        let is_there = range.end() <= file.size_bytes().map_err(file_error)?;
        if !is_there || !range.offset.is_multiple_of(page_bytes() as u64) {
            return Ok(None);
        }
        let map = Mapping::new(&file, range.offset, range.len as usize, writable);
        let map = map.map_err(|source| TransportError::File { path: self.path.clone(), source })?;
        Ok(Some(Arc::new(map)))
    }
}

/// Opens the file of a participant; `None` if it no longer exists.
fn open(path: &std::path::Path) -> Result<Option<PeerFile>, TransportError> {
    match PeerFile::open(path.to_owned(), true) {
        Ok(file) => Ok(Some(file)),
        Err(error) if error.source.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(file_error(error)),
    }
}

pub(crate) fn path(domain: u32, id: u64) -> PathBuf {
    shared_path(domain).join(format!("{PREFIX}{id:016x}"))
}

/// The id of the participant whose file, or stand-in file, has this name.
pub(crate) fn id_of(name: &str) -> Option<u64> {
    let digits = name
        .strip_prefix(PREFIX)
        .or_else(|| name.strip_prefix(STAND_IN))
        .filter(|digits| digits.len() == 16)?;
    u64::from_str_radix(digits, 16).ok()
}

pub(crate) fn file_error(ShmError { path, source }: ShmError) -> TransportError {
    TransportError::File { path, source }
}

/// The peers that this participant has mapped, each once.
#[derive(Default)]
pub(crate) struct Peers {
    known: BTreeMap<u64, Weak<Peer>>,
}

impl Peers {
    pub(crate) fn get(&mut self, domain: u32, id: u64) -> Result<Option<Arc<Peer>>, TransportError> {
        if let Some(peer) = self.known.get(&id).and_then(Weak::upgrade) {
            return Ok(Some(peer));
        }
        let Some(peer) = Peer::open(domain, id)?.map(Arc::new) else { return Ok(None) };
        self.known.retain(|_, peer| peer.strong_count() > 0);
        self.known.insert(id, Arc::downgrade(&peer));
        Ok(Some(peer))
    }
}

/// The participant that an arena belongs to: this process's own or another.
#[derive(Clone)]
pub(crate) enum ArenaOwner {
    Own(Arc<Doorbell>),
    Peer(Arc<Peer>),
}

impl ArenaOwner {
    pub(crate) fn arena(&self) -> &Arena {
        match self {
            ArenaOwner::Own(doorbell) => doorbell.arena(),
            ArenaOwner::Peer(peer) => peer.arena(),
        }
    }

    /// Makes sure that `slot` can be rung. False if there is no such slot.
    pub(crate) fn reach(&self, slot: usize) -> Result<bool, TransportError> {
        match self {
            ArenaOwner::Own(doorbell) => Ok(doorbell.arena().has(slot)),
            ArenaOwner::Peer(peer) => peer.reach(slot),
        }
    }
}

const _: () = assert!(size_of::<ParticipantHeader>() <= ARENA_AT);

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn parts_are_whole_pages_of_any_size_and_do_not_overlap() {
        let mut random = tautline_seed::random();
        for page in [4 << 10, 16 << 10, 64 << 10] {
            let layout = FileLayout::of_pages(page);
            let first = Range { offset: 0, len: layout.first_bytes() as u64 };
            assert!(first.len >= (ARENA_AT + MAIN_BYTES) as u64);
            let (mut ranges, mut parts) = (layout.ranges(), vec![first]);
            for _ in 0..200 {
                let len = random.random_range(1..10 * page);
                let part = ranges.take(len).unwrap();
                assert!(part.len >= len && part.len < len + page, "{part:?} of {len} bytes");
                assert_eq!(PackedRange::from_word(PackedRange::to_word(part)), Some(part));
                parts.push(part);
            }
            parts.sort_by_key(|part| part.offset);
            assert!(
                parts.iter().all(|part| part.offset.is_multiple_of(page) && part.len.is_multiple_of(page))
            );
            assert!(parts.windows(2).all(|pair| pair[0].end() <= pair[1].offset), "{page}: {parts:?}");
        }
    }
}

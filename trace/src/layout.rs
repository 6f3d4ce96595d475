// SPDX-License-Identifier: MIT OR Apache-2.0
//! The content of a process's trace file, and its mapping. Every field is an atomic whose zero value is a valid idle
//! state. A value written by another process must be checked, but never causes undefined behaviour.

use crate::event::WORDS;
use crate::ring::{Ring, RingHead};
use crate::sync::{AtomicU32, AtomicU64, Ordering};
use rustix::fd::AsFd;
use rustix::mm::{MapFlags, ProtFlags};
use std::io;
use std::ptr::NonNull;
use tautline_rt::fork::{map_shared, unmap_shared};

/// Threads of one process that can record at once.
pub(crate) const RINGS: usize = 64;
/// Nodes, publishers, subscriptions, callbacks, timers of one process that are described at once.
pub(crate) const OBJECTS: usize = 1024;
pub(crate) const NAME_BYTES: usize = 192;
/// Events of one ring: a power of two within this range.
pub(crate) const MIN_EVENTS: usize = 16;
pub(crate) const MAX_EVENTS: usize = 1 << 20;

const MAGIC: u64 = u64::from_le_bytes(*b"tauttrac");
const VERSION: u32 = 2;

/// Meaning of the state word, which its owner writes.
pub(crate) mod state {
    /// Nothing is recorded.
    pub const OFF: u32 = 0;
    /// Events are recorded because a recorder requested it.
    pub const ASKED: u32 = 1;
    /// Events are recorded from the start.
    pub const ALWAYS: u32 = 2;
}

#[repr(C)]
pub(crate) struct Layout {
    header: Header,
    pub(crate) objects: [ObjectWords; OBJECTS],
    heads: [RingHead; RINGS],
}

/// Aligned so that its length, and with it the offset of what follows, depends neither on its fields nor on the page size.
#[repr(C, align(4096))]
struct Header {
    magic: AtomicU64,
    version: AtomicU32,
    events: AtomicU32,
    pid: AtomicU32,
    state: AtomicU32,
    name: [AtomicU64; 2],
    unrecorded: AtomicU64,
    undescribed: AtomicU64,
    described: AtomicU64,
    claimed_objects: AtomicU64,
}

/// An object that events refer to. `turn` is odd while the owner writes, and grows with every use of the entry.
#[repr(C)]
pub(crate) struct ObjectWords {
    pub(crate) turn: AtomicU64,
    /// Kind in the low byte, then the length of the name.
    pub(crate) kind: AtomicU32,
    pub(crate) name_bytes: AtomicU32,
    pub(crate) id: AtomicU64,
    pub(crate) parent: AtomicU64,
    pub(crate) detail: AtomicU64,
    pub(crate) gid: [AtomicU64; 2],
    pub(crate) created_ns: AtomicU64,
    pub(crate) name: [AtomicU64; NAME_BYTES / 8],
}

/// A mapped trace file. Never unmapped by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Map {
    base: NonNull<Layout>,
    events: usize,
}

// SAFETY: the mapping holds atomics only.
unsafe impl Send for Map {}
// SAFETY: as above: shared access is through atomics.
unsafe impl Sync for Map {}

impl Map {
    pub(crate) const fn bytes(events: usize) -> usize {
        size_of::<Layout>() + RINGS * Self::ring_bytes(events)
    }

    pub(crate) const fn ring_bytes(events: usize) -> usize {
        events * WORDS * size_of::<AtomicU64>()
    }

    /// Maps a file of at least `bytes(events)` bytes, over `at` if that is given.
    pub(crate) fn of_file(file: impl AsFd, events: usize, at: Option<Map>) -> io::Result<Map> {
        let (address, fixed) = Self::place(at, events);
        let (len, access) = (Self::bytes(events), ProtFlags::READ | ProtFlags::WRITE);
        let base = map_shared(len, || {
            // SAFETY: a new shared mapping at an address of the kernel's choice, or over a mapping of the same length that is
            // this crate's and holds atomics only; the length is not zero.
            unsafe { rustix::mm::mmap(address, len, access, MapFlags::SHARED | fixed, file, 0) }
        })?;
        Self::at(base, events)
    }

    /// Maps zeros over the file, so that its pages are freed when its name is removed. Events that threads still write there are
    /// lost.
    pub(crate) fn forget_file(self) -> io::Result<()> {
        let (address, fixed) = Self::place(Some(self), self.events);
        // SAFETY: over a mapping of this length that is this crate's and holds atomics only, of which zero is valid.
        unsafe {
            rustix::mm::mmap_anonymous(
                address,
                Self::bytes(self.events),
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::PRIVATE | fixed,
            )
        }?;
        Ok(())
    }

    fn place(at: Option<Map>, events: usize) -> (*mut core::ffi::c_void, MapFlags) {
        match at.filter(|map| map.events == events) {
            Some(map) => (map.base.as_ptr().cast(), MapFlags::FIXED),
            None => (std::ptr::null_mut(), MapFlags::empty()),
        }
    }

    fn at(base: *mut core::ffi::c_void, events: usize) -> io::Result<Map> {
        let base = NonNull::new(base.cast()).ok_or_else(|| io::Error::other("mapped at address zero"))?;
        Ok(Map { base, events })
    }

    /// # Safety
    /// Nothing may borrow from the map afterwards.
    pub(crate) unsafe fn unmap(self) {
        let base = self.base.as_ptr().cast();
        // SAFETY: `base` came from mmap with this length; the caller's promise.
        unmap_shared(base, || _ = unsafe { rustix::mm::munmap(base, Self::bytes(self.events)) });
    }

    pub(crate) fn layout<'m>(self) -> &'m Layout {
        // SAFETY: `base` points to a live mapping of at least bytes(events) bytes, page-aligned, and every bit pattern of a
        // Layout is valid (atomics only). Maps of this process's own file are never unmapped; a recorder's are when the
        // recorder forgets the process, see `unmap`.
        unsafe { &*self.base.as_ptr() }
    }

    /// # Panics
    /// If `index` is not below [`RINGS`].
    pub(crate) fn ring<'m>(self, index: usize) -> Ring<'m> {
        let head = &self.layout::<'m>().heads[index];
        let words = self.events * WORDS;
        // SAFETY: behind the Layout lie RINGS * events * WORDS words, mapped as long as the Layout is; any value is valid.
        let events = unsafe {
            let first = self.base.as_ptr().add(1).cast::<AtomicU64>().add(index * words);
            std::slice::from_raw_parts(first, words)
        };
        Ring::new(head, events)
    }

    /// Offset and length in the file of a ring's events.
    pub(crate) fn ring_range(&self, index: usize) -> (u64, u64) {
        let bytes = Self::ring_bytes(self.events);
        ((size_of::<Layout>() + index * bytes) as u64, bytes as u64)
    }

    /// Offset and length in the file of an object's entry.
    pub(crate) fn object_range(&self, index: usize) -> (u64, u64) {
        let bytes = size_of::<ObjectWords>();
        ((size_of::<Header>() + index * bytes) as u64, bytes as u64)
    }

    /// Offset and length in the file of what is needed before the first ring: the header and the heads.
    pub(crate) fn fixed_ranges() -> [(u64, u64); 2] {
        let heads = RINGS * size_of::<RingHead>();
        let heads_at = size_of::<Layout>() - heads;
        [(0, size_of::<Header>() as u64), (heads_at as u64, heads as u64)]
    }

    /// Fills in the header of a fresh file.
    pub(crate) fn claim(self, pid: u32, name: [u64; 2]) {
        let header = &self.layout().header;
        header.version.store(VERSION, Ordering::Relaxed);
        header.events.store(self.events as u32, Ordering::Relaxed);
        header.pid.store(pid, Ordering::Relaxed);
        for (to, from) in header.name.iter().zip(name) {
            to.store(from, Ordering::Relaxed);
        }
        // Release: pairs with the Acquire in `check`.
        header.magic.store(MAGIC, Ordering::Release);
    }

    /// The events per ring that a file of `bytes` bytes claims to have, from its first bytes.
    pub(crate) fn check_header(first: &[u8], bytes: u64) -> Result<usize, &'static str> {
        let word =
            |at: usize| first.get(at..at + 4).and_then(|word| word.try_into().ok()).map(u32::from_ne_bytes);
        let magic = first.get(..8).and_then(|word| word.try_into().ok()).map(u64::from_ne_bytes);
        let (Some(magic), Some(version), Some(events)) = (magic, word(8), word(12)) else {
            return Err("shorter than a header");
        };
        if magic != MAGIC || version != VERSION {
            return Err(
                "it is no trace file, or of another version of Tautline: use the same one in all processes of a domain",
            );
        }
        let events = events as usize;
        if !events.is_power_of_two() || !(MIN_EVENTS..=MAX_EVENTS).contains(&events) {
            return Err("claims rings of an impossible size");
        }
        if bytes < Self::bytes(events) as u64 { Err("shorter than its rings") } else { Ok(events) }
    }

    pub(crate) fn pid(self) -> u32 {
        self.layout().header.pid.load(Ordering::Relaxed)
    }

    pub(crate) fn name(self) -> String {
        words_to_name(&self.layout().header.name)
    }

    pub(crate) fn state(self) -> &'static AtomicU32 {
        &self.layout().header.state
    }

    /// Events of threads that got no ring.
    pub(crate) fn unrecorded(self) -> &'static AtomicU64 {
        &self.layout().header.unrecorded
    }

    /// Objects that got no entry.
    pub(crate) fn undescribed(self) -> &'static AtomicU64 {
        &self.layout().header.undescribed
    }

    /// Counts the entries written to the table of objects.
    pub(crate) fn described(self) -> &'static AtomicU64 {
        &self.layout().header.described
    }

    /// How many entries of the table of objects have memory, the first ones. To read others would take memory, or raise SIGBUS.
    pub(crate) fn claimed_objects(self) -> &'static AtomicU64 {
        &self.layout().header.claimed_objects
    }

    /// Whether a recorder has fetched all events.
    pub(crate) fn is_drained(self) -> bool {
        (0..RINGS).all(|index| self.ring(index).is_drained())
    }
}

/// Up to 16 bytes, as the kernel keeps a thread's name.
pub(crate) fn name_to_words(name: &[u8]) -> [u64; 2] {
    let mut bytes = [0; 16];
    for (to, from) in bytes.iter_mut().zip(name) {
        *to = *from;
    }
    let value = u128::from_le_bytes(bytes);
    [value as u64, (value >> 64) as u64]
}

pub(crate) fn words_to_name(words: &[AtomicU64]) -> String {
    let bytes: Vec<u8> = words.iter().flat_map(|word| word.load(Ordering::Relaxed).to_le_bytes()).collect();
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn the_layout_has_no_gaps_that_the_ranges_miss() {
        assert_eq!(size_of::<ObjectWords>(), 256);
        assert_eq!(size_of::<RingHead>(), 128);
        assert_eq!(size_of::<Layout>(), 4096 + OBJECTS * 256 + RINGS * 128);
        assert_eq!(size_of::<Layout>() % 4096, 0);
    }

    #[test]
    fn headers_that_lie_are_refused() {
        let mut first = vec![0u8; 64];
        first[..8].copy_from_slice(&MAGIC.to_ne_bytes());
        first[8..12].copy_from_slice(&VERSION.to_ne_bytes());
        let claim = |events: u32, bytes: u64| {
            let mut first = first.clone();
            first[12..16].copy_from_slice(&events.to_ne_bytes());
            Map::check_header(&first, bytes)
        };
        assert_eq!(claim(64, Map::bytes(64) as u64), Ok(64));
        assert!(claim(64, Map::bytes(64) as u64 - 1).is_err());
        for events in [0, 1, 63, 1 << 21, u32::MAX] {
            assert!(claim(events, u64::MAX).is_err(), "{events}");
        }
        assert!(Map::check_header(&first[..15], u64::MAX).is_err());
        first[0] ^= 1;
        assert!(Map::check_header(&first, u64::MAX).is_err());
    }
}

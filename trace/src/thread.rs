// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where a thread's events go: how a thread gets its ring, without a lock.

use crate::layout::{Map, RINGS, name_to_words};
use crate::ring::Ring;
use crate::sync;
use core::sync::atomic::{AtomicBool, AtomicPtr, AtomicU64, Ordering};
use rustix::fs::{Mode, OFlags};
use std::cell::Cell;

/// Where the current thread's events go.
#[derive(Clone, Copy)]
pub(crate) enum EventSink {
    Nowhere,
    /// No ring is free: they are counted.
    Counted(&'static sync::AtomicU64),
    Ring(Ring<'static>),
}

thread_local! {
    // The place and its generation. Needs no destructor: the ring of an ended thread is given back by `process::attend`.
    static PLACE: Cell<(u64, EventSink)> = const { Cell::new((0, EventSink::Nowhere)) };
}

/// Whether rings record. Relaxed: a few events more or less around the switch do not matter.
static ON: AtomicBool = AtomicBool::new(false);

pub(crate) fn switch(on: bool) {
    ON.store(on, Ordering::Relaxed);
}

/// Whether this process's rings record.
#[inline(always)]
pub(crate) fn is_on() -> bool {
    ON.load(Ordering::Relaxed)
}

/// Counts the files that this process has had; zero before the first. A ring belongs to one of them.
static GENERATION: AtomicU64 = AtomicU64::new(0);

/// The current map, for threads that must not take a lock: null, or one of those that [`change_map`] has leaked.
static MAP: AtomicPtr<Map> = AtomicPtr::new(core::ptr::null_mut());

/// Makes threads use the process's new file. One caller at a time.
pub(crate) fn change_map(map: Map) {
    // SAFETY: as in `find_place`.
    if unsafe { MAP.load(Ordering::Relaxed).as_ref() } != Some(&map) {
        // Leaks one map for each address at which files were mapped: a single one, unless the size of the rings changed.
        MAP.store(Box::leak(Box::new(map)), Ordering::Release);
    }
    // Release: pairs with the Acquire in `place`.
    GENERATION.fetch_add(1, Ordering::Release);
}

pub(crate) fn generation() -> u64 {
    GENERATION.load(Ordering::Relaxed)
}

/// What [`place`] found before, if that holds for the current file.
pub(crate) fn cached() -> Option<EventSink> {
    PLACE.try_with(Cell::get).ok().filter(|(of, _)| *of == generation()).map(|(_, place)| place)
}

/// Where the current thread's events go. The first time in a thread it looks for a ring.
///
/// # Real-time
/// Wait-free; no allocation; some syscalls when it finds its ring, otherwise none.
pub(crate) fn place() -> EventSink {
    // Acquire: pairs with the Release in `change_map`.
    let generation = GENERATION.load(Ordering::Acquire);
    // The thread-local was destroyed: the thread is ending.
    let Ok((of, place)) = PLACE.try_with(Cell::get) else { return EventSink::Nowhere };
    if of == generation && matches!(place, EventSink::Ring(_)) {
        return place;
    }
    let place = find_place();
    let _ = PLACE.try_with(|cell| cell.set((generation, place)));
    place
}

#[cold]
fn find_place() -> EventSink {
    // SAFETY: null, or a leaked Map, whose memory is never unmapped. Acquire: pairs with the Release in `change_map`.
    let Some(map) = (unsafe { MAP.load(Ordering::Acquire).as_ref() }) else { return EventSink::Nowhere };
    // A thread without a ring comes here with every event, so there is no syscall if no ring is free.
    if !(0..RINGS).any(|index| map.ring(index).is_spare()) {
        return EventSink::Counted(map.unrecorded());
    }
    let tid = tautline_rt::current_tid();
    let Some(ring) = (0..RINGS).map(|index| map.ring(index)).find(|ring| ring.claim(tid)) else {
        return EventSink::Counted(map.unrecorded());
    };
    if tid == std::process::id() {
        set_name(ring, b"main");
    } else {
        let mut name = [0; 16];
        let len = comm(&mut name);
        set_name(ring, name.get(..len).unwrap_or_default());
    }
    EventSink::Ring(ring)
}

pub(crate) fn set_name(ring: Ring<'_>, name: &[u8]) {
    for (to, from) in ring.head.name.iter().zip(name_to_words(name)) {
        to.store(from, Ordering::Relaxed);
    }
}

/// Reads the kernel's name of the current thread, without allocating. Returns its length.
fn comm(name: &mut [u8; 16]) -> usize {
    let file = rustix::fs::open(c"/proc/thread-self/comm", OFlags::RDONLY | OFlags::CLOEXEC, Mode::empty());
    let read = file.and_then(|file| rustix::io::read(file, &mut name[..])).unwrap_or(0);
    name[..read].iter().position(|byte| *byte == b'\n').unwrap_or(read)
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's own trace file: made with the first membership of a domain, given up with the last one.
//!
//! The file is mapped at one address for good; when the last membership ends, zeros take its place there. So a thread may
//! keep a reference to its ring for ever.

use crate::control::{self, Asked};
use crate::error::TraceError;
use crate::hot;
use crate::layout::{Map, RINGS, name_to_words, state};
use crate::object::{Description, FreeEntries};
use crate::recorder;
use crate::ring::Ring;
use crate::settings::{TraceMode, TraceSettings};
use crate::sync::{AtomicU64 as AtomicU64Shared, Ordering};
use core::sync::atomic::{AtomicPtr, AtomicU64};
use rustix::fs::{FallocateFlags, FlockOperation, Mode, OFlags};
use std::cell::Cell;
use std::hash::{BuildHasher, Hasher};
use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

static PROCESS: Mutex<Process> = Mutex::new(Process {
    settings: None,
    memberships: 0,
    file: None,
    region: None,
    free: FreeEntries::none(),
});

/// Counts the files that this process has had; zero before the first. Rings are of one of them.
static GENERATION: AtomicU64 = AtomicU64::new(0);

struct Process {
    settings: Option<TraceSettings>,
    memberships: usize,
    file: Option<Own>,
    /// Where files of this process are mapped.
    region: Option<Map>,
    free: FreeEntries,
}

/// The file while there is a membership. Its lock says that its owner lives.
struct Own {
    domain: u32,
    path: PathBuf,
    file: OwnedFd,
    map: Map,
    mode: TraceMode,
}

/// Says what this process lets be traced, instead of `TAUT_TRACE` and `TAUT_TRACE_EVENTS`. For the file that is made with the
/// first membership of a domain, so call it before.
pub fn configure(settings: TraceSettings) {
    process().settings = Some(settings);
}

fn process() -> MutexGuard<'static, Process> {
    PROCESS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A membership of a domain, whose end it tells when it is dropped.
#[derive(Debug)]
#[must_use = "nothing can be traced after it is dropped"]
pub struct Membership(());

/// Begins a membership of `domain`. With the first one of the process this makes its trace file, in which all of the process
/// is recorded: of memberships of several domains at once, the first one's recorder gets all.
///
/// # Errors
/// [`TraceError`]: a variable that is not understood, a file that cannot be made.
pub fn join(domain: u32) -> Result<Membership, TraceError> {
    let mut process = process();
    if process.memberships == 0 {
        let settings = match process.settings {
            Some(settings) => settings,
            None => TraceSettings::of_environment()?,
        };
        if settings.mode != TraceMode::Off {
            recorder::remove_dead_files(domain);
            process.open(domain, settings)?;
        }
    }
    process.memberships += 1;
    Ok(Membership(()))
}

impl Drop for Membership {
    fn drop(&mut self) {
        let mut process = process();
        process.memberships -= 1;
        if process.memberships == 0
            && let Some(own) = process.file.take()
        {
            own.give_up();
        }
    }
}

/// Looks whether a recorder is there, and gives rings of ended threads back. For a low-priority thread, now and then.
pub fn attend() {
    if let Some(own) = &process().file {
        own.attend();
    }
}

impl Process {
    fn open(&mut self, domain: u32, settings: TraceSettings) -> Result<(), TraceError> {
        let own = loop {
            if let Some(own) = Own::create(domain, settings, self.region)? {
                break own;
            }
        };
        self.region = Some(own.map);
        self.free = FreeEntries::all();
        own.prepare_rings(SPARE);
        let known = MAP.load(Ordering::Relaxed);
        // SAFETY: as in `find_place`.
        if unsafe { known.as_ref() } != Some(&own.map) {
            // One for each place where a file of this process was mapped: one, unless the size of its rings changed.
            MAP.store(Box::leak(Box::new(own.map)), Ordering::Release);
        }
        // Release: pairs with the Acquire in `place`.
        GENERATION.fetch_add(1, Ordering::Release);
        own.map.state().store(
            if settings.mode == TraceMode::On { state::ALWAYS } else { state::OFF },
            Ordering::Relaxed,
        );
        hot::switch(settings.mode == TraceMode::On);
        own.attend();
        self.file = Some(own);
        Ok(())
    }
}

impl Own {
    /// `None` if the file was taken for a dead owner's between its creation and its locking.
    fn create(domain: u32, settings: TraceSettings, region: Option<Map>) -> Result<Option<Own>, TraceError> {
        let path = control::path_of(domain, &format!("p{:016x}", random()));
        let make = || -> io::Result<Option<Own>> {
            let flags = OFlags::CREATE | OFlags::EXCL | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let file = rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR)?;
            rustix::fs::flock(&file, FlockOperation::LockExclusive)?;
            if rustix::fs::fstat(&file)?.st_nlink == 0 {
                return Ok(None);
            }
            rustix::fs::ftruncate(&file, Map::bytes(settings.ring_events) as u64)?;
            for range in Map::fixed_ranges() {
                claim(&file, range)?;
            }
            let map = Map::of_file(&file, settings.ring_events, region)?;
            let name = std::fs::read("/proc/self/comm").unwrap_or_default();
            map.claim(std::process::id(), name_to_words(name.strip_suffix(b"\n").unwrap_or(&name)));
            Ok(Some(Own { domain, path: path.clone(), file, map, mode: settings.mode }))
        };
        make().map_err(|source| TraceError::File { path: path.clone(), source })
    }

    fn attend(&self) {
        let asked = control::asked(self.domain);
        if self.mode != TraceMode::On {
            let wanted = if asked == Asked::Record { state::ASKED } else { state::OFF };
            if self.map.state().load(Ordering::Relaxed) != wanted {
                hot::switch(wanted == state::ASKED);
                if asked == Asked::Nothing {
                    // The recorder was killed. What it left would turn up in the next recording.
                    self.discard();
                }
                // Release: pairs with the Acquire of the recorder, which then fetches the last events.
                self.map.state().store(wanted, Ordering::Release);
            }
        }
        self.give_back_rings(asked);
        self.prepare_rings(SPARE);
    }

    fn discard(&self) {
        for index in 0..RINGS {
            let head = self.map.ring(index).head;
            head.drained.store(head.committed.load(Ordering::Relaxed), Ordering::Relaxed);
        }
    }

    /// A ring whose thread has ended is free when a recorder has everything; without a recorder also when rings run short.
    fn give_back_rings(&self, asked: Asked) {
        let owners = |index: &usize| self.map.ring(*index).head.tid.load(Ordering::Relaxed);
        let free = (0..RINGS).filter(|index| owners(index) == 0).count();
        for index in 0..RINGS {
            let (ring, tid) = (self.map.ring(index), owners(&index));
            if tid == 0 || std::path::Path::new(&format!("/proc/self/task/{tid}")).exists() {
                continue;
            }
            if !ring.is_drained() {
                if asked != Asked::Nothing || free >= RINGS / 4 {
                    continue;
                }
                let committed = ring.head.committed.load(Ordering::Relaxed);
                let drained = ring.head.drained.swap(committed, Ordering::Relaxed);
                self.map.unrecorded().fetch_add(committed.wrapping_sub(drained), Ordering::Relaxed);
            }
            // Release: pairs with the Acquire of the next owner.
            ring.head.tid.store(0, Ordering::Release);
        }
    }

    /// Gives rings memory, until `spare` of those that have it are nobody's.
    fn prepare_rings(&self, spare: usize) {
        let is_free = |ring: &Ring| ring.head.tid.load(Ordering::Relaxed) == 0;
        let rings = || (0..RINGS).map(|index| (index, self.map.ring(index)));
        let ready = |ring: &Ring| ring.head.ready.load(Ordering::Relaxed) != 0;
        let missing = spare.saturating_sub(rings().filter(|(_, ring)| ready(ring) && is_free(ring)).count());
        for (index, ring) in rings().filter(|(_, ring)| !ready(ring)).take(missing) {
            if claim(&self.file, self.map.ring_range(index)).is_err() {
                return;
            }
            ring.touch();
            // Release: pairs with the Acquire in `Ring::claim`.
            ring.head.ready.store(1, Ordering::Release);
        }
    }

    /// What nobody has fetched stays for a recorder.
    fn give_up(self) {
        hot::switch(false);
        if self.map.is_drained() {
            let _ = rustix::fs::unlink(&self.path);
        }
        // Should this fail, the pages stay until the process ends.
        let _ = self.map.forget_file();
    }
}

/// Memory for a part of the file, now: written to without it, a full /dev/shm would kill the process.
fn claim(file: &OwnedFd, (offset, length): (u64, u64)) -> rustix::io::Result<()> {
    rustix::fs::fallocate(file, FallocateFlags::empty(), offset, length)
}

// ---- Objects ----

/// An entry of the table of a generation.
#[derive(Debug)]
pub(crate) struct Entry {
    index: usize,
    generation: u64,
}

pub(crate) fn describe(object: &Description) -> Option<Entry> {
    let mut process = process();
    let Process { file: Some(own), free, .. } = &mut *process else { return None };
    let index = free.take().filter(|index| claim(&own.file, own.map.object_range(*index)).is_ok());
    let Some(index) = index else {
        own.map.undescribed().fetch_add(1, Ordering::Relaxed);
        return None;
    };
    own.map.layout().objects[index].write(object);
    // Release: pairs with the Acquire of the recorder, which then looks at the table.
    own.map.described().fetch_add(1, Ordering::Release);
    Some(Entry { index, generation: GENERATION.load(Ordering::Relaxed) })
}

pub(crate) fn forget(entry: Entry) {
    let mut process = process();
    if process.file.is_some() && entry.generation == GENERATION.load(Ordering::Relaxed) {
        process.free.give_back(entry.index);
    }
}

// ---- Rings ----

/// Rings that have memory and wait for a thread that nobody has registered.
const SPARE: usize = 2;

/// Where the current thread's events go.
#[derive(Clone, Copy)]
pub(crate) enum Place {
    /// Nowhere: there is no file.
    Nowhere,
    /// No ring is free: they are counted.
    Counted(&'static AtomicU64Shared),
    /// To a ring.
    Ring(Ring<'static>),
}

thread_local! {
    // With the generation it is of. Needs no destructor: the ring of an ended thread is given back by `attend`.
    static PLACE: Cell<(u64, Place)> = const { Cell::new((0, Place::Nowhere)) };
}

/// The current map, for threads that must not take a lock: null, or one of those that [`Process::open`] has leaked.
static MAP: AtomicPtr<Map> = AtomicPtr::new(core::ptr::null_mut());

/// Claims a ring for the current thread under its name, and touches all of it: afterwards its events cost no syscall.
/// A thread that makes a publisher or a subscription and a callback's thread do so by themselves; any other thread does
/// with its first event, if a ring is spare.
///
/// # Real-time
/// Setup: some syscalls and page faults. Once the thread has a ring: wait-free, no syscall.
pub fn register_thread() {
    register_thread_as("");
}

/// As [`register_thread`], under a name of at most 15 bytes.
///
/// # Real-time
/// As [`register_thread`].
pub fn register_thread_as(name: &str) {
    if !matches!(cached(), Some(Place::Ring(_)))
        && let Some(own) = &process().file
    {
        // One for this thread.
        own.prepare_rings(SPARE + 1);
    }
    if let Place::Ring(ring) = place()
        && !name.is_empty()
    {
        set_name(ring, name.as_bytes());
    }
}

fn cached() -> Option<Place> {
    let generation = GENERATION.load(Ordering::Relaxed);
    PLACE.try_with(Cell::get).ok().filter(|(of, _)| *of == generation).map(|(_, place)| place)
}

/// Where the current thread's events go. The first time in a thread it looks for a ring.
///
/// # Real-time
/// Wait-free; no allocation; in a thread's first event some syscalls for its name.
pub(crate) fn place() -> Place {
    // Acquire: pairs with the Release in `open`.
    let generation = GENERATION.load(Ordering::Acquire);
    // No thread-local any more: the thread is going down.
    let Ok((of, place)) = PLACE.try_with(Cell::get) else { return Place::Nowhere };
    if of == generation && matches!(place, Place::Ring(_)) {
        return place;
    }
    let place = find_place();
    let _ = PLACE.try_with(|cell| cell.set((generation, place)));
    place
}

#[cold]
fn find_place() -> Place {
    // SAFETY: null, or a leaked Map, whose memory is never unmapped. Acquire: pairs with the Release in `open`.
    let Some(map) = (unsafe { MAP.load(Ordering::Acquire).as_ref() }) else { return Place::Nowhere };
    let tid = tautline_rt::current_tid();
    let Some(ring) = (0..RINGS).map(|index| map.ring(index)).find(|ring| ring.claim(tid)) else {
        return Place::Counted(map.unrecorded());
    };
    let mut name = [0u8; 16];
    let named = if tid == std::process::id() { copy(&mut name, b"main") } else { comm(&mut name) };
    set_name(ring, name.get(..named).unwrap_or_default());
    Place::Ring(ring)
}

fn set_name(ring: Ring<'_>, name: &[u8]) {
    for (to, from) in ring.head.name.iter().zip(name_to_words(name)) {
        to.store(from, Ordering::Relaxed);
    }
}

fn copy(to: &mut [u8], from: &[u8]) -> usize {
    to.iter_mut().zip(from).map(|(to, from)| *to = *from).count()
}

/// The name that the kernel knows the current thread by; without allocating.
fn comm(name: &mut [u8; 16]) -> usize {
    let file = rustix::fs::open(c"/proc/thread-self/comm", OFlags::RDONLY | OFlags::CLOEXEC, Mode::empty());
    let read = file.and_then(|file| rustix::io::read(file, &mut name[..])).unwrap_or(0);
    name[..read].iter().position(|byte| *byte == b'\n').unwrap_or(read)
}

/// Random enough for a name: the seeds of the standard library's hash maps.
fn random() -> u64 {
    std::collections::hash_map::RandomState::new().build_hasher().finish()
}

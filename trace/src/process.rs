// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process's own trace file: created with the first membership of a domain, released with the last one.
//!
//! The file is mapped at one address permanently; when the last membership ends, zeros are mapped there instead. So a
//! thread may keep a reference to its ring forever.

use crate::control::{self, RecorderRequest};
use crate::description::{Description, FreeEntries};
use crate::error::TraceError;
use crate::layout::{Map, RINGS, name_to_words, state};
use crate::recorder;
use crate::ring::Ring;
use crate::settings::{TraceMode, TraceSettings};
use crate::sync::Ordering;
use crate::thread;
use std::cell::Cell;
use std::time::Duration;
use tautline_rt::fork::{ProcessMark, ProcessMutex};
use tautline_rt::shm::{OwnFile, ShmError};

static PROCESS: ProcessMutex<Process> = ProcessMutex::new(Process::new(), Process::new);

/// Rings with memory that are kept for threads that were not registered.
const SPARE_RINGS: usize = 2;

struct Process {
    settings: Option<TraceSettings>,
    memberships: usize,
    file: Option<OwnTraceFile>,
    /// The address range where files of this process are mapped.
    region: Option<Map>,
    free: FreeEntries,
}

/// The file while there is a membership. Its lock says that its owner lives.
struct OwnTraceFile {
    domain: u32,
    file: OwnFile,
    map: Map,
    mode: TraceMode,
    /// How many new threads may still register before rings of ended threads are searched for.
    until_look: Cell<usize>,
}

/// Sets the trace settings of this process, instead of `TAUT_TRACE` and `TAUT_TRACE_EVENTS`. They apply to the file that is
/// created with the first membership of a domain, so call it before. A forked child has settings of its own.
pub fn configure(settings: TraceSettings) {
    PROCESS.lock().settings = Some(settings);
}

/// A membership of a domain, which ends when this is dropped.
#[derive(Debug)]
#[must_use = "nothing can be traced after it is dropped"]
pub struct Membership(ProcessMark);

/// Starts a membership of `domain`. The first membership of the process creates its trace file, in which the whole process
/// is recorded. If the process is a member of several domains at once, the recorder of the first domain gets all events.
///
/// # Errors
/// [`TraceError`]: a variable with an invalid value, a file that cannot be created.
pub fn join(domain: u32) -> Result<Membership, TraceError> {
    let mut process = PROCESS.lock();
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
    Ok(Membership(ProcessMark::new()))
}

impl Drop for Membership {
    fn drop(&mut self) {
        if !self.0.is_here() {
            return;
        }
        let mut process = PROCESS.lock();
        process.memberships -= 1;
        if process.memberships == 0
            && let Some(own) = process.file.take()
        {
            own.give_up();
        }
    }
}

/// Gives one more ring memory, for the current thread, which claims it with `claim` before another thread can.
pub(crate) fn with_spare_ring(claim: impl FnOnce()) {
    let process = PROCESS.lock();
    if let Some(own) = &process.file {
        if own.missing_rings(SPARE_RINGS + 1) > 0 {
            own.look_now_and_then();
        }
        own.prepare_rings(SPARE_RINGS + 1);
    }
    claim();
}

/// The interval of checks while there is a recorder: it may be killed, and threads end.
const PERIOD: Duration = Duration::from_millis(250);

/// Checks whether there is a recorder. If there is one, or if few rings are free, releases the rings of ended threads. For a
/// low-priority thread, when a recorder has started. Returns the time after which to check again; `None`: only when the next recorder
/// starts.
pub fn attend() -> Option<Duration> {
    let is_recorded = PROCESS.lock().file.as_ref().is_some_and(OwnTraceFile::attend);
    is_recorded.then_some(PERIOD)
}

impl Process {
    const fn new() -> Process {
        Process { settings: None, memberships: 0, file: None, region: None, free: FreeEntries::none() }
    }

    fn open(&mut self, domain: u32, settings: TraceSettings) -> Result<(), TraceError> {
        let own = OwnTraceFile::create(domain, settings, self.region)?;
        self.region = Some(own.map);
        self.free = FreeEntries::all();
        own.prepare_rings(SPARE_RINGS);
        thread::change_map(own.map);
        own.map.state().store(
            if settings.mode == TraceMode::On { state::ALWAYS } else { state::OFF },
            Ordering::Relaxed,
        );
        thread::switch(settings.mode == TraceMode::On);
        own.attend();
        self.file = Some(own);
        Ok(())
    }
}

impl OwnTraceFile {
    fn create(domain: u32, settings: TraceSettings, region: Option<Map>) -> Result<OwnTraceFile, TraceError> {
        let file = control::in_folder(domain, || OwnFile::create(&control::process_prefix(domain)))?;
        let made = (|| -> Result<Map, ShmError> {
            file.set_len(Map::bytes(settings.ring_events) as u64)?;
            for (offset, len) in Map::fixed_ranges() {
                file.claim(offset, len)?;
            }
            Map::of_file(&file, settings.ring_events, region)
                .map_err(|source| ShmError { path: file.path().to_owned(), source })
        })();
        let map = match made {
            Ok(map) => map,
            Err(error) => {
                file.retire();
                return Err(error.into());
            }
        };
        let name = std::fs::read("/proc/self/comm").unwrap_or_default();
        map.claim(std::process::id(), name_to_words(name.strip_suffix(b"\n").unwrap_or(&name)));
        Ok(OwnTraceFile { domain, file, map, mode: settings.mode, until_look: Cell::new(0) })
    }

    /// Follows the recorder's request. Returns whether there is a recorder.
    fn attend(&self) -> bool {
        let asked = control::recorder_request(self.domain);
        if self.mode != TraceMode::On {
            let wanted = if asked == RecorderRequest::Record { state::ASKED } else { state::OFF };
            if self.map.state().load(Ordering::Relaxed) != wanted {
                if wanted == state::ASKED {
                    // Drops events of threads that checked the switch before it went off: they do not belong to the next recording.
                    self.discard();
                }
                thread::switch(wanted == state::ASKED);
                if asked == RecorderRequest::Nothing {
                    // The recorder was killed. Events that it left would appear in the next recording.
                    self.discard();
                }
                // Release: pairs with the Acquire of the recorder, which then fetches the last events.
                self.map.state().store(wanted, Ordering::Release);
            }
        }
        // Without a recorder, rings are given back only before others would get memory.
        if asked != RecorderRequest::Nothing || self.missing_rings(SPARE_RINGS) > 0 {
            self.give_back_rings(asked);
        }
        self.prepare_rings(SPARE_RINGS);
        asked != RecorderRequest::Nothing
    }

    fn discard(&self) {
        for index in 0..RINGS {
            let head = self.map.ring(index).head;
            head.drained.store(head.committed.load(Ordering::Relaxed), Ordering::Relaxed);
        }
    }

    fn free_rings(&self) -> usize {
        (0..RINGS).filter(|index| self.map.ring(*index).head.tid.load(Ordering::Relaxed) == 0).count()
    }

    /// Gives back the rings of ended threads, but not for each new thread: that asks the kernel about every thread that has a ring. As many
    /// threads may come between two checks as had a ring at the first: one question for each, however many there are. But while events are
    /// recorded, a check is made whenever few rings are free, so that no thread goes without one.
    fn look_now_and_then(&self) {
        let left = self.until_look.get();
        self.until_look.set(left.saturating_sub(1));
        let is_recorded = self.map.state().load(Ordering::Relaxed) != state::OFF;
        if left == 0 || (is_recorded && self.free_rings() <= SPARE_RINGS) {
            self.give_back_rings(control::recorder_request(self.domain));
            self.until_look.set(RINGS - self.free_rings());
        }
    }

    /// A ring whose thread has ended is free when a recorder has fetched everything; without a recorder also when rings run short.
    fn give_back_rings(&self, asked: RecorderRequest) {
        let owners = |index: &usize| self.map.ring(*index).head.tid.load(Ordering::Relaxed);
        let free = self.free_rings();
        for index in 0..RINGS {
            let (ring, tid) = (self.map.ring(index), owners(&index));
            if tid == 0 || std::path::Path::new(&format!("/proc/self/task/{tid}")).exists() {
                continue;
            }
            if !ring.is_drained() {
                if asked != RecorderRequest::Nothing || free >= RINGS / 4 {
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

    /// The number of rings that must get memory, so that `spare` rings with memory are free.
    fn missing_rings(&self, spare: usize) -> usize {
        let is_spare = |ring: &Ring| is_ready(ring) && ring.head.tid.load(Ordering::Relaxed) == 0;
        spare.saturating_sub((0..RINGS).filter(|index| is_spare(&self.map.ring(*index))).count())
    }

    /// Gives rings memory, until `spare` rings with memory are free.
    fn prepare_rings(&self, spare: usize) {
        let rings = (0..RINGS).map(|index| (index, self.map.ring(index)));
        for (index, ring) in rings.filter(|(_, ring)| !is_ready(ring)).take(self.missing_rings(spare)) {
            let (offset, len) = self.map.ring_range(index);
            if self.file.claim(offset, len).is_err() {
                return;
            }
            ring.touch();
            // Release: pairs with the Acquire in `Ring::claim`.
            ring.head.ready.store(1, Ordering::Release);
        }
    }

    /// Keeps the file if it has unfetched events: for the recorder that requested them, or for any if it recorded from the start.
    fn leave(&self) {
        thread::switch(false);
        let wanted =
            self.mode == TraceMode::On || control::recorder_request(self.domain) != RecorderRequest::Nothing;
        if !wanted || self.map.is_drained() {
            self.file.retire();
            control::leave_folder(self.domain);
        }
    }

    fn give_up(self) {
        self.leave();
        // Should this fail, the pages stay until the process ends.
        let _ = self.map.forget_file();
    }
}

fn is_ready(ring: &Ring) -> bool {
    ring.head.ready.load(Ordering::Relaxed) != 0
}

/// Call at the process's end, when its threads may still write events.
pub fn leave_at_exit() {
    if let Some(own) = &PROCESS.lock().file {
        own.leave();
    }
}

// ---- Objects ----

/// An entry of the table of a generation.
#[derive(Debug)]
pub(crate) struct ObjectEntry {
    index: usize,
    generation: u64,
}

pub(crate) fn describe(object: &Description) -> Option<ObjectEntry> {
    let mut process = PROCESS.lock();
    let Process { file: Some(own), free, .. } = &mut *process else { return None };
    let index = free.take(|index| {
        let (offset, len) = own.map.object_range(index);
        own.file.claim(offset, len).is_ok()
    });
    let Some(index) = index else {
        own.map.undescribed().fetch_add(1, Ordering::Relaxed);
        return None;
    };
    own.map.layout().objects[index].write(object);
    own.map.claimed_objects().store(free.claimed() as u64, Ordering::Relaxed);
    // Release: pairs with the Acquire of the recorder, which then looks at the table.
    own.map.described().fetch_add(1, Ordering::Release);
    Some(ObjectEntry { index, generation: thread::generation() })
}

pub(crate) fn forget(entry: ObjectEntry) {
    let mut process = PROCESS.lock();
    if process.file.is_some() && entry.generation == thread::generation() {
        process.free.give_back(entry.index);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The recorder's side: finds the processes of a domain, switches their recording on, fetches their events.

use crate::control::{self, RecorderLock, RecorderRequest};
use crate::description::{self, Description};
use crate::error::TraceError;
use crate::event::Event;
use crate::layout::{Map, RINGS, state, words_to_name};
use crate::sync::Ordering;
use std::collections::{HashMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tautline_rt::domain::shared_folder;
use tautline_rt::shm::{self, PeerFile};

/// The data that a recorder finds. The data of a process follow its [`Process`](Record::Process), the events of a thread
/// follow its [`Thread`](Record::Thread).
#[derive(Debug)]
#[non_exhaustive]
pub enum Record<'r> {
    /// A process.
    Process {
        /// Its number in this recording.
        process: u32,
        /// The kernel's id of it.
        pid: u32,
        /// Its program.
        name: &'r str,
    },
    /// An object of a process's events.
    Object {
        /// The process, by its number in this recording.
        process: u32,
        /// What it is.
        object: &'r Description,
    },
    /// A thread.
    Thread {
        /// Its process, by the number in this recording.
        process: u32,
        /// The kernel's id of it.
        tid: u32,
        /// Its name.
        name: &'r str,
    },
    /// Events of one thread.
    Events {
        /// Its process, by the number in this recording.
        process: u32,
        /// The thread.
        tid: u32,
        /// The events, in order.
        events: &'r [Event],
    },
    /// Events of one thread that were overwritten before they were fetched, or that were invalid.
    Lost {
        /// Its process, by the number in this recording.
        process: u32,
        /// The thread.
        tid: u32,
        /// How many.
        events: u64,
    },
    /// Events of threads without a ring, because all rings were in use.
    Unrecorded {
        /// The process, by its number in this recording.
        process: u32,
        /// How many.
        events: u64,
    },
    /// Objects for which the table of their process had no room: events may refer to objects without a name.
    Undescribed {
        /// The process, by its number in this recording.
        process: u32,
        /// How many.
        objects: u64,
    },
    /// A process has ended, and all its data have been fetched.
    Ended {
        /// The process, by its number in this recording.
        process: u32,
    },
}

/// Records a domain: processes record events as long as this exists.
///
/// ```
/// use tautline_trace::{Record, Recorder};
/// let mut recorder = Recorder::start(1203)?;
/// let mut events = 0;
/// let mut count = |record: Record<'_>| if let Record::Events { events: new, .. } = record { events += new.len() };
/// recorder.poll(&mut count); // every few milliseconds
/// recorder.finish(&mut count);
/// assert_eq!(events, 0, "nobody is there");
/// # Ok::<(), tautline_trace::TraceError>(())
/// ```
#[derive(Debug)]
pub struct Recorder {
    domain: u32,
    control: RecorderLock,
    processes: HashMap<PathBuf, Peer>,
    /// Files that are not trace files; each is reported once.
    refused: HashSet<PathBuf>,
    complaints: Vec<String>,
    next_number: u32,
    next_scan: Instant,
}

impl Recorder {
    /// The interval between two searches for new processes.
    const SCAN_PERIOD: Duration = Duration::from_millis(100);

    /// Makes the processes of `domain` record: they notice it at their next [attend](crate::attend). Processes that start from now
    /// on record at once.
    ///
    /// # Errors
    /// [`TraceError::SecondRecorder`] if there is already one.
    pub fn start(domain: u32) -> Result<Recorder, TraceError> {
        let control = RecorderLock::claim(domain)?;
        Ok(Recorder {
            domain,
            control,
            processes: HashMap::new(),
            refused: HashSet::new(),
            complaints: Vec::new(),
            next_number: 0,
            next_scan: Instant::now(),
        })
    }

    /// Fetches the new events since the last call. A thread loses events if it fills its ring between two
    /// calls.
    pub fn poll(&mut self, sink: &mut impl FnMut(Record<'_>)) {
        if Instant::now() >= self.next_scan {
            self.scan(sink);
            self.next_scan = Instant::now() + Self::SCAN_PERIOD;
        }
        self.fetch(sink);
    }

    /// Makes every process stop recording, waits until they have stopped, at most two seconds, and fetches the
    /// rest.
    pub fn finish(mut self, sink: &mut impl FnMut(Record<'_>)) {
        const PATIENCE: Duration = Duration::from_secs(2);
        self.control.finish();
        let start = Instant::now();
        self.scan(sink);
        while self.processes.values().any(Peer::is_recording) && start.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(5));
            self.fetch(sink);
        }
        self.fetch(sink);
    }

    /// How many processes are being recorded now.
    pub fn recording(&self) -> usize {
        self.processes.values().filter(|peer| peer.map.state().load(Ordering::Relaxed) != state::OFF).count()
    }

    /// Files of this domain that could not be read, with the reason; each is reported once.
    pub fn complaints(&mut self) -> Vec<String> {
        std::mem::take(&mut self.complaints)
    }

    /// Fetches what each process has recorded. Those that have ended are removed.
    fn fetch(&mut self, sink: &mut impl FnMut(Record<'_>)) {
        for peer in self.processes.values_mut() {
            peer.fetch(sink);
        }
        self.remove_dead(sink);
    }

    fn scan(&mut self, sink: &mut impl FnMut(Record<'_>)) {
        for path in shm::list(&control::process_prefix(self.domain)).unwrap_or_default() {
            if self.processes.contains_key(&path) || self.refused.contains(&path) {
                continue;
            }
            match Peer::open(&path, self.next_number) {
                Ok(Some(peer)) => {
                    let (process, pid) = (self.next_number, peer.map.pid());
                    self.next_number += 1;
                    sink(Record::Process { process, pid, name: &peer.map.name() });
                    self.processes.insert(path, peer);
                }
                Ok(None) => {}
                Err(reason) => {
                    self.complaints.push(format!("{} is left out: {reason}", path.display()));
                    self.refused.insert(path);
                }
            }
        }
    }

    /// Removes the files of processes that have ended.
    fn remove_dead(&mut self, sink: &mut impl FnMut(Record<'_>)) {
        self.processes.retain(|_, peer| {
            // The file is not locked: its owner died, or does not need it any more.
            if peer.file.is_owned() {
                return true;
            }
            peer.fetch(sink);
            peer.file.remove_if_orphaned();
            sink(Record::Ended { process: peer.number });
            false
        });
    }
}

/// The trace file of a process. Its content is untrusted.
#[derive(Debug)]
struct Peer {
    number: u32,
    map: Map,
    file: PeerFile,
    /// The turn of each reported entry of the table.
    turns: HashMap<usize, u64>,
    /// The owner and name of each ring when it was last reported.
    owners: HashMap<usize, (u32, String)>,
    described: u64,
    unrecorded: u64,
    undescribed: u64,
}

impl Peer {
    /// Opens a trace file. `None` if it is not complete yet, or gone.
    fn open(path: &Path, number: u32) -> Result<Option<Peer>, String> {
        let file = match PeerFile::open(path.to_owned(), true) {
            Ok(file) => file,
            Err(error) if error.source.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error.source.to_string()),
        };
        let mut first = [0; 64];
        let read = rustix::io::pread(&file, &mut first, 0).map_err(|errno| errno.to_string())?;
        if first.iter().take(8).all(|byte| *byte == 0) {
            // Its owner is about to write the header, or died before.
            file.remove_if_orphaned();
            return Ok(None);
        }
        let size = file.size_bytes().map_err(|error| error.source.to_string())?;
        let events = Map::check_header(first.get(..read).unwrap_or_default(), size)?;
        let map = Map::of_file(&file, events, None).map_err(|error| error.to_string())?;
        let (turns, owners) = (HashMap::new(), HashMap::new());
        Ok(Some(Peer { number, map, file, turns, owners, described: 0, unrecorded: 0, undescribed: 0 }))
    }

    fn is_recording(&self) -> bool {
        // Acquire: pairs with the Release of the owner: its last events are seen.
        self.map.state().load(Ordering::Acquire) == state::ASKED
    }

    fn fetch(&mut self, sink: &mut impl FnMut(Record<'_>)) {
        let process = self.number;
        let mut batches = Vec::new();
        for index in 0..RINGS {
            let ring = self.map.ring(index);
            if ring.is_drained() {
                continue;
            }
            let from = ring.head.drained.load(Ordering::Relaxed);
            let mut words = Vec::new();
            let drained = ring.drain(from, &mut words);
            // Read after the events: a ring is given back only when it is drained, so the events that were just read are this thread's.
            let tid = ring.head.tid.load(Ordering::Acquire);
            batches.push((index, tid, words_to_name(&ring.head.name), words, drained));
        }
        // Objects are reported after the events are copied and before these are reported: an object is described before its events.
        self.report_objects(sink);
        for (index, tid, name, words, drained) in batches {
            let events: Vec<Event> = words.iter().filter_map(|words| Event::from_words(*words)).collect();
            let lost = drained.lost.saturating_add((words.len() - events.len()) as u64);
            if self.owners.get(&index).is_none_or(|known| (known.0, &known.1) != (tid, &name)) {
                sink(Record::Thread { process, tid, name: &name });
                self.owners.insert(index, (tid, name));
            }
            if lost != 0 {
                sink(Record::Lost { process, tid, events: lost });
            }
            if !events.is_empty() {
                sink(Record::Events { process, tid, events: &events });
            }
            self.map.ring(index).head.drained.store(drained.next, Ordering::Relaxed);
        }
        let unrecorded = self.map.unrecorded().load(Ordering::Relaxed);
        if unrecorded > self.unrecorded {
            sink(Record::Unrecorded { process, events: unrecorded - self.unrecorded });
            self.unrecorded = unrecorded;
        }
        let undescribed = self.map.undescribed().load(Ordering::Relaxed);
        if undescribed > self.undescribed {
            sink(Record::Undescribed { process, objects: undescribed - self.undescribed });
            self.undescribed = undescribed;
        }
    }

    fn report_objects(&mut self, sink: &mut impl FnMut(Record<'_>)) {
        // Acquire: pairs with the Release of the owner, who counts after writing.
        let described = self.map.described().load(Ordering::Acquire);
        if described == self.described {
            return;
        }
        self.described = described;
        for (index, turn, object) in description::entries(self.map) {
            if self.turns.insert(index, turn) != Some(turn) {
                sink(Record::Object { process: self.number, object: &object });
            }
        }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // SAFETY: rings and objects are borrowed from the map within calls of `fetch` only.
        unsafe { self.map.unmap() };
    }
}

/// Removes the files of a domain's dead processes that contain no events for a recorder. While there is a recorder, the
/// recorder does this itself.
pub fn remove_dead_files(domain: u32) {
    remove_dead_files_in(&shared_folder(domain));
}

/// The same for the domain whose folder in /dev/shm has this name, which may be of another scope.
pub fn remove_dead_files_in(folder: &str) {
    let mut files = shm::list(&control::prefix_in(folder)).unwrap_or_default();
    // Not opened for writing: that would notify the processes that watch the folder, and they would check it again.
    files.retain(|path| PeerFile::open(path.clone(), false).is_ok_and(|file| !file.is_owned()));
    if files.is_empty() || control::request_in(folder) != RecorderRequest::Nothing {
        return;
    }
    for path in files {
        // Opening it removes a file whose owner died before it wrote a header.
        if let Ok(Some(peer)) = Peer::open(&path, 0)
            && peer.map.is_drained()
        {
            peer.file.remove_if_orphaned();
        }
    }
    let _ = rustix::fs::rmdir(Path::new(shm::DIRECTORY).join(folder));
}

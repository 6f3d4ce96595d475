// SPDX-License-Identifier: MIT OR Apache-2.0
//! The warden: the one participant of a domain that detects dead participants.
//!
//! The kernel notifies it: the files of a process that dies are closed, and inotify reports this to the process that watches
//! the domain's folder. The warden then checks whether the owner's lock is free. This also works from another container, where
//! the dead process's id has no meaning.
//!
//! The lock of a pipe in the folder determines which participant is the warden. Only the warden has the pipe open for writing. All
//! other participants sleep on its read end, which the kernel hangs up when the warden dies. Then they try to lock the pipe, and one
//! of them gets the lock.

use crate::cleanup::dead_participant;
use crate::cleanup::dead_participant::{Dead, FileState};
use crate::error::TransportError;
use crate::graph::domain::{Domain, WARDEN, has_owner};
use crate::low_priority::low_priority_thread;
use crate::memory::file::{file_error, id_of};
use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use rustix::fs::inotify::{self, CreateFlags, ReadFlags, WatchFlags};
use rustix::fs::{CWD, FileType, FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::domain::shared_path;
use tautline_rt::fork::ProcessFd;
use tautline_rt::shm::{self, ShmError};

/// A file that was closed is checked at once and after each of these times: the kernel reports that a file is closed a moment before
/// it frees the lock, and a dying thread may wait for a core that real-time threads have. If the lock is held even after the last one,
/// another process than the owner has closed the file.
const AGAIN: [Duration; 8] = [
    Duration::from_millis(1),
    Duration::from_millis(4),
    Duration::from_millis(8),
    Duration::from_millis(16),
    Duration::from_millis(200),
    Duration::from_secs(1),
    Duration::from_secs(10),
    Duration::from_secs(60),
];
/// How often all files are checked if the kernel does not report closed files.
const PERIOD: Duration = Duration::from_millis(40);
/// The pause before the next attempt to become the warden, or to check a file, if the system refuses.
const RETRY: Duration = Duration::from_secs(1);

/// Handle of a participant's thread that is the warden or waits to become it; dropping it ends the thread and waits for it.
pub(crate) struct Warden {
    stop: Arc<ProcessFd>,
    thread: Option<tautline_rt::JoinHandle<()>>,
}

impl Warden {
    /// If there is no warden, this participant becomes the warden, and has cleaned up after all dead
    /// participants when this returns.
    pub(crate) fn start(domain: &Arc<Domain>) -> Result<Self, TransportError> {
        let candidate = Candidate::new(domain)?;
        let warden = match candidate.elect()? {
            Election::Won(warden) => Some(warden),
            Election::Lost | Election::Removed => None,
        };
        let stop = candidate.stop.clone();
        let builder = low_priority_thread("warden").map_err(TransportError::Thread)?;
        let thread = builder.spawn(move || move || candidate.run(warden)).map_err(TransportError::Thread)?;
        Ok(Warden { stop, thread: Some(thread) })
    }
}

impl Drop for Warden {
    fn drop(&mut self) {
        let _ = rustix::io::write(&*self.stop, &1_u64.to_ne_bytes());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The result of an attempt to become the warden.
enum Election {
    Won(ActiveWarden),
    /// Another participant is the warden.
    Lost,
    /// The domain's files were removed while they were in use: participants that joined after that have another domain, with
    /// its own warden.
    Removed,
}

/// A participant that is not the warden yet.
struct Candidate {
    domain: Arc<Domain>,
    path: PathBuf,
    /// Hung up when there is no warden.
    pipe: OwnedFd,
    stop: Arc<ProcessFd>,
}

impl Candidate {
    fn new(domain: &Arc<Domain>) -> Result<Self, TransportError> {
        let path = shared_path(domain.number()).join(WARDEN);
        let open = || -> io::Result<OwnedFd> {
            match rustix::fs::mknodat(CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0) {
                Ok(()) | Err(Errno::EXIST) => {}
                Err(errno) => return Err(errno.into()),
            }
            // Opened before the attempt to lock it: if that fails, there is a warden, and this end is hung up when the warden dies.
            let pipe = rustix::fs::open(&path, flags(OFlags::RDONLY), Mode::empty())?;
            shm::check_owner(&pipe)?;
            if FileType::from_raw_mode(rustix::fs::fstat(&pipe)?.st_mode) != FileType::Fifo {
                return Err(io::Error::other("it is no pipe: remove it"));
            }
            Ok(pipe)
        };
        let pipe = open().map_err(|source| file_error(ShmError { path: path.clone(), source }))?;
        let stop = ProcessFd::make(|| eventfd(0, EventfdFlags::CLOEXEC));
        let stop = Arc::new(stop.map_err(|errno| file_error(refused(&path, errno)))?);
        Ok(Candidate { domain: domain.clone(), path, pipe, stop })
    }

    /// Makes this participant the warden, if there is none.
    fn elect(&self) -> Result<Election, TransportError> {
        let refuse = |errno| file_error(refused(&self.path, errno));
        // Closed after this process's file, which must be unlocked when the next warden checks it; before files that take long to close.
        let open = || {
            rustix::fs::open(&self.path, flags(OFlags::RDWR), Mode::empty())
                .map(|pipe| shm::closed_early(pipe, 128))
        };
        let pipe = match ProcessFd::make(open) {
            Err(Errno::NOENT) => return Ok(Election::Removed),
            pipe => pipe.map_err(refuse)?,
        };
        let file = |pipe: BorrowedFd<'_>| rustix::fs::fstat(pipe).map(|stat| (stat.st_dev, stat.st_ino));
        if file(pipe.as_fd()).map_err(refuse)? != file(self.pipe.as_fd()).map_err(refuse)? {
            return Ok(Election::Removed);
        }
        match rustix::fs::flock(&pipe, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => {}
            Err(Errno::WOULDBLOCK) => return Ok(Election::Lost),
            Err(errno) => return Err(refuse(errno)),
        }
        let mut warden = ActiveWarden {
            _pipe: pipe,
            watch: watch(self.path.parent()),
            suspects: BTreeMap::new(),
            dead: Vec::new(),
            kept: BTreeSet::new(),
            look_all_ns: 0,
        };
        // After the watch was added, so that events during the cleanup are not missed.
        warden.clean_up_all(&self.domain, false);
        Ok(Election::Won(warden))
    }

    /// Runs until the thread is stopped.
    fn run(self, warden: Option<ActiveWarden>) {
        let (mut warden, mut is_said) = (warden, false);
        loop {
            match &mut warden {
                Some(warden) => {
                    if self.is_stopped(warden.watch.as_ref(), warden.pause()) {
                        // There may be no next warden.
                        let is_last = self.domain.members().count() <= 1;
                        return warden.clean_up_all(&self.domain, is_last);
                    }
                    warden.listen(&self.domain);
                    warden.check_due(&self.domain);
                }
                None => {
                    let (pipe, retry) = match self.elect() {
                        Ok(Election::Won(own)) => {
                            warden = Some(own);
                            continue;
                        }
                        Ok(Election::Lost) => (Some(&self.pipe), None),
                        Ok(Election::Removed) => (None, None),
                        Err(error) => {
                            if !std::mem::replace(&mut is_said, true) {
                                tracing::warn!(
                                    "this process cannot look after those that died: {error} (logged once)"
                                );
                            }
                            (None, Some(RETRY))
                        }
                    };
                    if self.is_stopped(pipe, retry) {
                        return;
                    }
                }
            }
        }
    }

    /// Sleeps until there is an event at `file`, `pause` is over, or the thread is stopped. Returns whether it is stopped.
    fn is_stopped(&self, file: Option<&OwnedFd>, pause: Option<Duration>) -> bool {
        let pause = pause
            .map(|pause| Timespec { tv_sec: pause.as_secs() as i64, tv_nsec: pause.subsec_nanos().into() });
        let mut polled = [PollFd::new(&*self.stop, PollFlags::IN), PollFd::new(&*self.stop, PollFlags::IN)];
        if let Some(file) = file {
            polled[1] = PollFd::new(file, PollFlags::IN);
        }
        // An interruption is a wake-up like any other.
        let _ = poll(&mut polled, pause.as_ref());
        polled[0].revents().contains(PollFlags::IN)
    }
}

fn flags(access: OFlags) -> OFlags {
    access | OFlags::NONBLOCK | OFlags::CLOEXEC | OFlags::NOFOLLOW
}

fn refused(path: &Path, errno: Errno) -> ShmError {
    ShmError { path: path.to_owned(), source: errno.into() }
}

/// Watches the folder by inotify; `None` if the kernel refuses.
fn watch(folder: Option<&Path>) -> Option<OwnedFd> {
    let watched = inotify::init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).and_then(|watch| {
        inotify::add_watch(
            &watch,
            folder.unwrap_or(Path::new("")),
            WatchFlags::CLOSE_WRITE | WatchFlags::DELETE,
        )?;
        Ok(watch)
    });
    watched
        .inspect_err(|error| {
            tracing::warn!(
                "the kernel does not report processes that die ({error}), so Tautline polls for them {} times a second: raise \
                 fs.inotify.max_user_instances and fs.inotify.max_user_watches (sysctl)",
                1000 / PERIOD.as_millis()
            );
        })
        .ok()
}

/// The state of the participant that is the warden.
struct ActiveWarden {
    _pipe: ProcessFd,
    watch: Option<OwnedFd>,
    /// Files to check, and when; how often they were checked.
    suspects: BTreeMap<String, (u64, usize)>,
    /// Participants that have died and are not cleaned up yet.
    dead: Vec<Dead>,
    /// Files of dead participants that must stay until they are removed from outside.
    kept: BTreeSet<String>,
    /// When to check all files, because they could not be listed before; 0: not necessary.
    look_all_ns: u64,
}

impl ActiveWarden {
    fn suspect(&mut self, name: &str) {
        if has_owner(name) && !self.kept.contains(name) {
            self.suspects.insert(name.to_owned(), (0, 0));
        }
    }

    fn suspect_all(&mut self, domain: &Domain) {
        match dead_participant::names(domain.number()) {
            Ok(names) => names.iter().for_each(|name| self.suspect(name)),
            Err(_) => self.look_all_ns = monotonic_ns() + RETRY.as_nanos() as u64,
        }
    }

    /// Cleans up after all participants that are dead by now; unless this one is the last, those whose publishers had ended may be left
    /// for later.
    fn clean_up_all(&mut self, domain: &Domain, is_last: bool) {
        self.suspect_all(domain);
        self.check_due(domain);
        self.dead.iter_mut().filter(|_| is_last).for_each(Dead::hurry);
        while let Some(dead) = self.dead.iter().find(|dead| dead.is_urgent()) {
            std::thread::sleep(dead.period());
            dead_participant::clean_up(domain, &mut self.dead);
        }
    }

    /// The time until the next check or cleanup; `None` if only an event makes one necessary.
    fn pause(&self) -> Option<Duration> {
        let next = self.suspects.values().map(|(due_ns, _)| *due_ns).min();
        let next = next.map(|due_ns| Duration::from_nanos(due_ns.saturating_sub(monotonic_ns())));
        let look = self.watch.is_none().then_some(PERIOD);
        let look_all = (self.look_all_ns != 0)
            .then(|| Duration::from_nanos(self.look_all_ns.saturating_sub(monotonic_ns())));
        let clean_up = self.dead.iter().map(Dead::period).min();
        [next, look, look_all, clean_up].into_iter().flatten().min()
    }

    /// Reads the events of the watch, and suspects the files that were closed; without a watch, all files.
    fn listen(&mut self, domain: &Domain) {
        let Some(watch) = self.watch.take() else {
            if self.suspects.is_empty() {
                self.suspect_all(domain);
            }
            return;
        };
        let mut buffer = [MaybeUninit::uninit(); 4096];
        let mut reader = inotify::Reader::new(&watch, &mut buffer);
        loop {
            let event = match reader.next() {
                Ok(event) => event,
                Err(Errno::INTR) => continue,
                Err(_) => break,
            };
            if event.events().contains(ReadFlags::QUEUE_OVERFLOW) {
                self.suspect_all(domain);
            }
            let Some(name) = event.file_name().and_then(|name| name.to_str().ok()) else { continue };
            if event.events().contains(ReadFlags::DELETE) {
                // A member's file was removed, but not by the warden: the member's janitor reports this.
                let member = domain.members().find(|member| Some(member.id) == id_of(name));
                member.inspect(|member| domain.call(member.place));
                self.kept.remove(name);
            } else {
                self.suspect(name);
            }
        }
        self.watch = Some(watch);
    }

    /// Checks the files that are due, and cleans up after dead participants.
    fn check_due(&mut self, domain: &Domain) {
        let now_ns = monotonic_ns();
        if self.look_all_ns != 0 && self.look_all_ns <= now_ns {
            self.look_all_ns = 0;
            self.suspect_all(domain);
        }
        let due = |(_, (due_ns, _)): &(&String, &(u64, usize))| *due_ns <= now_ns;
        let names: Vec<String> = self.suspects.iter().filter(due).map(|(name, _)| name.clone()).collect();
        for name in names {
            let looks = self.suspects.remove(&name).map_or(0, |(_, looks)| looks);
            // The pause before the next check.
            let again = AGAIN.get(looks).copied();
            let pause = match dead_participant::check_file(domain, &name) {
                Ok(FileState::Gone) => None,
                Ok(FileState::Dead(dead)) => {
                    self.dead.push(dead);
                    None
                }
                Ok(FileState::Kept) => {
                    self.kept.insert(name.clone());
                    None
                }
                Ok(FileState::Owned) => again.filter(|_| self.watch.is_some()),
                Err(error) if error.is_passing() => Some(again.unwrap_or(RETRY).min(RETRY)),
                // A file of another user, or a folder: it stays.
                Err(_) => None,
            };
            if let Some(pause) = pause {
                self.suspects.insert(name, (now_ns + pause.as_nanos() as u64, looks + 1));
            }
        }
        dead_participant::clean_up(domain, &mut self.dead);
    }
}

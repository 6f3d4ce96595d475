// SPDX-License-Identifier: MIT OR Apache-2.0
//! The participants of a domain: one file in its folder, with an entry for each participant, and a word that changes when
//! anything in the domain changes.
//!
//! | in the file | written by |
//! |---|---|
//! | the domain's id, a random number | the process that creates the file |
//! | the epoch, a futex word: changes when a node, a port or a participant appears or disappears | the process that makes this change |
//! | a member's id | the participant that takes the entry; the process that cleans up after it sets it to 0 |
//! | a member's generation: changes when its record changes | that participant |
//! | a growth count: changes when the segments of its publishers' samples change | that participant |
//! | a member's calls, a futex word on which its janitor sleeps | any process that wakes this janitor |
//!
//! Every member holds a shared lock of the file. A leaving member that gets the lock exclusively is the last one, and removes the
//! domain's files; killed processes hold no locks. The last member does the same at the end of its process, although threads of the
//! process still run. If it is not the last one, the other members clean up after it when it is dead: until then its threads may hold
//! samples.

use crate::error::TransportError;
use crate::memory::file::id_of;
use rustix::fs::{AtFlags, FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use std::io;
use std::mem::offset_of;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_rt::domain::{shared_folder, shared_path};
use tautline_rt::fork::{ProcessFd, ProcessMark};
use tautline_rt::shm::{self, Mapping, ShmError};
use tautline_rt::{FutexWord, Patience, PiMutex};

const MAGIC: u64 = u64::from_le_bytes(*b"tautdom2");
/// Greatest domain number, as in ROS 2.
pub const MAX_DOMAIN: u32 = 232;
/// Participants of a domain at once.
pub(crate) const MEMBERS: usize = 2048;
pub(crate) const NAME: &str = "domain";
/// The pipe by which members know that there is a warden.
pub(crate) const WARDEN: &str = "warden";

/// Whether a file of the domain's folder has one owner. The domain's file and the warden's pipe have none: all members share them.
pub(crate) fn has_owner(name: &str) -> bool {
    name != WARDEN && name != NAME
}

/// How long a joining participant waits for the domain's former last member to remove its files.
const PATIENCE: Duration = Duration::from_secs(2);

/// The content of the domain's file. All bit patterns are valid values.
#[repr(C)]
struct Layout {
    magic: AtomicU64,
    epoch: FutexWord,
    /// Entries from this index on were never used.
    end: AtomicU32,
    /// Distinguishes this domain from domains of other hosts, users and scopes, and from the same domain at
    /// another time.
    id: AtomicU64,
    members: [MemberSlot; MEMBERS],
}

#[repr(C, align(64))]
struct MemberSlot {
    /// The participant's id; 0: the entry is free.
    id: AtomicU64,
    generation: AtomicU64,
    /// Changes when the segments of samples of one of its publishers change.
    grown: AtomicU32,
    calls: FutexWord,
}

/// Checks that the domain's number is in range and that the scope is valid.
pub(crate) fn check_domain(domain: u32) -> Result<(), TransportError> {
    if domain > MAX_DOMAIN {
        return Err(TransportError::DomainRange { domain, max: MAX_DOMAIN });
    }
    tautline_rt::domain::scope()?;
    Ok(())
}

/// The mapped file of a domain, and the shared lock of it.
pub(crate) struct Domain {
    number: u32,
    file: ProcessFd,
    map: Mapping,
    has_left: PiMutex<bool>,
    process: ProcessMark,
}

/// A member's entry, as it was read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Seen {
    pub(crate) place: usize,
    pub(crate) id: u64,
    pub(crate) generation: u64,
    pub(crate) grown: u32,
}

impl Domain {
    /// Joins the domain: makes its folder and its file if they are not there.
    pub(crate) fn join(number: u32) -> Result<Arc<Self>, TransportError> {
        // A failed join leaves no empty folder behind.
        Self::make_and_join(number).inspect_err(|_| _ = rustix::fs::rmdir(shared_path(number)))
    }

    fn make_and_join(number: u32) -> Result<Arc<Self>, TransportError> {
        let path = shared_path(number).join(NAME);
        let refuse = |source: io::Error| TransportError::File { path: path.clone(), source };
        let mut patience = Patience::new(PATIENCE);
        let mut is_made = false;
        loop {
            shm::make_folder(&shared_folder(number))
                .map_err(|ShmError { path, source }| TransportError::File { path, source })?;
            match Self::open(&path).map_err(refuse)? {
                Opened::Whole(file, map) => return Ok(Self::of(number, file, map)),
                Opened::Other => return Err(TransportError::Version { path }),
                Opened::Missing if patience.is_over() => {
                    return Err(refuse(io::Error::other(
                        "it is made and not there: is /proc mounted, and this process's own?",
                    )));
                }
                Opened::Missing => {
                    if std::mem::replace(&mut is_made, true) {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    make(&path).map_err(refuse)?;
                }
                // The last member is removing the domain right now, unless its process is stopped.
                Opened::Leaving if patience.is_over() => {
                    return Err(refuse(io::Error::other(
                        "the last process of this domain is removing it and makes no progress: continue or kill it if it is stopped",
                    )));
                }
                Opened::Leaving => std::thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// Opens the domain for a reader that does not join it; `None` if the domain has no members.
    pub(crate) fn visit(number: u32) -> Result<Option<Arc<Self>>, TransportError> {
        let path = shared_path(number).join(NAME);
        match Self::open(&path) {
            Ok(Opened::Whole(file, map)) => Ok(Some(Self::of(number, file, map))),
            Ok(Opened::Other) => Err(TransportError::Version { path }),
            Ok(Opened::Missing | Opened::Leaving) => Ok(None),
            Err(source) => Err(TransportError::File { path, source }),
        }
    }

    fn of(number: u32, file: ProcessFd, map: Mapping) -> Arc<Self> {
        let (has_left, process) = (PiMutex::default(), ProcessMark::new());
        Arc::new(Domain { number, file, map, has_left, process })
    }

    fn open(path: &Path) -> io::Result<Opened> {
        let flags = OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
        let mut is_locked = true;
        let file = ProcessFd::make(|| -> io::Result<_> {
            let file = rustix::fs::open(path, flags, Mode::empty())?;
            shm::check_owner(&file)?;
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockShared) {
                Err(Errno::WOULDBLOCK) => is_locked = false,
                locked => locked?,
            }
            Ok(file)
        });
        let file = match file {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Opened::Missing),
            Ok(_) if !is_locked => return Ok(Opened::Leaving),
            file => file?,
        };
        let stat = rustix::fs::fstat(&file)?;
        if stat.st_nlink == 0 {
            return Ok(Opened::Leaving);
        }
        if u64::try_from(stat.st_size).unwrap_or(0) < size_of::<Layout>() as u64 {
            return Ok(Opened::Other);
        }
        let map = Mapping::new(&file, 0, size_of::<Layout>(), true)?;
        match layout(&map).magic.load(Ordering::Acquire) {
            MAGIC => Ok(Opened::Whole(file, map)),
            _ => Ok(Opened::Other),
        }
    }

    pub(crate) fn number(&self) -> u32 {
        self.number
    }

    fn layout(&self) -> &Layout {
        layout(&self.map)
    }

    /// The random number that distinguishes this domain from all others.
    pub(crate) fn id(&self) -> u64 {
        self.layout().id.load(Ordering::Relaxed)
    }

    pub(crate) fn epoch(&self) -> u32 {
        // Acquire: pairs with the Release in `advance`; members and records that are read after this show that change.
        self.layout().epoch.0.load(Ordering::Acquire)
    }

    /// Changes the epoch, and wakes all threads that wait for a change.
    pub(crate) fn advance(&self) {
        self.layout().epoch.0.fetch_add(1, Ordering::Release);
        self.layout().epoch.wake();
    }

    /// Sleeps until the epoch is not `since`, at most for `timeout`. Returns the epoch.
    pub(crate) fn wait(&self, since: u32, timeout: Option<Duration>) -> u32 {
        let end_ns =
            timeout.map(|timeout| monotonic_ns().saturating_add(nanoseconds(timeout)).min(i64::MAX as u64));
        while self.epoch() == since && end_ns.is_none_or(|end_ns| monotonic_ns() < end_ns) {
            self.layout().epoch.wait(since, end_ns);
        }
        self.epoch()
    }

    /// The current members. Reads at most as many entries as were ever in use at once.
    pub(crate) fn members(&self) -> impl Iterator<Item = Seen> + '_ {
        let end = (self.layout().end.load(Ordering::Acquire) as usize).min(MEMBERS);
        self.layout().members[..end].iter().enumerate().filter_map(|(place, member)| {
            // Acquire: pairs with the Release in `add`, which took the entry, and in `changed` and `grew`.
            let id = member.id.load(Ordering::Acquire);
            let generation = member.generation.load(Ordering::Acquire);
            let grown = member.grown.load(Ordering::Acquire);
            (id != 0).then_some(Seen { place, id, generation, grown })
        })
    }

    /// Takes an entry for a participant, and returns its index.
    pub(crate) fn add(&self, id: u64) -> Result<usize, TransportError> {
        // Loaded before the exchange, so that entries that are taken stay in the caches of all cores.
        let take = |member: &MemberSlot| {
            member.id.load(Ordering::Relaxed) == 0
                && member.id.compare_exchange(0, id, Ordering::AcqRel, Ordering::Relaxed).is_ok()
        };
        let place = self.layout().members.iter().position(take);
        let place = place.ok_or(TransportError::Members { domain: self.number, limit: MEMBERS })?;
        self.layout().end.fetch_max(place as u32 + 1, Ordering::AcqRel);
        self.advance();
        Ok(place)
    }

    /// Frees the entry of a participant. Returns whether it had one.
    pub(crate) fn remove(&self, id: u64) -> bool {
        let free = |member: &MemberSlot| {
            member.id.load(Ordering::Relaxed) == id
                && member.id.compare_exchange(id, 0, Ordering::AcqRel, Ordering::Relaxed).is_ok()
        };
        let removed = self.layout().members.iter().any(free);
        if removed {
            self.advance();
        }
        removed
    }

    /// Announces that the record of the member at `place` has changed.
    pub(crate) fn changed(&self, place: usize) {
        if let Some(member) = self.layout().members.get(place) {
            member.generation.fetch_add(1, Ordering::Release);
        }
        self.advance();
    }

    /// Announces that a publisher of the member at `place` has added or removed a segment of samples.
    pub(crate) fn grew(&self, place: usize) {
        if let Some(member) = self.layout().members.get(place) {
            member.grown.fetch_add(1, Ordering::Release);
        }
    }

    /// The word on which the janitor of the member at `place` sleeps.
    ///
    /// # Panics
    /// If there is no such place.
    pub(crate) fn calls(&self, place: usize) -> &FutexWord {
        &self.layout().members[place].calls
    }

    /// Wakes the janitor of the member at `place`.
    ///
    /// # Real-time
    /// Wait-free; one futex wake.
    pub(crate) fn call(&self, place: usize) {
        let Some(member) = self.layout().members.get(place) else { return };
        member.calls.0.fetch_add(1, Ordering::Release);
        member.calls.wake();
    }

    /// Wakes the janitors of all members.
    pub(crate) fn call_all(&self) {
        self.members().for_each(|member| self.call(member.place));
    }

    /// Whether somebody has removed the file.
    pub(crate) fn is_removed(&self) -> bool {
        !shm::has_name(&self.file)
    }

    /// Returns an error in a forked child of the process that joined.
    pub(crate) fn check_process(&self) -> Result<(), TransportError> {
        if self.process.is_here() { Ok(()) } else { Err(TransportError::Forked { domain: self.number }) }
    }

    /// Leaves the domain: this process is no longer a member, or ends right now. The last member removes the domain's files and its folder.
    /// Traces of killed processes stay for a recorder. Does nothing in a forked child, which was not a member.
    pub(crate) fn leave(&self) {
        if !self.process.is_here() {
            return;
        }
        let mut has_left = self.has_left.lock();
        if std::mem::replace(&mut has_left, true) {
            return;
        }
        if rustix::fs::flock(&self.file, FlockOperation::NonBlockingLockExclusive).is_err()
            || self.is_removed()
        {
            return;
        }
        remove_files(&shared_folder(self.number));
    }

    /// Whether this process has left the domain because it ends.
    pub(crate) fn has_left(&self) -> bool {
        *self.has_left.lock()
    }
}

/// Removes the files of a domain. The caller holds the exclusive lock of its file. Traces of killed processes stay for a recorder.
fn remove_files(folder: &str) {
    // A participant's file belongs to one that was killed when there was no warden any more, or to a process that ends right now.
    for file in shm::list(&format!("{folder}/")).unwrap_or_default() {
        let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        if id_of(name).is_some() {
            let _ = rustix::fs::unlink(file);
        } else if has_owner(name)
            && !tautline_trace::is_trace_file(name)
            && let Ok(file) = shm::PeerFile::open(file, false)
        {
            file.remove_if_orphaned();
        }
    }
    let folder = Path::new(shm::DIRECTORY).join(folder);
    let _ = rustix::fs::unlink(folder.join(WARDEN));
    let _ = rustix::fs::unlink(folder.join(NAME));
    let _ = rustix::fs::rmdir(folder);
}

/// The domain's file, exclusively locked, if all processes of the domain were killed; `None` for another user's or version's file.
fn lock_dead(folder: &str) -> Option<shm::PeerFile> {
    let file = shm::PeerFile::open(Path::new(shm::DIRECTORY).join(folder).join(NAME), false).ok()?;
    let mut magic = [0; 8];
    let is_known = rustix::io::pread(&file, &mut magic, 0) == Ok(magic.len()) && magic == MAGIC.to_ne_bytes();
    let is_dead = is_known && rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok();
    (is_dead && shm::has_name(&file)).then_some(file)
}

/// Whether all processes of the domain whose folder in /dev/shm has this name were killed, so that nobody has cleaned up after them.
pub fn is_dead_domain(folder: &str) -> bool {
    lock_dead(folder).is_some()
}

/// Removes the files of a dead domain: all that its last member would have removed. Traces that nobody has fetched stay. Returns
/// whether the domain was dead.
pub fn remove_dead_domain(folder: &str) -> bool {
    // A process that joins meanwhile waits for the lock, and then finds that the file has no name.
    let locked = lock_dead(folder);
    if locked.is_some() {
        tautline_trace::remove_dead_files_in(folder);
        remove_files(folder);
    }
    locked.is_some()
}

impl Drop for Domain {
    fn drop(&mut self) {
        self.leave();
    }
}

fn layout(map: &Mapping) -> &Layout {
    // SAFETY: callers pass a mapping of a whole Layout at the start of a page, of a file that is at least as long; any bytes are valid.
    unsafe { map.start().cast().as_ref() }
}

enum Opened {
    /// The file is valid, and locked.
    Whole(ProcessFd, Mapping),
    /// The file is of another version.
    Other,
    Missing,
    /// The file is being removed.
    Leaving,
}

/// Creates the file atomically: complete, or not at all.
fn make(path: &Path) -> io::Result<()> {
    let Some(folder) = path.parent() else { return Ok(()) };
    let file = match rustix::fs::open(
        folder,
        OFlags::TMPFILE | OFlags::RDWR | OFlags::CLOEXEC,
        Mode::RUSR | Mode::WUSR,
    ) {
        // The domain's former last member removes the folder right now.
        Err(Errno::NOENT) => return Ok(()),
        file => file?,
    };
    shm::claim(&file, 0, size_of::<Layout>() as u64)?;
    rustix::io::pwrite(&file, &MAGIC.to_ne_bytes(), 0)?;
    rustix::io::pwrite(&file, &shm::random().to_ne_bytes(), offset_of!(Layout, id) as u64)?;
    let unnamed = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&file));
    let here = rustix::fs::CWD;
    match rustix::fs::linkat(here, unnamed.as_str(), here, path, AtFlags::SYMLINK_FOLLOW) {
        // Another process was faster, or the folder was removed.
        Ok(()) | Err(Errno::EXIST | Errno::NOENT) => Ok(()),
        Err(errno) => Err(errno.into()),
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::tests::isolated;

    #[test]
    fn the_last_one_removes_it() {
        isolated();
        let folder = shared_path(230);
        let one = Domain::join(230).unwrap();
        let other = Domain::join(230).unwrap();
        assert_eq!((one.add(5).unwrap(), other.add(7).unwrap()), (0, 1));
        one.changed(0);
        let seen: Vec<_> = other.members().map(|seen| (seen.place, seen.id, seen.generation)).collect();
        assert_eq!(seen, [(0, 5, 1), (1, 7, 0)]);
        assert!(other.remove(5) && !other.remove(5));
        assert_eq!(one.add(9).unwrap(), 0, "a place that is free again");
        drop(one);
        assert!(folder.join(NAME).exists());
        drop(other);
        assert!(!folder.exists() && Domain::visit(230).unwrap().is_none());
        let again = Domain::join(230).unwrap();
        assert_eq!(again.members().count(), 0);
    }

    #[test]
    fn what_is_no_domain_is_named() {
        isolated();
        let folder = shared_folder(231);
        shm::make_folder(&folder).unwrap();
        let path = Path::new(shm::DIRECTORY).join(folder).join(NAME);
        for content in [vec![], vec![1; 100], vec![1; size_of::<Layout>()]] {
            std::fs::write(&path, &content).unwrap();
            let error = Domain::join(231).map(drop).unwrap_err().to_string();
            assert!(error.contains(&*path.to_string_lossy()) && error.contains("version"), "{error}");
            assert!(Domain::visit(231).is_err());
        }
        std::fs::remove_file(&path).unwrap();
        std::fs::remove_dir(path.parent().unwrap()).unwrap();
    }

    #[test]
    fn who_waits_is_woken_by_a_change() {
        isolated();
        let domain = Domain::join(229).unwrap();
        let epoch = domain.epoch();
        assert_eq!(domain.wait(epoch, Some(Duration::ZERO)), epoch);
        let waiter = {
            let domain = domain.clone();
            std::thread::spawn(move || domain.wait(epoch, None))
        };
        domain.advance();
        assert_ne!(waiter.join().unwrap(), epoch);
    }
}

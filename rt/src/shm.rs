// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files in /dev/shm: private to their user, created and owned by one process, mapped by others.
//!
//! The owner holds the lock of its file as long as it is alive. The kernel releases the lock when the owner dies, so a
//! process that can lock a file may remove it. Any user may create files in /dev/shm, under any name. Another user could
//! truncate its file while it is mapped here, which would kill the reader. So files of other users are not opened.

use std::ffi::c_void;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::ptr::{NonNull, null_mut};

use rustix::fs::{FallocateFlags, FileType, FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use rustix::mm::{Advice, MapFlags, ProtFlags};
use std::sync::Arc;

use crate::fork::{self, ProcessFd, ProcessMark};

/// The folder of named shared memory.
pub const DIRECTORY: &str = "/dev/shm";

/// The size of a page: mappings of files begin at multiples of it. 4,096 bytes on most systems, 16,384 or 65,536 on some of Arm.
///
/// # Real-time
/// Wait-free; no syscall.
pub fn page_bytes() -> usize {
    rustix::param::page_size()
}

/// The system's error for a file.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct ShmError {
    /// The file.
    pub path: PathBuf,
    /// Why.
    pub source: io::Error,
}

impl ShmError {
    fn of(path: &Path) -> impl Fn(io::Error) -> ShmError {
        move |source| ShmError { path: path.to_owned(), source }
    }
}

impl From<ShmError> for io::Error {
    fn from(error: ShmError) -> io::Error {
        io::Error::new(error.source.kind(), error)
    }
}

/// Creates a folder of this user in /dev/shm, unless it exists.
///
/// # Errors
/// [`ShmError`]: it cannot be created, or is not a folder to which only this user can write.
pub fn make_folder(name: &str) -> Result<(), ShmError> {
    let path = Path::new(DIRECTORY).join(name);
    let make = || -> io::Result<()> {
        let flags = OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::RDONLY | OFlags::CLOEXEC;
        let folder = loop {
            let is_made = match rustix::fs::mkdir(&path, Mode::RWXU) {
                Ok(()) => true,
                Err(Errno::EXIST) => false,
                Err(errno) => return Err(errno.into()),
            };
            match rustix::fs::open(&path, flags, Mode::empty()) {
                // Its owner has removed it since: create it again.
                Err(Errno::NOENT) if !is_made => {}
                folder => break folder?,
            }
        };
        check_owner(&folder)?;
        let mode = Mode::from_raw_mode(rustix::fs::fstat(&folder)?.st_mode);
        if mode.intersects(Mode::WGRP | Mode::WOTH) {
            return Err(io::Error::other("others can write to it: remove it"));
        }
        Ok(())
    };
    make().map_err(ShmError::of(&path))
}

/// A file that this process created. Dropping this does not remove it: see [`retire`](Self::retire).
#[derive(Debug)]
pub struct OwnFile {
    path: PathBuf,
    id: u64,
    file: ProcessFd,
    owner: ProcessMark,
}

impl OwnFile {
    /// Creates an empty file whose name is `prefix`, which may begin with a folder, followed by a random number in 16
    /// hexadecimal digits.
    ///
    /// # Real-time
    /// Setup only.
    pub fn create(prefix: &str) -> Result<OwnFile, ShmError> {
        loop {
            let id = random();
            let path = Path::new(DIRECTORY).join(format!("{prefix}{id:016x}"));
            match Self::create_at(path, id) {
                // Another process is checking whether the file's owner is alive, and may be stopped while it does: try another name.
                Err(error) if error.source.kind() == io::ErrorKind::WouldBlock => {}
                made => return made,
            }
        }
    }

    /// Creates an empty file at `path`, with the number `id`.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`ShmError`]; of the kind `WouldBlock` if another process removed it, as a file of a dead owner, before it was
    /// locked.
    pub fn create_at(path: PathBuf, id: u64) -> Result<OwnFile, ShmError> {
        let make = || -> io::Result<OwnedFd> {
            let flags = OFlags::CREATE | OFlags::EXCL | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let file = rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR)?;
            let locked = rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive);
            if locked.is_ok() && has_name(&file) {
                return Ok(closed_early(file, OWN_FILES));
            }
            let _ = rustix::fs::unlink(&path);
            locked?;
            Err(Errno::WOULDBLOCK.into())
        };
        match ProcessFd::make(make) {
            Ok(file) => Ok(OwnFile { path, id, file, owner: ProcessMark::new() }),
            Err(source) => Err(ShmError { path, source }),
        }
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The number in its name; not 0.
    pub fn id(&self) -> u64 {
        self.id
    }

    /// Claims memory for `len` bytes from `offset` on; the file grows if necessary. Without this, a write at a full
    /// /dev/shm would kill the process; with it, a full /dev/shm is an error here.
    ///
    /// # Real-time
    /// Setup only.
    pub fn claim(&self, offset: u64, len: u64) -> Result<(), ShmError> {
        claim(&self.file, offset, len).map_err(ShmError::of(&self.path))
    }

    /// Releases the memory of `len` bytes from `offset` on; they then read as zeros. Whole pages only.
    pub fn give_back(&self, offset: u64, len: u64) -> Result<(), ShmError> {
        let flags = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
        let punched = rustix::fs::fallocate(&self.file, flags, offset, len);
        punched.map_err(|errno| ShmError::of(&self.path)(errno.into()))
    }

    /// Sets the file's length to `len` bytes, without claiming memory.
    pub fn set_len(&self, len: u64) -> Result<(), ShmError> {
        rustix::fs::ftruncate(&self.file, len).map_err(|errno| ShmError::of(&self.path)(errno.into()))
    }

    /// Removes the file and unlocks it: for other processes, its owner has ended. Existing mappings keep the
    /// content. Does nothing in a forked child, which does not own it.
    pub fn retire(&self) {
        if !self.owner.is_here() {
            return;
        }
        let _ = rustix::fs::unlink(&self.path);
        let _ = rustix::fs::flock(&self.file, FlockOperation::Unlock);
    }
}

impl AsFd for OwnFile {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

/// The numbers of own files' descriptors begin here.
const OWN_FILES: i32 = 256;

/// Moves a descriptor to a number of at least `least`. The kernel closes a dead process's descriptors from the highest number down,
/// and some take long (10 ms for an inotify instance). Descriptors whose closing other processes wait for must be closed before those.
/// Own files begin at 256.
pub fn closed_early(file: OwnedFd, least: i32) -> OwnedFd {
    // Refused beyond the limit of open files.
    rustix::io::fcntl_dupfd_cloexec(&file, least).unwrap_or(file)
}

/// Another process's file. Its content is untrusted. It remains readable after that process has ended.
#[derive(Debug)]
pub struct PeerFile {
    path: PathBuf,
    file: OwnedFd,
}

impl PeerFile {
    /// Opens a file of this user's for reading, and for writing too if `writable`.
    ///
    /// # Errors
    /// [`ShmError`]; a file of another user is an error.
    pub fn open(path: PathBuf, writable: bool) -> Result<PeerFile, ShmError> {
        let access = if writable { OFlags::RDWR } else { OFlags::RDONLY };
        // Not blocking: opening a pipe would wait for a process at its other end.
        let flags = access | OFlags::CLOEXEC | OFlags::NOFOLLOW | OFlags::NONBLOCK;
        let open = || -> io::Result<OwnedFd> {
            let file = rustix::fs::open(&path, flags, Mode::empty())?;
            check_owner(&file)?;
            if FileType::from_raw_mode(rustix::fs::fstat(&file)?.st_mode) != FileType::RegularFile {
                return Err(io::Error::other("it is no regular file: remove it"));
            }
            Ok(file)
        };
        match open() {
            Ok(file) => Ok(PeerFile { path, file }),
            Err(source) => Err(ShmError { path, source }),
        }
    }

    /// Its path; the file may have been removed.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its present length.
    pub fn size_bytes(&self) -> Result<u64, ShmError> {
        let stat = rustix::fs::fstat(&self.file).map_err(|errno| ShmError::of(&self.path)(errno.into()))?;
        Ok(u64::try_from(stat.st_size).unwrap_or(0))
    }

    /// Whether the process that created it is alive. The file's lock shows this, because process ids repeat.
    pub fn is_owned(&self) -> bool {
        let free = rustix::fs::flock(&self.file, FlockOperation::NonBlockingLockShared).is_ok();
        if free {
            let _ = rustix::fs::flock(&self.file, FlockOperation::Unlock);
        }
        !free
    }

    /// Removes the file of a process that was killed. Does nothing if its owner is alive.
    pub fn remove_if_orphaned(&self) -> bool {
        if rustix::fs::flock(&self.file, FlockOperation::NonBlockingLockExclusive).is_err() {
            return false;
        }
        // Not locked: its owner died, or has not locked it yet and will then create another file.
        let removed = rustix::fs::unlink(&self.path).is_ok();
        let _ = rustix::fs::flock(&self.file, FlockOperation::Unlock);
        removed
    }
}

impl AsFd for PeerFile {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.file.as_fd()
    }
}

/// The files whose names begin with `prefix`, which may begin with a folder, in the order of their names; none if there is no
/// such folder.
///
/// # Errors
/// [`ShmError`] if the folder cannot be read.
pub fn list(prefix: &str) -> Result<Vec<PathBuf>, ShmError> {
    let (folder, prefix) = prefix.rsplit_once('/').unwrap_or(("", prefix));
    let folder = Path::new(DIRECTORY).join(folder);
    let entries = match std::fs::read_dir(&folder) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(ShmError::of(&folder))?,
    };
    let mut paths: Vec<PathBuf> = entries
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix))
        .map(|entry| entry.path())
        .collect();
    paths.sort();
    Ok(paths)
}

/// Checks that a file belongs to this user.
///
/// # Errors
/// Names the user to whom it belongs.
pub fn check_owner(file: impl AsFd) -> io::Result<()> {
    let user = rustix::fs::fstat(file)?.st_uid;
    if user == rustix::process::geteuid().as_raw() {
        return Ok(());
    }
    Err(io::Error::other(format!("it belongs to user {user}: remove it as that user, or as root")))
}

/// Whether a file has not been removed.
pub fn has_name(file: impl AsFd) -> bool {
    rustix::fs::fstat(file).is_ok_and(|stat| stat.st_nlink != 0)
}

/// Like [`OwnFile::claim`], for a file that several processes share.
///
/// # Errors
/// The system's error.
pub fn claim(file: impl AsFd, offset: u64, len: u64) -> io::Result<()> {
    claim_by(offset, len, |offset, len| rustix::fs::fallocate(&file, FallocateFlags::empty(), offset, len))
}

/// The number of bytes that one call claims at first: 0.1 to 1 ms of work.
const CLAIM_BYTES: u64 = 1 << 20;
/// How often in a row a signal may end the claim of a page.
const CLAIM_TRIES: u32 = 1_000;

/// Claims in steps: if a signal comes, older kernels (5.15, 6.1) take back what the call has claimed, and a program with a timer would
/// never get a large piece. Steps that a signal ends become shorter, those after longer again.
fn claim_by(
    offset: u64,
    len: u64,
    mut claim: impl FnMut(u64, u64) -> rustix::io::Result<()>,
) -> io::Result<()> {
    let (page, end) = (rustix::param::page_size() as u64, offset.saturating_add(len));
    let (mut at, mut step, mut tries) = (offset, CLAIM_BYTES, 0);
    // The system refuses a length of zero.
    while at < end || len == 0 {
        let len = step.min(end - at);
        match claim(at, len) {
            Err(Errno::INTR) if tries < CLAIM_TRIES => {
                tries += u32::from(step <= page);
                step = (step / 2).max(page);
            }
            claimed => {
                claimed?;
                (at, step, tries) = (at + len, (step * 2).min(CLAIM_BYTES), 0);
            }
        }
    }
    Ok(())
}

/// A mapped part of a file. Its content may change at any time: read and write it only with atomics. In a forked child it is zeros.
#[derive(Debug)]
pub struct Mapping {
    start: NonNull<c_void>,
    len_bytes: usize,
}

// SAFETY: a mapping is memory of the process, not of a thread; code that creates references into it is responsible for them.
unsafe impl Send for Mapping {}
// SAFETY: as above.
unsafe impl Sync for Mapping {}

impl Mapping {
    /// Maps `len_bytes` from `offset` on, a multiple of the page size.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The system's error: a length of zero, an offset within a page.
    pub fn new(file: impl AsFd, offset: u64, len_bytes: usize, writable: bool) -> io::Result<Mapping> {
        let access = if writable { ProtFlags::READ | ProtFlags::WRITE } else { ProtFlags::READ };
        let address = fork::map_shared(len_bytes, || {
            // SAFETY: a new shared mapping at an address of the kernel's choice.
            unsafe { rustix::mm::mmap(null_mut(), len_bytes, access, MapFlags::SHARED, file, offset) }
        })?;
        let start = NonNull::new(address).ok_or_else(|| io::Error::other("mapped at address zero"))?;
        Ok(Mapping { start, len_bytes })
    }

    /// Zeroed memory of this process only, which uses memory only where it is written.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The system's error: a length of zero, too many mappings.
    pub fn scratch(len_bytes: usize) -> io::Result<Mapping> {
        let flags = MapFlags::PRIVATE | MapFlags::NORESERVE;
        let access = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: a new mapping at an address of the kernel's choice.
        let address = unsafe { rustix::mm::mmap_anonymous(null_mut(), len_bytes, access, flags) }?;
        let start = NonNull::new(address).ok_or_else(|| io::Error::other("mapped at address zero"))?;
        Ok(Mapping { start, len_bytes })
    }

    /// Its start, at a page boundary. Mapped as long as this exists.
    pub fn start(&self) -> NonNull<c_void> {
        self.start
    }

    /// How many bytes are mapped.
    pub fn len_bytes(&self) -> usize {
        self.len_bytes
    }

    /// Brings in the pages of `len_bytes` from `offset_bytes` on, so that their use causes no page fault: for writing if
    /// `writable`, in which case the mapping must be writable. The file's memory must have been claimed before.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The system's error: beyond the end of the mapping or of the file.
    pub fn populate(&self, offset_bytes: usize, len_bytes: usize, writable: bool) -> io::Result<()> {
        let end = offset_bytes.checked_add(len_bytes).filter(|end| *end <= self.len_bytes);
        let Some(end) = end else { return Err(io::Error::other("beyond the end of the mapping")) };
        let page = page_bytes();
        let (from, to) = (offset_bytes / page * page, end.next_multiple_of(page).min(self.len_bytes));
        let advice = if writable { Advice::LinuxPopulateWrite } else { Advice::LinuxPopulateRead };
        // SAFETY: within the mapping, as checked; bringing pages in changes nothing that lies there.
        unsafe { rustix::mm::madvise(self.start.as_ptr().byte_add(from), to - from, advice) }?;
        Ok(())
    }
}

/// Part of a mapping. It keeps the mapping alive.
#[derive(Clone, Debug)]
pub struct Region {
    map: Arc<Mapping>,
    offset_bytes: usize,
    len_bytes: usize,
}

impl Region {
    /// `len_bytes` from `offset_bytes` on; `None` if that is beyond the mapping's end.
    pub fn new(map: &Arc<Mapping>, offset_bytes: usize, len_bytes: usize) -> Option<Region> {
        let end = offset_bytes.checked_add(len_bytes)?;
        (end <= map.len_bytes()).then(|| Region { map: map.clone(), offset_bytes, len_bytes })
    }

    /// Its start. Mapped as long as this or a clone exists.
    pub fn start(&self) -> NonNull<c_void> {
        // SAFETY: within the mapping, as `new` checked.
        unsafe { self.map.start().byte_add(self.offset_bytes) }
    }

    /// Its length.
    pub fn len_bytes(&self) -> usize {
        self.len_bytes
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        fork::unmap_shared(self.start.as_ptr(), || {
            // SAFETY: it came from mmap with this length, and nothing borrows from a dropped Mapping.
            let _ = unsafe { rustix::mm::munmap(self.start.as_ptr(), self.len_bytes) };
        });
    }
}

/// A random number, never 0: random enough for a name (from the seeds of the standard library's hash maps), but not for a
/// secret.
pub fn random() -> u64 {
    use std::hash::{BuildHasher, Hasher};
    std::collections::hash_map::RandomState::new().build_hasher().finish() | 1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prefix(name: &str) -> String {
        format!("taut_rt_test_{}_{name}_", std::process::id())
    }

    #[test]
    fn who_owns_a_file_is_known_by_its_lock() {
        let prefix = prefix("lock");
        let own = OwnFile::create(&prefix).unwrap();
        assert_eq!(list(&prefix).unwrap(), [own.path()]);
        assert!(own.id() != 0 && own.path().to_string_lossy().ends_with(&format!("{:016x}", own.id())));
        let peer = PeerFile::open(own.path().to_owned(), false).unwrap();
        assert!(peer.is_owned() && !peer.remove_if_orphaned());
        // As if it was killed: the lock goes, the name stays.
        drop(own);
        assert!(!peer.is_owned() && peer.remove_if_orphaned());
        assert!(!has_name(&peer) && list(&prefix).unwrap().is_empty());
        own_is_gone(&peer);
    }

    fn own_is_gone(peer: &PeerFile) {
        let error = PeerFile::open(peer.path().to_owned(), false).unwrap_err();
        assert_eq!(error.source.kind(), io::ErrorKind::NotFound);
        assert!(error.to_string().starts_with("/dev/shm/taut_rt_test_"), "{error}");
    }

    /// A kernel that claims so many bytes between two signals, and takes back what a call has claimed that was interrupted.
    fn claimed_between_signals(bytes: u64, offset: u64, len: u64) -> (io::Result<()>, Vec<(u64, u64)>, u32) {
        let (mut done, mut calls, mut left) = (Vec::new(), 0, bytes);
        let result = claim_by(offset, len, |at, len| {
            calls += 1;
            if len > left {
                left = bytes;
                return Err(Errno::INTR);
            }
            left -= len;
            done.push((at, len));
            Ok(())
        });
        (result, done, calls)
    }

    #[test]
    fn signals_do_not_keep_memory_from_being_claimed() {
        let page = rustix::param::page_size() as u64;
        for (bytes, len) in
            [(u64::MAX, 512 << 20), (3 << 20, 512 << 20), (2 * page, 4 << 20), (page, 64 * page)]
        {
            let (result, done, calls) = claimed_between_signals(bytes, page, len + 1);
            result.unwrap();
            let mut at = page;
            for (offset, len) in done {
                assert!(offset == at && len <= CLAIM_BYTES);
                at += len;
            }
            assert_eq!(at, page + len + 1);
            assert!(u64::from(calls) <= 4 * (len / page + 1), "{calls}");
        }
        let (result, done, calls) = claimed_between_signals(0, 0, page);
        assert_eq!(result.unwrap_err().raw_os_error(), Some(Errno::INTR.raw_os_error()));
        assert!(done.is_empty() && calls < CLAIM_TRIES + 20, "it ends");
        assert_eq!(claim_by(0, 0, |_, _| Err(Errno::INVAL)).unwrap_err().kind(), io::ErrorKind::InvalidInput);
    }

    #[test]
    fn memory_is_claimed_in_a_program_with_a_timer() {
        extern "C" fn nothing(_: libc::c_int) {}
        // SAFETY: a handler that does nothing, and a timer of the process, which ends below; nextest gives each test a process.
        let set = |us| unsafe {
            libc::signal(libc::SIGALRM, nothing as *const () as usize);
            let time = libc::timeval { tv_sec: 0, tv_usec: us };
            libc::setitimer(
                libc::ITIMER_REAL,
                &libc::itimerval { it_interval: time, it_value: time },
                std::ptr::null_mut(),
            )
        };
        let own = OwnFile::create(&prefix("timer")).unwrap();
        assert_eq!(set(500), 0);
        let claimed = own.claim(0, 64 << 20);
        set(0);
        own.retire();
        claimed.unwrap();
        assert!(rustix::fs::fstat(&own).unwrap().st_blocks * 512 >= 64 << 20);
    }

    #[test]
    fn a_pipe_is_refused_and_not_waited_at() {
        let path = Path::new(DIRECTORY).join(prefix("pipe"));
        rustix::fs::mknodat(rustix::fs::CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        let error = PeerFile::open(path.clone(), false).unwrap_err().to_string();
        std::fs::remove_file(&path).unwrap();
        assert!(error.ends_with("it is no regular file: remove it"), "{error}");
    }

    #[test]
    fn a_file_of_another_user_is_not_opened() {
        let own = OwnFile::create(&prefix("user")).unwrap();
        if std::os::unix::fs::chown(own.path(), Some(65534), None).is_err() {
            eprintln!("skipped: only root gives files away");
            return own.retire();
        }
        let error = PeerFile::open(own.path().to_owned(), true).unwrap_err();
        own.retire();
        assert!(error.to_string().contains("it belongs to user 65534: remove it as"), "{error}");
    }
}

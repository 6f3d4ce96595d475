// SPDX-License-Identifier: MIT OR Apache-2.0
//! Blocks of 64-bit words that one thread writes and others read, of this process or of another.

use std::ffi::c_void;
use std::fmt;
use std::io;
use std::ops::Deref;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::ptr::{NonNull, null_mut};
use std::slice;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::fs::{FallocateFlags, FlockOperation, Mode, OFlags};
use rustix::mm::{MapFlags, ProtFlags};
use rustix::param::page_size;

const DIRECTORY: &str = "/dev/shm";
const WORD_BYTES: usize = size_of::<AtomicU64>();

/// A block of words: private, or in a file that other processes read. All zeros at first.
pub struct Words {
    memory: Memory,
}

enum Memory {
    Private(Box<[AtomicU64]>),
    Shared(Mapping),
}

impl Words {
    /// Words that only this process sees.
    ///
    /// # Real-time
    /// Setup only: allocates, and touches what it allocates.
    pub fn private(len: usize) -> Words {
        Words { memory: Memory::Private((0..len).map(|_| AtomicU64::new(0)).collect()) }
    }
}

impl Deref for Words {
    type Target = [AtomicU64];

    fn deref(&self) -> &[AtomicU64] {
        match &self.memory {
            Memory::Private(words) => words,
            // SAFETY: the mapping is writable and lives as long as `self`; its pages belong to the file, which only grows.
            // Every bit pattern is a valid AtomicU64.
            Memory::Shared(map) => unsafe { slice::from_raw_parts(map.start.as_ptr().cast(), map.len) },
        }
    }
}

impl fmt::Debug for Words {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Words").field("len", &self.len()).finish_non_exhaustive()
    }
}

/// A file of words in /dev/shm. The process that made it holds it locked as long as it lives and removes it at its end; if
/// it was killed, whoever can lock the file may remove it.
#[derive(Debug)]
pub struct WordsFile {
    path: PathBuf,
    file: OwnedFd,
}

impl WordsFile {
    /// Makes a file whose name begins with `prefix`.
    ///
    /// # Errors
    /// What the system said, with the path.
    pub fn create(prefix: &str) -> io::Result<WordsFile> {
        loop {
            let path = Path::new(DIRECTORY).join(format!("{prefix}{:016x}", random()));
            let flags = OFlags::CREATE | OFlags::EXCL | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let file = rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR)
                .map_err(|errno| with_path(&path, errno.into()))?;
            let made = WordsFile { path, file };
            // Waits: a reader that looks whether this file's owner lives may hold the lock for a moment.
            rustix::fs::flock(&made.file, FlockOperation::LockExclusive)?;
            // Not if it was taken for a dead owner's before it was locked.
            if rustix::fs::fstat(&made.file)?.st_nlink > 0 {
                return Ok(made);
            }
        }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Removes the file and unlocks it, before the last of its words goes: to readers its owner has ended.
    pub fn retire(&self) {
        let _ = rustix::fs::unlink(&self.path);
        let _ = rustix::fs::flock(&self.file, FlockOperation::Unlock);
    }

    /// Maps `len` words that begin `at` words into the file, a multiple of [`page_words`]; the file grows if need be.
    ///
    /// # Real-time
    /// Setup only: touches every page, so that using them later faults none.
    ///
    /// # Errors
    /// What the system said, with the path.
    pub fn map(&self, at: usize, len: usize) -> io::Result<Words> {
        let map = || -> io::Result<Words> {
            // Claims the memory: a full /dev/shm is an error here, not a SIGBUS later.
            let (start_bytes, len_bytes) = ((at * WORD_BYTES) as u64, (len * WORD_BYTES) as u64);
            rustix::fs::fallocate(&self.file, FallocateFlags::empty(), start_bytes, len_bytes)?;
            let map = Mapping::new(&self.file, at, len, ProtFlags::READ | ProtFlags::WRITE)?;
            Ok(Words { memory: Memory::Shared(map) })
        };
        let words = map().map_err(|error| with_path(&self.path, error))?;
        for word in words.iter().step_by(page_words()) {
            // A locked instruction writes, whatever the word holds, and changes nothing.
            word.fetch_add(0, Ordering::Relaxed);
        }
        Ok(words)
    }
}

impl Drop for WordsFile {
    fn drop(&mut self) {
        self.retire();
    }
}

/// Another process's file, to be read. What it holds are claims. It stays readable when that process has ended.
#[derive(Debug)]
pub struct ForeignWords {
    path: PathBuf,
    file: OwnedFd,
}

impl ForeignWords {
    /// This user's files whose names begin with `prefix`, in the order of their names.
    ///
    /// # Errors
    /// If /dev/shm cannot be read.
    pub fn list(prefix: &str) -> io::Result<Vec<ForeignWords>> {
        let mut paths: Vec<PathBuf> = std::fs::read_dir(DIRECTORY)
            .map_err(|error| with_path(Path::new(DIRECTORY), error))?
            .flatten()
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(prefix))
            .map(|entry| entry.path())
            .collect();
        paths.sort();
        let flags = OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NOFOLLOW;
        // One that cannot be opened has just gone. One that is somebody else's could be cut short while it is read, which
        // would kill the reader.
        let user = rustix::process::geteuid().as_raw();
        let open = |path: PathBuf| {
            let file = rustix::fs::open(&path, flags, Mode::empty()).ok()?;
            let is_own = rustix::fs::fstat(&file).ok()?.st_uid == user;
            is_own.then_some(ForeignWords { path, file })
        };
        Ok(paths.into_iter().filter_map(open).collect())
    }

    /// Where it is, or was.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the process that made it lives. Its lock says so: process numbers repeat.
    pub fn is_owned(&self) -> bool {
        let free = rustix::fs::flock(&self.file, FlockOperation::NonBlockingLockShared).is_ok();
        if free {
            let _ = rustix::fs::flock(&self.file, FlockOperation::Unlock);
        }
        !free
    }

    /// Removes the file of a process that was killed. Does nothing if its owner lives.
    pub fn remove_if_orphaned(&self) -> bool {
        if rustix::fs::flock(&self.file, FlockOperation::NonBlockingLockExclusive).is_err() {
            return false;
        }
        // Not locked: its owner died, or has not come to lock it and will then make another one.
        let removed = rustix::fs::unlink(&self.path).is_ok();
        let _ = rustix::fs::flock(&self.file, FlockOperation::Unlock);
        removed
    }

    /// How many words the file has now.
    ///
    /// # Errors
    /// What the system said, with the path.
    pub fn size_words(&self) -> io::Result<usize> {
        let bytes = size_bytes(&self.file).map_err(|error| with_path(&self.path, error))?;
        Ok(usize::try_from(bytes).unwrap_or(0) / WORD_BYTES)
    }

    /// Copies `len` words that begin `at` words into the file, a multiple of [`page_words`], each as it is when it is
    /// read, in ascending order. The writer notices nothing.
    ///
    /// # Errors
    /// What the system said, with the path; an error if the file is shorter.
    pub fn read(&self, at: usize, len: usize) -> io::Result<Vec<u64>> {
        if self.size_words()? < at + len {
            let error = io::Error::other("shorter than it should be: made by another version of Tautline?");
            return Err(with_path(&self.path, error));
        }
        let map = Mapping::new(&self.file, at, len, ProtFlags::READ)
            .map_err(|error| with_path(&self.path, error))?;
        let word = |index: usize| {
            // SAFETY: the index is within the mapping, which is readable; a load does not write. Acquire: pairs with
            // the writer's Release stores.
            unsafe { (*map.start.as_ptr().cast::<AtomicU64>().add(index)).load(Ordering::Acquire) }
        };
        Ok((0..len).map(word).collect())
    }
}

/// Words in a page: where a mapping may begin.
pub fn page_words() -> usize {
    page_size() / WORD_BYTES
}

/// Part of a file, in memory.
struct Mapping {
    start: NonNull<c_void>,
    len: usize,
}

// SAFETY: a mapping is memory of the process, not of a thread, and holds atomics only.
unsafe impl Send for Mapping {}
// SAFETY: as above: shared access is through atomics.
unsafe impl Sync for Mapping {}

impl Mapping {
    fn new(file: &OwnedFd, at: usize, len: usize, access: ProtFlags) -> io::Result<Mapping> {
        let (bytes, offset) = (len * WORD_BYTES, (at * WORD_BYTES) as u64);
        // SAFETY: a new shared mapping at an address of the kernel's choice; it refuses a length of zero and an offset
        // within a page.
        let address = unsafe { rustix::mm::mmap(null_mut(), bytes, access, MapFlags::SHARED, file, offset) }?;
        let start = NonNull::new(address).ok_or_else(|| io::Error::other("mapped at address zero"))?;
        Ok(Mapping { start, len })
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: it came from mmap with this length, and nothing borrows from a dropped Mapping.
        let _ = unsafe { rustix::mm::munmap(self.start.as_ptr(), self.len * WORD_BYTES) };
    }
}

fn size_bytes(file: &OwnedFd) -> io::Result<u64> {
    Ok(u64::try_from(rustix::fs::fstat(file)?.st_size).unwrap_or(0))
}

fn with_path(path: &Path, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

/// Random enough for a name: the seeds of the standard library's hash maps.
fn random() -> u64 {
    use std::hash::{BuildHasher, Hasher};
    std::collections::hash_map::RandomState::new().build_hasher().finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prefix(name: &str) -> String {
        format!("taut_rt_test_{}_{name}_", std::process::id())
    }

    #[test]
    fn what_is_written_is_read_elsewhere_and_outlives_the_file() {
        let prefix = prefix("read");
        let file = WordsFile::create(&prefix).unwrap();
        let (first, second) = (file.map(0, 8).unwrap(), file.map(page_words(), 3).unwrap());
        first[7].store(7, Ordering::Relaxed);
        second[2].store(u64::MAX, Ordering::Release);
        let found = ForeignWords::list(&prefix).unwrap();
        let [found] = found.as_slice() else { panic!("{found:?}") };
        assert_eq!((found.path(), found.size_words().unwrap()), (file.path(), page_words() + 3));
        assert_eq!(found.read(0, 8).unwrap(), [0, 0, 0, 0, 0, 0, 0, 7]);
        assert!(found.read(page_words(), 4).unwrap_err().to_string().contains("shorter"));
        assert!(found.is_owned() && !found.remove_if_orphaned());
        drop((first, second, file));
        assert!(!found.is_owned() && !found.path().exists());
        assert_eq!(found.read(page_words(), 3).unwrap(), [0, 0, u64::MAX]);
        assert!(ForeignWords::list(&prefix).unwrap().is_empty());
    }

    #[test]
    fn a_killed_owners_file_can_be_removed() {
        let prefix = prefix("orphan");
        let file = WordsFile::create(&prefix).unwrap();
        let path = file.path().to_owned();
        let _words = file.map(0, 8).unwrap();
        // As the kernel does it when a process is killed: the lock goes, the file stays.
        let WordsFile { file: lock, .. } = &file;
        rustix::fs::flock(lock, FlockOperation::Unlock).unwrap();
        let found = ForeignWords::list(&prefix).unwrap();
        assert!(!found[0].is_owned() && found[0].remove_if_orphaned() && !path.exists());
    }

    #[test]
    fn files_of_others_are_left_out() {
        let prefix = prefix("others");
        let file = WordsFile::create(&prefix).unwrap();
        if let Err(error) = std::os::unix::fs::chown(file.path(), Some(65_534), None) {
            println!("skipped: only root can give a file away: {error}");
            return;
        }
        assert!(ForeignWords::list(&prefix).unwrap().is_empty());
    }

    #[test]
    fn private_words_are_zeros() {
        let words = Words::private(3);
        assert!(words.len() == 3 && words.iter().all(|word| word.load(Ordering::Relaxed) == 0));
    }
}

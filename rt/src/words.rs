// SPDX-License-Identifier: MIT OR Apache-2.0
//! Blocks of 64-bit words that one thread writes and others read, in this process or in another.

use std::io;
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::slice;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::shm::page_bytes;

use crate::shm::{self, Mapping, OwnFile, PeerFile};
use crate::{AtExit, at_exit};

const WORD_BYTES: usize = size_of::<AtomicU64>();

/// A block of words: private, or in a file that other processes read. Initially all zeros.
pub struct Words {
    memory: Memory,
}

enum Memory {
    Private(Box<[AtomicU64]>),
    Shared(Mapping, usize),
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
            Memory::Shared(map, len) => unsafe { slice::from_raw_parts(map.start().as_ptr().cast(), *len) },
        }
    }
}

crate::debug_fields!(Words, |this| len = this.len());

/// A file of words in /dev/shm. The process that created it holds its lock as long as it is alive, and removes it at its
/// end. If that process was killed, any process that can lock the file may remove it.
#[derive(Debug)]
pub struct WordsFile {
    file: Arc<OwnFile>,
    _at_exit: AtExit,
}

impl WordsFile {
    /// Creates a file whose name begins with `prefix`.
    ///
    /// # Errors
    /// The system's error, with the path.
    pub fn create(prefix: &str) -> io::Result<WordsFile> {
        let file = Arc::new(OwnFile::create(prefix)?);
        let last = file.clone();
        Ok(WordsFile { file, _at_exit: at_exit(move || last.retire()) })
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Removes the file and unlocks it, before the last of its words is dropped: for readers its owner has
    /// ended.
    pub fn retire(&self) {
        self.file.retire();
    }

    /// Maps `len` words that begin `at` words into the file, a multiple of [`page_words`]; the file grows if
    /// necessary.
    ///
    /// # Real-time
    /// Setup only: touches every page, so that their later use causes no page fault.
    ///
    /// # Errors
    /// The system's error, with the path.
    pub fn map(&self, at: usize, len: usize) -> io::Result<Words> {
        let (start_bytes, len_bytes) = (at * WORD_BYTES, len * WORD_BYTES);
        self.file.claim(start_bytes as u64, len_bytes as u64)?;
        let map = Mapping::new(&*self.file, start_bytes as u64, len_bytes, true)
            .map_err(|error| with_path(self.path(), error))?;
        let words = Words { memory: Memory::Shared(map, len) };
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

/// Another process's file, for reading. Its content is untrusted. It remains readable after that process has
/// ended.
#[derive(Debug)]
pub struct ForeignWords {
    file: PeerFile,
}

impl ForeignWords {
    /// This user's files whose names begin with `prefix`, in the order of their names.
    ///
    /// # Errors
    /// If /dev/shm cannot be read, or at the limit of open files.
    pub fn list(prefix: &str) -> io::Result<Vec<ForeignWords>> {
        let open = |path: PathBuf| match PeerFile::open(path, false) {
            Ok(file) => Some(Ok(ForeignWords { file })),
            Err(error) if matches!(error.source.raw_os_error(), Some(libc::EMFILE | libc::ENFILE)) => {
                Some(Err(error.into()))
            }
            // It was just removed, or belongs to another user.
            Err(_) => None,
        };
        shm::list(prefix)?.into_iter().filter_map(open).collect()
    }

    /// Its path; the file may have been removed.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// Whether the process that created it is alive.
    pub fn is_owned(&self) -> bool {
        self.file.is_owned()
    }

    /// Removes the file of a process that was killed. Does nothing if its owner is alive.
    pub fn remove_if_orphaned(&self) -> bool {
        self.file.remove_if_orphaned()
    }

    /// How many words the file has now.
    ///
    /// # Errors
    /// The system's error, with the path.
    pub fn size_words(&self) -> io::Result<usize> {
        Ok(usize::try_from(self.file.size_bytes()?).unwrap_or(0) / WORD_BYTES)
    }

    /// Copies `len` words that begin `at` words into the file, a multiple of [`page_words`], each with its value at
    /// the time of reading, in ascending order. This does not affect the writer.
    ///
    /// # Errors
    /// The system's error, with the path; an error if the file is shorter.
    pub fn read(&self, at: usize, len: usize) -> io::Result<Vec<u64>> {
        let map = self.map(at, len)?;
        Ok((0..len).map_while(|index| map.load(index)).collect())
    }

    /// Maps `len` words that begin `at` words into the file, a multiple of [`page_words`], for readers that read them more
    /// than once.
    ///
    /// # Errors
    /// As [`read`](Self::read).
    pub fn map(&self, at: usize, len: usize) -> io::Result<ForeignMap> {
        if self.size_words()? < at + len {
            let error = io::Error::other("shorter than it should be: made by another version of Tautline?");
            return Err(with_path(self.path(), error));
        }
        let map = Mapping::new(&self.file, (at * WORD_BYTES) as u64, len * WORD_BYTES, false)
            .map_err(|error| with_path(self.path(), error))?;
        Ok(ForeignMap { map, len })
    }
}

/// Words of another process, mapped for reading.
#[derive(Debug)]
pub struct ForeignMap {
    map: Mapping,
    len: usize,
}

#[allow(clippy::len_without_is_empty, reason = "the system maps nothing that is empty")]
impl ForeignMap {
    /// How many words are mapped.
    pub fn len(&self) -> usize {
        self.len
    }

    /// The word's present value; `None` beyond the end. Values that are loaded after it are not older. This does not
    /// affect the writer.
    pub fn load(&self, index: usize) -> Option<u64> {
        if index >= self.len {
            return None;
        }
        // SAFETY: the index is within the mapping, which is readable; a load does not write. Acquire: pairs with the
        // writer's Release stores.
        Some(unsafe { (*self.map.start().as_ptr().cast::<AtomicU64>().add(index)).load(Ordering::Acquire) })
    }
}

/// The number of words in a page; a mapping may begin only at a page.
pub fn page_words() -> usize {
    page_bytes() / WORD_BYTES
}

fn with_path(path: &Path, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! A file whose space is reserved before it is written, so that a full disk is noticed while the file can still be completed.

use crate::BagError;
use crate::disk::{BLOCK, Disk, Job, Jobs, Piece};
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

/// The number of bytes that are reserved at once, if the disk has as many.
const STEP: u64 = 64 << 20;

/// The end of a [`Claimed`] file, for code that no longer owns the file.
#[derive(Clone, Default)]
pub struct Position(Arc<AtomicU64>);

impl Position {
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Reserves space for a file.
pub struct Claim {
    file: File,
    path: PathBuf,
    /// The number of bytes that are reserved for the file, written or not.
    claimed: u64,
    /// The file system cannot reserve space.
    is_impossible: bool,
    jobs: Jobs,
}

/// Writes into the reserved space: at the file's end, or again over what was written.
pub struct Claimed {
    piece: Piece,
    /// Where the piece begins in the file.
    start: u64,
    /// The offset of the next byte.
    cursor: u64,
    end: Position,
    /// The piece begins with the block in which the last piece ended.
    is_shared: bool,
    /// The offset up to which bytes were handed over to the disk's thread.
    given: u64,
    /// Bytes before the piece that are written again, and their offset.
    again: (u64, Vec<u8>),
    jobs: Jobs,
    spare: Receiver<Piece>,
}

/// Creates a file that is written to the disk in pieces of `piece_bytes`; it uses twice that as memory. While `is_behind` is set, pieces go
/// through the kernel's page cache, which takes them at once when the disk does not.
pub fn create(
    path: &Path,
    piece_bytes: usize,
    is_behind: Arc<AtomicBool>,
) -> Result<(Claim, Claimed, Position), BagError> {
    let file = File::options().write(true).create_new(true).open(path).map_err(BagError::write(path))?;
    // Keeps `recover` off the file until this process has ended. An error is ignored: some file systems have no locks.
    let _ = file.try_lock();
    let position = Position::default();
    let (jobs, spare) = Disk::start(path, &file, piece_bytes, is_behind).inspect_err(|_| {
        let _ = std::fs::remove_file(path);
    })?;
    let claim = Claim { file, path: path.to_owned(), claimed: 0, is_impossible: false, jobs: jobs.clone() };
    let claimed = Claimed {
        piece: Piece::new(piece_bytes),
        start: 0,
        cursor: 0,
        end: position.clone(),
        is_shared: false,
        given: 0,
        again: (0, Vec::new()),
        jobs,
        spare,
    };
    Ok((claim, claimed, position))
}

impl Claim {
    /// Reserves space, so that the file can be written up to `end`.
    ///
    /// # Errors
    /// [`BagError::Full`].
    pub fn up_to(&mut self, end: u64) -> Result<(), BagError> {
        if end <= self.claimed || self.is_impossible {
            return Ok(());
        }
        for wanted in [end.next_multiple_of(STEP), end] {
            match fallocate(&self.file, FallocateFlags::KEEP_SIZE, self.claimed, wanted - self.claimed) {
                Ok(()) => {
                    self.claimed = wanted;
                    return Ok(());
                }
                Err(Errno::NOSPC | Errno::DQUOT | Errno::FBIG) => {}
                Err(Errno::INTR) => return self.up_to(end),
                // A full disk is then an error of `write`, and `recover` completes the file.
                Err(Errno::OPNOTSUPP | Errno::NOSYS) => {
                    self.is_impossible = true;
                    return Ok(());
                }
                Err(error) => return Err(BagError::write(&self.path)(error.into())),
            }
        }
        Err(BagError::Full { path: self.path.clone(), bytes: end - self.claimed })
    }

    /// Waits until the disk's thread has written all that it was given.
    ///
    /// # Errors
    /// The thread could not write it.
    pub fn wait(&self) -> Result<(), BagError> {
        self.wait_for(Job::Tell)
    }

    fn wait_for(&self, job: impl FnOnce(SyncSender<()>) -> Job) -> Result<(), BagError> {
        let (tell, done) = sync_channel(1);
        let told = self.jobs.send(job(tell));
        told.and_then(|()| done.recv().map_err(|_| self.jobs.fault())).map_err(BagError::write(&self.path))
    }

    /// Gives back the reserved space behind `end`, and syncs the file to the disk.
    pub fn release(&self, end: u64) -> Result<(), BagError> {
        self.wait()?;
        self.file.set_len(end).and_then(|()| self.file.sync_all()).map_err(BagError::write(&self.path))
    }
}

impl Claimed {
    /// Hands the piece over to the disk's thread. A partial block at its end also begins the next piece.
    fn hand_over(&mut self) -> io::Result<()> {
        self.hand_over_again()?;
        let next = self.spare.recv().map_err(|_| self.jobs.fault())?;
        let piece = std::mem::replace(&mut self.piece, next);
        let (bytes, is_shared) = (piece.get(), self.is_shared);
        let whole = bytes.len() / BLOCK * BLOCK;
        self.piece.len = 0;
        self.piece.put(0, &bytes[whole..]);
        self.is_shared = whole < bytes.len();
        let start = self.start;
        self.start += whole as u64;
        self.given = self.end.get();
        self.jobs.send(Job::Write { piece, start, is_shared })
    }

    fn hand_over_again(&mut self) -> io::Result<()> {
        let (at, bytes) = std::mem::take(&mut self.again);
        if bytes.is_empty() { Ok(()) } else { self.jobs.send(Job::Again(at, bytes)) }
    }
}

impl Drop for Claim {
    /// Waits until the file has all that was handed over, also that of an unfinished bag, and is closed, so that `recover` can take it.
    fn drop(&mut self) {
        let _ = self.wait_for(Job::Close);
    }
}

impl Drop for Claimed {
    fn drop(&mut self) {
        let _ = self.flush();
    }
}

impl Write for Claimed {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = match self.start.checked_sub(self.cursor) {
            Some(before) if before > 0 => {
                let count = bytes.len().min(usize::try_from(before).unwrap_or(usize::MAX));
                if self.again.1.is_empty() {
                    self.again.0 = self.cursor;
                }
                self.again.1.extend_from_slice(&bytes[..count]);
                count
            }
            _ => {
                if self.cursor == self.start + self.piece.len as u64 && self.piece.is_full() {
                    self.hand_over()?;
                }
                self.piece.put((self.cursor - self.start) as usize, bytes)
            }
        };
        self.cursor += count as u64;
        self.end.0.fetch_max(self.cursor, Ordering::Relaxed);
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.given < self.end.get() { self.hand_over() } else { self.hand_over_again() }
    }
}

impl Seek for Claimed {
    /// Seeks to the head of a chunk, to write its length when the chunk is complete, and to the end again. Until then a kill leaves a chunk
    /// that is longer than its file.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let end = self.end.get();
        let to = match to {
            SeekFrom::Start(to) => Some(to),
            SeekFrom::Current(by) => self.cursor.checked_add_signed(by),
            SeekFrom::End(by) => end.checked_add_signed(by),
        };
        let behind = || io::Error::new(io::ErrorKind::InvalidInput, "bags have no holes");
        let to = to.filter(|to| *to <= end).ok_or_else(behind)?;
        if to != self.cursor {
            self.hand_over_again()?;
            self.cursor = to;
        }
        Ok(to)
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! A file whose space is claimed before it is written, so that a disk that fills up is noticed while the file can still be ended; and
//! which goes to the disk past the kernel's cache, where the file system permits that: its pages would have to be found first, would
//! push out those of others, and be written when the kernel likes, which then stops the writer for long.

use crate::BagError;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::sync::{Arc, OnceLock};

/// How much is claimed at once, if there is as much.
const STEP: u64 = 64 << 20;
/// What a disk takes from memory: so many bytes, or several times as many, at an address and to a place that are multiples of it.
const BLOCK: usize = 4096;
/// The one that is filled and the one that is being written.
const PIECES: usize = 2;

/// Where a [`Claimed`] file ends, for who no longer has it.
#[derive(Clone, Default)]
pub struct Position(Arc<AtomicU64>);

impl Position {
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// What claims space for a file.
pub struct Claim {
    file: File,
    path: PathBuf,
    /// Bytes that are the file's, written or not.
    claimed: u64,
    /// The file system cannot.
    is_impossible: bool,
    jobs: Jobs,
}

/// Writes what was claimed: at the end, or again what is before it.
pub struct Claimed {
    piece: Piece,
    /// Where the piece begins in the file.
    start: u64,
    /// Where the next byte goes.
    cursor: u64,
    end: Position,
    /// The piece's first block is one that the last piece ended in.
    is_shared: bool,
    /// What is before this is the disk's thread's.
    given: u64,
    /// What is written again of what is before the piece, and where.
    again: (u64, Vec<u8>),
    jobs: Jobs,
    spare: Receiver<Piece>,
}

/// A new file, of which `piece_bytes` go to the disk at once; twice that is its memory. While `is_behind` what is written goes through
/// the kernel's cache all the same: that takes it at once, if the disk does not.
pub fn create(
    path: &Path,
    piece_bytes: usize,
    is_behind: Arc<AtomicBool>,
) -> Result<(Claim, Claimed, Position), BagError> {
    let file = File::options().write(true).create_new(true).open(path).map_err(BagError::write(path))?;
    let position = Position::default();
    let others = file.try_clone().map_err(BagError::write(path))?;
    let past_cache = File::options().write(true).custom_flags(libc::O_DIRECT).open(path).ok();
    let ((sender, work), (give_back, spare)) = (channel(), channel());
    for _ in 1..PIECES {
        let _ = give_back.send(Piece::new(piece_bytes));
    }
    let mut disk = Disk { file: others, past_cache, is_behind, give_back, hurried: 0..0 };
    let jobs = Jobs { sender, fault: Arc::default() };
    let fault = jobs.fault.clone();
    let thread = std::thread::Builder::new().name("disk".to_owned());
    // Why it ends is there before it has ended.
    let run = move || drop(disk.run(&work).map_err(|error| fault.set(error)));
    thread.spawn(run).map_err(BagError::write(path))?;
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

/// Memory that begins where a block can.
struct Piece {
    bytes: Vec<u8>,
    /// Where the first block is.
    first: usize,
    len: usize,
}

impl Piece {
    fn new(bytes: usize) -> Self {
        let bytes = vec![0; bytes.max(BLOCK).next_multiple_of(BLOCK) + BLOCK];
        let first = bytes.as_ptr().align_offset(BLOCK).min(BLOCK);
        Piece { bytes, first, len: 0 }
    }

    fn get(&self) -> &[u8] {
        &self.bytes[self.first..self.first + self.len]
    }

    /// What there is room for from `at` on; how many bytes that is.
    fn put(&mut self, at: usize, bytes: &[u8]) -> usize {
        let room = self.bytes.len() - BLOCK - at;
        let count = bytes.len().min(room);
        self.bytes[self.first + at..][..count].copy_from_slice(&bytes[..count]);
        self.len = self.len.max(at + count);
        count
    }

    fn is_full(&self) -> bool {
        self.len == self.bytes.len() - BLOCK
    }
}

/// What the disk's thread is told, in this order.
enum Job {
    /// To be written from here on. The first block, if it is shared, was written before, in part.
    Write { piece: Piece, start: u64, is_shared: bool },
    /// To be written in the place of others.
    Again(u64, Vec<u8>),
    /// To be said when all of before is done.
    Tell(SyncSender<()>),
}

/// To the disk's thread.
#[derive(Clone)]
struct Jobs {
    sender: Sender<Job>,
    /// Why it has ended.
    fault: Arc<OnceLock<io::Error>>,
}

impl Jobs {
    fn give(&self, job: Job) -> io::Result<()> {
        self.sender.send(job).map_err(|_| self.fault())
    }

    fn fault(&self) -> io::Error {
        match self.fault.get() {
            Some(error) => error.raw_os_error().map_or_else(
                || io::Error::new(error.kind(), error.to_string()),
                io::Error::from_raw_os_error,
            ),
            None => io::Error::other("the thread that writes to the disk has ended"),
        }
    }
}

/// The thread that waits for the disk.
struct Disk {
    file: File,
    /// The same one, past the kernel's cache.
    past_cache: Option<File>,
    is_behind: Arc<AtomicBool>,
    give_back: Sender<Piece>,
    /// What the kernel was last told to write out.
    hurried: std::ops::Range<u64>,
}

impl Disk {
    fn run(&mut self, jobs: &Receiver<Job>) -> io::Result<()> {
        while let Ok(job) = jobs.recv() {
            match job {
                Job::Write { piece, start, is_shared } => {
                    self.write(piece.get(), start, is_shared)?;
                    // Nobody wants it any more after the last.
                    let _ = self.give_back.send(piece);
                }
                Job::Again(at, bytes) => self.file.write_all_at(&bytes, at)?,
                Job::Tell(done) => drop(done.send(())),
            }
        }
        Ok(())
    }

    /// Blocks that are written once go past the cache; one that two pieces share goes through it each time, for what the cache has of a
    /// block would have to be written first.
    fn write(&mut self, bytes: &[u8], start: u64, is_shared: bool) -> io::Result<()> {
        // Not hurried: that may wait for the disk.
        if self.is_behind.load(Ordering::Relaxed) {
            return self.file.write_all_at(bytes, start);
        }
        let shared = if is_shared { BLOCK.min(bytes.len()) } else { 0 };
        let whole = (bytes.len() / BLOCK * BLOCK).max(shared);
        self.file.write_all_at(&bytes[..shared], start)?;
        let (start, bytes, rest) = (start + shared as u64, &bytes[shared..whole], &bytes[whole..]);
        let is_written = match &self.past_cache {
            Some(file) => match file.write_all_at(bytes, start) {
                Ok(()) => true,
                // A disk of longer blocks, for one.
                Err(error) if error.raw_os_error() == Some(libc::EINVAL) => {
                    self.past_cache = None;
                    false
                }
                Err(error) => return Err(error),
            },
            None => false,
        };
        let end = start + bytes.len() as u64;
        if !is_written {
            self.file.write_all_at(bytes, start)?;
        }
        self.file.write_all_at(rest, end)?;
        // What is in the cache all the same, from before or because the file system does not do otherwise.
        let range = self.hurried.end..end;
        hurry(&self.file, range.clone(), libc::SYNC_FILE_RANGE_WRITE);
        let before = std::mem::replace(&mut self.hurried, range);
        if !is_written {
            hurry(&self.file, before, libc::SYNC_FILE_RANGE_WAIT_BEFORE);
        }
        Ok(())
    }
}

/// Has the disk begin with what is in the cache: the kernel alone would begin when a tenth of the memory is unwritten, and then stop the
/// writer for long. If that is refused, it is written later. Not `posix_fadvise`, which drops what is on the disk, and disturbs every core
/// for that.
#[expect(unsafe_code, reason = "no crate that is used here has the call")]
fn hurry(file: &File, range: std::ops::Range<u64>, how: libc::c_uint) {
    // No bytes are all that follow.
    let Some(Ok(bytes)) = (!range.is_empty()).then(|| (range.end - range.start).try_into()) else { return };
    let Ok(offset) = range.start.try_into() else { return };
    // SAFETY: the descriptor is open as long as the file is borrowed; the call touches no memory of this process.
    let _ = unsafe { libc::sync_file_range(file.as_raw_fd(), offset, bytes, how) };
}

impl Claim {
    /// The file can be written up to here.
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
                // Then a full disk is an error of `write`, and `recover` ends the file.
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
    /// It could not.
    pub fn wait(&self) -> Result<(), BagError> {
        let (tell, done) = sync_channel(1);
        let told = self.jobs.give(Job::Tell(tell));
        told.and_then(|()| done.recv().map_err(|_| self.jobs.fault())).map_err(BagError::write(&self.path))
    }

    /// Gives back what was not written, and has the rest on the disk.
    pub fn release(&self, end: u64) -> Result<(), BagError> {
        self.wait()?;
        self.file.set_len(end).and_then(|()| self.file.sync_all()).map_err(BagError::write(&self.path))
    }
}

impl Claimed {
    /// What is in the piece is the disk's; where the file ends within a block, that begins the next piece.
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
        self.jobs.give(Job::Write { piece, start, is_shared })
    }

    fn hand_over_again(&mut self) -> io::Result<()> {
        let (at, bytes) = std::mem::take(&mut self.again);
        if bytes.is_empty() { Ok(()) } else { self.jobs.give(Job::Again(at, bytes)) }
    }
}

impl Drop for Claim {
    /// What was given is in the file when this is gone: of a bag that was not finished, too.
    fn drop(&mut self) {
        let _ = self.wait();
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
    /// Back to the head of a chunk, whose length is known when the chunk is whole, and to the end again: until then a kill leaves a chunk
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that writes a file to the disk, past the kernel's page cache where the file system permits that. With the cache, the kernel
//! would have to find pages first, would evict other pages, and would write them at a time of its own choice, which then blocks the writer
//! for a long time.

use crate::BagError;
use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;
use std::fs::{self, File};
use std::io;
use std::ops::Range;
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel};
use std::sync::{Arc, OnceLock};

/// The block size of direct I/O: lengths, memory addresses and file offsets must be multiples of it.
pub const BLOCK: usize = 4096;
/// One piece is filled while the other one is written.
const PIECES: usize = 2;

/// Memory that is aligned for direct I/O.
pub struct Piece {
    bytes: Vec<u8>,
    /// The offset of the first block.
    first: usize,
    pub len: usize,
}

impl Piece {
    pub fn new(bytes: usize) -> Self {
        let bytes = vec![0; bytes.max(BLOCK).next_multiple_of(BLOCK) + BLOCK];
        let first = bytes.as_ptr().align_offset(BLOCK).min(BLOCK);
        Piece { bytes, first, len: 0 }
    }

    pub fn get(&self) -> &[u8] {
        &self.bytes[self.first..self.first + self.len]
    }

    /// Copies as many bytes to `at` as there is room for. Returns their number.
    pub fn put(&mut self, at: usize, bytes: &[u8]) -> usize {
        let room = self.bytes.len() - BLOCK - at;
        let count = bytes.len().min(room);
        self.bytes[self.first + at..][..count].copy_from_slice(&bytes[..count]);
        self.len = self.len.max(at + count);
        count
    }

    pub fn is_full(&self) -> bool {
        self.len == self.bytes.len() - BLOCK
    }
}

/// A job of the disk's thread, which does jobs in the order in which they are sent.
pub enum Job {
    /// Writes a piece from `start` on. If `is_shared`, its first block was written before, in part.
    Write { piece: Piece, start: u64, is_shared: bool },
    /// Writes bytes over those at an offset.
    Again(u64, Vec<u8>),
    /// Signals that all jobs before it are done.
    Tell(SyncSender<()>),
    /// The last job: signals that all jobs before it are done and the file is closed here.
    Close(SyncSender<()>),
}

/// Sends jobs to the disk's thread.
#[derive(Clone)]
pub struct Jobs {
    sender: Sender<Job>,
    /// Why the thread has ended.
    fault: Arc<OnceLock<io::Error>>,
}

impl Jobs {
    pub fn send(&self, job: Job) -> io::Result<()> {
        self.sender.send(job).map_err(|_| self.fault())
    }

    pub fn fault(&self) -> io::Error {
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
pub struct Disk {
    file: File,
    /// The same file, opened for direct I/O.
    past_cache: Option<File>,
    is_behind: Arc<AtomicBool>,
    give_back: Sender<Piece>,
    /// The range that the kernel was last told to write out.
    hurried: Range<u64>,
}

impl Disk {
    /// Starts the thread of a file that is written in pieces of `piece_bytes`. Returns its jobs, and the channel of written pieces.
    pub fn start(
        path: &Path,
        file: &File,
        piece_bytes: usize,
        is_behind: Arc<AtomicBool>,
    ) -> Result<(Jobs, Receiver<Piece>), BagError> {
        let past_cache = File::options().write(true).custom_flags(libc::O_DIRECT).open(path).ok();
        let file = file.try_clone().map_err(BagError::write(path))?;
        let ((sender, work), (give_back, spare)) = (channel(), channel());
        for _ in 1..PIECES {
            let _ = give_back.send(Piece::new(piece_bytes));
        }
        let mut disk = Disk { file, past_cache, is_behind, give_back, hurried: 0..0 };
        let jobs = Jobs { sender, fault: Arc::default() };
        let fault = jobs.fault.clone();
        // The fault is set before `work` is dropped, so before a sender notices the end.
        let run = move || match disk.run(&work) {
            Ok(closed) => {
                drop(disk);
                let _ = closed.map(|closed| closed.send(()));
            }
            Err(error) => drop(fault.set(error)),
        };
        let thread = std::thread::Builder::new().name("disk".to_owned());
        thread.spawn(run).map_err(BagError::write(path))?;
        Ok((jobs, spare))
    }

    /// Does jobs until the last one, or until all senders are gone. Returns the sender to notify when the file is closed.
    fn run(&mut self, jobs: &Receiver<Job>) -> io::Result<Option<SyncSender<()>>> {
        while let Ok(job) = jobs.recv() {
            match job {
                Job::Write { piece, start, is_shared } => {
                    self.write(piece.get(), start, is_shared)?;
                    // Nobody receives the piece after the last job.
                    let _ = self.give_back.send(piece);
                }
                Job::Again(at, bytes) => self.file.write_all_at(&bytes, at)?,
                Job::Tell(done) => drop(done.send(())),
                Job::Close(closed) => return Ok(Some(closed)),
            }
        }
        Ok(None)
    }

    /// Writes blocks that are written once past the cache. A block that two pieces share goes through the cache each time, because the
    /// kernel would have to write its cached part first.
    fn write(&mut self, bytes: &[u8], start: u64, is_shared: bool) -> io::Result<()> {
        // Without `hurry`, which may wait for the disk.
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
                // For example, the disk has longer blocks.
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
        // Some of it is in the cache: shared blocks, or all of it if the file system has no direct I/O.
        let range = self.hurried.end..end;
        hurry(&self.file, range.clone(), libc::SYNC_FILE_RANGE_WRITE);
        let before = std::mem::replace(&mut self.hurried, range);
        if !is_written {
            hurry(&self.file, before, libc::SYNC_FILE_RANGE_WAIT_BEFORE);
        }
        Ok(())
    }
}

/// Renames, unless `to` exists.
pub fn rename_to_new(from: &Path, to: &Path) -> io::Result<()> {
    match renameat_with(CWD, from, CWD, to, RenameFlags::NOREPLACE) {
        // The file system cannot do that; `rename` does not replace a folder that is not empty.
        Err(Errno::INVAL | Errno::NOSYS) if from.is_dir() || !to.exists() => fs::rename(from, to),
        Err(Errno::INVAL | Errno::NOSYS) => Err(io::ErrorKind::AlreadyExists.into()),
        other => other.map_err(Into::into),
    }
}

/// Starts writing what is in the cache: the kernel alone would begin when a tenth of the memory is unwritten, and then block the
/// writer for long. If that is refused, it is written later. `posix_fadvise` is no substitute: it drops what is on the disk, and
/// disturbs every core for that.
#[expect(unsafe_code, reason = "no crate that is used here has the call")]
fn hurry(file: &File, range: Range<u64>, how: libc::c_uint) {
    // To the kernel, a length of 0 means all that follows.
    let Some(Ok(bytes)) = (!range.is_empty()).then(|| (range.end - range.start).try_into()) else { return };
    let Ok(offset) = range.start.try_into() else { return };
    // SAFETY: the descriptor is open as long as the file is borrowed; the call touches no memory of this process.
    let _ = unsafe { libc::sync_file_range(file.as_raw_fd(), offset, bytes, how) };
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Past the cache, without that, refused there (memory that begins anywhere), and behind: the file is the same.
    #[test]
    fn a_file_is_the_same_whichever_way_it_goes() {
        let folder = tempfile::tempdir().unwrap();
        let bytes: Vec<u8> = (0..10 * BLOCK + 100).map(|n| (n % 251) as u8).collect();
        let mut aligned = Piece::new(bytes.len());
        assert_eq!(aligned.put(0, &bytes), bytes.len());
        let mut shifted = vec![0; 1 + bytes.len()];
        let first = shifted.as_ptr().align_offset(2) ^ 1;
        shifted[first..][..bytes.len()].copy_from_slice(&bytes);
        let anywhere = &shifted[first..][..bytes.len()];
        for (way, direct, is_behind, memory) in [
            ("past the cache", true, false, aligned.get()),
            ("through it", false, false, aligned.get()),
            ("refused", true, false, anywhere),
            ("behind", true, true, aligned.get()),
        ] {
            let path = folder.path().join(way);
            let file = File::create(&path).unwrap();
            let opened = || File::options().write(true).custom_flags(libc::O_DIRECT).open(&path).ok();
            let past_cache = direct.then(opened).flatten();
            let is_behind = Arc::new(AtomicBool::new(is_behind));
            let mut disk = Disk { file, past_cache, is_behind, give_back: channel().0, hurried: 0..0 };
            // The second piece begins with the block that the first one ended in.
            let middle = 5 * BLOCK;
            disk.write(&memory[..middle + 10], 0, false).unwrap();
            disk.write(&memory[middle..], middle as u64, true).unwrap();
            assert!(std::fs::read(&path).unwrap() == bytes, "{way}");
        }
    }
}

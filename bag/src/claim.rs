// SPDX-License-Identifier: MIT OR Apache-2.0
//! A file whose space is claimed before it is written, so that a disk that fills up is noticed while the file can still be ended.

use crate::BagError;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};

/// How much is claimed at once, if there is as much.
const STEP: u64 = 64 << 20;

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
    early: Sender<u64>,
}

/// So much is on its way to the disk at once, twice: what else wants it, such as the file system's journal, does not wait for long.
const ON_ITS_WAY: u64 = 8 << 20;

/// The thread that has the disk begin as soon as there is something for it. The kernel alone would begin when a tenth of the memory is
/// unwritten, and then stop the writer for long.
fn write_early(file: &File, ends: &Receiver<u64>) {
    let (mut start, mut before) = (0, 0);
    while let Ok(end) = ends.recv() {
        let mut end = ends.try_iter().last().unwrap_or(end);
        while start < end {
            let until = end.min(start + ON_ITS_WAY);
            hurry(file, start, until, libc::SYNC_FILE_RANGE_WRITE);
            hurry(file, before, start, libc::SYNC_FILE_RANGE_WAIT_BEFORE);
            (before, start) = (start, until);
            end = ends.try_iter().last().unwrap_or(end);
        }
    }
}

/// If that is refused, it is written later. Not `posix_fadvise`, which drops what is on the disk, and disturbs every core for that.
#[expect(unsafe_code, reason = "no crate that is used here has the call")]
fn hurry(file: &File, start: u64, end: u64, how: libc::c_uint) {
    // No bytes are all that follow.
    let Some(Ok(bytes)) = (end > start).then(|| (end - start).try_into()) else { return };
    let Ok(offset) = start.try_into() else { return };
    // SAFETY: the descriptor is open as long as the file is borrowed; the call touches no memory of this process.
    let _ = unsafe { libc::sync_file_range(file.as_raw_fd(), offset, bytes, how) };
}

/// How much is put together before it is written.
const BUFFER: usize = 64 << 10;

/// Writes what was claimed: at the end, or again what is before it.
pub struct Claimed {
    file: File,
    buffer: Vec<u8>,
    /// Where the buffer begins in the file.
    start: u64,
    end: Position,
}

/// A new file.
pub fn create(path: &Path) -> Result<(Claim, Claimed, Position), BagError> {
    let file = File::options().write(true).create_new(true).open(path).map_err(BagError::write(path))?;
    let position = Position::default();
    let others = file.try_clone().and_then(|claim| Ok((claim, file.try_clone()?)));
    let (other, another) = others.map_err(BagError::write(path))?;
    let (early, ends) = channel();
    let thread = std::thread::Builder::new().name("write-early".to_owned());
    thread.spawn(move || write_early(&another, &ends)).map_err(BagError::write(path))?;
    let claim = Claim { file: other, path: path.to_owned(), claimed: 0, is_impossible: false, early };
    let buffer = Vec::with_capacity(BUFFER);
    Ok((claim, Claimed { file, buffer, start: 0, end: position.clone() }, position))
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

    /// The disk is to begin with what is before `end`.
    pub fn send_off(&self, end: u64) {
        // Without the thread the kernel begins when it likes.
        let _ = self.early.send(end);
    }

    /// Gives back what was not written, and has the rest on the disk.
    pub fn release(&self, end: u64) -> Result<(), BagError> {
        self.file.set_len(end).and_then(|()| self.file.sync_all()).map_err(BagError::write(&self.path))
    }
}

impl Claimed {
    fn position(&self) -> u64 {
        self.start + self.buffer.len() as u64
    }

    fn empty(&mut self) -> io::Result<()> {
        self.file.write_all_at(&self.buffer, self.start)?;
        self.start = self.position();
        self.buffer.clear();
        Ok(())
    }
}

impl Write for Claimed {
    /// What is long goes to the file from where it is.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.buffer.len() + bytes.len() > BUFFER {
            self.empty()?;
        }
        if bytes.len() > BUFFER {
            self.file.write_all_at(bytes, self.start)?;
            self.start += bytes.len() as u64;
        } else {
            self.buffer.extend_from_slice(bytes);
        }
        self.end.0.fetch_max(self.position(), Ordering::Relaxed);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.empty()
    }
}

impl Seek for Claimed {
    /// Back to the head of a chunk, whose length is known when the chunk is whole, and to the end again: until then a kill leaves a chunk
    /// that is longer than its file.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let end = self.end.get();
        let to = match to {
            SeekFrom::Start(to) => Some(to),
            SeekFrom::Current(by) => self.position().checked_add_signed(by),
            SeekFrom::End(by) => end.checked_add_signed(by),
        };
        let behind = || io::Error::new(io::ErrorKind::InvalidInput, "bags have no holes");
        let to = to.filter(|to| *to <= end).ok_or_else(behind)?;
        if to != self.position() {
            self.empty()?;
            self.start = to;
        }
        Ok(to)
    }
}

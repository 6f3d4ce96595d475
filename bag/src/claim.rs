// SPDX-License-Identifier: MIT OR Apache-2.0
//! A file whose space is claimed before it is written, so that a disk that fills up is noticed while the file can still be ended.

use crate::BagError;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::Errno;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// How much is claimed at once, if there is as much.
const STEP: u64 = 64 << 20;

/// Where a [`Claimed`] file is written to, for who no longer has it.
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
}

/// How much is put together before it is written.
const BUFFER: usize = 64 << 10;

/// Writes what was claimed, one byte after the other.
pub struct Claimed {
    file: File,
    buffer: Vec<u8>,
    position: Position,
}

/// A new file.
pub fn create(path: &Path) -> Result<(Claim, Claimed, Position), BagError> {
    let file = File::options().write(true).create_new(true).open(path).map_err(BagError::write(path))?;
    let position = Position::default();
    let other = file.try_clone().map_err(BagError::write(path))?;
    let claim = Claim { file: other, path: path.to_owned(), claimed: 0, is_impossible: false };
    Ok((claim, Claimed { file, buffer: Vec::with_capacity(BUFFER), position: position.clone() }, position))
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

    /// Gives back what was not written, and has the rest on the disk.
    pub fn release(&self, end: u64) -> Result<(), BagError> {
        self.file.set_len(end).and_then(|()| self.file.sync_all()).map_err(BagError::write(&self.path))
    }
}

impl Claimed {
    fn empty(&mut self) -> io::Result<()> {
        self.file.write_all(&self.buffer)?;
        self.buffer.clear();
        Ok(())
    }
}

impl Write for Claimed {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.buffer.len() + bytes.len() > BUFFER {
            self.empty()?;
        }
        if bytes.len() > BUFFER {
            self.file.write_all(bytes)?;
        } else {
            self.buffer.extend_from_slice(bytes);
        }
        self.position.0.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.empty()
    }
}

impl Seek for Claimed {
    /// Only says where it is: what was written stays, so that a kill leaves what is whole.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Current(0) => Ok(self.position.get()),
            _ => Err(io::Error::new(
                io::ErrorKind::Unsupported,
                "bags are written from the beginning to the end",
            )),
        }
    }
}

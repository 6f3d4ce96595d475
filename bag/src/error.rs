// SPDX-License-Identifier: MIT OR Apache-2.0

use std::io;
use std::path::{Path, PathBuf};

/// Why a bag was not written or read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum BagError {
    /// The path exists already.
    #[error("'{}' exists already; choose another folder with -o, or remove it", .0.display())]
    Exists(PathBuf),
    /// The disk has no space for one more message and the end of the file.
    #[error("the disk of '{}' is full: no room for {bytes} bytes more; the bag is whole up to here", path.display())]
    Full { path: PathBuf, bytes: u64 },
    /// Another process writes it.
    #[error("'{}' is being written by another process; stop that first", path.display())]
    Busy { path: PathBuf },
    /// The new storage has no place for it.
    #[error("{what} cannot be kept in sqlite3; --storage mcap keeps it")]
    Unkept { what: String },
    /// There is no space for a temporary file.
    #[error("the disk of '{}' is full: no room for {bytes} bytes and 64 MiB for others; nothing is left of it", path.display())]
    NoRoom { path: PathBuf, bytes: u64 },
    /// The caller stopped the operation.
    #[error("interrupted; nothing is left of it")]
    Interrupted,
    /// It cannot be written.
    #[error("'{}' cannot be written: {source}", path.display())]
    Write { path: PathBuf, source: io::Error },
    /// It cannot be read.
    #[error("'{}' cannot be read: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    /// It is neither an MCAP file nor a folder of MCAP files.
    #[error("'{}' is not a bag: {reason}", path.display())]
    NoBag { path: PathBuf, reason: String },
    /// More topics or types than a file can hold.
    #[error("'{}': {reason}", path.display())]
    Format { path: PathBuf, reason: String },
}

impl BagError {
    pub(crate) fn write(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        |source| BagError::Write { path, source }
    }

    pub(crate) fn read(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        |source| BagError::Read { path, source }
    }

    /// What the MCAP library refuses when it writes.
    pub(crate) fn mcap(path: &Path) -> impl FnOnce(mcap::McapError) -> Self {
        let path = path.to_owned();
        |error| match error {
            mcap::McapError::Io(source) => BagError::Write { path, source },
            other => BagError::Format { path, reason: other.to_string() },
        }
    }
}

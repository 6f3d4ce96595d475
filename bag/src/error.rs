// SPDX-License-Identifier: MIT OR Apache-2.0

use std::io;
use std::path::{Path, PathBuf};

/// Why a bag was not written or read.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// The path exists already.
    #[error("'{}' exists already; choose another folder with -o, or remove it", .0.display())]
    Exists(PathBuf),
    /// The disk has no space for one more message and the end of the file.
    #[error("the disk of '{}' is full: no room for {bytes} bytes more; the bag is whole up to here", path.display())]
    Full {
        /// The file.
        path: PathBuf,
        /// How many bytes were to be reserved.
        bytes: u64,
    },
    /// Another process writes it.
    #[error("'{}' is being written by another process; stop that first", path.display())]
    Busy {
        /// The file.
        path: PathBuf,
    },
    /// The new storage has no place for it.
    #[error("{what} cannot be kept in sqlite3; --storage mcap keeps it")]
    Unkept {
        /// What of the bag.
        what: String,
    },
    /// There is no space for a temporary file.
    #[error("the disk of '{}' is full: no room for {bytes} bytes and 64 MiB for others; nothing is left of it", path.display())]
    NoRoom {
        /// Where it was to be.
        path: PathBuf,
        /// How many bytes were to be written.
        bytes: u64,
    },
    /// The caller stopped the operation.
    #[error("interrupted; nothing is left of it")]
    Interrupted,
    /// It cannot be written.
    #[error("'{}' cannot be written: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// It cannot be read.
    #[error("'{}' cannot be read: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// It is neither an MCAP file nor a folder of MCAP files.
    #[error("'{}' is not a bag: {reason}", path.display())]
    NoBag {
        /// The file or folder.
        path: PathBuf,
        /// What is missing.
        reason: String,
    },
    /// More topics or types than a file can hold.
    #[error("'{}': {reason}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        reason: String,
    },
}

impl BagError {
    pub(crate) fn no_bag(path: &Path, reason: impl Into<String>) -> Self {
        BagError::NoBag { path: path.to_owned(), reason: reason.into() }
    }

    pub(crate) fn write(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        |source| BagError::Write { path, source }
    }

    pub(crate) fn read(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        |source| BagError::Read { path, source }
    }

    /// Converts errors of the MCAP library's writer.
    pub(crate) fn mcap(path: &Path) -> impl FnOnce(mcap::McapError) -> Self {
        let path = path.to_owned();
        |error| match error {
            mcap::McapError::Io(source) => BagError::Write { path, source },
            other => BagError::Format { path, reason: other.to_string() },
        }
    }
}

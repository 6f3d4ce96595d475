// SPDX-License-Identifier: MIT OR Apache-2.0
//! The system file, `system.toml`: what runs where, how often, how long and how urgently.
//!
//! [`SystemFile::parse`] reports everything that is wrong with a file at once, with line and column;
//! [`SystemFile::check`] analyses what it describes. docs/system-toml.md explains the format.
use std::path::{Path, PathBuf};

pub mod admission;
mod build;
mod check;
mod content;
mod declared;
mod graph;
mod locks;
mod paths;
mod places;
mod priorities;
mod problem;
pub mod reader;
mod reservations;
mod sections;
mod streams;
pub mod version;
mod wake;

pub use check::{CheckedCallback, CheckedChain, CheckedCore, CheckedJoin, CheckedSystem};
pub use content::{
    CallbackEntry, Client, CoreEntry, Executor, JoinPolicy, LinkPriority, MOST_DEPTH, OverrunPolicy,
    SystemFile, ThreadPriority, TopicEntry, WakeUp,
};
pub use problem::{Problem, Problems};

/// Why a system file could not be used.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// It could not be read.
    #[error("`{}` cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Its content is wrong.
    #[error("`{}` has {} problem(s):\n{source}", path.display(), source.0.len())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: Problems,
    },
}

impl SystemFile {
    /// Reads a system from the text of a file.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn parse(text: &str) -> Result<Self, Problems> {
        let mut file = build::build(text)?;
        // FNV-1a: the same in every program and version.
        let step = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
        file.fingerprint = text.bytes().fold(0xcbf2_9ce4_8422_2325, step);
        Ok(file)
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`FileError::Read`] if it cannot be read, [`FileError::Content`] with everything that is wrong with it.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let path = path.as_ref().to_path_buf();
        let text = std::fs::read_to_string(&path)
            .map_err(|source| FileError::Read { path: path.clone(), source })?;
        Self::parse(&text).map_err(|source| FileError::Content { path, source })
    }

    /// Bounds every callback and every chain, with and without overheads, and sizes the queues.
    pub fn check(&self) -> CheckedSystem {
        check::check(self)
    }
}

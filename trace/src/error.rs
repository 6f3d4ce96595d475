// SPDX-License-Identifier: MIT OR Apache-2.0
//! What can go wrong while setting up.

use std::io;
use std::path::PathBuf;
use tautline_rt::shm::ShmError;

impl From<ShmError> for TraceError {
    fn from(ShmError { path, source }: ShmError) -> TraceError {
        TraceError::File { path, source }
    }
}

/// Why nothing can be traced.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TraceError {
    /// A file in shared memory could not be made or mapped.
    #[error("the trace file {} cannot be used: {source}; check that /dev/shm exists, is writable and is not full", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// A variable is not understood.
    #[error("{variable}={value} is not understood: {expected}")]
    Environment {
        /// The variable.
        variable: &'static str,
        /// What it says.
        value: String,
        /// What it may say.
        expected: &'static str,
    },
    /// One recorder at a time drains the rings of a domain.
    #[error("domain {domain} is being recorded already: end that `taut trace record` first")]
    SecondRecorder {
        /// The domain.
        domain: u32,
    },
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Errors of the setup.

use std::io;
use std::path::PathBuf;
use tautline_rt::shm::ShmError;

impl From<ShmError> for TraceError {
    fn from(ShmError { path, source }: ShmError) -> TraceError {
        TraceError::File { path, source }
    }
}

/// Why tracing is not possible.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TraceError {
    /// A file in shared memory could not be created or mapped.
    #[error("the trace file {} cannot be used: {source}; check that /dev/shm exists, is writable and is not full", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// An environment variable has an invalid value.
    #[error("{variable}={value} is not understood: {expected}")]
    Environment {
        /// The variable.
        variable: &'static str,
        /// Its value.
        value: String,
        /// The allowed values.
        expected: &'static str,
    },
    /// The domain already has a recorder.
    #[error("domain {domain} is already being recorded: end that `taut trace record` first")]
    SecondRecorder {
        /// The domain.
        domain: u32,
    },
}

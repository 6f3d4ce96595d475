// SPDX-License-Identifier: MIT OR Apache-2.0

use std::path::PathBuf;
use std::time::Duration;

/// Why a process does not run as its environment and its system file say. Each message names the object, the limit and the fix.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SystemError {
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
    /// The system file cannot be read, or has errors: all of them, with line and column.
    #[error(transparent)]
    File(Box<dyn std::error::Error + Send + Sync>),
    /// It is not known which of the system file's hosts this is.
    #[error(
        "{} {}: set TAUT_HOST, or `ContextBuilder::host`, to one of {known}",
        path.display(),
        wanted.as_ref().map_or_else(|| "has several hosts".to_owned(), |wanted| format!("has no host '{wanted}'"))
    )]
    Host {
        /// The file.
        path: PathBuf,
        /// The requested host, if one was.
        wanted: Option<String>,
        /// The existing hosts.
        known: String,
    },
    /// The system file has no such callback on this host.
    #[error("callback '{name}' is not in {} on host '{host}'; there are: {known}", path.display())]
    UnknownCallback {
        /// The callback.
        name: String,
        /// The file.
        path: PathBuf,
        /// This host.
        host: String,
        /// The existing callbacks.
        known: String,
    },
    /// The system file has no such group on this host.
    #[error("group '{name}' is not in {} on host '{host}'; there are: {known}", path.display())]
    UnknownGroup {
        /// The group.
        name: String,
        /// The file.
        path: PathBuf,
        /// This host.
        host: String,
        /// The existing groups.
        known: String,
    },
    /// The new load does not fit beside the load that runs in the domain.
    #[error(
        "{what} is not admitted to domain {domain}: {late}; beside it run: {beside}. Lower the load or its priority, move it to another \
         core, or end what runs; {table}"
    )]
    NotAdmitted {
        /// A system file, or a callback.
        what: String,
        /// The domain.
        domain: u32,
        /// The response times that would be too long, with their deadlines.
        late: String,
        /// The running processes.
        beside: String,
        /// A command that shows everything, and other possible actions.
        table: String,
    },
    /// The admission of another process does not end.
    #[error(
        "a process has been checked against domain {domain} for {waited:?}, and only one can be at a time: see who holds {} \
         (`fuser`), end it, or set TAUT_ADMISSION=off", folder.display()
    )]
    AdmissionBusy {
        /// The domain.
        domain: u32,
        /// The locked folder.
        folder: PathBuf,
        /// How long this process has waited.
        waited: Duration,
    },
    /// What runs in the domain cannot be read, nor can new load be checked beside it.
    #[error(
        "what runs in domain {domain} cannot be read: {source}; mend that (`ulimit -n`, /dev/shm); a node starts without it with \
         TAUT_ADMISSION=off"
    )]
    Unreadable {
        /// The domain.
        domain: u32,
        /// Why.
        source: std::io::Error,
    },
    /// The statistics could not be shared with other processes.
    #[error(
        "the callbacks' statistics cannot be shared: {0}; `ContextBuilder::share_statistics(false)` does without"
    )]
    Statistics(std::io::Error),
    /// The analysis gives the callback no bound, so no queue is deep enough.
    #[error("callback '{name}' of {} has no bound, so no queue depth is enough for it: see `taut check`, or state its topic's depth", path.display())]
    NoCapacity {
        /// The callback.
        name: String,
        /// The file.
        path: PathBuf,
    },
}

pub(crate) type Result<T> = std::result::Result<T, SystemError>;

impl From<tautline_analysis::file::FileError> for SystemError {
    fn from(error: tautline_analysis::file::FileError) -> Self {
        SystemError::File(error.into())
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a recorder notifies running processes: a file whose lock it holds, and one byte in this file.
//!
//! A killed recorder loses its lock, so it never leaves tracing switched on.

use crate::error::TraceError;
use rustix::fs::{FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_rt::Patience;
use tautline_rt::domain::{shared_folder, shared_path};
use tautline_rt::fork::{ProcessFd, ProcessMark};
use tautline_rt::shm::{self, PeerFile, ShmError, has_name};

const ON: &[u8] = b"1";
const OFF: &[u8] = b"0";

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RecorderRequest {
    Nothing,
    /// A recorder collects the remaining events and ends.
    Finish,
    Record,
}

/// The prefix of the names of trace files in the folder of their domain.
const PREFIX: &str = "trace_";

/// Whether this is the name of the trace file of a process.
pub fn is_trace_file(name: &str) -> bool {
    name.strip_prefix(PREFIX).is_some_and(|rest| rest.starts_with('p'))
}

/// The prefix of the names of processes' files.
pub(crate) fn process_prefix(domain: u32) -> String {
    prefix_in(&shared_folder(domain))
}

/// Creates a file in the folder of a domain, and the folder too: the last process of the domain may remove the folder at any moment.
pub(crate) fn in_folder<T>(domain: u32, make: impl Fn() -> Result<T, ShmError>) -> Result<T, ShmError> {
    loop {
        shm::make_folder(&shared_folder(domain))?;
        match make() {
            Err(error) if error.source.kind() == io::ErrorKind::NotFound => {}
            made => return made.inspect_err(|_| leave_folder(domain)),
        }
    }
}

/// Removes the folder of a domain, unless something is in it.
pub(crate) fn leave_folder(domain: u32) {
    let _ = rustix::fs::rmdir(shared_path(domain));
}

/// The prefix of the names of processes' files in a domain's folder.
pub(crate) fn prefix_in(folder: &str) -> String {
    format!("{folder}/{PREFIX}p")
}

fn control_file(folder: &str) -> PathBuf {
    Path::new(shm::DIRECTORY).join(folder).join(format!("{PREFIX}control"))
}

/// What the recorder of a domain requests, if there is one.
pub(crate) fn recorder_request(domain: u32) -> RecorderRequest {
    request_in(&shared_folder(domain))
}

/// What the recorder of the domain whose folder has this name requests, if there is one.
pub(crate) fn request_in(folder: &str) -> RecorderRequest {
    let path = control_file(folder);
    let Ok(file) = PeerFile::open(path.clone(), false) else { return RecorderRequest::Nothing };
    if rustix::fs::flock(&file, FlockOperation::NonBlockingLockShared).is_ok() {
        // Its recorder was killed, or has not locked it yet and will check whether it still has a name. A process that has the exclusive
        // lock while the file has a name unlinks this file, and not the next recorder's of the same name.
        if rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok() && has_name(&file) {
            let _ = rustix::fs::unlink(&path);
        }
        return RecorderRequest::Nothing;
    }
    let mut byte = [0];
    match rustix::io::pread(&file, &mut byte, 0) {
        Ok(1) if byte == ON => RecorderRequest::Record,
        _ => RecorderRequest::Finish,
    }
}

/// The lock of a domain's recorder. Dropping it removes its file.
#[derive(Debug)]
pub(crate) struct RecorderLock {
    domain: u32,
    path: PathBuf,
    file: ProcessFd,
    owner: ProcessMark,
}

impl RecorderLock {
    pub(crate) fn claim(domain: u32) -> Result<RecorderLock, TraceError> {
        // Processes hold the lock for a moment when they check for a recorder.
        const PATIENCE: Duration = Duration::from_millis(500);
        let (path, mut patience) = (control_file(&shared_folder(domain)), Patience::new(PATIENCE));
        let refuse = |errno: Errno| TraceError::File { path: path.clone(), source: io::Error::from(errno) };
        loop {
            let flags = OFlags::CREATE | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let open = || {
                let file = rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR);
                file.map_err(|errno| ShmError { path: path.clone(), source: errno.into() })
            };
            let file = in_folder(domain, open)?;
            shm::check_owner(&file).map_err(|source| TraceError::File { path: path.clone(), source })?;
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) if has_name(&file) => {
                    let file = ProcessFd::make(|| Ok(file)).map_err(refuse)?;
                    let control =
                        RecorderLock { domain, path: path.clone(), file, owner: ProcessMark::new() };
                    control.write(ON).map_err(refuse)?;
                    return Ok(control);
                }
                Err(errno) if errno != Errno::WOULDBLOCK => return Err(refuse(errno)),
                _ if patience.is_over() => return Err(TraceError::SecondRecorder { domain }),
                _ => std::thread::sleep(Duration::from_millis(5)),
            }
        }
    }

    /// Tells every process to stop recording.
    pub(crate) fn finish(&self) {
        let _ = self.write(OFF);
    }

    fn write(&self, byte: &[u8]) -> rustix::io::Result<()> {
        rustix::io::pwrite(&self.file, byte, 0).map(|_| ())
    }
}

impl Drop for RecorderLock {
    fn drop(&mut self) {
        if self.owner.is_here() {
            let _ = rustix::fs::unlink(&self.path);
            leave_folder(self.domain);
        }
    }
}

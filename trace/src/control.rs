// SPDX-License-Identifier: MIT OR Apache-2.0
//! How a recorder tells running processes that it is there: a file whose lock it holds, and one byte in it.
//!
//! A killed recorder loses its lock, so that it never leaves tracing on.

use crate::error::TraceError;
use rustix::fs::{FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const DIRECTORY: &str = "/dev/shm";
const ON: &[u8] = b"1";
const OFF: &[u8] = b"0";

/// What a recorder asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Asked {
    /// There is no recorder.
    Nothing,
    /// A recorder collects what is left and ends.
    Finish,
    /// Record.
    Record,
}

/// Starts the names of a domain's trace files, which are private to their user.
pub(crate) fn file_prefix(domain: u32) -> String {
    format!("taut_{domain}_{}_trace_", rustix::process::getuid().as_raw())
}

pub(crate) fn path_of(domain: u32, name: &str) -> PathBuf {
    Path::new(DIRECTORY).join(format!("{}{name}", file_prefix(domain)))
}

/// The trace files of a domain's processes.
pub(crate) fn process_files(domain: u32) -> Vec<PathBuf> {
    let prefix = format!("{}p", file_prefix(domain));
    let Ok(entries) = std::fs::read_dir(DIRECTORY) else { return Vec::new() };
    let of_domain =
        entries.flatten().filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix));
    of_domain.map(|entry| entry.path()).collect()
}

fn path(domain: u32) -> PathBuf {
    path_of(domain, "control")
}

/// Whether a file is this user's. `/dev/shm` is everybody's: what others put there under our names could be cut short while
/// it is mapped, and then kills who reads it.
pub(crate) fn is_own(file: impl AsFd) -> bool {
    rustix::fs::fstat(file).is_ok_and(|stat| stat.st_uid == rustix::process::geteuid().as_raw())
}

fn has_name(file: impl AsFd) -> bool {
    rustix::fs::fstat(file).is_ok_and(|stat| stat.st_nlink != 0)
}

/// Looks whether a recorder is there.
pub(crate) fn asked(domain: u32) -> Asked {
    let path = path(domain);
    let Ok(file) =
        rustix::fs::open(&path, OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NOFOLLOW, Mode::empty())
    else {
        return Asked::Nothing;
    };
    if !is_own(&file) {
        return Asked::Nothing;
    }
    if rustix::fs::flock(&file, FlockOperation::NonBlockingLockShared).is_ok() {
        // Its recorder was killed, or has not come to lock it and will look whether it still has a name. Who locks it alone
        // while it has one unlinks this file, and not the next recorder's of the same name.
        if rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok() && has_name(&file) {
            let _ = rustix::fs::unlink(&path);
        }
        return Asked::Nothing;
    }
    let mut byte = [0];
    match rustix::io::pread(&file, &mut byte, 0) {
        Ok(1) if byte == ON => Asked::Record,
        _ => Asked::Finish,
    }
}

/// The lock of a domain's recorder; its file goes when it is dropped.
#[derive(Debug)]
pub(crate) struct Control {
    path: PathBuf,
    file: OwnedFd,
}

impl Control {
    pub(crate) fn claim(domain: u32) -> Result<Control, TraceError> {
        // Processes hold the lock for a moment when they look.
        const PATIENCE: Duration = Duration::from_millis(500);
        let (path, start) = (path(domain), Instant::now());
        let refuse = |errno: Errno| TraceError::File { path: path.clone(), source: io::Error::from(errno) };
        loop {
            let flags = OFlags::CREATE | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let file = rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR).map_err(refuse)?;
            if !is_own(&file) {
                return Err(refuse(Errno::PERM));
            }
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) if has_name(&file) => {
                    let control = Control { path: path.clone(), file };
                    control.write(ON).map_err(refuse)?;
                    return Ok(control);
                }
                Err(errno) if errno != Errno::WOULDBLOCK => return Err(refuse(errno)),
                _ if start.elapsed() > PATIENCE => return Err(TraceError::SecondRecorder { domain }),
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

impl Drop for Control {
    fn drop(&mut self) {
        let _ = rustix::fs::unlink(&self.path);
    }
}

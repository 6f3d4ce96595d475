// SPDX-License-Identifier: MIT OR Apache-2.0
//! Lock files: one process at a time holds one. The kernel releases the lock when its process dies, for any reason, so that the next
//! process can take over at once.

use crate::Patience;
use crate::fork::{ProcessFd, ProcessMark};
use crate::shm::DIRECTORY;
use rustix::fs::{FlockOperation, Mode, OFlags};
use std::io::{self, Read};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A process that removes the file of a killed process locks it for a moment: that is not another holder.
const PATIENCE: Duration = Duration::from_millis(50);

/// A locked file in /dev/shm. Dropping it releases the lock and removes the file.
#[derive(Debug)]
pub struct LockFile {
    path: PathBuf,
    _lock: ProcessFd,
    owner: ProcessMark,
}

/// Why a file was not locked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LockFileError {
    /// Another process holds the lock.
    #[error("{} is locked by another process", path.display())]
    Locked {
        /// The file.
        path: PathBuf,
        /// The other process's id, if it has written it.
        pid: Option<u32>,
    },
    /// The file cannot be created or locked.
    #[error("the lock {} cannot be used: {source}; check that /dev/shm exists and is writable", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

impl LockFile {
    /// Locks the file `name` in /dev/shm. Creates it if it does not exist.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`LockFileError::Locked`] while another process holds it.
    pub fn lock(name: &str) -> Result<Self, LockFileError> {
        let path = Path::new(DIRECTORY).join(name);
        let refuse = |source: io::Error| LockFileError::File { path: path.clone(), source };
        // A child that is forked between these would keep the lock.
        let open_locked = || -> io::Result<OwnedFd> {
            let flags = OFlags::CREATE | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let file = rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR)?;
            rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive)?;
            Ok(file)
        };
        let mut patience = Patience::new(PATIENCE);
        loop {
            let lock = match ProcessFd::make(open_locked) {
                Ok(lock) => lock,
                Err(error) if error.kind() != io::ErrorKind::WouldBlock => return Err(refuse(error)),
                Err(_) if !patience.is_over() => {
                    std::thread::sleep(Duration::from_millis(1));
                    continue;
                }
                Err(_) => {
                    let pid = read_pid(&path);
                    return Err(LockFileError::Locked { path, pid });
                }
            };
            // Removed between opening and locking: the file belongs to no process any more.
            if rustix::fs::fstat(&lock).map_err(|e| refuse(e.into()))?.st_nlink == 0 {
                continue;
            }
            let written = rustix::fs::ftruncate(&lock, 0)
                .and_then(|()| rustix::io::pwrite(&lock, std::process::id().to_string().as_bytes(), 0));
            written.map_err(|e| refuse(e.into()))?;
            return Ok(LockFile { path, _lock: lock, owner: ProcessMark::new() });
        }
    }
}

impl Drop for LockFile {
    fn drop(&mut self) {
        // Still locked: a process that has opened it meanwhile sees that it was removed, and creates another file.
        if self.owner.is_here() {
            let _ = rustix::fs::unlink(&self.path);
        }
    }
}

fn read_pid(path: &Path) -> Option<u32> {
    let mut text = String::new();
    std::fs::File::open(path).ok()?.take(16).read_to_string(&mut text).ok()?;
    text.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::{Command, Stdio};

    #[test]
    fn one_at_a_time_and_taken_over_when_it_died() {
        let name = format!("taut_lock_{}", std::process::id());
        let path = Path::new(DIRECTORY).join(&name);
        let lock = LockFile::lock(&name).unwrap();
        let refusal = LockFile::lock(&name).unwrap_err();
        assert!(matches!(refusal, LockFileError::Locked { pid: Some(pid), .. } if pid == std::process::id()));
        drop(LockFile::lock(&format!("{name}_other")).unwrap());
        drop(lock);
        assert!(!path.exists());

        // Another process that holds the lock and is killed: nothing of it stays locked.
        let script = format!("exec 9>>{} && flock -x 9 && echo locked && exec sleep 100", path.display());
        let mut holder = Command::new("sh").args(["-c", &script]).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = [0; 7];
        holder.stdout.as_mut().unwrap().read_exact(&mut line).unwrap();
        assert!(matches!(LockFile::lock(&name), Err(LockFileError::Locked { pid: None, .. })));
        holder.kill().unwrap();
        holder.wait().unwrap();
        drop(LockFile::lock(&name).unwrap());
        assert!(!path.exists());
    }

    #[test]
    fn a_file_that_is_just_being_removed_is_nobodys_lock() {
        let name = format!("taut_lock_removed_{}", std::process::id());
        let path = Path::new(DIRECTORY).join(&name);
        for _ in 0..100 {
            let left = std::fs::File::create(&path).unwrap();
            rustix::fs::flock(&left, FlockOperation::NonBlockingLockExclusive).unwrap();
            let taken = std::thread::scope(|scope| {
                let taker = scope.spawn(|| LockFile::lock(&name));
                std::fs::remove_file(&path).unwrap();
                drop(left);
                taker.join().unwrap()
            });
            drop(taken.unwrap());
        }
    }
}

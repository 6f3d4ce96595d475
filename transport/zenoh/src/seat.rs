// SPDX-License-Identifier: MIT OR Apache-2.0
//! One gateway per host, domain and user: who holds the lock on a file is it. The kernel drops the lock of one that
//! dies, however it dies, so that the next can take over at once.

use rustix::fs::{FlockOperation, Mode, OFlags};
use rustix::io::Errno;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Being the gateway; dropping it makes room for another.
#[derive(Debug)]
pub struct Seat {
    path: PathBuf,
    _lock: std::fs::File,
}

/// Why this is not the gateway.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SeatError {
    /// There is one.
    #[error(
        "domain {domain} of this host has a gateway already{}: stop that one, or wait for its end with --standby", holder(*.pid)
    )]
    Taken {
        /// The domain.
        domain: u32,
        /// Process id of the other, if it wrote it.
        pid: Option<u32>,
    },
    /// The file cannot be made or locked.
    #[error("the gateway's lock {} cannot be used: {source}; check that /dev/shm exists and is writable", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

fn holder(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (process {pid})"))
}

impl Seat {
    /// Becomes the gateway of `domain`.
    ///
    /// # Errors
    /// [`SeatError::Taken`] while another lives.
    pub fn take(domain: u32) -> Result<Self, SeatError> {
        let path = path(domain);
        let refuse = |source: io::Error| SeatError::File { path: path.clone(), source };
        loop {
            let flags = OFlags::CREATE | OFlags::RDWR | OFlags::CLOEXEC | OFlags::NOFOLLOW;
            let file =
                rustix::fs::open(&path, flags, Mode::RUSR | Mode::WUSR).map_err(|e| refuse(e.into()))?;
            let mut file = std::fs::File::from(file);
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => {}
                Err(Errno::WOULDBLOCK) => return Err(SeatError::Taken { domain, pid: read_pid(&mut file) }),
                Err(errno) => return Err(refuse(errno.into())),
            }
            // Removed between opening and locking: that file is nobody's any more.
            if rustix::fs::fstat(&file).map_err(|e| refuse(e.into()))?.st_nlink == 0 {
                continue;
            }
            file.set_len(0).and_then(|()| write!(file, "{}", std::process::id())).map_err(refuse)?;
            return Ok(Seat { path, _lock: file });
        }
    }

    /// Becomes the gateway of `domain` as soon as there is no other; `None` if `stop` says so first.
    ///
    /// # Errors
    /// As [`Seat::take`], but for [`SeatError::Taken`].
    pub fn wait(domain: u32, stop: impl Fn() -> bool) -> Result<Option<Self>, SeatError> {
        const PERIOD: Duration = Duration::from_millis(50);
        while !stop() {
            match Seat::take(domain) {
                Err(SeatError::Taken { .. }) => std::thread::sleep(PERIOD),
                outcome => return outcome.map(Some),
            }
        }
        Ok(None)
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        // Still locked: who opened it meanwhile sees that it is gone, and makes another.
        let _ = rustix::fs::unlink(&self.path);
    }
}

fn read_pid(file: &mut std::fs::File) -> Option<u32> {
    let mut text = String::new();
    file.take(16).read_to_string(&mut text).ok()?;
    text.trim().parse().ok()
}

/// Beside the domain's shared memory, which is the user's own.
fn path(domain: u32) -> PathBuf {
    let user = rustix::process::getuid().as_raw();
    Path::new("/dev/shm").join(format!("taut_{domain}_{user}_gateway"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::{Command, Stdio};

    const DOMAIN: u32 = 178;

    #[test]
    fn one_at_a_time_and_taken_over_when_it_died() {
        let seat = Seat::take(DOMAIN).unwrap();
        let refusal = Seat::take(DOMAIN).unwrap_err().to_string();
        let me = format!("process {}", std::process::id());
        assert!(refusal.contains("domain 178") && refusal.contains(&me), "{refusal}");
        drop(Seat::take(DOMAIN - 1).unwrap());
        drop(seat);
        assert!(!path(DOMAIN).exists() && !path(DOMAIN - 1).exists());

        // Another process that holds the lock and is killed: nothing of it stays locked.
        let script =
            format!("exec 9>>{} && flock -x 9 && echo locked && exec sleep 100", path(DOMAIN).display());
        let mut holder = Command::new("sh").args(["-c", &script]).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = [0; 7];
        holder.stdout.as_mut().unwrap().read_exact(&mut line).unwrap();
        assert!(matches!(Seat::take(DOMAIN), Err(SeatError::Taken { pid: None, .. })));
        assert!(Seat::wait(DOMAIN, || true).unwrap().is_none());
        holder.kill().unwrap();
        holder.wait().unwrap();
        drop(Seat::wait(DOMAIN, || false).unwrap().unwrap());
        assert!(!path(DOMAIN).exists());
    }
}

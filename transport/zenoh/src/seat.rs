// SPDX-License-Identifier: MIT OR Apache-2.0
//! One gateway per host, domain, user and scope: who holds the lock on a file is it. The kernel drops the lock of one that
//! dies, however it dies, so that the next can take over at once.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_rt::domain::shared_folder;
use tautline_rt::shm::{self, PeerFile};

/// Being the gateway; dropping it makes room for another.
#[derive(Debug)]
pub struct Seat {
    seat: Option<tautline_rt::Seat>,
    folder: PathBuf,
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
    /// The folder cannot be made.
    #[error("the gateway's lock: {0}")]
    Folder(#[source] shm::ShmError),
    /// The file cannot be made or locked.
    #[error("the gateway's lock: {0}")]
    File(#[source] tautline_rt::SeatError),
}

fn holder(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (process {pid})"))
}

/// In the folder of the domain's shared memory, whose warden removes the file of a gateway that died.
fn file(domain: u32) -> String {
    format!("{}/gateway", shared_folder(domain))
}

impl Seat {
    /// Becomes the gateway of `domain`.
    ///
    /// # Errors
    /// [`SeatError::Taken`] while another lives.
    pub fn take(domain: u32) -> Result<Self, SeatError> {
        const MOMENT: Duration = Duration::from_millis(1);
        let (name, folder) = (file(domain), shared_folder(domain));
        let mut again = 3;
        loop {
            shm::make_folder(&folder).map_err(SeatError::Folder)?;
            match tautline_rt::Seat::take(&name) {
                Ok(seat) => {
                    return Ok(Seat { seat: Some(seat), folder: Path::new(shm::DIRECTORY).join(folder) });
                }
                // Who looks whether the owner lives locks it, too, for a moment.
                Err(tautline_rt::SeatError::Taken { .. }) if again > 0 => {
                    again -= 1;
                    std::thread::sleep(MOMENT);
                }
                Err(tautline_rt::SeatError::Taken { pid, .. }) => {
                    return Err(SeatError::Taken { domain, pid });
                }
                // The last process of the domain removed the folder just now.
                Err(tautline_rt::SeatError::File { source, .. }) if source.kind() == ErrorKind::NotFound => {}
                Err(error) => return Err(SeatError::File(error)),
            }
        }
    }

    /// Becomes the gateway of `domain` as soon as there is no other; `None` if `stop` says so first.
    ///
    /// # Errors
    /// As [`Seat::take`], but for [`SeatError::Taken`].
    pub fn wait(domain: u32, stop: impl Fn() -> bool) -> Result<Option<Self>, SeatError> {
        const PERIOD: Duration = Duration::from_millis(50);
        let path = Path::new(shm::DIRECTORY).join(file(domain));
        while !stop() {
            match Seat::take(domain) {
                Err(SeatError::Taken { .. }) => {}
                outcome => return outcome.map(Some),
            }
            // By the same open file: each attempt to take the seat wakes the domain's warden.
            let holder = PeerFile::open(path.clone(), false);
            std::thread::sleep(PERIOD);
            while holder.as_ref().is_ok_and(PeerFile::is_owned) && !stop() {
                std::thread::sleep(PERIOD);
            }
        }
        Ok(None)
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        self.seat = None;
        // If it was the last file of the domain.
        let _ = std::fs::remove_dir(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_rt::domain::shared_path;
    use tautline_transport::Participant;

    #[test]
    fn one_at_a_time() {
        crate::tests::isolated();
        let seat = Seat::take(178).unwrap();
        let refusal = Seat::take(178).unwrap_err().to_string();
        let me = format!("process {}", std::process::id());
        assert!(refusal.contains("domain 178") && refusal.contains(&me), "{refusal}");
        assert!(Seat::wait(178, || true).unwrap().is_none());
        drop(Seat::take(177).unwrap());
        drop(seat);
        drop(Seat::wait(178, || false).unwrap().unwrap());
        for domain in [177, 178] {
            assert!(!shared_path(domain).exists(), "nothing is left");
        }
    }

    /// Who has the seat has it whatever comes and goes in the domain. The file of who died goes with its warden.
    #[test]
    fn the_domains_warden_leaves_it_alone_until_it_is_free() {
        crate::tests::isolated();
        let seat = Seat::take(179).unwrap();
        drop(Participant::new(179).unwrap());
        let participant = Participant::new(179).unwrap();
        assert!(matches!(Seat::take(179), Err(SeatError::Taken { .. })));
        let path = Path::new(shm::DIRECTORY).join(file(179));
        assert!(path.exists());
        drop(seat);
        // As one that was killed leaves it.
        std::fs::write(&path, "1").unwrap();
        let since = std::time::Instant::now();
        while path.exists() {
            assert!(since.elapsed() < Duration::from_secs(30), "the warden leaves it there");
            std::thread::yield_now();
        }
        drop(participant);
        assert!(path.parent().is_some_and(|folder| !folder.exists()));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! One gateway, and one bridge to each ROS domain, per host, domain, user and scope: who holds the lock on a file is it. The kernel
//! drops the lock of one that dies, however it dies, so that the next can take over at once.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_rt::domain::shared_folder;
use tautline_rt::shm::{self, PeerFile};

/// Being the one; dropping it makes room for another.
#[derive(Debug)]
pub struct Seat {
    seat: Option<tautline_rt::Seat>,
    folder: PathBuf,
}

/// What there is one of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Office {
    /// Of which domain.
    pub domain: u32,
    /// Its file, in the folder of the domain's shared memory, whose warden removes it when who had it has died.
    pub file: String,
    /// What people call it: `gateway`.
    pub name: String,
}

/// Why this is not it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SeatError {
    /// There is one.
    #[error(
        "domain {} of this host has a {} already{}: stop that one, or wait for its end with --standby",
        office.domain,
        office.name,
        holder(*.pid)
    )]
    Taken {
        /// What there is one of.
        office: Office,
        /// Process id of the other, if it wrote it.
        pid: Option<u32>,
    },
    /// The folder cannot be made.
    #[error("the {}'s lock: {source}", office.name)]
    Folder {
        /// Whose.
        office: Office,
        /// Why.
        source: shm::ShmError,
    },
    /// The file cannot be made or locked.
    #[error("the {}'s lock: {source}", office.name)]
    File {
        /// Whose.
        office: Office,
        /// Why.
        source: tautline_rt::SeatError,
    },
}

fn holder(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (process {pid})"))
}

impl Office {
    /// The gateway of a domain.
    pub fn gateway(domain: u32) -> Self {
        Office { domain, file: "gateway".to_owned(), name: "gateway".to_owned() }
    }

    /// The bridge between a domain and one of ROS.
    pub fn bridge(domain: u32, ros_domain: u32) -> Self {
        let file = format!("bridge_ros_{ros_domain}");
        Office { domain, file, name: format!("bridge to ROS domain {ros_domain}") }
    }

    fn file(&self) -> String {
        format!("{}/{}", shared_folder(self.domain), self.file)
    }

    /// Becomes it.
    ///
    /// # Errors
    /// [`SeatError::Taken`] while another lives.
    pub fn take(&self) -> Result<Seat, SeatError> {
        let folder = shared_folder(self.domain);
        loop {
            shm::make_folder(&folder).map_err(|source| SeatError::Folder { office: self.clone(), source })?;
            match tautline_rt::Seat::take(&self.file()) {
                Ok(seat) => {
                    return Ok(Seat { seat: Some(seat), folder: Path::new(shm::DIRECTORY).join(folder) });
                }
                Err(tautline_rt::SeatError::Taken { pid, .. }) => {
                    return Err(SeatError::Taken { office: self.clone(), pid });
                }
                // The last process of the domain removed the folder just now.
                Err(tautline_rt::SeatError::File { source, .. }) if source.kind() == ErrorKind::NotFound => {}
                Err(source) => return Err(SeatError::File { office: self.clone(), source }),
            }
        }
    }

    /// Becomes it as soon as there is no other; `None` if `stop` says so first.
    ///
    /// # Errors
    /// As [`take`](Self::take), but for [`SeatError::Taken`].
    pub fn wait(&self, stop: impl Fn() -> bool) -> Result<Option<Seat>, SeatError> {
        const PERIOD: Duration = Duration::from_millis(50);
        let path = Path::new(shm::DIRECTORY).join(self.file());
        while !stop() {
            match self.take() {
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

    fn isolated() {
        tautline_rt::domain::set_scope(&format!("unit{}", std::process::id())).unwrap();
    }

    #[test]
    fn one_at_a_time() {
        isolated();
        let of_ros = [3, 4].map(|ros_domain| Office::bridge(176, ros_domain));
        let seats = of_ros.clone().map(|office| office.take().unwrap());
        let refusal = of_ros[1].take().unwrap_err().to_string();
        assert!(
            refusal.starts_with("domain 176 of this host has a bridge to ROS domain 4 already"),
            "{refusal}"
        );
        drop(seats);
        let seat = Office::gateway(178).take().unwrap();
        let refusal = Office::gateway(178).take().unwrap_err().to_string();
        let me = format!("process {}", std::process::id());
        assert!(refusal.contains("domain 178") && refusal.contains(&me), "{refusal}");
        assert!(Office::gateway(178).wait(|| true).unwrap().is_none());
        drop(Office::gateway(177).take().unwrap());
        drop(seat);
        drop(Office::gateway(178).wait(|| false).unwrap().unwrap());
        for domain in [176, 177, 178] {
            assert!(!shared_path(domain).exists(), "nothing is left");
        }
    }

    /// Who has the seat has it whatever comes and goes in the domain. The file of who died goes with its warden.
    #[test]
    fn the_domains_warden_leaves_it_alone_until_it_is_free() {
        isolated();
        let seat = Office::gateway(179).take().unwrap();
        drop(Participant::new(179).unwrap());
        let participant = Participant::new(179).unwrap();
        assert!(matches!(Office::gateway(179).take(), Err(SeatError::Taken { .. })));
        let path = Path::new(shm::DIRECTORY).join(Office::gateway(179).file());
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

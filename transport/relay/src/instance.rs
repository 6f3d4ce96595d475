// SPDX-License-Identifier: MIT OR Apache-2.0
//! One gateway, and one bridge per ROS domain, for each host, domain, user and scope, ensured by a lock file. The kernel releases
//! the lock of a killed process, so that the next can take over at once.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tautline_rt::domain::shared_folder;
use tautline_rt::shm::{self, PeerFile};

/// The lock of an instance; dropping this releases it.
#[derive(Debug)]
pub struct InstanceLock {
    lock: Option<tautline_rt::LockFile>,
    folder: PathBuf,
}

/// A program that runs at most once per domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Instance {
    /// Its domain.
    pub domain: u32,
    /// Its lock file, in the folder of the domain's shared memory. The domain's warden removes the file when its holder was killed.
    pub file: String,
    /// Its name in messages: `gateway`.
    pub name: String,
}

/// Why the lock of an instance was not taken.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the names of the fields say it")]
pub enum InstanceError {
    /// Another process holds the lock.
    #[error(
        "domain {} of this host has a {} already{}: stop it, or use --standby to take over when it ends",
        instance.domain,
        instance.name,
        holder(*.pid)
    )]
    Taken {
        instance: Instance,
        /// Process id of the holder, if the file contains it.
        pid: Option<u32>,
    },
    /// The folder cannot be created.
    #[error("lock of the {}: {source}; check that /dev/shm exists and is writable", instance.name)]
    Folder { instance: Instance, source: shm::ShmError },
    /// The file cannot be created or locked.
    #[error("lock of the {}: {source}", instance.name)]
    File { instance: Instance, source: tautline_rt::LockFileError },
}

fn holder(pid: Option<u32>) -> String {
    pid.map_or_else(String::new, |pid| format!(" (process {pid})"))
}

impl Instance {
    /// The gateway of a domain.
    pub fn gateway(domain: u32) -> Self {
        Instance { domain, file: "gateway".to_owned(), name: "gateway".to_owned() }
    }

    /// The bridge between a domain and a ROS domain.
    pub fn bridge(domain: u32, ros_domain: u32) -> Self {
        let file = format!("bridge_ros_{ros_domain}");
        Instance { domain, file, name: format!("bridge to ROS domain {ros_domain}") }
    }

    fn file(&self) -> String {
        format!("{}/{}", shared_folder(self.domain), self.file)
    }

    /// Takes the lock.
    ///
    /// # Errors
    /// [`InstanceError::Taken`] while another process holds it.
    pub fn lock(&self) -> Result<InstanceLock, InstanceError> {
        let folder = shared_folder(self.domain);
        loop {
            shm::make_folder(&folder)
                .map_err(|source| InstanceError::Folder { instance: self.clone(), source })?;
            match tautline_rt::LockFile::lock(&self.file()) {
                Ok(lock) => {
                    return Ok(InstanceLock {
                        lock: Some(lock),
                        folder: Path::new(shm::DIRECTORY).join(folder),
                    });
                }
                Err(tautline_rt::LockFileError::Locked { pid, .. }) => {
                    return Err(InstanceError::Taken { instance: self.clone(), pid });
                }
                // The domain's last process has just removed the folder.
                Err(tautline_rt::LockFileError::File { source, .. })
                    if source.kind() == ErrorKind::NotFound => {}
                Err(source) => return Err(InstanceError::File { instance: self.clone(), source }),
            }
        }
    }

    /// Takes the lock as soon as it is free; `None` if `stop` is true first.
    ///
    /// # Errors
    /// As [`lock`](Self::lock), except [`InstanceError::Taken`].
    pub fn wait(&self, stop: impl Fn() -> bool) -> Result<Option<InstanceLock>, InstanceError> {
        const PERIOD: Duration = Duration::from_millis(50);
        let path = Path::new(shm::DIRECTORY).join(self.file());
        while !stop() {
            match self.lock() {
                Err(InstanceError::Taken { .. }) => {}
                outcome => return outcome.map(Some),
            }
            // Polls the open file, because each attempt to lock wakes the domain's warden.
            let holder = PeerFile::open(path.clone(), false);
            std::thread::sleep(PERIOD);
            while holder.as_ref().is_ok_and(PeerFile::is_owned) && !stop() {
                std::thread::sleep(PERIOD);
            }
        }
        Ok(None)
    }
}

impl Drop for InstanceLock {
    fn drop(&mut self) {
        self.lock = None;
        // Succeeds if the lock was the domain's last file.
        let _ = std::fs::remove_dir(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::isolated;
    use tautline_rt::domain::shared_path;
    use tautline_transport::Participant;

    #[test]
    fn one_at_a_time() {
        isolated();
        let of_ros = [3, 4].map(|ros_domain| Instance::bridge(176, ros_domain));
        let locks = of_ros.clone().map(|instance| instance.lock().unwrap());
        let refusal = of_ros[1].lock().unwrap_err().to_string();
        assert!(
            refusal.starts_with("domain 176 of this host has a bridge to ROS domain 4 already"),
            "{refusal}"
        );
        drop(locks);
        let lock = Instance::gateway(178).lock().unwrap();
        let refusal = Instance::gateway(178).lock().unwrap_err().to_string();
        let me = format!("process {}", std::process::id());
        assert!(refusal.contains("domain 178") && refusal.contains(&me), "{refusal}");
        assert!(Instance::gateway(178).wait(|| true).unwrap().is_none());
        drop(Instance::gateway(177).lock().unwrap());
        drop(lock);
        drop(Instance::gateway(178).wait(|| false).unwrap().unwrap());
        for domain in [176, 177, 178] {
            assert!(!shared_path(domain).exists(), "nothing is left");
        }
    }

    /// The holder keeps the lock while participants start and end. A killed holder's file is removed by the warden.
    #[test]
    fn the_domains_warden_leaves_it_alone_until_it_is_free() {
        isolated();
        let lock = Instance::gateway(179).lock().unwrap();
        drop(Participant::new(179).unwrap());
        let participant = Participant::new(179).unwrap();
        assert!(matches!(Instance::gateway(179).lock(), Err(InstanceError::Taken { .. })));
        let path = Path::new(shm::DIRECTORY).join(Instance::gateway(179).file());
        assert!(path.exists());
        drop(lock);
        // As a killed holder leaves it.
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

// SPDX-License-Identifier: MIT OR Apache-2.0

use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Where the systems of one run keep their files; all of them are removed on drop, also those of killed processes.
#[derive(Debug)]
pub struct Scratch {
    directory: TempDir,
    prefix: String,
}

impl Scratch {
    /// Makes the directory and removes what runs of `bench` that were themselves killed have left.
    ///
    /// # Errors
    /// The directory cannot be made.
    pub fn new(bench: &str) -> Result<Self> {
        for place in places() {
            remove(&place, |name| {
                owner(name, bench).is_some_and(|pid| !Path::new(&format!("/proc/{pid}")).exists())
            });
        }
        let prefix = format!("taut_{bench}_{}_", std::process::id());
        Ok(Self { directory: tempfile::Builder::new().prefix(&prefix).tempdir()?, prefix })
    }

    /// For files.
    #[must_use]
    pub fn directory(&self) -> &Path {
        self.directory.path()
    }

    /// For names in /dev/shm.
    #[must_use]
    pub fn prefix(&self) -> &str {
        &self.prefix
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        for place in places() {
            remove(&place, |name| name.starts_with(&self.prefix));
        }
    }
}

fn places() -> [PathBuf; 2] {
    ["/dev/shm".into(), std::env::temp_dir()]
}

/// The process that made a file of this name, if a run did.
fn owner(name: &str, bench: &str) -> Option<u32> {
    let name = name.strip_prefix("taut_")?.strip_prefix(bench)?.strip_prefix('_')?;
    name.split('_').next()?.parse().ok()
}

fn remove(place: &Path, unwanted: impl Fn(&str) -> bool) {
    for entry in fs::read_dir(place).into_iter().flatten().flatten() {
        if entry.file_name().to_str().is_some_and(&unwanted) {
            // Ignored: what cannot be removed belongs to another user, and bothers nobody.
            let _ = if entry.path().is_dir() {
                fs::remove_dir_all(entry.path())
            } else {
                fs::remove_file(entry.path())
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_files_of_runs_have_an_owner() {
        assert_eq!(owner("taut_wake_12_ab.data", "wake"), Some(12));
        assert_eq!(owner("taut_wake_x", "wake"), None);
        assert_eq!(owner("taut_wakeful_12_", "wake"), None);
    }
}

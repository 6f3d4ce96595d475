// SPDX-License-Identifier: MIT OR Apache-2.0
//! The domain's files, and a gate at which processes wait for each other.

use crate::job::DOMAIN;
use crate::{Experiment, Result};
use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use tautline_harness::Scratch;
use tautline_harness::readings::Reading;
use tautline_rt::domain::shared_path;

/// Shared memory of all processes of the domain, in bytes.
pub fn shared_bytes() -> u64 {
    let files = fs::read_dir(shared_path(DOMAIN)).into_iter().flatten().flatten();
    files.filter_map(|file| file.metadata().ok()).map(|file| file.blocks() * 512).sum()
}

/// Files that the processes of an experiment, which have all ended, have left in shared memory.
pub fn left_behind(experiment: Experiment) -> Result<Reading> {
    let folder = shared_path(DOMAIN);
    let files = match fs::read_dir(&folder) {
        Ok(files) => files.collect::<std::io::Result<Vec<_>>>()?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
        Err(error) => return Err(error.into()),
    };
    let names: Vec<String> =
        files.iter().map(|file| file.file_name().to_string_lossy().into_owned()).collect();
    if !names.is_empty() {
        eprintln!("left in {}: {}", folder.display(), names.join(", "));
    }
    let left = Reading::of(experiment, 0, "files left in /dev/shm", "files").value(names.len() as f64);
    Ok(left.at_most(0.0).must())
}

/// Where processes wait until all of them are there.
pub struct Gate {
    path: PathBuf,
    file: File,
}

impl Gate {
    pub fn closed(scratch: &Scratch) -> Result<Gate> {
        let path = scratch.directory().join("gate");
        let file = File::create(&path)?;
        file.lock()?;
        Ok(Gate { path, file })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn open(self) -> Result<()> {
        Ok(self.file.unlock()?)
    }

    /// Waits until it is open.
    pub fn pass(path: &Path) -> Result<()> {
        Ok(File::open(path)?.lock_shared()?)
    }
}

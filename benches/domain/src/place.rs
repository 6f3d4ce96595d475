// SPDX-License-Identifier: MIT OR Apache-2.0
//! The scope of a run, and its files.

use crate::report::Row;
use crate::{Experiment, Result};
use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use tautline_benches::Scratch;
use tautline_rt::domain::shared_path;

use crate::job::DOMAIN;

/// A scope of its own, with its files.
pub struct Place {
    scratch: Scratch,
}

impl Place {
    /// Moves this process into a new scope.
    pub fn new() -> Result<Self> {
        Ok(Place { scratch: Scratch::new("bench_domain")? })
    }

    /// For files of rivals.
    pub fn scratch(&self) -> &Scratch {
        &self.scratch
    }

    /// The domain's folder in shared memory.
    pub fn folder(&self) -> PathBuf {
        shared_path(DOMAIN)
    }

    /// Shared memory of all processes of the domain, in bytes.
    pub fn shared_bytes(&self) -> u64 {
        let files = fs::read_dir(self.folder()).into_iter().flatten().flatten();
        files.filter_map(|file| file.metadata().ok()).map(|file| file.blocks() * 512).sum()
    }

    /// Counts files in shared memory left by the processes of an experiment, which have all ended.
    pub fn left_behind(&self, experiment: Experiment) -> Result<Row> {
        let files = match fs::read_dir(self.folder()) {
            Ok(files) => files.collect::<std::io::Result<Vec<_>>>()?,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(error.into()),
        };
        let names: Vec<String> =
            files.iter().map(|file| file.file_name().to_string_lossy().into_owned()).collect();
        if !names.is_empty() {
            eprintln!("left in {}: {}", self.folder().display(), names.join(", "));
        }
        Ok(Row::of(experiment, 0, "files left in /dev/shm", "files").value(names.len() as f64).at_most(0.0))
    }

    /// A closed gate.
    pub fn gate(&self) -> Result<Gate> {
        let path = self.scratch.directory().join("gate");
        let file = File::create(&path)?;
        file.lock()?;
        Ok(Gate { path, file })
    }
}

/// Processes wait here for each other.
pub struct Gate {
    path: PathBuf,
    file: File,
}

impl Gate {
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Opens it.
    pub fn open(self) -> Result<()> {
        Ok(self.file.unlock()?)
    }

    /// Waits until it is open.
    pub fn pass(path: &Path) -> Result<()> {
        Ok(File::open(path)?.lock_shared()?)
    }
}

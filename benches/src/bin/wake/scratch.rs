// SPDX-License-Identifier: MIT OR Apache-2.0

use std::fs;
use std::path::Path;

use tempfile::TempDir;

use crate::Result;

/// Where the systems of one run keep their files; all of them are removed on drop, also those of killed processes.
pub struct Scratch {
    directory: TempDir,
    prefix: String,
}

impl Scratch {
    pub fn new() -> Result<Self> {
        let directory = tempfile::Builder::new().prefix("tautline-wake-").tempdir()?;
        Ok(Self { directory, prefix: format!("taut_wake_{}_", std::process::id()) })
    }

    /// For files.
    pub fn directory(&self) -> &Path {
        self.directory.path()
    }

    /// For names in /dev/shm.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        for entry in fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.prefix) {
                // Ignored: whatever is not removed now is named after this process.
                let _ = fs::remove_file(entry.path());
            }
        }
    }
}

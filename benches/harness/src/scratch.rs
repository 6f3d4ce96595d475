// SPDX-License-Identifier: MIT OR Apache-2.0

use std::fs;
use std::path::Path;

use tautline_rt::domain::set_scope;
use tempfile::TempDir;

use crate::Result;

/// Where the systems of one run keep their files, Tautline's in a scope that nobody else is in; all of them are removed on drop, also
/// those of killed processes.
#[derive(Debug)]
pub struct Scratch {
    directory: TempDir,
    prefix: String,
    bench: String,
}

impl Scratch {
    /// Makes the directory, puts this process and those that [`Process`](crate::Process) starts into the scope, and removes what runs
    /// of `bench` that were themselves killed have left. Call it before anything of Tautline's.
    ///
    /// # Errors
    /// The directory cannot be made, or the process is in another scope already.
    pub fn new(bench: &str) -> Result<Self> {
        remove(|name| owner(name, bench).is_some_and(|pid| !Path::new(&format!("/proc/{pid}")).exists()));
        let pid = std::process::id();
        set_scope(&format!("{bench}_{pid}"))?;
        let prefix = format!("taut_{bench}_{pid}_");
        let directory = tempfile::Builder::new().prefix(&prefix).tempdir()?;
        Ok(Self { directory, prefix, bench: bench.to_owned() })
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
        remove(|name| owner(name, &self.bench) == Some(std::process::id()));
    }
}

/// The process that made a file of this name, if a run of `bench` did.
fn owner(name: &str, bench: &str) -> Option<u32> {
    let after = |name: &str| name.strip_prefix(bench)?.strip_prefix('_')?.split('_').next()?.parse().ok();
    match name.rsplit_once('.').filter(|(folder, _)| folder.starts_with("taut")) {
        Some((_, scope)) if scope.starts_with(bench) => after(scope),
        _ => after(name.strip_prefix("taut_")?),
    }
}

fn remove(is_unwanted: impl Fn(&str) -> bool) {
    // Tautline's types are in /tmp, whatever is for temporary files.
    for entry in ["/dev/shm".into(), "/tmp".into(), std::env::temp_dir()]
        .iter()
        .flat_map(fs::read_dir)
        .flatten()
        .flatten()
    {
        if entry.file_name().to_str().is_some_and(&is_unwanted) {
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
        assert_eq!(owner("taut_0_1000.wake_12", "wake"), Some(12));
        assert_eq!(owner("tautline_1000.wake_12", "wake"), Some(12));
        assert_eq!(owner("taut_0_1000.awake_12", "wake"), None);
        assert_eq!(owner("tracker.wake_12", "wake"), None);
    }
}

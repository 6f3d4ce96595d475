// SPDX-License-Identifier: MIT OR Apache-2.0
//! A scope of this run's own, which is removed with its content.

use crate::Result;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use tautline_rt::domain::{kept_folder, set_scope};

const SCOPE: &str = "kills";

/// The folders in which this run may leave nothing.
const FOLDERS: [&str; 2] = ["/dev/shm", "/tmp"];

/// The scope. Removes its files when it is dropped; files that are left when all have ended are a defect: see [`check`](Self::check).
pub struct Place {
    scope: String,
    before: BTreeSet<PathBuf>,
}

impl Place {
    /// Puts this process, and those that it starts, into a scope of their own, and removes the scopes of runs that were killed.
    pub fn new() -> Result<Self> {
        let mark = format!(".{SCOPE}");
        for path in FOLDERS.iter().flat_map(|folder| entries(Path::new(folder))) {
            let owner = path.to_str().and_then(|path| path.rsplit_once(&mark)?.1.parse::<u32>().ok());
            if owner.is_some_and(|pid| !Path::new(&format!("/proc/{pid}")).exists()) {
                remove(&path);
            }
        }
        let scope = format!("{SCOPE}{}", std::process::id());
        set_scope(&scope)?;
        Ok(Place { scope, before: all() })
    }

    /// Checks that nothing of this run is left, after all of its processes have ended. Definitions of types are kept for tools
    /// on purpose, but only complete ones.
    pub fn check(&self) -> Result<()> {
        let kept = kept_folder();
        let halves = entries(&kept.join("schemas"))
            .into_iter()
            .filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.')));
        let after = all();
        let new = after.difference(&self.before).filter(|path| **path != kept && self.is_ours(path));
        let left: Vec<_> = new.cloned().chain(halves).collect();
        if left.is_empty() { Ok(()) } else { Err(format!("left behind: {left:?}").into()) }
    }

    /// Whether a file belongs to this run: other runs may have scopes of their own at the same time.
    fn is_ours(&self, path: &Path) -> bool {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.ends_with(&self.scope)
            || (name.starts_with("taut") && !name.contains('.'))
            || name.contains("iox2")
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let ours = format!(".{}", self.scope);
        let is_ours = |path: &PathBuf| path.to_string_lossy().ends_with(&ours);
        all().iter().filter(|path| is_ours(path)).for_each(|path| remove(path));
    }
}

pub fn entries(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

fn all() -> BTreeSet<PathBuf> {
    FOLDERS.iter().flat_map(|folder| entries(Path::new(folder))).collect()
}

fn remove(path: &Path) {
    // Ignored: a file that cannot be removed is another user's.
    let _ = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where things are built, and what this user may do here.

use crate::files;
use std::ffi::OsString;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// The root of the workspace.
pub fn root() -> PathBuf {
    let xtask = Path::new(env!("CARGO_MANIFEST_DIR"));
    xtask.parent().unwrap_or(xtask).to_owned()
}

/// The directory that this program was built in, which is everything's.
pub fn target_dir() -> PathBuf {
    // <target>/debug/xtask
    let executable = std::env::current_exe().unwrap_or_default();
    executable.ancestors().nth(2).map_or_else(|| root().join("target"), Path::to_owned)
}

/// Writes a shell script to the target directory.
pub fn script(name: &str, line: &str) -> Result<PathBuf, String> {
    let (path, text) = (target_dir().join(name), format!("#!/bin/sh\n{line}\n"));
    // Somebody may be running it.
    if fs::read_to_string(&path).is_ok_and(|there| there == text) {
        return Ok(path);
    }
    let written =
        fs::write(&path, text).and_then(|()| fs::set_permissions(&path, fs::Permissions::from_mode(0o755)));
    written.map(|()| path.clone()).map_err(files::at(&path))
}

/// The value of a variable such as PATH with this folder before the others.
pub fn path_with(variable: &str, folder: &Path) -> OsString {
    let others = std::env::var_os(variable).unwrap_or_default();
    let folders = std::iter::once(folder.to_owned()).chain(std::env::split_paths(&others));
    std::env::join_paths(folders).unwrap_or(others)
}

/// Whether nothing may be skipped that needs a privilege.
pub fn is_ci() -> bool {
    std::env::var_os("CI").is_some_and(|value| !value.is_empty() && value != "false")
}

/// Whether this user may have real-time priorities, as far as capabilities and limits tell.
pub fn realtime_permitted() -> bool {
    const CAP_SYS_NICE: u64 = 1 << 23;
    let field = |file: &str, name: &str| {
        let text = fs::read_to_string(file).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        line.split_whitespace().next().map(str::to_owned)
    };
    let capabilities = field("/proc/self/status", "CapEff:");
    let capable =
        capabilities.and_then(|hex| u64::from_str_radix(&hex, 16).ok()).unwrap_or(0) & CAP_SYS_NICE != 0;
    let limit = field("/proc/self/limits", "Max realtime priority").unwrap_or_default();
    capable || limit == "unlimited" || limit.parse().is_ok_and(|limit: u8| limit >= 98)
}

/// Seconds of a core that this process's children have used, with theirs, once they have ended.
pub fn used_by_children() -> f64 {
    /// Of a second: Linux tells programs of all processors' time in this unit.
    const TICKS: f64 = 100.0;
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // cutime and cstime are its 16th and 17th field; the second may hold spaces, and ends with a bracket.
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace().skip(13).take(2);
    fields.filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / TICKS
}

/// What a program is told where real-time priorities are not permitted; in CI they must be.
pub fn no_rt() -> Option<&'static str> {
    (!is_ci() && !realtime_permitted()).then_some("--no-rt")
}

/// Whether `cargo <arguments>` works; otherwise the last line of what it complains about.
pub fn cargo_has(arguments: &str) -> Result<(), String> {
    let output = Command::new("cargo").args(arguments.split(' ')).stdin(Stdio::null()).output();
    match output {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => {
            let complaint = String::from_utf8_lossy(&output.stderr);
            Err(complaint.lines().find(|line| !line.is_empty()).unwrap_or("it fails silently").to_owned())
        }
        Err(error) => Err(error.to_string()),
    }
}

/// A part of Tautline that nobody else is in; what is left there is removed when this is dropped.
pub struct Scope {
    name: String,
    is_own: bool,
}

impl Scope {
    /// For programs that are given it, and may be killed.
    pub fn new(purpose: &str) -> Scope {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        Scope { name: format!("{purpose}-{}-{count}", std::process::id()), is_own: true }
    }

    /// What everything runs in that a verb starts: it meets nothing of this user's running systems. That of `TAUT_SCOPE`, or a new one,
    /// which is the children's too.
    ///
    /// # Safety
    /// No other thread runs yet.
    pub unsafe fn enter() -> Scope {
        const VARIABLE: &str = "TAUT_SCOPE";
        if let Some(name) = std::env::var(VARIABLE).ok().filter(|name| !name.is_empty()) {
            return Scope { name, is_own: false };
        }
        let name = format!("xtask{}", std::process::id());
        // SAFETY: the caller's promise.
        unsafe { std::env::set_var(VARIABLE, &name) };
        Scope { name, is_own: true }
    }

    /// The value of `TAUT_SCOPE`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What is there: files in shared memory, of domains that nobody may be in any more.
    pub fn left(&self) -> Vec<PathBuf> {
        let folders = entries(Path::new("/dev/shm")).filter(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with("taut_") && name.ends_with(&format!(".{}", self.name))
        });
        folders.flat_map(|folder| entries(&folder).chain([folder.clone()]).collect::<Vec<_>>()).collect()
    }
}

impl Drop for Scope {
    fn drop(&mut self) {
        if !self.is_own {
            return;
        }
        for path in self.left() {
            let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        }
        let ending = format!(".{}", self.name);
        for folder in entries(Path::new("/tmp")) {
            let name = folder.file_name().unwrap_or_default().to_string_lossy();
            if name.starts_with("tautline_") && name.ends_with(&ending) {
                let _ = fs::remove_dir_all(&folder);
            }
        }
    }
}

fn entries(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path())
}

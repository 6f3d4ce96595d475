// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where things are built, and what this user may do here.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

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

/// A Tautline domain for a run that disturbs no other: one of the last 33, of which shared memory has no trace.
pub struct Domain {
    pub number: u32,
    was_unused: bool,
}

impl Domain {
    pub fn unused() -> Domain {
        let first = std::process::id() % 33;
        let mut numbers = (first..first + 33).map(|number| 200 + number % 33);
        match numbers.find(|&number| files_of(number).is_empty()) {
            Some(number) => Domain { number, was_unused: true },
            None => Domain { number: 200 + first, was_unused: false },
        }
    }
}

impl Drop for Domain {
    /// Removes what the run left behind, unless others may use it.
    fn drop(&mut self) {
        if self.was_unused {
            for file in files_of(self.number) {
                let _ = fs::remove_file(file);
            }
        }
    }
}

/// Removes the two small files that every domain has for good (iceoryx2's and the graph's epoch), from the domains that tests
/// use (120 and up) and that have no other file: nobody is in them. And the events that a test left for a recorder when it
/// failed, also in domains that ROS 2 does not have: tests without topics use these.
pub fn sweep() {
    for domain in (120..=232).chain(1190..=1300) {
        let mut files = files_of(domain);
        files.retain(|file| !(is_abandoned_trace(file) && fs::remove_file(file).is_ok()));
        let lasts = |file: &PathBuf| {
            let name = file.to_string_lossy();
            name.ends_with(".global_mgmt") || name.ends_with("_graph1")
        };
        if files.iter().all(lasts) {
            files.iter().for_each(|file| drop(fs::remove_file(file)));
        }
    }
}

/// A trace file is locked as long as its owner lives.
fn is_abandoned_trace(file: &Path) -> bool {
    file.to_string_lossy().contains("_trace_p")
        && fs::File::open(file).is_ok_and(|file| file.try_lock().is_ok())
}

fn files_of(domain: u32) -> Vec<PathBuf> {
    let prefix = format!("taut_{domain}_");
    let entries = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    let of_domain = entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix));
    of_domain.map(|entry| entry.path()).collect()
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The kernel's statistics of processes.

use std::fs;
use std::path::{Path, PathBuf};
use tautline_rt::ThreadTime;
use tautline_rt::clock::monotonic_ns;

pub use tautline_harness::Process;

/// Exact CPU time of a process, from its threads; the clock ticks of `/proc/PID/stat` round it down.
pub fn cpu_ns(pid: u32) -> u64 {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let tids = tasks.filter_map(|task| task.file_name().to_str()?.parse().ok());
    tids.filter_map(ThreadTime::of).map(|time| time.used_ns).sum()
}

/// CPU time of all these processes over this time, as a percentage of one core.
pub fn cpu_percent(pids: &[u32], duration: std::time::Duration) -> f64 {
    let all = || -> Vec<u64> { pids.iter().map(|&pid| cpu_ns(pid)).collect() };
    let (before, start) = (all(), monotonic_ns());
    std::thread::sleep(duration);
    let (after, end) = (all(), monotonic_ns());
    // A process that has ended meanwhile has no statistics.
    let used: u64 = after.iter().zip(before).map(|(after, before)| after.saturating_sub(before)).sum();
    100.0 * used as f64 / (end - start) as f64
}

#[derive(Clone, Copy, Debug, Default)]
pub struct Memory {
    /// Resident, with shared pages in full.
    pub rss: u64,
    /// With shared pages in proportion.
    pub pss: u64,
    /// Resident, without pages in `/dev/shm`: code, heap, stacks.
    pub rss_without_shared: u64,
}

pub fn memory(pid: u32) -> Memory {
    let field = |file: &str, name: &str| {
        let text = fs::read_to_string(format!("/proc/{pid}/{file}")).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix(name)).unwrap_or_default();
        line.split_whitespace().next().and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) * 1024
    };
    let rss = field("smaps_rollup", "Rss:");
    let rss_without_shared = rss.saturating_sub(field("status", "RssShmem:"));
    Memory { rss, pss: field("smaps_rollup", "Pss:"), rss_without_shared }
}

/// A process's open files, except standard input, output and error.
pub fn descriptors(pid: u32) -> Vec<(PathBuf, PathBuf)> {
    let links = fs::read_dir(format!("/proc/{pid}/fd")).into_iter().flatten().flatten();
    let links = links.filter_map(|link| Some((link.path(), fs::read_link(link.path()).ok()?)));
    let is_standard = |link: &Path| ["0", "1", "2"].iter().any(|number| link.ends_with(number));
    links.filter(|(link, _)| !is_standard(link)).collect()
}

/// Mappings of its address space; the kernel's default limit is 65,530.
pub fn mappings(pid: u32) -> usize {
    fs::read_to_string(format!("/proc/{pid}/maps")).map_or(0, |maps| maps.lines().count())
}

/// Files of a process's participants. A participant locks its own, and opens others' only while it reads them.
pub fn records(pid: u32, folder: &Path) -> Vec<PathBuf> {
    let is_record = |(link, path): &(PathBuf, PathBuf)| {
        let name = path.file_name().and_then(|name| name.to_str());
        path.parent() == Some(folder)
            && name.is_some_and(|name| name.len() == 17 && name.starts_with('p'))
            && about(pid, link).lines().any(|line| line.starts_with("lock:"))
    };
    descriptors(pid).into_iter().filter(is_record).map(|(_, file)| file).collect()
}

/// The kernel's information about a descriptor; empty once it is closed.
fn about(pid: u32, link: &Path) -> String {
    let number = link.file_name().unwrap_or_default().to_string_lossy();
    fs::read_to_string(format!("/proc/{pid}/fdinfo/{number}")).unwrap_or_default()
}

/// Whether a process is the domain's warden: only the warden has its pipe open for writing.
pub fn is_warden(pid: u32, folder: &Path) -> bool {
    let has_for_writing = |link: &Path| {
        let about = about(pid, link);
        let flags = about.lines().find_map(|line| line.strip_prefix("flags:"));
        flags.is_some_and(|flags| flags.trim().ends_with('2'))
    };
    descriptors(pid).iter().any(|(link, file)| *file == folder.join("warden") && has_for_writing(link))
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why the kernel refuses a real-time priority.

use std::fs;
use std::path::{Path, PathBuf};

use rustix::process::{Resource, getrlimit};
use rustix::thread::{CapabilitySet, capabilities};

use crate::{RtError, affinity_of};

/// The reason why the kernel would return EPERM for `SCHED_FIFO` or `SCHED_RR` at `priority`: checks privilege
/// first, then the user's limit, then the cpu cgroup. Meaningful only after such an error.
pub fn diagnose(priority: u8) -> RtError {
    let privileged = privileged();
    let limit = getrlimit(Resource::Rtprio).current.unwrap_or(u64::MAX);
    if !privileged && limit == 0 {
        return RtError::MissingCapability { priority, exe: current_exe() };
    }
    if !privileged && limit < u64::from(priority) {
        return RtError::PriorityLimit { priority, limit };
    }
    match group_without_runtime() {
        Some(path) => RtError::NoGroupRuntime { priority, path },
        None => RtError::RealtimeRefused { priority },
    }
}

/// As [`diagnose`], for EPERM of `SCHED_DEADLINE` for thread `tid`: privilege first, then the cores that it is bound to.
pub(crate) fn diagnose_reservation(tid: u32) -> RtError {
    match (privileged(), affinity_of(tid)) {
        (true, Ok(cores)) => RtError::ReservationBound { cores: cores.to_string() },
        (_, Err(error)) => error,
        (false, _) => RtError::ReservationRefused { exe: current_exe() },
    }
}

fn privileged() -> bool {
    capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::SYS_NICE))
}

/// The path of this executable, as a fix would name it.
pub(crate) fn current_exe() -> PathBuf {
    std::env::current_exe().unwrap_or_else(|_| PathBuf::from("<path of the executable>"))
}

/// The runtime file of this process's cpu cgroup, when it reads 0. Version 2 of cgroups has no such file.
fn group_without_runtime() -> Option<PathBuf> {
    let read = |path: &str| fs::read_to_string(path).ok();
    let folder = cpu_group_folder(cpu_group(&read("/proc/self/cgroup")?)?, &read("/proc/self/mountinfo")?)?;
    let file = folder.join("cpu.rt_runtime_us");
    fs::read_to_string(&file).is_ok_and(|runtime| runtime.trim() == "0").then_some(file)
}

/// The cpu controller's group, in the text of `/proc/self/cgroup`; `None` under version 2 of cgroups.
pub fn cpu_group(text: &str) -> Option<&str> {
    text.lines().find_map(|line| {
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        has_cpu(controllers).then_some(path)
    })
}

/// Where that group is mounted, by the text of `/proc/self/mountinfo`: a container may see only its own group. `None` if it is not mounted,
/// or outside of this namespace.
pub fn cpu_group_folder(group: &str, mounts: &str) -> Option<PathBuf> {
    // The kernel's escapes for characters that would end a word.
    let escapes = [("\\040", " "), ("\\011", "\t"), ("\\012", "\n"), ("\\134", "\\")];
    let plain = |path: &str| escapes.iter().fold(path.to_owned(), |path, (from, to)| path.replace(from, to));
    if group.starts_with("/..") {
        return None;
    }
    mounts.lines().find_map(|line| {
        let (place, source) = line.split_once(" - ")?;
        let mut place = place.split(' ').skip(3);
        let (root, mount) = (plain(place.next()?), plain(place.next()?));
        let is_cpu = source.starts_with("cgroup ") && has_cpu(source.rsplit(' ').next()?);
        let below = Path::new(group).strip_prefix(&root).ok().filter(|_| is_cpu)?;
        // Collecting the components removes the slash that an empty `below` adds.
        Some(Path::new(&mount).join(below).components().collect())
    })
}

fn has_cpu(words: &str) -> bool {
    words.split(',').any(|word| word == "cpu")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cpu_group_is_found() {
        let text = "12:memory:/a\n4:cpu,cpuacct:/user.slice/x\n0::/unified\n";
        assert_eq!(cpu_group(text), Some("/user.slice/x"));
        assert_eq!(cpu_group("3:cpuset:/\n2:cpu:/\n"), Some("/"));
        assert_eq!(cpu_group("0::/only/v2\n"), None);
    }

    #[test]
    fn the_cpu_group_is_found_where_it_is_mounted() {
        let host = "33 31 0:30 / /sys/fs/cgroup/memory rw shared:9 - cgroup cgroup rw,memory\n\
                    32 31 0:29 / /sys/fs/cgroup/cpu,cpuacct rw shared:8 - cgroup cgroup rw,cpu,cpuacct\n\
                    41 31 0:38 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw\n";
        // As Docker and Podman mount it into a container that sees the host's groups.
        let container = "83 82 0:29 /docker/1f /sys/fs/cgroup/cpu ro,nosuid - cgroup cgroup rw,cpu\n";
        let folder = |group: &str, mounts: &str| cpu_group_folder(group, mounts).map(PathBuf::into_os_string);
        assert_eq!(folder("/x", host), Some("/sys/fs/cgroup/cpu,cpuacct/x".into()));
        assert_eq!(folder("/", host), Some("/sys/fs/cgroup/cpu,cpuacct".into()));
        assert_eq!(folder("/docker/1f", container), Some("/sys/fs/cgroup/cpu".into()));
        assert_eq!(folder("/docker/1f/a", container), Some("/sys/fs/cgroup/cpu/a".into()));
        assert_eq!(folder("/docker/2", container), None);
        assert_eq!(folder("/docker/1f", ""), None);
        let slice = "83 82 0:29 /a\\134x2db.slice /sys/fs/cgroup/cpu ro - cgroup cgroup rw,cpu\n";
        assert_eq!(folder("/a\\x2db.slice", slice), Some("/sys/fs/cgroup/cpu".into()));
        assert_eq!(folder("/../x", host), None);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Why the kernel refuses a real-time priority, and how to fix it.

use std::fs;
use std::path::{Path, PathBuf};

use rustix::process::{Resource, getrlimit};
use rustix::thread::{CapabilitySet, capabilities};

use crate::{Policy, RtError, ThreadBuilder, affinity_of};

/// Checks whether this process may use `SCHED_FIFO` at `priority`, by using it on a short-lived thread.
///
/// # Errors
/// [`RtError::BadPriority`] outside 1..=99; else the variant that names the fix, as [`diagnose`].
pub fn realtime_permitted(priority: u8) -> Result<(), RtError> {
    ThreadBuilder::new("rt-probe").policy(Policy::Fifo(priority)).spawn(|| || ())?.join()
}

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

/// As [`diagnose`], of EPERM to `SCHED_DEADLINE` for thread `tid`: privilege first, then the cores that it is bound to.
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
    let groups = fs::read_to_string("/proc/self/cgroup").ok()?;
    let mounts = [Path::new("/sys/fs/cgroup/cpu"), Path::new("/sys/fs/cgroup/cpu,cpuacct")];
    let group = cpu_group(&groups)?;
    let mut files = mounts.iter().map(|mount| mount.join(group).join("cpu.rt_runtime_us"));
    files.find(|file| fs::read_to_string(file).is_ok_and(|runtime| runtime.trim() == "0"))
}

/// The path of the cpu controller's group, relative to its mount, in the text of `/proc/self/cgroup`; `None` under version 2 of cgroups.
pub fn cpu_group(text: &str) -> Option<&str> {
    text.lines().find_map(|line| {
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        controllers.split(',').any(|c| c == "cpu").then(|| path.trim_start_matches('/'))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cpu_group_is_found() {
        let text = "12:memory:/a\n4:cpu,cpuacct:/user.slice/x\n0::/unified\n";
        assert_eq!(cpu_group(text), Some("user.slice/x"));
        assert_eq!(cpu_group("3:cpuset:/\n2:cpu:/\n"), Some(""));
        assert_eq!(cpu_group("0::/only/v2\n"), None);
    }

    #[test]
    fn a_priority_out_of_range_is_not_a_matter_of_permission() {
        assert!(matches!(realtime_permitted(0), Err(RtError::BadPriority { priority: 0 })));
        assert!(matches!(realtime_permitted(100), Err(RtError::BadPriority { priority: 100 })));
    }
}

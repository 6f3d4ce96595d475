// SPDX-License-Identifier: MIT OR Apache-2.0
//! The properties of this machine that matter for real time.

use std::fs;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::sync::OnceLock;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use rustix::system::uname;

pub use crate::cores::online_cores;

/// When the kernel may preempt its own work for a thread of higher priority.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Preemption {
    /// `PREEMPT_RT`: nearly always.
    Rt,
    /// `PREEMPT_DYNAMIC`: chosen when booting, see [`HostInfo::preempt_mode`].
    Dynamic,
    /// `PREEMPT`: outside its critical sections.
    Full,
    /// Only at explicit preemption points.
    Voluntary,
}

impl Preemption {
    /// Parses the kernel's version, such as `#1 SMP PREEMPT_RT Debian 6.1` (`uname -v`).
    pub fn of_version(version: &str) -> Preemption {
        let has = |word| version.split_whitespace().any(|w| w == word);
        match () {
            () if has("PREEMPT_RT") => Preemption::Rt,
            () if has("PREEMPT_DYNAMIC") => Preemption::Dynamic,
            () if has("PREEMPT") => Preemption::Full,
            () => Preemption::Voluntary,
        }
    }
}

crate::names!(Preemption: Display {
    Rt: "PREEMPT_RT", Dynamic: "PREEMPT_DYNAMIC", Full: "PREEMPT",
    Voluntary: "PREEMPT_VOLUNTARY or PREEMPT_NONE",
});

/// The kernel and its real-time settings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HostInfo {
    /// The kernel's release, such as `6.8.0-45-generic`.
    pub kernel: String,
    /// The preemption model it was built with.
    pub preemption: Preemption,
    /// The active mode under [`Preemption::Dynamic`] (`none`, `voluntary`, `full` or `lazy`), if it can be read.
    pub preempt_mode: Option<String>,
    /// Real-time threads get at most this many µs in every [`rt_period_us`](Self::rt_period_us); -1: no limit.
    pub rt_runtime_us: Option<i64>,
    /// The period of that limit, in µs.
    pub rt_period_us: Option<i64>,
}

impl HostInfo {
    /// Reads the settings; what cannot be read is `None`.
    pub fn read() -> HostInfo {
        let name = uname();
        let number = |path| fs::read_to_string(path).ok().and_then(|text| text.trim().parse().ok());
        let is_rt = number("/sys/kernel/realtime") == Some(1);
        let mode = fs::read_to_string("/sys/kernel/debug/sched/preempt").ok();
        HostInfo {
            kernel: name.release().to_string_lossy().into_owned(),
            preemption: if is_rt {
                Preemption::Rt
            } else {
                Preemption::of_version(&name.version().to_string_lossy())
            },
            preempt_mode: mode.and_then(|text| selected(&text)),
            rt_runtime_us: number("/proc/sys/kernel/sched_rt_runtime_us"),
            rt_period_us: number("/proc/sys/kernel/sched_rt_period_us"),
        }
    }
}

/// The name of this host.
pub fn name() -> String {
    uname().nodename().to_string_lossy().into_owned()
}

/// Time that the hypervisor gave to other guests while this machine, or this core, was ready to run, in ticks of 10
/// ms since boot. 0 where the kernel reports none, as on bare metal or for a core that does not exist.
pub fn steal_ticks(core: Option<usize>) -> u64 {
    fs::read_to_string("/proc/stat").map_or(0, |stat| parse_steal(&stat, core))
}

/// The limit of open files that a process gets at most: far more than it needs. Children inherit it, and some close every number up to
/// their limit before they begin, which is 10^9 in some containers.
pub const OPEN_FILES: u64 = 65_536;

/// The limit before it was raised.
static OPEN_FILES_BEFORE: OnceLock<Rlimit> = OnceLock::new();

/// Raises this process's limit of open files to the hard limit, but at most to [`OPEN_FILES`], so that the soft limit set by a shell has
/// no effect. Returns the limit.
///
/// # Real-time
/// Setup only.
pub fn raise_open_files() -> u64 {
    let limits = getrlimit(Resource::Nofile);
    let [current, maximum] = [limits.current, limits.maximum].map(|limit| limit.unwrap_or(u64::MAX));
    if current < maximum.min(OPEN_FILES) {
        OPEN_FILES_BEFORE.get_or_init(|| limits);
        // Refused where a sandbox forbids it: then it stays as it is.
        let _ = setrlimit(Resource::Nofile, Rlimit { current: Some(maximum.min(OPEN_FILES)), ..limits });
    }
    getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX)
}

/// Starts the program of `command` with the limit of open files that this process had before [`raise_open_files`].
///
/// # Real-time
/// Setup only.
pub fn with_former_open_files(command: &mut Command) -> &mut Command {
    let Some(before) = OPEN_FILES_BEFORE.get().copied() else { return command };
    let lower = move || {
        let _ = setrlimit(Resource::Nofile, before);
        Ok(())
    };
    // SAFETY: between fork and exec it makes one system call and nothing else.
    unsafe { command.pre_exec(lower) }
}

/// The bracketed word of `none voluntary (full)`.
fn selected(text: &str) -> Option<String> {
    let (_, rest) = text.split_once('(')?;
    Some(rest.split_once(')')?.0.to_owned())
}

/// The 8th number of the line `cpu` (all cores) or `cpuN`.
fn parse_steal(stat: &str, core: Option<usize>) -> u64 {
    let label = core.map_or("cpu".to_owned(), |core| format!("cpu{core}"));
    let mut fields =
        stat.lines().map(str::split_whitespace).filter(|f| f.clone().next() == Some(label.as_str()));
    fields.next().and_then(|mut line| line.nth(8)).and_then(|ticks| ticks.parse().ok()).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CoreSet;

    #[test]
    fn kernel_texts_are_read() {
        assert_eq!(Preemption::of_version("#1 SMP PREEMPT_RT Debian 6.1"), Preemption::Rt);
        assert_eq!(Preemption::of_version("#45-Ubuntu SMP PREEMPT_DYNAMIC Fri"), Preemption::Dynamic);
        assert_eq!(Preemption::of_version("#1 SMP PREEMPT Mon"), Preemption::Full);
        assert_eq!(Preemption::of_version("#1 SMP Mon"), Preemption::Voluntary);
        assert_eq!(selected("none voluntary (full)\n").as_deref(), Some("full"));
        let stat =
            "cpu  1 2 3 4 5 6 7 88 9 10\ncpu0 1 2 3 4 5 6 7 40 9 10\ncpu1 1 2 3 4 5 6 7 48 9 10\nintr 5\n";
        assert_eq!([None, Some(0), Some(1), Some(2)].map(|core| parse_steal(stat, core)), [88, 40, 48, 0]);
    }

    #[test]
    fn the_limit_of_open_files_is_raised_and_not_for_programs_that_are_started() {
        let before = getrlimit(Resource::Nofile);
        let maximum = before.maximum.unwrap_or(u64::MAX);
        setrlimit(Resource::Nofile, Rlimit { current: Some(100), ..before }).unwrap();
        assert_eq!(raise_open_files(), maximum.min(OPEN_FILES));
        assert_eq!(raise_open_files(), maximum.min(OPEN_FILES), "once is enough");
        let mut command = Command::new("sh");
        let output = with_former_open_files(command.args(["-c", "ulimit -n"])).output().unwrap();
        assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), "100");
    }

    #[test]
    fn this_host_can_be_read() {
        let host = HostInfo::read();
        assert!(!host.kernel.is_empty());
        assert!(host.rt_period_us.is_none_or(|us| us > 0));
        assert!(!online_cores().unwrap().is_empty());
        assert!(steal_ticks(None) >= steal_ticks(Some(CoreSet::MAX)));
    }
}

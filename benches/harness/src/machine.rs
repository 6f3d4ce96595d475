// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a measurement's reader must know about where it ran.

use std::fs;
use std::time::Instant;

use tautline_rt::host::{HostInfo, online_cores, steal_ticks};

/// Processor, cores, kernel and the kernel's limit for real-time threads in one line.
pub fn machine() -> String {
    let host = HostInfo::read();
    let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = cpuinfo
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(": "))
        .map_or(std::env::consts::ARCH, |(_, name)| name);
    // All, however few this program confines itself to.
    let cores = online_cores().map_or(1, |cores| cores.len());
    let mode = host.preempt_mode.map(|mode| format!(" ({mode})")).unwrap_or_default();
    let limit = match host.rt_runtime_us.zip(host.rt_period_us) {
        Some((runtime, period)) if runtime >= 0 => {
            format!(", real-time threads get {runtime} of {period} µs when others wait")
        }
        _ => String::new(),
    };
    format!("{cpu}, {cores} cores, kernel {}, {}{mode}{limit}", host.kernel, host.preemption)
}

/// The version of `package` that this workspace was built with.
pub fn version_of(package: &str) -> Option<&'static str> {
    // Of several, the last is the newest: a rival may have an older iceoryx2.
    let (_, entry) =
        include_str!("../../Cargo.lock").rsplit_once(&format!("name = \"{package}\"\nversion = \""))?;
    entry.split('"').next()
}

/// Tells how quiet the machine was: a core that others use must be interrupted to wake a thread on it, whatever its
/// idle states.
#[derive(Debug)]
pub struct Disturbance {
    start: Instant,
    steal_ticks: u64,
    before: Cores,
}

impl Disturbance {
    pub fn start() -> Self {
        Self { start: Instant::now(), steal_ticks: steal_ticks(None), before: Cores::read() }
    }

    /// What the hypervisor gave to others since the start (ticks of 10 ms, share of all cores' time), and how much of a core other programs and the
    /// kernel took, with a warning if it is more than waking idle cores costs the kernel: some 12 % where two processes on two slow cores do nothing
    /// else. To be called when the processes of the measurement have ended and been waited for.
    pub fn report(&self) -> String {
        let (now, before) = (Cores::read(), &self.before);
        let ticks = self.start.elapsed().as_secs_f64().max(0.01) * 100.0;
        let since = |now: u64, before: u64| now.saturating_sub(before) as f64;
        let steal = since(steal_ticks(None), self.steal_ticks);
        let known = steal + since(now.idle, before.idle) + since(now.own, before.own);
        let others = (now.count as f64 - known / ticks).max(0.0) * 100.0;
        let warning = if others > 25.0 { ": NOT QUIET, other programs ran" } else { "" };
        let share = steal / ticks / now.count.max(1) as f64 * 100.0;
        format!("steal {steal} ticks ({share:.1} %), others took {others:.0} % of a core{warning}")
    }
}

/// What became of all cores' time since the machine's start, in ticks of 10 ms. The kernel takes idle time and that of processes from its clock,
/// but what a core works it samples at timer ticks, which short jobs escape.
#[derive(Debug, PartialEq)]
struct Cores {
    count: usize,
    idle: u64,
    /// Of this process, and of its children that have been waited for.
    own: u64,
}

impl Cores {
    fn read() -> Self {
        let read = |path: &str| fs::read_to_string(path).unwrap_or_default();
        Self::of(&read("/proc/stat"), &read("/proc/self/stat"))
    }

    fn of(machine: &str, process: &str) -> Self {
        let number = |field: &str| field.parse::<u64>().unwrap_or(0);
        let all: Vec<u64> =
            machine.lines().next().unwrap_or_default().split_whitespace().map(number).collect();
        let at = |index: usize| all.get(index).copied().unwrap_or(0);
        let is_core = |line: &&str| line.strip_prefix("cpu").is_some_and(|rest| !rest.starts_with(' '));
        // A name may have spaces and brackets. Behind it are the state and ten numbers; then user and system time, of itself and of its children.
        let (_, behind) = process.rsplit_once(')').unwrap_or_default();
        Cores {
            count: machine.lines().filter(is_core).count(),
            idle: at(4) + at(5),
            own: behind.split_whitespace().skip(11).take(4).map(number).sum(),
        }
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn versions_come_from_the_lock_file() {
        assert_eq!(super::version_of("iceoryx2"), Some("0.10.0"));
        assert_eq!(super::version_of("no-such-package"), None);
    }

    #[test]
    fn the_time_of_cores_is_read() {
        let machine = "cpu  500 20 100 9000 300 7 3 40 0 0\ncpu0 500 20 100 9000 300 7 3 40 0 0\nintr 5\n";
        let process = "7 (a (b) c) S 1 7 7 0 -1 4194304 100 200 0 0 50 20 300 10 20 0 1 0 100\n";
        let read = super::Cores::of(machine, process);
        assert_eq!(read, super::Cores { count: 1, idle: 9300, own: 380 });
        assert_eq!(super::Cores::of("", ""), super::Cores { count: 0, idle: 0, own: 0 });
    }
}

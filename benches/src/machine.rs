// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a measurement's reader must know about where it ran.

use std::fs;
use std::time::Instant;

use tautline_rt::host::{HostInfo, steal_ticks};

/// Processor, cores, kernel and the kernel's limit for real-time threads in one line.
pub fn machine() -> String {
    let host = HostInfo::read();
    let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = cpuinfo
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(": "))
        .map_or(std::env::consts::ARCH, |(_, name)| name);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
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
    let lock = include_str!("../../Cargo.lock");
    let (_, entry) = lock.split_once(&format!("name = \"{package}\"\nversion = \""))?;
    entry.split('"').next()
}

/// Tells how quiet the machine was: a core that others use must be interrupted to wake a thread on it, whatever its
/// idle states.
#[derive(Debug)]
pub struct Disturbance {
    start: Instant,
    steal_ticks: u64,
    others_ticks: u64,
}

impl Disturbance {
    pub fn start() -> Self {
        Self { start: Instant::now(), steal_ticks: steal_ticks(None), others_ticks: others_ticks() }
    }

    /// What the hypervisor gave to others since the start (ticks of 10 ms, share of all cores' time), and the share that other programs and the
    /// kernel took, with a warning if it is much. To be called when the processes of the measurement have ended.
    pub fn report(&self) -> String {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let core_seconds = self.start.elapsed().as_secs_f64() * cores as f64;
        let percent = |ticks: u64| ticks as f64 / core_seconds.max(0.01);
        let ticks = steal_ticks(None).saturating_sub(self.steal_ticks);
        let others = percent(others_ticks().saturating_sub(self.others_ticks));
        let warning = if others > 5.0 { ": NOT QUIET, other programs ran" } else { "" };
        format!("steal {ticks} ticks ({:.1} %), others took {others:.1} %{warning}", percent(ticks))
    }
}

/// What all cores have worked since the machine's start but not for this process and those of its children that have ended, in ticks of 10 ms.
fn others_ticks() -> u64 {
    let read = |path: &str| fs::read_to_string(path).unwrap_or_default();
    others(&read("/proc/stat"), &read("/proc/self/stat"))
}

fn others(machine: &str, process: &str) -> u64 {
    let sum = |fields: &mut dyn Iterator<Item = &str>| -> u64 {
        fields.filter_map(|field| field.parse::<u64>().ok()).sum()
    };
    let all: Vec<&str> = machine.lines().next().unwrap_or_default().split_whitespace().collect();
    // User, nice, system; then idle and waiting for disks; interrupts.
    let busy = sum(&mut all
        .iter()
        .enumerate()
        .filter(|(at, _)| [1, 2, 3, 6, 7].contains(at))
        .map(|(_, field)| *field));
    // A name may have spaces. Behind it, the state and ten numbers; user and system time, both of itself and of its children.
    let (_, behind) = process.rsplit_once(')').unwrap_or_default();
    busy.saturating_sub(sum(&mut behind.split_whitespace().skip(11).take(4)))
}

#[cfg(test)]
mod tests {
    #[test]
    fn versions_come_from_the_lock_file() {
        assert_eq!(super::version_of("iceoryx2"), Some("0.10.0"));
        assert_eq!(super::version_of("no-such-package"), None);
    }

    #[test]
    fn others_are_all_but_this_process_and_its_children() {
        let machine = "cpu  500 20 100 9000 300 7 3 40 0 0\ncpu0 500 20 100 9000 300 7 3 40 0 0\n";
        let process = "7 (a (b) c) S 1 7 7 0 -1 4194304 100 200 0 0 50 20 300 10 20 0 1 0 100\n";
        assert_eq!(super::others(machine, process), 630 - 380);
        assert_eq!(super::others("", ""), 0);
    }
}

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
    load: f64,
}

impl Disturbance {
    pub fn start() -> Self {
        let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
        let load = load.split(' ').next().and_then(|load| load.parse().ok()).unwrap_or(f64::NAN);
        Self { start: Instant::now(), steal_ticks: steal_ticks(None), load }
    }

    /// The time that the hypervisor gave to others since the start (ticks of 10 ms, share of all cores' time) and the
    /// load average at the start, with a warning if others were running.
    pub fn report(&self) -> String {
        let ticks = steal_ticks(None).saturating_sub(self.steal_ticks);
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let core_seconds = self.start.elapsed().as_secs_f64() * cores as f64;
        let warning = if self.load > 0.5 { ": NOT QUIET, other programs ran" } else { "" };
        let percent = ticks as f64 / core_seconds.max(0.01);
        format!("steal {ticks} ticks ({percent:.1} %), load average {:.2} at the start{warning}", self.load)
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn versions_come_from_the_lock_file() {
        assert_eq!(super::version_of("iceoryx2"), Some("0.10.0"));
        assert_eq!(super::version_of("no-such-package"), None);
    }
}

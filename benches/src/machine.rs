// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a measurement's reader must know about where it ran.

use std::fs;
use std::time::Instant;

use tautline_rt::host::{HostInfo, steal_ticks};

/// Processor, cores, kernel and the kernel's limit for real-time threads in one line.
#[must_use]
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
#[must_use]
pub fn version_of(package: &str) -> Option<&'static str> {
    let lock = include_str!("../../Cargo.lock");
    let (_, entry) = lock.split_once(&format!("name = \"{package}\"\nversion = \""))?;
    entry.split('"').next()
}

/// Measures the time that the hypervisor gave to others.
#[derive(Debug)]
pub struct StealMeter {
    start: Instant,
    ticks: u64,
}

impl StealMeter {
    /// Starts.
    #[must_use]
    pub fn start() -> Self {
        Self { start: Instant::now(), ticks: steal_ticks(None) }
    }

    /// `steal 12 ticks (0.3 %)` since the start: ticks of 10 ms, share of all cores' time.
    #[must_use]
    pub fn report(&self) -> String {
        let ticks = steal_ticks(None).saturating_sub(self.ticks);
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let core_seconds = self.start.elapsed().as_secs_f64() * cores as f64;
        format!("steal {ticks} ticks ({:.1} %)", ticks as f64 / core_seconds.max(0.01))
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

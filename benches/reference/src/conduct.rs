// SPDX-License-Identifier: MIT OR Apache-2.0
//! A run in time: what it is asked to be, when it counts, and what its process used meanwhile.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tautline_rt::clock::{monotonic_ns, process_cpu_ns, sleep_until_monotonic};
use tautline_rt::host::steal_ticks;

use crate::Window;

/// Before that nothing counts: ends find each other, memory is touched for the first time.
const WARM_UP: Duration = Duration::from_secs(1);
/// After that what still comes from a lidar sample comes late enough to be called missing.
const COOL_DOWN: Duration = Duration::from_millis(500);
const TELL: Duration = Duration::from_millis(200);

/// What a process is asked to run. JSON on the command line of a process that another one starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Job {
    pub seconds: f64,
    pub cruncher_limit: u64,
    pub realtime: bool,
    /// Who runs where, for a middleware that has such files.
    pub system_file: Option<PathBuf>,
    /// The same for another, in the order of [`CALLBACKS`](crate::graph::CALLBACKS): a thread for each. Empty: one thread.
    pub placements: Vec<Placement>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Placement {
    pub core: usize,
    pub priority: u8,
}

#[derive(Clone, Copy, Debug)]
pub struct Usage {
    pub cpu_ns: u64,
    /// Resident memory at the end.
    pub rss_bytes: u64,
    /// What the hypervisor gave to others, in ticks of 10 ms.
    pub steal_ticks: u64,
}

pub fn window(job: &Job) -> Window {
    let begin_ns = monotonic_ns() + WARM_UP.as_nanos() as u64;
    Window { begin_ns, end_ns: begin_ns + (job.seconds * 1e9) as u64 }
}

/// Sleeps until the run is over; `progress` hears the share that has passed, 0 to 1.
pub fn conduct(window: &Window, mut progress: impl FnMut(f64)) -> Usage {
    sleep_until_monotonic(window.begin_ns);
    let (cpu_ns, steal) = (process_cpu_ns(), steal_ticks(None));
    let length_ns = window.end_ns - window.begin_ns;
    while monotonic_ns() < window.end_ns {
        progress((monotonic_ns() - window.begin_ns) as f64 / length_ns as f64);
        sleep_until_monotonic(window.end_ns.min(monotonic_ns() + TELL.as_nanos() as u64));
    }
    let usage = Usage {
        cpu_ns: process_cpu_ns() - cpu_ns,
        rss_bytes: rss_bytes(),
        steal_ticks: steal_ticks(None).saturating_sub(steal),
    };
    sleep_until_monotonic(window.end_ns + COOL_DOWN.as_nanos() as u64);
    usage
}

/// 0 where the kernel does not say.
fn rss_bytes() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kibibytes = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
    kibibytes.unwrap_or(0) * 1024
}

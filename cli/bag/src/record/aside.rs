// SPDX-License-Identifier: MIT OR Apache-2.0
//! Keeps the recorder off the cores to which real-time threads of the domain are bound, if others are left: its timers would
//! interrupt those threads, and its copies would take their caches.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};
use tautline_rt::{self as rt, CoreSet, Policy, RtError, ThreadInfo};

/// From the end of one scan to the next: this time, plus `SHARE` times the duration of the scan.
const PAUSE: Duration = Duration::from_secs(1);
const SHARE: u32 = 100;

pub struct Aside {
    /// The cores on which this process may run, and those on which it runs.
    allowed: CoreSet,
    cores: CoreSet,
    next: Instant,
}

impl Aside {
    /// # Errors
    /// The cores on which this process may run cannot be read.
    pub fn new() -> Result<Self, RtError> {
        let allowed = rt::current_affinity()?;
        Ok(Aside { allowed, cores: allowed, next: Instant::now() })
    }

    /// Moves this process off the cores to which real-time threads of these processes are bound. Returns a message if it has moved.
    pub fn look(&mut self, processes: &BTreeSet<u32>) -> Option<String> {
        let start = Instant::now();
        if start < self.next {
            return None;
        }
        let bound: CoreSet = processes
            .iter()
            // Processes of other users or in other namespaces cannot be read, and count as not bound.
            .flat_map(|pid| rt::threads_of(*pid).unwrap_or_default())
            .filter(|thread| self.is_bound(thread))
            .flat_map(|thread| thread.cores.iter())
            .collect();
        let cores = besides(self.allowed, bound);
        let said = (cores != self.cores).then(|| self.move_to(cores));
        self.next = Instant::now() + PAUSE + start.elapsed() * SHARE;
        said
    }

    fn is_bound(&self, thread: &ThreadInfo) -> bool {
        let is_free = self.allowed.iter().all(|core| thread.cores.contains(core));
        matches!(thread.policy, Policy::Fifo(_) | Policy::RoundRobin(_)) && !is_free
    }

    fn move_to(&mut self, cores: CoreSet) -> String {
        self.cores = cores;
        let moved = rt::threads().and_then(|threads| {
            // Threads inherit the cores of the thread that starts them. A listed thread may have ended since.
            let moved = threads.iter().map(|thread| rt::set_affinity_of(thread.tid, cores));
            moved
                .filter(|moved| !matches!(moved, Err(RtError::NoSuchThread { .. })))
                .collect::<Result<(), _>>()
        });
        match moved {
            Ok(()) if cores == self.allowed => format!("recording on all cores again: {cores}"),
            Ok(()) => {
                format!("recording on cores {cores}: real-time threads are bound to the others (--cores)")
            }
            Err(error) => {
                format!("warning: the recorder is not kept off the cores of real-time threads: {error}")
            }
        }
    }
}

/// The allowed cores that are not bound, or all allowed ones if none is left.
fn besides(allowed: CoreSet, bound: CoreSet) -> CoreSet {
    let left: CoreSet = allowed.iter().filter(|core| !bound.contains(*core)).collect();
    if left.is_empty() { allowed } else { left }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn something_is_left_to_run_on() {
        let of = |list| CoreSet::parse(list).unwrap();
        assert_eq!(besides(of("0-3"), of("1,3")), of("0,2"));
        assert_eq!(besides(of("0-1"), of("0-7")), of("0-1"));
        assert_eq!(besides(of("0-1"), of("")), of("0-1"));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! A processor budget for the network: its threads have real-time priority only while they use little.
//!
//! They run above the callbacks, for what arrives is to be there when a callback starts. A flood, wanted or hostile,
//! would then starve the callbacks. So their time is summed up: once they have used more than the budget in a window,
//! they are ordinary threads until a whole window shows less. What a callback can lose to the network is thus the
//! budget of one window and what is used until the next look, once for each time that a flood begins.

use crate::session::network_threads;
use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;
use tautline_rt::{JoinHandle, Policy, Realtime, RtError, ThreadBuilder, ThreadInfo};

/// How much processor time the network's threads may use at real-time priority.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Of one core, in percent; may be above 100 on several.
    pub percent: u32,
}

impl Default for Budget {
    /// A quarter of one core.
    fn default() -> Self {
        Budget { percent: 25 }
    }
}

const WINDOW: Duration = Duration::from_millis(40);
const LOOKS_PER_WINDOW: u32 = 8;

/// What is to be done after a look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    Keep,
    Demote,
    Promote,
}

/// Decides from the sums alone.
struct Meter {
    budget_ns: u64,
    looks: u32,
    used_at_start_ns: u64,
    is_demoted: bool,
}

impl Meter {
    fn new(budget: Budget, used_ns: u64) -> Self {
        let budget_ns = WINDOW.as_nanos() as u64 * u64::from(budget.percent) / 100;
        Meter { budget_ns, looks: 0, used_at_start_ns: used_ns, is_demoted: false }
    }

    /// `used_ns` is all that was ever used.
    fn look(&mut self, used_ns: u64) -> Verdict {
        self.looks += 1;
        let is_over = used_ns.saturating_sub(self.used_at_start_ns) > self.budget_ns;
        let is_end = self.looks >= LOOKS_PER_WINDOW;
        if is_end {
            (self.looks, self.used_at_start_ns) = (0, used_ns);
        }
        match (self.is_demoted, is_over) {
            (false, true) => {
                // What follows is judged by a window of its own.
                (self.looks, self.used_at_start_ns, self.is_demoted) = (0, used_ns, true);
                Verdict::Demote
            }
            (true, false) if is_end => {
                self.is_demoted = false;
                Verdict::Promote
            }
            _ => Verdict::Keep,
        }
    }
}

/// The thread that looks; dropping it ends it.
pub(crate) struct Guard {
    stop: Arc<AtomicBool>,
    demotions: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Guard {
    /// Watches the threads of Zenoh and those whose names are in `also`, which all have `policy`.
    pub(crate) fn start(
        budget: Budget,
        policy: Policy,
        also: &'static [&'static str],
    ) -> Result<Self, RtError> {
        let (stop, demotions) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        // Above what it watches, or it would not come to look.
        let above = match policy {
            Policy::Fifo(priority) | Policy::RoundRobin(priority) => Policy::Fifo((priority + 1).min(99)),
            other => other,
        };
        let builder = ThreadBuilder::new("gw-budget").policy(above).realtime(Realtime::Required);
        let thread = {
            let (stop, demotions) = (stop.clone(), demotions.clone());
            builder.spawn(move || move || watch(budget, policy, also, &stop, &demotions))?
        };
        Ok(Guard { stop, demotions, thread: Some(thread) })
    }

    /// How often the budget was used up.
    pub(crate) fn demotions(&self) -> u64 {
        self.demotions.load(Ordering::Relaxed)
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn watch(budget: Budget, policy: Policy, also: &[&str], stop: &AtomicBool, demotions: &AtomicU64) {
    let mut watched = Watched::default();
    watched.list(also);
    let mut meter = Meter::new(budget, watched.used_ns());
    let mut looks = 0u32;
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(WINDOW / LOOKS_PER_WINDOW);
        looks = looks.wrapping_add(1);
        if looks.is_multiple_of(LOOKS_PER_WINDOW * 10) {
            watched.list(also);
        }
        match meter.look(watched.used_ns()) {
            Verdict::Keep => {}
            Verdict::Demote => {
                demotions.fetch_add(1, Ordering::Relaxed);
                watched.set(also, Policy::Other { nice: 0 });
            }
            Verdict::Promote => watched.set(also, policy),
        }
    }
    watched.set(also, policy);
}

/// Threads and the time that those which ended had used.
#[derive(Default)]
struct Watched {
    threads: Vec<(u32, u64)>,
    ended_ns: u64,
}

impl Watched {
    fn list(&mut self, also: &[&str]) {
        let Ok(now) = all(also) else { return };
        let known = |tid| self.threads.iter().find(|(known, _)| *known == tid).map(|(_, used)| *used);
        let gone: u64 = self
            .threads
            .iter()
            .filter(|(tid, _)| !now.iter().any(|t| t.tid == *tid))
            .map(|(_, used)| used)
            .sum();
        let threads = now.iter().map(|thread| {
            // A thread that was not known had used something already, which is no use of this window's.
            let used = known(thread.tid);
            (thread.tid, used, used_by(thread.tid))
        });
        let threads: Vec<_> = threads.collect();
        for (_, known, used) in &threads {
            if known.is_none() {
                // Keeps the sum where it was: what it used before is taken off what the ended ones had.
                self.ended_ns = self.ended_ns.wrapping_sub(used.unwrap_or(0));
            }
        }
        self.ended_ns = self.ended_ns.wrapping_add(gone);
        self.threads =
            threads.into_iter().map(|(tid, known, used)| (tid, used.or(known).unwrap_or(0))).collect();
    }

    fn used_ns(&mut self) -> u64 {
        for (tid, used) in &mut self.threads {
            *used = used_by(*tid).unwrap_or(*used);
        }
        self.threads.iter().fold(self.ended_ns, |sum, (_, used)| sum.wrapping_add(*used))
    }

    fn set(&mut self, also: &[&str], policy: Policy) {
        self.list(also);
        for (tid, _) in &self.threads {
            if let Err(error) = tautline_rt::set_policy_of(*tid, policy)
                && !matches!(error, RtError::NoSuchThread { .. })
            {
                tracing::warn!("a network thread keeps its priority: {error}");
            }
        }
    }
}

fn all(also: &[&str]) -> Result<Vec<ThreadInfo>, RtError> {
    let mut threads = network_threads()?;
    let others = tautline_rt::threads()?;
    threads.extend(others.into_iter().filter(|thread| also.contains(&thread.name.as_str())));
    Ok(threads)
}

/// Processor time of a thread of this process, in nanoseconds.
fn used_by(tid: u32) -> Option<u64> {
    fs::read_to_string(format!("/proc/self/task/{tid}/schedstat")).ok()?.split(' ').next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW_NS: u64 = 40_000_000;

    #[test]
    fn over_the_budget_is_demoted_until_a_window_shows_less() {
        let mut meter = Meter::new(Budget { percent: 25 }, 7);
        let mut used = 7;
        let mut look = |share_percent: u64| {
            used += WINDOW_NS / u64::from(LOOKS_PER_WINDOW) * share_percent / 100;
            meter.look(used)
        };
        for _ in 0..100 {
            assert_eq!(look(25), Verdict::Keep, "what is in the budget");
        }
        // A flood: over the budget at the third look at the latest, of a window that may have begun with less.
        let verdicts: Vec<_> = (0..3).map(|_| look(100)).collect();
        assert_eq!(verdicts.iter().filter(|verdict| **verdict == Verdict::Demote).count(), 1, "{verdicts:?}");
        for _ in 0..100 {
            assert_eq!(look(100), Verdict::Keep, "as long as it lasts");
        }
        let after: Vec<_> = (0..20).map(|_| look(10)).collect();
        let promoted: Vec<_> = after.iter().enumerate().filter(|(_, v)| **v == Verdict::Promote).collect();
        assert_eq!(promoted.len(), 1);
        assert!(promoted[0].0 <= 16, "within two windows");
    }

    #[test]
    fn time_of_threads_is_read() {
        let tid = tautline_rt::current_tid();
        let before = used_by(tid).unwrap();
        let mut n = 0u64;
        while used_by(tid).unwrap() < before + 2_000_000 {
            n = n.wrapping_add(1);
        }
        assert_eq!(used_by(u32::MAX), None);
    }
}

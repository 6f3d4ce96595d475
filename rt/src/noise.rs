// SPDX-License-Identifier: MIT OR Apache-2.0
//! Measures what takes the processor from a thread that nothing should interrupt: interrupts, the hypervisor,
//! firmware.

use std::time::Duration;

use crate::clock::monotonic_ns;

/// A thread that only reads the clock sees steps of some 20 ns; a longer one means that it was interrupted.
const THRESHOLD_NS: u64 = 1_000;

/// More interruptions than this in one window are counted but not sorted.
const ROOM: usize = 1 << 16;

/// The interruptions in a time window. The rare longest ones are separated from the regular ones, which occur with
/// every tick: a bound that charges a single outlier to every response has no meaning for the other responses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Interruptions {
    /// Length of the window.
    pub window_ns: u64,
    /// The number of regular interruptions: all except the longest hundredth.
    pub count: u64,
    /// The total length of the regular interruptions.
    pub total_ns: u64,
    /// The longest regular interruption: the 99th percentile.
    pub regular_ns: u64,
    /// The longest of all.
    pub longest_ns: u64,
}

impl Interruptions {
    /// Measures for the time `window` by spinning: run it on the core and at the priority of interest.
    ///
    /// # Real-time
    /// Allocates before the measurement; then no syscall where the kernel maps its clock. Occupies the core for
    /// `window`.
    pub fn watch(window: Duration) -> Interruptions {
        Interruptions::watch_by(monotonic_ns, crate::clock::nanoseconds(window))
    }

    fn watch_by(mut clock: impl FnMut() -> u64, window_ns: u64) -> Interruptions {
        let mut steps_ns = Vec::with_capacity(ROOM);
        // Those without room, all of which count as regular: number, total and longest.
        let mut more = (0, 0, 0);
        let start_ns = clock();
        let end_ns = start_ns.saturating_add(window_ns);
        let mut last_ns = start_ns;
        while last_ns < end_ns {
            let now_ns = clock();
            let step_ns = now_ns - last_ns;
            if step_ns >= THRESHOLD_NS && steps_ns.len() < ROOM {
                steps_ns.push(step_ns);
            } else if step_ns >= THRESHOLD_NS {
                more = (more.0 + 1, more.1 + step_ns, step_ns.max(more.2));
            }
            last_ns = now_ns;
        }
        let mut seen = Interruptions::of(steps_ns, last_ns - start_ns);
        (seen.count, seen.total_ns) = (seen.count + more.0, seen.total_ns + more.1);
        (seen.regular_ns, seen.longest_ns) = (seen.regular_ns.max(more.2), seen.longest_ns.max(more.2));
        seen
    }

    fn of(mut steps_ns: Vec<u64>, window_ns: u64) -> Interruptions {
        steps_ns.sort_unstable();
        let longest_ns = steps_ns.last().copied().unwrap_or(0);
        steps_ns.truncate((steps_ns.len() * 99).div_ceil(100));
        Interruptions {
            window_ns,
            count: steps_ns.len() as u64,
            total_ns: steps_ns.iter().sum(),
            regular_ns: steps_ns.last().copied().unwrap_or(0),
            longest_ns,
        }
    }

    /// Mean time between two regular interruptions; `None` if there was none.
    pub fn period_ns(&self) -> Option<u64> {
        self.window_ns.checked_div(self.count)
    }

    /// Mean length of a regular interruption, rounded up; `None` if there was none.
    pub fn mean_ns(&self) -> Option<u64> {
        (self.count != 0).then(|| self.total_ns.div_ceil(self.count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_numbers_belong_together() {
        let seen = Interruptions::watch(Duration::from_millis(20));
        assert!(seen.window_ns >= 20_000_000);
        assert!(seen.total_ns <= seen.window_ns && seen.regular_ns <= seen.longest_ns);
        assert!(seen.count * THRESHOLD_NS <= seen.total_ns);
    }

    #[test]
    fn the_longest_hundredth_is_told_apart() {
        let mut steps: Vec<u64> = vec![2_000; 198];
        steps.extend([1_000_000, 5_000_000]);
        let seen = Interruptions::of(steps, 1_000_000_000);
        assert_eq!((seen.count, seen.total_ns), (198, 396_000));
        assert_eq!((seen.regular_ns, seen.longest_ns), (2_000, 5_000_000));
        assert_eq!((seen.period_ns(), seen.mean_ns()), (Some(1_000_000_000 / 198), Some(2_000)));
    }

    #[test]
    fn what_there_is_no_room_for_is_counted() {
        let (mut now_ns, mut steps) = (0, 0);
        let clock = || {
            steps += 1;
            now_ns += if steps == 70_000 { 5_000_000 } else { 1_200 };
            now_ns
        };
        let seen = Interruptions::watch_by(clock, 71_000 * 1_200 + 5_000_000);
        assert!(seen.count > ROOM as u64 && seen.longest_ns == 5_000_000, "{seen:?}");
    }

    #[test]
    fn without_interruptions_there_is_no_mean() {
        let none = Interruptions::of(Vec::new(), 10);
        assert_eq!((none.period_ns(), none.mean_ns(), none.longest_ns), (None, None, 0));
    }
}

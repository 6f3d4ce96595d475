// SPDX-License-Identifier: MIT OR Apache-2.0
//! The time limit of a polling loop.

use crate::clock::{monotonic_ns, nanoseconds};
use std::time::Duration;

/// The least number of polls. After a stop (of this process, or of its host) the time may be over although the awaited event had no time to
/// happen.
const LOOKS: u32 = 100;

/// The time limit of a loop that polls about once a millisecond. It ends after its time, but not before 100 polls: a process that
/// was stopped meanwhile, or got no core, polls again before it gives up.
///
/// ```
/// use std::time::Duration;
/// use tautline_rt::Patience;
///
/// // As if all of its time had passed while it was stopped.
/// let mut patience = Patience::new(Duration::ZERO);
/// let mut looks = 1;
/// while !patience.is_over() {
///     looks += 1;
/// }
/// assert_eq!(looks, 101);
/// ```
#[derive(Debug)]
pub struct Patience {
    end_ns: u64,
    looks: u32,
}

impl Patience {
    /// Starts a wait of this length.
    pub fn new(time: Duration) -> Self {
        Patience { end_ns: monotonic_ns().saturating_add(nanoseconds(time)), looks: 0 }
    }

    /// Call it after each unsuccessful poll: whether this was the last one.
    ///
    /// # Real-time
    /// Wait-free; no allocation.
    pub fn is_over(&mut self) -> bool {
        self.is_over_at(monotonic_ns())
    }

    fn is_over_at(&mut self, now_ns: u64) -> bool {
        self.looks = self.looks.saturating_add(1);
        self.looks > LOOKS && now_ns >= self.end_ns
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn who_was_stopped_looks_again() {
        let mut patience = Patience { end_ns: 1000, looks: 0 };
        assert!((0..LOOKS).all(|_| !patience.is_over_at(5000)));
        assert!(patience.is_over_at(5000));
    }

    #[test]
    fn the_time_is_waited_for() {
        let mut patience = Patience { end_ns: 1000, looks: 0 };
        assert!((0..10 * LOOKS).all(|_| !patience.is_over_at(999)));
        assert!(patience.is_over_at(1000));
        assert!(Patience { end_ns: u64::MAX, looks: u32::MAX }.is_over_at(u64::MAX));
    }
}

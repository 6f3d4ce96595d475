// SPDX-License-Identifier: MIT OR Apache-2.0
//! A topic's rate limit.

use std::time::Duration;

/// Admits a message if enough time has passed since the last one.
#[derive(Clone, Copy, Debug)]
pub struct Limiter {
    period_ns: u64,
    next_ns: u64,
}

impl Limiter {
    /// Minimum time between two messages; `None`: no limit.
    pub fn new(min_period: Option<Duration>) -> Self {
        let period_ns = min_period.map_or(0, |period| u64::try_from(period.as_nanos()).unwrap_or(u64::MAX));
        Limiter { period_ns, next_ns: 0 }
    }

    /// Minimum time between two messages, in nanoseconds; 0: no limit.
    pub fn period_ns(&self) -> u64 {
        self.period_ns
    }

    /// Whether a message may pass at `now_ns`. A slightly late message does not delay later ones.
    pub fn admits(&mut self, now_ns: u64) -> bool {
        if self.period_ns == 0 {
            return true;
        }
        if now_ns < self.next_ns {
            return false;
        }
        let on_time = self.next_ns.saturating_add(self.period_ns);
        self.next_ns = if on_time > now_ns { on_time } else { now_ns.saturating_add(self.period_ns) };
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_kept_though_messages_jitter() {
        let mut limiter = Limiter::new(Some(Duration::from_nanos(100)));
        let times = [1000, 1050, 1099, 1103, 1201, 1290, 1302, 2000, 2099, 2100];
        let admitted: Vec<u64> = times.into_iter().filter(|&now| limiter.admits(now)).collect();
        assert_eq!(admitted, [1000, 1103, 1201, 1302, 2000, 2100]);
        let mut none = Limiter::new(None);
        assert!((0..10).all(|now| none.admits(now)));
    }
}

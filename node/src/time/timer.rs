// SPDX-License-Identifier: MIT OR Apache-2.0
//! Timers on a node's ROS clock: on the sampler's clock, or on simulated time.

use super::source::ClockWaiter;
use crate::error::Result;
use std::task::{Context, Poll};
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Events, GuardCondition, Tick};
use tautline_transport::NodeHandle;

/// Follows the ROS clock: with a timer of the sampler while it shows the system's time, else by simulated time.
pub(crate) struct RosTimer {
    waiter: ClockWaiter,
    events: Events,
    /// Wakes the task when the node ends.
    end: GuardCondition,
    period_ns: u64,
    on: On,
    /// Releases so far.
    index: u64,
    missed: u64,
}

enum On {
    Steady(tautline_sampler::Timer),
    Simulated(Schedule),
}

/// When the next release is, in simulated time.
#[derive(Debug, Default)]
struct Schedule {
    /// The next release, and the time at the last check; `None`: the time is not known yet.
    next: Option<(i64, i64)>,
}

impl Schedule {
    /// The number of releases until `now_ns`, and the time at which the last one was due. A new period begins when the clock
    /// has gone back, and when the time becomes known with the simulation's first message.
    fn released(&mut self, now_ns: i64, period_ns: i64) -> Option<(u64, i64)> {
        let next = match self.next {
            Some((next, last)) if now_ns >= last => next,
            _ if now_ns == 0 => return None,
            _ => {
                self.next = Some((now_ns.saturating_add(period_ns), now_ns));
                return None;
            }
        };
        if now_ns < next {
            self.next = Some((next, now_ns));
            return None;
        }
        let releases = (now_ns - next) / period_ns + 1;
        let due = next + (releases - 1) * period_ns;
        self.next = Some((due.saturating_add(period_ns), now_ns));
        Some((releases.unsigned_abs(), due))
    }
}

impl RosTimer {
    pub(crate) fn new(
        node: &NodeHandle,
        waiter: ClockWaiter,
        events: Events,
        period_ns: u64,
    ) -> Result<RosTimer> {
        let on = On::of(&waiter, &events, period_ns)?;
        let end = events.guard_condition()?;
        node.adopt(end.as_ref());
        Ok(RosTimer { waiter, events, end, period_ns, on, index: 0, missed: 0 })
    }

    pub(crate) fn period_ns(&self) -> u64 {
        self.period_ns
    }

    pub(crate) fn missed(&self) -> u64 {
        self.missed
    }

    /// The next release.
    pub(crate) fn poll_tick(&mut self, context: &mut Context<'_>) -> Poll<Tick> {
        self.waiter.register(context);
        let _ = self.end.poll_triggered(context);
        let simulated = self.waiter.source().simulated_ns();
        if simulated.is_some() != matches!(self.on, On::Simulated(_)) {
            match On::of(&self.waiter, &self.events, self.period_ns) {
                Ok(on) => self.on = on,
                Err(error) => tracing::warn!("a timer keeps its previous clock: {error}"),
            }
        }
        let tick = match (&mut self.on, simulated) {
            (On::Steady(timer), _) => match timer.poll_tick(context) {
                Poll::Ready(tick) => tick,
                Poll::Pending => return Poll::Pending,
            },
            (On::Simulated(schedule), now_ns) => {
                let now_ns = now_ns.unwrap_or_default();
                let Some((releases, due)) = schedule.released(now_ns, self.period_ns.cast_signed()) else {
                    return Poll::Pending;
                };
                let (release_ns, since_ns) = (due.unsigned_abs(), monotonic_ns());
                Tick { release_ns, since_ns, index: 0, missed: releases - 1 }
            }
        };
        self.missed += tick.missed;
        self.index += tick.missed + 1;
        Poll::Ready(Tick { index: self.index, ..tick })
    }
}

impl On {
    fn of(waiter: &ClockWaiter, events: &Events, period_ns: u64) -> Result<On> {
        let period = std::time::Duration::from_nanos(period_ns);
        Ok(match waiter.source().simulated_ns() {
            Some(now_ns) => {
                let mut schedule = Schedule::default();
                schedule.released(now_ns, period_ns.cast_signed());
                On::Simulated(schedule)
            }
            None => On::Steady(tautline_sampler::Timer::new(events, period)?),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn releases_follow_a_clock_that_pauses_and_jumps() {
        let mut schedule = Schedule::default();
        for (now, expected) in [
            (0, None),
            // The simulation begins somewhere.
            (1000, None),
            (1009, None),
            (1010, Some((1, 1010))),
            // A pause.
            (1010, None),
            (1025, Some((1, 1020))),
            // Forward: one release, and those that nobody could take.
            (1100, Some((8, 1100))),
            (1109, None),
            // Back: a new period.
            (500, None),
            (509, None),
            (511, Some((1, 510))),
            (520, Some((1, 520))),
            (0, None),
            (5, None),
        ] {
            assert_eq!(schedule.released(now, 10), expected, "{now}");
        }
    }
}

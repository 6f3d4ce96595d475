// SPDX-License-Identifier: MIT OR Apache-2.0
//! Absolute periodic timers, released by the sampler.

use crate::events::{Events, TimerSlot};
use futures::Stream;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_transport::{Slot, TransportError};

/// One release of a timer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tick {
    /// The time at which this release was due, in `CLOCK_MONOTONIC` nanoseconds, or on the simulated clock of a ROS timer.
    pub release_ns: u64,
    /// The `CLOCK_MONOTONIC` time since which it could be served, in nanoseconds: `release_ns`, unless that is simulated.
    pub since_ns: u64,
    /// The number of the release, from 1.
    pub index: u64,
    /// Releases since the previous tick that were not taken.
    pub missed: u64,
}

/// A periodic timer: release *k* (from 1) is at `first + (k - 1) * period`. No drift; setting the system's clock does
/// not disturb it.
///
/// A late task gets the newest release and the number of missed releases, not all of them in a burst.
pub struct Timer {
    slot: TimerSlot<Arc<Slot>>,
    first_release_ns: u64,
    period_ns: u64,
    number: u64,
    seen: u64,
    missed: u64,
}

impl Timer {
    /// A timer whose first release is one period from now.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if there is no memory for its slot.
    pub fn new(events: &Events, period: Duration) -> Result<Timer, TransportError> {
        let period_ns = nanoseconds(period).max(1);
        Timer::starting_at(events, monotonic_ns().saturating_add(period_ns), period)
    }

    /// A timer whose first release is at `first_release_ns` on `CLOCK_MONOTONIC`; periods below 1 ns are 1 ns.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if there is no memory for its slot.
    pub fn starting_at(
        events: &Events,
        first_release_ns: u64,
        period: Duration,
    ) -> Result<Timer, TransportError> {
        let (slot, period_ns) = (events.timer_slot::<Arc<Slot>>()?, nanoseconds(period).max(1));
        let number = slot.arm(first_release_ns, period_ns, None);
        Ok(Timer { slot, first_release_ns, period_ns, number, seen: 0, missed: 0 })
    }

    /// Period in nanoseconds.
    pub fn period_ns(&self) -> u64 {
        self.period_ns
    }

    /// Releases that this timer's task missed so far.
    pub fn missed(&self) -> u64 {
        self.missed
    }

    /// The timer's slot.
    pub fn slot(&self) -> &Arc<Slot> {
        &self.slot.slot
    }

    /// Waits for the next release.
    ///
    /// # Real-time
    /// Each poll wait-free; no allocation; no syscall.
    pub async fn tick(&mut self) -> Tick {
        poll_fn(|context| self.poll_tick(context)).await
    }

    /// The poll function of [`tick`](Self::tick).
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn poll_tick(&mut self, context: &mut Context<'_>) -> Poll<Tick> {
        self.slot.register(context);
        let words = self.slot.words();
        let Some(released) = words.released_since(self.number, self.seen) else { return Poll::Pending };
        let missed = released - self.seen - 1;
        self.seen = released;
        self.missed += missed;
        let release_ns = self.first_release_ns + (released - 1) * self.period_ns;
        Poll::Ready(Tick { release_ns, since_ns: release_ns, index: released, missed })
    }
}

impl Stream for Timer {
    type Item = Tick;

    /// # Real-time
    /// As [`Timer::poll_tick`]. Never ends.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Tick>> {
        self.poll_tick(context).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Sampler;
    use std::sync::atomic::Ordering;
    use std::task::Waker;
    use tautline_transport::Participant;

    /// The sampler accepts the timer when it looks for the ring of the slot's owner before, and again for its own.
    #[test]
    fn a_timer_that_is_accepted_twice_ticks_once_for_each_release() {
        let participant = Participant::new(86).unwrap();
        let mut sampler = Sampler::new(&participant).unwrap();
        let hour = Duration::from_secs(3600);
        let start = monotonic_ns();
        let mut timer = Timer::starting_at(sampler.events(), start, hour).unwrap();
        let (state, slot) = (sampler.events().state.clone(), timer.slot().index());
        let words = state.timers.at(slot);
        let mut poll = || timer.poll_tick(&mut Context::from_waker(Waker::noop()));
        sampler.spin_once(Some(Duration::ZERO));
        assert_eq!(poll(), Poll::Ready(Tick { release_ns: start, since_ns: start, index: 1, missed: 0 }));
        words.released.store(0, Ordering::Release);
        assert_eq!(poll(), Poll::Pending, "counted anew, and not there yet");
        words.released.store(1, Ordering::Release);
        assert_eq!(poll(), Poll::Pending, "it was seen");
        words.released.store(3, Ordering::Release);
        let release_ns = start + 2 * nanoseconds(hour);
        assert_eq!(poll(), Poll::Ready(Tick { release_ns, since_ns: release_ns, index: 3, missed: 1 }));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Activities that must happen in time, monitored by the sampler.

use crate::events::{Events, TimerSlot};
use std::future::poll_fn;
use std::sync::atomic::{Ordering, fence};
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_transport::{Activity, Slot, TransportError};

/// Shorter deadlines and leases are monitored as if they were this long. No thread could meet them, and one that is missed again and
/// again would keep the sampler, for which no thread should have to wait, busy with nothing else.
const SHORTEST: Duration = Duration::from_micros(50);

/// Returns the period with which a deadline or lease of this length is monitored.
pub(crate) fn monitored(period: Duration) -> Duration {
    period.max(SHORTEST)
}

/// An activity did not happen in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expiry {
    /// The latest time at which it should have happened, on `CLOCK_MONOTONIC`: one period after it last happened, or after the
    /// previous expiry.
    pub due_ns: u64,
    /// How many periods have passed without it, from 1.
    pub count: u64,
    /// How many of these since the last expiry that was taken from the watchdog.
    pub change: u64,
}

/// Expires when an [`Activity`] was not seen for one period, and again for each further period. The active
/// thread only stores the time; the sampler checks it when the next activity is due.
pub struct Watchdog {
    slot: TimerSlot<Slot>,
    number: u64,
    seen: u64,
}

impl Watchdog {
    /// Monitors that `activity` is seen at least once in each `period`, from the first time on that it was seen.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if there is no memory for its slot.
    pub fn new(events: &Events, activity: Activity, period: Duration) -> Result<Watchdog, TransportError> {
        let (slot, period_ns) = (events.timer_slot::<Slot>()?, nanoseconds(period).max(1));
        let now_ns = monotonic_ns();
        let first_ns = match events.state.doorbell.activity_ns(activity) {
            0 => now_ns.saturating_add(period_ns),
            activity_ns => now_ns.max(activity_ns.saturating_add(period_ns)),
        };
        let number = slot.arm(first_ns, period_ns, Some(activity));
        Ok(Watchdog { slot, number, seen: 0 })
    }

    /// Waits for the next expiry.
    ///
    /// # Real-time
    /// Each poll wait-free; no allocation; no syscall.
    pub async fn expired(&mut self) -> Expiry {
        poll_fn(|context| self.poll_expired(context)).await
    }

    /// The poll function of [`expired`](Self::expired).
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn poll_expired(&mut self, context: &mut Context<'_>) -> Poll<Expiry> {
        self.slot.register(context);
        let words = self.slot.words();
        let Some(count) = words.released_since(self.number, self.seen) else { return Poll::Pending };
        let due_ns = words.last_due_ns.load(Ordering::Relaxed);
        // Pairs with the Release fence of the sampler, which may already be recording the next expiry.
        fence(Ordering::Acquire);
        if words.begun.load(Ordering::Relaxed) != count {
            // The sampler wakes the task again when that expiry is recorded.
            return Poll::Pending;
        }
        let change = count - self.seen;
        self.seen = count;
        Poll::Ready(Expiry { due_ns, count, change })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Sampler;
    use std::task::Waker;
    use std::time::Duration;
    use tautline_transport::{ActivityKind, Participant};

    /// The sampler has been interrupted between what it writes of an expiry.
    #[test]
    fn an_expirys_time_is_that_of_its_count() {
        let participant = Participant::new(85).unwrap();
        let mut sampler = Sampler::new(&participant).unwrap();
        let slot = participant.claim_slot().unwrap();
        let hour = Duration::from_secs(3600);
        let mut watchdog =
            Watchdog::new(sampler.events(), slot.activity(ActivityKind::Sample), hour).unwrap();
        sampler.spin_once(Some(Duration::ZERO));
        let (state, index) = (sampler.events().state.clone(), watchdog.slot.slot.index());
        let words = state.timers.at(index);
        let mut poll = || watchdog.poll_expired(&mut Context::from_waker(Waker::noop()));
        let write = |begun, due_ns, released| {
            words.begun.store(begun, Ordering::Relaxed);
            words.last_due_ns.store(due_ns, Ordering::Relaxed);
            words.released.store(released, Ordering::Release);
        };
        write(1, 10, 1);
        assert_eq!(poll(), Poll::Ready(Expiry { due_ns: 10, count: 1, change: 1 }));
        write(2, 20, 2);
        write(3, 30, 2);
        assert_eq!(poll(), Poll::Pending, "30 is not when the second one was due");
        write(3, 30, 3);
        assert_eq!(poll(), Poll::Ready(Expiry { due_ns: 30, count: 3, change: 2 }));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What should happen in time, watched by the sampler.

use crate::events::Shared;
use std::future::poll_fn;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll};
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Pulse, Slot};

/// Something did not happen in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expiry {
    /// When it should have happened at the latest, on `CLOCK_MONOTONIC`: one period after it last did, or after the expiry before.
    pub due_ns: u64,
    /// How many periods passed without it, from 1.
    pub count: u64,
    /// How many of these since the last expiry that was taken.
    pub change: u64,
}

/// Expires when what a [`Pulse`] tells of did not happen for one period, and again for each further period. Whoever does it
/// stores the time, and nothing else; the sampler looks there when the next one would be due.
pub struct Watchdog {
    shared: Arc<Shared>,
    slot: Slot,
    number: u64,
    seen: u64,
}

impl Watchdog {
    pub(crate) fn arm(shared: Arc<Shared>, slot: Slot, pulse: Pulse, period_ns: u64) -> Self {
        let now_ns = monotonic_ns();
        let first_ns = match shared.doorbell.pulse_ns(pulse) {
            0 => now_ns.saturating_add(period_ns),
            pulse_ns => now_ns.max(pulse_ns.saturating_add(period_ns)),
        };
        let number = shared.timers[slot.index()].arm(first_ns, period_ns, Some(pulse));
        slot.ring();
        Watchdog { shared, slot, number, seen: 0 }
    }

    /// Waits for the next expiry.
    ///
    /// # Real-time
    /// Each poll wait-free; no allocation; no syscall.
    pub async fn expired(&mut self) -> Expiry {
        poll_fn(|context| self.poll_expired(context)).await
    }

    /// The poll behind [`expired`](Self::expired).
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn poll_expired(&mut self, context: &mut Context<'_>) -> Poll<Expiry> {
        self.slot.waker().register(context.waker());
        let words = &self.shared.timers[self.slot.index()];
        let Some(count) = words.released_since(self.number, self.seen) else { return Poll::Pending };
        let change = count - self.seen;
        self.seen = count;
        Poll::Ready(Expiry { due_ns: words.last_due_ns.load(Ordering::Relaxed), count, change })
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.shared.timers[self.slot.index()].disarm();
        self.slot.ring();
    }
}

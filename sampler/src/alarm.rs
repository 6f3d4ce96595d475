// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wakes a task once, at a time that the task sets.

use crate::events::{Events, TimerSlot};
use std::task::{Context, Poll};
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Slot, TransportError};

/// Wakes one task at a time that can be changed. Ringing its slot also wakes the task, so a task that waits for several things
/// needs only one alarm.
pub struct Alarm {
    slot: TimerSlot<Slot>,
    at_ns: Option<u64>,
}

impl Alarm {
    /// An alarm that is not set.
    ///
    /// # Real-time
    /// Like [`Doorbell::claim`](tautline_transport::Doorbell::claim): wait-free, without allocation or syscall, unless its slot is in
    /// a new window, or in a window that had no timer before: then it allocates and takes a lock.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if there is no memory for its slot.
    pub fn new(events: &Events) -> Result<Alarm, TransportError> {
        Ok(Alarm { slot: events.timer_slot()?, at_ns: None })
    }

    /// The alarm's slot.
    pub fn slot(&self) -> &Slot {
        &self.slot.slot
    }

    /// Sets the time, in `CLOCK_MONOTONIC` nanoseconds. Nothing happens if it is the same as before.
    ///
    /// # Real-time
    /// Wait-free; no allocation; at most one futex wake. The sampler then checks all its timers once.
    pub fn set(&mut self, at_ns: Option<u64>) {
        if at_ns == self.at_ns {
            return;
        }
        self.at_ns = at_ns;
        match at_ns {
            Some(at_ns) => drop(self.slot.arm(at_ns, u64::MAX, None)),
            None => self.slot.disarm(),
        }
    }

    /// Ready when the time has come. Wakes the task then, and whenever the slot is rung.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub fn poll(&self, context: &mut Context<'_>) -> Poll<()> {
        self.slot.register(context);
        if self.at_ns.is_some_and(|at_ns| monotonic_ns() >= at_ns) { Poll::Ready(()) } else { Poll::Pending }
    }
}

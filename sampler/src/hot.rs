// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sampler's loop.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::events::SamplerState;
use crate::sampler::{Sampler, Sleep, Wait};
use crate::timers::{TimerQueue, TimerWords};
use core::cmp::Reverse;
use core::sync::atomic::{Ordering, fence};
use core::time::Duration;
use tautline_rt::clock::{monotonic_ns, nanoseconds};
use tautline_transport::Activity;

impl TimerQueue {
    /// Updates the queue after a timer was armed or dropped at `slot`: O(timers), to find its entry.
    fn update(&mut self, state: &SamplerState, slot: usize) {
        let Some(words) = state.timers.get(slot) else { return };
        if !words.changed.load(Ordering::Relaxed) || !words.changed.swap(false, Ordering::Acquire) {
            return;
        }
        self.spares.move_to_larger(&mut self.due);
        // Acquire: pairs with the Release in `arm`; `armed` and `first_release_ns` belong to this period, or are newer.
        let period_ns = words.period_ns.load(Ordering::Acquire);
        self.due.retain(|Reverse((_, other))| *other != slot);
        words.begun.store(0, Ordering::Relaxed);
        words.released.store(0, Ordering::Relaxed);
        words.accepted.store(words.armed.load(Ordering::Relaxed), Ordering::Release);
        if period_ns != 0 {
            self.due.push(Reverse((words.first_release_ns.load(Ordering::Relaxed), slot)));
        }
    }

    /// Releases every timer that is due. A timer that is late by several periods is released once; the releases between
    /// are counted as missed by its task.
    fn release(&mut self, state: &SamplerState) -> usize {
        let Some(Reverse((first, _))) = self.due.peek() else { return 0 };
        let now = monotonic_ns();
        if *first > now {
            return 0;
        }
        let mut count = 0;
        // Bounded: each timer's next release is put after `now`.
        while let Some(mut next) = self.due.peek_mut() {
            let Reverse((release_ns, slot)) = *next;
            if release_ns > now {
                break;
            }
            let Some(words) = state.timers.get(slot) else { break };
            let period_ns = words.period_ns.load(Ordering::Relaxed);
            if period_ns == 0 {
                // The timer was dropped; its ring has not been drained yet.
                std::collections::binary_heap::PeekMut::pop(next);
                continue;
            }
            let release_ns = due_ns(words, release_ns, period_ns, now, state);
            if release_ns > now {
                *next = Reverse((release_ns, slot));
                continue;
            }
            let elapsed = (now - release_ns) / period_ns + 1;
            *next = Reverse((release_ns.saturating_add(elapsed.saturating_mul(period_ns)), slot));
            drop(next);
            let last_due_ns = release_ns.saturating_add((elapsed - 1).saturating_mul(period_ns));
            words.begun.fetch_add(elapsed, Ordering::Relaxed);
            // Pairs with the Acquire fence in `Watchdog::poll_expired`: a reader of this `last_due_ns` sees this `begun`.
            fence(Ordering::Release);
            words.last_due_ns.store(last_due_ns, Ordering::Relaxed);
            words.released.fetch_add(elapsed, Ordering::Release);
            state.doorbell.wake(slot);
            count += 1;
        }
        count
    }

    fn next_release(&self) -> Option<u64> {
        self.due.peek().map(|Reverse((release_ns, _))| *release_ns)
    }
}

/// When a release that was planned for `release_ns` is due: for a watchdog one period after the last activity, if there was one since.
fn due_ns(words: &TimerWords, release_ns: u64, period_ns: u64, now: u64, state: &SamplerState) -> u64 {
    let Some(activity) = Activity::from_word(words.activity.load(Ordering::Relaxed)) else {
        return release_ns;
    };
    match state.doorbell.activity_ns(activity) {
        // There was no activity yet.
        0 => now.saturating_add(period_ns),
        activity_ns => release_ns.max(activity_ns.saturating_add(period_ns)),
    }
}

impl Sampler {
    /// Wakes the ready tasks; waits up to `timeout` for something to become ready, with `None` without a limit.
    /// Returns the number of events served. [`Events::stop`](crate::Events::stop) ends the wait.
    ///
    /// # Real-time
    /// O(ready) per wake, and O(timers) for each timer, watchdog or alarm that was armed, set or dropped since the last wake; a
    /// request with a time-out causes two of these. No allocation; no lock; one syscall to wait and one per thread that is
    /// woken.
    pub fn spin_once(&mut self, timeout: Option<Duration>) -> usize {
        let deadline_ns = timeout.map(|timeout| monotonic_ns().saturating_add(nanoseconds(timeout)));
        loop {
            let served = self.serve();
            let expired = || deadline_ns.is_some_and(|deadline| monotonic_ns() >= deadline);
            if served != 0 || self.events.is_stopped() || expired() {
                return served;
            }
            self.wait_until(deadline_ns, &mut |_| ());
        }
    }

    /// Serves events until [`Events::stop`](crate::Events::stop) is called.
    ///
    /// # Real-time
    /// Per wake as [`spin_once`](Self::spin_once).
    pub fn spin(&mut self) {
        self.spin_told(|_| ());
    }

    /// Like [`spin`](Self::spin), and calls `sleep` before and after each sleep.
    ///
    /// # Real-time
    /// Like [`spin`](Self::spin), plus the cost of `sleep`, twice per wake.
    pub fn spin_told(&mut self, mut sleep: impl FnMut(Sleep)) {
        tautline_trace::register_thread_as("sampler");
        while !self.events.is_stopped() {
            self.serve();
            // No further work, such as another look at the timers: the threads that were woken on this core wait until the sampler sleeps.
            // A stop rings, but its ring is not pending any more if `serve` has drained it: so the flag is checked, too.
            if !self.events.is_stopped() && !self.events.state.doorbell.is_pending() {
                self.wait_until(None, &mut sleep);
            }
        }
    }

    /// Drains the rings first, so that a timer that one of them armed is checked at once.
    fn serve(&mut self) -> usize {
        let (state, timers) = (&*self.events.state, &mut self.timers);
        let rung = self.seat.drain(|slot| timers.update(state, slot));
        let served = rung + timers.release(state);
        if std::mem::take(&mut self.awake) {
            tautline_trace::spin_end(&self.trace);
        }
        served
    }

    fn wait_until(&mut self, deadline_ns: Option<u64>, sleep: &mut impl FnMut(Sleep)) {
        let until = match (deadline_ns, self.timers.next_release()) {
            (Some(deadline), Some(release)) => Some(deadline.min(release)),
            (deadline, release) => deadline.or(release),
        };
        tautline_trace::spin_start(&self.trace, until);
        sleep(Sleep::Begins);
        self.sleep_until(until);
        sleep(Sleep::Ends { due_ns: until });
        if tautline_trace::is_on() {
            let due = || self.timers.next_release().is_some_and(|release_ns| monotonic_ns() >= release_ns);
            self.awake = self.events.state.doorbell.is_pending() || due();
            if self.awake {
                tautline_trace::spin_wake(&self.trace);
            } else {
                tautline_trace::spin_timeout(&self.trace);
            }
        }
    }

    fn sleep_until(&self, until: Option<u64>) {
        let doorbell = &self.events.state.doorbell;
        if let Wait::Adaptive(spin) = self.wait {
            let give_up_ns = monotonic_ns().saturating_add(nanoseconds(spin));
            loop {
                if doorbell.is_pending() {
                    return;
                }
                let now = monotonic_ns();
                if until.is_some_and(|until| now >= until) {
                    return;
                }
                if now >= give_up_ns {
                    break;
                }
                core::hint::spin_loop();
            }
        }
        self.seat.sleep(until);
    }
}

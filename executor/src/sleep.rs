// SPDX-License-Identifier: MIT OR Apache-2.0
//! The sleep of a callback thread that only its own process wakes.
//!
//! ```text
//!  waker (any thread)                            the thread
//!  1 state |= WOKEN                              1 not WOKEN? state = the next sleep's number | SLEEPING, and
//!  2 it was SLEEPING, and not OVER? wake           2 sleep while state is that
//!  3 state |= OVER, unless that sleep has ended  3 clear the three bits; again from 1 if it was not WOKEN
//! ```
//!
//! As with the doorbell, only the thread that sleeps clears SLEEPING, and a waker leaves the wake to another only if that one's is over. The
//! standard library's `unpark` and the tasks of `futures` leave it to whoever was first: if that is a thread of low priority that is
//! preempted before its wake, the callback would sleep on although the sampler wakes it.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use std::sync::atomic::Ordering;
use std::time::Duration;

use tautline_rt::FutexWord;

use crate::Parker;

const WOKEN: u32 = 1;
const SLEEPING: u32 = 2;
const OVER: u32 = 4;
/// The lowest bit of the number of the sleep, which wraps.
const ONE_SLEEP: u32 = 8;

#[derive(Debug)]
pub(crate) struct ThreadSleep(FutexWord);

impl ThreadSleep {
    pub fn new() -> ThreadSleep {
        ThreadSleep(FutexWord::new(0))
    }
}

impl Parker for ThreadSleep {
    /// # Real-time
    /// No allocation; one syscall for each sleep. It never spins.
    fn park(&self, _spin: Duration) {
        let word = &self.0.0;
        loop {
            let state = word.load(Ordering::Relaxed);
            let asleep = state.wrapping_add(ONE_SLEEP) | SLEEPING;
            if state & WOKEN == 0
                && word.compare_exchange(state, asleep, Ordering::Relaxed, Ordering::Relaxed).is_ok()
            {
                self.0.wait(asleep, None);
            }
            // Acquire: pairs with the Release in `unpark`.
            if word.fetch_and(!(ONE_SLEEP - 1), Ordering::Acquire) & WOKEN != 0 {
                return;
            }
        }
    }

    /// # Real-time
    /// Wait-free; no allocation; one futex wake if the thread sleeps and no wake of that sleep is over, else no syscall.
    fn unpark(&self) {
        let word = &self.0.0;
        // Release: pairs with the Acquire in `park`; what was written before the wake is seen after the sleep.
        let before = word.fetch_or(WOKEN, Ordering::Release);
        if before & (SLEEPING | OVER) == SLEEPING {
            self.0.wake();
            let state = before | WOKEN;
            let _ = word.compare_exchange(state, state | OVER, Ordering::Relaxed, Ordering::Relaxed);
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
#[allow(clippy::disallowed_methods, clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use std::sync::Arc;

    fn state(sleep: &ThreadSleep) -> u32 {
        sleep.0.0.load(Ordering::Relaxed)
    }

    #[test]
    fn a_waker_that_gets_no_further_keeps_no_other_from_waking() {
        let sleep = Arc::new(ThreadSleep::new());
        let its_own = Arc::clone(&sleep);
        let thread = std::thread::spawn(move || its_own.park(Duration::ZERO));
        while state(&sleep) & SLEEPING == 0 {
            std::thread::yield_now();
        }
        // Preempted here.
        sleep.0.0.fetch_or(WOKEN, Ordering::Release);
        sleep.unpark();
        thread.join().unwrap();
    }

    #[test]
    fn a_wake_before_the_sleep_prevents_it_and_one_wake_is_enough() {
        let sleep = ThreadSleep::new();
        sleep.unpark();
        sleep.unpark();
        sleep.park(Duration::ZERO);
        assert_eq!(state(&sleep), 0, "it did not begin to sleep");
        // As if it slept.
        sleep.0.0.store(ONE_SLEEP | SLEEPING, Ordering::Relaxed);
        sleep.unpark();
        assert_eq!(state(&sleep), ONE_SLEEP | SLEEPING | WOKEN | OVER, "the next one makes no system call");
    }
}

#[cfg(all(test, taut_loom))]
#[allow(clippy::indexing_slicing, reason = "a test")]
mod loom_tests {
    use super::*;
    use loom::sync::Arc;
    use loom::sync::atomic::AtomicBool;

    #[test]
    fn loom_a_thread_sees_what_was_written_before_each_wake() {
        let mut model = loom::model::Builder::new();
        model.preemption_bound = Some(3);
        model.check(|| {
            let sleep = Arc::new(ThreadSleep::new());
            let written = Arc::new([AtomicBool::new(false), AtomicBool::new(false)]);
            for index in 0..2 {
                let (sleep, written) = (sleep.clone(), written.clone());
                loom::thread::spawn(move || {
                    written[index].store(true, Ordering::Relaxed);
                    sleep.unpark();
                });
            }
            // It would sleep for ever if a wake were lost, which loom finds.
            while !written.iter().all(|one| one.load(Ordering::Relaxed)) {
                sleep.park(Duration::ZERO);
            }
        });
    }
}

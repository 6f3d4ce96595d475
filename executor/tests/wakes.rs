// SPDX-License-Identifier: MIT OR Apache-2.0
//! A wake of a callback is not left to a thread of lower priority.

mod common;

use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::task::{Poll, Waker};

use common::{cores, realtime};
use tautline_executor::{CallbackOptions, Executor, Realtime};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};

/// One that wakes all the time is preempted at any instant of that by another one, which then needs the same callback.
#[test]
fn a_waker_that_is_preempted_holds_up_no_other() {
    const ROUNDS: u64 = 300;
    if !realtime() {
        return;
    }
    let [first, .., last] = cores()[..] else { return println!("skipped: needs two cores") };
    let executor = Executor::new(Realtime::Required);
    let (polls, waker) = (Arc::new(AtomicU64::new(0)), Arc::new(OnceLock::<Waker>::new()));
    let (its_polls, its_waker) = (polls.clone(), waker.clone());
    let woken = poll_fn(move |context| {
        its_waker.get_or_init(|| context.waker().clone());
        its_polls.fetch_add(1, Ordering::SeqCst);
        Poll::<()>::Pending
    });
    let woken = executor.spawn_callback(CallbackOptions::fifo(20).core(last).name("woken"), woken).unwrap();
    while waker.get().is_none() {
        std::thread::yield_now();
    }
    let (begun, over, served) =
        (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let (wake, has_begun, ends, its_served) =
        (waker.get().unwrap().clone(), begun.clone(), over.clone(), served.clone());
    let high = async move {
        while !has_begun.load(Ordering::SeqCst) {
            sleep_until_monotonic(monotonic_ns() + 100_000);
        }
        for round in 0..ROUNDS {
            sleep_until_monotonic(monotonic_ns() + 20_000 + round * 7_919 % 20_000);
            let before = polls.load(Ordering::SeqCst);
            wake.wake_by_ref();
            // The one below has no core until this ends.
            let end_ns = monotonic_ns() + 2_000_000_000;
            while polls.load(Ordering::SeqCst) == before && monotonic_ns() < end_ns {
                std::hint::spin_loop();
            }
            if polls.load(Ordering::SeqCst) == before {
                break;
            }
            its_served.fetch_add(1, Ordering::SeqCst);
        }
        ends.store(true, Ordering::SeqCst);
    };
    let high = executor.spawn_callback(CallbackOptions::fifo(30).core(first).name("high"), high).unwrap();
    let wake = waker.get().unwrap().clone();
    let low = async move {
        begun.store(true, Ordering::SeqCst);
        while !over.load(Ordering::SeqCst) {
            wake.wake_by_ref();
        }
    };
    let low = executor.spawn_callback(CallbackOptions::fifo(1).core(first).name("low"), low).unwrap();
    high.join().unwrap();
    low.join().unwrap();
    woken.stop();
    woken.join().unwrap();
    assert_eq!(served.load(Ordering::SeqCst), ROUNDS);
}

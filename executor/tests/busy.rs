// SPDX-License-Identifier: MIT OR Apache-2.0
//! Busy polling runs without wakes, and starves nobody.

mod common;

use std::future::{pending, poll_fn};
use std::task::Poll;

use common::{cores, realtime};
use tautline_executor::{CallbackOptions, CoreSet, Executor, ExecutorError, Policy, Realtime, busy_polling};
use tautline_rt::set_affinity;

#[test]
fn a_busy_callback_is_polled_without_wakes_until_it_ends_or_is_stopped() {
    let executor = Executor::new(Realtime::Off);
    let options = CallbackOptions::fifo(1).core(cores()[0]).busy_poll();
    let mut polls = 0;
    let count = poll_fn(move |_| {
        assert!(busy_polling());
        polls += 1;
        if polls == 10_000 { Poll::Ready(()) } else { Poll::Pending }
    });
    executor.spawn_callback(options.clone(), count).unwrap().join().unwrap();

    let endless = executor.spawn_callback(options, pending()).unwrap();
    endless.stop();
    endless.join().unwrap();
}

#[test]
fn a_plain_callback_knows_that_it_parks() {
    let executor = Executor::new(Realtime::Off);
    let future = async { assert!(!busy_polling()) };
    executor.spawn_callback(CallbackOptions::other(), future).unwrap().join().unwrap();
}

#[test]
fn without_one_core_of_its_own_it_is_refused() {
    let executor = Executor::new(Realtime::Required);
    let cores = cores();
    if cores.len() > 1 {
        let both = CoreSet::one(cores[0]).with(cores[1]);
        let error =
            executor.spawn_callback(CallbackOptions::fifo(1).cores(both).busy_poll().name("b"), pending());
        let message = error.unwrap_err().to_string();
        assert!(message.starts_with(&format!("callback `b` cannot busy-poll on cores {both}")), "{message}");
    }
    // Refused before any thread starts, so no privilege is needed to see it.
    let core = CoreSet::one(cores[0]);
    let _sampler = executor.register_thread("sampler", Policy::Fifo(30), core).unwrap();
    let error =
        executor.spawn_callback(CallbackOptions::fifo(30).cores(core).busy_poll(), pending()).unwrap_err();
    match error {
        ExecutorError::Starved { starved, busy_priority, .. } => {
            assert_eq!((starved.as_str(), busy_priority), ("sampler", 30));
        }
        ExecutorError::BusyPollOnlyCore { .. } => assert_eq!(cores.len(), 1),
        other => panic!("{other}"),
    }
}

#[test]
fn who_would_starve_below_it_is_refused_until_it_ends() {
    if !realtime() {
        return;
    }
    let cores = cores();
    let [first, .., last] = cores[..] else { return println!("skipped: needs two cores") };
    // Out of the busy poller's way.
    set_affinity(CoreSet::one(first)).unwrap();
    let executor = Executor::new(Realtime::Required);
    let busy = executor.spawn_callback(CallbackOptions::fifo(5).core(last).busy_poll(), pending()).unwrap();
    let late = CallbackOptions::fifo(5).core(last).name("late");
    let message = executor.spawn_callback(late.clone(), pending()).unwrap_err().to_string();
    assert!(message.contains("would starve `late`") && message.contains("a priority above 5"), "{message}");
    executor.spawn_callback(CallbackOptions::fifo(6).core(last), async {}).unwrap().join().unwrap();
    busy.stop();
    busy.join().unwrap();
    executor.spawn_callback(late, async {}).unwrap().join().unwrap();
    executor.shutdown().unwrap();
}

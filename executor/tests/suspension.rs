// SPDX-License-Identifier: MIT OR Apache-2.0
//! Budgets and reservations that leave others their time, and still come to their end while others want all of it.

mod common;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Poll;
use std::time::Duration;

use common::{Log, cores, realtime};
use futures::StreamExt;
use tautline_executor::{CallbackOptions, CallbackStats, Executor, ExecutorError, Policy, Realtime, job};
use tautline_rt::clock;

fn budget() -> Duration {
    clock::test_time(Duration::from_millis(2))
}

fn period() -> Duration {
    budget() * 10
}

/// A job that is released now.
fn one_job() -> impl futures::Stream<Item = ()> + Send {
    let mut running: Option<job::Job> = None;
    let mut left = 1;
    futures::stream::poll_fn(move |_| {
        if let Some(job) = running.take() {
            job.finish();
        }
        if left == 0 {
            return Poll::Ready(None);
        }
        left -= 1;
        running = Some(job::begin(clock::monotonic_ns()));
        Poll::Ready(Some(()))
    })
}

/// A thread below that wants the core until the one above has ended, which does not end before the one below has run.
fn shares_its_core(above: CallbackOptions) -> Arc<CallbackStats> {
    let core = cores()[0];
    let executor = Executor::new(Realtime::Required);
    let (log, ran, ended) =
        (Log::default(), Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
    let (log_above, has_run, ends) = (log.clone(), Arc::clone(&ran), Arc::clone(&ended));
    let work = async move {
        let until_it_has_run = |_| {
            while !has_run.load(Ordering::Acquire) {
                clock::burn_cpu(Duration::from_micros(100));
            }
            std::future::ready(())
        };
        one_job().for_each(until_it_has_run).await;
        log_above.add("above has ended");
        ends.store(true, Ordering::Release);
    };
    let callback = executor.spawn_callback(above, work).unwrap();
    let log_below = log.clone();
    let below = async move {
        log_below.add("below has run");
        ran.store(true, Ordering::Release);
        while !ended.load(Ordering::Acquire) {
            std::hint::spin_loop();
        }
    };
    let below = executor.spawn_callback(CallbackOptions::fifo(10).core(core).name("below"), below).unwrap();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    below.join().unwrap();
    assert_eq!(log.events(), ["below has run", "above has ended"]);
    stats
}

#[test]
fn a_suspended_job_leaves_the_core_and_comes_back() {
    if !realtime() {
        return;
    }
    let core = cores()[0];
    let above = CallbackOptions::fifo(20).core(core).name("above").period(period()).budget(budget());
    let stats = shares_its_core(above.suspend_on_overrun());
    // How much it had used by then is not known: more than its budget only if the one below was not there before.
    assert_eq!(stats.completions(), 1);
    assert_eq!(stats.overruns(), stats.demotions());
}

#[test]
fn jobs_that_waited_for_a_suspended_one_share_its_refills() {
    if !realtime() {
        return;
    }
    let executor = Executor::new(Realtime::Required);
    let options =
        CallbackOptions::fifo(20).name("held").period(period()).budget(budget()).suspend_on_overrun();
    let times = Arc::new(std::sync::Mutex::new(Vec::new()));
    let each_times = Arc::clone(&times);
    // All released with the first one, which takes 3 of 2 ms: what is left of the refill is for one more, and so on.
    let mut works = [30, 6, 6, 6].map(|tenths| budget() * tenths / 20).into_iter();
    let mut running: Option<job::Job> = None;
    let mut first_ns = None;
    let stream = futures::stream::poll_fn(move |_| {
        if let Some(job) = running.take() {
            job.finish();
        }
        let release_ns = *first_ns.get_or_insert_with(clock::monotonic_ns);
        let next = works.next();
        running = next.map(|_| job::begin(release_ns));
        Poll::Ready(next.map(|work| (work, release_ns)))
    });
    let work = stream.for_each(move |(work, release_ns)| {
        clock::burn_cpu(work);
        each_times.lock().unwrap().push(clock::monotonic_ns() - release_ns);
        std::future::ready(())
    });
    let callback = executor.spawn_callback(options, work).unwrap();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    let times = times.lock().unwrap();
    let at_least = |index: usize, periods: u64| {
        assert!(times[index] >= periods * clock::nanoseconds(period()), "job {index}: {:?}", *times);
    };
    at_least(0, 1);
    // 4.8 ms in all: no less than two refills.
    at_least(3, 2);
    assert_eq!(stats.completions(), 4);
    assert!(stats.demotions() >= 2, "{}", stats.demotions());
}

#[test]
fn a_reservation_leaves_the_core_and_comes_back() {
    if !realtime() {
        return;
    }
    // Bound to a core it may not be on this kernel: then it may run beside the other one, and nothing is to be seen.
    let core = cores()[0];
    let above = CallbackOptions::reserved(budget(), period()).name("above");
    let executor = Executor::new(Realtime::Required);
    match executor.spawn_callback(above.clone().core(core), async {}) {
        Ok(callback) => {
            callback.join().unwrap();
            assert_eq!(shares_its_core(above.core(core)).completions(), 1);
        }
        Err(ExecutorError::Thread { source, .. }) => {
            println!("not bound: {source}");
            let callback = executor.spawn_callback(above, async {}).unwrap();
            let [runtime_ns, period_ns] = [budget(), period()].map(clock::nanoseconds);
            let policy = Policy::Deadline { runtime_ns, period_ns };
            assert_eq!(callback.thread().policy, policy);
            assert_eq!(
                tautline_executor::CallbackSnapshot::of(callback.stats()).unwrap().priority,
                Some(Policy::RESERVATION)
            );
            callback.join().unwrap();
        }
        Err(error) => panic!("{error}"),
    }
}

#[test]
fn what_cannot_be_suspended_says_why() {
    let executor = Executor::new(Realtime::Off);
    let refused = |options: CallbackOptions| {
        let error = executor.spawn_callback(options.name("x").suspend_on_overrun(), async {}).unwrap_err();
        assert!(matches!(error, ExecutorError::CannotHold { .. }), "{error}");
        error.to_string()
    };
    let fifo = CallbackOptions::fifo(20).budget(budget());
    assert!(refused(fifo.clone()).contains("no period to wait for"));
    assert!(refused(fifo.period(Duration::ZERO)).contains("no period to wait for"));
    assert!(refused(CallbackOptions::reserved(budget(), period())).contains("holds its thread"));
}

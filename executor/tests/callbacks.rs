// SPDX-License-Identifier: MIT OR Apache-2.0
//! A callback has a thread of its own, at its own priority.

mod common;

use std::future::{pending, poll_fn};
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use common::{Log, cores, realtime};
use futures::task::AtomicWaker;
use futures::{Stream, StreamExt, channel::oneshot};
use tautline_executor::{
    CallbackGroup, CallbackOptions, CallbackStats, CoreSet, Executor, ExecutorError, Policy, Realtime, job,
    stop_requested,
};
use tautline_rt::{clock, current_policy, threads};

#[test]
fn policies_and_cores_are_in_force_when_spawn_returns() {
    if !realtime() {
        return;
    }
    let executor = Executor::new(Realtime::Required);
    let core = cores()[0];
    let options = [
        CallbackOptions::fifo(20).core(core).name("fast"),
        CallbackOptions::fifo(19).name("a/long/topic/name"),
        CallbackOptions::new(Policy::RoundRobin(3)).name("rr"),
        CallbackOptions::other().name("slow"),
    ];
    let spawned = options.map(|options| executor.spawn_callback(options, pending()).unwrap());
    let listed = threads().unwrap();
    for callback in &spawned {
        assert!(listed.contains(callback.thread()), "{:?} not in {listed:?}", callback.thread());
    }
    let seen = spawned.each_ref().map(|callback| (callback.thread().name.as_str(), callback.thread().policy));
    assert_eq!(
        seen,
        [
            ("cb:fast", Policy::Fifo(20)),
            ("cb:a/l~pic/name", Policy::Fifo(19)),
            ("cb:rr", Policy::RoundRobin(3)),
            ("cb:slow", Policy::Other { nice: 0 }),
        ]
    );
    assert_eq!(spawned[0].thread().cores, CoreSet::one(core));
    executor.shutdown().unwrap();
    assert!(spawned.iter().all(|callback| callback.is_finished()));
}

#[test]
fn the_future_is_made_before_the_thread_is_real_time_and_run_after() {
    if !realtime() {
        return;
    }
    let executor = Executor::new(Realtime::Required);
    let log = Log::default();
    let in_thread = log.clone();
    let make = move || {
        let not_send = Rc::new(in_thread);
        not_send.add(format!("made at {:?}", current_policy().unwrap().realtime_priority()));
        async move { not_send.add(format!("run at {:?}", current_policy().unwrap().realtime_priority())) }
    };
    executor.spawn_local(CallbackOptions::fifo(7), make).unwrap().join().unwrap();
    assert_eq!(log.events(), ["made at None", "run at Some(7)"]);
}

/// On one core, a callback that waits is woken by one that runs.
fn order_on_one_core(waiting: u8, running: u8) -> Vec<String> {
    let executor = Executor::new(Realtime::Required);
    let core = cores()[0];
    let log = Log::default();
    let bell = Arc::new((AtomicBool::new(false), AtomicWaker::new()));

    let (waiter_log, waiter_bell) = (log.clone(), bell.clone());
    let waiter = poll_fn(move |cx| {
        waiter_bell.1.register(cx.waker());
        if !waiter_bell.0.load(Ordering::Acquire) {
            return Poll::Pending;
        }
        waiter_log.add("waiting one runs");
        Poll::Ready(())
    });
    // Spawned first: on this core the other cannot start before it has parked.
    executor.spawn_callback(CallbackOptions::fifo(waiting).core(core), waiter).unwrap();

    let runner_log = log.clone();
    let runner = async move {
        runner_log.add("running one wakes it");
        bell.0.store(true, Ordering::Release);
        bell.1.wake();
        runner_log.add("running one ends");
    };
    let runner = executor.spawn_callback(CallbackOptions::fifo(running).core(core), runner).unwrap();
    runner.join().unwrap();
    // The waiting one may be about to run, but its thread ends by itself: only then is the log complete.
    while log.events().len() < 3 {
        std::thread::yield_now();
    }
    log.events()
}

#[test]
fn a_higher_priority_preempts_and_an_equal_one_does_not() {
    if !realtime() {
        return;
    }
    let (wakes, runs, ends) = ("running one wakes it", "waiting one runs", "running one ends");
    assert_eq!(order_on_one_core(20, 10), [wakes, runs, ends]);
    assert_eq!(order_on_one_core(10, 10), [wakes, ends, runs]);
    assert_eq!(order_on_one_core(10, 20), [wakes, ends, runs]);
}

#[test]
fn a_panic_is_reported_with_its_name_and_others_go_on() {
    let executor = Executor::new(Realtime::Off);
    let (sender, receiver) = oneshot::channel::<()>();
    let log = Log::default();
    let other_log = log.clone();
    let other = async move {
        receiver.await.unwrap();
        other_log.add("other goes on");
    };
    let other = executor.spawn_callback(CallbackOptions::other().name("other"), other).unwrap();
    let bad = async { panic!("lost the {}", "plot") };
    let bad = executor.spawn_callback(CallbackOptions::other().name("/a/bad/topic"), bad).unwrap();

    let message = bad.clone().join().unwrap_err().to_string();
    assert_eq!(message, "callback `/a/bad/topic` panicked: lost the plot");
    assert!(bad.is_finished() && !other.is_finished());
    sender.send(()).unwrap();
    other.join().unwrap();
    assert_eq!(log.events(), ["other goes on"]);
    // Whoever asks is told.
    assert_eq!(bad.join().unwrap_err().to_string(), message);
    assert_eq!(executor.shutdown().unwrap_err().to_string(), message);
}

#[test]
fn a_stopped_future_is_dropped_on_its_own_thread() {
    struct DropLog(Log);
    impl Drop for DropLog {
        fn drop(&mut self) {
            self.0.add(std::thread::current().name().unwrap_or_default());
        }
    }
    let executor = Executor::new(Realtime::Off);
    let log = Log::default();
    let held = DropLog(log.clone());
    let future = async move {
        let _held = held;
        pending::<()>().await;
    };
    let callback = executor.spawn_callback(CallbackOptions::other().name("mine"), future).unwrap();
    callback.stop();
    callback.join().unwrap();
    assert_eq!(log.events(), ["cb:mine"]);
}

#[test]
fn a_stream_without_end_can_let_its_callback_stop() {
    let executor = Executor::new(Realtime::Off);
    let endless = poll_fn(|_| if stop_requested() { Poll::Pending } else { Poll::Ready(()) });
    let mut endless = Box::pin(endless);
    let future = async move {
        loop {
            endless.as_mut().await;
        }
    };
    executor.spawn_callback(CallbackOptions::other(), future).unwrap();
    executor.shutdown().unwrap();
    assert!(!stop_requested());
}

#[test]
fn a_callback_that_cannot_start_is_an_error_that_names_it() {
    let executor = Executor::new(Realtime::Required);
    let error =
        executor.spawn_callback(CallbackOptions::other().core(1023).name("x"), pending()).unwrap_err();
    assert!(matches!(error, ExecutorError::Thread { .. }), "{error}");
    assert!(error.to_string().starts_with("callback `x` cannot start: core 1023 does not exist"), "{error}");
    let error = executor.spawn_callback(CallbackOptions::fifo(100), pending()).unwrap_err();
    assert!(error.to_string().starts_with("callback `#1` cannot start: priority 100"), "{error}");
    let make = || -> std::future::Ready<()> { panic!("nothing to make") };
    let error = executor.spawn_local(CallbackOptions::other(), make).unwrap_err();
    assert!(error.to_string().contains("nothing to make"), "{error}");
    executor.shutdown().unwrap();
}

#[test]
fn nobody_waits_for_the_end_of_itself() {
    let executor = Executor::new(Realtime::Off);
    let (send_handle, handle) = oneshot::channel::<tautline_executor::CallbackHandle>();
    let log = Log::default();
    let in_thread = log.clone();
    let future = async move { in_thread.add(handle.await.unwrap().join().unwrap_err().to_string()) };
    let callback = executor.spawn_callback(CallbackOptions::other().name("me"), future).unwrap();
    send_handle.send(callback.clone()).unwrap();
    callback.join().unwrap();
    assert_eq!(log.events(), ["callback `me` cannot wait for its own end: join it from another thread"]);
}

/// Hands out items as subscriptions do: a job ends when the next item is asked for.
struct Measured {
    left: u32,
    job: Option<job::Job>,
}

impl Stream for Measured {
    type Item = ();

    fn poll_next(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<()>> {
        if let Some(job) = self.job.take() {
            job.finish();
        }
        let Some(left) = self.left.checked_sub(1) else { return Poll::Ready(None) };
        self.left = left;
        self.job = Some(job::begin(clock::monotonic_ns()));
        Poll::Ready(Some(()))
    }
}

#[test]
fn a_plain_for_each_is_measured() {
    const WORK: Duration = Duration::from_millis(1);
    let executor = Executor::new(Realtime::Off);
    let options = CallbackOptions::other().period(WORK).name("m");
    let jobs = Measured { left: 3, job: None }.for_each(|()| async { clock::burn_cpu(WORK) });
    let callback = executor.spawn_callback(options.clone(), jobs).unwrap();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!(
        (stats.name(), stats.releases(), stats.completions(), stats.deadline_misses()),
        ("m", 3, 3, 3)
    );
    let (execution, response) = (stats.execution().snapshot(), stats.response().snapshot());
    assert_eq!((execution.n(), response.n()), (3, 3));
    // Neither is the greater one: what the executor used to get to a job counts as its execution, and is before its release.
    assert!(execution.p(0.0) >= WORK && response.p(0.0) >= WORK);

    // A deadline that is met, and no execution times.
    let options = options.deadline(Duration::from_secs(3600)).execution_time(false);
    let jobs = Measured { left: 2, job: None }.for_each(|()| async {});
    let callback = executor.spawn_callback(options, jobs).unwrap();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!((stats.completions(), stats.deadline_misses(), stats.execution().snapshot().n()), (2, 0, 0));
}

#[test]
fn an_input_size_is_that_of_the_job_that_stated_it() {
    let executor = Executor::new(Realtime::Off);
    let mut sizes = [Some(3), None, Some(700), Some(3)].into_iter();
    let jobs = Measured { left: 4, job: None }.for_each(move |()| {
        sizes.next().flatten().into_iter().for_each(job::set_input_size);
        async {}
    });
    let callback = executor.spawn_callback(CallbackOptions::other(), jobs).unwrap();
    let alone = callback.stats().clone();
    // Each member of a group has its own.
    let mut group = CallbackGroup::new();
    let member = group.add(
        CallbackOptions::other(),
        futures::stream::iter([5, 5, 900]),
        |_| 0,
        |size| async move { job::set_input_size(size) },
    );
    // What its stream states is no job's.
    let stream = futures::stream::iter([1]).inspect(|_| job::set_input_size(77));
    let silent = group.add(CallbackOptions::other(), stream, |_| 0, |_| async {});
    let group = executor.spawn_group(CallbackOptions::other(), group).unwrap();
    callback.join().unwrap();
    let all = group.stats().clone();
    group.join().unwrap();
    let seen = |stats: &CallbackStats| -> Vec<_> {
        tautline_executor::CallbackSnapshot::of(stats)
            .unwrap()
            .inputs
            .iter()
            .map(|class| (class.least, class.jobs))
            .collect()
    };
    assert_eq!((seen(&alone), alone.completions()), (vec![(3, 2), (700, 1)], 4));
    assert_eq!((seen(&member), seen(&silent)), (vec![(5, 2), (900, 1)], vec![]));
    assert_eq!((seen(&all), all.completions()), (vec![], 4));
}

#[test]
fn a_job_that_another_thread_finishes_is_not_a_job_of_that_thread() {
    let executor = Executor::new(Realtime::Off);
    let (send, sent) = oneshot::channel();
    let begins = async move { send.send(job::begin(clock::monotonic_ns())).unwrap() };
    let finishes = async move {
        let own = job::begin(clock::monotonic_ns());
        job::set_input_size(7);
        sent.await.unwrap().finish();
        own.finish();
    };
    let callbacks = [
        executor.spawn_callback(CallbackOptions::other(), begins).unwrap(),
        executor.spawn_callback(CallbackOptions::other(), finishes).unwrap(),
    ];
    let stats = callbacks.each_ref().map(|callback| callback.stats().clone());
    callbacks.into_iter().for_each(|callback| callback.join().unwrap());
    assert_eq!(stats.each_ref().map(|of| (of.releases(), of.completions())), [(1, 0), (1, 1)]);
    let inputs = tautline_executor::CallbackSnapshot::of(&stats[1]).unwrap().inputs;
    assert_eq!((inputs.len(), inputs[0].least), (1, 7), "its own job's size");
}

#[test]
fn outside_a_callback_thread_jobs_are_nothing() {
    job::begin(0).finish();
    job::set_input_size(1);
    assert!(!tautline_executor::busy_polling());
}

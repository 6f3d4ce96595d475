// SPDX-License-Identifier: MIT OR Apache-2.0
//! A plain `for_each` is measured: releases, completions, execution and response times, missed deadlines.

mod common;

use std::time::Duration;

use common::{Log, Number, context, spin};
use futures::StreamExt;
use tautline::{CallbackOptions, Node, Qos};
use tautline_rt::clock;

const WORK: Duration = Duration::from_millis(1);
const DAY: Duration = Duration::from_secs(86_400);

#[test]
fn each_message_is_a_job() {
    static DONE: Log<u64> = Log::new();
    let context = context(210);
    let mut node = Node::create(context.clone(), "measured", "").unwrap();
    let publisher = node.create_publisher::<Number>("/m", Qos::default()).unwrap();
    let _spinning = spin(&context);
    // (deadline, jobs that miss it)
    for (deadline, misses) in [(WORK / 2, 10), (DAY, 0)] {
        let numbers = node.subscribe::<Number>("/m", Qos::default()).unwrap();
        let options = CallbackOptions::other().name("/m").deadline(deadline);
        let work = |sample: tautline::Sample<Number>| async move {
            clock::burn_cpu(WORK);
            DONE.add(sample.value);
        };
        let callback = node.spawn_callback(options, numbers.for_each(work)).unwrap();
        let before = DONE.events().len();
        let released_ns = clock::monotonic_ns();
        for value in 0..10 {
            let mut loan = publisher.loan().unwrap();
            loan.value = value;
            loan.publish_released_at(released_ns).unwrap();
        }
        DONE.wait_for(before + 10);
        // The poll in which the last callback ended also asked for the next message: that ended the last job.
        callback.stop();
        let stats = callback.stats().clone();
        callback.join().unwrap();
        assert_eq!((stats.name(), stats.deadline()), ("/m", Some(deadline)));
        assert_eq!((stats.releases(), stats.completions(), stats.deadline_misses()), (10, 10, misses));
        let (execution, response) = (stats.execution().snapshot(), stats.response().snapshot());
        assert_eq!((execution.n(), response.n()), (10, 10));
        assert!(execution.p(0.0) >= WORK && response.p(0.0) >= WORK, "{execution:?} {response:?}");
        // Ten were released at once: the last waited for nine.
        assert!(response.max() >= 10 * WORK);
    }
}

#[test]
fn responses_count_from_the_release() {
    static DONE: Log<u64> = Log::new();
    const LATE: Duration = Duration::from_secs(3);
    let context = context(211);
    let mut node = Node::create(context.clone(), "late", "").unwrap();
    let publisher = node.create_publisher::<Number>("/late", Qos::default()).unwrap();
    let numbers = node.subscribe::<Number>("/late", Qos::default()).unwrap();
    // A period is the deadline unless another one is set; no execution times.
    let options = CallbackOptions::other().period(LATE).execution_time(false);
    let note = |sample: tautline::Sample<Number>| async move { DONE.add(sample.info().released_ns) };
    let callback = node.spawn_callback(options, numbers.for_each(note)).unwrap();
    let released_ns = clock::monotonic_ns() - LATE.as_nanos() as u64;
    let mut loan = publisher.loan().unwrap();
    loan.value = 1;
    loan.publish_released_at(released_ns).unwrap();
    let _spinning = spin(&context);
    assert_eq!(DONE.wait_for(1), [released_ns]);
    callback.stop();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!((stats.completions(), stats.deadline_misses(), stats.execution().snapshot().n()), (1, 1, 0));
    assert!(stats.response().snapshot().p(0.0) >= LATE);
}

#[test]
fn a_tick_is_a_job_released_when_it_was_due() {
    let context = context(212);
    let mut node = Node::create(context.clone(), "ticker", "").unwrap();
    let first_ns = clock::monotonic_ns();
    let timer = node.create_wall_timer_at(first_ns, WORK).unwrap();
    let ticks = timer.take(5).collect::<Vec<_>>();
    let (report, reported) = futures::channel::oneshot::channel();
    let future = async move { report.send(ticks.await).unwrap() };
    let callback = node.spawn_callback(CallbackOptions::other(), future).unwrap();
    let _spinning = spin(&context);
    let ticks = futures::executor::block_on(reported).unwrap();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    for tick in &ticks {
        assert_eq!(tick.release_ns, first_ns + (tick.index - 1) * WORK.as_nanos() as u64);
    }
    let missed = ticks.iter().map(|tick| tick.missed).sum::<u64>();
    assert_eq!(ticks.last().unwrap().index, 5 + missed, "every release is a tick or missed");
    // `take` never asks for a sixth, which would have ended the fifth.
    assert_eq!((stats.releases(), stats.completions()), (5, 4));
}

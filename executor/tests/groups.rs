// SPDX-License-Identifier: MIT OR Apache-2.0
//! A group serves its members in order of release, one message at a time.

mod common;

use std::rc::Rc;
use std::time::Duration;

use common::Log;
use futures::channel::{mpsc, oneshot};
use futures::stream;
use tautline_executor::{CallbackGroup, CallbackOptions, Executor, Realtime};

/// A message and its release.
type Message = (&'static str, u64);

fn release(message: &Message) -> u64 {
    message.1
}

fn run(group: CallbackGroup) {
    let executor = Executor::new(Realtime::Off);
    executor.spawn_group(CallbackOptions::other(), group).unwrap().join().unwrap();
}

#[test]
fn messages_run_in_order_of_release_and_no_stream_is_drained() {
    let log = Log::default();
    let mut group = CallbackGroup::new();
    let members: [&[Message]; 4] = [&[("A", 3)], &[("B1", 1), ("B2", 5)], &[("C", 4)], &[("D", 2)]];
    for messages in members {
        let log = log.clone();
        group.add("member", stream::iter(messages.iter().copied()), release, move |message| {
            let log = log.clone();
            async move { log.add(message.0) }
        });
    }
    run(group);
    assert_eq!(log.events(), ["B1", "D", "A", "C", "B2"]);
}

#[test]
fn equal_releases_run_in_order_of_addition_in_turn() {
    let log = Log::default();
    let mut group = CallbackGroup::new();
    for messages in [[("a1", 7), ("a2", 8)], [("b1", 7), ("b2", 8)]] {
        let log = log.clone();
        group.add("member", stream::iter(messages), release, move |message| {
            log.add(message.0);
            async {}
        });
    }
    run(group);
    assert_eq!(log.events(), ["a1", "b1", "a2", "b2"]);
}

#[test]
fn every_member_is_asked_again_before_each_job() {
    let log = Log::default();
    let (send_b, b) = mpsc::unbounded::<Message>();
    let mut group = CallbackGroup::new();
    let a_log = log.clone();
    let mut send_b = Some(send_b);
    group.add("a", stream::iter([("a1", 1), ("a2", 3)]), release, move |message| {
        a_log.add(message.0);
        // While a1 runs, a message arrives that was released before a2.
        if let Some(send_b) = send_b.take() {
            send_b.unbounded_send(("b", 2)).unwrap();
        }
        async {}
    });
    let b_log = log.clone();
    group.add("b", b, release, move |message| {
        b_log.add(message.0);
        async {}
    });
    run(group);
    assert_eq!(log.events(), ["a1", "b", "a2"]);
}

#[test]
fn a_callback_that_waits_keeps_the_others_out() {
    let log = Log::default();
    let (send_a, a) = mpsc::unbounded::<Message>();
    let (send_b, b) = mpsc::unbounded::<Message>();
    let (begun, has_begun) = std::sync::mpsc::channel();
    let (go_on, may_go_on) = oneshot::channel::<()>();

    let mut group = CallbackGroup::new();
    let (a_log, mut may_go_on) = (log.clone(), Some(may_go_on));
    group.add("a", a, release, move |message| {
        let (log, may_go_on) = (Rc::new(a_log.clone()), may_go_on.take().unwrap());
        log.add(format!("{} begins", message.0));
        begun.send(()).unwrap();
        async move {
            may_go_on.await.unwrap();
            log.add(format!("{} ends", message.0));
        }
    });
    let b_log = log.clone();
    group.add("b", b, release, move |message| {
        b_log.add(message.0);
        async {}
    });

    let executor = Executor::new(Realtime::Off);
    let callback = executor.spawn_group(CallbackOptions::other(), group).unwrap();
    send_a.unbounded_send(("a", 2)).unwrap();
    has_begun.recv().unwrap();
    // Released earlier, arrived later: it has to wait all the same.
    send_b.unbounded_send(("b", 1)).unwrap();
    go_on.send(()).unwrap();
    drop((send_a, send_b));
    callback.join().unwrap();
    assert_eq!(log.events(), ["a begins", "a ends", "b"]);
}

#[test]
fn members_and_the_whole_group_are_measured() {
    let mut group = CallbackGroup::new();
    let a = group.add("a", stream::iter([("a1", 1), ("a2", 2)]), release, |_| async {});
    let b = group.add("b", stream::iter([("b", 1)]), release, |_| async {});
    // Released at the start of the clock, so the deadline has long passed.
    a.set_deadline(Some(Duration::from_nanos(1)));
    let executor = Executor::new(Realtime::Off);
    let callback = executor.spawn_group(CallbackOptions::other().name("group"), group).unwrap();
    let total = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!((a.name(), a.releases(), a.completions(), a.deadline_misses()), ("a", 2, 2, 2));
    assert_eq!((b.name(), b.releases(), b.completions(), b.deadline_misses()), ("b", 1, 1, 0));
    assert_eq!((total.name(), total.completions(), total.response().snapshot().n()), ("group", 3, 3));
    assert_eq!(a.execution().snapshot().n(), 2);
}

#[test]
fn a_group_with_endless_work_can_be_stopped() {
    let mut group = CallbackGroup::new();
    group.add("endless", stream::repeat(("again", 1)), release, |_| async {});
    let executor = Executor::new(Realtime::Off);
    let callback = executor.spawn_group(CallbackOptions::other(), group).unwrap();
    callback.stop();
    callback.join().unwrap();
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Settings that change while callbacks run.

mod common;

use std::future::pending;
use std::time::Duration;

use common::realtime;
use tautline_executor::{
    CallbackGroup, CallbackHandle, CallbackOptions, Executor, ExecutorError, Policy, Realtime,
};
use tautline_rt::policy_of;

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn policy(callback: &CallbackHandle) -> Policy {
    policy_of(callback.thread().tid).unwrap()
}

#[test]
fn a_running_callback_gets_another_priority_and_other_limits() {
    if !realtime() {
        return;
    }
    let executor = Executor::new(Realtime::Required);
    let first = CallbackOptions::fifo(20).name("a").budget(ms(2)).period(ms(10)).demote_on_overrun();
    let callback = executor.spawn_callback(first.clone(), pending()).unwrap();
    let other = executor.spawn_callback(CallbackOptions::fifo(20).name("b"), pending()).unwrap();
    let settings = executor.settings();
    let second = CallbackOptions::fifo(25).name("a").budget(ms(3)).deadline(ms(8)).bound(ms(7));
    assert_eq!(settings.change(&second).unwrap(), 1);
    let stats = callback.stats();
    assert_eq!((policy(&callback), policy(&other)), (Policy::Fifo(25), Policy::Fifo(20)));
    assert_eq!((stats.budget(), stats.deadline()), (Some(ms(3)), Some(ms(8))));
    let seen = tautline_executor::CallbackSnapshot::of(stats).unwrap();
    assert_eq!((seen.priority, seen.bound_ns), (Some(25), Some(7_000_000)));

    let reserved = CallbackOptions::reserved(ms(1), ms(10)).name("a");
    let error = settings.change(&reserved).unwrap_err();
    assert!(matches!(error, ExecutorError::CannotChange { .. }), "{error}");
    assert!(matches!(
        settings.change(&CallbackOptions::fifo(0).name("a")),
        Err(ExecutorError::Thread { .. })
    ));
    assert_eq!((policy(&callback), stats.budget()), (Policy::Fifo(25), Some(ms(3))));
    assert_eq!(settings.change(&first.name("nobody")).unwrap(), 0);
    callback.stop();
    callback.join().unwrap();
    assert_eq!(settings.change(&second).unwrap(), 0, "it has ended");
}

#[test]
fn a_member_brings_its_group_along() {
    if !realtime() {
        return;
    }
    let executor = Executor::new(Realtime::Required);
    let mut group = CallbackGroup::new();
    let none = futures::stream::pending::<u64>;
    let a = group.add(CallbackOptions::other().name("a").budget(ms(1)), none(), |n| *n, |_| async {});
    let b = group.add(CallbackOptions::other().name("b").budget(ms(1)), none(), |n| *n, |_| async {});
    let thread = executor.spawn_group(CallbackOptions::fifo(20).name("group"), group).unwrap();
    executor.settings().change(&CallbackOptions::fifo(22).name("b").budget(ms(2))).unwrap();
    assert_eq!(policy(&thread), Policy::Fifo(22));
    assert_eq!((a.budget(), b.budget()), (Some(ms(1)), Some(ms(2))));
    assert_eq!(tautline_executor::CallbackSnapshot::of(&a).unwrap().priority, Some(22));
}

#[test]
fn a_reservation_gets_another_size() {
    if !realtime() {
        return;
    }
    let executor = Executor::new(Realtime::Required);
    let options = CallbackOptions::reserved(ms(1), ms(20)).name("r");
    let callback = executor.spawn_callback(options, pending()).unwrap();
    executor.settings().change(&CallbackOptions::reserved(ms(2), ms(20)).name("r")).unwrap();
    let wanted = Policy::Deadline { runtime_ns: 2_000_000, period_ns: 20_000_000 };
    let seen = tautline_executor::CallbackSnapshot::of(callback.stats()).unwrap();
    assert_eq!((policy(&callback), seen.reservation), (wanted, Some(wanted)));
    let error = executor.settings().change(&CallbackOptions::fifo(20).name("r")).unwrap_err();
    assert!(error.to_string().contains("restart its program"), "{error}");
}

#[test]
fn without_real_time_there_are_only_limits_to_change() {
    let executor = Executor::new(Realtime::Off);
    let callback = executor.spawn_callback(CallbackOptions::fifo(20).name("a"), pending()).unwrap();
    let before = policy(&callback);
    assert_eq!(executor.settings().change(&CallbackOptions::fifo(30).name("a").budget(ms(4))).unwrap(), 1);
    assert_eq!((policy(&callback), callback.stats().budget()), (before, Some(ms(4))));
}

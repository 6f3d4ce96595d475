// SPDX-License-Identifier: MIT OR Apache-2.0
//! Futures that wait for transforms: whom a set wakes, what they end with, and how many there may be.

mod support;

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll, Wake, Waker};

use support::{at_x, set, set_static};
use tautline_tf::{Buffer, Limits, LookupError, Stamped, Time, WaitError, WaitFor, Writer};

/// Counts how often it is woken.
#[derive(Default)]
struct Woken(AtomicUsize);

impl Wake for Woken {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

struct Task {
    woken: Arc<Woken>,
    wait: Pin<Box<WaitFor>>,
}

impl Task {
    fn new(buffer: &Buffer, target: &str, source: &str, time: Time) -> Task {
        Task { woken: Arc::default(), wait: Box::pin(buffer.wait_for(target, source, time).unwrap()) }
    }

    fn poll(&mut self) -> Poll<Result<Stamped, WaitError>> {
        self.wait.as_mut().poll(&mut Context::from_waker(&Waker::from(self.woken.clone())))
    }

    fn x(&mut self) -> Option<f64> {
        match self.poll() {
            Poll::Ready(found) => Some(found.unwrap().transform.translation[0]),
            Poll::Pending => None,
        }
    }

    fn woken(&self) -> usize {
        self.woken.0.swap(0, Ordering::Relaxed)
    }
}

fn buffer(waiters: usize) -> (Writer, Buffer) {
    Buffer::new(Limits { frames: 16, samples: 64, waiters, ..Limits::default() }).unwrap()
}

#[test]
fn a_wait_ends_when_the_last_transform_is_there() {
    let (mut writer, buffer) = buffer(4);
    let mut task = Task::new(&buffer, "map", "laser", Time::At(15));
    assert_eq!((task.x(), task.woken()), (None, 0));
    // Two names that nobody knew, then a tree.
    set_static(&mut writer, "base", "laser", at_x(1.0)).unwrap();
    assert_eq!((task.woken(), task.x()), (1, None));
    set(&mut writer, "map", "base", 10, at_x(10.0)).unwrap();
    assert_eq!((task.woken(), task.x()), (1, None));
    // From now on only samples of base matter, from 15 on.
    set(&mut writer, "map", "base", 12, at_x(12.0)).unwrap();
    set(&mut writer, "map", "other", 20, at_x(0.0)).unwrap();
    assert!(task.woken() <= 1, "by the first transform of another frame");
    set(&mut writer, "map", "other", 21, at_x(0.0)).unwrap();
    assert_eq!((task.woken(), task.x()), (0, None));
    set(&mut writer, "map", "base", 20, at_x(20.0)).unwrap();
    assert_eq!(task.woken(), 1);
    assert_eq!(task.x(), Some(16.0));
    // Its place is free: nobody is woken.
    set(&mut writer, "map", "base", 21, at_x(20.0)).unwrap();
    assert_eq!(task.woken(), 0);
}

#[test]
fn the_latest_is_waited_for_until_all_are_in_one_tree() {
    let (mut writer, buffer) = buffer(4);
    let mut task = Task::new(&buffer, "map", "base", Time::Latest);
    assert_eq!(task.x(), None);
    set(&mut writer, "map", "odom", 5, at_x(1.0)).unwrap();
    assert_eq!((task.woken(), task.x()), (1, None));
    set(&mut writer, "odom", "base", 5, at_x(2.0)).unwrap();
    assert_eq!((task.woken(), task.x()), (1, Some(3.0)));
}

#[test]
fn what_comes_late_and_what_is_cleared_wakes_too() {
    let (mut writer, buffer) = buffer(4);
    set(&mut writer, "map", "base", 10, at_x(10.0)).unwrap();
    let mut past = Task::new(&buffer, "map", "base", Time::At(5));
    assert_eq!(past.x(), None);
    set(&mut writer, "map", "base", 4, at_x(4.0)).unwrap();
    assert_eq!((past.woken(), past.x()), (1, Some(5.0)));
    let mut future = Task::new(&buffer, "map", "base", Time::At(11));
    assert_eq!(future.x(), None);
    writer.clear();
    set(&mut writer, "map", "base", 3, at_x(3.0)).unwrap();
    assert_eq!((future.woken(), future.x()), (1, None));
    set(&mut writer, "map", "base", 11, at_x(11.0)).unwrap();
    assert_eq!((future.woken(), future.x()), (1, Some(11.0)));
}

#[test]
fn a_frame_that_gets_a_new_parent_wakes_all() {
    let (mut writer, buffer) = buffer(4);
    set(&mut writer, "map", "base", 10, at_x(10.0)).unwrap();
    set(&mut writer, "base", "cup", 10, at_x(10.0)).unwrap();
    set_static(&mut writer, "world", "map", at_x(0.0)).unwrap();
    let mut task = Task::new(&buffer, "world", "cup", Time::At(12));
    assert_eq!(task.x(), None);
    // It waits for cup at 12, then for base at 12; from 12 on cup hangs elsewhere.
    set(&mut writer, "base", "cup", 12, at_x(12.0)).unwrap();
    assert_eq!((task.woken(), task.x()), (1, None));
    set_static(&mut writer, "world", "base", at_x(1.0)).unwrap();
    assert_eq!((task.woken(), task.x()), (1, Some(13.0)));
}

#[test]
fn what_cannot_come_ends_the_wait() {
    let (mut writer, buffer) = buffer(4);
    set(&mut writer, "map", "base", 20_000_000_000, at_x(0.0)).unwrap();
    let mut task = Task::new(&buffer, "map", "base", Time::At(9_000_000_000));
    let Poll::Ready(Err(WaitError::Lookup(error))) = task.poll() else { panic!("waits") };
    assert!(matches!(error, LookupError::Extrapolation { asked_ns: 9_000_000_000, .. }));
    assert!(matches!(buffer.wait_for("map", "", Time::Latest), Err(LookupError::InvalidArgument { .. })));
}

#[test]
fn as_many_wait_as_there_are_places_and_who_leaves_makes_room() {
    let (mut writer, buffer) = buffer(2);
    let mut tasks = [0, 1, 2].map(|_| Task::new(&buffer, "map", "base", Time::Latest));
    assert_eq!((tasks[0].x(), tasks[1].x()), (None, None));
    let Poll::Ready(Err(full)) = tasks[2].poll() else { panic!("waits") };
    assert_eq!(full, WaitError::WaitersFull { waiters: 2 });
    assert_eq!(full.to_string(), "2 futures wait for transforms already: raise Limits::waiters");
    let [dropped, mut stays, _] = tasks;
    let woken = dropped.woken.clone();
    drop(dropped);
    assert_eq!(Arc::strong_count(&woken), 1, "its waker is gone");
    let mut next = Task::new(&buffer, "map", "base", Time::Latest);
    assert_eq!(next.x(), None);
    set(&mut writer, "map", "base", 1, at_x(1.0)).unwrap();
    assert_eq!((stays.woken(), stays.x(), next.woken(), next.x()), (1, Some(1.0), 1, Some(1.0)));
    assert_eq!(woken.0.load(Ordering::Relaxed), 0);
    // What is there is found without a place.
    let mut ready = [0, 1, 2].map(|_| Task::new(&buffer, "map", "base", Time::At(1)));
    assert_eq!(ready.each_mut().map(|task| task.x()), [Some(1.0); 3]);
}

#[test]
fn no_wake_is_lost_between_threads() {
    let rounds = if cfg!(miri) { 20 } else { 20_000 };
    let (mut writer, buffer) = buffer(4);
    set_static(&mut writer, "map", "odom", at_x(0.0)).unwrap();
    set(&mut writer, "odom", "base", 0, at_x(0.0)).unwrap();
    let (asked, answered) = (AtomicUsize::new(0), AtomicUsize::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for round in 1..=rounds {
                asked.store(round, Ordering::Release);
                // A future that is not woken waits for ever.
                let wait = buffer.wait_for("map", "base", Time::At(round as i64)).unwrap();
                let found = futures::executor::block_on(wait).unwrap();
                assert_eq!(found.transform.translation[0], round as f64);
                answered.store(round, Ordering::Release);
            }
        });
        for round in 1..=rounds {
            while asked.load(Ordering::Acquire) < round {
                std::thread::yield_now();
            }
            set(&mut writer, "odom", "base", round as i64, at_x(round as f64)).unwrap();
        }
    });
    assert_eq!(answered.into_inner(), rounds);
}

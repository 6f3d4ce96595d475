// SPDX-License-Identifier: MIT OR Apache-2.0
//! The joins as streams: what is passed on and counted, which job is open then, ends, floods, and that nothing is allocated.

#[path = "../../../msgs/tests/support/heap.rs"]
mod heap;

use futures::channel::mpsc::{UnboundedReceiver, UnboundedSender, unbounded};
use futures::task::noop_waker_ref;
use futures::{Stream, StreamExt};
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_join::{
    ApproximateEpsilonTime, ApproximateTime, ExactTime, JoinCounters, JoinError, LatestTime,
    RateSynchronizer, Room, Source, Stamped, Synchronizer, all_of, latest, stamped,
};

thread_local!(static CALLS: Cell<u64> = const { Cell::new(0) });

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|_| {
    let _ = CALLS.try_with(|calls| calls.set(calls.get() + 1));
});

/// An input that says what it is asked: `+a` where a job of `a` begins, `-a` where it ends.
struct Input {
    name: char,
    items: Rc<RefCell<VecDeque<i64>>>,
    has_ended: Rc<Cell<bool>>,
    log: Rc<RefCell<String>>,
    job: bool,
    held: usize,
}

impl Source for Input {
    fn name(&self) -> String {
        format!("/{}", self.name)
    }

    fn room(&self) -> Room {
        Room { held: self.held, depth: 4 }
    }

    fn try_next(&mut self) -> Option<i64> {
        self.items.borrow_mut().pop_front()
    }

    fn finish(&mut self) {
        if std::mem::take(&mut self.job) {
            self.log.borrow_mut().extend(['-', self.name]);
        }
    }
}

impl Stream for Input {
    type Item = i64;

    fn poll_next(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<i64>> {
        self.finish();
        let item = self.items.borrow_mut().pop_front();
        match item {
            Some(item) => {
                self.job = true;
                self.log.borrow_mut().extend(['+', self.name]);
                Poll::Ready(Some(item))
            }
            None if self.has_ended.get() => Poll::Ready(None),
            None => Poll::Pending,
        }
    }
}

impl Stamped for Input {
    fn stamp_ns(&self, item: &i64) -> i64 {
        *item
    }
}

#[derive(Default)]
struct World {
    items: [Rc<RefCell<VecDeque<i64>>>; 3],
    has_ended: [Rc<Cell<bool>>; 3],
    log: Rc<RefCell<String>>,
}

impl World {
    fn new() -> Self {
        let world = World::default();
        world.items.iter().for_each(|items| items.borrow_mut().reserve(1_000));
        world.log.borrow_mut().reserve(100_000);
        world
    }

    fn input(&self, i: usize) -> Input {
        let (items, has_ended, log) = (self.items[i].clone(), self.has_ended[i].clone(), self.log.clone());
        Input { name: ['a', 'b', 'c'][i], items, has_ended, log, job: false, held: 100 }
    }

    fn send(&self, i: usize, item: i64) {
        self.items[i].borrow_mut().push_back(item);
    }

    fn log(&self) -> String {
        std::mem::take(&mut self.log.borrow_mut())
    }
}

fn poll<S: Stream + Unpin>(stream: &mut S) -> Poll<Option<S::Item>> {
    stream.poll_next_unpin(&mut Context::from_waker(noop_waker_ref()))
}

/// How many items are there, which are dropped.
fn poll_all(stream: &mut (impl Stream + Unpin)) -> usize {
    std::iter::from_fn(|| matches!(poll(stream), Poll::Ready(Some(_))).then_some(())).count()
}

/// What became of the messages of each input: received, dropped, refused.
fn counts(counters: &JoinCounters) -> Vec<[u64; 3]> {
    counters.inputs().iter().map(|input| [input.received(), input.dropped(), input.refused()]).collect()
}

#[test]
fn the_callback_works_in_the_job_of_who_came_last() {
    let world = World::new();
    let mut pairs = Synchronizer::new(ExactTime::new(3), (world.input(0), world.input(1))).unwrap();
    world.send(0, 1);
    assert_eq!(poll(&mut pairs), Poll::Pending);
    assert_eq!(world.log(), "+a-a");
    world.send(1, 1);
    assert_eq!(poll(&mut pairs), Poll::Ready(Some((1, 1))));
    assert_eq!(world.log(), "+b");
    assert_eq!(poll(&mut pairs), Poll::Pending);
    assert_eq!(world.log(), "-b");

    // One message that completes two sets: both belong to its job, and what waits elsewhere is taken only after it.
    let mut pairs = Synchronizer::new(ApproximateTime::new(5), (world.input(0), world.input(1))).unwrap();
    for (input, stamp) in [(0, 0), (1, 1), (1, 3)] {
        world.send(input, stamp);
        assert_eq!(poll(&mut pairs), Poll::Pending);
    }
    world.log();
    world.send(0, 3);
    assert_eq!(poll(&mut pairs), Poll::Ready(Some((0, 1))));
    world.send(1, 9);
    assert_eq!(poll(&mut pairs), Poll::Ready(Some((3, 3))));
    assert_eq!(world.log(), "+a");
    assert_eq!(poll(&mut pairs), Poll::Pending);
    assert_eq!(world.log(), "-a+b-b");
    assert_eq!(counts(&pairs.counters()), [[2, 0, 0], [3, 0, 0]]);

    let mut all = all_of((world.input(0), world.input(1))).unwrap();
    [(1, 7), (0, 5), (0, 6)].into_iter().for_each(|(input, stamp)| world.send(input, stamp));
    assert_eq!(poll(&mut all), Poll::Ready(Some((6, 7))));
    assert_eq!(world.log(), "+a+b-a");
    assert_eq!(poll(&mut all), Poll::Pending);
    assert_eq!(world.log(), "-b");
    world.send(0, 8);
    assert_eq!(poll(&mut all), Poll::Pending);
    world.send(0, 9);
    world.send(1, 10);
    assert_eq!(poll(&mut all), Poll::Ready(Some((9, 10))));
    assert_eq!(world.log(), "+a-a+a+b-a");
    assert_eq!((all.counters().sets(), counts(&all.counters())), (2, vec![[4, 2, 0], [2, 0, 0]]));
}

#[test]
fn the_latest_of_others_is_read_with_the_trigger_and_makes_no_job() {
    let world = World::new();
    let mut joined = latest(world.input(0), (world.input(1), world.input(2))).unwrap();
    world.send(1, 10);
    assert!(poll(&mut joined).is_pending());
    world.send(1, 11);
    world.send(0, 1);
    let Poll::Ready(Some((1, (Some(first), None)))) = poll(&mut joined) else { panic!() };
    assert_eq!((*first, &world.log()[..]), (11, "+a"));
    // The same again: there is nothing newer.
    world.send(0, 2);
    let Poll::Ready(Some((2, (Some(again), None)))) = poll(&mut joined) else { panic!() };
    assert_eq!((*first, *again), (11, 11));
    world.send(0, 3);
    world.send(1, 12);
    world.send(2, 20);
    let Poll::Ready(Some((3, (Some(second), Some(other))))) = poll(&mut joined) else { panic!() };
    assert_eq!((*first, *second, *other), (11, 12, 20));
    // The callback holds both places: what comes is dropped and counted, what it holds stays.
    world.send(0, 4);
    world.send(1, 13);
    let Poll::Ready(Some((4, (Some(third), Some(_))))) = poll(&mut joined) else { panic!() };
    assert_eq!((*first, *second, *third), (11, 12, 12));
    drop((first, again, third, second));
    world.send(0, 5);
    world.send(1, 14);
    let Poll::Ready(Some((5, (Some(fifth), _)))) = poll(&mut joined) else { panic!() };
    assert_eq!(*fifth, 14);
    assert_eq!(counts(&joined.counters()), [[5, 2, 0], [1, 0, 0]]);
    world.has_ended[0].set(true);
    assert!(matches!(poll(&mut joined), Poll::Ready(None)));
}

#[test]
fn each_message_of_the_fastest_comes_with_the_newest_of_all() {
    let world = World::new();
    let now = Rc::new(Cell::new(0));
    let clock = {
        let now = now.clone();
        move || now.get()
    };
    let inputs = (world.input(0), world.input(1));
    let mut joined = RateSynchronizer::new(LatestTime::new(), clock, inputs).unwrap();
    let at = |ms: i64| now.set(ms * 1_000_000);
    let mut send = |ms: i64, input: usize, item: i64| {
        at(ms);
        world.send(input, item);
        let Poll::Ready(set) = poll(&mut joined) else { return None };
        set.map(|(a, b)| (*a, *b))
    };
    assert_eq!((send(0, 0, 1), send(10, 0, 2)), (None, None), "nothing of the other yet");
    assert_eq!((send(15, 1, 100), send(20, 0, 3)), (None, Some((3, 100))));
    assert_eq!(world.log(), "+a-a+a-a+b-b+a");
    assert_eq!((send(30, 0, 4), send(35, 1, 101), send(40, 0, 5)), (Some((4, 100)), None, Some((5, 101))));
    // The fast one stops: the other takes over.
    assert_eq!((send(55, 1, 102), send(75, 1, 103)), (Some((5, 102)), Some((5, 103))));
    assert_eq!(world.log(), "-a+a-a+b-b+a-a+b-b+b");
    assert_eq!((joined.counters().sets(), counts(&joined.counters())), (5, vec![[5, 2, 0], [4, 0, 0]]));

    // Who holds both places of an input gets no set with what finds none.
    let mut held = Vec::new();
    for i in 0..3 {
        at(100 + i * 10);
        world.send(0, 10 + i);
        while let Poll::Ready(Some(set)) = poll(&mut joined) {
            held.push(set);
        }
    }
    at(130);
    world.send(0, 13);
    assert!(poll(&mut joined).is_pending() && held.len() == 2, "{held:?}");
    drop(held);
    at(140);
    world.send(0, 14);
    let Poll::Ready(Some((a, _))) = poll(&mut joined) else { panic!() };
    assert_eq!(*a, 14);
    // It ends when all have ended, or one that sent nothing.
    world.has_ended[0].set(true);
    assert!(poll(&mut joined).is_pending());
    world.has_ended[1].set(true);
    assert!(matches!(poll(&mut joined), Poll::Ready(None)));
    let inputs = (world.input(0), world.input(2));
    let mut never = RateSynchronizer::new(LatestTime::new(), || 0, inputs).unwrap();
    assert!(matches!(poll(&mut never), Poll::Ready(None)));
}

#[test]
fn nothing_is_unaccounted_for_and_nothing_is_allocated() {
    let world = World::new();
    let inputs = || (world.input(0), world.input(1), world.input(2));
    let policy = || ApproximateTime::new(4).max_interval(Duration::from_nanos(30));
    let mut near = Synchronizer::new(policy(), inputs()).unwrap();
    let mut equal = Synchronizer::new(ExactTime::new(4), inputs()).unwrap();
    let mut all = all_of(inputs()).unwrap();
    let mut joined = latest(world.input(0), (world.input(1), world.input(2))).unwrap();
    let epsilon = ApproximateEpsilonTime::new(4, Duration::from_nanos(30));
    let mut within = Synchronizer::new(epsilon, inputs()).unwrap();
    let now = Cell::new(0);
    let clock = || {
        now.set(now.get() + 1);
        now.get()
    };
    let mut fastest = RateSynchronizer::new(LatestTime::new(), clock, inputs()).unwrap();
    let mut sets = [0; 6];
    let before = CALLS.get();
    for step in 0..30_000_i64 {
        let input = (step % 7 % 3) as usize;
        let part = step / 5_000;
        world.send(input, step / 7 * 10 + if part == 1 { 0 } else { step % 2 * 3 });
        sets[part as usize] += match part {
            0 => poll_all(&mut near),
            1 => poll_all(&mut equal),
            2 => poll_all(&mut all),
            3 => poll_all(&mut joined),
            4 => poll_all(&mut within),
            _ => poll_all(&mut fastest),
        };
        world.log.borrow_mut().clear();
    }
    assert_eq!(CALLS.get(), before);
    println!("{sets:?}");
    assert!(sets.iter().all(|sets| *sets > 10), "{sets:?}");
    let queued = [near.counters(), equal.counters(), within.counters()].map(|counters| (counters, 4));
    for (counters, most) in queued.into_iter().chain([(all.counters(), 1)]) {
        for input in counters.inputs() {
            let known = counters.sets() + input.dropped() + input.refused();
            assert!((known..=known + most).contains(&input.received()), "{counters:?}");
        }
    }
}

#[test]
fn a_flood_lets_others_have_their_turn() {
    let endless =
        |offset: i64| stamped(futures::stream::iter((0..).map(move |i| i * 2 + offset)), |stamp| *stamp);
    let mut never = Synchronizer::new(ExactTime::new(8), (endless(0), endless(1))).unwrap();
    assert_eq!(poll(&mut never), Poll::Pending);
    let taken: u64 = never.counters().inputs().iter().map(|input| input.received()).sum();
    assert_eq!(taken, 16);
    let mut never = RateSynchronizer::new(LatestTime::new(), || 0, (endless(0), endless(1))).unwrap();
    assert!(poll(&mut never).is_pending());
    let taken: u64 = never.counters().inputs().iter().map(|input| input.received()).sum();
    assert_eq!(taken, 2_000);
}

#[test]
fn a_leap_back_begins_anew() {
    let (senders, receivers): (Vec<UnboundedSender<i64>>, Vec<UnboundedReceiver<i64>>) =
        (0..2).map(|_| unbounded()).unzip();
    let mut inputs = receivers.into_iter().map(|input| stamped(input, |stamp: &i64| *stamp));
    let inputs = (inputs.next().unwrap(), inputs.next().unwrap());
    let mut pairs =
        Synchronizer::new(ApproximateTime::new(5), inputs).unwrap().time_jump(Duration::from_nanos(100));
    let send = |input: usize, stamp| senders[input].unbounded_send(stamp).unwrap();
    [(0, 1_000), (0, 1_010), (0, 990)].into_iter().for_each(|(input, stamp)| send(input, stamp));
    assert_eq!(poll(&mut pairs), Poll::Pending);
    send(0, 5);
    assert_eq!(poll(&mut pairs), Poll::Pending);
    send(1, 5);
    assert_eq!(poll(&mut pairs), Poll::Ready(Some((5, 5))));
    let counters = pairs.counters();
    assert_eq!((counters.resets(), counts(&counters)), (1, vec![[4, 2, 1], [1, 0, 0]]));
    // The end of an input that nothing waits of is the end.
    drop(senders);
    assert_eq!(poll(&mut pairs), Poll::Ready(None));
}

#[test]
fn what_has_no_room_is_refused_with_the_fix() {
    let world = World::new();
    let tight = Input { held: 5, ..world.input(1) };
    let error = Synchronizer::new(ExactTime::new(4), (world.input(0), tight)).err().unwrap();
    assert_eq!(error, JoinError::Room { input: "/b".into(), room: 5, needed: 6 });
    assert!(error.to_string().contains("raise `Limits::held` to 6"), "{error}");
    let none = Synchronizer::new(ExactTime::new(0), (world.input(0), world.input(1))).err().unwrap();
    assert_eq!(none, JoinError::NoQueue);
    assert!(all_of((Input { held: 2, ..world.input(0) }, world.input(1))).is_err());
    assert!(latest(world.input(0), (Input { held: 3, ..world.input(1) },)).is_err());
    let tight = (world.input(0), Input { held: 3, ..world.input(1) });
    let error = RateSynchronizer::new(LatestTime::new(), || 0, tight).err().unwrap();
    assert_eq!(error, JoinError::Room { input: "/b".into(), room: 3, needed: 4 });
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that wait for several topics: sets of samples that lie where they were written, jobs, limits, no allocation.

mod common;
#[path = "../../msgs/tests/support/heap.rs"]
mod heap;

use std::cell::Cell;
use std::time::Duration;

use common::{Log, Number, context, eventually, spin};
use futures::StreamExt;
use tautline::geometry_msgs::msg::{PointStamped, PoseStamped};
use tautline::join::{
    ApproximateEpsilonTime, ApproximateTime, ExactTime, JoinError, LatestTime, Policy, RateSynchronizer,
    Synchronizer, all_of, latest,
};
use tautline::{CallbackHandle, CallbackOptions, Limits, Node, Publisher, Qos, Subscription};

thread_local!(static CALLS: Cell<u64> = const { Cell::new(0) });

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|_| {
    let _ = CALLS.try_with(|calls| calls.set(calls.get() + 1));
});

fn point(publisher: &Publisher<PointStamped>, ms: i64, x: f64) {
    let mut message = PointStamped::default();
    (message.header.stamp.sec, message.header.stamp.nanosec) =
        ((ms / 1_000) as i32, (ms % 1_000 * 1_000_000) as u32);
    message.point.x = x;
    publisher.publish(&message).unwrap();
}

fn pose(publisher: &Publisher<PoseStamped>, ms: i64, x: f64) {
    let mut message = PoseStamped::default();
    (message.header.stamp.sec, message.header.stamp.nanosec) =
        ((ms / 1_000) as i32, (ms % 1_000 * 1_000_000) as u32);
    message.pose.position.x = x;
    publisher.publish(&message).unwrap();
}

const QUEUE: usize = 6;

fn node(domain: u32) -> (tautline::Context, Node) {
    let context = context(domain);
    let mut node = Node::create(context.clone(), "joiner", "").unwrap();
    for topic in ["/points", "/poses"] {
        node.set_topic_limits(topic, Limits { held: QUEUE + 2, ..Limits::default() }).unwrap();
    }
    (context, node)
}

type Publishers = (Publisher<PointStamped>, Publisher<PoseStamped>);
type Pairs<P> = Synchronizer<P, (Subscription<PointStamped>, Subscription<PoseStamped>)>;

/// Both topics, published and joined.
fn pairs<P: Policy>(node: &mut Node, policy: P) -> (Publishers, Pairs<P>) {
    let points = node.create_publisher("/points", Qos::default()).unwrap();
    let poses = node.create_publisher("/poses", Qos::default()).unwrap();
    let inputs = (
        node.subscribe("/points", Qos::default()).unwrap(),
        node.subscribe("/poses", Qos::default()).unwrap(),
    );
    ((points, poses), Synchronizer::new(policy, inputs).unwrap())
}

/// What the sets say that come.
fn spawn<P: Policy + Unpin + Send + 'static>(
    node: &mut Node,
    pairs: Pairs<P>,
    sets: &'static Log<(f64, f64)>,
) -> CallbackHandle {
    let callback = pairs.for_each(move |(point, pose)| async move {
        sets.add((point.view().point().x, pose.view().pose().position.x));
    });
    node.spawn_callback(CallbackOptions::other(), callback).unwrap()
}

/// Ends a callback when so many jobs have ended, which are all.
fn end_after(callback: CallbackHandle, jobs: u64) {
    let stats = callback.stats().clone();
    eventually("the end of the last job", || stats.completions() == jobs);
    callback.stop();
    callback.join().unwrap();
    assert_eq!((stats.releases(), stats.completions()), (jobs, jobs));
}

#[test]
fn messages_of_two_topics_meet_by_their_headers() {
    static SETS: Log<(f64, f64)> = Log::new();
    let (context, mut node) = node(53);
    let policy = ApproximateTime::new(QUEUE).max_interval(Duration::from_millis(20));
    let ((points, poses), pairs) = pairs(&mut node, policy);
    let counters = pairs.counters();
    let callback = spawn(&mut node, pairs, &SETS);
    let _spinning = spin(&context);
    // Points every 100 ms, poses every 50 ms and 3 ms late; a set is known to be the best with the message after it.
    for i in 0..20 {
        point(&points, i * 100, i as f64);
        pose(&poses, i * 100 + 3, i as f64);
        pose(&poses, i * 100 + 53, -1.0);
        if i > 0 {
            SETS.wait_for(i as usize);
        }
    }
    let sets = SETS.wait_for(19);
    let expected: Vec<_> = (0..sets.len()).map(|i| (i as f64, i as f64)).collect();
    assert_eq!(sets, expected);
    // Each message is a job, whether it completes a set or not.
    end_after(callback, 60);
    assert_eq!(counters.inputs().iter().map(|input| input.received()).collect::<Vec<_>>(), [20, 40]);
    assert!(counters.inputs()[1].dropped() >= 18, "{counters:?}");
}

#[test]
fn a_set_within_a_tolerance_comes_with_its_last_message() {
    static SETS: Log<(f64, f64)> = Log::new();
    let (context, mut node) = node(56);
    let policy = ApproximateEpsilonTime::new(QUEUE, Duration::from_millis(20));
    let ((points, poses), pairs) = pairs(&mut node, policy);
    let counters = pairs.counters();
    let callback = spawn(&mut node, pairs, &SETS);
    let _spinning = spin(&context);
    for i in 0..20 {
        // One that is 50 ms before its partner is in no set.
        pose(&poses, i * 100 + 50, -1.0);
        point(&points, i * 100 + 100, i as f64);
        pose(&poses, i * 100 + 103, i as f64);
        SETS.wait_for(i as usize + 1);
    }
    let expected: Vec<_> = (0..20).map(|i| (f64::from(i), f64::from(i))).collect();
    assert_eq!(SETS.events(), expected);
    end_after(callback, 60);
    assert_eq!(counters.inputs().iter().map(|input| input.dropped()).collect::<Vec<_>>(), [0, 20]);
}

#[test]
fn the_newest_of_all_come_at_the_pace_of_the_fastest() {
    static SETS: Log<(u64, u64)> = Log::new();
    static TAKEN: Log<u64> = Log::new();
    let context = context(57);
    let mut node = Node::create(context.clone(), "joiner", "").unwrap();
    let [fast, slow] =
        ["/fast", "/slow"].map(|topic| node.create_publisher::<Number>(topic, Qos::default()).unwrap());
    let mut subscribe = |topic: &str| node.subscribe::<Number>(topic, Qos::default()).unwrap();
    let inputs = (subscribe("/fast"), subscribe("/slow"));
    // Each message is taken 10 ms after the one before.
    let clock = || {
        TAKEN.add(0);
        10_000_000 * TAKEN.events().len() as i64
    };
    let joined = RateSynchronizer::new(LatestTime::new(), clock, inputs).unwrap();
    let counters = joined.counters();
    let each = joined.for_each(|(fast, slow)| async move { SETS.add((fast.value, slow.value)) });
    let each = node.spawn_callback(CallbackOptions::other(), each).unwrap();
    let _spinning = spin(&context);
    let mut sent = 0;
    let mut send = |publisher: &Publisher<Number>, value| {
        publisher.publish(&Number { value }).unwrap();
        sent += 1;
        TAKEN.wait_for(sent);
    };
    for value in 0..12 {
        send(&fast, value);
        if value % 3 == 0 {
            send(&slow, 100 + value);
        }
    }
    // A rate is known from an input's second message on; then each message of the fast one makes a set, and none of the slow one.
    let expected: Vec<_> = (1..12).map(|value| (value, 100 + (value - 1) / 3 * 3)).collect();
    assert_eq!(SETS.wait_for(expected.len()), expected);
    // A message of the slow one is a job, too.
    end_after(each, 16);
    assert_eq!(counters.sets(), 11);
}

#[test]
fn ten_thousand_sets_allocate_nothing() {
    static SETS: Log<u64> = Log::new();
    const COUNT: i64 = 10_000;
    let (context, mut node) = node(54);
    let ((points, poses), mut pairs) = pairs(&mut node, ExactTime::new(QUEUE));
    let numbers = node.create_publisher::<Number>("/numbers", Qos::default()).unwrap();
    let others = node.subscribe::<Number>("/numbers", Qos::default()).unwrap();
    let callback = async move {
        let mut before = 0;
        for i in 0..COUNT {
            let Some((point, pose)) = pairs.next().await else { return };
            assert_eq!(point.view().header().stamp(), pose.view().header().stamp());
            if i == 100 {
                before = CALLS.get();
            }
            if i == COUNT - 1 {
                SETS.add(CALLS.get() - before);
            }
            drop((point, pose));
            TAKEN.store(i as u64 + 1, std::sync::atomic::Ordering::Release);
        }
    };
    static TAKEN: std::sync::atomic::AtomicU64 = std::sync::atomic::AtomicU64::new(0);
    node.spawn_callback(CallbackOptions::other(), callback).unwrap();
    let _spinning = spin(&context);
    for i in 0..COUNT {
        point(&points, i * 1_000, 0.0);
        pose(&poses, i * 1_000, 0.0);
        numbers.publish(&Number { value: i as u64 }).unwrap();
        while TAKEN.load(std::sync::atomic::Ordering::Acquire) <= i as u64 {
            std::thread::yield_now();
        }
    }
    assert_eq!(SETS.wait_for(1), [0]);
    drop(others);
}

#[test]
fn something_new_of_each_and_the_latest_of_another() {
    static ALL: Log<(u64, u64)> = Log::new();
    static LATEST: Log<(u64, Option<u64>)> = Log::new();
    let context = context(55);
    let mut node = Node::create(context.clone(), "joiner", "").unwrap();
    let [a, b] = ["/a", "/b"].map(|topic| node.create_publisher::<Number>(topic, Qos::default()).unwrap());
    let mut subscribe = |topic: &str| node.subscribe::<Number>(topic, Qos::default()).unwrap();
    let all = all_of((subscribe("/a"), subscribe("/b"))).unwrap();
    let joined = latest(subscribe("/a"), (subscribe("/b"),)).unwrap();
    node.spawn_callback(
        CallbackOptions::other(),
        all.for_each(|(a, b)| async move { ALL.add((a.value, b.value)) }),
    )
    .unwrap();
    let each = joined.for_each(|(a, (b,))| async move { LATEST.add((a.value, b.map(|b| b.value))) });
    let each = node.spawn_callback(CallbackOptions::other(), each).unwrap();
    let _spinning = spin(&context);
    let send = |publisher: &Publisher<Number>, value| publisher.publish(&Number { value }).unwrap();
    send(&a, 1);
    LATEST.wait_for(1);
    send(&b, 10);
    ALL.wait_for(1);
    send(&b, 11);
    send(&b, 12);
    send(&a, 2);
    ALL.wait_for(2);
    assert_eq!(LATEST.wait_for(2), [(1, None), (2, Some(12))]);
    assert_eq!(ALL.events(), [(1, 10), (2, 12)]);
    // What is read beside the trigger is no job.
    each.stop();
    let stats = each.stats().clone();
    each.join().unwrap();
    assert_eq!((stats.releases(), stats.completions()), (2, 2));
}

#[test]
fn a_subscription_that_may_hold_too_little_is_named_with_the_fix() {
    let context = context(60);
    let mut node = Node::create(context, "joiner", "").unwrap();
    let mut points = |topic: &str| node.subscribe::<PointStamped>(topic, Qos::default()).unwrap();
    let error = Synchronizer::new(ExactTime::new(10), (points("/left"), points("/right"))).err().unwrap();
    assert_eq!(error, JoinError::Room { input: "/left".into(), room: 4, needed: 12 });
    // By another time than the header's.
    let mut by_time = |topic: &str| points(topic).stamped_by(|sample| sample.info().source_timestamp_ns);
    let inputs = (by_time("/left"), by_time("/right"));
    assert!(Synchronizer::new(ApproximateTime::new(2), inputs).is_ok());
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Transforms over `/tf` and `/tf_static`: from broadcasters in one context to a listener in another, late joiners, what is refused,
//! simulated time that leaps back, and no allocation.

mod common;
#[path = "../../msgs/tests/support/heap.rs"]
mod heap;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use common::{context, eventually, spin};
use futures::executor::block_on;
use tautline::geometry_msgs::msg::TransformStamped;
use tautline::rosgraph_msgs::msg::Clock;
use tautline::tf::{
    Buffer, Limits, LookupError, StaticTransformBroadcaster, Time, TransformBroadcaster, TransformListener,
    to_message,
};
use tautline::tf2_msgs::msg::TFMessage;
use tautline::{CallbackOptions, Context, Error, Node, Qos};

/// Heap calls of the listener's thread, which is told by its name once it is asked.
static CALLS: AtomicU64 = AtomicU64::new(0);
static COUNTS: AtomicBool = AtomicBool::new(false);

static LISTENER: AtomicU64 = AtomicU64::new(0);

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|_| {
    if COUNTS.load(Ordering::SeqCst)
        && rustix::thread::gettid().as_raw_nonzero().get() as u64 == LISTENER.load(Ordering::SeqCst)
    {
        CALLS.fetch_add(1, Ordering::SeqCst);
    }
});

const MS: i64 = 1_000_000;

fn stamped(parent: &str, child: &str, stamp_ns: i64, x: f64) -> TransformStamped {
    let mut stamped = TransformStamped { child_frame_id: child.into(), ..TransformStamped::default() };
    stamped.header.frame_id = parent.into();
    (stamped.header.stamp.sec, stamped.header.stamp.nanosec) =
        ((stamp_ns / 1_000_000_000) as i32, (stamp_ns % 1_000_000_000) as u32);
    stamped.transform.translation.x = x;
    stamped
}

fn listen(context: &Context) -> (Node, TransformListener) {
    let mut node = Node::create(context.clone(), "listener", "").unwrap();
    let options = CallbackOptions::other().name("tf");
    let listener =
        TransformListener::new(&mut node, options, Limits { frames: 16, ..Limits::default() }).unwrap();
    (node, listener)
}

fn x(buffer: &Buffer, target: &str, source: &str, time: Time) -> Result<f64, LookupError> {
    buffer.lookup(target, source, time).map(|found| found.transform.translation[0])
}

#[test]
fn what_is_broadcast_is_found_and_what_is_refused_is_counted() {
    let (near, far) = (context(61), context(61));
    let mut robot = Node::create(near.clone(), "robot", "").unwrap();
    let mut fixed = StaticTransformBroadcaster::new(&mut robot).unwrap();
    // Before there is a listener: it is told all the same, of both.
    fixed.send_transform(&stamped("base", "laser", 0, 0.5)).unwrap();
    fixed.send_transform(&stamped("base", "camera", 0, 0.25)).unwrap();
    let (_node, listener) = listen(&far);
    let _spinning = spin(&far);
    let buffer = listener.buffer();
    let laser = block_on(buffer.wait_for("camera", "laser", Time::At(5)).unwrap()).unwrap();
    assert_eq!(laser.transform.translation, [0.25, 0.0, 0.0]);

    let moving = TransformBroadcaster::new(&mut robot).unwrap();
    let waiting = buffer.wait_for("odom", "laser", Time::At(15 * MS)).unwrap();
    let waiting = std::thread::spawn(move || block_on(waiting));
    eventually("the listener", || robot.count_subscribers("/tf").unwrap() == 1);
    for (stamp, at) in [(10 * MS, 1.0), (20 * MS, 2.0)] {
        moving.send_transform(&stamped("odom", "base", stamp, at)).unwrap();
    }
    let found = waiting.join().unwrap().unwrap();
    assert_eq!((found.stamp_ns, found.transform.translation[0]), (Some(15 * MS), 2.0));
    assert_eq!(to_message(&found.transform).translation.x, 2.0);
    assert_eq!(x(&buffer, "odom", "laser", Time::Latest), Ok(2.5));
    assert!(matches!(x(&buffer, "odom", "laser", Time::At(21 * MS)), Err(LookupError::Extrapolation { .. })));

    let mut bent = stamped("odom", "base", 30 * MS, 3.0);
    bent.transform.rotation.w = 2.0;
    moving
        .send(&TFMessage {
            transforms: vec![bent, stamped("odom", "odom", 0, 0.0), stamped("odom", "base", 20 * MS, 9.0)],
        })
        .unwrap();
    eventually("three refusals", || buffer.counters().invalid + buffer.counters().repeated == 3);
    assert_eq!((buffer.counters().set, buffer.counters().repeated), (4, 1), "two that stay, two that move");
    assert_eq!(x(&buffer, "odom", "base", Time::Latest), Ok(2.0));
}

#[test]
fn simulated_time_that_leaps_back_forgets_what_moved() {
    let context = context(62);
    let (mut node, listener) = listen(&context);
    node.set_parameter("use_sim_time", true).unwrap();
    let clock = node.create_publisher::<Clock>("/clock", Qos::default()).unwrap();
    let mut fixed = StaticTransformBroadcaster::new(&mut node).unwrap();
    let moving = TransformBroadcaster::new(&mut node).unwrap();
    let _spinning = spin(&context);
    let buffer = listener.buffer();
    let show = |sec: i32| {
        let mut now = Clock::default();
        now.clock.sec = sec;
        // Nobody else reads the time.
        clock.publish(&now).unwrap();
    };
    show(100);
    fixed.send_transform(&stamped("base", "laser", 0, 0.5)).unwrap();
    moving.send_transform(&stamped("odom", "base", 100_000 * MS, 1.0)).unwrap();
    block_on(buffer.wait_for("odom", "laser", Time::Latest).unwrap()).unwrap();
    show(50);
    eventually("what moved to be forgotten", || !buffer.can_transform("odom", "base", Time::Latest));
    assert!(buffer.can_transform("base", "laser", Time::Latest));
    moving.send_transform(&stamped("odom", "base", 50_000 * MS, 2.0)).unwrap();
    let found = block_on(buffer.wait_for("odom", "laser", Time::At(50_000 * MS)).unwrap()).unwrap();
    assert_eq!(found.transform.translation[0], 2.5);
    assert!(matches!(
        x(&buffer, "odom", "laser", Time::At(100_000 * MS)),
        Err(LookupError::Extrapolation { .. })
    ));
    assert_eq!(buffer.counters().old, 0);
}

#[test]
fn a_listener_is_one_of_those_on_its_nodes_ros_clock() {
    let context = context(199);
    let (mut node, listener) = listen(&context);
    let second = Duration::from_secs(1);
    let _timers: Vec<_> = (0..63).map(|_| node.create_timer(second).unwrap()).collect();
    assert!(matches!(node.create_timer(second), Err(Error::ClockUsers { max: 64 })));
    drop(listener);
}

#[test]
fn ten_thousand_transforms_allocate_nothing() {
    let context = context(63);
    let (mut node, listener) = listen(&context);
    let moving = TransformBroadcaster::new(&mut node).unwrap();
    let _spinning = spin(&context);
    let buffer = listener.buffer();
    let mut message =
        TFMessage { transforms: vec![stamped("odom", "base", 0, 0.0), stamped("base", "arm", 0, 1.0)] };
    let mut send = |i: i64| {
        for transform in &mut message.transforms {
            (transform.header.stamp.sec, transform.header.stamp.nanosec) =
                ((i / 1_000) as i32, (i % 1_000 * MS) as u32);
        }
        moving.send(&message).unwrap();
        block_on(buffer.wait_for("odom", "arm", Time::At(i * MS)).unwrap()).unwrap();
    };
    (1..100).for_each(&mut send);
    LISTENER.store(thread_of("cb:tf"), Ordering::SeqCst);
    COUNTS.store(true, Ordering::SeqCst);
    (100..10_000).for_each(&mut send);
    COUNTS.store(false, Ordering::SeqCst);
    assert_eq!(CALLS.load(Ordering::SeqCst), 0);
    assert_eq!(listener.callback().stats().releases(), 9_999);
}

/// The thread of this process with a name.
fn thread_of(name: &str) -> u64 {
    let threads = std::fs::read_dir("/proc/self/task").unwrap().map(|entry| entry.unwrap());
    let is = |id: &str| std::fs::read_to_string(format!("/proc/self/task/{id}/comm")).unwrap().trim() == name;
    let ids = threads.map(|entry| entry.file_name().into_string().unwrap());
    ids.filter(|id| is(id)).map(|id| id.parse().unwrap()).next().unwrap()
}

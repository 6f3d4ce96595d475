// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clocks, and timers that follow simulated time.

mod common;

use std::task::Poll;
use std::time::Duration;

use common::{Log, context, spin};
use futures::{FutureExt, StreamExt};
use tautline::rosgraph_msgs::msg::Clock as ClockMessage;
use tautline::{
    CallbackGroup, CallbackOptions, Clock, ClockChange, ClockJump, ClockType, Context, Error, JumpThreshold,
    Node, Publisher, Qos, Realtime, Tick,
};

/// A context whose nodes show simulated time, and who tells it.
fn simulation(domain: u32) -> (Context, Node, Publisher<ClockMessage>) {
    let args = ["--ros-args", "-p", "use_sim_time:=true"];
    let ctx = Context::builder().domain(domain).realtime(Realtime::Off).args(args).build().unwrap();
    let mut simulator = Node::create(ctx.clone(), "simulator", "").unwrap();
    let publisher = simulator.create_publisher("/clock", Qos::keep_last(1)).unwrap();
    (ctx, simulator, publisher)
}

fn tell(publisher: &Publisher<ClockMessage>, ms: u64) {
    publisher.publish(&ClockMessage { clock: Clock::to_builtin_time(&Duration::from_millis(ms)) }).unwrap();
}

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

#[test]
fn a_period_may_be_as_long_as_there_is_time() {
    let (ctx, _simulator, publisher) = simulation(77);
    let mut node = Node::create(ctx, "patient", "").unwrap();
    let mut timers =
        [Duration::MAX, Duration::from_nanos(u64::MAX), Duration::from_nanos(i64::MAX as u64 + 1)]
            .map(|period| node.create_timer(period).unwrap());
    for time in [0, 5, 10, 3, 4_000_000] {
        tell(&publisher, time);
        for timer in &mut timers {
            let poll = timer.poll_next_unpin(&mut std::task::Context::from_waker(std::task::Waker::noop()));
            assert!(poll.is_pending());
        }
    }
}

#[test]
fn clocks_show_what_they_are() {
    let steady = Clock::new(ClockType::SteadyTime);
    let (first, second) = (steady.now(), steady.now());
    assert!(second >= first);
    let now = || std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap();
    for kind in [ClockType::SystemTime, ClockType::RosTime] {
        let clock = Clock::new(kind);
        let (before, shown, after) = (now(), clock.now(), now());
        assert!(before <= shown && shown <= after && clock.clock_type() == kind && !clock.is_simulated());
        assert!(matches!(clock.on_jump(JumpThreshold::default(), |_| {}), Err(Error::ClockTypeNotRosTime)));
    }
    let stamp = Clock::to_builtin_time(&Duration::new(5, 7));
    assert_eq!((stamp.sec, stamp.nanosec), (5, 7));
}

#[test]
fn a_ros_clock_shows_simulated_time() {
    let (ctx, _simulator, publisher) = simulation(200);
    let node = Node::create(ctx, "robot", "").unwrap();
    let clock = node.clock();
    assert_eq!((clock.is_simulated(), clock.now()), (true, ms(0)));
    let of_source = node.time_source().clock();
    static JUMPS: Log<ClockJump> = Log::new();
    let threshold = JumpThreshold { min_forward: Some(ms(1000)), ..JumpThreshold::default() };
    let jumps = clock.on_jump(threshold, |jump| JUMPS.add(jump)).unwrap();
    // Ten times as fast, a pause, on, a jump forward, one back.
    for time in [1500, 1600, 1700, 1700, 1800, 60_000, 30_000] {
        tell(&publisher, time);
        assert_eq!(clock.now(), ms(time));
        assert_eq!(of_source.now(), ms(time));
    }
    // Of several messages only the last is the time.
    tell(&publisher, 30_100);
    tell(&publisher, 30_200);
    assert_eq!(clock.now(), ms(30_200));
    let jump = |ms: i64| ClockJump { change: ClockChange::NoChange, delta_ns: ms * 1_000_000 };
    assert_eq!(JUMPS.events(), [jump(1500), jump(58_200), jump(-30_000)]);
    node.set_parameter("use_sim_time", false).unwrap();
    assert!(!clock.is_simulated() && clock.now() > ms(1_600_000_000_000));
    node.set_parameter("use_sim_time", true).unwrap();
    let changes: Vec<_> = JUMPS.events()[3..].iter().map(|jump| (jump.change, jump.delta_ns > 0)).collect();
    assert_eq!(changes, [(ClockChange::Deactivated, true), (ClockChange::Activated, false)]);
    drop(jumps);
    tell(&publisher, 90_000);
    assert_eq!((clock.now(), JUMPS.events().len()), (ms(90_000), 5));
}

#[test]
fn timers_follow_simulated_time() {
    let (ctx, _simulator, publisher) = simulation(217);
    let mut node = Node::create(ctx, "robot", "").unwrap();
    let mut timer = node.create_timer(ms(100)).unwrap();
    let mut task = std::task::Context::from_waker(std::task::Waker::noop());
    for (time, expected) in [
        // The simulation begins here.
        (5000, None),
        (5099, None),
        (5100, Some((5100, 1, 0))),
        // A pause, a late message, a jump forward.
        (5100, None),
        (5250, Some((5200, 2, 0))),
        (6010, Some((6000, 10, 7))),
        // Back: a new period.
        (1000, None),
        (1099, None),
        (1100, Some((1100, 11, 0))),
    ] {
        tell(&publisher, time);
        let tick = match timer.poll_next_unpin(&mut task) {
            Poll::Ready(Some(tick)) => Some((tick.release_ns / 1_000_000, tick.index, tick.missed)),
            _ => None,
        };
        assert_eq!(tick, expected, "at {time} ms");
        assert!(timer.poll_next_unpin(&mut task).is_pending());
    }
    assert_eq!(timer.missed(), 7);
}

#[test]
fn timers_change_over_when_the_clock_does() {
    static TICKS: Log<u64> = Log::new();
    let ctx = context(230);
    let _spinning = spin(&ctx);
    let mut node = Node::create(ctx, "robot", "").unwrap();
    let publisher = node.create_publisher::<ClockMessage>("/clock", Qos::keep_last(1)).unwrap();
    let timer = node.create_timer(ms(2)).unwrap();
    node.spawn_callback(
        CallbackOptions::fifo(20),
        timer.for_each(|tick| async move { TICKS.add(tick.index) }),
    )
    .unwrap();
    TICKS.wait_for(2);
    node.set_parameter("use_sim_time", true).unwrap();
    let clock = node.clock();
    // The first message begins the period, whenever the timer comes to read it; then each is one period later.
    let (mut time, before) = (1000, TICKS.events().len());
    while TICKS.events().len() < before + 5 {
        tell(&publisher, time);
        assert_eq!(clock.now(), ms(time));
        time += 2;
    }
    node.set_parameter("use_sim_time", false).unwrap();
    let so_far = TICKS.events().len();
    let indices = TICKS.wait_for(so_far + 3);
    assert!(indices.windows(2).all(|pair| pair[0] < pair[1]), "{indices:?}");
}

/// By how long it waited, whatever the simulated clock shows.
#[test]
fn a_simulated_timer_in_a_group_responds_from_when_it_could_run() {
    static RELEASES: Log<u64> = Log::new();
    let (ctx, _simulator, publisher) = simulation(180);
    let mut node = Node::create(ctx.clone(), "robot", "").unwrap();
    let timer = node.create_timer(ms(1000)).unwrap();
    let mut group = CallbackGroup::new();
    let stats = group.add(
        "timer",
        timer,
        |tick: &Tick| tick.since_ns,
        |tick| async move { RELEASES.add(tick.release_ns) },
    );
    let callback = node.spawn_group(CallbackOptions::other().name("group"), group).unwrap();
    let _spinning = spin(&ctx);
    let started = std::time::Instant::now();
    let mut now = 1000;
    while RELEASES.events().is_empty() {
        now += 1000;
        tell(&publisher, now);
        std::thread::yield_now();
    }
    callback.stop();
    callback.join().unwrap();
    assert!(RELEASES.events()[0] >= 2_000_000_000);
    let longest = stats.response().snapshot().max();
    assert!(longest <= started.elapsed(), "{longest:?}");
}

/// A thread that comes to poll late keeps the sampler awake no longer than one release.
#[test]
fn a_sleep_rings_once() {
    let ctx = context(180);
    let clock = Clock::new(ClockType::SteadyTime);
    let until = clock.now() + Duration::from_micros(100);
    let mut sleep = std::pin::pin!(clock.sleep_until(until, &ctx));
    if sleep.as_mut().now_or_never().is_some() {
        // It was over before it was polled.
        return;
    }
    while clock.now() < until {
        ctx.spin_once(Duration::ZERO);
    }
    let is_quiet = (0..10).any(|_| {
        let start = std::time::Instant::now();
        ctx.spin_once(ms(20));
        start.elapsed() >= ms(20)
    });
    assert!(is_quiet);
    assert!(sleep.now_or_never().is_some());
}

#[test]
fn sleeps_end_when_the_clock_is_there() {
    static ENDED: Log<&str> = Log::new();
    let (ctx, _simulator, publisher) = simulation(159);
    let _spinning = spin(&ctx);
    let node = Node::create(ctx.clone(), "robot", "").unwrap();
    for (name, clock) in [
        ("simulated", node.clock()),
        ("steady", Clock::new(ClockType::SteadyTime)),
        ("system", Clock::new(ClockType::SystemTime)),
    ] {
        let context = ctx.clone();
        let until = clock.now() + ms(50);
        let sleep = async move {
            clock.sleep_until(until, &context).await.unwrap();
            assert!(clock.now() >= until);
            ENDED.add(name);
        };
        node.spawn_callback(CallbackOptions::fifo(10).name(name), sleep).unwrap();
    }
    // Real time does not move the simulated one.
    let mut ended = ENDED.wait_for(2);
    ended.sort_unstable();
    assert_eq!(ended, ["steady", "system"]);
    tell(&publisher, 49);
    tell(&publisher, 51);
    assert_eq!(ENDED.wait_for(3)[2], "simulated");
}

#[test]
fn use_sim_time_is_a_boolean() {
    let args = ["--ros-args", "-p", "use_sim_time:=1"];
    let ctx = Context::builder().domain(230).realtime(Realtime::Off).args(args).build().unwrap();
    let error = Node::create(ctx, "robot", "").map(drop).unwrap_err().to_string();
    assert!(
        error.starts_with("parameter 'use_sim_time' is of type boolean, but 1 is of type integer"),
        "{error}"
    );
}

#[test]
fn a_node_has_a_limited_number_of_timers_on_its_ros_clock() {
    let ctx = context(230);
    let mut node = Node::create(ctx, "robot", "").unwrap();
    let timers: Vec<_> = (0..64).map(|_| node.create_timer(ms(1000)).unwrap()).collect();
    let error = node.create_timer(ms(1000)).map(drop).unwrap_err().to_string();
    assert!(
        error.starts_with("64 timers, sleeps and transform listeners are on this node's ROS clock already"),
        "{error}"
    );
    drop(timers);
    assert!(node.create_timer(ms(1000)).is_ok());
    assert!(matches!(node.create_timer(Duration::ZERO), Err(Error::ZeroPeriod)));
    let short = Duration::from_nanos(999);
    assert!(matches!(node.create_timer(short), Err(Error::ShortPeriod { .. })));
    let error = node.create_wall_timer(short).map(drop).unwrap_err().to_string();
    assert_eq!(error, "a timer cannot have a period of 999ns: the shortest is 1µs");
    assert!(node.create_wall_timer(Duration::from_micros(1)).is_ok());
}

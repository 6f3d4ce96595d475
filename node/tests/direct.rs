// SPDX-License-Identifier: MIT OR Apache-2.0
//! A callback thread that publishers wake themselves: without the sampler for messages, with it for all else.

mod common;

use std::time::Duration;

use common::{Log, Number, context, leave_a_thread, realtime, spin};
use futures::future::{FutureExt, join};
use futures::stream::{FuturesUnordered, StreamExt};
use tautline::{
    CallbackGroup, CallbackOptions, Context, Error, ExecutorError, Node, Publisher, Qos, Realtime, Sample,
    Tick,
};

fn publish(publisher: &Publisher<Number>, value: u64) {
    publisher.publish(&Number { value }).unwrap();
}

fn direct() -> CallbackOptions {
    CallbackOptions::other().direct_wake()
}

/// Each message is published when the one before has been received, so that the thread sleeps before most.
fn one_by_one(context: &Context, options: CallbackOptions, log: &'static Log<u64>) {
    let mut node = Node::create(context.clone(), "direct", "").unwrap();
    let numbers = node.subscribe::<Number>("/direct", Qos::default()).unwrap();
    let publisher = node.create_publisher::<Number>("/direct", Qos::default()).unwrap();
    let callback = numbers.for_each(move |sample| async move { log.add(sample.value) });
    let callback = node.spawn_callback(options, callback).unwrap();
    for value in 1..=1000 {
        publish(&publisher, value);
        log.wait_for(value as usize);
    }
    assert_eq!(log.events(), (1..=1000).collect::<Vec<_>>());
    callback.stop();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!((stats.releases(), stats.completions()), (1000, 1000));
}

#[test]
fn messages_need_no_sampler() {
    static LOG: Log<u64> = Log::new();
    static SPUN: Log<u64> = Log::new();
    one_by_one(&context(91), direct(), &LOG);
    one_by_one(&context(91), direct().spin(Duration::from_micros(50)), &SPUN);
}

#[test]
fn messages_need_no_sampler_in_real_time() {
    static LOG: Log<u64> = Log::new();
    if !realtime() {
        return;
    }
    let context = Context::builder().domain(92).realtime(Realtime::Required).build().unwrap();
    one_by_one(&context, CallbackOptions::fifo(5).direct_wake(), &LOG);
}

#[test]
fn several_streams_share_a_thread_however_they_are_polled() {
    static LOG: Log<u64> = Log::new();
    let context = context(93);
    let mut node = Node::create(context.clone(), "combined", "").unwrap();
    let topics = ["/a", "/b", "/c", "/d"];
    let publishers = topics.map(|topic| node.create_publisher::<Number>(topic, Qos::default()).unwrap());
    let mut streams =
        topics.map(|topic| node.subscribe::<Number>(topic, Qos::default()).unwrap()).into_iter();
    let mut next = move || streams.next().unwrap();
    let add = |sample: Sample<Number>| async move { LOG.add(sample.value) };
    // The first two are polled whenever the thread is woken, the others only if they themselves were.
    let both = join(next().for_each(add), next().for_each(add));
    let each: FuturesUnordered<_> = [next().for_each(add), next().for_each(add)].into_iter().collect();
    let all = join(both, each.for_each(|()| async {})).map(|_| ());
    let callback = node.spawn_callback(direct(), all).unwrap();
    for value in 1..=400 {
        publish(&publishers[value as usize % 4], value);
        LOG.wait_for(value as usize);
    }
    assert_eq!(LOG.events(), (1..=400).collect::<Vec<_>>());
    callback.stop();
    callback.join().unwrap();
}

#[test]
fn groups_and_timers_wake_it_too() {
    static LOG: Log<&str> = Log::new();
    let context = context(94);
    let mut node = Node::create(context.clone(), "group", "").unwrap();
    let numbers = node.subscribe::<Number>("/group", Qos::default()).unwrap();
    let publisher = node.create_publisher::<Number>("/group", Qos::default()).unwrap();
    let timer = node.create_wall_timer(Duration::from_millis(1)).unwrap();
    let mut group = CallbackGroup::new();
    let released_ns = |sample: &Sample<Number>| sample.info().released_ns;
    group.add("number", numbers, released_ns, |_| async { LOG.add("number") });
    group.add("tick", timer, |tick: &Tick| tick.since_ns, |_| async { LOG.add("tick") });
    node.spawn_group(direct(), group).unwrap();
    publish(&publisher, 1);
    assert_eq!(LOG.wait_for(1), ["number"], "nobody spins, so the timer is silent");
    let _spinning = spin(&context);
    LOG.wait_for(20);
    publish(&publisher, 2);
    let mut seen = 20;
    while LOG.events().iter().filter(|event| **event == "number").count() < 2 {
        seen += 1;
        LOG.wait_for(seen);
    }
}

#[test]
fn a_subscription_that_leaves_the_thread_is_rung_through_the_sampler_again() {
    leave_a_thread(95, direct());
}

#[test]
fn what_is_beyond_the_limits_goes_through_the_sampler_or_is_refused() {
    static LOG: Log<u64> = Log::new();
    let context = context(228);
    let mut node = Node::create(context.clone(), "many", "").unwrap();
    // One more than a thread's bell has places for.
    let topics: Vec<String> = (0..64).map(|index| format!("/many/t{index}")).collect();
    let mut publishers = Vec::new();
    let all: FuturesUnordered<_> = topics
        .iter()
        .map(|topic| {
            publishers.push(node.create_publisher::<Number>(topic, Qos::default()).unwrap());
            let numbers = node.subscribe::<Number>(topic, Qos::default()).unwrap();
            numbers.for_each(|sample| async move { LOG.add(sample.value) })
        })
        .collect();
    node.spawn_callback(direct(), all.for_each(|()| async {})).unwrap();
    let spinning = spin(&context);
    for (index, publisher) in publishers.iter().enumerate() {
        publish(publisher, index as u64);
        LOG.wait_for(index + 1);
    }
    drop(spinning);

    let spawn = || node.spawn_callback(direct().name("sleeper"), std::future::pending());
    let error = (0..=256).find_map(|_| spawn().err()).unwrap();
    let Error::Executor(ExecutorError::DirectWake { .. }) = &error else { panic!("{error}") };
    assert!(error.to_string().contains("`sleeper` cannot start with direct wake-ups"), "{error}");
    assert!(error.to_string().contains("256 callback threads"), "{error}");
}

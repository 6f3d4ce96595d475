// SPDX-License-Identifier: MIT OR Apache-2.0
//! A busy-polling subscription needs no sampler, is not rung, and starves nobody.

mod common;

use std::time::Duration;

use common::{Gate, Log, Number, context, cores, leave_a_thread, realtime, spin};
use futures::{FutureExt, StreamExt};
use tautline::{
    CallbackOptions, Context, CoreSet, Error, ExecutorError, Node, Publisher, Qos, Realtime, Sample,
};
use tautline_rt::{clock, current_affinity, current_policy, set_affinity};

fn publish(publisher: &Publisher<Number>, values: impl IntoIterator<Item = u64>) {
    values.into_iter().for_each(|value| publisher.publish(&Number { value }).unwrap());
}

/// A core for the busy poller, while the calling thread stays on another if there is one.
fn last_core() -> usize {
    let cores = cores();
    set_affinity(CoreSet::one(cores[0])).unwrap();
    *cores.last().unwrap()
}

/// Nobody spins. The callback waits at a gate with its first message while more come than its queue holds.
fn messages_come_without_a_sampler(
    context: &Context,
    options: CallbackOptions,
    log: &'static Log<u64>,
    gate: &'static Gate,
) {
    let mut node = Node::create(context.clone(), "busy", "").unwrap();
    let numbers = node.subscribe::<Number>("/busy", Qos::keep_last(4)).unwrap();
    let publisher = node.create_publisher::<Number>("/busy", Qos::default()).unwrap();
    let counters = numbers.counters();
    let callback = numbers.for_each(move |sample: Sample<Number>| async move {
        log.add(sample.value);
        gate.pass();
    });
    let callback = node.spawn_callback(options.busy_poll(), callback).unwrap();
    publish(&publisher, [1]);
    log.wait_for(1);
    publish(&publisher, 2..=20);
    gate.open();
    log.wait_for(5);
    publish(&publisher, [21]);
    assert_eq!(log.wait_for(6), [1, 17, 18, 19, 20, 21]);
    assert_eq!((counters.received(), counters.lost(), counters.max_queue()), (6, 15, 4));
    callback.stop();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!((stats.releases(), stats.completions()), (6, 6));
}

#[test]
fn messages_come_in_order_and_losses_are_counted() {
    static LOG: Log<u64> = Log::new();
    static GATE: Gate = Gate::new();
    messages_come_without_a_sampler(&context(220), CallbackOptions::other().core(last_core()), &LOG, &GATE);
}

#[test]
fn messages_come_in_real_time() {
    static LOG: Log<u64> = Log::new();
    static GATE: Gate = Gate::new();
    if !realtime() {
        return;
    }
    if cores().len() == 1 {
        return println!("skipped: needs two cores");
    }
    let context = Context::builder().domain(221).realtime(Realtime::Required).build().unwrap();
    messages_come_without_a_sampler(&context, CallbackOptions::fifo(5).core(last_core()), &LOG, &GATE);
}

/// Says whether publishing woke the sampler before a timer did that is due after `timeout`.
fn rings(node: &mut Node, timeout: Duration, publish: impl FnOnce()) -> bool {
    let due_ns = clock::monotonic_ns() + timeout.as_nanos() as u64;
    let mut timer = node.create_wall_timer_at(due_ns, Duration::from_secs(3600)).unwrap();
    // Arming the timer rang, too.
    node.spin_once(Duration::ZERO);
    publish();
    node.spin_once(Duration::from_secs(3600));
    timer.tick().now_or_never().is_none()
}

#[test]
fn publishers_do_not_ring_it() {
    static LOG: Log<u64> = Log::new();
    let mut node = Node::create(context(222), "quiet", "").unwrap();
    let publisher = node.create_publisher::<Number>("/quiet", Qos::default()).unwrap();
    let numbers = node.subscribe::<Number>("/quiet", Qos::default()).unwrap();
    let is_rung = rings(&mut node, Duration::from_secs(60), || publish(&publisher, [0]));
    assert!(is_rung, "an ordinary subscription is rung");
    let callback = numbers.for_each(|sample| async move { LOG.add(sample.value) });
    node.spawn_callback(CallbackOptions::other().core(last_core()).busy_poll(), callback).unwrap();
    LOG.wait_for(1);
    // The janitor may ring after a topic has changed, and does so once.
    let quiet = (0..20).any(|_| {
        !rings(&mut node, Duration::from_millis(50), || {
            let received = LOG.events().len();
            publish(&publisher, 1..=3);
            LOG.wait_for(received + 3);
        })
    });
    assert!(quiet, "each time something was published, the sampler was rung");
}

#[test]
fn a_subscription_that_leaves_a_busy_thread_is_rung_again() {
    leave_a_thread(222, CallbackOptions::other().core(last_core()).busy_poll());
}

#[test]
fn whoever_would_starve_the_sampler_is_refused() {
    if !realtime() {
        return;
    }
    let (own, sampler_core) = ((current_policy().unwrap(), current_affinity().unwrap()), cores()[0]);
    if cores().len() == 1 {
        return println!("skipped: needs two cores");
    }
    let context = Context::builder().domain(223).sampler_core(last_core()).sampler_priority(10);
    let context = context.realtime(Realtime::Required).build().unwrap();
    let busy = |priority, core| {
        let node = Node::create(context.clone(), "greedy", "").unwrap();
        node.spawn_callback(
            CallbackOptions::fifo(priority).core(core).busy_poll().name("greedy"),
            std::future::pending(),
        )
    };
    // Too late for the sampler: it does not even try.
    let greedy = busy(10, *cores().last().unwrap()).unwrap();
    let here = (current_policy().unwrap(), current_affinity().unwrap());
    let error = context.spin().unwrap_err();
    let Error::Executor(ExecutorError::Starved { busy: poller, starved, .. }) = &error else {
        panic!("{error}")
    };
    assert_eq!((poller.as_str(), starved.as_str()), ("greedy", "sampler"));
    assert_eq!((current_policy().unwrap(), current_affinity().unwrap()), here);
    greedy.stop();
    greedy.join().unwrap();

    // Too late for the busy poller.
    static SERVED: Gate = Gate::new();
    let mut node = Node::create(context.clone(), "server", "").unwrap();
    let mut timer = node.create_wall_timer(Duration::from_millis(1)).unwrap();
    let served = async move {
        timer.tick().await.unwrap();
        SERVED.open();
    };
    node.spawn_callback(CallbackOptions::fifo(5).core(sampler_core), served).unwrap();
    let spinning = spin(&context);
    SERVED.pass();
    let error = busy(10, *cores().last().unwrap()).unwrap_err();
    let message = error.to_string();
    assert!(message.contains("`greedy`") && message.contains("would starve `sampler`"), "{message}");
    // Below the sampler it may.
    busy(9, *cores().last().unwrap()).unwrap().stop();
    drop(spinning);
    assert_eq!(current_policy().unwrap(), own.0);
}

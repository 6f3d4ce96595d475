// SPDX-License-Identifier: MIT OR Apache-2.0
//! A callback that is slower than its topic: losses are counted exactly, and it can still be ended.

mod common;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use common::{Gate, Log, Number, context, spin};
use futures::StreamExt;
use tautline::{CallbackOptions, Node, Qos, Sample};
use tautline_rt::clock;

#[test]
fn published_is_received_and_lost_and_queued() {
    static LOG: Log<u64> = Log::new();
    static GATES: [Gate; 2] = [Gate::new(), Gate::new()];
    const DEPTH: u64 = 5;
    let context = context(224);
    let mut node = Node::create(context.clone(), "slow", "").unwrap();
    let qos = Qos::keep_last(DEPTH as usize);
    let numbers = node.subscribe::<Number>("/fast", qos).unwrap();
    let publisher = node.create_publisher::<Number>("/fast", qos).unwrap();
    let counters = numbers.counters();
    // Waits with the first message and with the third.
    let slow = |sample: Sample<Number>| async move {
        LOG.add(sample.value);
        match LOG.events().len() {
            1 => GATES[0].pass(),
            3 => GATES[1].pass(),
            _ => {}
        }
    };
    node.spawn_callback(CallbackOptions::other(), numbers.for_each(slow)).unwrap();
    let _spinning = spin(&context);
    let publish = |values: std::ops::RangeInclusive<u64>| {
        values.for_each(|value| publisher.publish(&Number { value }).unwrap());
    };
    publish(1..=1);
    LOG.wait_for(1);
    publish(2..=100);
    GATES[0].open();
    // At the third: 1, 96 and 97 of 100 are received, 98 to 100 queued, the rest lost.
    assert_eq!(LOG.wait_for(3), [1, 96, 97]);
    assert_eq!((counters.received(), counters.lost()), (3, 100 - 3 - 3));
    publish(101..=104);
    GATES[1].open();
    // Two places were free, so 98 and 99 went: five queued, none left.
    assert_eq!(LOG.wait_for(8)[3..], [100, 101, 102, 103, 104]);
    assert_eq!((counters.received(), counters.lost(), counters.max_queue()), (8, 104 - 8, DEPTH));
}

#[test]
fn a_stream_that_is_never_empty_lets_its_callback_end() {
    static LOG: Log<u64> = Log::new();
    static LAST: AtomicU64 = AtomicU64::new(0);
    let (fast, slow) = (context(225), context(225));
    let mut node = Node::create(slow.clone(), "slow", "").unwrap();
    let numbers = node.subscribe::<Number>("/flood", Qos::keep_last(3)).unwrap();
    let counters = numbers.counters();
    let work = |sample: Sample<Number>| async move {
        clock::burn_cpu(Duration::from_millis(1));
        LAST.store(sample.value, Ordering::Release);
        LOG.add(sample.value);
    };
    let callback = node.spawn_callback(CallbackOptions::other(), numbers.for_each(work)).unwrap();
    let mut fast = Node::create(fast.clone(), "fast", "").unwrap();
    let publisher = fast.create_publisher::<Number>("/flood", Qos::default()).unwrap();
    let over = &AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(move || {
            for value in (1..).take_while(|_| !over.load(Ordering::Acquire)) {
                publisher.publish(&Number { value }).unwrap();
            }
        });
        let spinning = spin(&slow);
        LOG.wait_for(20);
        // While messages go on coming: the sampler first, then node and context, which join the callback.
        drop(spinning);
        drop((node, slow));
        assert!(callback.is_finished());
        over.store(true, Ordering::Release);
    });
    // The values are the sequence numbers: up to the last one received, all are received or lost.
    assert_eq!(counters.received() + counters.lost(), LAST.load(Ordering::Acquire));
    assert_eq!(counters.received(), LOG.events().len() as u64);
    assert!(counters.lost() > 0);
}

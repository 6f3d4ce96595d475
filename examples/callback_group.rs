//! Callback group: two topics and a timer share one thread, and are served in order of release.
//!
//! The first job keeps the thread for 350 ms. What was released meanwhile is served by age, whatever it came from.
// SPDX-License-Identifier: MIT OR Apache-2.0

use std::process::ExitCode;
use std::time::Duration;
use tautline::rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline::{CallbackGroup, CallbackOptions, Node, Qos, Result, Sample, Tick};
use tautline_examples::{UInt64, context, exit_code};

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "group", "")?;
    let odometry = node.subscribe::<UInt64>("/odometry", Qos::default())?;
    let scan = node.subscribe::<UInt64>("/scan", Qos::default())?;
    let to_odometry = node.create_publisher::<UInt64>("/odometry", Qos::default())?;
    let to_scan = node.create_publisher::<UInt64>("/scan", Qos::default())?;

    let start_ns = monotonic_ns();
    let at_ns = move |ms: u64| start_ns + ms * 1_000_000;
    let timer = node.create_wall_timer_at(at_ns(200), Duration::from_millis(200))?;
    // Each message says when it was due, as a periodic publisher does that was woken late.
    for (publisher, due_ms) in [(&to_odometry, 0), (&to_odometry, 250), (&to_scan, 100), (&to_scan, 300)] {
        let mut message = publisher.loan().expect("a loan is free");
        message.data = due_ms;
        message.publish_released_at(at_ns(due_ms)).expect("keep-last never refuses");
    }

    let released = |message: &Sample<UInt64>| message.info().released_ns;
    let mut group = CallbackGroup::new();
    group.add("scan", scan, released, |message| {
        println!("scan     released at {} ms", message.data);
        async {}
    });
    group.add("odometry", odometry, released, move |message| {
        println!("odometry released at {} ms", message.data);
        if message.data == 0 {
            sleep_until_monotonic(at_ns(350));
        }
        async {}
    });
    let ended = context.clone();
    let statistics = group.add(
        "timer",
        timer,
        |tick: &Tick| tick.since_ns,
        move |tick| {
            println!("timer    released at {} ms", (tick.release_ns - start_ns) / 1_000_000);
            if tick.index == 2 {
                ended.shutdown();
            }
            async {}
        },
    );

    let callback = node.spawn_group(CallbackOptions::fifo(10).name("group"), group)?;
    node.spin()?;
    callback.stop();
    callback.join()?;
    println!("{} jobs of the timer", statistics.completions());
    Ok(())
}

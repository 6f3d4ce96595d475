// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two components: one counts, one doubles what it hears.

use futures::StreamExt;
use std::time::Duration;
use tautline::std_msgs::msg::UInt64;
use tautline::{CallbackHandle, CallbackOptions, Error, Node, Qos, Result, log_debug};

tautline_components::components! {
    "demo::Counter" => counter,
    "demo::Doubler" => doubler,
    "demo::Broken" => |_| panic!("as it should"),
    "demo::Unfinished" => unfinished,
}

fn counter(mut node: Node) -> Result<Vec<CallbackHandle>> {
    let step = node.declare_parameter("step", 1)?.get();
    log_debug!(node.logger(), "counts in steps of {step}");
    let publisher = node.create_publisher::<UInt64>("count", Qos::default())?;
    let mut timer = node.create_wall_timer(Duration::from_millis(5))?;
    let count = async move {
        let mut count = 0;
        while timer.tick().await.is_ok() {
            count += step;
            let _ = publisher.publish(&UInt64 { data: count.unsigned_abs() });
        }
    };
    Ok(vec![node.spawn_callback(CallbackOptions::fifo(10).name("counter"), count)?])
}

fn doubler(mut node: Node) -> Result<Vec<CallbackHandle>> {
    let counts = node.subscribe::<UInt64>("count", Qos::default())?;
    let publisher = node.create_publisher::<UInt64>("doubled", Qos::default())?;
    let double = counts.for_each(move |count| {
        let _ = publisher.publish(&UInt64 { data: count.data * 2 });
        async {}
    });
    Ok(vec![node.spawn_callback(CallbackOptions::fifo(20).name("doubler"), double)?])
}

/// Counts already when it finds that it cannot go on.
fn unfinished(node: Node) -> Result<Vec<CallbackHandle>> {
    counter(node)?;
    Err(Error::ZeroPeriod)
}

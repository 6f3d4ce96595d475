//! Busy polling: a callback with a core of its own looks for messages all the time; nobody rings or wakes it.
//!
//! The proof: no thread ever calls `spin`, so there is no sampler that could wake anything. The price: one core at 100 %.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use tautline::rt::set_affinity;
use tautline::{CallbackOptions, Context, CoreSet, Node, Qos, Result};
use tautline_examples::{SKIPPED, UInt64, exit_code};

const MESSAGES: u64 = 1000;

fn main() -> ExitCode {
    let cores: Vec<usize> = CoreSet::allowed().unwrap_or_default().iter().collect();
    let Some((&own, others @ [_, ..])) = cores.split_last() else {
        eprintln!("busy polling needs a core of its own, and this process has only one");
        return ExitCode::from(SKIPPED);
    };
    exit_code(show(own, others.iter().copied().collect()))
}

fn show(own: usize, others: CoreSet) -> Result<()> {
    // Whatever else this process does stays away from the callback's core.
    set_affinity(others)?;

    let mut node = Node::create(Context::create()?, "busy_poll", "")?;
    let subscription = node.subscribe::<UInt64>("/counter", Qos::keep_last(MESSAGES as usize))?;
    let publisher = node.create_publisher::<UInt64>("/counter", Qos::default())?;
    let counters = subscription.counters();

    let options = CallbackOptions::fifo(10).core(own).busy_poll().execution_time(false).name("/counter");
    let callback = node.spawn_callback(options, async move {
        let sum = StreamExt::take(subscription, MESSAGES as usize).fold(0, |sum, message| {
            let sum = sum + message.data;
            async move { sum }
        });
        println!("sum {}", sum.await);
    })?;
    for data in 1..=MESSAGES {
        publisher.publish(&UInt64 { data }).expect("keep-last never refuses");
    }
    callback.join()?;
    println!("received {}, lost {}, and no thread has called spin", counters.received(), counters.lost());
    Ok(())
}

//! Priorities: on one core a high-priority callback starts and ends within a low-priority one; a lower one waits.
//!
//! `work` (priority 20) publishes twice while it runs. The first message is for `log` (10), which must wait; the second
//! for `alarm` (30), which preempts `work` at once, inside its call of `publish`.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::{CallbackOptions, Context, CoreSet, Node, Qos, Realtime, Result};
use tautline_examples::{UInt64, exit_code};

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let core = CoreSet::allowed()?.iter().last().unwrap_or(0);
    let context = Context::builder().sampler_core(core).build()?;
    if context.realtime() == Realtime::Off {
        eprintln!("without real-time priorities any order may follow");
    }
    let mut node = Node::create(context.clone(), "priorities", "")?;
    let on_core = |name, priority| CallbackOptions::fifo(priority).core(core).name(name);

    let mut messages = node.subscribe::<UInt64>("/alarm", Qos::default())?;
    let alarm = node.spawn_callback(on_core("alarm", 30), async move {
        if let Some(message) = messages.next().await {
            println!("    alarm {} begins", message.data);
            println!("    alarm {} ends", message.data);
        }
    })?;

    let mut messages = node.subscribe::<UInt64>("/log", Qos::default())?;
    let log = node.spawn_callback(on_core("log", 10), async move {
        if let Some(message) = messages.next().await {
            println!("log {} begins", message.data);
            println!("log {} ends", message.data);
        }
        context.shutdown();
    })?;

    let to_alarm = node.create_publisher::<UInt64>("/alarm", Qos::default())?;
    let to_log = node.create_publisher::<UInt64>("/log", Qos::default())?;
    let timer = node.create_wall_timer(Duration::from_millis(500))?;
    let work = timer.for_each(move |_| {
        println!("  work begins");
        to_log.publish(&UInt64 { data: 1 }).expect("keep-last never refuses");
        println!("  work has published for log");
        to_alarm.publish(&UInt64 { data: 2 }).expect("keep-last never refuses");
        println!("  work has published for alarm");
        println!("  work ends");
        async {}
    });
    let work = node.spawn_callback(on_core("work", 20), work)?;

    node.spin()?;
    work.stop();
    for callback in [alarm, log, work] {
        callback.join()?;
    }
    Ok(())
}

//! Composition: three nodes in one process, one sampler that wakes them, and one message that none of them copies.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use tautline::{CallbackOptions, Context, Node, Qos, Result};
use tautline_examples::{UInt64, context, exit_code};

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    // What a library of components would export: see node/components/demo.
    doubler(Node::create(context.clone(), "doubler", "")?)?;
    printer(Node::create(context.clone(), "printer", "")?, context.clone())?;
    let mut counter = Node::create(context.clone(), "counter", "")?;
    let publisher = counter.create_publisher::<UInt64>("count", Qos::default())?;
    for data in 1..=3 {
        publisher.publish(&UInt64 { data })?;
    }
    // This thread becomes the sampler of all three.
    context.spin()
}

fn doubler(mut node: Node) -> Result<()> {
    let counts = node.subscribe::<UInt64>("count", Qos::default())?;
    let publisher = node.create_publisher::<UInt64>("doubled", Qos::default())?;
    let double = counts.for_each(move |count| {
        let mut loan = publisher.loan().expect("a loan is free");
        loan.data = count.data * 2;
        loan.publish().expect("keep-last never refuses");
        async {}
    });
    node.spawn_callback(CallbackOptions::fifo(20).name("doubler"), double)?;
    Ok(())
}

fn printer(mut node: Node, context: Context) -> Result<()> {
    let doubled = node.subscribe::<UInt64>("doubled", Qos::default())?;
    let events = context.events().clone();
    let print = doubled.for_each(move |message| {
        println!("{}", message.data);
        if message.data == 6 {
            events.stop();
        }
        async {}
    });
    node.spawn_callback(CallbackOptions::fifo(10).name("printer"), print)?;
    Ok(())
}

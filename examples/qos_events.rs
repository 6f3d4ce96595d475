//! QoS events: who is matched, who does not fit, a missed deadline, lost messages, each told to a stream of its own.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::{Stream, StreamExt};
use std::process::ExitCode;
use std::time::Duration;
use tautline::{Node, PublisherEvent, Qos, Result, SubscriptionEvent};
use tautline_examples::{UInt64, context, exit_code};

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let sampler = std::thread::spawn({
        let context = context.clone();
        move || {
            while context.is_valid() {
                context.spin_once(Duration::from_millis(100))
            }
        }
    });
    let mut node = Node::create(context.clone(), "qos_events", "")?;
    let qos = Qos::keep_last(2).deadline(Duration::from_millis(50));
    let subscription = node.subscribe::<UInt64>("/speed", qos)?;
    let mut events = node.subscription_events(&subscription)?;

    // A publisher without a deadline promises less than is requested: it is not matched.
    let lax = node.create_publisher::<UInt64>("/speed", Qos::default())?;
    let mut lax_events = node.publisher_events(&lax)?;
    if let Some(PublisherEvent::OfferedIncompatibleQos(found)) = next(&mut lax_events) {
        println!("offered     the {} is not what is requested", found.last_policy_kind);
    }
    if let Some(SubscriptionEvent::RequestedIncompatibleQos(found)) = next(&mut events) {
        println!("requested   the {} is not what is offered", found.last_policy_kind);
    }

    let publisher = node.create_publisher::<UInt64>("/speed", qos)?;
    for data in 1..=5 {
        publisher.publish(&UInt64 { data })?;
    }
    // The queue holds two; taking shows what was overwritten.
    while let Some(message) = subscription.try_take()? {
        println!("received    {}", message.data);
    }
    // Nothing more comes, so that at last the deadline is missed.
    loop {
        match next(&mut events) {
            Some(SubscriptionEvent::Matched(now)) => println!("matched     {} publisher", now.current_count),
            Some(SubscriptionEvent::LivelinessChanged(now)) => {
                println!("liveliness  {} alive", now.alive_count)
            }
            Some(SubscriptionEvent::MessageLost(lost)) => {
                println!("lost        {} messages", lost.total_count)
            }
            Some(SubscriptionEvent::RequestedDeadlineMissed(_)) => break println!("deadline    missed"),
            _ => {}
        }
    }
    context.shutdown();
    sampler.join().expect("it does not panic");
    Ok(())
}

fn next<E>(events: &mut (impl Stream<Item = E> + Unpin)) -> Option<E> {
    futures::executor::block_on(events.next())
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Many nodes in one process: one sampler wakes them all, and what they tell each other is not copied.

mod common;
#[path = "../../transport/tests/support/mod.rs"]
mod support;

use common::{Log, Number, context, spin};
use futures::StreamExt;
use std::sync::Arc;
use support::{Place, place_of};
use tautline::{CallbackOptions, Error, Node, Qos};

const NODES: usize = 20;

#[test]
fn a_message_goes_through_twenty_nodes_on_one_sampler() {
    let context = context(119);
    let arrived: Arc<Log<(usize, u64)>> = Arc::new(Log::new());
    let mut nodes: Vec<Node> = (0..NODES)
        .map(|n| Node::create(context.clone(), &format!("node_{n}"), "/composed").unwrap())
        .collect();
    let qos = Qos::default();
    for (index, node) in nodes.iter_mut().enumerate() {
        let numbers = node.subscribe::<Number>(&format!("hop_{index}"), qos).unwrap();
        let next = node.create_publisher::<Number>(&format!("hop_{}", index + 1), qos).unwrap();
        let arrived = arrived.clone();
        let pass = numbers.for_each(move |number| {
            arrived.add((index, number.value));
            next.publish(&Number { value: number.value + 1 }).unwrap();
            async {}
        });
        node.spawn_callback(CallbackOptions::other().name(format!("hop {index}")), pass).unwrap();
    }
    let mut first = Node::create(context.clone(), "first", "/composed").unwrap();
    let publisher = first.create_publisher::<Number>("hop_0", qos).unwrap();
    let sampler = spin(&context);
    publisher.publish(&Number { value: 100 }).unwrap();
    let hops = arrived.wait_for(NODES);
    assert_eq!(hops, (0..NODES).map(|hop| (hop, 100 + hop as u64)).collect::<Vec<_>>());
    assert!(matches!(context.spin(), Err(Error::AlreadySpinning)), "there is one");
    drop(sampler);
}

#[test]
fn what_one_node_writes_another_of_the_process_reads_in_place() {
    let context = context(119);
    let [mut writer, mut reader] =
        ["writer", "reader"].map(|name| Node::create(context.clone(), name, "/placed").unwrap());
    let publisher = writer.create_publisher::<Number>("place", Qos::default()).unwrap();
    let subscription = reader.subscribe::<Number>("place", Qos::default()).unwrap();
    let mut loan = publisher.loan().unwrap();
    loan.value = 7;
    let Place { inode, offset, .. } = place_of(&raw const *loan);
    loan.publish().unwrap();
    let sample = subscription.try_take().unwrap().unwrap();
    let read = place_of(&raw const *sample);
    assert_eq!((read.inode, read.offset, sample.value), (inode, offset, 7));
}

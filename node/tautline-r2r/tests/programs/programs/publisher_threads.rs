// SPDX-License-Identifier: MIT OR Apache-2.0
//! A publisher for each thread, nodes of one context, and a subscriber that hears them all.

use futures::{FutureExt, StreamExt};
use r2r::QosProfile;
use r2r::std_msgs::msg::Int32;
use std::collections::BTreeMap;
use std::thread;
use std::time::Duration;

const THREADS: i32 = 4;
const MESSAGES: i32 = 20;

pub fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    assert!(ctx.is_valid());
    let mut listener = r2r::Node::create(ctx.clone(), "listener", "")?;
    let mut numbers = listener.subscribe::<Int32>("/numbers", QosProfile::default().keep_all())?;
    let threads: Vec<_> = (0..THREADS)
        .map(|thread| {
            let ctx = ctx.clone();
            thread::spawn(move || {
                let mut node = r2r::Node::create(ctx, &format!("talker_{thread}"), "").unwrap();
                let publisher =
                    node.create_publisher::<Int32>("/numbers", QosProfile::default().keep_all()).unwrap();
                while publisher.get_inter_process_subscription_count().unwrap() == 0 {
                    node.spin_once(Duration::from_millis(10));
                }
                // It goes on without its node's thread.
                let talker = thread::spawn(move || {
                    for count in 0..MESSAGES {
                        publisher.publish(&Int32 { data: thread * 1000 + count }).unwrap();
                        thread::sleep(Duration::from_millis(10));
                    }
                });
                talker.join().unwrap();
                node.spin_once(Duration::from_millis(1));
                node
            })
        })
        .collect();
    let mut heard: BTreeMap<i32, Vec<i32>> = BTreeMap::new();
    while heard.values().map(Vec::len).sum::<usize>() < (THREADS * MESSAGES) as usize {
        listener.spin_once(Duration::from_millis(10));
        while let Some(Some(number)) = numbers.next().now_or_never() {
            heard.entry(number.data / 1000).or_default().push(number.data % 1000);
        }
    }
    // All, and in order.
    assert!(heard.values().all(|numbers| numbers.iter().copied().eq(0..MESSAGES)), "{heard:?}");
    threads.into_iter().for_each(|thread| drop(thread.join().unwrap()));
    Ok(())
}

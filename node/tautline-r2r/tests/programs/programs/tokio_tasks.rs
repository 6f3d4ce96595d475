// SPDX-License-Identifier: MIT OR Apache-2.0
//! Streams and timers in tasks of a multi-threaded tokio, a thread that spins.

use futures::{future, stream::StreamExt};
use r2r::QosProfile;
use r2r::std_msgs::msg::String as Text;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::task;

#[derive(Debug, Default)]
struct SharedState {
    pub state: i32,
}

#[tokio::main(flavor = "multi_thread", worker_threads = 4)]
pub async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "testnode", "")?;
    let mut sub = node.subscribe::<Text>("/topic", QosProfile::default())?;
    let p = node.create_publisher::<Text>("/topic2", QosProfile::default())?;
    let state = Arc::new(Mutex::new(SharedState::default()));

    let state_t1 = state.clone();
    task::spawn(async move {
        let mut x: i32 = 0;
        while let Some(msg) = sub.next().await {
            if x % 2 == 0 {
                p.publish(&Text { data: format!("({x}): new msg: {}", msg.data) }).unwrap();
            } else {
                state_t1.lock().unwrap().state = x;
            }
            x += 1;
        }
    });

    let sub2 = node.subscribe::<Text>("/topic2", QosProfile::default())?;
    let (heard, mut hear) = tokio::sync::mpsc::channel(100);
    task::spawn(async move {
        sub2.for_each(|msg| {
            heard.try_send(msg.data).unwrap();
            future::ready(())
        })
        .await
    });

    let source = node.create_publisher::<Text>("/topic", QosProfile::default())?;
    let mut timer = node.create_wall_timer(Duration::from_millis(20))?;
    let matched = source.wait_for_inter_process_subscribers()?;
    task::spawn(async move {
        matched.await.unwrap();
        for count in 0.. {
            if timer.tick().await.is_err() || source.publish(&Text { data: count.to_string() }).is_err() {
                break; // the node has gone
            }
        }
    });

    let is_done = Arc::new(AtomicBool::new(false));
    let stop = is_done.clone();
    let handle = std::thread::spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            node.spin_once(Duration::from_millis(100));
        }
    });
    // The first ones may have been said before the second topic's ends had met.
    let mut last = None;
    for _ in 0..5 {
        let text = hear.recv().await.expect("it goes on");
        let (x, count) = text.split_once(": new msg: ").expect("what was forwarded");
        let x: i32 = x.trim_matches(['(', ')']).parse()?;
        assert!(x % 2 == 0 && last.is_none_or(|last| x == last + 2), "{text} after {last:?}");
        assert!(count.parse::<i32>()? >= x);
        last = Some(x);
    }
    is_done.store(true, Ordering::Relaxed);
    handle.join().unwrap();
    assert!(state.lock().unwrap().state % 2 == 1);
    Ok(())
}

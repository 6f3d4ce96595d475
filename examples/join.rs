//! Joins: a callback that waits for an image and a cloud whose stamps are close, as `message_filters`' synchronizers do.
//!
//! How long messages wait at most, and how many, `taut check examples/systems/fusion.toml` has computed before; the program
//! takes the window and the queue's size from that file. Samples stay where they were written until their set is dropped.
//! `join 1000` runs for 1,000 sets in place of 5; `taut report` meanwhile compares them with the file.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tautline::geometry_msgs::msg::PointStamped;
use tautline::join::Synchronizer;
use tautline::rt::clock::monotonic_ns;
use tautline::{Context, Node, Publisher};
use tautline_examples::exit_code;

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> tautline::Result<()> {
    let sets: usize = std::env::args().nth(1).and_then(|sets| sets.parse().ok()).unwrap_or(5);
    let context =
        Context::builder().system(concat!(env!("CARGO_MANIFEST_DIR"), "/systems/fusion.toml")).build()?;
    let mut node = Node::create(context.clone(), "join", "")?;
    let join = context.callback_join("fuse")?;
    for topic in ["/image", "/cloud"] {
        node.set_topic_limits(topic, join.limits())?;
    }
    let qos = context.callback_qos("fuse")?;
    let inputs =
        (node.subscribe::<PointStamped>("/image", qos)?, node.subscribe::<PointStamped>("/cloud", qos)?);
    let pairs = Synchronizer::new(join.approximate_time(), inputs).expect("the limits are set");
    let counters = pairs.counters();
    println!(
        "stamps within {:?}, at most {} messages of a topic wait",
        join.window.unwrap_or_default(),
        join.queue_size
    );

    let stop = context.clone();
    let longest = Arc::new(AtomicU64::new(0));
    let seen = longest.clone();
    let mut pairs = pairs.take(sets).enumerate();
    let fuse = node.spawn_callback(context.callback("fuse")?, async move {
        while let Some((set, (image, cloud))) = pairs.next().await {
            // Milliseconds, by what each says of itself.
            let apart = (image.view().point().x - cloud.view().point().x).abs();
            let oldest = image.info().released_ns.min(cloud.info().released_ns);
            seen.fetch_max(monotonic_ns().saturating_sub(oldest), Relaxed);
            if set < 5 {
                println!(
                    "set {set}: stamps {}",
                    if apart <= 12.0 { "within 12 ms" } else { "too far apart" }
                );
            }
        }
        stop.shutdown();
    })?;

    let mut sensors = Vec::new();
    for (name, topic, period) in [("camera", "/image", 10), ("lidar", "/cloud", 40)] {
        let publisher = node.create_publisher(topic, context.callback_qos("fuse")?)?;
        let timer = node.create_wall_timer(Duration::from_millis(period))?;
        let callback = timer.for_each(move |tick| {
            publish(&publisher, tick.release_ns);
            async {}
        });
        sensors.push(node.spawn_callback(context.callback(name)?, callback)?);
    }
    node.spin()?;
    for callback in sensors.iter().chain([&fuse]) {
        callback.stop();
    }
    for callback in sensors.into_iter().chain([fuse]) {
        callback.join()?;
    }
    let [images, clouds] = [0, 1].map(|input| counters.inputs()[input].dropped());
    println!("images that were in no set: {}, clouds: {clouds}", if images > 0 { "some" } else { "none" });
    let longest = Duration::from_nanos(longest.load(Relaxed));
    let kept = if longest <= join.latency { "within" } else { "LONGER than" };
    println!("from a message to its set: {kept} the {:?} that were computed", join.latency);
    Ok(())
}

/// A message that is stamped with its release.
fn publish(publisher: &Publisher<PointStamped>, release_ns: u64) {
    let mut message = PointStamped::default();
    message.header.stamp.sec = (release_ns / 1_000_000_000) as i32;
    message.header.stamp.nanosec = (release_ns % 1_000_000_000) as u32;
    message.point.x = release_ns as f64 / 1e6;
    publisher.publish(&message).expect("keep-last never refuses");
}

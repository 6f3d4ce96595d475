// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages as the bytes of the wire, both ways, in tasks of tokio.

use futures::stream::StreamExt;
use r2r::{QosProfile, WrappedTypesupport, std_msgs::msg};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

#[tokio::main]
pub async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let ctx = r2r::Context::create()?;
    let mut node = r2r::Node::create(ctx, "testnode", "")?;
    let raw = node.create_publisher_untyped("/raw", "std_msgs/msg/String", QosProfile::default())?;
    let typed = node.create_publisher::<msg::String>("/typed", QosProfile::default())?;
    let mut sub_typed = node.subscribe::<msg::String>("/raw", QosProfile::default())?;
    let mut sub_raw = node.subscribe_raw("/typed", "std_msgs/msg/String", QosProfile::default())?;
    let (raw_matched, typed_matched) =
        (raw.wait_for_inter_process_subscribers()?, typed.wait_for_inter_process_subscribers()?);

    let is_done = Arc::new(AtomicBool::new(false));
    let stop = is_done.clone();
    let handle = tokio::task::spawn_blocking(move || {
        while !stop.load(Ordering::Relaxed) {
            node.spin_once(Duration::from_millis(10));
        }
    });
    let text = |x: usize| msg::String { data: format!("Hello{:>width$}", "World", width = x) };
    let publishing = tokio::task::spawn(async move {
        raw_matched.await.unwrap();
        typed_matched.await.unwrap();
        // A string of varying length.
        for x in 5..15 {
            raw.publish_raw(&text(x).to_serialized_bytes().unwrap()).unwrap();
            typed.publish(&text(x)).unwrap();
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    });
    for x in 5..15 {
        assert_eq!(sub_typed.next().await, Some(text(x)));
        let bytes = sub_raw.next().await.expect("it goes on");
        assert_eq!(bytes[..4], [0, 1, 0, 0]);
        assert_eq!(msg::String::from_serialized_bytes(&bytes)?, text(x));
    }
    publishing.await?;
    is_done.store(true, Ordering::Relaxed);
    handle.await?;
    Ok(())
}

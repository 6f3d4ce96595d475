//! Messages of types that the program was not built with: JSON out and in, and the CDR that a recorder or a bridge forwards.
//!
//! A type is known by its name. Its definition comes from beside the topic (every process leaves those of its types there),
//! from an installed ROS 2, or from the packages that Tautline brings.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use serde_json::json;
use std::process::ExitCode;
use tautline::sensor_msgs::msg::JointState;
use tautline::{CallbackOptions, Json, Node, Qos, Result};
use tautline_examples::{context, exit_code};

const TYPE: &str = "sensor_msgs/msg/JointState";

fn main() -> ExitCode {
    exit_code(show())
}

fn show() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context.clone(), "untyped", "")?;
    let qos = Qos::default();
    let mut bytes = node.subscribe_raw("/joints", TYPE, qos)?.owned();
    let mut json = node.subscribe_untyped("/relayed", TYPE, qos)?.owned();
    let mut typed = node.subscribe::<JointState>("/relayed", qos)?;
    let publisher = node.create_publisher_untyped("/joints", TYPE, qos)?;
    let relay = node.create_publisher_untyped("/relayed", TYPE, qos)?;

    // JSON and copies allocate: this is work for threads without a deadline.
    let forward = node.spawn_callback(CallbackOptions::other().name("/joints"), async move {
        while let Some(cdr) = bytes.next().await {
            println!("forwarded: {} bytes, header {:02x?}", cdr.len(), &cdr[..4]);
            if let Err(error) = relay.publish_raw(&cdr) {
                println!("{error}"); // bytes that are no JointState
            }
        }
    })?;
    let print = node.spawn_callback(CallbackOptions::other().name("/relayed"), async move {
        if let Some(message) = json.next().await {
            match message {
                Ok(message) => println!("as JSON:   {} at {}", message["name"], message["position"]),
                Err(error) => println!("{error}"),
            }
        }
        if let Some(sample) = typed.next().await {
            println!("in place:  {:?} at {:?}", sample.view().name().get(1), sample.view().position());
        }
        context.shutdown();
    })?;

    // The definition leads: what is left out has its default, what does not fit is refused with its place.
    for wrong in [json!({ "positions": [0.5] }), json!({ "name": ["left", 2] })] {
        if let Err(error) = publisher.publish(&Json(wrong)) {
            println!("refused:   {error}");
        }
    }
    publisher.publish(&Json(json!({ "name": ["left", "right"], "position": [0.5, "Infinity"] })))?;

    node.spin()?;
    forward.stop(); // it would wait for more
    forward.join()?;
    Ok(print.join()?)
}

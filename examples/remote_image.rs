//! An Image of any length, seen from another host: written in place here, read in place there, copied by the gateways only.
//!
//! The program knows nothing of the network. `two_hosts.sh 5 remote_image` runs `remote_image send` on one host and
//! `remote_image receive 5` on another.
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::sensor_msgs::msg::{Image, ImageSizes};
use tautline::std_msgs::msg::HeaderSizes;
use tautline::{CallbackOptions, Context, Limits, Node, Qos, Result};
use tautline_examples::{context, exit_code};

const WIDTH: u32 = 1280;
const HEIGHT: u32 = 720;

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let (role, images) = (arguments.next(), arguments.next().and_then(|n| n.parse().ok()));
    match role.as_deref() {
        Some("send") => exit_code(context().and_then(|context| send(context, images.unwrap_or(usize::MAX)))),
        Some("receive") => exit_code(context().and_then(|context| receive(context, images.unwrap_or(5)))),
        _ => {
            eprintln!("usage: remote_image send|receive [images]");
            ExitCode::from(2)
        }
    }
}

fn node(context: &Context, name: &str) -> Result<Node> {
    let mut node = Node::create(context.clone(), name, "")?;
    let limits = Limits { message_bytes: 3 << 20, ..Limits::default() };
    node.set_topic_limits("/camera/image_raw", limits)?;
    Ok(node)
}

fn send(context: Context, images: usize) -> Result<()> {
    let mut node = node(&context, "camera")?;
    let publisher = node.create_publisher::<Image>("/camera/image_raw", Qos::keep_last(2))?;
    let mut timer = node.create_wall_timer(Duration::from_millis(100))?;
    let sizes =
        ImageSizes { header: HeaderSizes { frame_id: 6 }, encoding: 4, data: (WIDTH * HEIGHT * 3) as usize };
    let sender = node.spawn_callback(CallbackOptions::fifo(10).name("camera"), async move {
        for n in 0..images {
            timer.next().await;
            let written = publisher.loan_with(sizes).map(|loan| {
                loan.write(|image| {
                    image.header.frame_id.set("camera")?;
                    image.encoding.set("rgb8")?;
                    image.width.set(WIDTH);
                    image.height.set(HEIGHT);
                    image.step.set(WIDTH * 3);
                    image.data.slice_mut().fill(n as u8);
                    image.default_rest();
                    Ok(())
                })
            });
            match written {
                Ok(Ok(loan)) => drop(loan.publish().inspect_err(|error| eprintln!("{error}"))),
                Ok(Err(error)) => eprintln!("{error}"),
                Err(error) => eprintln!("{error}"),
            }
        }
        context.shutdown();
    })?;
    node.spin()?;
    Ok(sender.join()?)
}

fn receive(context: Context, count: usize) -> Result<()> {
    let mut node = node(&context, "viewer")?;
    let images = node.subscribe::<Image>("/camera/image_raw", Qos::keep_last(2))?;
    let mut images = images.take(count);
    let viewer = node.spawn_callback(CallbackOptions::fifo(10).name("viewer"), async move {
        while let Some(sample) = images.next().await {
            // A slice of this host's shared memory, into which the gateway wrote what came.
            let image = sample.view();
            let colour = image.data().first();
            let is_whole = image.data().iter().all(|byte| Some(byte) == colour);
            let (frame, bytes) = (image.header().frame_id(), image.data().len());
            println!("{}x{} {} from {frame}, {bytes} bytes", image.width(), image.height(), image.encoding());
            assert!(is_whole, "pixels of several images");
        }
        context.shutdown();
    })?;
    node.spin()?;
    Ok(viewer.join()?)
}

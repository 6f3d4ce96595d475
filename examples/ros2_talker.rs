//! ROS 2's talker: its listener hears it, from another RMW process or another host, through `taut gateway`.
//!
//!     ros2 run rmw_zenoh_cpp rmw_zenohd                                            # Zenoh's router, as rmw_zenoh wants it
//!     taut gateway                                                                 # finds that router
//!     RMW_IMPLEMENTATION=rmw_zenoh_cpp ros2 run demo_nodes_cpp listener
//!     ros2_talker
// SPDX-License-Identifier: MIT OR Apache-2.0

use futures::StreamExt;
use std::process::ExitCode;
use std::time::Duration;
use tautline::std_msgs::msg::String as Text;
use tautline::{CallbackOptions, Node, Qos, Result};
use tautline_examples::{context, exit_code};

fn main() -> ExitCode {
    exit_code(talk())
}

fn talk() -> Result<()> {
    let context = context()?;
    let mut node = Node::create(context, "talker", "")?;
    let publisher = node.create_publisher::<Text>("/chatter", Qos::default())?;
    let timer = node.create_wall_timer(Duration::from_millis(500))?;
    let mut number = 0;
    node.spawn_callback(
        CallbackOptions::fifo(10).name("talker"),
        timer.for_each(move |_| {
            number += 1;
            let message = Text { data: format!("Hello World: {number}") };
            match publisher.publish(&message) {
                Ok(()) => println!("Publishing: '{}'", message.data),
                Err(error) => eprintln!("{error}"),
            }
            std::future::ready(())
        }),
    )?;
    node.spin() // until Ctrl-C
}

// SPDX-License-Identifier: MIT OR Apache-2.0
use tautline_msgs::Message;

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/Tick", crate = "tautline_msgs")]
struct Tick {
    count: u64,
}

#[derive(Message, Clone, Copy)]
#[message(crate = "tautline_msgs")]
enum Mode {
    Off,
}

fn main() {}

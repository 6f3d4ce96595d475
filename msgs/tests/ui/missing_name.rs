// SPDX-License-Identifier: MIT OR Apache-2.0
use tautline_msgs::Message;

#[derive(Message, Clone, Copy)]
#[message(crate = "tautline_msgs")]
#[repr(C)]
struct Tick {
    count: u64,
}

#[derive(Message, Clone, Copy)]
#[message(name = "Tock", crate = "tautline_msgs")]
#[repr(C)]
struct Tock {
    count: u64,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo__msgs/msg/Tack", crate = "tautline_msgs")]
#[repr(C)]
struct Tack {
    count: u64,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/Tuck_", crate = "tautline_msgs")]
#[repr(C)]
struct Tuck {
    count: u64,
}

fn main() {}

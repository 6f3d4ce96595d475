// SPDX-License-Identifier: MIT OR Apache-2.0
use tautline_msgs::Message;

#[derive(Message, Clone)]
#[message(name = "demo_msgs/msg/Text", crate = "tautline_msgs")]
#[repr(C)]
struct Text {
    data: String,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/Timed", crate = "tautline_msgs")]
#[repr(C)]
struct Timed {
    count: u8,
    elapsed: std::time::Duration,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/Count", crate = "tautline_msgs")]
#[repr(C)]
struct Count {
    data: [usize; 2],
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/Generic", crate = "tautline_msgs")]
#[repr(C)]
struct Generic<T> {
    data: T,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/Packed", crate = "tautline_msgs")]
#[repr(C, packed)]
struct Packed {
    data: u64,
}

fn main() {}

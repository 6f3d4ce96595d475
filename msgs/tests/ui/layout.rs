// SPDX-License-Identifier: MIT OR Apache-2.0
//! C pads nested structs where CDR does not.
use tautline_msgs::Message;

#[derive(Message, Clone, Copy)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct SmallFirst {
    flag: bool,
    value: f64,
}

#[derive(Message, Clone, Copy)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct SmallLast {
    value: f64,
    flag: bool,
}

#[derive(Message, Clone, Copy)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct SmallAround {
    flag: bool,
    value: f64,
    last: u16,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/PaddedBefore", crate = "tautline_msgs")]
#[repr(C)]
struct PaddedBefore {
    id: u8,
    inner: SmallFirst,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/PaddedAfter", crate = "tautline_msgs")]
#[repr(C)]
struct PaddedAfter {
    inner: [SmallLast; 2],
    id: u8,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/PaddedBetween", crate = "tautline_msgs")]
#[repr(C)]
struct PaddedBetween {
    inner: [SmallAround; 2],
}

fn main() {}

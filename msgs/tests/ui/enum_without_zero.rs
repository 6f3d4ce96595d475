// SPDX-License-Identifier: MIT OR Apache-2.0
use tautline_msgs::Message;

#[derive(Message, Clone, Copy)]
#[message(crate = "tautline_msgs")]
#[repr(u8)]
enum Gear {
    First = 1,
    Second,
}

fn main() {}

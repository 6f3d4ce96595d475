// SPDX-License-Identifier: MIT OR Apache-2.0
//! The layout computed here is the one that `tautline-msgs` proves for Rust structs.

use tautline_msgs::{Message, Plain};
use tautline_schema::{Layout, Schema, Size};

#[derive(Message, Clone, Copy)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct Time {
    sec: i32,
    nanosec: u32,
}

#[derive(Message, Clone, Copy)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct Tail {
    value: u16,
    flag: bool,
}

#[derive(Message, Clone, Copy)]
#[message(name = "demo_msgs/msg/Demo", crate = "tautline_msgs")]
#[repr(C)]
struct Demo {
    id: u8,
    stamp: Time,
    points: [[f64; 2]; 3],
    small: i16,
    tails: [Tail; 5],
    last: Tail,
}

const TEXT: &str = "uint8 id\nTime stamp\nfloat64[6] points\nint16 small\nTail[5] tails\nTail last\n===\n\
                    MSG: demo_msgs/Time\nint32 sec\nuint32 nanosec\n===\nMSG: demo_msgs/Tail\nuint16 value\nbool flag\n";

#[test]
fn layouts_agree() {
    let schema = Schema::from_text(&Demo::TYPE_NAME.parse().unwrap(), TEXT).unwrap();
    let layout = Layout::of(&schema);
    let plain = layout.plain.unwrap();
    assert_eq!((plain.size, plain.align), (size_of::<Demo>(), align_of::<Demo>()));
    assert_eq!((plain.cdr_size, plain.first_align), (Demo::CDR_SIZE, Demo::FIRST_ALIGN));
    assert_eq!(layout.size, Size::Fixed(Demo::CDR_SIZE));
    let offsets: Vec<_> = layout.fields.iter().map(|field| field.offset.clone()).collect();
    let theirs = [
        std::mem::offset_of!(Demo, id),
        std::mem::offset_of!(Demo, stamp),
        std::mem::offset_of!(Demo, points),
        std::mem::offset_of!(Demo, small),
        std::mem::offset_of!(Demo, tails),
        std::mem::offset_of!(Demo, last),
    ];
    assert_eq!(offsets, theirs.map(Size::Fixed));
}

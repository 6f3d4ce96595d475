// SPDX-License-Identifier: MIT OR Apache-2.0
//! Definitions of types that are only written in Rust.

use tautline_msgs::{Message, definition_text};

#[derive(Message, Clone, Copy)]
#[repr(i16)]
#[message(crate = "tautline_msgs")]
#[allow(dead_code)]
enum Mode {
    Idle = 0,
    Driving = -3,
}

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(nested, crate = "tautline_msgs")]
struct Wheel {
    slip: [f32; 2],
}

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "base_msgs/msg/Axle", crate = "tautline_msgs")]
struct Axle {
    left: Wheel,
    right: Wheel,
}

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "car_msgs/msg/Car", crate = "tautline_msgs")]
struct Car {
    matrix: [[[f64; 2]; 3]; 4],
    axles: [Axle; 2],
    first: Wheel,
    letter: char,
    r#type: Mode,
    is_on: bool,
    name: [u8; 8],
}

#[test]
fn a_derived_type_has_the_definition_of_its_fields() {
    let line = "=".repeat(80);
    let expected = format!(
        "float64[24] matrix\nbase_msgs/Axle[2] axles\ncar_msgs/Wheel first\nuint32 letter\nint16 type\nbool is_on\nuint8[8] name\n\
         {line}\nMSG: base_msgs/Axle\ncar_msgs/Wheel left\ncar_msgs/Wheel right\n{line}\nMSG: car_msgs/Wheel\nfloat32[2] slip\n"
    );
    assert_eq!(definition_text::<Car>(), Some(expected));
}

mod other {
    use super::*;

    #[derive(Message, Clone, Copy)]
    #[repr(C)]
    #[message(nested, crate = "tautline_msgs")]
    pub struct Wheel {
        pub slip: f32,
    }
}

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "car_msgs/msg/Two", crate = "tautline_msgs")]
struct Two {
    one: Wheel,
    other: other::Wheel,
}

#[test]
fn two_structs_of_one_name_have_no_definition_together() {
    assert_eq!(definition_text::<Two>(), None);
}

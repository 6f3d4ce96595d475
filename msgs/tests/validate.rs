// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bytes that no value has are refused before a reference to them exists.
#![forbid(unsafe_code)]

use tautline_msgs::{Invalid, Message, Plain, from_bytes, write_cdr};

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "test_msgs/msg/Outer", crate = "tautline_msgs")]
#[repr(C)]
struct Outer {
    stamp_ns: u64,
    inner: [Inner; 3],
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct Inner {
    letter: char,
    flags: [bool; 2],
    gear: Gear,
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(crate = "tautline_msgs")]
#[repr(u8)]
enum Gear {
    Neutral,
    First,
    Reverse = 255,
}

#[repr(align(8))]
struct Body([u8; 32]);

/// Zeroed bytes with `bytes` written at `offset`.
fn body(offset: usize, bytes: &[u8]) -> Body {
    let mut body = Body([0; 32]);
    body.0[offset..offset + bytes.len()].copy_from_slice(bytes);
    body
}

#[track_caller]
fn refused(offset: usize, bytes: &[u8], value: i64, type_name: &'static str) {
    let fault = Invalid::Value { offset, value, type_name };
    assert_eq!(from_bytes::<Outer>(&body(offset, bytes).0), Err(fault));
    assert_eq!(Outer::validate(&body(offset, bytes).0), Err(fault));
}

#[test]
fn zeroed_memory_is_a_value() {
    let inner = Inner { letter: '\0', flags: [false; 2], gear: Gear::Neutral };
    assert_eq!(from_bytes::<Outer>(&body(0, &[]).0), Ok(&Outer { stamp_ns: 0, inner: [inner; 3] }));
}

#[test]
fn a_bool_is_0_or_1() {
    refused(8 + 4, &[2], 2, "bool");
    refused(8 + 8 + 5, &[255], 255, "bool");
    refused(8 + 16 + 5, &[128], 128, "bool");
    assert!(from_bytes::<Outer>(&body(8 + 5, &[1]).0).is_ok_and(|outer| outer.inner[0].flags[1]));
}

#[test]
fn a_char_is_a_unicode_scalar_value() {
    refused(8, &0xD800_u32.to_le_bytes(), 0xD800, "char");
    refused(8 + 8, &0x11_0000_u32.to_le_bytes(), 0x11_0000, "char");
    refused(8 + 16, &u32::MAX.to_le_bytes(), u32::MAX.into(), "char");
    assert!(from_bytes::<Outer>(&body(8, &0x10_FFFF_u32.to_le_bytes()).0).is_ok());
}

#[test]
fn an_enum_is_one_of_its_variants() {
    refused(8 + 6, &[2], 2, "Gear");
    refused(8 + 16 + 6, &[254], 254, "Gear");
    assert!(
        from_bytes::<Outer>(&body(8 + 8 + 6, &[255]).0)
            .is_ok_and(|outer| outer.inner[1].gear == Gear::Reverse)
    );
}

#[test]
fn the_first_fault_is_reported_in_words() {
    let fault = from_bytes::<Outer>(&body(12, &[2, 2]).0).expect_err("two invalid flags");
    let text = "byte 12 of the body holds 2, which is not a `bool`: its publisher wrote another type";
    assert_eq!(fault.to_string(), text);
}

#[test]
fn padding_is_not_looked_at() {
    assert!(from_bytes::<Outer>(&body(8 + 7, &[0xFF]).0).is_ok());
}

#[test]
fn short_and_misaligned_bytes_are_refused() {
    let body = body(0, &[]);
    assert_eq!(size_of::<Outer>(), 32);
    assert!(matches!(from_bytes::<Outer>(&body.0[..31]), Err(Invalid::Length { needed: 32, len: 31, .. })));
    assert!(matches!(from_bytes::<u64>(&body.0[4..]), Err(Invalid::Alignment { align: 8, .. })));
    assert_eq!(from_bytes::<u32>(&body.0[4..]), Ok(&0));
    // `validate` needs the last primitive, not the padding, and never reads past the end.
    for len in 0..Outer::CDR_SIZE {
        assert!(matches!(Outer::validate(&body.0[..len]), Err(Invalid::Length { .. })), "{len}");
    }
    assert_eq!(Outer::validate(&body.0[..Outer::CDR_SIZE]), Ok(()));
}

#[test]
fn a_short_buffer_is_left_alone() {
    let mut out = [7; 7];
    let fault = Invalid::Length { type_name: "u64", needed: 8, len: 7 };
    assert_eq!(write_cdr(&1_u64, &mut out), Err(fault));
    assert_eq!(out, [7; 7]);
}

macro_rules! frame {
    ($name:ident, $text:literal, $half:expr) => {
        #[derive(Message, Clone, Copy)]
        #[message(name = $text, crate = "tautline_msgs")]
        #[repr(C)]
        struct $name {
            data: [u16; $half * 2],
        }
    };
}

frame!(Frame, "test_msgs/msg/Frame", 1 + 2);

/// `1 + 2 * 2` would be 5 numbers.
#[test]
fn a_macro_of_the_user_passes_a_length() {
    assert_eq!((size_of::<Frame>(), Frame::CDR_SIZE, Frame::FIXED_LEN), (12, 12, Some(12)));
    let frame = Frame { data: [7; 6] };
    assert_eq!((frame.cdr_len(), frame.to_cdr().unwrap().len()), (12, 16));
}

#[test]
fn padding_is_cleared_and_nothing_else() {
    let mut memory = [0xaa; size_of::<Outer>()];
    Outer::clear_padding(&mut memory);
    let kept: Vec<_> = (0..Outer::CDR_SIZE).filter(|&byte| memory[byte] == 0xaa).collect();
    assert_eq!(kept.len(), Outer::CONTENT_SIZE);
    // What the fields write is what is kept.
    let outer: Outer = *from_bytes(&body(0, &[]).0).unwrap_or_else(|fault| panic!("{fault}"));
    let mut written = [0x55; size_of::<Outer>()];
    outer.write_fields(&mut written);
    let content: Vec<_> = (0..Outer::CDR_SIZE).filter(|&byte| written[byte] == 0).collect();
    assert_eq!(kept, content);
}

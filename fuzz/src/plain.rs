// SPDX-License-Identifier: MIT OR Apache-2.0
//! Structs whose memory is their CDR, with every field that not all bytes are a value of.

use std::fmt::Debug;

use tautline_msgs::cdr::{DecodeFault, Endian};
use tautline_msgs::{Body, Message, Plain, from_bytes, write_cdr};

use crate::allocations::Limit;
use crate::input::Input;
use crate::memory::Memory;

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Outer", crate = "tautline_msgs")]
#[repr(C)]
struct Outer {
    stamp_ns: u64,
    inner: [Inner; 3],
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Inner", crate = "tautline_msgs")]
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

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(crate = "tautline_msgs")]
#[repr(i32)]
enum Level {
    Lowest = i32::MIN,
    None = 0,
    Highest = i32::MAX,
}

/// Padding before, between and after.
#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Padded", crate = "tautline_msgs")]
#[repr(C)]
struct Padded {
    valid: bool,
    level: Level,
    count: u16,
    letters: [char; 2],
    end: u64,
    last: bool,
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Numbers", crate = "tautline_msgs")]
#[repr(C)]
struct Numbers {
    a: i8,
    b: u16,
    c: [i32; 3],
    d: [i64; 2],
    e: i16,
}

/// An array is decoded into a list first.
const ARRAYS: Limit = Limit { multiple: 2, fixed: 0 };

/// Reads bytes in place. The flags choose how far from a multiple of 8 they start.
pub fn plain(input: &[u8]) {
    let Some(input) = Input::new(input) else { return };
    let checks = [check::<Outer>, check::<Inner>, check::<Padded>, check::<Numbers>];
    input.choose(&checks)(&input);
}

fn check<T: Plain + Message + Debug + PartialEq>(input: &Input<'_>) {
    let bytes = input.rest;
    let shift = usize::from(input.flags & 7);
    let mut shifted = Memory::new(shift + bytes.len(), 0);
    shifted.bytes_mut()[shift..].copy_from_slice(bytes);
    let moved = &shifted.bytes()[shift..];
    let memory = Memory::with(bytes, bytes.len(), 0);

    let valid = Limit::NONE.check(0, || T::validate(bytes));
    let read = Limit::NONE.check(0, || from_bytes::<T>(memory.bytes()));
    if bytes.len() >= size_of::<T>() {
        assert_eq!(read.map(|_| ()), valid);
    } else {
        assert!(read.is_err());
    }
    assert_eq!(T::validate(moved), valid);
    if let Ok(value) = from_bytes::<T>(moved) {
        assert_eq!(read.map(|read| encoded(read)), Ok(encoded(value)));
    }

    let decoded = ARRAYS.check(bytes.len(), || T::decode(bytes, Endian::Little));
    match (&decoded, valid) {
        (Ok(value), Ok(())) => {
            let again = T::decode(&encoded(value), Endian::Little);
            assert_eq!(again.as_ref(), Ok(value));
            let trailing = bytes.len() - T::CDR_SIZE;
            assert!(trailing <= 8, "{trailing}");
            let mut cleared = Memory::with(&bytes[..T::CDR_SIZE], size_of::<T>(), 0);
            T::clear_padding(cleared.bytes_mut());
            assert_eq!(&cleared.bytes()[..T::CDR_SIZE], encoded(value));
        }
        // Numbers are valid, but may be missing.
        (Err(_), Ok(())) if bytes.len() < T::CDR_SIZE => {}
        (Err(error), Ok(())) => assert!(matches!(error.fault, DecodeFault::Trailing { .. }), "{error}"),
        (Ok(_), Err(fault)) => panic!("decoded what is not valid: {fault}"),
        (Err(_), Err(_)) => {}
    }
    let room = Memory::with(bytes, bytes.len().next_multiple_of(8), 0xee);
    let body = Body::new(room.bytes(), bytes.len()).expect("aligned and as long as it says");
    assert_eq!(T::view(body).map(|_| ()), decoded.map(|_| ()));
    let _ = T::decode(bytes, Endian::Big).map(|value| encoded(&value));
}

fn encoded<T: Plain + Message>(value: &T) -> Vec<u8> {
    let mut memory = Memory::new(T::CDR_SIZE, 0xaa);
    assert_eq!(write_cdr(value, memory.bytes_mut()), Ok(T::CDR_SIZE));
    let bytes = memory.bytes().to_vec();
    assert_eq!(value.encode(memory.bytes_mut()), Ok(T::CDR_SIZE));
    assert_eq!(memory.bytes(), bytes);
    bytes
}

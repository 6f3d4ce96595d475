// SPDX-License-Identifier: MIT OR Apache-2.0
//! Owned messages: bytes, bad bytes, bounds, allocation. That they equal ROS 2's, `tautline-ros-msgs` shows.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use tautline_msgs::cdr::{Bounded, Cdr, DecodeError, DecodeFault, EncodeFault, Endian, WString};
use tautline_msgs::{cdr_struct, serde_fields};

#[derive(Clone, Debug, PartialEq)]
struct Empty {}

#[derive(Clone, Debug, PartialEq)]
struct Point {
    x: f64,
    name: String,
}

#[derive(Clone, Debug, PartialEq)]
struct Demo {
    id: u8,
    path: Vec<Point>,
    data: Vec<u8>,
    ok: bool,
    wide: String,
    r#type: [u16; 2],
    last: Vec<f64>,
    flags: Vec<bool>,
    empty: Vec<Empty>,
}

cdr_struct! { "demo_msgs/msg/Empty", "RIHS01_00"; Empty {} }
cdr_struct! { "demo_msgs/msg/Point", "RIHS01_00"; Point { x: f64, name: Bounded<String, 2> } }
cdr_struct! {
    "demo_msgs/msg/Demo", "RIHS01_00";
    Demo {
        id: u8,
        path: Vec<Point>,
        data: Bounded<Vec<u8>, 4>,
        ok: bool,
        wide: Bounded<WString, 3>,
        r#type: [u16; 2],
        last: Vec<f64>,
        flags: Vec<bool>,
        empty: Vec<Empty>,
    }
}

fn demo() -> Demo {
    Demo {
        id: 7,
        path: vec![Point { x: 1.0, name: "aé".to_owned() }],
        data: vec![1, 255],
        ok: true,
        wide: "é😀".to_owned(),
        r#type: [0x1234, 1],
        last: vec![-2.0],
        flags: vec![true, false],
        empty: vec![Empty {}; 2],
    }
}

#[rustfmt::skip]
const BODY: [u8; 87] = [
    7, 0, 0, 0, 1, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0xf0, 0x3f, 4, 0, 0, 0, b'a', 0xc3, 0xa9, 0,
    2, 0, 0, 0, 1, 255, 1, 0,
    3, 0, 0, 0, 0xe9, 0, 0, 0, 0x3d, 0xd8, 0, 0, 0, 0xde, 0, 0,
    0x34, 0x12, 1, 0, 1, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0, 0xc0,
    2, 0, 0, 0, 1, 0, 0, 0,
    2, 0, 0, 0, 0, 0, // two empty messages of a byte each
    0, 0, 0, 0, 0, 0, 0, 0, 0,
];
const LEN: usize = 78;

#[test]
fn bytes_are_those_of_the_wire() {
    let mut out = [0xaa; LEN + 2];
    assert_eq!(demo().cdr_len(), LEN);
    assert_eq!(demo().encode(&mut out), Ok(LEN));
    assert_eq!(out[..LEN], BODY[..LEN]);
    assert_eq!(out[LEN..], [0xaa; 2]);
    assert_eq!(demo().to_cdr().unwrap()[..4], [0, 1, 0, 0]);
    assert_eq!(Demo::from_cdr(&demo().to_cdr().unwrap()), Ok(demo()));
    let error = demo().encode(&mut out[..LEN - 1]).unwrap_err();
    assert_eq!((error.field, error.fault), ("empty", EncodeFault::Room { needed: LEN, len: LEN - 1 }));
}

#[test]
fn big_endian_is_decoded() {
    let mut big = BODY;
    // Every number of more than one byte: where it starts and how long it is.
    for (start, len) in [
        (4, 4),
        (8, 8),
        (16, 4),
        (24, 4),
        (32, 4),
        (36, 4),
        (40, 4),
        (44, 4),
        (48, 2),
        (50, 2),
        (52, 4),
        (56, 8),
        (64, 4),
        (72, 4),
    ] {
        big[start..start + len].reverse();
    }
    assert_eq!(Demo::decode(&big[..LEN], Endian::Big), Ok(demo()));
}

#[test]
fn bad_bytes_have_a_field_and_an_offset() {
    for end in 0..LEN {
        let error = Demo::decode(&BODY[..end], Endian::Little).unwrap_err();
        assert!(matches!(error.fault, DecodeFault::End { .. }), "{end}: {error}");
        assert!(error.offset <= end.next_multiple_of(8), "{end}: {error}");
    }
    let changed = |at: usize, bytes: &[u8]| {
        let mut body = BODY;
        body[at..at + bytes.len()].copy_from_slice(bytes);
        let DecodeError { type_name, field, offset, fault } =
            Demo::decode(&body[..LEN], Endian::Little).unwrap_err();
        (type_name.rsplit('/').next().unwrap(), field, offset, fault)
    };
    assert_eq!(
        changed(4, &[255; 4]),
        ("Demo", "path", 8, DecodeFault::End { needed: 12 * u32::MAX as usize, left: 70 })
    );
    assert_eq!(changed(21, &[0x80]), ("Point", "name", 21, DecodeFault::Unicode));
    assert_eq!(changed(21, b"bc"), ("Point", "name", 20, DecodeFault::Bound { len: 3, bound: 2 }));
    assert_eq!(changed(23, b"x"), ("Point", "name", 24, DecodeFault::Terminator));
    assert_eq!(changed(24, &[5]), ("Demo", "data", 24, DecodeFault::Bound { len: 5, bound: 4 }));
    assert_eq!(changed(30, &[2]), ("Demo", "ok", 30, DecodeFault::Bool { value: 2 }));
    assert_eq!(changed(38, &[1]), ("Demo", "wide", 36, DecodeFault::Unicode));
    assert_eq!(changed(41, &[0]), ("Demo", "wide", 36, DecodeFault::Unicode));
    assert_eq!(changed(69, &[9]), ("Demo", "flags", 69, DecodeFault::Bool { value: 9 }));
    let error = Demo::decode(&BODY[..50], Endian::Little).unwrap_err();
    assert_eq!(
        error.to_string(),
        "`demo_msgs/msg/Demo`: at byte 48 of the body, field `type`: 4 bytes are needed but 2 are left: the message is \
         cut off, or of another type"
    );
}

#[test]
fn headers_and_trailing_bytes_are_checked() {
    for header in [&[][..], &[0], &[0, 1, 0], &[0, 3, 0, 0, 1], &[1, 1, 0, 0]] {
        let error = Demo::from_cdr(header).unwrap_err();
        assert!(matches!(error.fault, DecodeFault::Encapsulation { .. }), "{error}");
    }
    let with = |mut demo: Demo, last: &[f64], trailing: usize| {
        demo.last = last.to_vec();
        let mut bytes = demo.to_cdr().unwrap();
        bytes.resize(bytes.len() + trailing, 0xee);
        Demo::from_cdr(&bytes).map(|_| ()).map_err(|error| error.fault)
    };
    // A `wstring` explains 8 more bytes, an empty sequence of 8-byte numbers as well.
    assert_eq!(with(demo(), &[1.0], 16), Ok(()));
    assert_eq!(with(demo(), &[1.0], 17), Err(DecodeFault::Trailing { len: 17, most: 16 }));
    assert_eq!(with(demo(), &[], 24), Ok(()));
    assert_eq!(with(demo(), &[], 25), Err(DecodeFault::Trailing { len: 25, most: 24 }));
}

#[test]
fn bounds_are_checked_when_encoding() {
    let bound = |change: fn(&mut Demo)| {
        let mut demo = demo();
        change(&mut demo);
        let error = demo.to_cdr().unwrap_err();
        (error.type_name.rsplit('/').next().unwrap(), error.field, error.fault)
    };
    let fault = |len, bound| EncodeFault::Bound { len, bound };
    assert_eq!(bound(|demo| demo.data = vec![0; 5]), ("Demo", "data", fault(5, 4)));
    assert_eq!(bound(|demo| demo.wide = "abcd".to_owned()), ("Demo", "wide", fault(4, 3)));
    assert_eq!(bound(|demo| demo.path[0].name = "abc".to_owned()), ("Point", "name", fault(3, 2)));
}

#[test]
fn serde_knows_all_floats_and_long_arrays() {
    #[derive(serde::Serialize, serde::Deserialize)]
    struct Floats {
        #[serde(with = "serde_fields::float")]
        one: f32,
        #[serde(with = "serde_fields::float")]
        many: [f64; 40],
        #[serde(with = "serde_fields::float")]
        list: Vec<f64>,
        #[serde(with = "serde_fields::array")]
        names: [String; 33],
    }
    let names = std::array::from_fn(|index| index.to_string());
    let list = vec![f64::INFINITY, f64::NEG_INFINITY, -0.0, 5.0];
    let json = serde_json::to_string(&Floats { one: f32::NAN, many: [0.1; 40], list, names }).unwrap();
    assert!(json.starts_with(r#"{"one":"NaN","many":[0.1,"#), "{json}");
    assert!(json.contains(r#""list":["Infinity","-Infinity",-0.0,5.0]"#), "{json}");
    let again: Floats = serde_json::from_str(&json).unwrap();
    assert!(again.one.is_nan() && again.many == [0.1; 40] && again.names[32] == "32");
    assert_eq!(serde_json::to_string(&again).unwrap(), json);
    for wrong in [json.replace("NaN", "nan"), json.replace("[0.1,", "["), json.replace("[0.1,", "[0.1,0.1,")]
    {
        assert!(serde_json::from_str::<Floats>(&wrong).is_err());
    }
}

/// Remembers the largest allocation of this thread, and counts them.
struct Counting;

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
    static COUNT: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: forwards to the system's allocator, unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.set(LARGEST.get().max(layout.size()));
        COUNT.set(COUNT.get() + 1);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn encoding_does_not_allocate() {
    let demo = demo();
    let mut out = [0; 100];
    COUNT.set(0);
    for _ in 0..10_000 {
        let len = std::hint::black_box(&demo).cdr_len();
        assert!(demo.encode(&mut out[..len]).is_ok());
    }
    assert_eq!(COUNT.get(), 0);
}

#[test]
fn lengths_are_not_believed() {
    // The length of each sequence and string, in a message that is long enough to start reading it.
    for at in [4, 16, 24, 32, 52, 64, 72] {
        for tail in [0, 64, 4096] {
            for len in [tail as u32 / 16, tail as u32, 1 << 20, 1 << 31, u32::MAX] {
                let mut body = BODY[..LEN].to_vec();
                body.resize(LEN + tail, 1);
                body[at..at + 4].copy_from_slice(&len.to_le_bytes());
                LARGEST.set(0);
                let result = Demo::decode(&body, Endian::Little);
                // A vector of elements that are shorter in CDR than in memory doubles as they are read.
                let most = 2 * body.len() * size_of::<Point>() / 12;
                assert!(
                    LARGEST.get() <= most,
                    "{at}: {} for {}, {}",
                    LARGEST.get(),
                    body.len(),
                    result.is_ok()
                );
            }
        }
    }
}

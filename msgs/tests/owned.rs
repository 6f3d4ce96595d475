// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages of any size, owned and in place: bytes, bad bytes, bounds, allocation. That they equal ROS 2's,
//! `tautline-ros-msgs` shows.
#![allow(missing_docs, reason = "a test")]

#[path = "support/heap.rs"]
mod heap;

use std::cell::Cell;

use tautline_msgs::cdr::{
    self, Bounded, DecodeError, DecodeFault, EncodeFault, Endian, Seq, WStr, WString, WriteError, WriteFault,
};
use tautline_msgs::{Body, Message, cdr_form, in_place, message, serde_fields};

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Empty {}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Point {
    x: f64,
    name: String,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Demo {
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

cdr_form! { "demo_msgs/msg/Empty"; Empty {} }
in_place! { "demo_msgs/msg/Empty"; Empty EmptyRef EmptyWriter (); {} }
message! { EmptyRef Empty "demo_msgs/msg/Empty" { "RIHS01_00", "", [] } }
cdr_form! { "demo_msgs/msg/Point"; Point { x: f64, name: Bounded<String, 2> } }
in_place! {
    "demo_msgs/msg/Point";
    Point PointRef PointWriter PointSizes;
    { x: f64 as f64 [], name: Bounded<String, 2> as &'a str [name], }
}
message! { PointRef Point "demo_msgs/msg/Point" { "RIHS01_00", "float64 x\nstring<=2 name\n", [] } }
cdr_form! {
    "demo_msgs/msg/Demo";
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
in_place! {
    "demo_msgs/msg/Demo";
    Demo DemoRef DemoWriter DemoSizes<'s>;
    {
        id: u8 as u8 [],
        path: Vec<Point> as Seq<'a, Point> [path],
        data: Bounded<Vec<u8>, 4> as &'a [u8] [data],
        ok: bool as bool [],
        wide: Bounded<WString, 3> as WStr<'a> [wide],
        r#type: [u16; 2] as &'a [u16; 2] [],
        last: Vec<f64> as &'a [f64] [last],
        flags: Vec<bool> as &'a [bool] [flags],
        empty: Vec<Empty> as Seq<'a, Empty> [empty],
    }
}
message! { DemoRef Demo "demo_msgs/msg/Demo" { "RIHS01_00", "not needed here", [Point, Empty] } }

#[derive(Clone, Copy, Default)]
pub struct PointSizes {
    name: usize,
}

#[derive(Clone, Copy, Default)]
pub struct DemoSizes<'s> {
    path: &'s [PointSizes],
    data: usize,
    wide: usize,
    last: usize,
    flags: usize,
    empty: &'s [()],
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

/// Where a body can be read in place.
#[repr(align(8))]
struct Aligned<const N: usize>([u8; N]);

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
    // Every number of more than one byte: how long it is and where it starts.
    for (len, starts) in [(2, &[48, 50][..]), (4, &[4, 16, 24, 32, 36, 40, 44, 52, 64, 72]), (8, &[8, 56])] {
        starts.iter().for_each(|&start| big[start..start + len].reverse());
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
        let owned = Demo::decode(&body[..LEN], Endian::Little).unwrap_err();
        let body = Aligned(body);
        let viewed = Demo::view(Body::new(&body.0, LEN).unwrap()).unwrap_err();
        assert_eq!(owned, viewed);
        let DecodeError { type_name, path, offset, fault } = owned;
        assert_eq!(type_name, "demo_msgs/msg/Demo");
        (path.to_string(), offset, fault)
    };
    let at = |path: &str, offset, fault| (path.to_owned(), offset, fault);
    assert_eq!(
        changed(4, &[255; 4]),
        at("path", 8, DecodeFault::End { needed: 12 * u32::MAX as usize, left: 70 })
    );
    assert_eq!(changed(21, &[0x80]), at("path[0].name", 21, DecodeFault::Unicode));
    assert_eq!(changed(21, b"bc"), at("path[0].name", 20, DecodeFault::Bound { len: 3, bound: 2 }));
    assert_eq!(changed(23, b"x"), at("path[0].name", 24, DecodeFault::Terminator));
    assert_eq!(changed(24, &[5]), at("data", 24, DecodeFault::Bound { len: 5, bound: 4 }));
    assert_eq!(changed(30, &[2]), at("ok", 30, DecodeFault::Bool { value: 2 }));
    assert_eq!(changed(38, &[1]), at("wide", 36, DecodeFault::Unicode));
    assert_eq!(changed(41, &[0]), at("wide", 36, DecodeFault::Unicode));
    assert_eq!(changed(69, &[9]), at("flags[1]", 69, DecodeFault::Bool { value: 9 }));
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
fn a_view_reads_what_is_there() {
    let body = Aligned(BODY);
    let view = Demo::view(Body::new(&body.0, LEN).unwrap()).unwrap();
    assert_eq!((view.id(), view.data(), view.ok()), (7, &[1, 255][..], true));
    let names: Vec<_> = view.path().iter().map(|point| (point.x(), point.name())).collect();
    assert_eq!(names, [(1.0, "aé")]);
    assert!(view.path().get(1).is_none() && view.path().len() == 1 && view.wide() == "é😀");
    assert_eq!((view.r#type(), view.last(), view.flags()), (&[0x1234, 1], &[-2.0][..], &[true, false][..]));
    assert_eq!(view.empty().iter().count(), 2);
    // Borrowed, not copied.
    assert_eq!(view.data().as_ptr(), &raw const body.0[28]);
    assert_eq!(view.last().as_ptr().cast(), &raw const body.0[56]);
    assert!(format!("{view:?}").contains("name: \"aé\""));

    let fault = |bytes| Body::new(bytes, LEN).map(|_| ()).unwrap_err();
    assert_eq!(fault(&body.0[1..]), DecodeFault::Alignment { align: 8 });
    assert_eq!(fault(&body.0[..72]), DecodeFault::End { needed: LEN, left: 72 });
    let mut wire = Aligned([0; LEN + 8]);
    wire.0[4..8].copy_from_slice(&[0, 1, 0, 0]);
    wire.0[8..].copy_from_slice(&BODY[..LEN]);
    assert_eq!(Demo::view_cdr(&wire.0[4..]).unwrap().id(), 7);
    wire.0[5] = 0;
    assert_eq!(Demo::view_cdr(&wire.0[4..]).unwrap_err().fault, DecodeFault::BigEndian);
}

/// The sizes of `demo()`.
const SIZES: DemoSizes<'static> =
    DemoSizes { path: &[PointSizes { name: 3 }], data: 2, wide: 3, last: 1, flags: 2, empty: &[(); 2] };

fn write_demo(demo: &mut DemoWriter<'_, '_>) -> Result<(), WriteError> {
    // In any order.
    demo.flags.copy_from(&[true, false])?;
    demo.id.set(7);
    demo.path.each(|_, point| {
        point.name.set("aé")?;
        point.x.set(1.0);
        Ok(())
    })?;
    demo.data.slice_mut().copy_from_slice(&[1, 255]);
    *demo.ok.value_mut() = true;
    demo.wide.set("é😀")?;
    demo.r#type.copy_from(&[0x1234, 1])?;
    demo.last.copy_from(&[-2.0])?;
    demo.empty.each(|_, _| Ok(()))
}

#[test]
fn writing_in_place_gives_the_same_bytes() {
    let mut memory = Aligned([0xaa; LEN + 2]);
    assert_eq!(cdr::sized_len::<Demo>(SIZES), LEN);
    COUNT.set(0);
    let written = cdr::fill::<Demo>(SIZES, &mut memory.0, write_demo);
    assert_eq!((COUNT.get(), written), (0, Ok(LEN)));
    assert_eq!(memory.0[..LEN], BODY[..LEN]);
    assert_eq!(memory.0[LEN..], [0xaa; 2]);

    let default = cdr::fill::<Demo>(DemoSizes::default(), &mut memory.0, |demo| {
        demo.default_rest();
        Ok(())
    });
    assert_eq!(memory.0[..default.unwrap()], Demo::default().to_cdr().unwrap()[4..]);
}

#[test]
fn nothing_is_forgotten_when_writing_in_place() {
    let mut memory = Aligned([0xaa; LEN + 2]);
    let mut written = |sizes, write: fn(&mut DemoWriter<'_, '_>) -> Result<(), WriteError>| {
        let error = cdr::fill::<Demo>(sizes, &mut memory.0, write).unwrap_err();
        (error.type_name.rsplit('/').next().unwrap(), error.field, error.fault)
    };
    assert_eq!(written(SIZES, |_| Ok(())), ("Demo", "id", WriteFault::Unset));
    let name_only = |demo: &mut DemoWriter<'_, '_>| demo.path.each(|_, point| point.name.set("aé"));
    assert_eq!(written(SIZES, name_only), ("Point", "x", WriteFault::Unset));
    let all_defaults = |demo: &mut DemoWriter<'_, '_>| {
        demo.default_rest();
        Ok(())
    };
    assert_eq!(written(SIZES, all_defaults), ("Demo", "path", WriteFault::Unset), "text has a stated length");
    let other_length = |demo: &mut DemoWriter<'_, '_>| demo.wide.set("longer");
    let fault = WriteFault::Length { len: 6, stated: 3 };
    assert_eq!(written(SIZES, other_length), ("Demo", "", fault), "the closure's own error has no field");
    let defaults_first = |demo: &mut DemoWriter<'_, '_>| {
        demo.default_rest();
        demo.empty.each(|_, _| Ok(()))
    };
    assert_eq!(written(SIZES, defaults_first), ("Demo", "", WriteFault::Again), "not passed over");
    let over = DemoSizes { data: 5, ..SIZES };
    let fault = WriteFault::Encode(EncodeFault::Bound { len: 5, bound: 4 });
    assert_eq!(written(over, all_defaults), ("Demo", "data", fault));
    let too_long = DemoSizes { last: usize::MAX / 2, ..SIZES };
    let (_, field, fault) = written(too_long, all_defaults);
    assert!(field == "last" && matches!(fault, WriteFault::Encode(EncodeFault::Length { .. })), "{fault}");
    let no_room = DemoSizes { last: 1 << 20, ..SIZES };
    let (_, field, fault) = written(no_room, all_defaults);
    assert!(field == "last" && matches!(fault, WriteFault::Encode(EncodeFault::Room { .. })), "{fault}");
    // Lengths that add up to more than there are addresses are too long, whatever follows them.
    for field in 0..3 {
        let mut sizes = SIZES;
        *[&mut sizes.data, &mut sizes.wide, &mut sizes.last][field] = usize::MAX;
        assert_eq!(cdr::sized_len::<Demo>(sizes), usize::MAX);
        assert!(matches!(written(sizes, all_defaults).2, WriteFault::Encode(_)));
    }
    let huge = DemoSizes { path: &[PointSizes { name: usize::MAX }; 2], ..SIZES };
    assert_eq!(cdr::sized_len::<Demo>(huge), usize::MAX);
    let (_, field, fault) = written(huge, all_defaults);
    assert!(field == "path" && matches!(fault, WriteFault::Encode(EncodeFault::Room { .. })), "{fault}");
    let odd = cdr::fill::<Demo>(SIZES, &mut memory.0[1..], write_demo).unwrap_err();
    assert_eq!(odd.fault, WriteFault::Encode(EncodeFault::Alignment { align: 8 }));
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

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
    static COUNT: Cell<usize> = const { Cell::new(0) };
}

#[global_allocator]
static ALLOCATOR: heap::Watched = heap::Watched(|bytes| {
    LARGEST.set(LARGEST.get().max(bytes.unwrap_or_default()));
    COUNT.set(COUNT.get() + usize::from(bytes.is_some()));
});

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

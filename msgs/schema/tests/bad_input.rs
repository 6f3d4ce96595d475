// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bytes that are no message, case by case: the owned type, the view and the dynamic message say the same of them, with
//! type, field and byte. (Of definitions, `definitions.rs` says the same; of JSON and YAML, `messages.rs`; of topics whose
//! types differ, `tautline-transport`.)
#![allow(missing_docs, reason = "a test")]

use std::sync::Arc;

use tautline_msgs::cdr::{Bounded, DecodeError, Endian, Seq, WStr, WString};
use tautline_msgs::{Body, Message, cdr_form, dense_struct, in_place, message, plain_struct};
use tautline_schema::{DynamicMessage, MessageError, Schema};

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Point {
    x: f64,
    label: String,
    flags: [bool; 2],
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Demo {
    name: String,
    path: Vec<Point>,
    ok: bool,
    wide: String,
    last: Vec<f64>,
    type_: [u8; 2],
}

#[derive(Clone, Copy, Default)]
pub struct PointSizes {
    label: usize,
}

#[derive(Clone, Copy, Default)]
pub struct DemoSizes<'s> {
    name: usize,
    path: &'s [PointSizes],
    wide: usize,
    last: usize,
}

cdr_form! { "demo_msgs/msg/Point"; Point { x: f64, label: String, flags: [bool; 2] } }
in_place! {
    "demo_msgs/msg/Point";
    Point PointRef PointWriter PointSizes;
    { x: f64 as f64 [], label: String as &'a str [label], flags: [bool; 2] as &'a [bool; 2] [], }
}
cdr_form! {
    "demo_msgs/msg/Demo";
    Demo {
        name: Bounded<String, 1>,
        path: Bounded<Vec<Point>, 2>,
        ok: bool,
        wide: Bounded<WString, 2>,
        last: Vec<f64>,
        type_: [u8; 2],
    }
}
in_place! {
    "demo_msgs/msg/Demo";
    Demo DemoRef DemoWriter DemoSizes<'s>;
    {
        name: Bounded<String, 1> as &'a str [name],
        path: Bounded<Vec<Point>, 2> as Seq<'a, Point> [path],
        ok: bool as bool [],
        wide: Bounded<WString, 2> as WStr<'a> [wide],
        last: Vec<f64> as &'a [f64] [last],
        type_: [u8; 2] as &'a [u8; 2] [],
    }
}
message! { DemoRef Demo "demo_msgs/msg/Demo" {} }

const DEFINITION: &str = "string<=1 name\nPoint[<=2] path\nbool ok\nwstring<=2 wide\nfloat64[] last\nuint8[2] type\n===\n\
    MSG: demo_msgs/Point\nfloat64 x\nstring label\nbool[2] flags\n";

#[rustfmt::skip]
const BODY: [u8; LEN] = [
    3, 0, 0, 0, 0xc3, 0xa9, 0, 0, // name
    1, 0, 0, 0, 0, 0, 0, 0, // path
    0, 0, 0, 0, 0, 0, 0xf0, 0x3f, 2, 0, 0, 0, b'b', 0, 1, 0, // path[0]
    1, 0, 0, 0, 1, 0, 0, 0, 0xe9, 0, 0, 0, // ok, wide
    1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xc0, // last
    7, 8, // type
];
const LEN: usize = 58;

/// Where a body can be read in place.
#[repr(align(8))]
struct Aligned([u8; 96]);

fn schema() -> Arc<Schema> {
    Arc::new(Schema::from_text(&"demo_msgs/msg/Demo".parse().unwrap(), DEFINITION).unwrap())
}

/// What all three say of a body.
fn fault(body: &[u8]) -> Result<(), String> {
    let owned = Demo::decode(body, Endian::Little);
    let mut memory = Aligned([0xee; 96]);
    memory.0[..body.len()].copy_from_slice(body);
    let viewed = <Demo as Message>::view(Body::new(&memory.0, body.len()).unwrap());
    let dynamic = DynamicMessage::from_body(&schema(), body, tautline_schema::Endian::Little);
    let owned = owned.map(|_| ()).map_err(|error: DecodeError| error.to_string());
    assert_eq!(viewed.map(|_| ()).map_err(|error| error.to_string()), owned, "view and owned");
    assert_eq!(dynamic.map(|_| ()).map_err(|error| error.to_string()), owned, "dynamic and owned");
    owned
}

/// That they refuse a body for this reason.
#[track_caller]
fn refused(body: &[u8], place: &str, reason: &str) {
    let said = fault(body).unwrap_err();
    let expected = format!("`demo_msgs/msg/Demo`: at {place}: ");
    assert!(said.starts_with(&expected), "{said}\n{expected}");
    assert!(said[expected.len()..].starts_with(reason), "{said}\n{reason}");
}

fn changed(at: usize, bytes: &[u8]) -> [u8; LEN] {
    let mut body = BODY;
    body[at..at + bytes.len()].copy_from_slice(bytes);
    body
}

#[test]
fn the_message_itself_is_accepted() {
    assert_eq!(fault(&BODY), Ok(()));
    assert_eq!(Demo::decode(&BODY, Endian::Little).unwrap().name, "é");
}

#[test]
fn truncated() {
    let needed =
        |needed, left| format!("{needed} bytes are needed but {left} are left: the message is cut off");
    refused(&BODY[..0], "byte 0 of the body, field `name`", &needed(4, 0));
    refused(&BODY[..5], "byte 4 of the body, field `name`", &needed(3, 1));
    refused(&BODY[..20], "byte 12 of the body, field `path`", &needed(14, 8));
    refused(&BODY[..26], "byte 24 of the body, field `path[0].label`", &needed(4, 2));
    refused(&BODY[..31], "byte 30 of the body, field `path[0].flags`", &needed(2, 1));
    refused(&BODY[..32], "byte 32 of the body, field `ok`", &needed(1, 0));
    refused(&BODY[..43], "byte 40 of the body, field `wide`", &needed(4, 3));
    refused(&BODY[..57], "byte 56 of the body, field `type`", &needed(2, 1));
    for end in 0..LEN {
        assert!(fault(&BODY[..end]).is_err(), "{end}");
    }
}

#[test]
fn a_wrong_encapsulation() {
    for header in [&[][..], &[0], &[0, 1, 0], &[0, 3, 0, 0], &[0, 7, 0, 0], &[1, 1, 0, 0]] {
        let bytes = [header, if header.len() == 4 { &BODY[..] } else { &[] }].concat();
        let owned = Demo::from_cdr(&bytes).unwrap_err();
        assert_eq!(Demo::view_cdr(&bytes).map(|_| ()), Err(owned));
        let start = "`demo_msgs/msg/Demo`: at byte 0 of the body: the header is ";
        assert!(owned.to_string().starts_with(start), "{owned}");
        let dynamic = DynamicMessage::from_cdr(&schema(), &bytes).unwrap_err();
        assert!(matches!(dynamic, MessageError::Encapsulation { .. }), "{dynamic}");
        assert!(dynamic.to_string().starts_with("`demo_msgs/msg/Demo`: the bytes start with "), "{dynamic}");
    }
}

#[test]
fn more_trailing_bytes_than_are_explained() {
    // 8 at the end of any message, 8 for the `wstring`.
    let with = |trailing| [&BODY[..], &[0xee; 32][..trailing]].concat();
    assert_eq!(fault(&with(16)), Ok(()));
    let reason =
        "17 bytes follow the last field, where at most 16 can be padding: the message is of another type";
    refused(&with(17), "byte 58 of the body", reason);
}

#[test]
fn big_endian() {
    let mut bytes = Aligned([0; 96]);
    let body = &mut bytes.0[8..];
    body[..LEN].copy_from_slice(&BODY);
    for (start, len) in [(0, 4), (8, 4), (16, 8), (24, 4), (36, 4), (40, 4), (44, 4), (48, 8)] {
        body[start..start + len].reverse();
    }
    let wire = &bytes.0[4..8 + LEN];
    let owned = Demo::from_cdr(wire).unwrap();
    assert_eq!(owned, Demo::decode(&BODY, Endian::Little).unwrap());
    assert_eq!(DynamicMessage::from_cdr(&schema(), wire).unwrap().to_body(), BODY);
    assert_eq!(
        Demo::view_cdr(wire).unwrap_err().to_string(),
        "`demo_msgs/msg/Demo`: at byte 0 of the body: the message is big-endian, which cannot be read in place: decode it \
         into an owned message"
    );
    // Errors count bytes as in the other order.
    bytes.0[8 + 31] = 2;
    let error = Demo::from_cdr(&bytes.0[4..8 + LEN]).unwrap_err();
    assert_eq!((error.path.to_string().as_str(), error.offset), ("path[0].flags[1]", 31));
}

#[test]
fn a_length_over_its_bound() {
    let reason = |len, bound| {
        format!("its length is {len} but at most {bound} are allowed: its publisher uses another")
    };
    refused(&changed(4, b"ab"), "byte 4 of the body, field `name`", &reason(2, 1));
    refused(&changed(8, &[3]), "byte 8 of the body, field `path`", &reason(3, 2));
    refused(&changed(8, &[255; 4]), "byte 8 of the body, field `path`", &reason(u32::MAX, 2));
    let wide = [&BODY[..36], &[3, 0, 0, 0], &[b'x', 0, 0, 0].repeat(3), &[0; 6]].concat();
    refused(&wide, "byte 40 of the body, field `wide`", &reason(3, 2));
}

#[test]
fn a_length_over_what_there_is() {
    let needed = |needed: u64, left| format!("{needed} bytes are needed but {left} are left");
    let most = u64::from(u32::MAX);
    refused(&changed(0, &[255; 4]), "byte 4 of the body, field `name`", &needed(most, 54));
    refused(&changed(36, &[255; 4]), "byte 40 of the body, field `wide`", &needed(4 * most, 18));
    refused(&changed(44, &[255; 4]), "byte 48 of the body, field `last`", &needed(8 * most, 10));
}

#[test]
fn text_that_is_none() {
    let reason = "its text is not valid Unicode";
    refused(&changed(5, &[0xff]), "byte 4 of the body, field `name`", reason);
    refused(&changed(28, &[0x80]), "byte 28 of the body, field `path[0].label`", reason);
    refused(&changed(40, &[0, 0xd8]), "byte 40 of the body, field `wide`", reason);
    refused(&changed(42, &[1]), "byte 40 of the body, field `wide`", reason);
    // Half of a pair, then what would be the other half if its upper bytes did not count.
    let pair = [&BODY[..36], &[2, 0, 0, 0, 0x3d, 0xd8, 0, 0, 0, 0xde, 0x0e, 0], &[0; 6]].concat();
    refused(&pair, "byte 40 of the body, field `wide`", reason);
    refused(
        &changed(6, b"x"),
        "byte 7 of the body, field `name`",
        "the string does not end with a zero byte",
    );
}

#[test]
fn a_bool_of_2() {
    refused(&changed(32, &[2]), "byte 32 of the body, field `ok`", "2 is not a bool");
    refused(&changed(31, &[255]), "byte 31 of the body, field `path[0].flags[1]`", "255 is not a bool");
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub struct Pair {
    ok: bool,
    level: u8,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Pairs {
    one: Pair,
    two: [Pair; 2],
    many: Vec<Pair>,
    flags: [bool; 2],
}

#[derive(Clone, Copy, Default)]
pub struct PairsSizes {
    many: usize,
}

plain_struct! { "demo_msgs/msg/Pair"; Pair { ok: bool, level: u8 } }
dense_struct! { Pair }
cdr_form! { "demo_msgs/msg/Pairs"; Pairs { one: Pair, two: [Pair; 2], many: Vec<Pair>, flags: [bool; 2] } }
in_place! {
    "demo_msgs/msg/Pairs";
    Pairs PairsRef PairsWriter PairsSizes;
    {
        one: Pair as &'a Pair [],
        two: [Pair; 2] as &'a [Pair; 2] [],
        many: Vec<Pair> as &'a [Pair] [many],
        flags: [bool; 2] as &'a [bool; 2] [],
    }
}
message! { PairsRef Pairs "demo_msgs/msg/Pairs" {} }

/// Messages that a view gives as references: it says which field of which of them is wrong, as the owned type does.
#[test]
fn messages_within_a_view() {
    let fault = |body: &[u8]| {
        let mut memory = Aligned([0; 96]);
        memory.0[..body.len()].copy_from_slice(body);
        let viewed = <Pairs as Message>::view(Body::new(&memory.0, body.len()).unwrap()).map(|_| ());
        assert_eq!(viewed, Pairs::decode(body, Endian::Little).map(|_| ()));
        viewed.map_err(|error| (error.path.to_string(), error.offset))
    };
    const BODY: [u8; 18] = [1, 5, 0, 6, 1, 7, 0, 0, 2, 0, 0, 0, 1, 8, 0, 9, 1, 0];
    assert_eq!(fault(&BODY), Ok(()));
    let paths = ["one.ok", "two[0].ok", "two[1].ok", "many[0].ok", "many[1].ok", "flags[0]", "flags[1]"];
    for (at, path) in [0, 2, 4, 12, 14, 16, 17].into_iter().zip(paths) {
        let mut body = BODY;
        body[at] = 2;
        assert_eq!(fault(&body), Err((path.to_owned(), at)));
    }
    for end in 0..BODY.len() {
        assert!(fault(&BODY[..end]).is_err(), "{end}");
    }
    assert_eq!(fault(&BODY[..1]), Err(("one.level".to_owned(), 1)));
    assert_eq!(fault(&[&BODY[..8], &[255; 4], &BODY[12..]].concat()), Err(("many".to_owned(), 12)));
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "demo_msgs/msg/Drive", crate = "tautline_msgs")]
#[repr(C)]
struct Drive {
    stamp_ns: u64,
    wheels: [Wheel; 2],
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(nested, crate = "tautline_msgs")]
#[repr(C)]
struct Wheel {
    letter: char,
    gear: Gear,
    on: bool,
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(crate = "tautline_msgs")]
#[repr(i8)]
enum Gear {
    Neutral,
    First,
    Reverse = -1,
}

/// Structs in shared memory, and what only they have: enums and `char`.
#[test]
fn plain_types() {
    let said = |at: usize, bytes: &[u8], len: usize| {
        let mut memory = Aligned([0; 96]);
        memory.0[at..at + bytes.len()].copy_from_slice(bytes);
        let owned = Drive::decode(&memory.0[..len], Endian::Little).map(|_| ());
        let viewed = <Drive as Message>::view(Body::new(&memory.0[..len.next_multiple_of(8)], len).unwrap());
        assert_eq!(viewed.map(|_| ()), owned);
        owned.map_err(|error| error.to_string().split_once(": at ").unwrap().1.to_owned())
    };
    let len = 8 + 8 + 6;
    assert_eq!(said(12, &[255], len), Ok(()));
    for (at, byte, start, field, reason) in [
        (12, 2, 12, "wheels[0].gear", "2 is not a `Gear`"),
        (20, 0x80, 20, "wheels[1].gear", "-128 is not a `Gear`"),
        (21, 2, 21, "wheels[1].on", "2 is not a bool"),
        (18, 0x11, 16, "wheels[1].letter", "1114112 is not a `char`"),
    ] {
        let of_another = "the message is of another type";
        let expected = format!("byte {start} of the body, field `{field}`: {reason}: {of_another}");
        assert_eq!(said(at, &[byte], len), Err(expected));
    }
    let cut = said(0, &[], len - 1).unwrap_err();
    assert!(
        cut.starts_with("byte 21 of the body, field `wheels[1].on`: 1 bytes are needed but 0 are left"),
        "{cut}"
    );
    assert_eq!(said(0, &[], len + 8), Ok(()));
    let more = said(0, &[], len + 9).unwrap_err();
    assert!(
        more.starts_with("byte 22 of the body: 9 bytes follow the last field, where at most 8 can be"),
        "{more}"
    );
    let mut big = Aligned([0; 96]);
    big.0[11..16].copy_from_slice(&[7, 0, 0, 0, 0]);
    assert_eq!(Drive::from_cdr(&big.0[4..8 + len]).unwrap().stamp_ns, 7 << 32);
    let refused = Drive::view_cdr(&big.0[4..8 + len]).unwrap_err().to_string();
    assert!(
        refused.starts_with("`demo_msgs/msg/Drive`: at byte 0 of the body: the message is big-endian"),
        "{refused}"
    );
}

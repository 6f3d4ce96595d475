// SPDX-License-Identifier: MIT OR Apache-2.0
//! Dynamic messages: bytes, bad bytes, paths, text.

use std::sync::Arc;

use tautline_schema::{DecodeFault, DynamicMessage, EchoForm, Endian, MessageError, Schema, Value};

fn schema(text: &str) -> Arc<Schema> {
    Arc::new(Schema::from_text(&"demo_msgs/msg/Demo".parse().unwrap(), text).unwrap())
}

const POSE: &str = "string name\nPoint[] path\nuint8[<=4] data\nbool ok\nwstring<=3 wide\n===\n\
                    MSG: demo_msgs/Point\nfloat64 x\nfloat64 y 2.0\n";

fn pose() -> DynamicMessage {
    let text = "{name: 'aé', path: [{x: 1}, {x: 2, y: .nan}], data: [1, 255], ok: true, wide: \"é😀\"}";
    DynamicMessage::from_yaml(&schema(POSE), text).unwrap()
}

/// The place and the kind of a fault in a body.
#[track_caller]
fn fault(schema: &Arc<Schema>, body: &[u8]) -> (String, usize, DecodeFault) {
    match DynamicMessage::from_body(schema, body, Endian::Little) {
        Err(MessageError::Decode { path, offset, fault, .. }) => (path, offset, fault),
        other => panic!("{other:?}"),
    }
}

#[test]
fn bytes_are_those_of_the_wire() {
    #[rustfmt::skip]
    let body = [
        4, 0, 0, 0, b'a', 0xc3, 0xa9, 0,
        2, 0, 0, 0, 0, 0, 0, 0,
        0, 0, 0, 0, 0, 0, 0xf0, 0x3f, 0, 0, 0, 0, 0, 0, 0, 0x40,
        0, 0, 0, 0, 0, 0, 0, 0x40, 0, 0, 0, 0, 0, 0, 0xf8, 0x7f,
        2, 0, 0, 0, 1, 255, 1, 0,
        3, 0, 0, 0, 0xe9, 0, 0, 0, 0x3d, 0xd8, 0, 0, 0, 0xde, 0, 0,
    ];
    assert_eq!(pose().to_body(), body);
    assert_eq!(pose().to_cdr()[..4], [0, 1, 0, 0]);
    let hello = DynamicMessage::from_json(&schema("string data"), r#"{"data":"Hello 0"}"#).unwrap();
    assert_eq!(hello.to_cdr(), *b"\0\x01\0\0\x08\0\0\0Hello 0\0");
}

#[test]
fn big_endian_is_decoded() {
    let schema = schema("uint8 a\nuint16 b\nfloat64[] c\nwstring w\n");
    let big =
        [0, 0, 0, 0, 7, 0, 0x12, 0x34, 0, 0, 0, 1, 0x3f, 0xf8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, b'x'];
    let message = DynamicMessage::from_cdr(&schema, &big).unwrap();
    assert_eq!(message.to_json(), r#"{"a":7,"b":4660,"c":[1.5],"w":"x"}"#);
    assert_eq!(message.to_cdr()[4..8], [7, 0, 0x34, 0x12]);
}

/// What else is said of bad bytes, `bad_input.rs` shows.
#[test]
fn lengths_are_checked_by_what_is_left_and_by_their_bounds() {
    let schema = schema(POSE);
    let changed = |at: usize, byte: u8| {
        let mut body = pose().to_body();
        body[at] = byte;
        fault(&schema, &body)
    };
    assert_eq!(changed(8, 100), ("path".into(), 12, DecodeFault::End { needed: 1600, left: 60 }));
    assert_eq!(changed(48, 5), ("data".into(), 48, DecodeFault::Bound { len: 5, bound: 4 }));
    let inner = self::schema("Point[] path\n===\nMSG: demo_msgs/Point\nbool[2] flags\nstring<=1 name\n");
    let (path, offset, _) = fault(&inner, &[1, 0, 0, 0, 1, 1, 0, 0, 3, 0, 0, 0, b'a', b'b', 0]);
    assert_eq!((path.as_str(), offset), ("path[0].name", 12));
}

#[test]
fn trailing_bytes_are_checked() {
    let schema = schema("uint8 a\nfloat64[] c\n");
    let with = |count: usize, trailing: usize| {
        let mut message = DynamicMessage::new(&schema);
        message.set("c", vec![1.0; count]).unwrap();
        let mut bytes = message.to_cdr();
        bytes.resize(bytes.len() + trailing, 0xee);
        DynamicMessage::from_cdr(&schema, &bytes).map(|message| message.trailing_bytes())
    };
    assert_eq!(with(1, 8), Ok(8));
    assert!(with(1, 9).is_err());
    // An empty sequence of 8-byte numbers explains 8 more.
    assert_eq!(with(0, 16), Ok(16));
    assert!(with(0, 17).is_err());
}

#[test]
fn values_are_reached_by_path() {
    let mut pose = pose();
    assert_eq!(pose.get("path[1].x").unwrap().as_f64(), Some(2.0));
    assert_eq!(pose.get("data[1]").unwrap().as_integer(), Some(255));
    assert_eq!(
        pose.get("path[0]").unwrap().into_owned(),
        Value::Struct(vec![Value::F64(1.0), Value::F64(2.0)])
    );
    pose.set("path[0].y", 5).unwrap();
    pose.set("data", vec![9u8]).unwrap();
    pose.set("data[0]", 7i64).unwrap();
    pose.set("name", "b").unwrap();
    pose.set("path[1]", Value::Struct(vec![Value::F32(0.5), Value::U8(1)])).unwrap();
    assert_eq!(
        pose.to_json(),
        r#"{"name":"b","path":[{"x":1.0,"y":5.0},{"x":0.5,"y":1.0}],"data":[7],"ok":true,"wide":"é😀"}"#
    );
    for path in
        ["", ".", "nothing", "name.x", "name[0]", "path.x", "path[2].x", "path[", "path[x]", "path[-1]"]
    {
        let result = pose.get(path);
        assert!(matches!(result, Err(MessageError::Path { .. })), "{path}");
    }
    assert_eq!(
        pose.get("path[0].z").unwrap_err().to_string(),
        "`demo_msgs/msg/Demo` has no `path[0].z`: demo_msgs/msg/Point has no field `z`, it has x, y"
    );
    let before = pose.to_json();
    for (path, value) in [
        ("data", Value::from(vec![1u8; 5])),
        ("data[0]", 256.into()),
        ("data[0]", 1.5.into()),
        ("data", 1u8.into()),
        ("ok", 1u8.into()),
        ("wide", "abcd".into()),
        ("path", Value::from(vec![1u8])),
        ("path[0]", Value::Struct(vec![Value::F64(1.0)])),
        ("path[0].x", true.into()),
    ] {
        assert!(matches!(pose.set(path, value), Err(MessageError::Value { .. })), "{path}");
    }
    assert!(matches!(pose.set("data[1]", 1u8), Err(MessageError::Path { .. })));
    assert_eq!(pose.to_json(), before, "nothing was changed");
    let fields = pose.fields().to_vec();
    assert!(DynamicMessage::from_fields(pose.schema(), fields.clone()).is_ok());
    assert!(DynamicMessage::from_fields(pose.schema(), fields[1..].to_vec()).is_err());
}

#[test]
fn text_is_checked_against_the_type() {
    let schema = schema(
        "int8 a 3\nfloat32 f\nuint64 big\nstring<=2 s\nint8[2] two\nPoint p\n===\nMSG: demo_msgs/Point\nint8[<=1] x\n",
    );
    let defaults = DynamicMessage::new(&schema);
    for text in ["", "{}", "a: 3", "a: 3\np: {x: []}\n", "s: ''", "# nothing\n"] {
        let message = DynamicMessage::from_yaml(&schema, text).unwrap();
        assert_eq!(message.fields(), defaults.fields(), "{text}");
    }
    let full = r#"{"a":-1,"f":"-Infinity","big":18446744073709551615,"s":"é7","two":[1,2],"p":{"x":[5]}}"#;
    let message = DynamicMessage::from_json(&schema, full).unwrap();
    assert_eq!(message.to_json(), full);
    assert_eq!(message.to_extended_json(), full.replace("\"-Infinity\"", "-Infinity"));
    assert_eq!(DynamicMessage::from_yaml(&schema, full).unwrap().to_json(), full);
    assert_eq!(DynamicMessage::from_yaml(&schema, "s: 12").unwrap().get("s").unwrap().as_str(), Some("12"));
    for (text, place) in [
        (r#"{"a": 128}"#, "`a`"),
        (r#"{"a": 1.5}"#, "`a`"),
        (r#"{"a": "x"}"#, "`a`"),
        (r#"{"a": null}"#, "`a`"),
        (r#"{"a": [1]}"#, "`a`"),
        (r#"{"a": 1, "a": 1}"#, "a"),
        (r#"{"f": 1e39}"#, "`f`"),
        (r#"{"s": "abc"}"#, "`s`"),
        (r#"{"two": [1]}"#, "`two`"),
        (r#"{"two": [1, 2, 3]}"#, "`two`"),
        (r#"{"two": [1, "x"]}"#, "`two[1]`"),
        (r#"{"p": {"x": [1, 2]}}"#, "`p.x`"),
        (r#"{"p": {"y": 1}}"#, "`p.y`"),
        (r#"{"p": 5}"#, "`p`"),
        (r#"{"q": 5}"#, "`q`"),
        (r#"[1]"#, "demo_msgs/msg/Demo"),
        (r#"{"a": 1} x"#, ""),
        (r#"{"a""#, ""),
    ] {
        for error in [DynamicMessage::from_json(&schema, text), DynamicMessage::from_yaml(&schema, text)] {
            let error = error.unwrap_err();
            assert!(
                matches!(&error, MessageError::Text { reason, .. } if reason.contains(place)),
                "{text}: {error}"
            );
        }
    }
}

#[test]
fn values_are_converted_as_ros2_topic_pub_does() {
    let schema = schema("bool b\nint8 i\nuint64 big\nbool[] bools\nfloat32 f\nint64 long\n");
    let text = "{b: 1, i: -3.0, big: 1.0e+3, bools: [0, 1, true, 1.0], f: 2}";
    let message = DynamicMessage::from_yaml(&schema, text).unwrap();
    let json = r#"{"b":true,"i":-3,"big":1000,"bools":[false,true,true,true],"f":2.0,"long":0}"#;
    assert_eq!(message.to_json(), json);
    for (text, place) in [
        ("{b: 2}", "`b`"),
        ("{b: 0.5}", "`b`"),
        ("{b: x}", "`b`"),
        ("{i: 1.5}", "`i`"),
        ("{i: 128.0}", "`i`"),
        ("{big: 1.0e+20}", "`big`"),
        ("{big: -1.0}", "`big`"),
        ("{big: .inf}", "`big`"),
        ("{bools: [1, 2]}", "`bools[1]`"),
        // As `f64` these are other integers, which would fit.
        ("{long: -9223372036854775809}", "`long`"),
        ("{big: 9007199254740993.5}", "`big`"),
    ] {
        let error = DynamicMessage::from_yaml(&schema, text).unwrap_err().to_string();
        assert!(error.contains(place), "{text}: {error}");
    }
    for json in [r#"{"long": -9223372036854775809}"#, r#"{"long": 9007199254740993.5}"#] {
        let error = DynamicMessage::from_json(&schema, json).unwrap_err().to_string();
        assert!(error.contains("`long`"), "{json}: {error}");
    }
    let largest = DynamicMessage::from_json(&schema, r#"{"long": 9007199254740992.0}"#).unwrap();
    assert_eq!(largest.get("long").unwrap().as_integer(), Some(1 << 53));
    for (number, value) in
        [("010", 8), ("-010", -8), ("+017", 15), ("0", 0), ("-0", 0), ("08", 8), ("0x10", 16)]
    {
        let message = DynamicMessage::from_yaml(&schema, &format!("{{i: {number}}}")).unwrap();
        assert_eq!(message.get("i").unwrap().as_integer(), Some(value), "{number}");
    }
}

#[test]
fn stamps_are_found_where_yaml_says_auto_or_now() {
    let schema = schema(
        "std_msgs/Header header\nstd_msgs/Header[] all\nbuiltin_interfaces/Time[2] times\nOther o\nstring s\n===\nMSG: std_msgs/Header\n\
         builtin_interfaces/Time stamp\nstring frame_id\n===\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n===\n\
         MSG: demo_msgs/Other\nstd_msgs/Header header\n",
    );
    let read = |text| DynamicMessage::from_yaml_with_stamps(&schema, text);
    let text = "{header: auto, all: [auto, {stamp: now, frame_id: map}], times: [now, {sec: 3}], o: {header: auto}, s: now}";
    let (message, stamps) = read(text).unwrap();
    assert_eq!(stamps, ["header.stamp", "all[0].stamp", "all[1].stamp", "times[0]", "o.header.stamp"]);
    assert_eq!(message.get("s").unwrap().as_str(), Some("now"));
    assert_eq!(message.get("all[1].frame_id").unwrap().as_str(), Some("map"));
    for (text, place) in [
        ("{header: now}", "`header`"),
        ("{header: {stamp: auto}}", "`header.stamp`"),
        ("{o: auto}", "`o`"),
        ("auto", "demo_msgs/msg/Demo"),
    ] {
        let error = read(text).unwrap_err().to_string();
        assert!(error.contains(place), "{text}: {error}");
    }
    let error = DynamicMessage::from_yaml(&schema, "{header: auto}").unwrap_err().to_string();
    assert!(error.contains("`header`"), "{error}");
}

/// YAML 1.1 would read them as numbers or times.
#[test]
fn texts_that_look_like_other_values_are_quoted() {
    let mut message = DynamicMessage::new(&schema("string s\n"));
    for text in [".nan", ".NaN", ".NAN", ".inf", ".Inf", "-.INF", "2001-12-14t21:59:43", "1_000", "010"] {
        message.set("s", text).unwrap();
        assert_eq!(message.to_string(), format!("s: '{text}'\n"));
    }
}

#[test]
fn echo_prints_as_ros2_topic_echo() {
    let schema = schema(
        "string text\nfloat64 f\nPoint p\nPoint[] all\nuint8[] data\nEmpty e\nstring[] words\n===\nMSG: demo_msgs/Point\n\
         int8 x\nint8[] y\n===\nMSG: demo_msgs/Empty\n",
    );
    let text = "text: 'yes'\nf: 1.0e-05\np:\n  x: -1\n  y: []\nall:\n- x: 1\n  y:\n  - 2\n  - 3\n- x: 0\n  y: []\ndata:\n- 1\n\
                - 2\n- 3\ne: {}\nwords:\n- a b\n- '1'\n- ''\n- \"\\t\"\n- 'two\n\n  lines'\n";
    let message = DynamicMessage::from_yaml(&schema, text).unwrap();
    assert_eq!(message.to_string(), text);
    let short = EchoForm { most: 2, ..EchoForm::default() };
    assert!(message.echo(short).contains("data:\n- 1\n- 2\n- '...'\n"));
    assert!(message.echo(short).starts_with("text: ye...\n"));
    let brief = message.echo(EchoForm { no_lists: true, no_texts: true, ..EchoForm::default() });
    let expected = "text: '<string length: <3>>'\nf: 1.0e-05\np:\n  x: -1\n  y: '<sequence type: int8, length: 0>'\n\
                    all: '<sequence type: demo_msgs/Point, length: 2>'\ndata: '<sequence type: uint8, length: 3>'\ne: {}\n\
                    words: '<sequence type: string, length: 5>'\n";
    assert_eq!(brief, expected);
    for (path, expected) in [
        ("f", "1.0e-05\n"),
        ("p", "x: -1\ny: []\n"),
        ("all[0].y", "- 2\n- 3\n"),
        ("all[1]", "x: 0\ny: []\n"),
        ("data[2]", "3\n"),
        ("all[1].y", "[]\n"),
    ] {
        assert_eq!(message.echo_field(path, EchoForm::default()).unwrap(), expected, "{path}");
    }
    assert!(message.echo_field("p.z", EchoForm::default()).is_err());
}

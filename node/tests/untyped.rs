// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages as JSON and as CDR, beside typed ends of the same topics.
#![cfg(all(feature = "untyped", feature = "std_msgs", feature = "sensor_msgs"))]

mod common;

use common::{Log, context, eventually, spin};
use futures::{FutureExt, Stream, StreamExt};
use serde_json::{Value, json};
use tautline::sensor_msgs::msg::Image;
use tautline::std_msgs::msg::{Empty, String as Text};
use tautline::{
    CallbackOptions, Error, IncompatibleType, Json, Limits, Message, Node, Qos, SubscriptionEvent,
};
use tautline_schema::{DynamicMessage, Schema};
use tautline_transport::{Participant, SchemaStore, TopicType};

const DOMAIN: u32 = 117;

fn node() -> Node {
    Node::create(context(DOMAIN), "testnode", "").unwrap()
}

fn qos() -> Qos {
    Qos::default()
}

/// What has arrived, without waiting.
fn drain<S: Stream + Unpin>(stream: &mut S) -> Vec<S::Item> {
    std::iter::from_fn(|| stream.next().now_or_never().flatten()).collect()
}

fn text(data: &str) -> Text {
    Text { data: data.to_owned() }
}

/// The wire's form of a `std_msgs/String`.
fn string_cdr(data: &str, endian: u8) -> Vec<u8> {
    let len = u32::try_from(data.len() + 1).unwrap();
    let len = if endian == 1 { len.to_le_bytes() } else { len.to_be_bytes() };
    [&[0, endian, 0, 0], &len[..], data.as_bytes(), &[0]].concat()
}

#[test]
fn ends_of_every_kind_understand_each_other() {
    const TYPE: &str = "std_msgs/msg/String";
    let mut node = node();
    let mut typed = node.subscribe::<Text>("/words", qos()).unwrap().owned();
    let mut json = node.subscribe_untyped("/words", TYPE, qos()).unwrap().owned();
    let mut raw = node.subscribe_raw("/words", TYPE, qos()).unwrap().owned();
    let typed_publisher = node.create_publisher::<Text>("/words", qos()).unwrap();
    let untyped_publisher = node.create_publisher_untyped("words", TYPE, qos()).unwrap();
    assert_eq!((untyped_publisher.topic(), untyped_publisher.subscription_count()), ("/words", 3));

    typed_publisher.publish(&text("typed")).unwrap();
    untyped_publisher.publish(&Json(json!({ "data": "as JSON" }))).unwrap();
    untyped_publisher.publish(&Json(json!({}))).unwrap();
    for endian in [1, 0] {
        untyped_publisher.publish_raw(&string_cdr("as CDR", endian)).unwrap();
        typed_publisher.publish_raw(&string_cdr("typed CDR", endian)).unwrap();
    }
    // What ROS 2 may append is left out.
    untyped_publisher.publish_raw(&[string_cdr("padded", 1), vec![7; 3]].concat()).unwrap();

    let words = ["", "as CDR", "as CDR", "as JSON", "padded", "typed", "typed CDR", "typed CDR"];
    // No order holds between two publishers' messages.
    let sorted = |mut heard: Vec<String>| {
        heard.sort();
        heard
    };
    assert_eq!(sorted(drain(&mut typed).into_iter().map(|word| word.data).collect()), words);
    let json = drain(&mut json).into_iter().map(|word| word.unwrap()["data"].as_str().unwrap().to_owned());
    assert_eq!(sorted(json.collect()), words);
    let bytes = drain(&mut raw);
    assert_eq!(sorted(bytes.iter().map(|cdr| Text::from_cdr(cdr).unwrap().data).collect()), words);
    assert!(bytes.contains(&string_cdr("padded", 1)) && bytes.iter().all(|cdr| cdr[..4] == [0, 1, 0, 0]));
}

#[test]
fn samples_of_json_are_bodies_in_place_until_they_are_copied() {
    let mut node = node();
    let subscription = node.subscribe_untyped("/in_place", "std_msgs/msg/String", qos()).unwrap();
    let publisher = node.create_publisher::<Text>("/in_place", qos()).unwrap();
    publisher.publish(&text("here")).unwrap();
    let sample = subscription.try_take().unwrap().unwrap();
    assert_eq!(sample.view(), &string_cdr("here", 1)[4..]);
    assert_eq!(sample.to_owned().unwrap(), json!({ "data": "here" }));
    assert_eq!(subscription.definition().name().to_string(), "std_msgs/msg/String");
    assert!(subscription.try_take().unwrap().is_none());
}

#[test]
fn an_image_is_the_same_from_every_end() {
    const TYPE: &str = "sensor_msgs/msg/Image";
    let mut node = node();
    let mut typed = node.subscribe::<Image>("/image", qos()).unwrap().owned();
    let mut json = node.subscribe_untyped("/image", TYPE, qos()).unwrap().owned();
    let mut raw = node.subscribe_raw("/image", TYPE, qos()).unwrap().owned();
    let typed_publisher = node.create_publisher::<Image>("/image", qos()).unwrap();
    let untyped_publisher = node.create_publisher_untyped("/image", TYPE, qos()).unwrap();

    let mut image = Image { height: 2, width: 3, encoding: "mono8".into(), step: 3, ..Image::default() };
    image.header.frame_id = "camera".into();
    image.header.stamp.sec = -1;
    image.data = vec![0, 1, 2, 3, 254, 255];
    let as_json = json!({
        "header": { "stamp": { "sec": -1, "nanosec": 0 }, "frame_id": "camera" },
        "height": 2, "width": 3, "encoding": "mono8", "is_bigendian": 0, "step": 3,
        "data": [0, 1, 2, 3, 254, 255],
    });
    typed_publisher.publish(&image).unwrap();
    untyped_publisher.publish(&Json(as_json.clone())).unwrap();
    let bytes = drain(&mut raw);
    assert_eq!(bytes[0], bytes[1], "the encoders agree");
    typed_publisher.publish_raw(&bytes[0]).unwrap();
    untyped_publisher.publish_raw(&bytes[0]).unwrap();

    assert_eq!(drain(&mut typed), vec![image; 4]);
    assert!(drain(&mut json).into_iter().all(|message| message.unwrap() == as_json));
    assert_eq!(drain(&mut raw), vec![bytes[0].clone(); 2]);
}

#[test]
fn types_of_fixed_size_keep_it() {
    let mut node = node();
    let mut typed = node.subscribe::<tautline::geometry_msgs::msg::Twist>("/twist", qos()).unwrap().owned();
    let untyped = node.create_publisher_untyped("/twist", "geometry_msgs/msg/Twist", qos()).unwrap();
    untyped.publish(&Json(json!({ "linear": { "x": 0.5 }, "angular": { "z": -1 } }))).unwrap();
    let cdr = DynamicMessage::from_json(untyped.definition(), r#"{"linear": {"y": 2}}"#).unwrap().to_cdr();
    // As rmw implementations do.
    untyped.publish_raw(&[&cdr[..], &[1, 2, 3, 4]].concat()).unwrap();
    let twists = drain(&mut typed);
    assert_eq!((twists[0].linear.x, twists[0].angular.z, twists[1].linear.y), (0.5, -1.0, 2.0));

    let mut typed = node.subscribe::<Empty>("/empty", qos()).unwrap().owned();
    let mut json = node.subscribe_untyped("/empty", "std_msgs/msg/Empty", qos()).unwrap().owned();
    let untyped = node.create_publisher_untyped("/empty", "std_msgs/msg/Empty", qos()).unwrap();
    let publisher = node.create_publisher::<Empty>("/empty", qos()).unwrap();
    untyped.publish(&Json(json!({}))).unwrap();
    publisher.publish(&Empty::default()).unwrap();
    assert_eq!(drain(&mut typed).len(), 2);
    assert!(drain(&mut json).into_iter().all(|message| message.unwrap() == json!({})));
}

#[test]
fn what_is_no_message_is_an_error_with_the_field() {
    let mut node = node();
    let mut heard = node.subscribe::<Image>("/bad", qos()).unwrap().owned();
    let untyped = node.create_publisher_untyped("/bad", "sensor_msgs/msg/Image", qos()).unwrap();
    let typed = node.create_publisher::<Image>("/bad", qos()).unwrap();
    for (json, expected) in [
        (json!({ "colour": 1 }), "there is no field `colour`"),
        (json!({ "header": { "stamp": { "secs": 1 } } }), "there is no field `header.stamp.secs`"),
        (json!({ "header": { "stamp": { "nanosec": -1 } } }), "header.stamp.nanosec"),
        (json!({ "is_bigendian": 256 }), "is_bigendian"),
        (json!({ "height": 1.5 }), "height"),
        (json!({ "encoding": 8 }), "encoding"),
        (json!({ "data": [1, 2, "three"] }), "data[2]"),
        (json!({ "header": { "frame_id": null } }), "header.frame_id"),
        (json!([1]), "sensor_msgs/msg/Image"),
    ] {
        let error = untyped.publish(&Json(json.clone())).expect_err(expected);
        assert!(matches!(error, Error::Message(_)), "{error}");
        let error = error.to_string();
        assert!(error.contains(expected) && error.contains("sensor_msgs/msg/Image"), "{json}: {error}");
    }
    // Of an image: the time (8), the frame (4, 2 and 2 for alignment), height and width (8), the encoding (4).
    let mut image = Image { encoding: "rgb8".into(), data: vec![1, 2, 3], ..Image::default() };
    image.header.frame_id = "f".into();
    let schema = untyped.definition();
    let good = DynamicMessage::from_json(schema, &serde_json::to_string(&image).unwrap()).unwrap().to_cdr();
    let changed = |index: usize, value: u8| {
        let mut bytes = good.clone();
        bytes[4 + index] = value;
        bytes
    };
    for (bytes, expected) in [
        (vec![], ""),
        (good[..3].to_vec(), ""),
        ([&[0, 9, 0, 0], &good[4..]].concat(), "00 09"),
        (good[4..].to_vec(), ""),
        (good[..4].to_vec(), "header.stamp.sec"),
        (good[..good.len() - 1].to_vec(), "data"),
        (changed(13, b'x'), "header.frame_id"),
        (changed(12, 0xff), "header.frame_id"),
        (changed(27, 0x7f), "encoding"),
        ([&good[..], &[0; 200]].concat(), "200 bytes follow"),
    ] {
        let untyped = untyped.publish_raw(&bytes).unwrap_err().to_string();
        let typed = typed.publish_raw(&bytes).unwrap_err().to_string();
        assert!(untyped.contains(expected), "{bytes:02x?}: {untyped}");
        let expected = if expected.starts_with("00") || expected.starts_with("200") { "" } else { expected };
        assert!(typed.contains(expected) && typed.contains("sensor_msgs/msg/Image"), "{bytes:02x?}: {typed}");
    }
    assert_eq!(drain(&mut heard).len(), 0, "nothing bad was sent");
    untyped.publish_raw(&good).unwrap();
    assert_eq!(drain(&mut heard), [image]);
}

#[test]
fn a_sample_that_is_no_message_is_an_error_of_its_item() {
    let mut node = node();
    let mut json = node.subscribe_untyped("/liar", "std_msgs/msg/String", qos()).unwrap().owned();
    let participant = Participant::new(DOMAIN).unwrap();
    let claimed = TopicType::new("std_msgs/msg/String");
    let liar =
        participant.create_raw_publisher("/liar", &claimed, Qos::default(), Limits::default()).unwrap();
    liar.publish(&[9, 0, 0, 0, b'h', b'i', 0]).unwrap();
    liar.publish(&string_cdr("hi", 1)[4..]).unwrap();
    let mut messages = Vec::new();
    eventually("two messages", || {
        messages.extend(drain(&mut json));
        messages.len() >= 2
    });
    let error = messages[0].as_ref().unwrap_err().to_string();
    assert!(error.contains("`std_msgs/msg/String`") && error.contains("`data`"), "{error}");
    assert_eq!(messages[1].as_ref().unwrap(), &json!({ "data": "hi" }));
}

/// A type that neither ROS 2 nor this program has: its definition comes from the schema store.
#[test]
fn a_definition_comes_with_the_topic() {
    common::isolate();
    let name = "demo_msgs/msg/Track".parse().unwrap();
    let definition =
        "uint8 LOST=3\nPoint[<=4] points\nbool seen\n===\nMSG: demo_msgs/Point\nfloat32 x\nint16 y 7\n";
    let schema = Schema::from_text(&name, definition).unwrap();
    let hash = schema.hash().to_string();
    let file = SchemaStore::of_user().path().join(&hash);
    let _ = std::fs::remove_file(&file);

    let mut node = node();
    let unknown = node.subscribe_untyped("/track", name.as_str(), qos()).err().unwrap().to_string();
    for part in ["/track", "demo_msgs/msg/Track", "AMENT_PREFIX_PATH", "no publisher or subscription"] {
        assert!(unknown.contains(part), "{unknown}");
    }

    let participant = Participant::new(DOMAIN).unwrap();
    let topic_type = TopicType::new(name.to_string()).with_hash(hash).with_definition(schema.to_text());
    let publisher =
        participant.create_raw_publisher("/track", &topic_type, Qos::default(), Limits::default()).unwrap();
    assert_eq!(std::fs::read_to_string(&file).unwrap(), schema.to_text());
    let mut json = node.subscribe_untyped("/track", name.as_str(), qos()).unwrap().owned();
    let untyped = node.create_publisher_untyped("/track", name.as_str(), qos()).unwrap();
    let track = json!({ "points": [{ "x": 0.5, "y": 7 }, { "x": "NaN", "y": -1 }], "seen": true });
    let body = DynamicMessage::from_json(&schema.into(), &track.to_string()).unwrap().to_body();
    publisher.publish(&body).unwrap();
    untyped
        .publish(&Json(json!({ "points": [{ "x": 0.5 }, { "x": "NaN", "y": -1 }], "seen": true })))
        .unwrap();
    let heard: Vec<Value> = drain(&mut json).into_iter().map(Result::unwrap).collect();
    assert_eq!(heard, [track.clone(), track]);
    for (json, expected) in [
        (json!({ "points": [{}, { "y": 40_000 }] }), "points[1].y"),
        (json!({ "points": [{}, {}, {}, {}, {}] }), "points"),
        (json!({ "seen": 2 }), "seen"),
    ] {
        let error = untyped.publish(&Json(json)).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let error = untyped.publish_raw(&[0, 1, 0, 0, 0, 0, 0, 0, 2]).unwrap_err().to_string();
    assert!(error.contains("`seen`: 2 is not a bool"), "{error}");
}

/// The type is derived, and ROS has no fields of this name, so no definition of it exists anywhere.
#[test]
fn without_a_definition_there_are_still_the_bytes() {
    #[derive(Message, Clone, Copy, Debug, PartialEq)]
    #[message(name = "test_msgs/msg/Number")]
    #[repr(C)]
    struct Number {
        _value: i64,
    }
    let mut node = node();
    let publisher = node.create_publisher::<Number>("/number", qos()).unwrap();
    let error = node.create_publisher_untyped("/number", "test_msgs/msg/Number", qos()).unwrap_err();
    assert!(matches!(error, Error::UnknownType { .. }), "{error}");
    assert!(error.to_string().contains("has no hash"), "{error}");
    let mut raw = node.subscribe_raw("/number", "test_msgs/msg/Number", qos()).unwrap().owned();
    let mut typed = node.subscribe::<Number>("/number", qos()).unwrap().owned();
    publisher.publish(&Number { _value: 3 }).unwrap();
    let bytes = drain(&mut raw);
    assert_eq!(bytes, [[0, 1, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0]]);
    publisher.publish_raw(&bytes[0]).unwrap();
    publisher.publish_raw(&[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 4]).unwrap();
    let error = publisher.publish_raw(&bytes[0][..11]).unwrap_err().to_string();
    assert!(error.contains("test_msgs/msg/Number"), "{error}");
    assert_eq!(drain(&mut typed), [3, 3, 4].map(|n| Number { _value: n }));
}

#[test]
fn a_topic_with_another_hash_does_not_match_and_is_told() {
    let mut node = node();
    let other = format!("RIHS01_{}", "a".repeat(64));
    let participant = Participant::new(DOMAIN).unwrap();
    let topic_type = TopicType::new("std_msgs/msg/String").with_hash(other);
    let there =
        participant.create_raw_publisher("/other", &topic_type, Qos::default(), Limits::default()).unwrap();
    let json = node.subscribe_untyped("/other", "std_msgs/msg/String", qos()).unwrap();
    let raw = node.subscribe_raw("/other", "std_msgs/msg/String", qos()).unwrap();
    let of_another_type = node.subscribe_raw("/other", "std_msgs/msg/Empty", qos()).unwrap();
    let json = node.subscription_events(&json).unwrap();
    for mut events in
        [json, node.subscription_events(&raw).unwrap(), node.subscription_events(&of_another_type).unwrap()]
    {
        let expected = IncompatibleType { total_count: 1, total_count_change: 1 };
        assert_eq!(drain(&mut events), [SubscriptionEvent::IncompatibleType(expected)]);
    }
    assert_eq!(there.subscription_count(), 0);
    let error = node.subscribe_raw("/new", "String", qos()).err().unwrap();
    assert!(matches!(error, Error::Schema(_)), "{error}");
}

#[test]
fn each_message_is_a_job_of_its_callback() {
    static HEARD: Log<Value> = Log::new();
    let context = context(DOMAIN);
    let mut node = Node::create(context.clone(), "testnode", "").unwrap();
    let json = node.subscribe_untyped("/jobs", "std_msgs/msg/String", qos()).unwrap();
    let counters = json.counters();
    let publisher = node.create_publisher::<Text>("/jobs", qos()).unwrap();
    let callback = json.owned().for_each(|message| async { HEARD.add(message.unwrap()) });
    let handle = node.spawn_callback(CallbackOptions::other().name("/jobs"), callback).unwrap();
    let _spinning = spin(&context);
    for data in ["one", "two"] {
        publisher.publish(&text(data)).unwrap();
    }
    assert_eq!(HEARD.wait_for(2), [json!({ "data": "one" }), json!({ "data": "two" })]);
    assert_eq!(counters.received(), 2);
    // The poll after the second message ended its job.
    publisher.publish(&text("three")).unwrap();
    HEARD.wait_for(3);
    assert!(handle.stats().completions() >= 2);
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random messages of many types, each way, against rclpy: equal values, in order, none lost.

mod support;

use serde_json::{Value, json};
use std::sync::Arc;
use support::{BridgeProcess, Peer, matched, publisher, ros, subscription, take, wait_until};
use tautline_schema::{DynamicMessage, Endian, Packages};
use tautline_transport::{Participant, Qos};

/// Messages per type and direction.
const COUNT: usize = 1000;
/// Sent at once. Not more: Fast DDS has 512 KiB and 512 messages of shared memory for a writer, and what does not fit comes after its
/// heartbeat of 3 s. A burst of a thousand is a test of `crashes.rs`.
const AT_ONCE: usize = 50;
/// The same of images and point clouds.
const AT_ONCE_OF_LARGE: usize = 8;
/// How much data they have at most.
const DATA_BYTES: usize = 10 << 10;
const DEPTH: usize = 1000;

fn seed() -> u64 {
    let seed = std::env::var("TAUT_SEED")
        .map_or_else(|_| rand::random::<u32>().into(), |seed| seed.parse().unwrap());
    println!("TAUT_SEED={seed}");
    seed
}

fn values_are_the_same_on_both_sides(domain: u32, types: &[&str]) {
    let Some(venv) = ros() else { return };
    let seed = seed();
    let mut packages = Packages::new();
    packages.add_folder(&venv);
    let bridge = BridgeProcess::start(domain, domain, &[]);
    let participant = Participant::new(domain).unwrap();
    let mut peer = Peer::start(&venv, domain, "values");
    for name in types {
        let schema = Arc::new(packages.schema(&name.parse().unwrap()).unwrap());
        let text = |value: &Value| DynamicMessage::from_json(&schema, &value.to_string()).unwrap().to_json();
        let topic = name.rsplit('/').next().unwrap().to_lowercase();
        let is_large = name.starts_with("sensor_msgs/");
        let (at_once, data_bytes) = if is_large { (AT_ONCE_OF_LARGE, DATA_BYTES) } else { (AT_ONCE, 0) };
        let random = |what: &str, seed: u64| json!({ "do": what, "type": name, "count": COUNT, "seed": seed, "data_bytes": data_bytes });

        let (from_ros, qos) = (format!("/from_ros/{topic}"), json!({ "depth": DEPTH }));
        let here = subscription(&participant, &from_ros, name, Qos::keep_last(DEPTH));
        let there = peer.publisher(&from_ros, name, qos.clone());
        peer.matched(there, 1);
        let said = peer.tell(random("prepare_random", seed));
        let mut bodies = Vec::new();
        while bodies.len() < COUNT {
            peer.tell(json!({ "do": "publish_prepared", "end": there, "count": at_once }));
            bodies.extend(take(&here, at_once));
        }
        for (body, said) in bodies.iter().zip(said.as_array().unwrap()) {
            let message = DynamicMessage::from_body(&schema, body, Endian::Little).unwrap();
            assert_eq!((message.to_json(), message.trailing_bytes()), (text(said), 0), "{name}");
        }

        let to_ros = format!("/to_ros/{topic}");
        let here = publisher(&participant, &to_ros, name, Qos::keep_last(DEPTH));
        let there = peer.subscription(&to_ros, name, qos);
        let said = peer.tell(random("random", seed + 1));
        let said: Vec<String> =
            said.as_array().unwrap().iter().map(|one| one[1].as_str().unwrap().to_owned()).collect();
        let bodies = said.iter().map(|json| DynamicMessage::from_json(&schema, json).unwrap().to_body());
        let bodies: Vec<Vec<u8>> = bodies.collect();
        matched(&here, 1);
        let mut received = Vec::new();
        for bodies in bodies.chunks(at_once) {
            bodies.iter().for_each(|body| here.publish(body).unwrap());
            received.extend(peer.take(there, bodies.len()));
        }
        for (received, said) in received.iter().zip(&said) {
            let said = DynamicMessage::from_json(&schema, said).unwrap().to_json();
            assert_eq!(text(received), said, "{name}");
        }
        assert_eq!((bodies.len(), received.len()), (COUNT, COUNT), "{name}");
        for (topic, direction) in [(&from_ros, "from_ros"), (&to_ros, "to_ros")] {
            let counted = || bridge.topic(topic, direction);
            wait_until("all are counted", || counted()["messages"] == COUNT);
            assert_eq!((&counted()["lost"], &counted()["dropped"]), (&json!(0), &json!({})), "{name}");
        }
    }
}

#[test]
fn of_common_types() {
    values_are_the_same_on_both_sides(
        34,
        &["std_msgs/msg/String", "geometry_msgs/msg/Twist", "sensor_msgs/msg/PointCloud2"],
    );
}

#[test]
fn of_arrays_and_strings() {
    values_are_the_same_on_both_sides(
        35,
        &[
            "test_msgs/msg/Arrays",
            "test_msgs/msg/WStrings",
            "test_msgs/msg/BasicTypes",
            "test_msgs/msg/Empty",
        ],
    );
}

#[test]
fn of_sequences() {
    values_are_the_same_on_both_sides(
        36,
        &["test_msgs/msg/UnboundedSequences", "test_msgs/msg/BoundedSequences", "sensor_msgs/msg/Image"],
    );
}

#[test]
fn of_nested_types() {
    values_are_the_same_on_both_sides(37, &["test_msgs/msg/MultiNested", "test_msgs/msg/Nested"]);
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Random messages of many types, each way, against rclpy: equal values, in order, none lost.

mod support;

use serde_json::json;
use support::{BridgeProcess, Peer, Values, ros, wait_until};
use tautline_schema::Packages;
use tautline_transport::Participant;

fn values_are_the_same_on_both_sides(domain: u32, types: &str) {
    let Some(venv) = ros() else { return };
    let mut packages = Packages::new();
    packages.add_folder(&venv);
    let bridge = BridgeProcess::start(domain, domain, &[]);
    let participant = Participant::new(domain).unwrap();
    let mut peer = Peer::start(&venv, domain, "values");
    for name in types.split(' ') {
        let values = Values::new(name);
        values.exchange(&mut peer, &participant, &mut packages, name);
        for (topic, direction) in Values::topics(name).iter().zip(["from_ros", "to_ros"]) {
            let counted = || bridge.topic(topic, direction);
            wait_until("all are counted", || counted()["messages"] == values.count);
            assert_eq!((&counted()["lost"], &counted()["dropped"]), (&json!(0), &json!({})), "{name}");
        }
    }
}

#[test]
fn of_common_types() {
    values_are_the_same_on_both_sides(
        34,
        "std_msgs/msg/String geometry_msgs/msg/Twist sensor_msgs/msg/PointCloud2",
    );
}

#[test]
fn of_arrays_and_strings() {
    values_are_the_same_on_both_sides(
        35,
        "test_msgs/msg/Arrays test_msgs/msg/WStrings test_msgs/msg/BasicTypes test_msgs/msg/Empty",
    );
}

#[test]
fn of_sequences() {
    values_are_the_same_on_both_sides(
        36,
        "test_msgs/msg/UnboundedSequences test_msgs/msg/BoundedSequences sensor_msgs/msg/Image",
    );
}

#[test]
fn of_nested_types() {
    values_are_the_same_on_both_sides(37, "test_msgs/msg/MultiNested test_msgs/msg/Nested");
}

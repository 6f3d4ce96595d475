// SPDX-License-Identifier: MIT OR Apache-2.0
//! What ROS 2's nodes have besides topics of their own: parameters, their events, log lines, simulated time, latched
//! transforms; with rclpy on the other side.

mod support;

use futures::StreamExt;
use serde_json::{Value, json};
use support::node::Spinning;
use support::{BridgeProcess, Peer, joined_nodes, ros, wait_until};
use tautline::geometry_msgs::msg::TransformStamped;
use tautline::{CallbackHandle, CallbackOptions, Clock, ParameterDescriptor, Qos};

const TRANSFORM: &str = "geometry_msgs/msg/TransformStamped";

fn serve_parameters(here: &mut Spinning) -> CallbackHandle {
    let (handler, _events) = here.node.make_parameter_handler().unwrap();
    here.node.spawn_callback(CallbackOptions::other().name("parameters"), handler).unwrap()
}

#[test]
fn parameters_of_a_node_here_are_got_set_listed_and_described_by_ros() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 22;
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let mut here = Spinning::new(DOMAIN, "here");
    let descriptor = ParameterDescriptor::new().description("Of the controller").range(0.0..=10.0);
    let mut gain = here.node.declare_parameter_with("gain", 1.5, descriptor).unwrap();
    here.node.declare_parameter("frames", vec!["map".to_owned(), "odom".to_owned()]).unwrap();
    let _served = serve_parameters(&mut here);
    let mut peer = Peer::start_with_services(&venv, DOMAIN, "there");
    let events = peer.subscription("/parameter_events", "rcl_interfaces/msg/ParameterEvent", json!({}));
    let client = peer.tell(json!({ "do": "parameters", "node": "here" }));

    let listed = peer.tell(json!({ "do": "list_parameters", "end": client }));
    for name in ["frames", "gain", "use_sim_time"] {
        assert!(listed.as_array().unwrap().contains(&json!(name)), "{listed}");
    }
    let names = ["gain", "frames", "none"];
    let values = peer.tell(json!({ "do": "get_parameters", "end": client, "names": names }));
    assert_eq!((&values[0]["type"], &values[0]["double_value"]), (&json!(3), &json!(1.5)));
    assert_eq!(values[1]["string_array_value"], json!(["map", "odom"]));
    assert_eq!(values[2]["type"], 0);
    let described = peer.tell(json!({ "do": "describe_parameters", "end": client, "names": ["gain"] }));
    assert_eq!(described[0]["description"], "Of the controller");
    assert_eq!(described[0]["floating_point_range"][0]["to_value"], 10.0);

    // Its own node's publisher is one.
    peer.matched(events, 2);
    let is_active = || bridge.topic("/parameter_events", "to_ros")["active"] == true;
    wait_until("events go on", is_active);
    let values = json!({ "gain": 2.5 });
    let results = peer.tell(json!({ "do": "set_parameters", "end": client, "values": values }));
    assert_eq!(results[0][0], true);
    assert_eq!(gain.get(), 2.5);
    let results = peer.tell(json!({ "do": "set_parameters", "end": client, "values": { "gain": 11.0 } }));
    assert!(results[0][0] == false && results[0][1].as_str().unwrap().contains("gain"), "{results}");

    let told = peer.take(events, 1);
    let changed =
        told.iter().flat_map(|event| event["changed_parameters"].as_array().cloned().unwrap_or_default());
    let gains: Vec<Value> =
        changed.filter(|one| one["name"] == "gain").map(|one| one["value"]["double_value"].clone()).collect();
    assert_eq!(gains, [json!(2.5)], "{told:?}");
    assert_eq!(told[0]["node"], "/here");
}

#[test]
fn ros_reads_what_is_logged_here() {
    let Some((_bridge, here, mut peer)) = joined_nodes(23) else { return };
    // A late joiner gets what was logged before, as of ROS 2's nodes.
    tautline::log_warn!(here.node.logger(), "before");
    let lines =
        peer.subscription("/rosout", "rcl_interfaces/msg/Log", json!({ "latched": true, "depth": 1000 }));
    let mut texts = Vec::new();
    let mut hear = |peer: &mut Peer, wanted: &str| {
        while !texts.iter().any(|text| text == wanted) {
            let told = peer.take(lines, 1);
            let own = told.iter().filter(|line| line["name"] == "here");
            texts.extend(own.map(|line| line["msg"].as_str().unwrap().to_owned()));
        }
    };
    hear(&mut peer, "before");
    tautline::log_error!(here.node.logger(), "after");
    hear(&mut peer, "after");
    assert_eq!(texts.iter().filter(|text| *text == "before").count(), 1);
}

#[test]
fn a_simulator_in_ros_gives_the_time_here() {
    let Some((_bridge, here, mut peer)) = joined_nodes(24) else { return };
    let clock = peer.publisher("/clock", "rosgraph_msgs/msg/Clock", json!({ "depth": 1 }));
    here.node.set_parameter("use_sim_time", true).unwrap();
    peer.matched(clock, 1);
    let time: Clock = here.node.clock();
    for sec in [100, 101, 200] {
        peer.tell(json!({ "do": "publish_clock", "end": clock, "sec": sec }));
        wait_until("the time", || time.now().as_secs() == sec);
    }
    assert!(time.is_simulated());
}

/// Transforms are of `tf2_msgs/msg/TFMessage`, which is in no wheel: these are the ones that it consists of.
#[test]
fn late_joiners_get_latched_transforms_on_both_sides() {
    let Some((_bridge, mut here, mut peer)) = joined_nodes(25) else { return };
    let latched = Qos::default().transient_local();

    let publisher = here.node.create_publisher::<TransformStamped>("/tf_static", latched).unwrap();
    let transform = |child: &str, x: f64| {
        let mut message = TransformStamped { child_frame_id: child.into(), ..Default::default() };
        message.transform.translation.x = x;
        message
    };
    publisher.publish(&transform("arm", 1.5)).unwrap();
    publisher.publish(&transform("hand", -2.0)).unwrap();
    let late = peer.subscription("/tf_static", TRANSFORM, json!({ "latched": true }));
    let told = peer.take(late, 2);
    let of = |message: &Value| {
        (message["child_frame_id"].clone(), message["transform"]["translation"]["x"].clone())
    };
    assert_eq!(
        told.iter().map(of).collect::<Vec<_>>(),
        [(json!("arm"), json!(1.5)), (json!("hand"), json!(-2.0))]
    );

    let from_ros = peer.publisher("/ros/tf_static", TRANSFORM, json!({ "latched": true }));
    for (child, x) in [("arm", 1.5), ("hand", -2.0)] {
        peer.tell(json!({ "do": "publish_transform", "end": from_ros, "child": child, "x": x }));
    }
    let late = here.node.subscribe::<TransformStamped>("/ros/tf_static", latched).unwrap().owned();
    let told = here.wait("latched transforms", late.take(2).collect::<Vec<_>>());
    assert_eq!(told, [transform("arm", 1.5), transform("hand", -2.0)]);
}

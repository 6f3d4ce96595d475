// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics by discovery, with rclpy on the other side: they come and go with their ends, and arrive in order.

mod support;

use serde_json::json;
use support::{
    BridgeProcess, Peer, STRING, matched, publisher, ros, subscription, take_texts, text_body, wait_until,
};
use tautline_transport::{Participant, Qos};

#[test]
fn texts_go_both_ways_and_topics_come_and_go() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 27;
    let bridge = BridgeProcess::start(DOMAIN, DOMAIN, &[]);
    let participant = Participant::new(DOMAIN).unwrap();
    let mut peer = Peer::start(&venv, DOMAIN, "both_ways");

    let here = publisher(&participant, "/to_ros", STRING, Qos::default());
    let there = peer.subscription("/to_ros", STRING, json!({}));
    matched(&here, 1);
    for text in ["one", "", "thrée"] {
        here.publish(&text_body(text)).unwrap();
    }
    assert_eq!(peer.take_texts(there, 3), ["one", "", "thrée"]);

    let here = subscription(&participant, "/from_ros", STRING, Qos::default());
    let there = peer.publisher("/from_ros", STRING, json!({}));
    peer.matched(there, 1);
    peer.publish_text(there, &["one", "", "thrée"]);
    assert_eq!(take_texts(&here, 3), ["one", "", "thrée"]);
    drop(here);
    peer.matched(there, 0);

    let numbers =
        bridge.wait_for("numbers", |stats| stats["topics"].as_array().is_some_and(|all| all.len() == 2));
    let all = numbers["topics"].as_array().unwrap();
    assert!(all.iter().all(|topic| topic["dropped"] == json!({}) && topic["lost"] == 0), "{all:?}");
    wait_until("both are counted", || bridge.topic("/to_ros", "to_ros")["messages"] == 3);
    wait_until("it has ended", || bridge.topic("/from_ros", "from_ros")["active"] == false);
}

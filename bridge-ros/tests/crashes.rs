// SPDX-License-Identifier: MIT OR Apache-2.0
//! What ends without a word: a bridge that is killed, a ROS node that is. What comes in its place is found.

mod support;

use serde_json::json;
use std::time::Instant;
use support::{
    BridgeProcess, Peer, STRING, joined, matched, publish_texts, publisher, recovers, ros, subscription,
    take, take_texts, text_body, wait_until,
};
use tautline_transport::{Participant, Qos};

#[test]
fn a_killed_bridge_and_a_killed_node_are_replaced() {
    let Some(venv) = ros() else { return };
    const DOMAIN: u32 = 1;
    let mut bridge = Some(BridgeProcess::start(DOMAIN, DOMAIN, &[]));
    let participant = Participant::new(DOMAIN).unwrap();
    let mut peer = Peer::start(&venv, DOMAIN, "survivor");
    let here = publisher(&participant, "/to_ros", STRING, Qos::default());
    let from_ros = subscription(&participant, "/from_ros", STRING, Qos::default());
    let there = peer.subscription("/to_ros", STRING, json!({}));
    let theirs = peer.publisher("/from_ros", STRING, json!({}));
    matched(&here, 1);
    here.publish(&text_body("before")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["before"]);

    recovers("a bridge that was killed and restarted", || {
        if let Some(bridge) = bridge.take() {
            bridge.kill();
        }
        bridge = Some(BridgeProcess::start(DOMAIN, DOMAIN, &[]));
        // Published until it is heard: nobody knows yet that the one before has gone.
        let mut heard = Vec::new();
        wait_until("something to be heard of the new bridge", || {
            here.publish(&text_body("after")).unwrap();
            heard = peer.take_texts(there, 0);
            !heard.is_empty()
        });
        assert!(heard.iter().all(|text| text == "after"), "{heard:?}");
        wait_until("something to be heard through the new bridge", || {
            peer.publish_text(theirs, &["after"]);
            from_ros.try_take().unwrap().is_some()
        });
    });

    recovers("a bridge that was killed while another one stood by", || {
        let next = BridgeProcess::stand_by(DOMAIN, DOMAIN);
        assert!(next.stats().is_null(), "it waits");
        bridge.replace(next).unwrap().kill();
        bridge.as_mut().unwrap().wait_for_numbers();
        let mut heard = Vec::new();
        wait_until("something to be heard of the one that stood by", || {
            here.publish(&text_body("by the next")).unwrap();
            heard = peer.take_texts(there, 0);
            heard.iter().any(|text| text == "by the next")
        });
        wait_until("something to be heard through the one that stood by", || {
            peer.publish_text(theirs, &["by the next"]);
            std::iter::from_fn(|| from_ros.try_take().unwrap())
                .any(|sample| sample.body() == text_body("by the next"))
        });
    });

    let mut peer = Some(peer);
    recovers("a node that was killed and restarted", || {
        if let Some(peer) = peer.take() {
            peer.kill();
        }
        let peer = peer.insert(Peer::start(&venv, DOMAIN, "survivor"));
        let there = peer.subscription("/to_ros", STRING, json!({}));
        let theirs = peer.publisher("/from_ros", STRING, json!({}));
        peer.matched(theirs, 1);
        peer.publish_text(theirs, &["again"]);
        let mut last = String::new();
        while last != "again" {
            last = take_texts(&from_ros, 1).pop().unwrap();
        }
        peer.matched(there, 1);
        here.publish(&text_body("again")).unwrap();
        assert_eq!(peer.take_texts(there, 1).last().map(String::as_str), Some("again"));
    });
}

#[test]
fn bursts_as_long_as_the_queue_arrive_whole_and_in_order() {
    const BURST: usize = 1000;
    let Some((_bridge, participant, mut peer)) = joined(2, "bursts") else { return };
    let texts: Vec<String> = (0..BURST).map(|number| format!("{number}")).collect();

    let here = publisher(&participant, "/to_ros", STRING, Qos::keep_last(BURST));
    let there = peer.subscription("/to_ros", STRING, json!({ "depth": BURST }));
    matched(&here, 1);
    // Printed, not judged: what Fast DDS's shared memory has no room for comes with its heartbeat of 3 s.
    let since = Instant::now();
    publish_texts(&here, &texts);
    assert_eq!(peer.take_texts(there, BURST), texts);
    println!("to ROS: {:?}", since.elapsed());

    let here = subscription(&participant, "/from_ros", STRING, Qos::keep_last(BURST));
    let there = peer.publisher("/from_ros", STRING, json!({ "depth": BURST }));
    peer.matched(there, 1);
    let since = Instant::now();
    peer.publish_text(there, &texts);
    assert_eq!(take_texts(&here, BURST), texts);
    println!("from ROS: {:?}", since.elapsed());
    assert_eq!(here.counters().lost(), 0);
}

#[test]
fn images_of_8_mib() {
    const BYTES: usize = 8 << 20;
    const IMAGE: &str = "sensor_msgs/msg/Image";
    let Some((_bridge, participant, mut peer)) = joined(3, "images") else { return };
    let from_ros = subscription(&participant, "/from_ros", IMAGE, Qos::keep_last(5));
    let theirs = peer.publisher("/from_ros", IMAGE, json!({ "depth": 5 }));
    let here = publisher(&participant, "/to_ros", IMAGE, Qos::keep_last(5));
    let there = peer.tell(json!({
        "do": "subscription", "topic": "/to_ros", "type": IMAGE, "qos": { "depth": 5 }, "digest": true
    }));
    let there = there.as_u64().unwrap();
    peer.matched(theirs, 1);
    matched(&here, 1);
    let large =
        |seed| json!({ "do": "publish_large", "end": theirs, "type": IMAGE, "bytes": BYTES, "seed": seed });
    for seed in 0..3 {
        let digest = peer.tell(large(seed));
        // And back, as it came.
        let bodies = take(&from_ros, 1);
        here.publish(&bodies[0]).unwrap();
        assert_eq!(peer.take(there, 1), [digest]);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics by discovery, with rclpy on the other side: they come and go with their ends, and arrive in order.

mod support;

use rustix::process::Signal;
use serde_json::json;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use support::{
    BridgeProcess, Peer, STRING, joined, matched, publish_texts, publisher, ros, subscription, take_texts,
    text_body, wait_until,
};
use tautline_transport::{Limits, Participant, Qos, TopicType};

#[test]
fn texts_go_both_ways_and_topics_come_and_go() {
    let Some((bridge, participant, mut peer)) = joined(27, "both_ways") else { return };

    let here = publisher(&participant, "/to_ros", STRING, Qos::default());
    let there = peer.subscription("/to_ros", STRING, json!({}));
    matched(&here, 1);
    publish_texts(&here, &["one", "", "thrée"]);
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

/// The reader in ROS is stopped, so that more is on its way than Fast DDS's queue in shared memory takes: what is sent again after that needs the
/// writer, which must not end with the publisher that it mirrors.
#[test]
fn what_a_publisher_sent_before_it_ended_arrives_in_ros() {
    const COUNT: usize = 900;
    let Some((bridge, participant, mut peer)) = joined(43, "late") else { return };
    let there = peer.subscription("/last_words", STRING, json!({ "depth": COUNT }));
    let here = publisher(&participant, "/last_words", STRING, Qos::keep_last(COUNT));
    matched(&here, 1);
    here.publish(&text_body("first")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["first"]);
    peer.signal(Signal::STOP);
    let texts: Vec<_> = (0..COUNT).map(|number| number.to_string()).collect();
    publish_texts(&here, &texts);
    drop(here);
    wait_until("all are sent", || bridge.topic("/last_words", "to_ros")["messages"] == 1 + COUNT);
    peer.signal(Signal::CONT);
    assert_eq!(peer.take_texts(there, COUNT), texts);
}

/// It gets more than 5000 messages: a keep-all writer of Fast DDS keeps these, and then waits at each further one.
#[test]
fn a_reader_in_ros_that_takes_nothing_holds_nothing_up() {
    const DEPTH: usize = 2000;
    let Some((bridge, participant, mut peer)) = joined(48, "stopped") else { return };
    let there = peer.subscription("/untaken", STRING, json!({}));
    let here = publisher(&participant, "/untaken", STRING, Qos::keep_all(DEPTH));
    matched(&here, 1);
    here.publish(&text_body("first")).unwrap();
    assert_eq!(peer.take_texts(there, 1), ["first"]);
    peer.signal(Signal::STOP);
    for batch in 1..=3 {
        (0..DEPTH).for_each(|_| here.publish(&text_body("untaken")).unwrap());
        wait_until("all are sent", || bridge.topic("/untaken", "to_ros")["messages"] == 1 + batch * DEPTH);
    }
    let numbers = bridge.topic("/untaken", "to_ros");
    assert_eq!((&numbers["lost"], &numbers["dropped"]), (&json!(0), &json!({})));
    peer.signal(Signal::CONT);
}

#[test]
fn nothing_is_lost_while_a_deeper_subscription_joins() {
    let Some((bridge, participant, mut peer)) = joined(32, "counting") else { return };
    let subscribe = |depth| {
        let string = TopicType::new(STRING.to_owned());
        participant
            .create_raw_subscription("/numbers", &string, Qos::keep_last(depth), Limits::default())
            .unwrap()
    };
    let first = subscribe(1000);
    let there = peer.publisher("/numbers", STRING, json!({ "depth": 1000 }));
    peer.matched(there, 1);

    // The bridge's subscription in ROS is to be deeper, so there is another for a while.
    let deeper = subscribe(3000);
    let (mut sent, mut ends) = (0, vec![1]);
    wait_until("the deeper subscription has replaced the first", || {
        let texts: Vec<_> = (sent..sent + 10).map(|number| number.to_string()).collect();
        peer.publish_text(there, &texts);
        assert_eq!(take_texts(&first, texts.len()), texts);
        sent += texts.len();
        let count = peer.tell(json!({ "do": "others", "end": there })).as_u64().unwrap();
        if ends.last() != Some(&count) {
            ends.push(count);
        }
        ends.starts_with(&[1, 2, 1])
    });
    drop(deeper);
    wait_until("all are counted", || bridge.topic("/numbers", "from_ros")["messages"] == sent);
    let numbers = bridge.topic("/numbers", "from_ros");
    assert_eq!((&numbers["lost"], &numbers["dropped"]), (&json!(0), &json!({})));
}

#[test]
fn nothing_is_lost_on_a_topic_that_both_sides_publish() {
    const DOMAIN: u32 = 33;
    let Some((bridge, _)) = both_sides_publish(DOMAIN, |_| {}) else { return };
    assert_eq!(bridge.stats()["returned"], 0, "the bridge's own messages came back to it");
}

#[test]
fn own_messages_that_a_users_profile_returns_are_passed_over() {
    const DOMAIN: u32 = 44;
    let folder = tempfile::tempdir().unwrap();
    let profile = folder.path().join("user.xml");
    let nothing = "<profiles><participant profile_name=\"user\" is_default_profile=\"true\"/></profiles>";
    std::fs::write(&profile, nothing).unwrap();
    let with_profile = |command: &mut Command| {
        command.env("FASTRTPS_DEFAULT_PROFILES_FILE", profile);
    };
    let Some((bridge, sent)) = both_sides_publish(DOMAIN, with_profile) else { return };
    wait_until("its own have come back", || bridge.stats()["returned"] == sent);
}

/// The bridge that all went through, and how many of the messages went to ROS; `None`: there is no ROS 2.
fn both_sides_publish(domain: u32, change: impl FnOnce(&mut Command)) -> Option<(BridgeProcess, usize)> {
    let venv = ros()?;
    const FROM_ROS: usize = 1000;
    const MOST_FROM_HERE: usize = 2000;
    const DEPTH: usize = FROM_ROS + MOST_FROM_HERE;
    let bridge = BridgeProcess::start_with(domain, domain, &["--no-rt"], change);
    let participant = Participant::new(domain).unwrap();
    let mut peer = Peer::start(&venv, domain, "both");
    let here = publisher(&participant, "/both", STRING, Qos::keep_last(DEPTH));
    let heard_here = subscription(&participant, "/both", STRING, Qos::keep_last(DEPTH));
    let there = peer.publisher("/both", STRING, json!({ "depth": DEPTH }));
    let heard_there = peer.subscription("/both", STRING, json!({ "depth": DEPTH }));
    matched(&here, 2);
    peer.matched(there, 2);
    peer.matched(heard_there, 2);

    // Those from ROS come to the bridge between its own.
    let texts = |from: &str, count| (0..count).map(|number| format!("{from} {number}")).collect::<Vec<_>>();
    let from_ros = texts("ros", FROM_ROS);
    let is_over = AtomicBool::new(false);
    let (here, from_here) = std::thread::scope(|scope| {
        let publishing = scope.spawn(|| {
            let here = here;
            let mut sent = texts("here", MOST_FROM_HERE);
            let is_last = |text: &String| {
                here.publish(&text_body(text)).unwrap();
                std::thread::sleep(Duration::from_micros(20));
                is_over.load(Ordering::Acquire)
            };
            let count = sent.iter().position(is_last).map_or(sent.len(), |last| last + 1);
            sent.truncate(count);
            // What has not been taken yet goes with the publisher.
            (here, sent)
        });
        peer.publish_text(there, &from_ros);
        is_over.store(true, Ordering::Release);
        publishing.join().unwrap()
    });
    let of = |from: &str, all: Vec<String>| -> Vec<String> {
        all.into_iter().filter(|text| text.starts_with(from)).collect()
    };
    let count = from_here.len() + FROM_ROS;
    assert_eq!(of("ros", take_texts(&heard_here, count)), from_ros);
    assert_eq!(of("here", peer.take_texts(heard_there, count)), from_here);
    drop(here);
    wait_until("all are counted", || bridge.topic("/both", "from_ros")["messages"] == FROM_ROS);
    assert_eq!(bridge.topic("/both", "from_ros")["lost"], 0);
    Some((bridge, from_here.len()))
}

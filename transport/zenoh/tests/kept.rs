// SPDX-License-Identifier: MIT OR Apache-2.0
//! Samples that publishers keep are requested also if a publisher was missed when it appeared, or a request was; others' go on meanwhile.

mod support;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use support::{Host, UNKNOWN_HASH, string_type, take, until, wait};
use tautline_gateway::wire::{Attachment, ENCAPSULATION, Token, endpoint_gid};
use tautline_transport::Qos;
use zenoh::Wait;
use zenoh::qos::CongestionControl;
use zenoh::query::Query;
use zenoh::sample::SourceInfo;

/// A node on rmw_zenoh with two publishers of a topic, of which the network has lost the word.
#[test]
fn what_was_missed_is_requested_again() {
    let host = Host::first(99, 99);
    let far = host.session();
    let name = format!("std_msgs::msg::dds_::String_/{UNKNOWN_HASH}");
    let key = format!("99/map/{name}");
    let publishers = [(); 2].map(|()| far.declare_publisher(key.clone()).wait().unwrap());
    let zid = u128::from_le_bytes(far.zid().to_le_bytes());
    let tokens = [1, 2].map(|id| format!("@ros2_lv/99/{zid:x}/0/{id}/MP/%/%/n/%map/{name}/:1:,3:,:,:,,"));
    let declared = tokens.each_ref().map(|token| far.liveliness().declare_token(token).wait().unwrap());
    let caches = publishers.each_ref().map(|publisher| {
        let id = publisher.id();
        far.declare_queryable(format!("{key}/@adv/pub/{}/{}/_", id.zid(), id.eid())).wait().unwrap()
    });
    let request = |n: usize| caches[n].recv_timeout(Duration::from_secs(30)).unwrap().expect("a request");
    let answer = |n: usize, request: &Query| {
        let gid = endpoint_gid(&Token::parse(&tokens[n]).unwrap());
        for number in 1..=2 {
            let body = [&ENCAPSULATION[..], &[n as u8, number]].concat();
            let attachment = Attachment { sequence_number: number.into(), source_timestamp_ns: 0, gid };
            let info = SourceInfo::new(publishers[n].id(), number.into());
            request.reply(&key, body).attachment(&attachment.encode()[..]).source_info(info).wait().unwrap();
        }
    };
    let subscription = host.subscription("/map", &string_type(), Qos::keep_last(3).transient_local());
    let next = || take(&subscription).body().to_vec();
    // The first one answers; the second one has answered nothing.
    answer(0, &request(0));
    drop(request(1));
    assert_eq!([next(), next()], [[0, 1], [0, 2]]);
    // It is asked once more, and the first one's answer is not delivered twice.
    answer(0, &request(0));
    answer(1, &request(1));
    assert_eq!([next(), next()], [[1, 1], [1, 2]]);
    assert!(subscription.try_take().unwrap().is_none());
    drop(declared);
}

/// A topic's way in starts anew each time that somebody asks for more kept samples than anybody before. Nobody keeps what a volatile publisher
/// sends meanwhile.
#[test]
fn a_volatile_publisher_loses_nothing_while_its_topics_way_starts_anew() {
    const PROBE: u64 = u64::MAX;
    let host = Host::first(151, 151);
    let far = host.session();
    let name = format!("std_msgs::msg::dds_::String_/{UNKNOWN_HASH}");
    let zid = u128::from_le_bytes(far.zid().to_le_bytes());
    let [volatile, keeping] = [(1, "::,1:,:,:,,"), (2, ":1:,1:,:,:,,")]
        .map(|(id, qos)| format!("@ros2_lv/151/{zid:x}/0/{id}/MP/%/%/n/%map/{name}/{qos}"));
    let _declared = [&volatile, &keeping].map(|token| far.liveliness().declare_token(token).wait().unwrap());
    let publisher = far.declare_publisher(format!("151/map/{name}"));
    let publisher = publisher.congestion_control(CongestionControl::Block).wait().unwrap();
    let gid = endpoint_gid(&Token::parse(&volatile).unwrap());
    let publish = |number: u64| {
        let attachment = Attachment { sequence_number: (number % PROBE) as i64, source_timestamp_ns: 0, gid };
        let body = [&ENCAPSULATION[..], &number.to_le_bytes()].concat();
        publisher.put(body).attachment(&attachment.encode()[..]).wait().unwrap();
    };
    // Room for all, so that whatever is missing was lost on the way.
    let subscription = host.subscription("/map", &string_type(), Qos::keep_last(65_000));
    let mut heard = Vec::new();
    let take_all = |heard: &mut Vec<u64>| {
        let samples = std::iter::from_fn(|| subscription.try_take_valid().unwrap());
        heard.extend(samples.map(|sample| u64::from_le_bytes(sample.body().try_into().unwrap())));
        !heard.is_empty()
    };
    until("the way", || {
        publish(PROBE);
        take_all(&mut heard)
    });
    let has_ended = &AtomicBool::new(false);
    let count = std::thread::scope(|scope| {
        let stream = scope.spawn(|| {
            // A minute at most, if nobody ends it.
            let numbers = (0..1_000_000).take_while(|_| !has_ended.load(Ordering::Relaxed));
            let paced = numbers.inspect(|_| std::thread::sleep(Duration::from_micros(10)));
            paced.map(publish).count() as u64
        });
        let ask = |depth: usize| {
            let late = host.subscription("/map", &string_type(), Qos::keep_last(depth).transient_local());
            // Only a way that keeps samples has any for it. It starts anew while others pass.
            until("a sample that is kept", || {
                take_all(&mut heard);
                late.try_take_valid().unwrap().is_some()
            });
            let enough = heard.len() + 2000;
            until("many others", || {
                take_all(&mut heard);
                heard.len() >= enough
            });
            late
        };
        let _late = [1, 2, 4, 8, 16, 32, 64, 128].map(ask);
        has_ended.store(true, Ordering::Relaxed);
        stream.join().unwrap()
    });
    until("the last one", || {
        take_all(&mut heard);
        heard.contains(&(count - 1))
    });
    heard.retain(|number| *number != PROBE);
    heard.sort_unstable();
    assert!(heard.iter().copied().eq(0..count), "{} of {count}", heard.len());
}

/// By the time stamps a receiver whose clock is behind cannot tell kept samples from new ones: Zenoh replaces those of new ones there.
#[test]
fn samples_that_are_kept_are_numbered() {
    let host = Host::first(153, 153);
    let far = host.session();
    let kept = Qos::keep_last(3).transient_local();
    for (topic, qos) in [("reliable", kept), ("best_effort", kept.best_effort())] {
        let key = format!("153/{topic}/std_msgs::msg::dds_::String_/{UNKNOWN_HASH}");
        let samples = far.declare_subscriber(key).wait().unwrap();
        let publisher = host.publisher(&format!("/{topic}"), &string_type(), qos);
        let sample = wait("a sample", || {
            publisher.publish(b"kept").unwrap();
            samples.recv_timeout(Duration::from_millis(5)).unwrap()
        });
        assert!(sample.source_info().is_some(), "{topic}");
    }
}

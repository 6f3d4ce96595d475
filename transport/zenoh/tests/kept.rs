// SPDX-License-Identifier: MIT OR Apache-2.0
//! Samples that publishers keep are requested also if a publisher was missed when it appeared, or a request was.

mod support;

use std::time::Duration;
use support::{Host, UNKNOWN_HASH, string_type, take};
use tautline_gateway::wire::{Attachment, ENCAPSULATION, Token, endpoint_gid};
use tautline_transport::Qos;
use zenoh::Wait;
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of both generations of rmw_zenoh's wire, played by a plain session of Zenoh: until 0.10.4, and from 0.10.5 on, whose tokens
//! name buffer backends and whose samples may come below the topic's key.

mod support;

use std::sync::mpsc;
use support::{Host, UNKNOWN_HASH, connect, string_type, take, until, wait};
use tautline_gateway::Direction;
use tautline_gateway::wire::{Attachment, Token, TopicKey, endpoint_gid};
use tautline_transport::Qos;
use zenoh::Wait;

const DOMAIN: u32 = 76;
const TYPE: &str = "std_msgs::msg::dds_::String_";

#[test]
fn nodes_of_both_generations_find_and_hear_ours() {
    let host = Host::first(DOMAIN, DOMAIN);
    let subscription = host.subscription("/x", &string_type(), Qos::keep_last(100));
    let peer = host.session();
    let key = TopicKey::parse(&format!("{DOMAIN}/x/{TYPE}/{UNKNOWN_HASH}")).unwrap();

    // What a newer publisher looks for before it sends to the key below.
    let (found, tokens) = mpsc::channel();
    let look = peer.liveliness().declare_subscriber(format!("@ros2_lv/{DOMAIN}/*/*/*/MS/**")).history(true);
    let told = move |sample: zenoh::sample::Sample| drop(found.send(sample.key_expr().to_string()));
    let _look = look.callback(told).wait().unwrap();
    let announced = wait("our subscription's token", || tokens.try_recv().ok());
    // It reads six fields of the QoS.
    let [.., qos, backends] = *announced.split('/').collect::<Vec<_>>() else { panic!("{announced}") };
    assert!(qos.starts_with("::,100:,:,:,,:tautline,") && backends == "backends:cpu:", "{announced}");

    for (id, suffix, at) in [(1, "", key.to_string()), (2, "/backends:cpu:;cuda:0", key.cpu_group())] {
        let token =
            format!("@ros2_lv/{DOMAIN}/bad/0/{id}/MP/%/%/n/%x/{TYPE}/{UNKNOWN_HASH}/::,10:,:,:,,{suffix}");
        let gid = endpoint_gid(&Token::parse(&token).unwrap());
        let _token = peer.liveliness().declare_token(token).wait().unwrap();
        let listed = || {
            let graph = host.participant.graph().unwrap();
            graph.endpoints.iter().any(|end| end.gid == gid)
        };
        until("the publisher to be listed by the gid that it sends", listed);
        let put = |number: i64| {
            let attachment = Attachment { sequence_number: number, source_timestamp_ns: 1, gid };
            let body = [&[0, 1, 0, 0, 3, 0, 0, 0][..], b"ab\0"].concat();
            peer.put(&at, body).attachment(&attachment.encode()[..]).wait().unwrap();
        };
        let mut number = 0;
        until("a sample", || {
            number += 2;
            put(number);
            subscription.try_take_valid().unwrap().is_some_and(|sample| sample.info().publisher_gid == gid)
        });
        put(number + 2);
        while take(&subscription).info().sequence_number != number as u64 + 2 {}
        let lost = || {
            let topics = host.stats().topics.into_iter();
            let mut of_topic =
                topics.filter(|stats| stats.name.topic == "/x" && stats.direction == Direction::In);
            of_topic.next().map(|stats| stats.reading.lost)
        };
        // A newer one counts what it sends to each: gaps are no losses.
        let before = lost();
        if suffix.is_empty() {
            until("gaps to be counted", || lost() > Some(0));
        } else {
            assert_eq!(lost(), before);
        }
    }

    // What is sent here goes to the topic's own key, which both read.
    let (arrived, samples) = mpsc::channel();
    let of_topic = peer.declare_subscriber(key.to_string());
    let _reader = of_topic.callback(move |sample| drop(arrived.send(sample))).wait().unwrap();
    let reader =
        format!("@ros2_lv/{DOMAIN}/bad/0/9/MS/%/%/n/%x/{TYPE}/{UNKNOWN_HASH}/::,10:,:,:,,/backends:cpu:");
    let _token = peer.liveliness().declare_token(reader).wait().unwrap();
    let publisher = host.publisher("/x", &string_type(), Qos::keep_last(10));
    connect(&publisher, &[&subscription], b"probe");
    until("a sample of ours", || {
        publisher.publish(&[3, 0, 0, 0, b'a', b'b', 0]).unwrap();
        samples.try_recv().is_ok_and(|sample| sample.attachment().is_some())
    });
}

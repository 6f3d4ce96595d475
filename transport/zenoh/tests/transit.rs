// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a bridge tells of in one host's domain, on another host: a participant plays the bridge, no ROS 2 is needed.

mod support;

use std::collections::BTreeMap;
use support::{Host, connect, stats, string_type, take, until, wait};
use tautline_gateway::Direction;
use tautline_transport::{
    EndpointKind, Gid, Limits, MessageInfo, NodeName, Origin, Participant, Qos, RawPublisher, RawSample,
    RawSubscription, RemoteGraph, TopicEndpoint,
};

const COUNT: u64 = 200;
/// The ends that are told of, as they are called where they are.
const TALKER: Gid = Gid([7; 16]);
const LISTENER: Gid = Gid([8; 16]);

fn qos() -> Qos {
    Qos::keep_last(1000)
}

/// Of the node `/theirs/node`.
fn end(kind: EndpointKind, topic: &str, gid: Gid) -> TopicEndpoint {
    TopicEndpoint {
        kind,
        topic: topic.into(),
        topic_type: string_type(),
        gid,
        qos: qos(),
        node: Some(NodeName { namespace: "/theirs".into(), name: "node".into() }),
        pid: None,
        is_remote: true,
        is_own: false,
        origin: Origin::default(),
        teller: None,
    }
}

/// Tells of ends in a host's domain, as a bridge does.
fn bridge(host: &Host, endpoints: Vec<TopicEndpoint>) -> Participant {
    let bridge = Participant::new(host.domain).unwrap();
    bridge.set_remote(&RemoteGraph { endpoints, ..RemoteGraph::default() }).unwrap();
    bridge
}

/// A bridge's way in.
fn port(bridge: &Participant, topic: &str) -> RawPublisher {
    bridge.create_raw_publisher(topic, &string_type(), qos(), Limits::default()).unwrap()
}

/// A bridge's way out.
fn taking(bridge: &Participant, topic: &str) -> RawSubscription {
    bridge.create_relay_subscription(topic, &string_type(), qos(), Limits::default()).unwrap()
}

/// Lets in what [`TALKER`] published under this number.
fn pass(port: &RawPublisher, number: u64) {
    let body = number.to_le_bytes();
    let mut loan = port.loan(body.len()).unwrap();
    loan.copy_from_slice(&body);
    let source_timestamp_ns = i64::try_from(number).unwrap();
    let (sequence_number, publisher_gid) = (number, TALKER);
    let source = MessageInfo { sequence_number, source_timestamp_ns, released_ns: 0, publisher_gid };
    loan.publish_as(source).unwrap();
}

/// The end of another host that is listed on this one.
fn listed(host: &Host, kind: EndpointKind, topic: &str) -> TopicEndpoint {
    wait("an end of another host", || {
        let graph = host.participant.graph().unwrap();
        let is_it = |end: &TopicEndpoint| {
            end.kind == kind && end.topic == topic && end.is_remote && end.gid != TALKER
        };
        graph.endpoints.iter().find(|end| is_it(end)).map(|end| (**end).clone())
    })
}

/// Passes messages with growing numbers until one has arrived. Returns the number that is next.
fn reach(port: &RawPublisher, subscription: &RawSubscription) -> u64 {
    let mut next = 1;
    let first = wait("a message", || {
        pass(port, next);
        next += 1;
        subscription.try_take_valid().unwrap()
    });
    // From the first on none is missing.
    for number in first.info().sequence_number + 1..next {
        assert_eq!(take(subscription).info().sequence_number, number);
    }
    next
}

/// So many went through the host's gateway, and none was dropped or lost.
fn nothing_was_dropped(host: &Host, topic: &str, direction: Direction, count: u64) {
    let stats = wait("the statistics", || {
        stats(host, topic, direction).filter(|stats| stats.reading.messages >= count)
    });
    assert!(stats.reading.dropped.is_empty() && stats.reading.lost == 0, "{stats:?}");
}

#[test]
fn what_a_bridge_tells_of_crosses_to_other_hosts() {
    let a = Host::first(72, 72);
    let b = Host::beside(&a, 73);
    let bridge = bridge(&a, vec![end(EndpointKind::Publisher, "/far", TALKER)]);
    let port = port(&bridge, "/far");
    let talker = listed(&b, EndpointKind::Publisher, "/far");
    assert_eq!(talker.node.unwrap().full_name(), "/theirs/node");
    assert_eq!((talker.topic_type, talker.qos), (string_type(), qos()));

    let subscription = b.subscription("/far", &string_type(), qos());
    listed(&a, EndpointKind::Subscription, "/far");
    let next = reach(&port, &subscription);
    for number in next..next + COUNT {
        pass(&port, number);
    }
    for number in next..next + COUNT {
        let sample = take(&subscription);
        assert_eq!(sample.body(), number.to_le_bytes());
        assert_eq!(support::origin(sample.info()), (number, i64::try_from(number).unwrap()));
        assert_eq!(sample.info().publisher_gid, talker.gid, "as it is listed here");
    }
    nothing_was_dropped(&a, "/far", Direction::Out, COUNT);
    nothing_was_dropped(&b, "/far", Direction::In, COUNT);
    assert!(subscription.try_take().unwrap().is_none());

    // What is no longer told of has gone.
    bridge.set_remote(&RemoteGraph::default()).unwrap();
    until("its end", || {
        let graph = b.participant.graph().unwrap();
        graph.endpoints.iter().all(|end| !end.is_remote) && graph.nodes.iter().all(|node| !node.is_remote)
    });
}

#[test]
fn demand_crosses_too() {
    let a = Host::first(74, 74);
    let b = Host::beside(&a, 75);
    let publisher = b.publisher("/wanted", &string_type(), qos());
    let bridge = bridge(&a, vec![end(EndpointKind::Subscription, "/wanted", LISTENER)]);
    let taken = taking(&bridge, "/wanted");
    let listener = listed(&b, EndpointKind::Subscription, "/wanted");
    assert_eq!(listener.node.unwrap().full_name(), "/theirs/node");
    let talker = listed(&a, EndpointKind::Publisher, "/wanted");

    connect(&publisher, &[&taken], b"probe");
    for number in 0..COUNT {
        publisher.publish(&number.to_le_bytes()).unwrap();
    }
    let mut numbers = Vec::new();
    for number in 0..COUNT {
        let sample = take(&taken);
        assert_eq!(sample.body(), number.to_le_bytes());
        assert_eq!(sample.info().publisher_gid, talker.gid, "as it is listed here");
        numbers.push(sample.info().sequence_number);
    }
    assert!(numbers.windows(2).all(|pair| pair[1] == pair[0] + 1), "{numbers:?}");
    nothing_was_dropped(&b, "/wanted", Direction::Out, COUNT);
    nothing_was_dropped(&a, "/wanted", Direction::In, COUNT);
    assert!(taken.try_take().unwrap().is_none());
}

/// On one topic: what the bridge lets in and what it takes do not meet.
#[test]
fn both_ways_at_once_nothing_comes_twice_or_is_dropped() {
    let a = Host::first(77, 77);
    let b = Host::beside(&a, 87);
    let ends = vec![
        end(EndpointKind::Publisher, "/both", TALKER),
        end(EndpointKind::Subscription, "/both", LISTENER),
    ];
    let bridge = bridge(&a, ends);
    let (port, taken) = (port(&bridge, "/both"), taking(&bridge, "/both"));
    let talker = listed(&b, EndpointKind::Publisher, "/both").gid;
    let subscription = b.subscription("/both", &string_type(), qos());
    let next = reach(&port, &subscription);
    // What it has heard of itself.
    while taken.try_take().unwrap().is_some() {}
    let publisher = b.publisher("/both", &string_type(), qos());
    connect(&publisher, &[&subscription, &taken], b"probe");
    // Here, too, the publisher is known by what its host has announced.
    let native = listed(&a, EndpointKind::Publisher, "/both").gid;

    for number in 0..COUNT {
        pass(&port, next + number);
        publisher.publish(&number.to_le_bytes()).unwrap();
    }
    // Sorted by who published them.
    let sorted = |subscription: &RawSubscription| {
        let mut bodies = BTreeMap::<Gid, Vec<u64>>::new();
        for _ in 0..2 * COUNT {
            let sample: RawSample = take(subscription);
            let number = u64::from_le_bytes(sample.body().try_into().unwrap());
            bodies.entry(sample.info().publisher_gid).or_default().push(number);
        }
        assert!(subscription.try_take().unwrap().is_none());
        bodies
    };
    let theirs: Vec<u64> = (next..next + COUNT).collect();
    let own: Vec<u64> = (0..COUNT).collect();
    assert_eq!(sorted(&subscription), [(talker, theirs.clone()), (publisher.gid(), own.clone())].into());
    // A bridge hears itself, and passes that over.
    let (mut there, port_gid) = (BTreeMap::<Gid, Vec<u64>>::new(), port.gid());
    while there.values().map(Vec::len).sum::<usize>() < own.len() {
        let sample = take(&taken);
        if sample.port_gid() != port_gid {
            let number = u64::from_le_bytes(sample.body().try_into().unwrap());
            there.entry(sample.info().publisher_gid).or_default().push(number);
        }
    }
    assert_eq!(there, [(native, own)].into());
    for host in [&a, &b] {
        for direction in [Direction::Out, Direction::In] {
            nothing_was_dropped(host, "/both", direction, COUNT);
        }
    }
}

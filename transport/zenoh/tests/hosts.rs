// SPDX-License-Identifier: MIT OR Apache-2.0
//! Two and three hosts: bytes, header fields, no loops, no traffic that nobody wants.

mod support;

use std::collections::HashSet;
use std::time::Duration;
use support::{Host, UNKNOWN_HASH, connect, image_type, stats, string_type, take, until, wait};
use tautline_gateway::Direction;
use tautline_gateway::wire::{Attachment, ENCAPSULATION, Token, endpoint_gid};
use tautline_ros_msgs::geometry_msgs::msg::Twist;
use tautline_ros_msgs::sensor_msgs::msg::{Image, ImageSizes};
use tautline_ros_msgs::std_msgs::msg::HeaderSizes;
use tautline_transport::{EndpointKind, Limits, Qos, ServiceKind, ServiceType};
use zenoh::Wait;
use zenoh::qos::CongestionControl;
use zenoh::query::Query;
use zenoh::sample::SourceInfo;

#[test]
fn bytes_of_every_size_arrive_as_they_were() {
    let a = Host::first(165, 165);
    let b = Host::beside(&a, 166);
    let qos = Qos::keep_last(4);
    let subscription = b.subscription("/image", &image_type(), qos);
    let publisher = a.publisher("/image", &image_type(), qos);
    connect(&publisher, &[&subscription], b"probe");
    for size in [0, 1, 3, 4, 64, 1000, 1024, 4096, 65_535, 1 << 20, 8 << 20] {
        let body: Vec<u8> = (0..size).map(|n: usize| (n * 7 + size) as u8).collect();
        publisher.publish(&body).unwrap();
        let sample = take(&subscription);
        assert!(sample.body() == body, "{size} bytes differ");
    }
    let out = stats(&a, "/image", Direction::Out);
    until("the statistics", || {
        stats(&b, "/image", Direction::In).is_some_and(|stats| stats.reading.messages > 10)
    });
    let inward = stats(&b, "/image", Direction::In).unwrap();
    assert_eq!(inward.reading.lost, 0, "{inward:?}");
    assert!(inward.reading.latency_us.is_some() && inward.reading.dropped.is_empty(), "{inward:?}");
    assert!(out.is_none_or(|out| out.active && out.reading.dropped.is_empty()));
}

/// Whoever is told that there is a subscription can send: nothing is put on a network that does not know yet who listens.
#[test]
fn what_is_published_once_it_is_matched_arrives() {
    let a = Host::first(107, 107);
    let b = Host::beside(&a, 108);
    for n in 0..40u8 {
        let topic = format!("/at_once_{n}");
        let qos = Qos::keep_last(10);
        // Either end may be there first.
        let here = || a.publisher(&topic, &string_type(), qos);
        let there = || b.subscription(&topic, &string_type(), qos);
        let (publisher, subscription) = if n % 2 == 0 {
            let publisher = here();
            (publisher, there())
        } else {
            let subscription = there();
            (here(), subscription)
        };
        until("a subscription", || publisher.subscription_count() == 1);
        (0..5).for_each(|m| publisher.publish(&[n, m]).unwrap());
        (0..5).for_each(|m| assert_eq!(take(&subscription).body(), [n, m]));
    }
}

/// Ends of generated types, plain and of any length: written in place on one host, read in place on the other.
#[test]
fn messages_are_written_here_and_read_there() {
    let a = Host::first(154, 154);
    let b = Host::beside(&a, 159);
    let (qos, limits) = (Qos::keep_last(4), Limits::default());
    let images = a.participant.create_publisher::<Image>("/image", qos, limits).unwrap();
    let viewer = b.participant.create_subscription::<Image>("/image", qos, limits).unwrap();
    let twists = b.participant.create_publisher::<Twist>("/cmd_vel", qos, limits).unwrap();
    let drive = a.participant.create_subscription::<Twist>("/cmd_vel", qos, limits).unwrap();

    let sizes = ImageSizes { header: HeaderSizes { frame_id: 6 }, encoding: 5, data: 640 * 480 };
    let sample = wait("an image", || {
        let loan = images.loan_with(sizes).unwrap().write(|image| {
            image.header.frame_id.set("camera")?;
            image.encoding.set("mono8")?;
            image.width.set(640);
            image.height.set(480);
            image.data.slice_mut().iter_mut().zip(0u32..).for_each(|(pixel, n)| *pixel = (n % 251) as u8);
            image.default_rest();
            Ok(())
        });
        loan.unwrap().publish().unwrap();
        std::thread::sleep(std::time::Duration::from_millis(5));
        viewer.try_take().unwrap()
    });
    let image = sample.view();
    assert_eq!((image.header().frame_id(), image.encoding()), ("camera", "mono8"));
    assert_eq!((image.width(), image.height(), image.step()), (640, 480, 0));
    assert!(
        image.data().len() == 640 * 480
            && image.data().iter().zip(0u32..).all(|(p, n)| u32::from(*p) == n % 251)
    );

    let twist = wait("a twist", || {
        let mut loan = twists.loan().unwrap();
        (loan.linear.x, loan.angular.z) = (0.5, -2.0);
        loan.publish().unwrap();
        std::thread::sleep(std::time::Duration::from_millis(5));
        drive.try_take().unwrap()
    });
    assert_eq!((twist.linear.x, twist.angular.z), (0.5, -2.0));
}

/// By their real names, also those without topics; services; and ends as they are there, not their stand-ins here.
#[test]
fn hosts_see_each_others_nodes() {
    let a = Host::first(113, 113);
    let b = Host::beside(&a, 114);
    let node = a.participant.create_node_in_enclave("talker", "/robot", "/front/left").unwrap();
    let silent = a.participant.create_node("silent", "/").unwrap();
    let qos = Qos::keep_last(7).best_effort().transient_local();
    let publisher = a
        .participant
        .for_node(&node)
        .create_raw_publisher("/chatter", &string_type(), qos, Limits::default())
        .unwrap();
    let service_type = ServiceType::new("a_msgs/srv/Add", Some(UNKNOWN_HASH));
    let (of_node, of_silent) = (a.participant.for_node(&node), a.participant.for_node(&silent));
    let service = of_node.create_raw_server("/robot/add", &service_type, 10, Limits::default()).unwrap();
    let _client = of_silent.create_raw_client("/robot/add", &service_type, Limits::default()).unwrap();
    let _subscription = b.subscription("/chatter", &string_type(), Qos::keep_last(7));

    let names = |host: &Host| -> Vec<(String, bool)> {
        host.participant
            .graph()
            .unwrap()
            .nodes
            .iter()
            .map(|node| (node.name.full_name(), node.is_remote))
            .collect()
    };
    until("nodes", || names(&b).len() >= 2);
    assert_eq!(names(&b), [("/silent".into(), true), ("/robot/talker".into(), true)]);
    let nodes = b.participant.graph().unwrap().nodes.clone();
    let enclaves: Vec<&str> = nodes.iter().map(|node| &*node.enclave).collect();
    assert_eq!(enclaves, ["/", "/front/left"]);
    // Also in the tokens of what belongs to the node, as any peer of the network sees them.
    let tokens = b.gateway().remote();
    let theirs = tokens.iter().filter(|token| token.node.name == "talker");
    let theirs: Vec<_> = theirs.map(|token| (&*token.node.enclave, token.endpoint.is_some())).collect();
    assert!(theirs.iter().all(|(enclave, _)| *enclave == "/front/left"), "{theirs:?}");
    assert!([true, false].iter().all(|is_end| theirs.iter().any(|(_, end)| end == is_end)), "{theirs:?}");
    let services = || {
        let mut services = b.participant.graph().unwrap().services.clone();
        // Beside those that tell of types.
        services.retain(|end| end.name == "/robot/add");
        services
    };
    until("services", || services().len() == 2);
    let graph = wait("everything", || {
        let graph = b.participant.graph().unwrap();
        (graph.endpoints.len() == 2).then_some(graph)
    });
    let [there, here] = &*graph.endpoints else { panic!("{graph:?}") };
    assert_eq!(
        (there.kind, &*there.topic, &there.topic_type),
        (EndpointKind::Publisher, "/chatter", &string_type())
    );
    assert_eq!((there.node.as_ref(), there.qos, there.is_remote), (Some(node.name()), qos, true));
    assert!(here.kind == EndpointKind::Subscription && !here.is_remote && here.is_own);
    let [server, client] = &*services() else { panic!("{graph:?}") };
    assert_eq!(
        (server.kind, server.node.as_ref(), client.kind),
        (ServiceKind::Server, Some(node.name()), ServiceKind::Client)
    );
    assert_eq!((&*server.type_name, server.type_hash.as_deref()), ("a_msgs/srv/Add", Some(UNKNOWN_HASH)));
    // What is nobody's node's is its process's.
    let theirs = wait("b's subscription", || {
        let graph = a.participant.graph().unwrap();
        graph.endpoints.iter().find(|end| end.is_remote).cloned()
    });
    assert!(theirs.node.as_ref().unwrap().name.ends_with(&std::process::id().to_string()));

    drop(service);
    until("the end of a service", || services().len() == 1);
    drop((node, of_node, publisher));
    until("the end of a node", || names(&b).len() == 1);
    drop(a);
    until("the end of a host", || names(&b).is_empty());
}

#[test]
fn header_fields_survive() {
    let a = Host::first(167, 167);
    let b = Host::beside(&a, 168);
    let near = a.subscription("/chatter", &string_type(), Qos::keep_last(100));
    let far = b.subscription("/chatter", &string_type(), Qos::keep_last(100));
    let publisher = a.publisher("/chatter", &string_type(), Qos::keep_last(100));
    connect(&publisher, &[&near, &far], b"probe");
    let mut gids = HashSet::new();
    for n in 0..20u8 {
        publisher.publish(&[n; 12]).unwrap();
        let (near, far) = (take(&near), take(&far));
        assert_eq!((near.body(), far.body()), ([n; 12].as_slice(), [n; 12].as_slice()));
        assert_eq!(support::origin(near.info()), support::origin(far.info()));
        assert!(far.info().released_ns > near.info().released_ns);
        gids.insert(far.info().publisher_gid);
    }
    // On the network a publisher is known by the hash of its token, which is what the graph says there.
    let announced = b.gateway().remote();
    let announced: Vec<_> = announced.iter().filter(|token| token.endpoint.is_some()).collect();
    let of_publisher = announced.iter().map(|token| tautline_gateway::wire::endpoint_gid(token));
    let of_publisher: HashSet<_> = of_publisher.collect();
    assert_eq!(gids.len(), 1);
    assert!(gids.is_subset(&of_publisher), "{gids:?} {announced:?}");
}

/// Ends of one name and two types, on both hosts.
#[test]
fn each_type_of_a_topic_goes_its_own_way() {
    let a = Host::first(83, 83);
    let b = Host::beside(&a, 144);
    let types = [string_type(), image_type()];
    let qos = Qos::keep_last(4);
    let near = types.each_ref().map(|topic_type| a.subscription("/x", topic_type, qos));
    let far = types.each_ref().map(|topic_type| b.subscription("/x", topic_type, qos));
    let publishers = types.each_ref().map(|topic_type| a.publisher("/x", topic_type, qos));
    for n in 0..2 {
        connect(&publishers[n], &[&near[n], &far[n]], b"probe");
    }
    for (n, publisher) in publishers.iter().enumerate() {
        publisher.publish(&[n as u8; 4]).unwrap();
    }
    for subscriptions in [near, far] {
        for (n, subscription) in subscriptions.iter().enumerate() {
            assert_eq!(take(subscription).body(), [n as u8; 4]);
            assert!(subscription.try_take().unwrap().is_none());
        }
    }
    // All have their counterparts.
    for host in [&a, &b] {
        assert_eq!(host.stats().not_mirrored, Default::default());
    }
}

#[test]
fn three_hosts_neither_loop_nor_duplicate() {
    let a = Host::first(169, 169);
    let b = Host::beside(&a, 170);
    let c = Host::new(171, 169, |options| {
        // A ring: each is linked to both others.
        options.network.connect = vec![a.locator(), b.locator()];
    });
    let hosts = [&a, &b, &c];
    let qos = Qos::keep_last(1000);
    // All publish and subscribe on one topic.
    let subscriptions: Vec<_> =
        hosts.iter().map(|host| host.subscription("/ring", &string_type(), qos)).collect();
    let publishers: Vec<_> = hosts.iter().map(|host| host.publisher("/ring", &string_type(), qos)).collect();
    let refs: Vec<_> = subscriptions.iter().collect();
    for publisher in &publishers {
        connect(publisher, &refs, b"probe");
    }
    for round in 0..100u8 {
        for (host, publisher) in publishers.iter().enumerate() {
            publisher.publish(&[host as u8, round]).unwrap();
        }
    }
    for subscription in &subscriptions {
        let mut seen = HashSet::new();
        while seen.len() < 300 {
            let sample = take(subscription);
            let body: [u8; 2] = sample.body().try_into().unwrap();
            assert!(seen.insert(body), "{body:?} came twice");
        }
        assert!(subscription.try_take().unwrap().is_none());
    }
    for host in hosts {
        until("statistics", || {
            stats(host, "/ring", Direction::Out).is_some_and(|out| out.reading.messages >= 100)
        });
        let (out, inward) = (stats(host, "/ring", Direction::Out), stats(host, "/ring", Direction::In));
        assert!(out.unwrap().reading.dropped.is_empty());
        assert!(inward.unwrap().reading.dropped.is_empty());
    }
}

#[test]
fn what_nobody_wants_is_not_sent() {
    let a = Host::first(172, 172);
    let b = Host::beside(&a, 173);
    let publisher = a.publisher("/alone", &string_type(), Qos::keep_last(10));
    let wanted = a.publisher("/wanted", &string_type(), Qos::keep_last(10));
    let subscription = b.subscription("/wanted", &string_type(), Qos::keep_last(10));
    for _ in 0..100 {
        publisher.publish(b"to nobody").unwrap();
    }
    connect(&wanted, &[&subscription], b"probe");
    until("statistics", || stats(&a, "/wanted", Direction::Out).is_some_and(|out| out.reading.messages > 0));
    assert_eq!(stats(&a, "/alone", Direction::Out), None, "not even taken");
    drop(subscription);
    until("the end of the subscription", || {
        stats(&a, "/wanted", Direction::Out).is_some_and(|out| !out.active)
    });
    let before = stats(&a, "/wanted", Direction::Out).unwrap().reading.messages;
    for _ in 0..100 {
        wanted.publish(b"to nobody").unwrap();
    }
    assert_eq!(stats(&a, "/wanted", Direction::Out).unwrap().reading.messages, before);
}

#[test]
fn late_joiners_on_another_host_get_what_was_kept() {
    let a = Host::first(174, 174);
    let publisher = a.publisher("/map", &string_type(), Qos::keep_last(3).transient_local());
    for n in 0..5u8 {
        publisher.publish(&[n; 4]).unwrap();
    }
    let b = Host::beside(&a, 176);
    let subscription = b.subscription("/map", &string_type(), Qos::keep_last(3).transient_local());
    for n in 2..5 {
        assert_eq!(take(&subscription).body(), [n; 4]);
    }
    publisher.publish(&[9; 4]).unwrap();
    assert_eq!(take(&subscription).body(), [9; 4]);
    assert!(subscription.try_take().unwrap().is_none());
    // A second one on that host is served there.
    let second = b.subscription("/map", &string_type(), Qos::keep_last(3).transient_local());
    for n in [3, 4, 9] {
        assert_eq!(take(&second).body(), [n; 4]);
    }
}

/// A publisher by hand: the test answers the requests for what it keeps, and publishes meanwhile.
#[test]
fn a_new_sample_does_not_overtake_the_kept_ones() {
    let host = Host::first(164, 164);
    let subscription = host.subscription("/map", &string_type(), Qos::keep_last(3).transient_local());
    let far = host.session();
    let name = format!("std_msgs::msg::dds_::String_/{UNKNOWN_HASH}");
    let (key, token) =
        (format!("164/map/{name}"), format!("@ros2_lv/164/fa/0/1/MP/%/%/n/%map/{name}/:1:,3:,:,:,,"));
    let publisher =
        far.declare_publisher(key.clone()).congestion_control(CongestionControl::Block).wait().unwrap();
    let place = format!("{key}/@adv/pub/{}/{}/_", publisher.id().zid(), publisher.id().eid());
    let requests = far.declare_queryable(&place).wait().unwrap();
    let _tokens = [&place, &token].map(|key| far.liveliness().declare_token(key).wait().unwrap());

    let gid = endpoint_gid(&Token::parse(&token).unwrap());
    let payload = |n: u8| [&ENCAPSULATION[..], &[n; 4]].concat();
    let info = |n: u8| SourceInfo::new(publisher.id(), n.into());
    let attachment = |n: u8| Attachment { sequence_number: n.into(), source_timestamp_ns: 0, gid }.encode();
    let answer = |request: Query, kept: &[u8]| {
        for &n in kept {
            let reply = request.reply(&key, payload(n)).attachment(attachment(n)).source_info(info(n));
            reply.wait().unwrap();
        }
    };
    let publish =
        |n: u8| publisher.put(payload(n)).attachment(attachment(n)).source_info(info(n)).wait().unwrap();

    // A request may be for all publishers; the last one is for this one.
    let request = || requests.recv_timeout(Duration::from_secs(20)).unwrap().expect("a request");
    let mut earlier = Vec::new();
    let last = loop {
        match request() {
            last if last.key_expr().as_str().contains("/@adv/pub/") => break last,
            other => earlier.push(other),
        }
    };
    earlier.into_iter().for_each(|request| answer(request, &[1]));
    publish(2);
    answer(last, &[1, 2]);
    publish(3);
    for n in 1..=3 {
        assert_eq!(take(&subscription).body(), [n; 4]);
    }
    // 4 is lost, and requested again.
    publish(5);
    let lost = request();
    assert_eq!(lost.parameters().get("_sn"), Some("4.."));
    answer(lost, &[4, 5]);
    publish(6);
    for n in 4..=6 {
        assert_eq!(take(&subscription).body(), [n; 4]);
    }
    assert!(subscription.try_take().unwrap().is_none());
}

/// Publishers that come later make both gateways keep more. What was there is sent once all the same, and nothing of it
/// is missing for who comes last. (On the receiving host it may come again.)
#[test]
fn more_publishers_that_keep_samples() {
    let a = Host::first(212, 212);
    let b = Host::beside(&a, 213);
    let kept = |depth| Qos::keep_last(depth).transient_local();
    let subscription = b.subscription("/tf_static", &string_type(), kept(50));
    let mut publishers = Vec::new();
    let mut here = HashSet::new();
    let all = |subscription, got: &mut HashSet<Vec<u8>>, count| {
        while got.len() < count {
            got.insert(take(subscription).body().to_vec());
        }
    };
    for n in 1..6u8 {
        // Deeper and deeper.
        let publisher = a.publisher("/tf_static", &string_type(), kept(usize::from(n) * 3));
        publisher.publish(&[n, 1]).unwrap();
        publisher.publish(&[n, 2]).unwrap();
        publishers.push(publisher);
        all(&subscription, &mut here, usize::from(n) * 2);
    }
    for (n, publisher) in publishers.iter().enumerate() {
        publisher.publish(&[n as u8, 3]).unwrap();
    }
    all(&subscription, &mut here, 15);
    let late = b.subscription("/tf_static", &string_type(), kept(50));
    all(&late, &mut HashSet::new(), 15);
    until("the statistics", || {
        stats(&a, "/tf_static", Direction::Out).is_some_and(|out| out.reading.messages >= 15)
    });
    assert_eq!(stats(&a, "/tf_static", Direction::Out).unwrap().reading.messages, 15);
}

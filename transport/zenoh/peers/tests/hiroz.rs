// SPDX-License-Identifier: MIT OR Apache-2.0
//! The gateway and hiroz, another implementation of the wire: messages both ways, and each in the other's graph.

#[path = "../../tests/support/mod.rs"]
mod support;

use hiroz::context::{ZContext, ZContextBuilder};
use hiroz::node::ZNode;
use hiroz::qos::{QosDurability, QosHistory, QosProfile, QosReliability};
use hiroz::{Builder, ZBuf};
use hiroz_msgs::{
    builtin_interfaces, geometry_msgs as their_geometry, sensor_msgs as their_sensor, std_msgs as their_std,
};
use hiroz_protocol::entity::EndpointKind as TheirKind;
use std::num::NonZeroUsize;
use std::time::Duration;
use support::{Host, until, wait};
use tautline_gateway::wire::{EndpointKind, endpoint_gid};
use tautline_msgs::Message;
use tautline_msgs::cdr::Endian;
use tautline_ros_msgs::{geometry_msgs, sensor_msgs, std_msgs};
use tautline_transport::{Durability, Limits, Qos, Reliability, ServiceType, TopicType};

fn topic_type<M: Message>() -> TopicType {
    TopicType::new(M::TYPE_NAME).with_hash(M::TYPE_HASH.unwrap())
}

fn context(host: &Host, mode: &str) -> ZContext {
    ZContextBuilder::default()
        .with_mode(mode)
        .with_connect_endpoints([host.locator()])
        .with_domain_id(host.network_domain as usize)
        .disable_multicast_scouting()
        .build()
        .unwrap()
}

fn node(context: &ZContext) -> ZNode {
    context.create_node("their_node").with_namespace("/theirs").without_parameters().build().unwrap()
}

fn encode<M: Message>(message: &M) -> Vec<u8> {
    let mut body = vec![0; message.cdr_len()];
    message.encode(&mut body).unwrap();
    body
}

/// One value as both sides hold it, published by each and received by the other.
macro_rules! both_ways {
    ($host:expr, $node:expr, $topic:literal, $ours:expr, $Ours:ty, $theirs:expr, $Theirs:ty, $equal:expr) => {{
        let (ours, theirs, equal): ($Ours, $Theirs, fn(&$Theirs, &$Ours) -> bool) = ($ours, $theirs, $equal);
        let topic = concat!("/out/", $topic);
        let subscription = $node.create_sub::<$Theirs>(topic).build().unwrap();
        let publisher = $host.publisher(topic, &topic_type::<$Ours>(), Qos::keep_last(10));
        let received = wait("their reception", || {
            publisher.publish(&encode(&ours)).unwrap();
            subscription.recv_timeout(Duration::from_millis(20)).ok()
        });
        assert!(equal(&received, &ours), "{topic}");

        let topic = concat!("/in/", $topic);
        let subscription = $host.subscription(topic, &topic_type::<$Ours>(), Qos::keep_last(10));
        let publisher = $node.create_pub::<$Theirs>(topic).build().unwrap();
        let sample = wait("our reception", || {
            publisher.publish(&theirs).unwrap();
            std::thread::sleep(Duration::from_millis(5));
            subscription.try_take_valid().unwrap()
        });
        assert_eq!(<$Ours>::decode(sample.body(), Endian::Little).unwrap(), ours, "{topic}");
        assert!(sample.info().source_timestamp_ns > 1_600_000_000_000_000_000);
    }};
}

fn messages_both_ways(domain: u32, mode: &str) {
    let host = Host::first(domain, domain);
    let context = context(&host, mode);
    let node = node(&context);

    let text = "Grüße, a text";
    both_ways!(
        host,
        node,
        "text",
        std_msgs::msg::String { data: text.into() },
        std_msgs::msg::String,
        their_std::String { data: text.into() },
        their_std::String,
        |theirs, ours| theirs.data == ours.data
    );

    let mut ours = geometry_msgs::msg::Twist::default();
    (ours.linear.x, ours.linear.z, ours.angular.z) = (0.5, -1.25, 3.5);
    let theirs = their_geometry::Twist {
        linear: their_geometry::Vector3 { x: 0.5, y: 0.0, z: -1.25 },
        angular: their_geometry::Vector3 { x: 0.0, y: 0.0, z: 3.5 },
    };
    both_ways!(
        host,
        node,
        "twist",
        ours,
        geometry_msgs::msg::Twist,
        theirs,
        their_geometry::Twist,
        |theirs, ours| theirs.linear.z == ours.linear.z && theirs.angular.z == ours.angular.z
    );

    let pixels: Vec<u8> = (0..640 * 480 * 3).map(|n| (n * 31) as u8).collect();
    let mut ours = sensor_msgs::msg::Image::default();
    (ours.height, ours.width, ours.step, ours.encoding) = (480, 640, 1920, "rgb8".into());
    (ours.header.stamp.sec, ours.header.frame_id) = (7, "camera".into());
    ours.data = pixels.clone();
    let stamp = builtin_interfaces::Time { sec: 7, nanosec: 0 };
    let header = their_std::Header { stamp, frame_id: "camera".into() };
    let theirs = their_sensor::Image {
        header: header.clone(),
        height: 480,
        width: 640,
        encoding: "rgb8".into(),
        is_bigendian: 0,
        step: 1920,
        data: ZBuf::from(pixels),
    };
    both_ways!(
        host,
        node,
        "image",
        ours,
        sensor_msgs::msg::Image,
        theirs,
        their_sensor::Image,
        |theirs, ours| {
            use zenoh_buffers::buffer::SplitBuffer;
            theirs.data.0.contiguous().as_ref() == ours.data && theirs.encoding == ours.encoding
        }
    );

    let ranges: Vec<f32> = (0..720).map(|n| n as f32 / 10.0).collect();
    let mut ours = sensor_msgs::msg::LaserScan::default();
    (ours.angle_min, ours.angle_max, ours.range_max) = (-1.5, 1.5, 72.0);
    (ours.header.stamp.sec, ours.header.frame_id) = (7, "camera".into());
    ours.ranges = ranges.clone();
    let theirs = their_sensor::LaserScan {
        header,
        angle_min: -1.5,
        angle_max: 1.5,
        angle_increment: 0.0,
        time_increment: 0.0,
        scan_time: 0.0,
        range_min: 0.0,
        range_max: 72.0,
        ranges,
        intensities: Vec::new(),
    };
    both_ways!(
        host,
        node,
        "scan",
        ours,
        sensor_msgs::msg::LaserScan,
        theirs,
        their_sensor::LaserScan,
        |theirs, ours| theirs.ranges == ours.ranges && theirs.range_max == ours.range_max
    );
}

#[test]
fn messages_both_ways_with_a_client() {
    messages_both_ways(201, "client");
}

#[test]
fn messages_both_ways_with_a_peer() {
    messages_both_ways(202, "peer");
}

#[test]
fn each_is_in_the_others_graph() {
    let host = Host::first(203, 203);
    let context = context(&host, "client");
    let node = node(&context);
    let qos = QosProfile {
        reliability: QosReliability::BestEffort,
        durability: QosDurability::TransientLocal,
        history: QosHistory::KeepLast(NonZeroUsize::new(7).unwrap()),
        ..QosProfile::default()
    };
    let _publisher = node.create_pub::<their_std::String>("/theirs/chatter").with_qos(qos).build().unwrap();
    let found = wait("their publisher", || {
        let remote = host.gateway().remote();
        remote
            .iter()
            .find(|token| token.endpoint.as_ref().is_some_and(|e| e.name == "/theirs/chatter"))
            .cloned()
    });
    assert_eq!(found.node.full_name(), "/theirs/their_node");
    let endpoint = found.endpoint.unwrap();
    assert_eq!(endpoint.kind, EndpointKind::Publisher);
    assert_eq!(endpoint.type_id.name.as_str(), "std_msgs/msg/String");
    assert_eq!(endpoint.type_id.hash.to_string(), std_msgs::msg::String::TYPE_HASH.unwrap());
    let qos = endpoint.qos;
    assert_eq!(
        (qos.reliability, qos.durability, qos.depth),
        (Reliability::BestEffort, Durability::TransientLocal, 7)
    );

    // In the graph of this host, too.
    let graph = wait("their publisher here", || {
        let graph = host.participant.graph().unwrap();
        (!graph.endpoints.is_empty()).then_some(graph)
    });
    let [end] = &*graph.endpoints else { panic!("{graph:?}") };
    assert_eq!((&*end.topic, end.is_remote, end.qos.depth), ("/theirs/chatter", true, 7));
    assert_eq!(end.node.as_ref().unwrap().full_name(), "/theirs/their_node");
    assert!(graph.nodes.iter().any(|node| node.is_remote && node.name.full_name() == "/theirs/their_node"));

    let _silent = host.participant.create_node("silent", "/ours").unwrap();
    let our_node = host.participant.create_node("our_node", "/ours").unwrap();
    let hash = format!("RIHS01_{:064x}", 7);
    let (ours, limits) = (host.participant.for_node(&our_node), Limits::default());
    let service_type = ServiceType::new("a_msgs/srv/Add", Some(&hash));
    let _service = ours.create_raw_server("/ours/add", &service_type, 10, limits).unwrap();
    let subscription = ours
        .create_raw_subscription(
            "/ours/scan",
            &topic_type::<sensor_msgs::msg::LaserScan>(),
            Qos::keep_last(5).best_effort(),
            limits,
        )
        .unwrap();
    let graph = context.graph();
    until("our service", || graph.count(TheirKind::Service, "/ours/add") == 1);
    until("our subscription", || graph.count(TheirKind::Subscription, "/ours/scan") == 1);
    let entities = graph.get_entities_by_topic(TheirKind::Subscription, "/ours/scan");
    let hiroz_protocol::Entity::Endpoint(entity) = &*entities[0] else { panic!("a node") };
    assert_eq!(
        entity.type_info.as_ref().unwrap().hash.to_rihs_string(),
        sensor_msgs::msg::LaserScan::TYPE_HASH.unwrap()
    );
    assert_eq!(entity.qos.reliability, hiroz_protocol::qos::QosReliability::BestEffort);
    assert_eq!(entity.qos.history, hiroz_protocol::qos::QosHistory::KeepLast(5));
    let types = graph.get_topic_names_and_types();
    assert!(types.contains(&("/ours/scan".into(), "sensor_msgs::msg::dds_::LaserScan_".into())), "{types:?}");
    let names = graph.get_node_names();
    for name in ["silent", "our_node"] {
        assert!(names.contains(&(name.into(), "/ours".into())), "{names:?}");
    }
    // Their graph keeps what somebody holds.
    drop((entities, subscription));
    until("its end", || graph.count(TheirKind::Subscription, "/ours/scan") == 0);
}

#[test]
fn late_joiners_both_ways() {
    let host = Host::first(204, 204);
    let context = context(&host, "client");
    let node = node(&context);
    let kept = QosProfile {
        durability: QosDurability::TransientLocal,
        history: QosHistory::KeepLast(NonZeroUsize::new(3).unwrap()),
        ..QosProfile::default()
    };
    let topic_type = topic_type::<std_msgs::msg::String>();
    let message = |n: u32| std_msgs::msg::String { data: format!("map {n}") };

    let publisher = host.publisher("/ours/map", &topic_type, Qos::keep_last(3).transient_local());
    (0..5).for_each(|n| publisher.publish(&encode(&message(n))).unwrap());
    // Late: zenoh-ext's subscriber, which is hiroz's, drops what is kept if something new arrives during its request (1.10.2).
    until("what is kept", || {
        let stats = host.stats().topics.into_iter();
        stats.filter(|topic| topic.name.topic == "/ours/map").any(|topic| topic.reading.messages >= 3)
    });
    let late = node.create_sub::<their_std::String>("/ours/map").with_qos(kept).build().unwrap();
    for n in 2..5 {
        assert_eq!(late.recv_timeout(Duration::from_secs(20)).unwrap().data, message(n).data);
    }

    let publisher = node.create_pub::<their_std::String>("/theirs/map").with_qos(kept).build().unwrap();
    (0..5).for_each(|n| publisher.publish(&their_std::String { data: message(n).data }).unwrap());
    let late = host.subscription("/theirs/map", &topic_type, Qos::keep_last(3).transient_local());
    // A sample that was still on its way when the subscription began comes before those that are kept.
    let mut received = Vec::new();
    while received.last() != Some(&message(4)) {
        let sample = wait("what was kept", || late.try_take_valid().unwrap());
        received.push(std_msgs::msg::String::decode(sample.body(), Endian::Little).unwrap());
    }
    let first = 5 - received.len().max(3) as u32;
    assert_eq!(received, (first..5).map(message).collect::<Vec<_>>());
}

#[test]
fn gids_are_those_of_our_tokens() {
    let host = Host::first(205, 205);
    let session = zenoh_client(&host);
    use zenoh::Wait;
    let topic_type = topic_type::<std_msgs::msg::String>();
    let key =
        format!("205/chatter/std_msgs::msg::dds_::String_/{}", std_msgs::msg::String::TYPE_HASH.unwrap());
    let samples = session.declare_subscriber(key).wait().unwrap();
    // A volatile publisher is heard only if a subscription was announced, as rmw_zenoh does.
    let token = "@ros2_lv/205/1/0/1/MS/%/%/n/%chatter/std_msgs::msg::dds_::String_";
    let token = format!("{token}/{}/::,10:,:,:,,", std_msgs::msg::String::TYPE_HASH.unwrap());
    let _token = session.liveliness().declare_token(token).wait().unwrap();
    let tokens =
        session.liveliness().declare_subscriber("@ros2_lv/205/*/*/*/MP/**").history(true).wait().unwrap();
    let publisher = host.publisher("/chatter", &topic_type, Qos::keep_last(10));
    let text = tokens.recv_timeout(Duration::from_secs(20)).unwrap().unwrap().key_expr().to_string();
    let sample = wait("a sample", || {
        publisher.publish(&encode(&std_msgs::msg::String { data: "Hello 0".into() })).unwrap();
        samples.recv_timeout(Duration::from_millis(20)).unwrap()
    });
    let golden = [&[0, 1, 0, 0, 8, 0, 0, 0][..], b"Hello 0\0"].concat();
    assert_eq!(sample.payload().to_bytes().as_ref(), golden);
    let attachment = sample.attachment().unwrap().to_bytes();
    assert_eq!(attachment.len(), 33);
    let token = tautline_gateway::wire::Token::parse(&text).unwrap();
    assert_eq!(token.to_string(), text, "canonical");
    assert_eq!(attachment[17..], endpoint_gid(&token).0);
    assert!(attachment[8..16] != [0; 8] && attachment[16] == 16);
}

fn zenoh_client(host: &Host) -> zenoh::Session {
    use zenoh::Wait;
    let text = format!(
        r#"{{ mode: "client", connect: {{ endpoints: ["{}"] }}, scouting: {{ multicast: {{ enabled: false }} }} }}"#,
        host.locator()
    );
    zenoh::open(zenoh::Config::from_json5(&text).unwrap()).wait().unwrap()
}

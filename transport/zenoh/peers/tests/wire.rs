// SPDX-License-Identifier: MIT OR Apache-2.0
//! Keys, tokens, QoS, gids and attachments: ours against hiroz-protocol's and zenoh-ros2-sdk's, both ways.

use gateway_peers::{python, script};
use hiroz_protocol::entity::{EndpointEntity, EndpointKind as TheirKind, Entity, NodeEntity, TypeInfo};
use hiroz_protocol::format::KeyExprFormatter;
use hiroz_protocol::format::rmw_zenoh::RmwZenohFormatter as Theirs;
use hiroz_protocol::qos::{QosDurability, QosDuration, QosHistory, QosProfile, QosReliability};
use rand::RngExt;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use std::io::Write;
use std::process::{Command, Stdio};
use tautline_gateway::wire::*;
use tautline_transport::{Durability, Gid, History, Reliability};

fn word(random: &mut StdRng) -> String {
    let len = random.random_range(1..12);
    (0..len).map(|_| char::from(*b"abcxyz".choose(random).unwrap())).collect()
}

/// Without durations that hold nanoseconds or seconds alone at their default: there the peers differ in thrift.
fn token(random: &mut StdRng) -> Token {
    let kinds =
        [EndpointKind::Publisher, EndpointKind::Subscription, EndpointKind::Service, EndpointKind::Client];
    let hash: String = (0..64).map(|_| char::from(*b"0123456789abcdef".choose(random).unwrap())).collect();
    let type_name = format!("{}/msg/N{}", word(random), word(random));
    let deadline =
        WireDuration { sec: random.random_range(0..9), nsec: random.random_range(0..1_000_000_000) };
    let node_id = random.random_range(0..1000);
    let namespace = if random.random() { "/".into() } else { format!("/{}/{}", word(random), word(random)) };
    Token {
        domain: random.random_range(0..=232),
        zid: random.random::<u128>() | 1 << 127,
        node_id,
        node: NodeName { enclave: "/".into(), namespace, name: word(random) },
        endpoint: Some(Endpoint {
            id: random.random_range(0..1000),
            kind: *kinds.choose(random).unwrap(),
            name: format!("/{}/{}", word(random), word(random)),
            type_id: TypeId {
                name: type_name.parse().unwrap(),
                hash: format!("RIHS01_{hash}").parse().unwrap(),
            },
            qos: WireQos {
                reliability: if random.random() { Reliability::Reliable } else { Reliability::BestEffort },
                durability: if random.random() { Durability::Volatile } else { Durability::TransientLocal },
                history: History::KeepLast,
                depth: random.random_range(1..42),
                deadline: if random.random() { deadline } else { WireDuration::INFINITE },
                ..WireQos::default()
            },
            suffix: String::new(),
        }),
        note: String::new(),
    }
}

fn dds_name(type_id: &TypeId) -> String {
    let name = &type_id.name;
    format!("{}::{}::dds_::{}_", name.package(), name.kind().as_str(), name.name())
}

/// The same, as hiroz holds it.
fn theirs(token: &Token) -> EndpointEntity {
    let endpoint = token.endpoint.as_ref().unwrap();
    let zid = format!("{:x}", token.zid).parse().unwrap();
    let namespace = if token.node.namespace == "/" { String::new() } else { token.node.namespace.clone() };
    let (id, name) = (token.node_id as usize, token.node.name.clone());
    let hash = hiroz_protocol::entity::TypeHash::new(1, *endpoint.type_id.hash.as_bytes());
    EndpointEntity {
        id: endpoint.id as usize,
        node: Some(NodeEntity::new(token.domain as usize, zid, id, name, namespace, String::new())),
        kind: match endpoint.kind {
            EndpointKind::Publisher => TheirKind::Publisher,
            EndpointKind::Subscription => TheirKind::Subscription,
            EndpointKind::Service => TheirKind::Service,
            EndpointKind::Client => TheirKind::Client,
        },
        topic: endpoint.name.clone(),
        type_info: Some(TypeInfo::new(&dds_name(&endpoint.type_id), hash)),
        qos: QosProfile {
            reliability: match endpoint.qos.reliability {
                Reliability::Reliable => QosReliability::Reliable,
                Reliability::BestEffort => QosReliability::BestEffort,
            },
            durability: match endpoint.qos.durability {
                Durability::Volatile => QosDurability::Volatile,
                Durability::TransientLocal => QosDurability::TransientLocal,
            },
            history: QosHistory::KeepLast(endpoint.qos.depth as usize),
            deadline: QosDuration { sec: endpoint.qos.deadline.sec, nsec: endpoint.qos.deadline.nsec },
            ..QosProfile::default()
        },
    }
}

#[test]
fn hiroz_writes_what_we_write_and_reads_what_we_read() {
    let mut random = tautline_seed::random();
    for _ in 0..2000 {
        let token = token(&mut random);
        let entity = theirs(&token);
        let node = entity.node.clone().unwrap();
        let text = Theirs::liveliness_key_expr(&entity, &node.z_id).unwrap().to_string();
        assert_eq!(token.to_string(), text);
        assert_eq!(Token::parse(&text), Ok(token.clone()));
        let parsed = Theirs::parse_liveliness(&token.to_string().try_into().unwrap()).unwrap();
        // It gives an absent namespace back as absent, a present one as written.
        assert_eq!(parsed, Entity::Endpoint(entity.clone()));
        let note = "tautline,0,1,x".to_owned();
        let noted = Token { note, ..token.clone() };
        assert_eq!(Theirs::parse_liveliness(&noted.to_string().try_into().unwrap()).unwrap(), parsed);

        let of_node = Token { endpoint: None, ..token.clone() };
        let noted = Token { endpoint: None, ..noted };
        assert_eq!(
            Theirs::parse_liveliness(&noted.to_string().try_into().unwrap()).unwrap(),
            Theirs::parse_liveliness(&of_node.to_string().try_into().unwrap()).unwrap()
        );
        assert_eq!(of_node.to_string(), Theirs::node_liveliness_key_expr(&node).unwrap().to_string());

        let endpoint = token.endpoint.unwrap();
        let key = TopicKey { domain: token.domain, topic: endpoint.name, type_id: endpoint.type_id };
        assert_eq!(key.to_string(), Theirs::topic_key_expr(&entity).unwrap().to_string());
    }
}

#[test]
fn hiroz_attachments_are_ours() {
    let mut random = tautline_seed::random();
    for _ in 0..200 {
        let (sequence_number, gid): (i64, [u8; 16]) = (random.random(), random.random());
        let theirs = hiroz::attachment::Attachment::new(sequence_number, gid);
        let ours =
            Attachment { sequence_number, source_timestamp_ns: theirs.source_timestamp, gid: Gid(gid) };
        let bytes = zenoh::bytes::ZBytes::from(theirs);
        assert_eq!(&bytes.to_bytes()[..], ours.encode());
        assert_eq!(Attachment::parse(&bytes.to_bytes()), Ok(ours));
    }
}

#[test]
fn the_python_sdk_writes_what_we_write() {
    let Some(python) = python() else { return };
    let mut random = tautline_seed::random();
    let tokens: Vec<_> = (0..500).map(|_| token(&mut random)).collect();
    let mut oracle = Command::new(python)
        .arg(script("oracle.py"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut questions = Vec::new();
    let (sequence, stamp, gid) = (7, 1_700_000_000_123_456_789i64, [0xCD; 16]);
    for token in &tokens {
        let endpoint = token.endpoint.as_ref().unwrap();
        let text = token.to_string();
        let question = serde_json::json!({
            "domain": token.domain, "zid": format!("{:x}", token.zid), "node_id": token.node_id,
            "node": token.node.name, "namespace": token.node.namespace, "id": endpoint.id,
            "kind": text.split('/').nth(5).unwrap(), "topic": endpoint.name,
            "type": endpoint.type_id.name.as_str(), "hash": endpoint.type_id.hash.to_string(),
            "reliability": if endpoint.qos.reliability == Reliability::Reliable { "RELIABLE" } else { "BEST_EFFORT" },
            "durability": if endpoint.qos.durability == Durability::Volatile { "VOLATILE" } else { "TRANSIENT_LOCAL" },
            "depth": endpoint.qos.depth, "deadline": [endpoint.qos.deadline.sec, endpoint.qos.deadline.nsec],
            "sequence": sequence, "stamp": stamp, "gid": hex(&gid),
        });
        writeln!(questions, "{question}").unwrap();
    }
    let mut input = oracle.stdin.take().unwrap();
    let writer = std::thread::spawn(move || input.write_all(&questions).unwrap());
    let output = oracle.wait_with_output().unwrap();
    writer.join().unwrap();
    assert!(output.status.success());
    let answers = String::from_utf8(output.stdout).unwrap();
    assert_eq!(answers.lines().count(), tokens.len());
    for (token, answer) in tokens.iter().zip(answers.lines()) {
        let answer: serde_json::Value = serde_json::from_str(answer).unwrap();
        let endpoint = token.endpoint.as_ref().unwrap();
        let key = TopicKey {
            domain: token.domain,
            topic: endpoint.name.clone(),
            type_id: endpoint.type_id.clone(),
        };
        assert_eq!(answer["token"], token.to_string());
        assert_eq!(answer["node"], Token { endpoint: None, ..token.clone() }.to_string());
        assert_eq!(answer["key"], key.to_string());
        assert_eq!(answer["gid"], hex(&endpoint_gid(token).0));
        let attachment = Attachment { sequence_number: sequence, source_timestamp_ns: stamp, gid: Gid(gid) };
        assert_eq!(answer["attachment"], hex(&attachment.encode()));
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bytes and texts that other implementations produce, and claims that must be refused.

use super::*;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt};
use std::time::Duration;
use tautline_transport::{Durability, Gid, History, Reliability};

const STRING_HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

fn string_type() -> TypeId {
    TypeId { name: "std_msgs/msg/String".parse().unwrap(), hash: STRING_HASH.parse().unwrap() }
}

fn qos(depth: u64) -> WireQos {
    WireQos { depth, ..WireQos::default() }
}

#[test]
fn data_keys() {
    let text = format!("0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}");
    let key = TopicKey { domain: 0, topic: "/chatter".into(), type_id: string_type() };
    assert_eq!(key.to_string(), text);
    assert_eq!(TopicKey::parse(&text), Ok(key));

    let text = format!("42/robot/arm/joint_states/std_msgs::msg::dds_::String_/{STRING_HASH}");
    let key = TopicKey::parse(&text).unwrap();
    assert_eq!((key.domain, key.topic.as_str()), (42, "/robot/arm/joint_states"));
    assert_eq!(key.to_string(), text);

    let text = text.replace("::msg::", "::srv::");
    assert_eq!(TopicKey::parse(&text).unwrap().type_id.name.as_str(), "std_msgs/srv/String");
}

/// rmw_zenoh_cpp 0.10.5, src/detail/buffer_endpoint_helpers.hpp:62-65 (ros2-gbp/rmw_zenoh-release, commit ce85fe8b).
#[test]
fn keys_of_cpu_groups() {
    let key = TopicKey { domain: 0, topic: "/chatter".into(), type_id: string_type() };
    let group = format!("0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/_buf_cpu");
    assert_eq!(key.cpu_group(), group);
    // Not itself the key of a topic.
    assert!(TopicKey::parse(&group).is_err());
}

#[test]
fn malformed_keys() {
    let refused = |text: &str| TopicKey::parse(text).unwrap_err();
    let good = format!("0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}");
    assert_eq!(refused(""), Malformed::Parts);
    assert_eq!(refused("0/a/b"), Malformed::Parts);
    assert_eq!(refused("0//a/b"), Malformed::TopicName);
    assert_eq!(refused(&format!("0/{}", "a/".repeat(2000))), Malformed::KeyTooLong);
    for domain in ["233", "-1", "+1", "00", "4294967296", "99999999999999999999999", "", " 0", "0x0"] {
        assert_eq!(refused(&good.replacen('0', domain, 1)), Malformed::Domain, "{domain}");
    }
    for topic in ["", "a//b", "a/", "a b", "a*", "é", "a%b", &"n".repeat(255)] {
        assert_eq!(refused(&good.replace("chatter", topic)), Malformed::TopicName, "{topic}");
    }
    for name in
        ["String_", "std_msgs::msg::String_", "std_msgs::msg::dds_::String", "std_msgs::x::dds_::String_"]
    {
        let text = good.replace("std_msgs::msg::dds_::String_", name);
        assert_eq!(refused(&text), Malformed::TypeName, "{name}");
    }
    for hash in ["", "RIHS01_", "TypeHashNotSupported", &STRING_HASH.replace("df", "DF"), &STRING_HASH[1..]] {
        assert_eq!(refused(&good.replace(STRING_HASH, hash)), Malformed::TypeHash, "{hash}");
    }
}

#[test]
fn tokens() {
    let node = "@ros2_lv/0/a0b1/0/0/NN/%/%/talker";
    let (endpoint, note) = (None, String::new());
    let talker = NodeName::new("/", "talker");
    let token = Token { domain: 0, zid: 0xa0b1, node_id: 0, node: talker, endpoint, note };
    assert_eq!(token.to_string(), node);
    assert_eq!(Token::parse(node), Ok(token));

    let text = format!(
        "@ros2_lv/7/aac3178e146ba6f1fc6e6a4085e77f21/3/12/MP/%/%robot%arm/camera/%robot%image/std_msgs::msg::dds_::String_/{STRING_HASH}/2::,5:,:,:,,"
    );
    let token = Token::parse(&text).unwrap();
    assert_eq!(token.node.full_name(), "/robot/arm/camera");
    let endpoint = token.endpoint.as_ref().unwrap();
    assert_eq!(
        (endpoint.kind, endpoint.name.as_str(), endpoint.id),
        (EndpointKind::Publisher, "/robot/image", 12)
    );
    assert_eq!(endpoint.qos, WireQos { reliability: Reliability::BestEffort, ..qos(5) });
    assert_eq!(token.to_string(), text);

    for (text, kind) in
        [("MS", EndpointKind::Subscription), ("SS", EndpointKind::Service), ("SC", EndpointKind::Client)]
    {
        let token =
            format!("@ros2_lv/0/1/0/1/{text}/%/%/n/%x/std_msgs::msg::dds_::String_/{STRING_HASH}/::,:,:,:,,");
        assert_eq!(Token::parse(&token).unwrap().endpoint.unwrap().kind, kind);
    }
}

/// rmw_zenoh_cpp 0.10.5, src/detail/liveliness_utils.cpp:538-576 (ros2-gbp/rmw_zenoh-release, commit ce85fe8b): after
/// the QoS one more part, `backends:`, then `name:metadata` of each backend, sorted by name, with `;` between them; in
/// both `%`, `;`, `:` and `/` are `%25`, `%3B`, `%3A` and `%2F`. Without backends, no further part and no slash. The
/// last one here is what a still later version might append.
const SUFFIXES: [&str; 5] = [
    "backends:cpu:",
    "backends:cpu:;cuda:",
    "backends:cpu:;demo:v%3A1%2F2%3Bfull%25",
    "backends:cpu:;cuda:device 0, \u{e9}@1.2",
    "backends:cpu:/what:a/later/version%2Fappends",
];

#[test]
fn tokens_of_both_generations() {
    let older = format!(
        "@ros2_lv/0/a1/3/12/MS/%/%/viewer/%image/std_msgs::msg::dds_::String_/{STRING_HASH}/::,5:,:,:,,"
    );
    let plain = Token::parse(&older).unwrap();
    assert_eq!(plain.endpoint.as_ref().unwrap().suffix, "");
    assert_eq!(plain.to_string(), older);

    for suffix in SUFFIXES {
        let text = format!("{older}/{suffix}");
        let token = Token::parse(&text).unwrap();
        assert_eq!(token.to_string(), text);
        let endpoint = plain.endpoint.clone().unwrap();
        let expected = Endpoint { suffix: suffix.into(), ..endpoint };
        assert_eq!(token, Token { endpoint: Some(expected), ..plain.clone() });
        assert_ne!(endpoint_gid(&token), endpoint_gid(&plain), "{suffix}");
    }
    assert_eq!(CPU_BACKEND, SUFFIXES[0]);

    // The same file, lines 642-680: of a node's token further parts are not read, and the gid is computed without them.
    let node = "@ros2_lv/0/a1/3/3/NN/%/%/viewer";
    let token = Token::parse(node).unwrap();
    for suffix in SUFFIXES {
        let parsed = Token::parse(&format!("{node}/{suffix}")).unwrap();
        assert_eq!(parsed.note, suffix.split('/').next().unwrap());
        assert_eq!(Token { note: String::new(), ..parsed }, token);
    }
    assert_eq!(token.to_string(), node);
}

/// rmw_zenoh_cpp 0.2.10 and 0.10.5, src/detail/liveliness_utils.cpp: `Entity::make` needs 9 parts of a node, `keyexpr_to_qos` 6 fields;
/// both ignore what follows, and the constructor writes the text for the gid anew.
#[test]
fn notes_do_not_change_gids() {
    let end =
        format!("@ros2_lv/0/a1/3/12/MP/%front/%/n/%x/std_msgs::msg::dds_::String_/{STRING_HASH}/::,5:,:,:,,");
    let plain = Token::parse(&end).unwrap();
    for suffix in ["", "/backends:cpu:"] {
        let token = Token::parse(&format!("{end}:a,b:c{suffix}")).unwrap();
        assert_eq!((&*token.note, &*token.node.enclave), ("a,b:c", "/front"));
        assert_eq!(token.to_string(), format!("{end}:a,b:c{suffix}"));
        let without = Token { note: String::new(), ..token.clone() };
        assert_eq!(endpoint_gid(&token), endpoint_gid(&without));
        assert_eq!(endpoint_gid(&token) == endpoint_gid(&plain), suffix.is_empty());
    }
    let node = "@ros2_lv/0/a1/3/3/NN/%front/%/n/a,b";
    assert_eq!(Token::parse(node).map(|token| token.to_string()), Ok(node.to_owned()));
    for hostile in ["*", "a$*", "a?", "a#b"] {
        assert_eq!(Token::parse(&format!("{end}:{hostile}")), Err(Malformed::Suffix), "{hostile}");
    }
}

#[test]
fn hostile_suffixes() {
    let node = "@ros2_lv/0/a1/3/3/NN/%/%/viewer";
    let endpoint = format!(
        "@ros2_lv/0/a1/3/12/SC/%/%/viewer/%add/std_msgs::srv::dds_::String_/{STRING_HASH}/::,5:,:,:,,"
    );
    for text in [node, &endpoint] {
        let refused = |suffix: &str| Token::parse(&format!("{text}/{suffix}")).unwrap_err();
        for suffix in ["", "/", "//", "a/", "/a", "a//b", "backends:cpu:/", "a/b/c/d/e/f/g//h"] {
            assert_eq!(refused(suffix), Malformed::Suffix, "{suffix}");
        }
        for suffix in ["*", "**", "backends:*", "a/**", "$*", "a$*b", "a$b", "a?b=c", "a#b", "a/b/c/d/e/f?"] {
            assert_eq!(refused(suffix), Malformed::Suffix, "{suffix}");
        }
        let longest = "x".repeat(MAX_KEY_BYTES - text.len() - 1);
        assert!(Token::parse(&format!("{text}/{longest}")).is_ok());
        assert_eq!(refused(&format!("{longest}x")), Malformed::KeyTooLong);
        assert_eq!(refused(&"/".repeat(MAX_KEY_BYTES)), Malformed::KeyTooLong);
        let parts = "x/".repeat(500);
        assert!(Token::parse(&format!("{text}/{parts}x")).is_ok());
    }
}

#[test]
fn malformed_tokens() {
    let good = format!(
        "@ros2_lv/0/a1/3/12/MP/%/%/camera/%image/std_msgs::msg::dds_::String_/{STRING_HASH}/::,:,:,:,,"
    );
    assert!(Token::parse(&good).is_ok());
    let refused = |from: &str, to: &str| Token::parse(&good.replacen(from, to, 1)).unwrap_err();
    assert_eq!(refused("@ros2_lv", "@ros2"), Malformed::Admin);
    assert_eq!(refused("/0/", "/999/"), Malformed::Domain);
    for zid in ["", "0", "0a1", "A1", "g", &"f".repeat(33)] {
        assert_eq!(refused("/a1/", &format!("/{zid}/")), Malformed::Zid, "{zid}");
    }
    assert_eq!(refused("/3/", "/-3/"), Malformed::Id);
    assert_eq!(refused("/12/", "/18446744073709551616/"), Malformed::Id);
    assert_eq!(refused("/MP/", "/XX/"), Malformed::Kind);
    assert_eq!(refused("/camera/", "/cam%era/"), Malformed::NodeName);
    assert_eq!(refused("/%/%/", "/%/no_slash/"), Malformed::NodeName);
    assert_eq!(refused("%image", "image"), Malformed::TopicName);
    assert_eq!(refused("String_", "String"), Malformed::TypeName);
    assert_eq!(refused("RIHS01", "RIHS02"), Malformed::TypeHash);
    assert_eq!(refused("::,:,:,:,,", "::,"), Malformed::Qos);
    assert_eq!(refused("camera", &"c".repeat(4000)), Malformed::KeyTooLong);
    let parts: Vec<_> = good.split('/').collect();
    for n in 0..parts.len() {
        assert!(Token::parse(&parts[..n].join("/")).is_err(), "{n} parts");
    }
    assert_eq!(Token::parse("@ros2_lv/0/a1/3/4/NN/%/%/camera"), Err(Malformed::Id));
}

#[test]
fn qos_texts() {
    let texts = [
        ("::,10:,:,:,,", qos(10)),
        ("2::,5:,:,:,,", WireQos { reliability: Reliability::BestEffort, ..qos(5) }),
        (":1:,1:,:,:,,", WireQos { durability: Durability::TransientLocal, ..qos(1) }),
        ("::,:,:,:,,", qos(42)),
        ("::2,0:,:,:,,", WireQos { history: History::KeepAll, ..qos(0) }),
        ("::,7:0,100000000:,:,,", WireQos { deadline: WireDuration { sec: 0, nsec: 100_000_000 }, ..qos(7) }),
        (
            "::,7:,:1,0:3,2,0",
            WireQos {
                lifespan: WireDuration { sec: 1, nsec: 0 },
                manual_liveliness: true,
                lease: WireDuration { sec: 2, nsec: 0 },
                ..qos(7)
            },
        ),
    ];
    for (text, qos) in texts {
        assert_eq!(qos.to_string(), text);
        assert_eq!(WireQos::parse(text), Ok(qos), "{text}");
    }
    // Defaults spelt out by less thrifty peers.
    assert_eq!(WireQos::parse("1:2:1,10:9223372036,854775807:,:1,,"), Ok(qos(10)));
    for text in [
        "",
        ":",
        "::::::",
        "::,:,:,:,,:",
        "::,:,:,:,,,",
        "::1:,:,:,,",
        "3::,:,:,:,,",
        "::,-1:,:,:,,",
        "::,99999999999:,:,:,,",
        ":3:,:,:,:,,",
        "::3,:,:,:,,",
        "::,:,,:,:,,",
        "::,:1:,:,,",
        "::,:,:,:4,,",
        "::,:,:,:,",
        "::,:18446744073709551616,:,:,,",
    ] {
        assert_eq!(WireQos::parse(text), Err(Malformed::Qos), "{text}");
    }
}

#[test]
fn durations() {
    let durations =
        [None, Some(Duration::ZERO), Some(Duration::from_millis(1500)), Some(Duration::from_nanos(1))];
    for duration in durations {
        assert_eq!(WireDuration::from_duration(duration).to_duration(), duration);
    }
    assert_eq!(WireDuration::from_duration(Some(Duration::MAX)), WireDuration::INFINITE);
    assert_eq!(WireDuration { sec: u64::MAX, nsec: u64::MAX }.to_duration(), None);
}

#[test]
fn attachments() {
    let attachment =
        Attachment { sequence_number: 1, source_timestamp_ns: 0x0102_0304_0506_0708, gid: Gid([0xAB; 16]) };
    let mut golden = vec![1, 0, 0, 0, 0, 0, 0, 0, 8, 7, 6, 5, 4, 3, 2, 1, 0x10];
    golden.extend([0xAB; 16]);
    assert_eq!(attachment.encode().as_slice(), golden);
    assert_eq!(Attachment::parse(&golden), Ok(attachment));
    for n in 0..33 {
        assert_eq!(Attachment::parse(&golden[..n]), Err(Malformed::Attachment), "{n} bytes");
    }
    golden.push(0);
    assert_eq!(Attachment::parse(&golden), Err(Malformed::Attachment));
    golden.pop();
    golden[16] = 15;
    assert_eq!(Attachment::parse(&golden), Err(Malformed::Attachment));
}

#[test]
fn encapsulations() {
    let mut payload = ENCAPSULATION.to_vec();
    payload.extend([8, 0, 0, 0]);
    payload.extend(b"Hello 0\0");
    assert_eq!(check_encapsulation(&payload), Ok(()));
    assert_eq!(check_encapsulation(&[0, 1, 0, 3]), Ok(()));
    for n in 0..4 {
        assert_eq!(check_encapsulation(&payload[..n]), Err(Malformed::PayloadTooShort));
    }
    // Big-endian, XCDR1 parameter list, XCDR2.
    for id in [0, 2, 3, 6, 7, 9, 0xB] {
        assert_eq!(check_encapsulation(&[0, id, 0, 0]), Err(Malformed::Encapsulation));
    }
    assert_eq!(check_encapsulation(&[1, 1, 0, 0]), Err(Malformed::Encapsulation));
}

#[test]
fn gids() {
    let text = format!(
        "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    );
    let token = Token::parse(&text).unwrap();
    // From `xxhash.xxh3_128_digest(text)[::-1]`: python-xxhash writes the high half first, big-endian.
    assert_eq!(endpoint_gid(&token), Gid(GOLDEN_GID));
    // However a peer spells the defaults, the gid is that of the canonical text.
    let spelt = text.replace("/::,7:,:,:,,", "/1:2:1,7:,:,:1,,");
    assert_eq!(endpoint_gid(&Token::parse(&spelt).unwrap()), endpoint_gid(&token));
}

/// rmw_zenoh_cpp 0.10.5, src/detail/liveliness_utils.cpp:578-585 (ros2-gbp/rmw_zenoh-release, commit ce85fe8b): the
/// hash is over the whole key, backends included.
#[test]
fn gids_of_both_generations() {
    let hash = format!("RIHS01_{}", "0123456789abcdef".repeat(4));
    let older = format!(
        "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/11/MS/%/%/viewer/%image/sensor_msgs::msg::dds_::Image_/{hash}/::,5:,:,:,,"
    );
    let newer = format!("{older}/backends:cpu:");
    // As above, from python-xxhash.
    assert_eq!(endpoint_gid(&Token::parse(&older).unwrap()), Gid(OLDER_GID));
    assert_eq!(endpoint_gid(&Token::parse(&newer).unwrap()), Gid(NEWER_GID));
}

const GOLDEN_GID: [u8; 16] =
    [0xc1, 0x28, 0xaa, 0x55, 0x67, 0xaf, 0x01, 0xb7, 0x16, 0x3e, 0xae, 0x5e, 0x2a, 0x83, 0x62, 0xd7];

const OLDER_GID: [u8; 16] =
    [0xd7, 0xe8, 0x86, 0x45, 0x52, 0x70, 0x5f, 0x34, 0x95, 0xd4, 0x19, 0x4e, 0x7b, 0x18, 0xef, 0x02];
const NEWER_GID: [u8; 16] =
    [0x71, 0x09, 0xa9, 0x67, 0x4c, 0x13, 0xf3, 0x53, 0x12, 0xc5, 0xb6, 0x14, 0xbc, 0x82, 0x1c, 0x3b];

fn name(random: &mut StdRng, letters: &[u8], max: usize) -> String {
    let len = random.random_range(1..=max);
    (0..len).map(|_| char::from(*letters.choose(random).unwrap())).collect()
}

fn absolute(random: &mut StdRng) -> String {
    let parts = random.random_range(1..4);
    (0..parts).map(|_| format!("/{}", name(random, b"abcXYZ019_", 20))).collect()
}

fn random_type(random: &mut StdRng) -> TypeId {
    let kind = ["msg", "srv", "action"].choose(random).unwrap();
    let text = format!("p{}/{kind}/N{}", name(random, b"abc123", 20), name(random, b"abcXYZ019", 20));
    let hash: String = (0..64).map(|_| char::from(*b"0123456789abcdef".choose(random).unwrap())).collect();
    TypeId { name: text.parse().unwrap(), hash: format!("RIHS01_{hash}").parse().unwrap() }
}

fn random_duration(random: &mut StdRng) -> WireDuration {
    let mut part = |infinite| if random.random() { infinite } else { random.random_range(0..2_000_000_000) };
    WireDuration { sec: part(WireDuration::INFINITE.sec), nsec: part(WireDuration::INFINITE.nsec) }
}

fn random_token(random: &mut StdRng) -> Token {
    let domain = random.random_range(0..=232);
    let node_id = random.random();
    let space = |random: &mut StdRng| if random.random() { "/".into() } else { absolute(random) };
    let node =
        NodeName { enclave: space(random), namespace: space(random), name: name(random, b"abc_09", 30) };
    let kinds =
        [EndpointKind::Publisher, EndpointKind::Subscription, EndpointKind::Service, EndpointKind::Client];
    let endpoint = random.random_bool(0.8).then(|| Endpoint {
        id: random.random(),
        kind: *kinds.choose(random).unwrap(),
        name: absolute(random),
        type_id: random_type(random),
        qos: WireQos {
            reliability: if random.random() { Reliability::Reliable } else { Reliability::BestEffort },
            durability: if random.random() { Durability::Volatile } else { Durability::TransientLocal },
            history: if random.random() { History::KeepLast } else { History::KeepAll },
            depth: random.random_range(0..=MAX_DEPTH),
            deadline: random_duration(random),
            lifespan: random_duration(random),
            manual_liveliness: random.random(),
            lease: random_duration(random),
        },
        suffix: if random.random() { String::new() } else { (*SUFFIXES.choose(random).unwrap()).into() },
    });
    let note = ["", "a", "tautline,0,1,x"].choose(random).unwrap().to_string();
    Token { domain, zid: random.random::<u128>().max(1), node_id, node, endpoint, note }
}

#[test]
fn what_is_encoded_is_read_back() {
    let mut random = tautline_seed::random();
    for _ in 0..20_000 {
        let token = random_token(&mut random);
        assert_eq!(Token::parse(&token.to_string()), Ok(token.clone()), "{token}");
        let topic = absolute(&mut random);
        let key = TopicKey { domain: token.domain, topic, type_id: random_type(&mut random) };
        assert_eq!(TopicKey::parse(&key.to_string()), Ok(key.clone()), "{key}");
        let attachment = Attachment {
            sequence_number: random.random(),
            source_timestamp_ns: random.random(),
            gid: Gid(random.random()),
        };
        assert_eq!(Attachment::parse(&attachment.encode()), Ok(attachment));
    }
}

#[test]
fn whatever_is_read_can_be_written_again() {
    let mut random = tautline_seed::random();
    let mut accepted = 0;
    for _ in 0..200_000 {
        let mut text = random_token(&mut random).to_string().into_bytes();
        for _ in 0..random.random_range(1..4) {
            mutate(&mut random, &mut text);
        }
        let text = String::from_utf8_lossy(&text);
        if let Ok(token) = Token::parse(&text) {
            accepted += 1;
            assert_eq!(Token::parse(&token.to_string()), Ok(token.clone()), "{text}");
            let _ = endpoint_gid(&token);
        }
        if let Ok(key) = TopicKey::parse(&text) {
            assert_eq!(TopicKey::parse(&key.to_string()), Ok(key), "{text}");
        }
    }
    println!("{accepted} of 200,000 accepted");
    assert!(accepted > 1000);
}

fn mutate(random: &mut StdRng, text: &mut Vec<u8>) {
    if text.is_empty() {
        return;
    }
    let at = random.random_range(0..text.len());
    match random.random_range(0..4) {
        0 => text[at] = random.random(),
        1 => drop(text.remove(at)),
        2 => text.insert(at, *b"/%:,_09a*$#?".choose(random).unwrap()),
        _ => text.truncate(at.max(1)),
    }
}

#[test]
fn random_bytes_never_panic() {
    let mut random = tautline_seed::random();
    let mut bytes = [0; 80];
    for _ in 0..200_000 {
        let len = random.random_range(0..bytes.len());
        random.fill_bytes(&mut bytes[..len]);
        let _ = Attachment::parse(&bytes[..len]);
        let _ = check_encapsulation(&bytes[..len]);
        let text = String::from_utf8_lossy(&bytes[..len]);
        let _ = (Token::parse(&text), TopicKey::parse(&text), WireQos::parse(&text));
    }
}

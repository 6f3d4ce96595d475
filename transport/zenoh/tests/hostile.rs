// SPDX-License-Identifier: MIT OR Apache-2.0
//! A peer that means harm: what it sends is dropped and counted with a reason, memory stays bounded, and what honest
//! peers send goes on arriving.

mod support;

use rand::{Rng, RngExt};
use std::collections::BTreeMap;
use support::{Host, UNKNOWN_HASH, connect, image_type, string_type, take, until};
use tautline_gateway::wire::{Attachment, Token, endpoint_gid};
use tautline_gateway::{Direction, GraphLimits};
use tautline_transport::{Qos, TopicType};
use zenoh::Wait;

const KEY_TYPE: &str = "std_msgs::msg::dds_::String_";

/// Of the publisher with this token.
fn attachment_of(token: &str, sequence_number: i64, source_timestamp_ns: i64) -> [u8; 33] {
    let gid = endpoint_gid(&Token::parse(token).unwrap());
    Attachment { sequence_number, source_timestamp_ns, gid }.encode()
}

fn token(domain: u32, id: u64, kind: &str, topic: &str) -> String {
    format!("@ros2_lv/{domain}/bad/0/{id}/{kind}/%/%/n/%{topic}/{KEY_TYPE}/{UNKNOWN_HASH}/::,10:,:,:,,")
}

fn dropped(host: &Host, topic: &str) -> BTreeMap<String, u64> {
    let stats = host.stats().topics.into_iter();
    let mut found = stats.filter(|stats| stats.name.topic == topic && stats.direction == Direction::In);
    found.next().map(|stats| stats.reading.dropped).unwrap_or_default()
}

fn now_ns() -> i64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos() as i64
}

#[test]
fn samples_that_are_none() {
    let mut random = tautline_seed::random();
    let host = Host::new(196, 196, |options| {
        options.network.listen = vec!["tcp/127.0.0.1:0".into()];
        options.max_message_bytes = 1 << 20;
    });
    let subscription = host.subscription("/x", &string_type(), Qos::keep_last(1000));
    let fixed_type = TopicType::new("geometry_msgs/msg/Vector3")
        .with_hash(UNKNOWN_HASH.replace("_df", "_cc"))
        .with_body_bytes(24);
    let fixed = host.subscription("/fixed", &fixed_type, Qos::keep_last(1000));
    let enemy = host.session();
    let of_x = token(196, 1, "MP", "x");
    let _token = enemy.liveliness().declare_token(of_x.clone()).wait().unwrap();
    let attachment = |number, time_ns| attachment_of(&of_x, number, time_ns);
    let of_fixed =
        token(196, 2, "MP", "fixed").replace("std_msgs", "geometry_msgs").replace("String_", "Vector3_");
    let of_fixed = of_fixed.replace("_df", "_cc");
    let _fixed_token = enemy.liveliness().declare_token(of_fixed.clone()).wait().unwrap();
    let key = format!("196/x/{KEY_TYPE}/{UNKNOWN_HASH}");
    let good = [&[0, 1, 0, 0, 3, 0, 0, 0][..], b"ab\0"].concat();
    // On a full link Zenoh would drop what is to arrive.
    let block = zenoh::qos::CongestionControl::Block;
    let put = |payload: Vec<u8>, attachment: Option<Vec<u8>>| {
        let put = enemy.put(&key, payload).congestion_control(block);
        match attachment {
            Some(bytes) => put.attachment(bytes).wait().unwrap(),
            None => put.wait().unwrap(),
        }
    };
    // Until the gateway listens.
    until("a connection", || {
        put(good.clone(), Some(attachment(1, now_ns()).into()));
        std::thread::sleep(std::time::Duration::from_millis(5));
        subscription.try_take_valid().unwrap().is_some()
    });
    let honest = attachment(2, now_ns()).to_vec();
    put(good.clone(), None);
    put(good.clone(), Some(vec![]));
    put(good.clone(), Some(honest[..32].to_vec()));
    put(good.clone(), Some([honest.clone(), vec![0]].concat()));
    put(good.clone(), Some(vec![0xFF; 100_000]));
    put(vec![], Some(honest.clone()));
    put(vec![0, 1, 0], Some(honest.clone()));
    put(vec![0, 0, 0, 0, 1, 2, 3, 4], Some(honest.clone()));
    put(vec![0, 7, 0, 0, 1, 2, 3, 4], Some(honest.clone()));
    put(good.clone(), Some(attachment(-1, now_ns()).into()));
    put(good.clone(), Some(attachment(3, i64::MIN).into()));
    put([vec![0, 1, 0, 0], vec![0; (1 << 20) + 1000]].concat(), Some(honest.clone()));
    // What is longer than the limit with its headers Zenoh does not even gather.
    put([vec![0, 1, 0, 0], vec![0; 4 << 20]].concat(), Some(honest.clone()));
    enemy.delete(&key).congestion_control(block).wait().unwrap();
    for _ in 0..300 {
        let mut bytes = vec![0; random.random_range(0..200)];
        random.fill_bytes(&mut bytes);
        let beside = random.random_bool(0.5).then(|| {
            let mut bytes = vec![0; random.random_range(0..40)];
            random.fill_bytes(&mut bytes);
            bytes
        });
        put(bytes, beside);
    }
    // On keys of our domain that are no topics, or another type's: nobody subscribed to them.
    for key in ["196/x", "196/a/b/c/d", "196/x/y/RIHS01_00", "@ros2_lv/196/zzz", &key.replace("df", "00")] {
        enemy.put(key, "junk").wait().unwrap();
    }
    let fixed_key = key
        .replace("196/x/", "196/fixed/")
        .replace("std_msgs", "geometry_msgs")
        .replace("String_", "Vector3_");
    let fixed_key = fixed_key.replace("_df", "_cc");
    let honest = attachment_of(&of_fixed, 2, now_ns()).to_vec();
    let put_fixed = |body: Vec<u8>| {
        enemy.put(&fixed_key, body).attachment(honest.clone()).congestion_control(block).wait().unwrap();
    };
    until("a connection", || {
        let body = [&[0, 1, 0, 0][..], &[7; 24]].concat();
        put_fixed(body);
        std::thread::sleep(std::time::Duration::from_millis(5));
        fixed.try_take_valid().unwrap().is_some()
    });
    for len in [0, 23, 33, 1000] {
        let body = [vec![0, 1, 0, 0], vec![7; len]].concat();
        put_fixed(body);
    }
    // With what Fast CDR appends it is a Vector3 still.
    let body = [&[0, 1, 0, 0][..], &[9; 32]].concat();
    put_fixed(body);
    while take(&fixed).body() != [9; 24] {}

    // Honest samples after all that, also those of hosts whose clocks are days and centuries ahead of this one's.
    for (number, time_ns) in [(9, now_ns()), (10, now_ns() + 86_400_000_000_000), (11, i64::MAX)] {
        put(good.clone(), Some(attachment(number, time_ns).into()));
        until("the honest sample", || {
            let taken = subscription.try_take_valid().unwrap();
            taken.is_some_and(|sample| support::origin(sample.info()) == (number as u64, time_ns))
        });
    }
    let reasons = [
        "no attachment",
        "malformed attachment",
        "payload shorter than its encapsulation",
        "encapsulation other than XCDR1 little-endian",
        "negative sequence number",
        "payload over the size limit",
        "time stamp before 1970",
        "a deletion, which topics do not have",
    ];
    let is_counted = |topic: &str, reasons: &[&str]| {
        let dropped = dropped(&host, topic);
        reasons.iter().all(|reason| dropped.contains_key(*reason))
    };
    until("the counters of /x", || is_counted("/x", &reasons));
    until("the counters of /fixed", || is_counted("/fixed", &["length differs from the type's"]));
    let dropped = dropped(&host, "/x");
    assert!(dropped.values().sum::<u64>() >= 312, "{dropped:?}");
}

/// The text of a message claims a string of 2 GiB: what lies in shared memory is a claim for its readers, too.
#[test]
fn a_claimed_length_allocates_nothing() {
    let a = Host::first(197, 197);
    let subscription = a.subscription("/x", &string_type(), Qos::keep_last(10));
    let enemy = a.session();
    let of_x = token(197, 1, "MP", "x");
    let _token = enemy.liveliness().declare_token(of_x.clone()).wait().unwrap();
    let payload = [0, 1, 0, 0, 0xFF, 0xFF, 0xFF, 0x7F, b'a', 0];
    let key = format!("197/x/{KEY_TYPE}/{UNKNOWN_HASH}");
    let before = resident_bytes();
    let mut taken = 0;
    until("what was let through or dropped", || {
        enemy.put(&key, payload).attachment(attachment_of(&of_x, 1, now_ns())).wait().unwrap();
        std::thread::sleep(std::time::Duration::from_millis(5));
        taken += usize::from(subscription.try_take_valid().unwrap().is_some());
        taken > 3 || dropped(&a, "/x").values().sum::<u64>() > 3
    });
    assert!(resident_bytes() < before + (256 << 20));
}

#[test]
fn floods_of_tokens_leave_memory_bounded_and_honest_peers_served() {
    let a = Host::new(198, 198, |options| {
        options.network.listen = vec!["tcp/127.0.0.1:0".into()];
        options.limits = GraphLimits { tokens: 2000, tokens_per_session: 1000 };
    });
    let publisher = a.publisher("/x", &image_type(), Qos::keep_last(10));
    let enemy = a.session();
    let before = resident_bytes();
    let mut tokens = Vec::new();
    for n in 0..3000 {
        tokens.push(enemy.liveliness().declare_token(token(198, n, "MS", &format!("t{n}"))).wait().unwrap());
        if n % 10 == 0 {
            let garbage = format!("@ros2_lv/198/garbage/{n}/x{}", "long".repeat(n as usize % 50));
            tokens.push(enemy.liveliness().declare_token(garbage).wait().unwrap());
        }
    }
    until("refusals", || a.stats().refused_tokens.contains_key("over the limit"));
    until("malformed ones", || a.stats().refused_tokens.contains_key("malformed session id"));
    assert!(a.gateway().remote().len() <= 1000);
    assert!(resident_bytes() < before + (256 << 20));

    let b = Host::beside(&a, 199);
    let subscription = b.subscription("/x", &image_type(), Qos::keep_last(10));
    connect(&publisher, &[&subscription], b"probe");
    drop(tokens);
    enemy.close().wait().unwrap();
    until("the enemy's end", || a.gateway().remote().iter().all(|token| token.zid != 0xbad));
}

fn resident_bytes() -> usize {
    let text = std::fs::read_to_string("/proc/self/statm").unwrap();
    text.split(' ').nth(1).unwrap().parse::<usize>().unwrap() * 4096
}

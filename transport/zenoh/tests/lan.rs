// SPDX-License-Identifier: MIT OR Apache-2.0
//! Three hosts on a network that fails in the ways that networks do.

#[path = "support/lan.rs"]
mod lan;

use lan::{Lan, Node, address, body, checksum, endpoint};
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

const MS: Duration = Duration::from_millis(1);
/// More than comes at once after a link stood still, so that what is lost was lost on the way.
const DEPTH: usize = 1000;

/// Not a test: what the nodes on the hosts run.
#[test]
fn role() {
    lan::play();
}

macro_rules! or_skip {
    () => {
        if let Some(reason) = lan::reason_to_skip() {
            println!("{reason}");
            return;
        }
    };
}

/// Publishes until each subscriber has heard something, then until all is quiet.
fn connect(publisher: &mut Node, subscribers: &[&Node]) {
    let start = Instant::now();
    let mut silent: Vec<_> = subscribers.to_vec();
    while !silent.is_empty() {
        publisher.publish(8, 5, 10 * MS);
        silent.retain(|subscriber| subscriber.arrived().is_empty());
        assert!(start.elapsed() < Duration::from_secs(60), "no connection");
    }
    let last = publisher.publish(9, 1, MS);
    for subscriber in subscribers {
        while subscriber.sample().number != last {}
    }
}

#[test]
fn one_publishes_and_two_receive_every_size() {
    or_skip!();
    let lan = Lan::new(3);
    let [a, b, c] = &lan.hosts[..] else { unreachable!() };
    let mut gateway_a = a.gateway(&["--listen", &endpoint(0)]);
    let mut gateway_b = b.gateway(&["--listen", &endpoint(1), "--connect", &endpoint(0)]);
    let _gateway_c =
        c.gateway(&["--listen", &endpoint(2), "--connect", &endpoint(0), "--connect", &endpoint(1)]);
    let (at_b, at_c) = (b.subscriber("/image", 10), c.subscriber("/image", 10));
    let mut publisher = a.publisher("/image", 10);
    connect(&mut publisher, &[&at_b, &at_c]);
    for bytes in [64, 1000, 4096, 65_536, 1 << 20, 8 << 20] {
        let number = publisher.publish(bytes, 1, MS);
        let expected = checksum(&body(bytes, number));
        for subscriber in [&at_b, &at_c] {
            let sample = subscriber.sample();
            assert_eq!((sample.bytes, sample.number, sample.checksum), (bytes, number, expected));
        }
    }
    let inward = gateway_b.wait_for("/image", "in", |stats| stats["bytes"].as_u64() > Some(9 << 20));
    assert_eq!((&inward["lost"], &inward["dropped"]), (&0.into(), &serde_json::json!({})));

    // What nobody wants: nothing on the wire but what keeps the links alive.
    let mut unwanted = a.publisher("/unwanted", DEPTH);
    gateway_a.stats();
    let before = a.packets_sent();
    unwanted.publish(1000, 2000, MS);
    let sent = a.packets_sent() - before;
    assert!(sent < 200, "{sent} packets for 2,000 samples that nobody wants");
    let stats = gateway_a.stats();
    let topics: BTreeSet<_> =
        stats["topics"].as_array().unwrap().iter().map(|t| t["topic"].as_str().unwrap()).collect();
    assert_eq!(topics, BTreeSet::from(["/image"]));
}

#[test]
fn a_link_that_was_down_resumes_and_losses_are_counted() {
    or_skip!();
    let lan = Lan::new(2);
    let [a, b] = &lan.hosts[..] else { unreachable!() };
    let _gateway_a = a.gateway(&["--listen", &endpoint(0)]);
    let mut gateway_b = b.gateway(&["--connect", &endpoint(0)]);
    let subscriber = b.subscriber("/x", DEPTH);
    let mut publisher = a.publisher("/x", DEPTH);
    connect(&mut publisher, &[&subscriber]);
    let before = gateway_b.wait_for("/x", "in", |_| true)["lost"].as_u64().unwrap();
    let first = publisher.publish(100, 1, MS) + 1;
    // Bulk, so that the queues of the link cannot hold it all.
    publisher.tell("100000 350 20000");
    std::thread::sleep(500 * MS);
    a.ip("link set eth0 down");
    std::thread::sleep(5000 * MS);
    a.ip("link set eth0 up");
    let start = Instant::now();
    publisher.expect(&format!("published {}", first + 349));
    let last = publisher.publish(101, 1, MS);
    let mut numbers = BTreeSet::new();
    loop {
        let number = subscriber.sample().number;
        if number >= first {
            assert!(numbers.insert(number), "{number} came twice");
        }
        if number == last {
            break;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "it does not resume");
    }
    let missing = (last - first + 1) - numbers.len() as u64;
    println!("{missing} of {} samples lost", last - first + 1);
    let lost = gateway_b.wait_for("/x", "in", |stats| stats["lost"].as_u64() >= Some(before + missing));
    assert_eq!(lost["lost"].as_u64().unwrap() - before, missing);
}

#[test]
fn a_router_and_a_gateway_are_killed_and_started_again() {
    or_skip!();
    let lan = Lan::new(3);
    let [a, b, r] = &lan.hosts[..] else { unreachable!() };
    let router_at = endpoint(2);
    let router = r.gateway(&["--router", "--listen", &router_at]);
    let gateway_a = a.gateway(&["--client", "--connect", &router_at]);
    let _gateway_b = b.gateway(&["--client", "--connect", &router_at]);
    let subscriber = b.subscriber("/x", DEPTH);
    let mut publisher = a.publisher("/x", DEPTH);
    connect(&mut publisher, &[&subscriber]);

    router.kill();
    publisher.publish(10, 50, MS);
    let _router = r.gateway(&["--router", "--listen", &router_at]);
    connect(&mut publisher, &[&subscriber]);

    gateway_a.kill();
    publisher.publish(10, 50, MS);
    let _gateway_a = a.gateway(&["--client", "--connect", &router_at]);
    connect(&mut publisher, &[&subscriber]);
}

#[test]
fn latency_of_the_network_shows_in_the_numbers() {
    or_skip!();
    let lan = Lan::new(2);
    let [a, b] = &lan.hosts[..] else { unreachable!() };
    let has_netem = a.try_sh("tc qdisc add dev eth0 root netem delay 20ms");
    let _gateway_a = a.gateway(&["--listen", &endpoint(0)]);
    let relay = (!has_netem).then(|| {
        println!("tc netem is not in this kernel: a relay delays instead");
        b.relay(9000, &format!("{}:7447", address(0)), 20 * MS)
    });
    let connect_to = if relay.is_some() { "tcp/127.0.0.1:9000".to_owned() } else { endpoint(0) };
    let mut gateway_b = b.gateway(&["--client", "--connect", &connect_to]);
    let subscriber = b.subscriber("/x", DEPTH);
    let mut publisher = a.publisher("/x", DEPTH);
    connect(&mut publisher, &[&subscriber]);
    publisher.publish(10, 100, 5 * MS);
    let stats = gateway_b.wait_for("/x", "in", |stats| stats["messages"].as_u64() > Some(100));
    // Both hosts have one clock.
    let p50 = stats["latency_us"]["p50"].as_u64().unwrap();
    assert!(p50 >= 19_800, "{stats}");
}

#[test]
fn loss_on_the_network_loses_nothing_that_is_reliable() {
    or_skip!();
    let lan = Lan::new(2);
    let [a, b] = &lan.hosts[..] else { unreachable!() };
    let nft = "nft 'add table ip t; add chain ip t in { type filter hook input priority 0; }; \
               add rule ip t in iifname eth0 numgen random mod 100 < 10 drop'";
    let iptables = "iptables -A INPUT -i eth0 -m statistic --mode random --probability 0.1 -j DROP";
    let ways = ["tc qdisc add dev eth0 root netem loss 10%", nft, iptables];
    let Some(way) = ways.into_iter().find(|way| a.try_sh(way) && b.try_sh(way)) else {
        let reason = "neither tc netem nor nft nor iptables can drop packets here";
        assert!(std::env::var_os("CI").is_none(), "{reason}");
        return println!("skipped: {reason}");
    };
    println!("10 % lost each way by: {way}");
    let _gateway_a = a.gateway(&["--listen", &endpoint(0)]);
    let mut gateway_b = b.gateway(&["--connect", &endpoint(0)]);
    let subscriber = b.subscriber("/x", DEPTH);
    let mut publisher = a.publisher("/x", DEPTH);
    connect(&mut publisher, &[&subscriber]);
    let before = gateway_b.wait_for("/x", "in", |_| true)["lost"].clone();
    let last = publisher.publish(200, 500, 10 * MS);
    for number in last - 499..=last {
        let sample = subscriber.sample();
        assert_eq!((sample.number, sample.checksum), (number, checksum(&body(200, number))));
    }
    assert_eq!(gateway_b.wait_for("/x", "in", |_| true)["lost"], before);
}

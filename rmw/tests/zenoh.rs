// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of rclpy on an installed rmw_zenoh_cpp, through the gateway, and nodes of rclpy on rmw_tautline: what `cargo xtask peers` runs
//! where there is an rmw_zenoh_cpp.

mod support;

use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use support::gateway::{GatewayProcess, listen};
use support::{Domain, Peer, STRING, TYPES, cross, on_tautline, wait_until};
use tautline_schema::Packages;

const BASIC_TYPES: &str = "test_msgs/srv/BasicTypes";
const IMAGE: &str = "sensor_msgs/msg/Image";

/// A domain, its gateway, and the library of nodes behind that.
struct Hosts {
    gateway: GatewayProcess,
    domain: Domain,
    library: PathBuf,
}

impl Hosts {
    /// For this test alone; prints why it is skipped.
    fn new(domain: u32) -> Option<Self> {
        let library = rmw_zenoh()?;
        let domain = Domain::new(domain)?;
        Some(Hosts { gateway: listen(domain.number)?, domain, library })
    }

    /// A node on rmw_tautline and one on rmw_zenoh_cpp, which know of each other.
    fn peers(&self) -> [Peer; 2] {
        self.both("ros_peer.py")
    }

    /// The same with services and actions.
    fn peers_with_services(&self) -> [Peer; 2] {
        self.both("ros_services_peer.py")
    }

    fn both(&self, script: &str) -> [Peer; 2] {
        let mut ours = Peer::start_as(&self.domain.venv, self.domain.number, "ours", script, on_tautline);
        let mut theirs = self.theirs("theirs", script, &[]);
        ours.tell(json!({ "do": "wait_node", "name": "/theirs" }));
        theirs.tell(json!({ "do": "wait_node", "name": "/ours" }));
        [ours, theirs]
    }

    fn theirs(&self, name: &str, script: &str, arguments: &[&str]) -> Peer {
        let prefix = self.library.ancestors().nth(2).unwrap();
        let prefixes = std::env::var("AMENT_PREFIX_PATH").unwrap_or_default();
        let links = format!(
            "connect/endpoints=[\"{}\"];listen/endpoints=[\"tcp/127.0.0.1:0\"]",
            self.gateway.endpoint()
        );
        Peer::start_as(&self.domain.venv, self.domain.number, name, script, |command| {
            command.args(arguments);
            command.env("RMW_IMPLEMENTATION", "rmw_zenoh_cpp").env("LD_PRELOAD", &self.library);
            command.env("AMENT_PREFIX_PATH", format!("{}:{prefixes}", prefix.display()));
            command.env_remove("ZENOH_SESSION_CONFIG_URI").env("ZENOH_CONFIG_OVERRIDE", links);
            // Its output is answers.
            command.env("RUST_LOG", "off");
            // There is no router.
            command.env("ZENOH_ROUTER_CHECK_ATTEMPTS", "-1");
        })
    }
}

impl Drop for Hosts {
    fn drop(&mut self) {
        if std::thread::panicking() {
            println!("the gateway's numbers: {}", self.gateway.stats());
        }
    }
}

/// The library that `TAUT_RMW_ZENOH` names, or that of the ROS 2 that is sourced.
fn rmw_zenoh() -> Option<PathBuf> {
    let named = std::env::var_os("TAUT_RMW_ZENOH").map(PathBuf::from);
    let prefixes = std::env::var_os("AMENT_PREFIX_PATH").unwrap_or_default();
    let sourced = std::env::split_paths(&prefixes).map(|prefix| prefix.join("lib/librmw_zenoh_cpp.so"));
    let found = named.into_iter().chain(sourced).find(|library| library.is_file());
    if found.is_none() {
        println!("skipped: no librmw_zenoh_cpp.so in a ROS 2 that is sourced, nor named by TAUT_RMW_ZENOH");
    }
    found
}

fn values(domain: u32, types: &str) {
    let Some(hosts) = Hosts::new(domain) else { return };
    let mut packages = Packages::new();
    packages.add_folder(Path::new(&hosts.domain.venv));
    let [mut ours, mut theirs] = hosts.peers();
    // Of what it does not keep, rmw_zenoh_cpp drops what its link is not ready for.
    cross(&mut ours, &mut theirs, &mut packages, types, true);
    cross(&mut theirs, &mut ours, &mut packages, types, true);
}

#[test]
fn values_of_test_messages() {
    values(120, TYPES[0]);
}

#[test]
fn values_of_texts_and_plain_types() {
    values(121, TYPES[1]);
}

#[test]
fn values_of_geometry_and_navigation() {
    values(122, TYPES[2]);
}

#[test]
fn values_of_sensors_and_joints() {
    values(123, TYPES[3]);
}

#[test]
fn services_and_actions_cross_both_ways() {
    let Some(hosts) = Hosts::new(124) else { return };
    let [mut ours, mut theirs] = hosts.peers_with_services();
    let both = [("/of_ours", true), ("/of_theirs", false)];
    for (name, is_ours) in both {
        let (server, client) = if is_ours { (&mut ours, &mut theirs) } else { (&mut theirs, &mut ours) };
        server.tell(json!({ "do": "service", "name": name, "type": BASIC_TYPES, "behaviour": "echo" }));
        let end = client.tell(json!({ "do": "client", "name": name, "type": BASIC_TYPES }));
        // rmw_zenoh_cpp queues ten responses, or requests, and drops older ones.
        for first in (0..200).step_by(5) {
            let requests: Vec<Value> = (first..first + 5).map(|n| json!({ "int32_value": n })).collect();
            let answers = client.tell(json!({ "do": "call", "end": end, "requests": requests }));
            let numbers = answers.as_array().unwrap().iter().map(|answer| answer["int32_value"].as_i64());
            assert!(numbers.eq((first..first + 5).map(Some)), "{name}: {answers}");
        }

        let name = format!("{name}/count");
        server.tell(json!({ "do": "action_server", "name": name }));
        let end = client.tell(json!({ "do": "action_client", "name": name }));
        let run = client.tell(json!({ "do": "goal", "end": end, "order": 6, "told": 1 }));
        assert_eq!((&run["status"], &run["sequence"]), (&json!(4), &json!([0, 1, 1, 2, 3, 5, 8])), "{run}");
        let run = client.tell(json!({ "do": "goal", "end": end, "order": 500, "cancel_after": 2 }));
        assert_eq!((&run["status"], &run["cancelling"]), (&json!(5), &json!(1)), "{run}");
        let run = client.tell(json!({ "do": "goal", "end": end, "order": -1 }));
        assert_eq!(run, json!({ "accepted": false }));
    }
}

/// Each way on 100 topics at once, beside threads that take all processors.
#[test]
fn late_joiners_get_what_is_kept() {
    let Some(hosts) = Hosts::new(125) else { return };
    let [mut ours, mut theirs] = hosts.peers();
    let qos = json!({ "latched": true, "depth": 10 });
    for (way, is_ours) in [("out", true), ("in", false)] {
        let (from, to) = if is_ours { (&mut ours, &mut theirs) } else { (&mut theirs, &mut ours) };
        let texts = |topic: usize| (0..10).map(|n| format!("{way} {topic} {n}")).collect::<Vec<_>>();
        for topic in 0..100 {
            let publisher = from.publisher(&format!("/{way}/topic{topic}"), STRING, qos.clone());
            from.publish_text(publisher, &texts(topic));
        }
        under_load(|| {
            let joined: Vec<u64> = (0..100)
                .map(|topic| to.subscription(&format!("/{way}/topic{topic}"), STRING, qos.clone()))
                .collect();
            for (topic, end) in joined.into_iter().enumerate() {
                assert_eq!(to.take_texts(end, 10), texts(topic));
            }
        });
    }
}

fn under_load(act: impl FnOnce()) {
    struct End<'a>(&'a AtomicBool);
    impl Drop for End<'_> {
        fn drop(&mut self) {
            self.0.store(true, Ordering::Relaxed);
        }
    }
    let has_ended = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let _end = End(&has_ended);
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) * 2 {
            scope.spawn(|| {
                while !has_ended.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        act();
    });
}

/// More at once than any queue on the way has room for by itself.
#[test]
fn bursts_arrive_whole() {
    let Some(hosts) = Hosts::new(126) else { return };
    let [mut ours, mut theirs] = hosts.peers();
    let kinds = [
        ("kept", 1000, json!({ "latched": true, "depth": 1000 })),
        ("all", 5000, json!({ "keep_all": true })),
    ];
    for (kind, count, qos) in kinds {
        for (way, is_ours) in [("out", true), ("in", false)] {
            let (from, to) = if is_ours { (&mut ours, &mut theirs) } else { (&mut theirs, &mut ours) };
            let topic = format!("/{kind}/{way}");
            let subscription = to.subscription(&topic, STRING, qos.clone());
            let publisher = from.publisher(&topic, STRING, qos.clone());
            arrive(from, to, publisher, subscription);
            let texts: Vec<String> = (0..count).map(|n| format!("{kind} {way} {n}")).collect();
            from.publish_text(publisher, &texts);
            let heard = to.take_texts(subscription, count);
            assert!(heard == texts, "{topic}: {} of {count}, or in another order", heard.len());
        }
    }
}

/// Publishes until what is published arrives, and all of it has.
fn arrive(from: &mut Peer, to: &mut Peer, publisher: u64, subscription: u64) {
    let (mut count, mut last) = (0, None);
    wait_until("the way from end to end", || {
        count += 1;
        from.publish_text(publisher, &[count.to_string()]);
        std::thread::sleep(Duration::from_millis(20));
        last = to.take_texts(subscription, 0).pop().or(last.take());
        last.is_some()
    });
    while last != Some(count.to_string()) {
        last = to.take_texts(subscription, 1).pop();
    }
}

/// A burst that nothing may drop, and one image after another: of a burst of keep-last samples, rmw_zenoh_cpp itself drops what its
/// link is not ready for.
#[test]
fn large_images_arrive_whole() {
    let Some(hosts) = Hosts::new(127) else { return };
    let [mut ours, mut theirs] = hosts.peers();
    for (way, is_ours) in [("out", true), ("in", false)] {
        let (from, to) = if is_ours { (&mut ours, &mut theirs) } else { (&mut theirs, &mut ours) };
        for (kind, at_once, qos) in
            [("all", 20, json!({ "keep_all": true })), ("last", 1, json!({ "depth": 1 }))]
        {
            let topic = format!("/{kind}/{way}");
            let subscription = to.tell(json!({
                "do": "subscription", "topic": topic, "type": IMAGE, "qos": qos, "digest": true
            }));
            let publisher = from.publisher(&topic, IMAGE, qos);
            let subscription = subscription.as_u64().unwrap();
            let mut image = |seed: u64, bytes: usize| {
                from.tell(json!({
                    "do": "publish_large", "end": publisher, "type": IMAGE, "bytes": bytes, "seed": seed
                }))
            };
            // The first one that comes shows the way; it is small.
            let mut seed = 0;
            wait_until("the way from end to end", || {
                seed += 1;
                image(seed, 4);
                std::thread::sleep(Duration::from_millis(20));
                !to.take(subscription, 0).is_empty()
            });
            let last = image(seed + 1, 4);
            while to.take(subscription, 1).last() != Some(&last) {}
            for first in (1000..1020).step_by(at_once) {
                let digests: Vec<Value> = (0..at_once as u64).map(|n| image(first + n, 16 << 20)).collect();
                assert!(to.take(subscription, at_once) == digests, "{topic}, image {first}");
            }
        }
    }
}

#[test]
fn each_side_sees_the_others_enclaves() {
    let Some(hosts) = Hosts::new(128) else { return };
    let _node = hosts.domain.participant.create_node_in_enclave("ours", "/here", "/our/enclave").unwrap();
    let mut theirs = hosts.theirs("theirs", "ros_peer.py", &["--ros-args", "--enclave", "/their/enclave"]);
    let mut ours = hosts.domain.simple_peer("seen");
    assert_eq!(theirs.tell(json!({ "do": "enclave", "node": "/here/ours" })), "/our/enclave");
    assert_eq!(ours.tell(json!({ "do": "enclave", "node": "/theirs" })), "/their/enclave");
    // One that comes later reads all tokens at once.
    let mut later = hosts.theirs("later", "ros_peer.py", &[]);
    assert_eq!(later.tell(json!({ "do": "enclave", "node": "/here/ours" })), "/our/enclave");
}

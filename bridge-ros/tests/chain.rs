// SPDX-License-Identifier: MIT OR Apache-2.0
//! ROS graph, bridge, gateway, gateway, bridge, ROS graph: values of many types, and what happens when one of the four ends.

mod support;

use serde_json::json;
use std::time::Instant;
use support::gateway::{GatewayProcess, link};
use support::{BridgeProcess, Peer, STRING, TYPES, cross, ros, wait_until};
use tautline_schema::Packages;

impl Drop for Chain {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.gateways
                .iter()
                .flatten()
                .for_each(|gateway| println!("a gateway's numbers: {}", gateway.stats()));
            self.bridges
                .iter()
                .flatten()
                .for_each(|bridge| println!("a bridge's numbers: {}", bridge.stats()));
        }
    }
}

/// Two hosts, each with a ROS graph of its own.
struct Chain {
    gateways: [Option<GatewayProcess>; 2],
    bridges: [Option<BridgeProcess>; 2],
    domains: [u32; 2],
}

impl Chain {
    fn new(domains: [u32; 2]) -> Option<Self> {
        let gateways = link(domains[0], domains[1])?.map(Some);
        let bridges = domains.map(|domain| Some(BridgeProcess::start(domain, domain, &[])));
        Some(Chain { gateways, bridges, domains })
    }

    /// One of the four ends, and comes back.
    fn restart(&mut self, link: usize, is_killed: bool) {
        match link {
            0 | 3 => {
                let at = usize::from(link == 3);
                let bridge = self.bridges[at].take().unwrap();
                if is_killed {
                    bridge.kill();
                } else {
                    drop(bridge);
                }
                self.bridges[at] = Some(BridgeProcess::start(self.domains[at], self.domains[at], &[]));
            }
            _ => {
                let gateway = self.gateways[link - 1].take().unwrap();
                self.gateways[link - 1] = Some(gateway.again(is_killed, || {}));
            }
        }
    }
}

fn values_cross(domains: [u32; 2], types: &str) {
    let Some(venv) = ros() else { return };
    let mut packages = Packages::new();
    packages.add_folder(&venv);
    let Some(_chain) = Chain::new(domains) else { return };
    let mut left = Peer::start(&venv, domains[0], "left");
    let mut right = Peer::start(&venv, domains[1], "right");
    cross(&mut left, &mut right, &mut packages, types, false);
}

#[test]
fn of_test_messages() {
    values_cross([24, 25], TYPES[0]);
}

#[test]
fn of_texts_and_plain_values() {
    values_cross([26, 27], TYPES[1]);
}

#[test]
fn of_geometry_and_navigation() {
    values_cross([28, 29], TYPES[2]);
}

#[test]
fn of_sensors_and_joints() {
    values_cross([30, 31], TYPES[3]);
}

/// Whichever of the four ends, by `kill -9` or in order: what is published then is lost or arrives, once and in order, and what is
/// published once it is back arrives.
#[test]
fn whoever_ends_on_the_way_comes_back_and_nothing_comes_twice() {
    let Some(venv) = ros() else { return };
    let domains = [32, 33];
    let Some(mut chain) = Chain::new(domains) else { return };
    let mut left = Peer::start(&venv, domains[0], "left");
    let mut right = Peer::start(&venv, domains[1], "right");
    let qos = json!({ "depth": 1000 });
    let subscription = right.subscription("/numbers", STRING, qos.clone());
    let publisher = left.publisher("/numbers", STRING, qos);
    let (mut next, mut heard) = (0_u64, Vec::<u64>::new());
    let mut step = |heard: &mut Vec<u64>| {
        left.publish_text(publisher, &[next.to_string()]);
        next += 1;
        heard.extend(right.take_texts(subscription, 0).iter().map(|text| text.parse::<u64>().unwrap()));
        next
    };
    wait_until("the way from end to end", || {
        step(&mut heard);
        !heard.is_empty()
    });
    for link in 0..4 {
        for is_killed in [true, false] {
            let first = step(&mut heard);
            chain.restart(link, is_killed);
            let back = step(&mut heard);
            let start = Instant::now();
            wait_until("the way after one was back", || {
                step(&mut heard);
                heard.last().is_some_and(|last| *last >= back)
            });
            // Without a pause from here on: this many in a row.
            let sound = step(&mut heard);
            wait_until("all that is published since", || {
                step(&mut heard);
                heard.iter().filter(|number| **number >= sound).count() >= 100
            });
            let of = ["left bridge", "left gateway", "right gateway", "right bridge"][link];
            let lost = (first..sound).filter(|number| !heard.contains(number)).count();
            println!(
                "{of} {}: heard again {:.2} s after its start, {lost} of {} lost",
                if is_killed { "killed" } else { "ended" },
                start.elapsed().as_secs_f64(),
                sound - first
            );
            assert!(heard.windows(2).all(|pair| pair[0] < pair[1]), "twice, or out of order: {heard:?}");
            let since: Vec<u64> = heard.iter().copied().filter(|number| *number >= sound).collect();
            assert!(
                since.windows(2).all(|pair| pair[1] == pair[0] + 1),
                "lost after {of} was back: {since:?}"
            );
        }
    }
}

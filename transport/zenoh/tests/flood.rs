// SPDX-License-Identifier: MIT OR Apache-2.0
//! A flood takes the network's threads their priority, and its end gives it back. Zenoh's threads are the process's: a
//! program of its own.

mod support;

use support::{Host, connect, image_type, until};
use tautline_gateway::{Budget, Options, network_threads};
use tautline_rt::permission::{realtime_permitted, test_needs};
use tautline_rt::{Policy, Realtime};
use tautline_transport::Qos;

#[test]
fn a_flood_runs_without_priority() {
    if test_needs(realtime_permitted(Options::PRIORITY + 1)).is_none() {
        return;
    }
    let a = Host::new(219, 219, |options| {
        options.network.listen = vec!["tcp/127.0.0.1:0".into()];
        options.realtime = Realtime::Required;
        options.budget = Some(Budget { percent: 5 });
    });
    let b = Host::beside(&a, 220);
    let subscription = a.subscription("/flood", &image_type(), Qos::keep_last(10));
    let publisher = b.publisher("/flood", &image_type(), Qos::keep_last(10));
    connect(&publisher, &[&subscription], b"probe");
    let body = vec![7; 1 << 20];
    let flood = || {
        publisher.publish(&body).unwrap();
        while subscription.try_take_valid().unwrap().is_some() {}
    };
    // Zenoh's and the gateways' own, but for the one that looks, and the one that never has a priority.
    let mut seen = String::new();
    let mut is = |wanted: fn(Policy) -> bool| {
        let own = tautline_rt::threads().unwrap().into_iter();
        let mut threads: Vec<_> = own
            .filter(|thread| {
                thread.name.starts_with("gw-") && !["gw-budget", "gw-claim"].contains(&&*thread.name)
            })
            .collect();
        assert_eq!(threads.len(), 12, "six of each gateway: {threads:?}");
        threads.append(&mut network_threads().unwrap());
        let other = threads.iter().filter(|thread| !wanted(thread.policy)).map(|thread| &thread.name);
        let other = other.map(String::as_str).collect::<Vec<_>>().join(" ");
        // For whoever looks why it failed.
        if other != seen {
            println!("not so: {other}");
            seen.clone_from(&other);
        }
        other.is_empty()
    };
    until("ordinary threads", || {
        flood();
        is(|policy| matches!(policy, Policy::Other { .. }))
    });
    assert!(a.stats().throttled > 0);
    until("their priority", || is(|policy| policy == Policy::Fifo(Options::PRIORITY)));
}

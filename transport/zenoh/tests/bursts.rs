// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bursts of samples that are kept for late joiners, or between endpoints that keep all, arrive whole on another host.

mod support;

use std::sync::atomic::{AtomicBool, Ordering};
use support::{Host, connect, image_type, stats, string_type, take, until};
use tautline_gateway::Direction;
use tautline_transport::{Limits, Participant, PublishError, Qos, RawSubscription};

fn numbers(subscription: &RawSubscription, count: u64) -> Vec<u64> {
    let mut numbers = Vec::new();
    while (numbers.len() as u64) < count {
        let body = take(subscription).body().try_into().ok();
        numbers.extend(body.map(u64::from_le_bytes));
    }
    numbers
}

#[test]
fn a_burst_of_kept_samples_arrives_and_is_kept() {
    const COUNT: u64 = 1000;
    let a = Host::first(89, 89);
    let b = Host::beside(&a, 90);
    let qos = Qos::keep_last(COUNT as usize).transient_local();
    let publisher = a.publisher("/map", &string_type(), qos);
    let subscription = b.subscription("/map", &string_type(), qos);
    connect(&publisher, &[&subscription], b"probe");
    (0..COUNT).for_each(|n| publisher.publish(&n.to_le_bytes()).unwrap());
    assert!(numbers(&subscription, COUNT).into_iter().eq(0..COUNT));
    // A late joiner gets what the network's cache has.
    let c = Host::beside(&a, 91);
    let late = c.subscription("/map", &string_type(), qos);
    assert!(numbers(&late, COUNT).into_iter().eq(0..COUNT));
}

/// Of a topic whose samples go out already: the new publisher's wait until it is announced.
#[test]
fn a_burst_of_a_new_publisher_arrives() {
    const COUNT: u64 = 1000;
    let a = Host::first(97, 97);
    let b = Host::beside(&a, 98);
    let qos = Qos::keep_last(COUNT as usize).transient_local();
    let publisher = a.publisher("/map", &string_type(), qos);
    let subscription = b.subscription("/map", &string_type(), qos);
    connect(&publisher, &[&subscription], b"probe");
    let new = a.publisher("/map", &string_type(), qos);
    (0..COUNT).for_each(|n| new.publish(&n.to_le_bytes()).unwrap());
    assert!(numbers(&subscription, COUNT).into_iter().eq(0..COUNT));
}

#[test]
fn between_ends_that_keep_all_nothing_is_lost() {
    const COUNT: u64 = 5000;
    let a = Host::first(95, 95);
    let b = Host::beside(&a, 96);
    let publisher = a.publisher("/log", &string_type(), Qos::keep_all(10));
    let subscription = b.subscription("/log", &string_type(), Qos::keep_all(COUNT as usize));
    connect(&publisher, &[&subscription], b"probe");
    let start = std::time::Instant::now();
    for n in 0..COUNT {
        until("room", || match publisher.publish(&n.to_le_bytes()) {
            Ok(()) => true,
            Err(PublishError::Full) => false,
            Err(error) => panic!("{error}"),
        });
    }
    println!("published in {:?}", start.elapsed());
    assert!(numbers(&subscription, COUNT).into_iter().eq(0..COUNT));
}

/// As many bytes as DDS has room for at once, one burst after the other, beside threads that keep Zenoh's from a processor.
#[test]
fn a_burst_waits_for_the_links_thread() {
    const COUNT: u64 = 50;
    let a = Host::first(99, 99);
    let b = Host::beside(&a, 100);
    let qos = Qos::keep_last(COUNT as usize);
    let publisher = a.publisher("/nested", &string_type(), qos);
    let subscription = b.subscription("/nested", &string_type(), qos);
    connect(&publisher, &[&subscription], b"probe");
    let has_ended = AtomicBool::new(false);
    let bursts = || {
        for burst in 0..100 {
            for n in 0..COUNT {
                let mut body = vec![0; 6000 + (n as usize * 397) % 9200];
                body[..8].copy_from_slice(&(burst * COUNT + n).to_le_bytes());
                publisher.publish(&body).unwrap();
            }
            let first = |_| u64::from_le_bytes(take(&subscription).body()[..8].try_into().unwrap());
            assert!((0..COUNT).map(first).eq(burst * COUNT..(burst + 1) * COUNT), "burst {burst}");
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..4 * std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while !has_ended.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(bursts));
        has_ended.store(true, Ordering::Relaxed);
        outcome.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
    });
}

/// More than a subscription may hold at once.
#[test]
fn a_burst_of_large_samples_arrives_though_its_publisher_ends() {
    const COUNT: u64 = 20;
    let a = Host::first(61, 61);
    let b = Host::beside(&a, 128);
    let qos = Qos::keep_last(COUNT as usize);
    let subscription = b.subscription("/camera", &image_type(), qos);
    let mut image = vec![0; 1 << 20];
    for round in 0..10 {
        // Its process ends, too.
        let ending = Participant::new(61).unwrap();
        let publisher =
            ending.create_raw_publisher("/camera", &image_type(), qos, Limits::default()).unwrap();
        connect(&publisher, &[&subscription], b"probe");
        for n in 0..COUNT {
            image[..8].copy_from_slice(&n.to_le_bytes());
            publisher.publish(&image).unwrap();
        }
        drop((publisher, ending));
        let first = |_| u64::from_le_bytes(take(&subscription).body()[..8].try_into().unwrap());
        assert!((0..COUNT).map(first).eq(0..COUNT), "round {round}");
        let lost = |host, direction| stats(host, "/camera", direction).map_or(0, |stats| stats.reading.lost);
        assert_eq!((lost(&a, Direction::Out), lost(&b, Direction::In)), (0, 0), "round {round}");
    }
    let is_announced = || b.participant.graph().unwrap().endpoints.iter().any(|end| end.is_remote);
    until("the publishers' ends", || !is_announced());
}

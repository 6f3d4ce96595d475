// SPDX-License-Identifier: MIT OR Apache-2.0
//! Quality of service over the network: publishers of another host come, die and are in time, or are not, for who watches here.

mod support;

use std::process::{Command, Stdio};
use std::time::Duration;
use support::{Host, connect, string_type, until};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{Limits, LivelinessChanged, Participant, Qos};

#[test]
fn publishers_of_another_host_are_watched_one_by_one() {
    let a = Host::first(79, 79);
    let b = Host::beside(&a, 80);
    let requested = Qos { deadline: Some(Duration::from_millis(100)), ..Qos::keep_last(10) };
    let subscription = b.subscription("/chatter", &string_type(), requested);
    let events = b.participant.claim_slot().unwrap();
    let mut monitor = subscription.monitor(&events);
    let [first, second] = [(); 2].map(|()| a.publisher("/chatter", &string_type(), Qos::keep_last(10)));
    let mut matched = 0;
    let mut last = LivelinessChanged::default();
    let mut look = |alive: u64| {
        let changes = monitor.changes(monotonic_ns());
        if let Some(now) = changes.matched {
            matched = now.current_count;
        }
        last = changes.liveliness.unwrap_or(last);
        (last.alive_count == alive).then_some((matched, last))
    };
    let (count, _) = support::wait("both publishers", || look(2));
    assert_eq!(count, 2);

    // The deadline is the subscription's: a message of either of them keeps it.
    let (activity, _) = subscription.monitor(&events).deadline().unwrap();
    for publisher in [&first, &second] {
        connect(publisher, &[&subscription], b"probe");
        let (before, doorbell) = (monotonic_ns(), b.participant.doorbell());
        publisher.publish(b"in time").unwrap();
        until("a sign of life", || doorbell.activity_ns(activity) > before);
    }

    drop(second);
    let (count, changed) = support::wait("the end of one", || look(1));
    assert_eq!((count, changed.alive_count_change, changed.not_alive_count), (1, -1, 0), "it ended");
    drop(a);
    let (count, changed) = support::wait("the end of the other host", || look(0));
    assert_eq!((count, changed.alive_count_change, changed.not_alive_count), (0, -1, 1), "nobody knows");
    drop(first);
}

/// What a publisher of another process does until it is told to go.
const CHILD: &str = "TAUT_TEST_CHILD";

#[test]
fn a_publisher_of_a_process_of_its_own() {
    let Ok(domain) = std::env::var(CHILD) else { return };
    support::scope();
    let participant = Participant::new(domain.parse().unwrap()).unwrap();
    let (qos, limits) = (Qos::keep_last(10), Limits::default());
    let publisher = participant.create_raw_publisher("/chatter", &string_type(), qos, limits).unwrap();
    let _ = std::io::stdin().read_line(&mut String::new());
    drop(publisher);
}

/// A process ends, and one is killed: of the one the other host hears that its publisher has ended, of the other one that it died.
#[test]
fn on_another_host_an_end_is_told_from_a_death() {
    let a = Host::first(111, 111);
    let b = Host::beside(&a, 112);
    let subscription = b.subscription("/chatter", &string_type(), Qos::keep_last(10));
    let events = b.participant.claim_slot().unwrap();
    let mut monitor = subscription.monitor(&events);
    let mut last = LivelinessChanged::default();
    let mut look = |alive: u64| {
        last = monitor.changes(monotonic_ns()).liveliness.unwrap_or(last);
        (last.alive_count == alive).then_some((last.alive_count_change, last.not_alive_count))
    };
    for is_killed in [false, true, false] {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["a_publisher_of_a_process_of_its_own", "--exact"])
            .env(CHILD, "111")
            .env("TAUT_SCOPE", support::scope())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        support::wait("its publisher", || look(1));
        if is_killed {
            child.kill().unwrap();
        }
        drop(child.stdin.take());
        child.wait().unwrap();
        let (change, not_alive) = support::wait("its end", || look(0));
        assert_eq!((change, not_alive), (-1, u64::from(is_killed)));
    }
}

#[test]
fn with_the_gateway_go_the_publishers_of_other_hosts() {
    let a = Host::first(83, 83);
    let mut b = Host::beside(&a, 144);
    let subscription = b.subscription("/chatter", &string_type(), Qos::keep_last(10));
    let events = b.participant.claim_slot().unwrap();
    let mut monitor = subscription.monitor(&events);
    let mut matched = 0;
    let mut look = |count: u64| {
        matched = monitor.changes(monotonic_ns()).matched.map_or(matched, |now| now.current_count);
        matched == count
    };
    let _publisher = a.publisher("/chatter", &string_type(), Qos::keep_last(10));
    until("the publisher", || look(1));
    drop(b.gateway.take());
    until("its end", || look(0));
}

#[test]
fn what_is_older_than_its_lifespan_is_not_delivered() {
    let a = Host::first(81, 81);
    let b = Host::beside(&a, 82);
    let lifespan_ns = 200_000_000;
    let offered = Qos { lifespan: Some(Duration::from_nanos(lifespan_ns)), ..Qos::keep_last(10) };
    let subscription = b.subscription("/chatter", &string_type(), Qos::keep_last(10));
    let publisher = a.publisher("/chatter", &string_type(), offered);
    // What comes soon enough is delivered.
    connect(&publisher, &[&subscription], b"probe");
    let expired = || subscription.counters().expired();
    let before = expired();
    until("one that was too old when it was taken", || {
        publisher.publish(b"stale").unwrap();
        sleep_until_monotonic(monotonic_ns() + lifespan_ns);
        assert!(subscription.try_take().unwrap().is_none());
        expired() > before
    });
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishers that end early: what they sent is received or counted, never silently gone.

mod support;

use std::time::{Duration, Instant};
use support::{
    Count, Part, claimed, clean, domain, publisher, say, subscription, take_all, wait_for, wait_for_the_end,
};
use tautline_transport::{Participant, Publisher, Qos, Subscription};

const DOMAIN: u32 = 192;
const DOMAIN_OF_STOPPED: u32 = 130;
const STOPPED: &str = "/ended/stopped";
/// To the one that was stopped.
const SENT: u64 = 62;

/// Both ends of a topic; they keep their participant.
fn ends(topic: &str, qos: Qos) -> (Subscription<Count>, Publisher<Count>) {
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    (subscription(&participant, topic, qos), publisher(&participant, topic, qos))
}

fn publish(publisher: &Publisher<Count>, numbers: std::ops::RangeInclusive<u64>) {
    numbers.for_each(|n| publisher.publish(&Count { n }).unwrap());
}

#[test]
fn what_was_sent_before_the_first_take_by_one_that_has_gone_is_counted() {
    let (subscription, publisher) = ends("/ended/first", Qos::default());
    publish(&publisher, 1..=3);
    drop(publisher);
    let received = take_all(&subscription).len() as u64;
    let counters = subscription.counters();
    assert_eq!(received + counters.lost(), 3, "received {received}, lost {}", counters.lost());
    assert_eq!(take_all(&subscription).len(), 0);
    assert_eq!(received + counters.lost(), 3, "counted once");
}

#[test]
fn what_is_queued_when_it_ends_is_received() {
    let (subscription, publisher) = ends("/ended/queued", Qos::default());
    assert_eq!(take_all(&subscription), [0_u64; 0], "connects");
    publish(&publisher, 1..=3);
    drop(publisher);
    assert_eq!(take_all(&subscription), [1, 2, 3]);
    assert_eq!(subscription.counters().lost(), 0);
}

#[test]
fn what_it_overwrote_before_it_ended_is_counted() {
    let (subscription, publisher) = ends("/ended/overwritten", Qos::keep_last(2));
    assert_eq!(take_all(&subscription), [0_u64; 0]);
    publish(&publisher, 1..=5);
    drop(publisher);
    assert_eq!(take_all(&subscription), [4, 5]);
    assert_eq!(subscription.counters().lost(), 3);
}

#[test]
fn two_hundred_publishers_come_and_go() {
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let topic = "/ended/many";
    let subscription = subscription(&participant, topic, Qos::default());
    let (mut received, rounds) = (0, 200);
    for round in 0..rounds {
        let publisher = publisher(&participant, topic, Qos::default());
        if round % 2 == 0 {
            received += take_all(&subscription).len() as u64;
        }
        publish(&publisher, 1..=2);
        drop(publisher);
        received += take_all(&subscription).len() as u64;
        assert_eq!(received + subscription.counters().lost(), 2 * (round + 1), "round {round}");
    }
}

/// The child subscribes, is stopped while a publisher comes and goes, and goes on.
#[test]
fn child_main() {
    let Some((_, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    let subscription = subscription(&participant, STOPPED, Qos::default());
    say("ready");
    let mut taken = Vec::new();
    // Messages of different publishers have no order: the last one sent may come before others.
    wait_for("all that was sent", || {
        taken.extend(take_all(&subscription));
        taken.len() as u64 + subscription.counters().lost() >= SENT
    });
    taken.sort_unstable();
    say(&format!("{taken:?}, {} lost", subscription.counters().lost()));
    drop(subscription);
    wait_for_the_end();
}

/// Publishers that came and went before a subscription's process looked: one, so many that the record is written anew meanwhile, and
/// one whose participant has ended as well.
#[test]
fn what_was_sent_by_one_that_was_never_seen_is_received() {
    let domain = domain(DOMAIN_OF_STOPPED);
    clean(domain);
    let participant = Participant::new(domain).unwrap();
    let create = |participant: &Participant| publisher(participant, STOPPED, Qos::default());
    let mut part = Part::start("stopped", domain);
    part.hear();
    let before = claimed(domain);
    part.stop();
    let other = Participant::new(domain).unwrap();
    publish(&create(&other), 0..=0);
    drop(other);
    // Much happens before the one that was stopped goes on: the warden waits for it.
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(300) {
        drop(publisher(&participant, "/ended/elsewhere", Qos::default()));
    }
    for n in 1..=60 {
        let publisher = create(&participant);
        publish(&publisher, n..=n);
    }
    let last = create(&participant);
    part.go_on();
    publish(&last, 61..=61);
    let all: Vec<u64> = (0..SENT).collect();
    assert_eq!(part.hear(), format!("{all:?}, 0 lost"));
    // Nothing is kept for it any more.
    drop(last);
    wait_for("the memory to be given back", || claimed(domain) <= before + (64 << 10));
    assert!(part.end().success());
    drop(participant);
    clean(domain);
}

#[test]
fn one_that_lives_on_is_remembered_however_many_come_and_go() {
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let topic = "/ended/remembered";
    let subscription = subscription(&participant, topic, Qos::default());
    let create = || publisher(&participant, topic, Qos::default());
    let lives = create();
    for n in 1..=100 {
        publish(&lives, n..=n);
        assert_eq!(take_all(&subscription), [n]);
    }
    for n in 0..130 {
        let other = create();
        assert_eq!(take_all(&subscription), [0_u64; 0]);
        publish(&other, n..=n);
        assert_eq!(take_all(&subscription), [n]);
        drop(other);
        assert_eq!(take_all(&subscription), [0_u64; 0]);
    }
    publish(&lives, 101..=101);
    assert_eq!(take_all(&subscription), [101]);
    assert_eq!(subscription.counters().lost(), 0);
}

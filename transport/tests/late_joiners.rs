// SPDX-License-Identifier: MIT OR Apache-2.0
//! Transient local: a late joiner gets the last samples, in order, once, also from a publisher that stays silent.

mod support;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use support::{Count, Part, Stop, domain, say, take_all, wait_for, wait_for_the_end};
use tautline_transport::{Limits, Participant, PublishError, Publisher, Qos, Subscription, TopicType};

fn kept(depth: usize) -> Qos {
    Qos::keep_last(depth).transient_local()
}

fn publisher(participant: &Participant, depth: usize) -> Publisher<Count> {
    support::publisher(participant, "/late", kept(depth))
}

fn subscription(participant: &Participant, depth: usize) -> Subscription<Count> {
    support::subscription(participant, "/late", kept(depth))
}

fn publish(publisher: &Publisher<Count>, numbers: impl IntoIterator<Item = u64>) {
    for n in numbers {
        publisher.publish(&Count { n }).unwrap();
    }
}

fn take_until(subscription: &Subscription<Count>, last: u64) -> Vec<u64> {
    let mut taken = Vec::new();
    wait_for(&format!("message {last}"), || {
        taken.extend(take_all(subscription));
        taken.last() == Some(&last)
    });
    taken
}

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    match part.as_str() {
        "publisher" => {
            let publisher = publisher(&participant, 3);
            publish(&publisher, 1..=10);
            say("published");
            wait_for_the_end();
        }
        "joiner" => {
            let subscription = subscription(&participant, 3);
            say(&format!("{:?}", take_until(&subscription, 10)));
        }
        other => panic!("no part {other}"),
    }
}

#[test]
fn from_a_silent_publisher() {
    let participant = Participant::new(domain(150)).unwrap();
    let publisher = publisher(&participant, 3);
    publish(&publisher, 1..=10);
    // Several, one after the other: serving one does not spend the history.
    for _ in 0..3 {
        let joiner = subscription(&participant, 3);
        assert_eq!(take_until(&joiner, 10), [8, 9, 10]);
        assert_eq!((joiner.counters().received(), joiner.counters().lost()), (3, 0));
    }
    publish(&publisher, [11]);
    assert_eq!(take_until(&subscription(&participant, 3), 11), [9, 10, 11]);
    let short = subscription(&participant, 2);
    assert_eq!(take_until(&short, 11), [10, 11], "the joiner's own depth");
    let deep = subscription(&participant, 100);
    assert_eq!(take_until(&deep, 11), [9, 10, 11], "no more than the publisher keeps");
}

#[test]
fn nothing_comes_twice_when_the_publisher_goes_on() {
    let participant = Participant::new(domain(151)).unwrap();
    let publisher = publisher(&participant, 5);
    let mut next = 1;
    for _ in 0..20 {
        publish(&publisher, next..next + 7);
        let joiner = subscription(&participant, 5);
        publish(&publisher, next + 7..next + 10);
        next += 10;
        let taken = take_until(&joiner, next - 1);
        // Of those that were the last 5 when it joined, 3 have made room for the last 3.
        assert_eq!(taken, (next - 5..next).collect::<Vec<_>>());
        assert_eq!((joiner.counters().received(), joiner.counters().lost()), (5, 3));
    }
}

#[test]
fn while_the_publisher_runs() {
    let participant = Participant::new(domain(152)).unwrap();
    let (stop, begun) = (AtomicBool::new(false), AtomicU64::new(0));
    std::thread::scope(|scope| {
        let publisher = publisher(&participant, 4);
        let _stop = Stop(&stop);
        let (stop, begun) = (&stop, &begun);
        scope.spawn(move || {
            let mut n = 0;
            while !stop.load(Ordering::Relaxed) {
                n += 1;
                begun.store(n, Ordering::SeqCst);
                publish(&publisher, [n]);
                std::thread::sleep(std::time::Duration::from_micros(200));
            }
        });
        for _ in 0..10 {
            let before = begun.load(Ordering::SeqCst);
            let joiner = subscription(&participant, 4);
            let after = begun.load(Ordering::SeqCst);
            let mut taken: Vec<u64> = Vec::new();
            wait_for("100 messages", || {
                taken.extend(take_all(&joiner));
                taken.len() >= 100
            });
            assert!(taken.is_sorted_by(|a, b| a < b), "in order, once: {taken:?}");
            // What is missing was counted, also of the history, of which some may be overwritten before the first take.
            let first = taken.last().unwrap() + 1 - taken.len() as u64 - joiner.counters().lost();
            let history = before.saturating_sub(4).max(1)..=after.max(1);
            assert!(history.contains(&first), "{first} of {history:?}");
        }
    });
}

#[test]
fn a_publisher_that_is_faster_than_its_history_is_handed_over_keeps_nobody_waiting() {
    const MESSAGE_BYTES: usize = 8 << 20;
    let participant = Participant::new(domain(159)).unwrap();
    let text = TopicType::new("test_msgs/msg/Text");
    let limits = Limits { held: 1, loans: 1, message_bytes: MESSAGE_BYTES, ..Limits::default() };
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let publisher = participant.create_raw_publisher("/fast", &text, kept(4), limits).unwrap();
        let _stop = Stop(&stop);
        let stop = &stop;
        scope.spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                publisher.loan(MESSAGE_BYTES).unwrap().publish().unwrap();
            }
        });
        // What is kept is overwritten while it is handed over.
        for _ in 0..3 {
            let joiner = participant.create_raw_subscription("/fast", &text, kept(4), limits).unwrap();
            wait_for("a message", || joiner.try_take().unwrap().is_some());
        }
    });
}

#[test]
fn from_two_publishers() {
    let participant = Participant::new(domain(153)).unwrap();
    let publishers = [publisher(&participant, 3), publisher(&participant, 3)];
    publish(&publishers[0], 1..=5);
    publish(&publishers[1], 101..=105);
    let joiner = subscription(&participant, 3);
    let mut taken = Vec::new();
    wait_for("both histories", || {
        taken.extend(take_all(&joiner));
        taken.len() >= 6
    });
    publish(&publishers[0], [6]);
    publish(&publishers[1], [106]);
    taken.extend(take_all(&joiner));
    let of =
        |range: std::ops::Range<u64>| taken.iter().copied().filter(|n| range.contains(n)).collect::<Vec<_>>();
    assert_eq!(of(0..100), [3, 4, 5, 6]);
    assert_eq!(of(100..200), [103, 104, 105, 106]);
    assert_eq!(taken.len(), 8);
}

#[test]
fn in_another_process() {
    let mut silent = Part::start("publisher", 154);
    assert_eq!(silent.hear(), "published");
    let mut joiner = Part::start("joiner", 154);
    assert_eq!(joiner.hear(), "[8, 9, 10]");
    assert!(joiner.end().success());
    assert!(silent.end().success());
}

#[test]
fn a_history_is_held_in_place_as_well() {
    let participant = Participant::new(domain(155)).unwrap();
    let limits = Limits { held: 2, ..Limits::default() };
    let publisher = participant.create_publisher::<Count>("/late", kept(4), limits).unwrap();
    publish(&publisher, 1..=4);
    let joiner = participant.create_subscription::<Count>("/late", kept(4), limits).unwrap();
    let mut held = Vec::new();
    wait_for("two samples", || {
        held.extend(joiner.try_take().unwrap());
        held.len() == 2
    });
    assert_eq!(joiner.try_take().err(), Some(tautline_transport::TakeError::TooManyHeld));
    let waker = futures::task::noop_waker();
    assert!(joiner.poll_take(&mut std::task::Context::from_waker(&waker)).is_pending(), "it must not spin");
    assert_eq!(held.iter().map(|sample| sample.n).collect::<Vec<_>>(), [1, 2]);
    held.clear();
    assert_eq!(take_until(&joiner, 4), [3, 4]);
}

#[test]
fn volatile_ends_get_nothing_old() {
    let participant = Participant::new(domain(156)).unwrap();
    let keeper = publisher(&participant, 3);
    let volatile = support::publisher(&participant, "/late", Qos::keep_last(3));
    publish(&volatile, 1..=3);
    publish(&keeper, 101..=103);
    let plain = support::subscription(&participant, "/late", Qos::keep_last(3));
    let joiner = subscription(&participant, 3);
    assert_eq!(take_until(&joiner, 103), [101, 102, 103]);
    publish(&volatile, [4]);
    // What asks for a history gets nothing from who keeps none, as in ROS 2.
    assert_eq!((take_all(&plain), take_all(&joiner)), (vec![4], vec![]));
}

#[test]
fn what_came_with_the_history_makes_room_when_it_is_taken() {
    let participant = Participant::new(domain(157)).unwrap();
    let qos = Qos::keep_all(2).transient_local();
    for round in 0..20 {
        let topic = format!("/room{round}");
        let publisher = participant.create_publisher::<Count>(&topic, qos, Limits::default()).unwrap();
        publish(&publisher, 1..=2);
        let joiner = participant.create_subscription::<Count>(&topic, qos, Limits::default()).unwrap();
        assert_eq!(publisher.publish(&Count { n: 3 }), Err(PublishError::Full), "both wait there");
        assert_eq!(take_until(&joiner, 2), [1, 2]);
        publish(&publisher, 3..=4);
        assert_eq!(publisher.publish(&Count { n: 5 }), Err(PublishError::Full));
        assert_eq!(take_all(&joiner), [3, 4]);
    }
}

#[test]
fn a_history_is_as_long_as_its_publisher_keeps_it_whatever_others_ask_for() {
    let participant = Participant::new(domain(158)).unwrap();
    let (deep, small) = (Qos::keep_last(1000), Limits { held: 1, loans: 1, ..Limits::default() });
    let _first = participant.create_subscription::<Count>("/late", deep, Limits::default()).unwrap();
    let create = || participant.create_publisher::<Count>("/late", kept(10), small).unwrap();
    let (one, other) = (create(), create());
    publish(&one, 1..=1);
    publish(&other, 2..=2);
    for depth in [800, 1, 10] {
        let joiner = participant.create_subscription::<Count>("/late", kept(depth), small).unwrap();
        let mut taken = Vec::new();
        wait_for("both histories", || {
            taken.extend(take_all(&joiner));
            taken.len() == 2
        });
    }
}

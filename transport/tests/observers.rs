// SPDX-License-Identifier: MIT OR Apache-2.0
//! Who looks on: what a tool sees of a domain, and what nobody sees of the tool.

mod support;

use std::collections::BTreeMap;
use support::{Count, Part, clean, domain, folder, publisher, say, subscription, wait_for, wait_for_the_end};
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{
    EndpointKind, Gid, Limits, Participant, Qos, RawSubscription, Sent, TakeError, TopicEndpoint, TopicType,
    Visitor,
};

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    assert_eq!(part, "publisher");
    let participant = Participant::new(domain).unwrap();
    let publisher = publisher(&participant, "/left", Qos::default());
    publisher.publish(&Count { n: 1 }).unwrap();
    say("ready");
    wait_for_the_end();
}

fn observer(participant: &Participant, topic: &str, depth: usize) -> RawSubscription {
    participant.create_observer(topic, &TopicType::of::<Count>(), depth, Limits::default()).unwrap()
}

fn take_all(observer: &RawSubscription) -> Vec<u64> {
    let number = |body: &[u8]| u64::from_le_bytes(body[..8].try_into().unwrap());
    std::iter::from_fn(|| observer.try_take().unwrap()).map(|sample| number(sample.body())).collect()
}

/// In the process of the publishers, and in another participant as a tool has one.
#[test]
fn an_observer_gets_everything_and_is_seen_by_nobody() {
    let robot = Participant::new(domain(231)).unwrap();
    let tool = Participant::new(231).unwrap();
    for looker in [&robot, &tool] {
        let strict = Qos { deadline: Some(std::time::Duration::from_secs(3600)), ..Qos::keep_all(2) };
        let latched = publisher(&robot, "/seen", Qos::keep_last(2).transient_local());
        let best_effort = publisher(&robot, "/seen", Qos::default().best_effort());
        let strict = publisher(&robot, "/seen", strict);
        (1..=3).for_each(|n| latched.publish(&Count { n }).unwrap());
        let slot = robot.claim_slot().unwrap();
        let mut monitor = latched.as_ref().monitor(&slot);
        let epoch = (robot.graph_epoch(), robot.graph().unwrap());
        let observer = observer(looker, "/seen", 4);
        assert_ne!(robot.graph_epoch(), epoch.0, "otherwise the next line says nothing");
        assert_eq!(robot.graph().unwrap().endpoints, epoch.1.endpoints);
        // What is kept, and what comes.
        // All three are connected: a publisher of another participant is by that one's janitor.
        wait_for("what is kept", || observer.publisher_count() == 3 && observer.has_samples());
        assert_eq!(take_all(&observer), [2, 3]);
        for publisher in [&latched, &best_effort, &strict] {
            publisher.publish(&Count { n: 4 }).unwrap();
        }
        assert_eq!(take_all(&observer), [4; 3]);
        for publisher in [&latched, &best_effort, &strict] {
            assert_eq!(publisher.subscription_count(), 0);
        }
        assert_eq!((monitor.changes().matched, monitor.changes().incompatible_qos), (None, None));
        // Nobody waits for it: it loses the oldest, and counts them.
        for n in 10..20 {
            strict.publish(&Count { n }).unwrap();
        }
        assert_eq!(take_all(&observer), [16, 17, 18, 19]);
        assert_eq!(observer.counters().lost(), 6);
        drop(observer);
        assert_eq!(monitor.changes().matched, None);
    }
}

#[test]
fn an_observer_is_not_rung() {
    let participant = Participant::new(domain(231)).unwrap();
    let seat = participant.doorbell().claim_sampler().unwrap();
    let publisher = publisher(&participant, "/still", Qos::default());
    let observer = observer(&participant, "/still", 4);
    seat.drain(|_| {});
    publisher.publish(&Count { n: 1 }).unwrap();
    assert_eq!(seat.drain(|_| {}), 0, "nobody is woken");
    assert_eq!(take_all(&observer), [1]);
    publisher.publish(&Count { n: 2 }).unwrap();
    assert_eq!(seat.drain(|_| {}), 0, "also not after it took");
}

/// An observer that holds all that it may holds no publisher up, and a publisher without room for more loans still has its own.
#[test]
fn an_observer_that_holds_on_costs_no_loan() {
    let participant = Participant::new(domain(231)).unwrap();
    let limits = Limits { held: 2, loans: 1, ..Limits::default() };
    let publisher = participant.create_publisher::<Count>("/held", Qos::keep_last(1), limits).unwrap();
    let observer = participant.create_observer("/held", &TopicType::of::<Count>(), 3, limits).unwrap();
    let mut held = Vec::new();
    for n in 0..20 {
        publisher.publish(&Count { n }).unwrap();
        if held.len() < 2 {
            held.extend(observer.try_take().unwrap());
        }
    }
    assert_eq!(observer.try_take().err(), Some(TakeError::TooManyHeld));
    assert_eq!(publisher.as_ref().counters().growths(), 0);
}

fn of_topic(visitor: &mut Visitor, topic: &str) -> BTreeMap<Gid, TopicEndpoint> {
    let graph = visitor.graph().unwrap();
    let ends = graph.endpoints.iter().filter(|end| end.topic == topic);
    ends.map(|end| (end.gid, TopicEndpoint::clone(end))).collect()
}

#[test]
fn what_publishers_send_can_be_read_without_a_subscription() {
    let mut visitor = Visitor::new(domain(230)).unwrap();
    assert!(visitor.graph().unwrap().endpoints.is_empty(), "the domain is not there yet");
    let participant = Participant::new(230).unwrap();
    let typed = publisher(&participant, "/counted", Qos::default());
    let bytes = participant
        .create_raw_publisher("/counted", &TopicType::new("demo/msg/Text"), Qos::default(), Limits::default())
        .unwrap();
    let subscription = subscription(&participant, "/counted", Qos::default());
    let ends = of_topic(&mut visitor, "/counted");
    assert_eq!(ends.len(), 3);
    let mut sent = |gid| visitor.sent(&ends[&gid]).unwrap();
    assert_eq!(sent(subscription.as_ref().gid()), None, "it sends nothing");
    assert_eq!(
        (sent(typed.as_ref().gid()), sent(bytes.gid())),
        (Some(Sent::default()), Some(Sent::default()))
    );
    let before_ns = monotonic_ns();
    for n in 0..1000 {
        typed.publish(&Count { n }).unwrap();
        bytes.publish(&[7; 13]).unwrap();
    }
    let after_ns = monotonic_ns();
    let (of_typed, of_bytes) = (sent(typed.as_ref().gid()).unwrap(), sent(bytes.gid()).unwrap());
    assert_eq!((of_typed.messages, of_typed.bytes), (1000, 8000));
    assert_eq!((of_bytes.messages, of_bytes.bytes), (1000, 13_000));
    assert!(before_ns <= of_typed.last_ns && of_typed.last_ns <= of_bytes.last_ns);
    assert!(of_bytes.last_ns <= after_ns);
    let gid = typed.as_ref().gid();
    let lost = subscription.as_ref().gid();
    let kept = Qos::default().depth as u64;
    assert_eq!(
        visitor.overwritten(&ends[&gid]).unwrap(),
        [(lost, 1000 - kept)],
        "each publisher's by itself"
    );
    let observer = observer(&participant, "/counted", 10);
    let taken = std::iter::from_fn(|| subscription.try_take().unwrap()).count() as u64;
    typed.publish(&Count { n: 0 }).unwrap();
    let now: BTreeMap<_, _> = visitor.overwritten(&ends[&gid]).unwrap().into_iter().collect();
    assert_eq!((now.len(), now[&lost], now[&observer.gid()]), (2, 1000 - kept, 0));
    assert_eq!((taken, subscription.as_ref().counters().lost()), (kept, 1000 - kept), "as it counts itself");
    assert_eq!(visitor.overwritten(&ends[&lost]).unwrap(), [], "it sends nothing");
    drop(typed);
    let left = of_topic(&mut visitor, "/counted");
    assert!(left.len() == 2 && !left.contains_key(&gid));
    assert_eq!(visitor.sent(&ends[&gid]).unwrap(), None);
}

/// Also if its record was rewritten while it ended, and is gone with its file when somebody looks.
#[test]
fn a_normal_end_is_no_death_however_long_the_record_is() {
    let domain = domain(53);
    clean(domain);
    let mut visitor = Visitor::new(domain).unwrap();
    for count in 1..=40 {
        let participant = Participant::new(domain).unwrap();
        let node = participant.create_node("ends", "/").unwrap();
        let publishers: Vec<_> =
            (0..count).map(|n| publisher(&participant, &format!("/of_many/{n}"), Qos::default())).collect();
        assert_eq!(visitor.graph().unwrap().endpoints.len(), count);
        drop((publishers, node, participant));
        assert_eq!(visitor.graph().unwrap().endpoints.len(), 0);
        assert_eq!(visitor.take_deaths(), [], "{count} publishers");
    }
}

/// Who publishes alone, and is killed: nobody cleans up after it, and it is not there.
#[test]
fn the_dead_are_not_seen_though_nobody_buried_them() {
    let domain = domain(229);
    clean(domain);
    let mut visitor = Visitor::new(domain).unwrap();
    let mut part = Part::start("publisher", domain);
    assert_eq!(part.hear(), "ready");
    let ends = of_topic(&mut visitor, "/left");
    let end = ends.values().find(|end| end.kind == EndpointKind::Publisher).unwrap();
    assert_eq!(visitor.sent(end).unwrap().unwrap().messages, 1);
    let pid = part.pid();
    part.kill();
    wait_for("it to be missed", || of_topic(&mut visitor, "/left").is_empty());
    assert_eq!(visitor.sent(end).unwrap(), None);
    assert_eq!(visitor.take_deaths().iter().map(|death| death.pid).collect::<Vec<_>>(), [pid]);
    // Whoever ends as it should is no death; nor is one again.
    let mut part = Part::start("publisher", domain);
    assert_eq!(part.hear(), "ready");
    wait_for("it to be seen", || !of_topic(&mut visitor, "/left").is_empty());
    assert!(part.end().success());
    wait_for("its end", || of_topic(&mut visitor, "/left").is_empty());
    assert_eq!(visitor.take_deaths(), []);
    drop(visitor);
    // And it leaves nothing behind once somebody comes by.
    drop(Participant::new(domain).unwrap());
    wait_for("the folder to go", || !folder(domain).exists());
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Quality of service: who fits whom, what is too old, who is alive, who has come and gone.

mod support;

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::task::{Context, Poll, Wake, Waker};
use std::time::Duration;
use support::{Count, LIMITS, Part, clean, domain, say, take_all, wait_for, wait_for_the_end};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_transport::{
    EndpointKind, Gid, IncompatibleQos, Liveliness, LivelinessChanged, Matched, MatchedCount, MessageInfo,
    MessageLost, NodeName, Origin, Participant, Publisher, Qos, QosPolicyKind, RemoteGraph, Subscription,
    TopicEndpoint, TopicType,
};

const HOUR: Option<Duration> = Some(Duration::from_secs(3600));

/// How often a task was woken.
#[derive(Default)]
struct Woken(AtomicU32);

impl Wake for Woken {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }
}

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    assert_eq!(part, "publisher");
    let participant = Participant::new(domain).unwrap();
    let _publisher = publisher(&participant, "/killed", Qos::default());
    say("ready");
    wait_for_the_end();
}

fn publisher(participant: &Participant, topic: &str, qos: Qos) -> Publisher<Count> {
    participant.create_publisher(topic, qos, LIMITS).unwrap()
}

fn subscription(participant: &Participant, topic: &str, qos: Qos) -> Subscription<Count> {
    participant.create_subscription(topic, qos, LIMITS).unwrap()
}

#[test]
fn who_does_not_fit_gets_nothing_whoever_came_first() {
    let participant = Participant::new(domain(113)).unwrap();
    let reliable = subscription(&participant, "/mixed", Qos::default());
    let any = subscription(&participant, "/mixed", Qos::default().best_effort());
    let late_first = subscription(&participant, "/mixed", Qos::default().transient_local());
    let sensor = publisher(&participant, "/mixed", Qos::default().best_effort());
    let latched = publisher(&participant, "/mixed", Qos::default().transient_local());
    let late = subscription(&participant, "/mixed", Qos::default().transient_local());
    assert_eq!((sensor.subscription_count(), latched.subscription_count()), (1, 4));
    let counts = [&reliable, &any, &late_first, &late].map(Subscription::publisher_count);
    assert_eq!(counts, [1, 2, 1, 1]);
    sensor.publish(&Count { n: 1 }).unwrap();
    latched.publish(&Count { n: 2 }).unwrap();
    sensor.publish(&Count { n: 3 }).unwrap();
    assert_eq!(take_all(&reliable), [2]);
    assert_eq!(take_all(&late_first), [2]);
    let mut all = take_all(&any);
    all.sort();
    assert_eq!(all, [1, 2, 3]);
    wait_for("the history", || take_all(&late) == [2]);
    assert_eq!([&reliable, &any, &late].map(|s| s.counters().lost()), [0; 3]);
}

#[test]
fn a_full_queue_that_does_not_fit_holds_nobody_up() {
    let participant = Participant::new(domain(113)).unwrap();
    let _full = subscription(&participant, "/apart", Qos::keep_all(2));
    let publisher = publisher(&participant, "/apart", Qos::keep_all(2).best_effort());
    for n in 0..10 {
        publisher.publish(&Count { n }).unwrap();
    }
}

#[test]
fn relays_fit_everybody() {
    let participant = Participant::new(domain(113)).unwrap();
    let topic_type = TopicType::of::<Count>();
    let [sensor, plain] =
        [Qos::default().best_effort(), Qos::default()].map(|qos| publisher(&participant, "/relayed", qos));
    let relay = participant.create_relay_subscription(
        "/relayed",
        &topic_type,
        Qos::default().transient_local(),
        LIMITS,
    );
    let relay = relay.unwrap();
    let strict = Qos { deadline: HOUR, ..Qos::default() };
    let strict = subscription(&participant, "/relayed", strict);
    let out = participant
        .create_relay_publisher("/relayed", &topic_type, Qos::default().best_effort(), LIMITS)
        .unwrap();
    sensor.publish(&Count { n: 1 }).unwrap();
    plain.publish(&Count { n: 2 }).unwrap();
    out.publish(&3u64.to_le_bytes()).unwrap();
    assert_eq!(std::iter::from_fn(|| relay.try_take().unwrap()).count(), 3);
    assert_eq!(take_all(&strict), [3]);
}

#[test]
fn all_of_it_is_listed() {
    let [one, other] = [(); 2].map(|()| Participant::new(domain(113)).unwrap());
    let times = |n| Some(Duration::new(n, 123_456_789));
    let qos = Qos {
        deadline: times(1),
        lifespan: times(2),
        liveliness: Liveliness::ManualByTopic,
        liveliness_lease_duration: times(3),
        ..Qos::keep_all(10).best_effort().transient_local()
    };
    let _ends = (publisher(&one, "/listed", qos), subscription(&one, "/listed", qos));
    let topics = other.topics().unwrap();
    let topic = topics.iter().find(|topic| topic.name == "/listed").unwrap();
    let listed = |ends: &[Arc<TopicEndpoint>]| ends.iter().map(|end| end.qos).collect::<Vec<_>>();
    assert_eq!((listed(&topic.publishers), listed(&topic.subscriptions)), (vec![qos], vec![qos]));
}

#[test]
fn what_is_too_old_is_not_delivered_but_counted() {
    let participant = Participant::new(domain(113)).unwrap();
    let long = publisher(&participant, "/old", Qos { lifespan: HOUR, ..Qos::default() });
    let short = Qos { lifespan: Some(Duration::from_nanos(1)), ..Qos::default().transient_local() };
    let short = publisher(&participant, "/old", short);
    let subscription = subscription(&participant, "/old", Qos::default().transient_local());
    let volatile = self::subscription(&participant, "/old", Qos::default());
    for n in 0..3 {
        long.publish(&Count { n }).unwrap();
        short.publish(&Count { n: 10 + n }).unwrap();
    }
    sleep_until_monotonic(monotonic_ns() + 1);
    assert_eq!(take_all(&volatile), [0, 1, 2]);
    let counters = volatile.counters();
    assert_eq!((counters.received(), counters.expired(), counters.lost()), (3, 3, 0));
    // The late joiner finds them in the history, or live, and once.
    wait_for("what is kept", || {
        assert!(take_all(&subscription).is_empty());
        subscription.counters().expired() == 3
    });
}

#[test]
fn a_take_looks_at_so_many_and_no_more_and_says_when_there_may_be_more() {
    /// Samples that one call looks at.
    const LOOKS: u64 = 16;
    let participant = Participant::new(domain(62)).unwrap();
    let seat = participant.doorbell().claim_sampler().unwrap();
    let publisher = publisher(&participant, "/passed", Qos::default());
    // Too old as soon as it is looked at.
    let publish_short = |n: u64| {
        let mut loan = publisher.as_ref().loan(8).unwrap();
        loan.copy_from_slice(&n.to_le_bytes());
        loan.publish_as_for(MessageInfo::default(), Duration::from_nanos(1)).unwrap();
    };
    let subscription = subscription(&participant, "/passed", Qos::keep_last(100));
    let counters = subscription.counters();
    let is_rung = || seat.drain(|_| {}) > 0;
    // Once more than a call looks at, and one that is not too old behind them.
    let publish = || {
        (0..2 * LOOKS + 1).for_each(publish_short);
        sleep_until_monotonic(monotonic_ns() + 1);
        publisher.publish(&Count { n: 77 }).unwrap();
        assert!(is_rung(), "they were published");
    };
    publish();
    for looked in [LOOKS, 2 * LOOKS] {
        assert!(subscription.try_take().unwrap().is_none());
        assert_eq!(
            (counters.expired(), is_rung()),
            (looked, true),
            "whoever waits for the doorbell comes again"
        );
    }
    assert_eq!(subscription.try_take().unwrap().unwrap().n, 77);
    assert_eq!((counters.expired(), counters.received(), counters.lost()), (2 * LOOKS + 1, 1, 0));

    publish();
    assert!([(), ()].iter().all(|()| subscription.try_take_valid().unwrap().is_none() && is_rung()));
    assert_eq!(subscription.try_take_valid().unwrap().unwrap().n, 77);

    // A task is woken itself, and its thread's other tasks have a turn.
    publish();
    let woken = Arc::new(Woken::default());
    let waker = Waker::from(woken.clone());
    let mut context = Context::from_waker(&waker);
    let times = || woken.0.load(Ordering::Relaxed);
    for polls in 1..=2 {
        assert!(subscription.poll_take(&mut context).is_pending());
        assert_eq!(times(), polls);
    }
    assert!(matches!(subscription.poll_take(&mut context), Poll::Ready(Some(sample)) if sample.n == 77));
    assert!(subscription.poll_take(&mut context).is_pending());
    assert_eq!((times(), counters.lost()), (2, 0), "nothing is behind it");

    // Invalid ones count like those that are too old.
    let raw = participant.create_raw_publisher("/passed", &TopicType::of::<Count>(), Qos::default(), LIMITS);
    let raw = raw.unwrap();
    (0..LOOKS / 2).for_each(publish_short);
    (0..LOOKS).for_each(|_| raw.publish(&[1, 2, 3]).unwrap());
    sleep_until_monotonic(monotonic_ns() + 1);
    let (expired, invalid) = (counters.expired(), counters.invalid());
    let looked = || counters.expired() - expired + counters.invalid() - invalid;
    assert!(subscription.poll_take(&mut context).is_pending());
    assert_eq!((looked(), times()), (LOOKS, 3));
    assert!(subscription.poll_take(&mut context).is_pending());
    assert_eq!((looked(), counters.invalid() - invalid, times()), (LOOKS * 3 / 2, LOOKS, 3));
}

#[test]
fn monitors_tell_of_matches() {
    let participant = Participant::new(domain(113)).unwrap();
    let events = participant.claim_slot().unwrap();
    let publisher = publisher(&participant, "/matches", Qos { deadline: HOUR, ..Qos::default() });
    let mut monitor = publisher.as_ref().monitor(&events);
    assert_eq!(monitor.changes(), Default::default());
    let first = subscription(&participant, "/matches", Qos::default());
    let strict = subscription(
        &participant,
        "/matches",
        Qos { deadline: Some(Duration::from_secs(1)), ..Qos::default() },
    );
    let changes = monitor.changes();
    assert_eq!(
        changes.matched,
        Some(Matched { total_count: 1, total_count_change: 1, current_count: 1, current_count_change: 1 })
    );
    let found =
        IncompatibleQos { total_count: 1, total_count_change: 1, last_policy_kind: QosPolicyKind::Deadline };
    assert_eq!(changes.incompatible_qos, Some(found));
    assert_eq!(monitor.changes(), Default::default(), "once");
    drop((first, strict));
    let gone = Matched { total_count: 1, total_count_change: 0, current_count: 0, current_count_change: -1 };
    assert_eq!(monitor.changes().matched, Some(gone));
    assert!(!monitor.has_ended());
    drop(publisher);
    assert!(monitor.has_ended());

    let subscription = subscription(&participant, "/matches", Qos::default());
    let mut monitor = subscription.as_ref().monitor(&events);
    let one = self::publisher(&participant, "/matches", Qos::default());
    let changes = monitor.changes(monotonic_ns());
    assert_eq!(changes.matched.unwrap().current_count, 1);
    let alive = LivelinessChanged {
        alive_count: 1,
        not_alive_count: 0,
        alive_count_change: 1,
        not_alive_count_change: 0,
    };
    assert_eq!(changes.liveliness, Some(alive));
    drop(one);
    // It said that it went: it did not die.
    let gone = LivelinessChanged { alive_count: 0, alive_count_change: -1, ..alive };
    assert_eq!(monitor.changes(monotonic_ns()).liveliness, Some(gone));
    drop(subscription);
    assert!(monitor.has_ended());
}

#[test]
fn losses_are_told() {
    let participant = Participant::new(domain(113)).unwrap();
    let events = participant.claim_slot().unwrap();
    let subscription = subscription(&participant, "/losses", Qos::keep_last(2));
    let publisher = publisher(&participant, "/losses", Qos::keep_last(1));
    let mut monitor = subscription.as_ref().monitor(&events);
    monitor.changes(0);
    for (round, total) in [(1, 3), (2, 6)] {
        for n in 0..5 {
            publisher.publish(&Count { n }).unwrap();
        }
        assert_eq!(monitor.changes(0).message_lost, None, "round {round}: nobody has looked into the queue");
        assert_eq!(take_all(&subscription), [3, 4]);
        let lost = MessageLost { total_count: total, total_count_change: 3 };
        assert_eq!(monitor.changes(0).message_lost, Some(lost), "round {round}");
    }
}

/// Whoever comes later calls the other's process, though nothing is connected.
#[test]
fn who_was_there_first_is_told_of_what_does_not_fit() {
    let [early, late] = [(); 2].map(|()| Participant::new(domain(113)).unwrap());
    let events = early.claim_slot().unwrap();
    let wanted = Qos::default().transient_local();
    let publisher = publisher(&early, "/offered", Qos::default());
    let mut monitor = publisher.as_ref().monitor(&events);
    assert_eq!(monitor.changes(), Default::default());
    let _strict = subscription(&late, "/offered", wanted);
    let policy = |found: Option<IncompatibleQos>| found.map(|found| found.last_policy_kind);
    wait_for("the subscription", || {
        policy(monitor.changes().incompatible_qos) == Some(QosPolicyKind::Durability)
    });
    let strict = subscription(&early, "/requested", wanted);
    let mut monitor = strict.as_ref().monitor(&events);
    let _loose = self::publisher(&late, "/requested", Qos::default());
    let found =
        |monitor: &mut tautline_transport::SubscriptionMonitor| policy(monitor.changes(0).incompatible_qos);
    wait_for("the publisher", || found(&mut monitor) == Some(QosPolicyKind::Durability));
}

#[test]
fn a_lease_is_kept_by_publishing_or_by_word() {
    let participant = Participant::new(domain(113)).unwrap();
    let events = participant.claim_slot().unwrap();
    let lease = Duration::from_secs(3600);
    let manual = Qos {
        liveliness: Liveliness::ManualByTopic,
        liveliness_lease_duration: Some(lease),
        ..Qos::default()
    };
    let subscription = subscription(&participant, "/lease", manual);
    let publisher = publisher(&participant, "/lease", manual);
    let mut monitor = subscription.as_ref().monitor(&events);
    let lease_ns = lease.as_nanos() as u64;
    let look = |monitor: &mut tautline_transport::SubscriptionMonitor, now_ns: u64| {
        let changes = monitor.changes(now_ns);
        let counts = changes.liveliness.map(|change| (change.alive_count, change.not_alive_count));
        (counts, changes.look_again_ns.unwrap())
    };
    let created_ns = monotonic_ns();
    let (counts, due_ns) = look(&mut monitor, created_ns);
    assert_eq!(counts, Some((1, 0)));
    assert!(due_ns <= created_ns + lease_ns);
    // The time is what the monitor is told.
    assert_eq!(look(&mut monitor, due_ns - 1), (None, due_ns));
    assert_eq!(look(&mut monitor, due_ns), (Some((0, 1)), due_ns + lease_ns));
    assert_eq!(look(&mut monitor, due_ns + 1).0, None, "it stays dead");
    publisher.assert_liveliness();
    let (counts, by_word) = look(&mut monitor, monotonic_ns());
    assert_eq!(counts, Some((1, 0)));
    assert!(by_word > due_ns);
    publisher.publish(&Count { n: 1 }).unwrap();
    assert!(look(&mut monitor, monotonic_ns()).1 > by_word, "publishing is a sign of life");
}

#[test]
fn a_killed_publisher_is_told_from_one_that_went() {
    let participant = Participant::new(domain(114)).unwrap();
    let events = participant.claim_slot().unwrap();
    let subscription = subscription(&participant, "/killed", Qos::default());
    let mut monitor = subscription.as_ref().monitor(&events);
    for cycle in 0..3 {
        let mut part = Part::start("publisher", 114);
        assert_eq!(part.hear(), "ready");
        let look = |monitor: &mut tautline_transport::SubscriptionMonitor| {
            monitor.changes(monotonic_ns()).liveliness
        };
        let mut last = None;
        let mut until = |monitor: &mut _, counts: (u64, u64)| {
            wait_for("the liveliness", || {
                let change = look(monitor);
                last = change.or(last);
                last.is_some_and(|last: LivelinessChanged| (last.alive_count, last.not_alive_count) == counts)
            });
            last.unwrap()
        };
        until(&mut monitor, (1, 0));
        part.kill();
        let lost = until(&mut monitor, (0, 1));
        assert_eq!((lost.alive_count_change, lost.not_alive_count_change), (-1, 1), "cycle {cycle}");
    }
    drop((monitor, subscription, events, participant));
    clean(114);
}

#[test]
fn monitors_tell_of_ends_on_other_hosts_and_not_of_their_stand_ins() {
    let domain = domain(78);
    clean(domain);
    let participant = Participant::new(domain).unwrap();
    let gateway = Participant::new(domain).unwrap();
    gateway.set_remote(&RemoteGraph::default()).unwrap();
    let subscription = subscription(&participant, "/far", Qos::default());
    let publisher = publisher(&participant, "/far", Qos::default());
    let slots = [participant.claim_slot().unwrap(), participant.claim_slot().unwrap()];
    let mut requested = subscription.as_ref().monitor(&slots[0]);
    let mut offered = publisher.as_ref().monitor(&slots[1]);
    assert_eq!(requested.changes(monotonic_ns()).matched.unwrap().current_count, 1);
    assert_eq!(offered.changes().matched.unwrap().current_count, 1);

    let topic_type = TopicType::of::<Count>();
    let relay = gateway.create_relay_publisher("/far", &topic_type, Qos::default(), LIMITS).unwrap();
    let _out = gateway.create_relay_subscription("/far", &topic_type, Qos::default(), LIMITS).unwrap();
    assert_eq!(requested.changes(monotonic_ns()), Default::default(), "a stand-in is no end");
    assert_eq!(offered.changes(), Default::default());
    let counts = [subscription.as_ref().matched(), publisher.as_ref().matched()];
    let counted = || counts.each_ref().map(MatchedCount::get);
    let here = || (subscription.publisher_count(), publisher.subscription_count());
    wait_for("the stand-ins", || here() == (2, 2));
    assert_eq!(counted(), [1, 1], "stand-ins count only beside nobody");
    let end = |topic: &str, type_name: &'static str, kind, gid| TopicEndpoint {
        kind,
        topic: topic.into(),
        topic_type: TopicType { hash: topic_type.hash.clone(), ..TopicType::new(type_name) },
        gid: Gid([gid; 16]),
        // Less than is requested: it is passed on all the same.
        qos: Qos::default().best_effort(),
        node: Some(NodeName { namespace: "/theirs".into(), name: "talker".into() }),
        pid: None,
        is_remote: true,
        is_own: false,
        origin: Default::default(),
        teller: None,
    };
    let (publishing, subscribing) = (EndpointKind::Publisher, EndpointKind::Subscription);
    let count = "test_msgs/msg/Count";
    let mut remote = RemoteGraph {
        endpoints: vec![
            end("/far", count, publishing, 1),
            end("/far", count, publishing, 2),
            end("/far", "test_msgs/msg/Other", publishing, 3),
            end("/farther", count, publishing, 4),
            end("/far", count, subscribing, 5),
        ],
        ..Default::default()
    };
    gateway.set_remote(&remote).unwrap();
    let mut changes = Default::default();
    wait_for("publishers elsewhere", || {
        changes = requested.changes(monotonic_ns());
        changes.matched.is_some()
    });
    let matched = changes.matched.unwrap();
    assert_eq!((matched.current_count, matched.current_count_change, matched.total_count), (3, 2, 3));
    assert_eq!(changes.incompatible_qos, None);
    let alive = |alive, not_alive, change, not_change| LivelinessChanged {
        alive_count: alive,
        not_alive_count: not_alive,
        alive_count_change: change,
        not_alive_count_change: not_change,
    };
    assert_eq!(changes.liveliness, Some(alive(3, 0, 2, 0)));
    wait_for("a subscription elsewhere", || {
        offered
            .changes()
            .matched
            .is_some_and(|matched| (matched.current_count, matched.total_count) == (2, 2))
    });
    assert_eq!((counted(), here()), ([3, 2], (2, 2)));

    // Who looks later sees it at once, as who looked before.
    let mut late = subscription.as_ref().monitor(&slots[0]);
    assert_eq!(late.changes(monotonic_ns()).matched.unwrap().current_count, 3);
    let requested = &mut late;
    relay.publish(&7u64.to_le_bytes()).unwrap();
    assert_eq!(take_all(&subscription), [7]);
    remote.endpoints.remove(0);
    gateway.set_remote(&remote).unwrap();
    wait_for("the end of a publisher", || {
        changes = requested.changes(monotonic_ns());
        changes.matched.is_some()
    });
    assert_eq!(changes.liveliness, Some(alive(2, 1, -1, 1)), "nobody says that it ended");
    // One that its host says has ended.
    let ended = remote.endpoints.remove(0);
    remote.ended.insert(ended.gid.tag());
    gateway.set_remote(&remote).unwrap();
    wait_for("the orderly end of a publisher", || {
        changes = requested.changes(monotonic_ns());
        changes.matched.is_some()
    });
    assert_eq!(changes.liveliness, Some(alive(1, 0, -1, -1)));
    remote.endpoints.push(end("/far", count, publishing, 6));
    gateway.set_remote(&remote).unwrap();
    wait_for("another publisher", || {
        changes = requested.changes(monotonic_ns());
        changes.matched.is_some()
    });
    assert_eq!(changes.liveliness, Some(alive(2, 0, 1, 0)));
    drop((relay, _out, gateway));
    wait_for("the end of the gateway", || {
        changes = requested.changes(monotonic_ns());
        changes.matched.is_some()
    });
    assert_eq!((changes.matched.unwrap().current_count, changes.liveliness), (1, Some(alive(1, 1, -1, 1))));
}

/// Two gateways tell of one publisher: it is one, and goes on to be there while one of them does.
#[test]
fn an_end_that_two_tell_of_is_one() {
    let domain = domain(88);
    clean(domain);
    let [observer, near, far] = [(); 3].map(|()| Participant::new(domain).unwrap());
    let subscription = subscription(&observer, "/far", Qos::default());
    let slot = observer.claim_slot().unwrap();
    let mut monitor = subscription.as_ref().monitor(&slot);
    let topic_type = TopicType::of::<Count>();
    let told = |gid, path: &[u64]| RemoteGraph {
        endpoints: vec![TopicEndpoint {
            kind: EndpointKind::Publisher,
            topic: "/far".into(),
            topic_type: topic_type.clone(),
            gid: Gid([gid; 16]),
            qos: Qos::default(),
            node: Some(NodeName { namespace: "/".into(), name: "talker".into() }),
            pid: None,
            is_remote: true,
            is_own: false,
            origin: Origin { tag: 7, path: path.to_vec(), ..Origin::default() },
            teller: None,
        }],
        ..RemoteGraph::default()
    };
    let (mut matched, mut alive, mut total) = (0, (0, 0), 0);
    let mut look = || {
        let changes = monitor.changes(monotonic_ns());
        if let Some(now) = changes.matched {
            (matched, total) = (now.current_count, now.total_count);
        }
        alive = changes.liveliness.map_or(alive, |now| (now.alive_count, now.not_alive_count));
        (matched, total, alive)
    };
    far.set_remote(&told(2, &[1, 2])).unwrap();
    wait_for("the publisher", || look() == (1, 1, (1, 0)));
    near.set_remote(&told(1, &[1])).unwrap();
    wait_for("the better word of it", || look() == (1, 2, (1, 0)));
    // The worse one changes nothing, and in place of the better one it is there at once.
    far.set_remote(&told(3, &[1, 2])).unwrap();
    near.set_remote(&RemoteGraph::default()).unwrap();
    wait_for("the other word of it", || look() == (1, 3, (1, 0)));
    far.set_remote(&RemoteGraph::default()).unwrap();
    wait_for("its end", || look() == (0, 3, (0, 1)));
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Events of publishers and subscriptions: told to whoever waits, through the sampler, exactly counted.

mod common;

use common::{Log, Number, context, realtime, run_again, spin, spinning_node};
use futures::executor::block_on;
use futures::{Stream, StreamExt};
use std::sync::Arc;
use std::time::Duration;
use tautline::{
    CallbackOptions, Context, Liveliness, Node, PublisherEvent, Qos, QosPolicyKind, Realtime,
    SubscriptionEvent,
};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};

const MS: u64 = 1_000_000;

fn next<E>(events: &mut (impl Stream<Item = E> + Unpin)) -> E {
    block_on(events.next()).expect("it has not ended")
}

/// The next event that `wanted` picks.
fn next_of<E, F>(events: &mut (impl Stream<Item = E> + Unpin), wanted: impl Fn(E) -> Option<F>) -> F {
    loop {
        if let Some(found) = wanted(next(events)) {
            return found;
        }
    }
}

#[test]
fn both_ends_hear_of_a_match_of_what_does_not_fit_and_of_the_end() {
    let (mut node, _sampler) = spinning_node(200, "matches");
    let sensor = Qos::default().best_effort();
    let publisher = node.create_publisher::<Number>("/m", sensor).unwrap();
    let mut offered = node.publisher_events(&publisher).unwrap();
    let fitting = node.subscribe::<Number>("/m", sensor).unwrap();
    let PublisherEvent::Matched(matched) = next(&mut offered) else { panic!() };
    assert_eq!((matched.current_count, matched.current_count_change), (1, 1));

    let strict = node.subscribe::<Number>("/m", Qos::default()).unwrap();
    let mut requested = node.subscription_events(&strict).unwrap();
    let PublisherEvent::OfferedIncompatibleQos(found) = next(&mut offered) else { panic!() };
    assert_eq!((found.total_count, found.last_policy_kind), (1, QosPolicyKind::Reliability));
    let SubscriptionEvent::RequestedIncompatibleQos(found) = next(&mut requested) else { panic!() };
    assert_eq!((found.total_count, found.last_policy_kind), (1, QosPolicyKind::Reliability));
    publisher.publish(&Number { value: 1 }).unwrap();
    assert_eq!(fitting.try_take().unwrap().unwrap().value, 1);
    assert!(strict.try_take().unwrap().is_none());

    drop(fitting);
    let PublisherEvent::Matched(matched) = next(&mut offered) else { panic!() };
    assert_eq!((matched.total_count, matched.current_count, matched.current_count_change), (1, 0, -1));
    drop((publisher, strict));
    assert_eq!((block_on(offered.next()), block_on(requested.next())), (None, None), "they end");
}

#[test]
fn a_deadline_is_missed_once_for_each_period_at_both_ends() {
    let (mut node, _sampler) = spinning_node(200, "deadline");
    let period_ns = 20 * MS;
    let qos = Qos::default().deadline(Duration::from_nanos(period_ns));
    let publisher = node.create_publisher::<Number>("/d", qos).unwrap();
    let subscription = node.subscribe::<Number>("/d", qos).unwrap();
    let (mut offered, mut requested) =
        (node.publisher_events(&publisher).unwrap(), node.subscription_events(&subscription).unwrap());
    let before = monotonic_ns();
    publisher.publish(&Number { value: 1 }).unwrap();
    let after = monotonic_ns();
    // The sample waits, untaken: it came all the same.
    let missed_by_publisher = |event| match event {
        PublisherEvent::OfferedDeadlineMissed(missed) => Some(missed),
        _ => None,
    };
    let missed_by_subscription = |event| match event {
        SubscriptionEvent::RequestedDeadlineMissed(missed) => Some(missed),
        _ => None,
    };
    let (mut offers, mut requests) = (0, 0);
    while offers < 3 {
        let missed = next_of(&mut offered, missed_by_publisher);
        offers += missed.total_count_change;
        assert_eq!(missed.total_count, offers);
        let due = missed.due_ns - offers * period_ns;
        assert!((before..=after).contains(&due), "counted from the last message");
    }
    while requests < 3 {
        let missed = next_of(&mut requested, missed_by_subscription);
        requests += missed.total_count_change;
        assert_eq!(missed.total_count, requests);
        assert!((before..=after).contains(&(missed.due_ns - requests * period_ns)));
    }
}

#[test]
fn lost_messages_and_leases_are_told() {
    let (mut node, _sampler) = spinning_node(200, "lost");
    let lease = Duration::from_millis(20);
    let manual = Qos::keep_last(1).liveliness(Liveliness::ManualByTopic).liveliness_lease_duration(lease);
    let publisher = node.create_publisher::<Number>("/l", manual).unwrap();
    let subscription = node.subscribe::<Number>("/l", manual).unwrap();
    let (mut offered, mut requested) =
        (node.publisher_events(&publisher).unwrap(), node.subscription_events(&subscription).unwrap());
    let lost = |event| match event {
        PublisherEvent::LivelinessLost(lost) => Some(lost.total_count),
        _ => None,
    };
    let changed = |event| match event {
        SubscriptionEvent::LivelinessChanged(changed) => Some((changed.alive_count, changed.not_alive_count)),
        _ => None,
    };
    assert_eq!(next_of(&mut requested, changed), (1, 0));
    assert_eq!(next_of(&mut offered, lost), 1);
    assert_eq!(next_of(&mut requested, changed), (0, 1));
    // Long silence is one loss.
    sleep_until_monotonic(monotonic_ns() + 100 * MS);
    publisher.assert_liveliness();
    assert_eq!(next_of(&mut offered, lost), 2);

    for value in 0..3 {
        publisher.publish(&Number { value }).unwrap();
    }
    assert_eq!(subscription.try_take().unwrap().unwrap().value, 2);
    let lost = next_of(&mut requested, |event| match event {
        SubscriptionEvent::MessageLost(lost) => Some(lost.total_count),
        _ => None,
    });
    assert_eq!(lost, 2);
}

/// One that nobody could keep is told of, and leaves the sampler time for others.
#[test]
fn a_deadline_of_no_time_does_not_keep_the_sampler_busy() {
    let (mut node, _sampler) = spinning_node(84, "hasty");
    let qos = Qos::default().deadline(Duration::from_nanos(1));
    let publisher = node.create_publisher::<Number>("/h", qos).unwrap();
    let subscription = node.subscribe::<Number>("/h", qos).unwrap();
    let mut requested = node.subscription_events(&subscription).unwrap();
    publisher.publish(&Number { value: 1 }).unwrap();
    let mut due = Vec::new();
    while due.len() < 3 {
        let missed = next_of(&mut requested, |event| match event {
            SubscriptionEvent::RequestedDeadlineMissed(missed) => Some(missed),
            _ => None,
        });
        due.push((missed.total_count, missed.due_ns));
    }
    for two in due.windows(2) {
        let ((before, first), (after, second)) = (two[0], two[1]);
        assert_eq!(second - first, (after - before) * 50_000, "{due:?}");
    }
}

#[test]
fn times_of_any_length_can_be_asked_for() {
    let mut node = Node::create(context(200), "times", "").unwrap();
    let all = Qos::default()
        .deadline(Duration::from_nanos(1))
        .lifespan(Duration::MAX)
        .liveliness_lease_duration(Duration::MAX)
        .liveliness(Liveliness::ManualByTopic);
    let publisher = node.create_publisher::<Number>("/t", all).unwrap();
    let _events = node.publisher_events(&publisher).unwrap();
    // A lease that is over before anybody can look: the stream ends a look all the same.
    let brief = Qos::default()
        .liveliness_lease_duration(Duration::from_nanos(1))
        .liveliness(Liveliness::ManualByTopic);
    let _brief = node.create_publisher::<Number>("/brief", brief).unwrap();
    let subscription = node.subscribe::<Number>("/brief", Qos::default()).unwrap();
    let mut told = node.subscription_events(&subscription).unwrap();
    while told.poll_next_unpin(&mut std::task::Context::from_waker(std::task::Waker::noop())).is_ready() {}
    // More than a context has places at the start: there is no limit of them.
    let events: Vec<_> = (0..1500).map(|_| node.publisher_events(&publisher).unwrap()).collect();
    drop(events);
}

const TOPICS: usize = 200;

/// 200 topics at 100 Hz with a deadline, of which each is silent for 20 messages. Every silence is told, once; how late is printed.
#[test]
fn two_hundred_topics_at_100_hz_on_one_sampler() {
    static MISSED: Log<(usize, u64)> = Log::new();
    let realtime = if realtime() { Realtime::Required } else { Realtime::Off };
    let context = Context::builder().domain(200).realtime(realtime).hold_idle(false).build().unwrap();
    let sampler = spin(&context);
    let mut node = Node::create(context.clone(), "many", "").unwrap();
    let (period_ns, rounds) = (10 * MS, 100);
    let qos = Qos::keep_last(1).deadline(Duration::from_nanos(period_ns + period_ns / 2));
    let mut publishers = Vec::new();
    let mut streams = Vec::new();
    for index in 0..TOPICS {
        let topic = format!("/many_{index}");
        let publisher = node.create_publisher::<Number>(&topic, qos).unwrap();
        let subscription = node.subscribe::<Number>(&topic, qos).unwrap();
        let events = node.subscription_events(&subscription).unwrap();
        streams.push(events.map(move |event| (index, event)));
        publishers.push((publisher, subscription));
    }
    let latencies: Arc<Log<u64>> = Arc::new(Log::new());
    let told = latencies.clone();
    let watch = node
        .spawn_callback(CallbackOptions::fifo(20).name("events"), async move {
            let mut events = futures::stream::select_all(streams);
            while let Some((index, event)) = events.next().await {
                if let SubscriptionEvent::RequestedDeadlineMissed(missed) = event {
                    told.add(monotonic_ns() - missed.due_ns);
                    MISSED.add((index, missed.due_ns));
                }
            }
        })
        .unwrap();
    let start = monotonic_ns() + 20 * MS;
    let mut published = vec![Vec::new(); TOPICS];
    for round in 0..rounds {
        sleep_until_monotonic(start + round as u64 * period_ns);
        for (index, (publisher, _)) in publishers.iter().enumerate() {
            let silence = index % 70 + 1;
            if !(silence..silence + 20).contains(&round) {
                let before = monotonic_ns();
                publisher.publish(&Number { value: round as u64 }).unwrap();
                published[index].push((before, monotonic_ns()));
            }
        }
    }
    let end = monotonic_ns();
    drop(publishers);
    watch.stop();
    watch.join().unwrap();
    drop(sampler);
    // What should have been told, from when the messages really went out: a gap longer than the deadline is a miss or more.
    let deadline_ns = period_ns + period_ns / 2;
    let missed = MISSED.events();
    for (index, sent) in published.iter().enumerate() {
        let due: Vec<u64> =
            missed.iter().filter(|(of, due)| *of == index && *due < end).map(|(_, due)| *due).collect();
        for gap in sent.windows(2) {
            let ((from, until), (next, _)) = (gap[0], gap[1]);
            let here = due.iter().filter(|due| (from + deadline_ns..=next).contains(*due)).count();
            // Long enough for a sampler on a busy machine to look in time.
            if next > until + deadline_ns + 100 * MS {
                assert!(here >= 1, "topic {index}: a gap of {} ns was not told", next - until);
            }
            assert!(due.windows(2).all(|two| two[0] < two[1]), "topic {index}: each once, in order");
        }
        assert!(!due.is_empty(), "topic {index} left one out");
    }
    let mut latencies = latencies.events();
    latencies.sort_unstable();
    let at = |percent: usize| latencies[(latencies.len() - 1) * percent / 100] / 1000;
    println!(
        "{} misses, real-time {realtime:?}, told after (us): p50 {}, p99 {}, max {}; load {}",
        latencies.len(),
        at(50),
        at(99),
        at(100),
        std::fs::read_to_string("/proc/loadavg").unwrap_or_default().trim()
    );
}

#[test]
fn liveliness_is_lost_after_kill_9_of_the_publisher() {
    // The child publishes, and is killed by itself.
    if std::env::var_os("TAUT_TEST_CHILD").is_some() {
        let mut node = Node::create(context(118), "victim", "").unwrap();
        let _publisher = node.create_publisher::<Number>("/victim", Qos::default()).unwrap();
        let subscription = node.subscribe::<Number>("/go", Qos::default()).unwrap();
        while subscription.try_take().unwrap().is_none() {
            std::thread::yield_now();
        }
        rustix::process::kill_process(rustix::process::getpid(), rustix::process::Signal::KILL).unwrap();
    }
    let (mut node, _sampler) = spinning_node(118, "watcher");
    let subscription = node.subscribe::<Number>("/victim", Qos::default()).unwrap();
    let mut events = node.subscription_events(&subscription).unwrap();
    let go = node.create_publisher::<Number>("/go", Qos::default().transient_local()).unwrap();
    let mut go_events = node.publisher_events(&go).unwrap();
    let child =
        std::thread::spawn(|| run_again("liveliness_is_lost_after_kill_9_of_the_publisher", &[]).unwrap());
    let changed = |event| match event {
        SubscriptionEvent::LivelinessChanged(changed) => Some(changed),
        _ => None,
    };
    assert_eq!(next_of(&mut events, changed).alive_count, 1);
    // Its subscription is there: it hears the word.
    next(&mut go_events);
    go.publish(&Number { value: 0 }).unwrap();
    let lost = next_of(&mut events, changed);
    assert_eq!((lost.alive_count, lost.not_alive_count), (0, 1));
    assert_eq!((lost.alive_count_change, lost.not_alive_count_change), (-1, 1));
    assert!(!child.join().unwrap().status.success());
}

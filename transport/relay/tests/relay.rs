// SPDX-License-Identifier: MIT OR Apache-2.0
//! The order in which samples are passed on, and which are not.

use std::collections::VecDeque;
use std::sync::mpsc;
use std::time::Duration;
use tautline_relay::{EarlyLimits, Egress, Last, OutboundSample, Relay};
use tautline_rt::ThreadBuilder;
use tautline_transport::{Limits, Participant, Qos, RawPublisher, TopicType};

/// Tells what it is given.
struct Log;

impl Egress for Log {
    type Key = &'static str;
    type Topic = mpsc::Sender<String>;
    type Sender = &'static str;

    const EARLY: EarlyLimits = EarlyLimits { samples: 3, bytes: 1000, time: Duration::from_secs(3600) };

    fn pass(&mut self, log: &mut Self::Topic, sender: &mut Self::Sender, sample: OutboundSample) {
        let when = if matches!(sample, OutboundSample::Early(_)) { "early" } else { "now" };
        assert_eq!(sample.body(), [7; 10]);
        let _ = log.send(format!("{sender} {} {when}", sample.port().1));
    }

    fn dropped(log: &Self::Topic) {
        let _ = log.send("dropped".into());
    }

    fn lost(log: &Self::Topic, samples: u64) {
        if samples > 0 {
            let _ = log.send(format!("lost {samples}"));
        }
    }
}

fn publish(publisher: &RawPublisher) {
    let mut loan = publisher.loan(10).unwrap();
    loan.fill(7);
    assert!(loan.publish().is_ok());
}

/// However many more than may come early.
#[test]
fn what_is_kept_finds_the_senders_that_its_topic_begins_with() {
    tautline_rt::domain::test_scope("test");
    let [participant, relaying] = [(); 2].map(|()| Participant::new(207).unwrap());
    let (topic_type, qos) = (TopicType::new("test_msgs/msg/Bytes"), Qos::keep_last(20).transient_local());
    let publisher = participant.create_raw_publisher("/x", &topic_type, qos, Limits::default()).unwrap();
    (0..20).for_each(|_| publish(&publisher));
    let subscription = relaying.create_relay_subscription("/x", &topic_type, qos, Limits::default()).unwrap();
    let relay = Relay::start(&relaying, ThreadBuilder::new("relay"), Log).unwrap();
    let (log, told) = mpsc::channel();
    relay.start_topic("/x", subscription, log, vec![(publisher.gid(), "kept")]);
    for n in 1..=20 {
        let next = told.recv_timeout(Duration::from_secs(30)).expect("waited in vain");
        assert_eq!(next, format!("kept {n} now"));
    }
}

#[test]
fn what_came_early_goes_first_and_what_is_a_relays_does_not_go() {
    tautline_rt::domain::test_scope("test");
    let [participant, relaying] = [(); 2].map(|()| Participant::new(93).unwrap());
    let (topic_type, qos) = (TopicType::new("test_msgs/msg/Bytes"), Qos::keep_last(10));
    let publisher =
        |of: &Participant| of.create_raw_publisher("/x", &topic_type, qos, Limits::default()).unwrap();
    let [known, early, other, unknown] = std::array::from_fn(|_| publisher(&participant));
    let own = publisher(&relaying);
    let subscription = relaying.create_relay_subscription("/x", &topic_type, qos, Limits::default()).unwrap();

    let relay = Relay::start(&relaying, ThreadBuilder::new("relay"), Log).unwrap();
    let (log, told) = mpsc::channel();
    let next = || told.recv_timeout(Duration::from_secs(30)).expect("waited in vain");
    relay.passed_over().lock().insert(other.gid());
    relay.open("/x", known.gid(), "a topic that is not taken yet");
    relay.start_topic("/x", subscription, log, Vec::new());
    relay.open("/x", known.gid(), "known");

    for _ in 0..4 {
        publish(&early);
    }
    publish(&own);
    publish(&other);
    // Once it was passed on, what is there with it has been taken before the next command.
    publish(&known);
    let mut both = [next(), next()];
    both.sort_unstable();
    assert_eq!(both, ["dropped", "known 1 now"], "the fourth is too much");
    relay.open("/x", early.gid(), "early");
    for n in 1..=3 {
        assert_eq!(next(), format!("early {n} early"));
    }
    publish(&early);
    assert_eq!(next(), "early 5 now");

    publish(&early);
    relay.close("/x", early.gid());
    assert_eq!(next(), "early 6 now", "what it published before it went");
    publish(&unknown);
    relay.stop_topic("/x");
    assert_eq!(next(), "dropped");
    publish(&known);
    drop(relay);
    assert_eq!(told.try_recv(), Err(mpsc::TryRecvError::Disconnected), "nothing more");
}

/// Hands samples over, for others to hold.
struct HandOver;

impl Egress for HandOver {
    type Key = &'static str;
    type Topic = mpsc::Sender<OutboundSample>;
    type Sender = Last;

    const EARLY: EarlyLimits = Log::EARLY;

    fn pass(&mut self, samples: &mut Self::Topic, last: &mut Last, sample: OutboundSample) {
        if last.admits(&sample) {
            let _ = samples.send(sample);
        }
    }

    fn dropped(_: &Self::Topic) {
        panic!("nothing comes early");
    }

    fn lost(_: &Self::Topic, samples: u64) {
        assert_eq!(samples, 0);
    }
}

#[test]
fn what_waits_for_held_samples_is_taken_though_its_publisher_or_topic_has_ended() {
    tautline_rt::domain::test_scope("test");
    let [participant, relaying] = [(); 2].map(|()| Participant::new(224).unwrap());
    let (topic_type, qos, limits) =
        (TopicType::new("test_msgs/msg/Bytes"), Qos::keep_last(20), Limits::default());
    let relay = Relay::start(&relaying, ThreadBuilder::new("relay"), HandOver).unwrap();
    for end in ["publisher", "topic", "subscription"] {
        let subscribe = || relaying.create_relay_subscription("/x", &topic_type, qos, limits).unwrap();
        let publisher = participant.create_raw_publisher("/x", &topic_type, qos, limits).unwrap();
        let (samples, passed) = mpsc::channel();
        relay.start_topic("/x", subscribe(), samples.clone(), vec![(publisher.gid(), Last::default())]);
        (0..20).for_each(|_| publish(&publisher));
        let next = || passed.recv_timeout(Duration::from_secs(30)).expect("no sample");
        let mut held: VecDeque<_> = (0..limits.held).map(|_| next()).collect();
        match end {
            "publisher" => relay.close("/x", publisher.gid()),
            "topic" => relay.stop_topic("/x"),
            _ => {
                relay.start_topic("/x", subscribe(), samples, Vec::new());
                // In both subscriptions, or in the second alone.
                (0..4).for_each(|_| publish(&publisher));
            }
        }
        drop(publisher);
        let last = if end == "subscription" { 24 } else { 20 };
        for n in 1..=last {
            let first = held.pop_front().unwrap();
            assert_eq!(first.port().1, n, "{end}");
            drop(first);
            held.extend((n + (limits.held as u64) <= last).then(next));
        }
    }
}

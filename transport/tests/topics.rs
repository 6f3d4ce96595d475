// SPDX-License-Identifier: MIT OR Apache-2.0
//! Loan, publish, take: in place, in order, counted; limits, types and domains.

mod support;

use std::time::Duration;
use support::{
    Count, IMAGE_BYTES, Image, LIMITS, Part, clean, domain, place_of, say, take_all, wait_for, wait_for_some,
    wait_for_the_end,
};
use tautline_msgs::Message;
use tautline_transport::{
    Limits, LoanError, Participant, PublishError, Publisher, Qos, SendError, Subscription, TakeError,
    TopicType, TransportError,
};

#[derive(Message, Clone, Copy)]
#[message(name = "test_msgs/msg/Other", crate = "tautline_msgs")]
#[repr(C)]
struct Other {
    n: u64,
}

#[derive(Message, Clone, Copy)]
#[message(name = "test_msgs/msg/Count", crate = "tautline_msgs")]
#[repr(C)]
struct Longer {
    n: [u64; 3],
}

#[derive(Message, Clone, Copy, Debug, PartialEq)]
#[message(name = "test_msgs/msg/Flag", crate = "tautline_msgs")]
#[repr(C)]
struct Flag {
    n: u32,
    raised: bool,
}

fn ends<T: Message>(participant: &Participant, topic: &str, qos: Qos) -> (Publisher<T>, Subscription<T>) {
    let publisher = participant.create_publisher(topic, qos, LIMITS).unwrap();
    (publisher, participant.create_subscription(topic, qos, LIMITS).unwrap())
}

/// The child's part of the tests here; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    match part.as_str() {
        "image" => {
            let publisher =
                participant.create_publisher::<Image>("/image", Qos::keep_last(2), LIMITS).unwrap();
            let mut loan = publisher.loan().unwrap();
            loan.data[..8].copy_from_slice(b"tautline");
            loan.data[IMAGE_BYTES - 1] = 7;
            let place = place_of(&raw const loan.data);
            loan.publish().unwrap();
            say(&format!("{} {} {}", place.path, place.inode, place.offset));
            wait_for_the_end();
        }
        "250 subscriptions" => {
            let limits = Limits { held: 1, ..LIMITS };
            let descriptors = descriptors();
            let subscriptions: Vec<_> = (0..250)
                .map(|_| {
                    participant.create_subscription::<Count>("/many", Qos::keep_last(4), limits).unwrap()
                })
                .collect();
            // But for what the janitor opens for a moment.
            let more = self::descriptors().saturating_sub(descriptors);
            assert!(more < 10, "{more} for 250 subscriptions and what they are connected to");
            say("ready");
            for subscription in &subscriptions {
                let mut taken = Vec::new();
                wait_for("a message of each publisher", || {
                    taken.extend(take_all(subscription));
                    taken.len() >= PUBLISHERS as usize
                });
                taken.sort();
                assert_eq!(taken, (0..PUBLISHERS).collect::<Vec<_>>());
            }
            say("all taken");
            wait_for_the_end();
        }
        other => panic!("no part {other}"),
    }
}

#[test]
fn an_image_is_read_where_it_was_written() {
    let participant = Participant::new(domain(130)).unwrap();
    let (publisher, subscription) = ends::<Image>(&participant, "/image", Qos::keep_last(2));
    let mut loan = publisher.loan().unwrap();
    loan.data[0] = 1;
    loan.data[IMAGE_BYTES - 1] = 2;
    let written = place_of(&raw const loan.data);
    loan.publish().unwrap();

    let sample = subscription.try_take().unwrap().unwrap();
    let read = place_of(&raw const sample.data);
    assert!(read.path.starts_with("/dev/shm/taut_130_"), "{read:?}");
    assert_eq!(read, written, "the same bytes of the same file: nothing was copied");
    assert_eq!((sample.data[0], sample.data[IMAGE_BYTES - 1]), (1, 2));
}

#[test]
fn an_image_of_another_process_is_read_in_that_ones_segment() {
    let participant = Participant::new(domain(131)).unwrap();
    let subscription = participant.create_subscription::<Image>("/image", Qos::keep_last(2), LIMITS).unwrap();
    let mut part = Part::start("image", 131);
    let written = part.hear();
    let sample = wait_for_some("the image", || subscription.try_take().unwrap());
    let read = place_of(&raw const sample.data);
    assert_eq!(format!("{} {} {}", read.path, read.inode, read.offset), written);
    assert_eq!((&sample.data[..8], sample.data[IMAGE_BYTES - 1]), (&b"tautline"[..], 7));
    part.kill();
    assert_eq!(sample.data[IMAGE_BYTES - 1], 7, "a held sample outlives its publisher");
    drop((sample, subscription, participant));
    clean(131);
}

#[test]
fn samples_carry_number_time_and_publisher() {
    let participant = Participant::new(domain(132)).unwrap();
    let first = participant.create_publisher::<Count>("/info", Qos::default(), LIMITS).unwrap();
    let second = participant.create_publisher::<Count>("/info", Qos::default(), LIMITS).unwrap();
    let subscription = participant.create_subscription::<Count>("/info", Qos::default(), LIMITS).unwrap();
    assert_ne!(first.gid(), second.gid());
    let before_ns = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos() as i64;
    for n in 1..=2 {
        first.publish(&Count { n }).unwrap();
    }
    second.loan().unwrap().publish_released_at(77).unwrap();
    let after_ns = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos() as i64;

    let infos: Vec<_> =
        std::iter::from_fn(|| subscription.try_take().unwrap().map(|sample| sample.info())).collect();
    let of = |gid| infos.iter().filter(|info| info.publisher_gid == gid).collect::<Vec<_>>();
    let numbers = |gid| of(gid).iter().map(|info| info.sequence_number).collect::<Vec<_>>();
    assert_eq!((numbers(first.gid()), numbers(second.gid())), (vec![1, 2], vec![1]));
    assert!(infos.iter().all(|info| (before_ns..=after_ns).contains(&info.source_timestamp_ns)));
    assert_eq!(of(second.gid())[0].released_ns, 77);
    assert!(of(first.gid())[0].released_ns <= of(first.gid())[1].released_ns);
}

#[test]
fn keep_last_overwrites_the_oldest_and_counts_it_there_alone() {
    let participant = Participant::new(domain(133)).unwrap();
    let publisher = participant.create_publisher::<Count>("/last", Qos::default(), LIMITS).unwrap();
    let subscribe =
        |depth| participant.create_subscription::<Count>("/last", Qos::keep_last(depth), LIMITS).unwrap();
    let (never, slow, fast) = (subscribe(2), subscribe(3), subscribe(100));
    let mut taken = Vec::new();
    for n in 1..=100 {
        publisher.publish(&Count { n }).unwrap();
        taken.extend(take_all(&fast));
    }
    assert_eq!(taken, (1..=100).collect::<Vec<_>>());
    assert_eq!(take_all(&slow), [98, 99, 100]);
    publisher.publish(&Count { n: 101 }).unwrap();
    assert_eq!(take_all(&slow), [101]);
    let counts = |subscription: &Subscription<Count>| {
        let counters = subscription.counters();
        (counters.received(), counters.lost(), counters.max_queue())
    };
    assert_eq!(counts(&fast), (100, 0, 1));
    assert_eq!(counts(&slow), (4, 97, 3));
    assert_eq!(counts(&never), (0, 0, 0), "what was lost shows when it takes");
    assert_eq!(take_all(&never), [100, 101]);
    assert_eq!(counts(&never), (2, 99, 2));
}

#[test]
fn losses_are_exact_with_several_publishers_and_random_pauses() {
    use rand::RngExt;
    let mut random = tautline_seed::random();
    let participant = Participant::new(domain(134)).unwrap();
    let publishers: Vec<_> = (0..3)
        .map(|_| participant.create_publisher::<Count>("/random", Qos::default(), LIMITS).unwrap())
        .collect();
    let subscription =
        participant.create_subscription::<Count>("/random", Qos::keep_last(5), LIMITS).unwrap();
    let (mut sent, mut received) = (0, 0);
    for _ in 0..20_000 {
        if random.random_ratio(4, 5) {
            publishers[random.random_range(0..3)].publish(&Count { n: sent }).unwrap();
            sent += 1;
        } else {
            let takes = random.random_range(0..12);
            received += (0..takes).filter(|_| subscription.try_take().unwrap().is_some()).count() as u64;
        }
    }
    received += take_all(&subscription).len() as u64;
    let counters = subscription.counters();
    // The last samples are always there, so that every gap was seen.
    assert_eq!((counters.received(), counters.received() + counters.lost()), (received, sent));
    assert_eq!(counters.max_queue(), 5);
}

#[test]
fn deep_queues() {
    let participant = Participant::new(domain(135)).unwrap();
    let subscription =
        participant.create_subscription::<Count>("/deep", Qos::keep_last(20_000), LIMITS).unwrap();
    let publisher = participant.create_publisher::<Count>("/deep", Qos::default(), LIMITS).unwrap();
    for n in 1..=20_001 {
        publisher.publish(&Count { n }).unwrap();
    }
    assert_eq!(take_all(&subscription), (2..=20_001).collect::<Vec<_>>());
    assert_eq!(subscription.counters().lost(), 1);
    // Whoever came first decides nothing.
    let deeper = participant.create_subscription::<Count>("/deep", Qos::keep_last(30_000), LIMITS).unwrap();
    for n in 1..=30_001 {
        publisher.publish(&Count { n }).unwrap();
    }
    assert_eq!(take_all(&deeper), (2..=30_001).collect::<Vec<_>>());
    assert_eq!(take_all(&subscription), (10_002..=30_001).collect::<Vec<_>>());
    for depth in [0, Limits::MAX_DEPTH + 1] {
        let error =
            participant.create_publisher::<Count>("/deep", Qos::keep_last(depth), LIMITS).err().unwrap();
        assert!(matches!(error, TransportError::LimitRange { limit: "depth", .. }), "{error}");
    }
}

#[test]
fn times_of_zero_are_refused() {
    let participant = Participant::new(domain(136)).unwrap();
    let none = Some(Duration::ZERO);
    for (qos, setting) in [
        (Qos { deadline: none, ..Qos::default() }, "deadline"),
        (Qos { lifespan: none, ..Qos::default() }, "lifespan"),
        (Qos { liveliness_lease_duration: none, ..Qos::default() }, "liveliness_lease_duration"),
    ] {
        let publisher = participant.create_publisher::<Count>("/zero", qos, LIMITS).err().unwrap();
        let subscription = participant.create_subscription::<Count>("/zero", qos, LIMITS).err().unwrap();
        for error in [publisher, subscription] {
            let text = error.to_string();
            assert!(text.contains("/zero") && text.contains(setting), "{text}");
        }
    }
}

#[test]
fn ends_of_other_types_get_nothing_from_each_other_and_are_told() {
    let participant = Participant::new(domain(137)).unwrap();
    let publisher = participant.create_publisher::<Count>("/typed", Qos::default(), LIMITS).unwrap();
    let other = participant.create_subscription::<Other>("/typed", Qos::default(), LIMITS).unwrap();
    let longer = participant.create_subscription::<Longer>("/typed", Qos::default(), LIMITS).unwrap();
    let same = participant.create_subscription::<Count>("/typed", Qos::default(), LIMITS).unwrap();
    let unknown = TopicType::new("test_msgs/msg/Count");
    let unknown = participant.create_raw_subscription("/typed", &unknown, Qos::default(), LIMITS).unwrap();
    publisher.publish(&Count { n: 7 }).unwrap();
    assert!(other.try_take().unwrap().is_none() && longer.try_take().unwrap().is_none());
    assert_eq!(take_all(&same), [7]);
    assert_eq!(unknown.try_take().unwrap().unwrap().body(), 7_u64.to_ne_bytes());
    assert_eq!(
        (publisher.subscription_count(), other.publisher_count(), longer.publisher_count()),
        (2, 0, 0)
    );

    let slots = [(); 2].map(|()| participant.claim_slot().unwrap());
    let mut offered = publisher.as_ref().monitor(&slots[0]);
    let mut requested = other.as_ref().monitor(&slots[1]);
    assert_eq!(offered.changes().incompatible_type.map(|found| found.total_count), Some(2));
    let changes = requested.changes(0);
    assert_eq!(changes.incompatible_type.map(|found| found.total_count), Some(1));
    assert_eq!((changes.matched, changes.incompatible_qos), (None, None));
    let seat = participant.doorbell().claim_sampler().unwrap();
    seat.drain(|_| {});
    let _longer = participant.create_publisher::<Longer>("/typed", Qos::default(), LIMITS).unwrap();
    let mut rung = Vec::new();
    seat.drain(|slot| rung.push(slot));
    assert!(rung.contains(&slots[1].index()), "{rung:?}");
    let found = requested.changes(0).incompatible_type.unwrap();
    assert_eq!((found.total_count, found.total_count_change), (2, 1));
    assert!(participant.topic_type("/typed").unwrap().is_none(), "they disagree");
}

#[test]
fn domains_are_apart() {
    let (here, there) = (Participant::new(domain(138)).unwrap(), Participant::new(domain(139)).unwrap());
    let (publisher, subscription) = ends::<Count>(&here, "/same", Qos::default());
    let stranger = there.create_subscription::<Other>("/same", Qos::default(), LIMITS).unwrap();
    publisher.publish(&Count { n: 1 }).unwrap();
    assert_eq!((publisher.subscription_count(), stranger.publisher_count()), (1, 0));
    assert!(stranger.try_take().unwrap().is_none());
    assert_eq!(take_all(&subscription), [1]);
    assert!(Participant::new(233).err().unwrap().to_string().contains("232"));
}

#[test]
fn loans_run_out_and_come_back() {
    let participant = Participant::new(domain(140)).unwrap();
    let limits = Limits { loans: 2, ..LIMITS };
    let publisher = participant.create_publisher::<Count>("/loans", Qos::default(), limits).unwrap();
    let subscription = participant.create_subscription::<Count>("/loans", Qos::default(), limits).unwrap();
    for _ in 0..1000 {
        let (first, mut second) = (publisher.loan().unwrap(), publisher.loan().unwrap());
        assert_eq!(publisher.loan().err(), Some(LoanError::Exhausted));
        assert_eq!(publisher.publish(&Count { n: 0 }), Err(PublishError::Loan(LoanError::Exhausted)));
        second.n = 9;
        second.publish().unwrap();
        drop(first);
        assert_eq!(take_all(&subscription), [9]);
    }
    assert_eq!(subscription.counters().lost(), 0, "a loan that is dropped has no number");
}

#[test]
fn held_samples_run_out_and_come_back() {
    let participant = Participant::new(domain(141)).unwrap();
    let limits = Limits { held: 3, ..LIMITS };
    let publishers =
        [(); 2].map(|()| participant.create_publisher::<Count>("/held", Qos::default(), limits).unwrap());
    let subscription = participant.create_subscription::<Count>("/held", Qos::keep_last(4), limits).unwrap();
    for round in 0..100 {
        for n in 1..=4 {
            publishers[round % 2].publish(&Count { n }).unwrap();
        }
        let mut held: Vec<_> = (0..3).map(|_| subscription.try_take().unwrap().unwrap()).collect();
        assert_eq!(subscription.try_take().err(), Some(TakeError::TooManyHeld));
        // Dropped in another thread, in any order.
        let one = held.swap_remove(0);
        std::thread::spawn(move || drop(one)).join().unwrap();
        assert_eq!(subscription.try_take().unwrap().unwrap().n, 4);
        assert!(subscription.try_take().unwrap().is_none());
        let numbers: Vec<_> = held.iter().map(|sample| sample.n).collect();
        assert_eq!(numbers, [3, 2]);
    }
}

#[test]
fn a_held_sample_does_not_change() {
    let participant = Participant::new(domain(142)).unwrap();
    let publisher = participant.create_publisher::<Count>("/kept", Qos::default(), LIMITS).unwrap();
    let subscription = participant.create_subscription::<Count>("/kept", Qos::keep_last(1), LIMITS).unwrap();
    publisher.publish(&Count { n: 42 }).unwrap();
    let kept = subscription.try_take().unwrap().unwrap();
    for n in 0..10_000 {
        publisher.publish(&Count { n }).unwrap();
        take_all(&subscription);
        assert_eq!(kept.n, 42);
    }
    drop((publisher, subscription));
    assert_eq!(kept.n, 42, "also without its subscription and publisher");
}

/// Open files of this process.
fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

#[test]
fn a_thousand_publishers_and_a_thousand_subscriptions() {
    let participant = Participant::new(domain(143)).unwrap();
    let limits = Limits { held: 1, loans: 1, ..LIMITS };
    let qos = Qos::keep_last(1);
    // All of both on one topic is `cargo xtask bench domain`'s to measure.
    for (subscriptions, publishers) in [(1000, 3), (3, 1000), (100, 100)] {
        let subscriptions: Vec<_> = (0..subscriptions)
            .map(|_| participant.create_subscription::<Count>("/many", qos, limits).unwrap())
            .collect();
        let publishers: Vec<_> = (0..publishers)
            .map(|_| participant.create_publisher::<Count>("/many", qos, limits).unwrap())
            .collect();
        assert!(publishers.iter().all(|publisher| publisher.subscription_count() == subscriptions.len()));
        assert!(subscriptions.iter().all(|subscription| subscription.publisher_count() == publishers.len()));
        for (n, publisher) in publishers.iter().enumerate() {
            publisher.publish(&Count { n: n as u64 }).unwrap();
        }
        for subscription in &subscriptions {
            let mut taken = take_all(subscription);
            taken.sort();
            assert_eq!(taken, (0..publishers.len() as u64).collect::<Vec<_>>());
        }
    }
}

/// In the test below.
const PUBLISHERS: u64 = 50;

#[test]
fn a_thousand_subscriptions_in_four_processes() {
    let participant = Participant::new(domain(145)).unwrap();
    let publishers: Vec<_> = (0..PUBLISHERS)
        .map(|_| participant.create_publisher::<Count>("/many", Qos::keep_last(4), LIMITS).unwrap())
        .collect();
    let mut parts = [(); 4].map(|()| Part::start("250 subscriptions", 145));
    for part in &mut parts {
        assert_eq!(part.hear(), "ready");
    }
    for (n, publisher) in publishers.iter().enumerate() {
        wait_for("all subscriptions", || publisher.subscription_count() == 1000);
        publisher.publish(&Count { n: n as u64 }).unwrap();
    }
    for part in &mut parts {
        assert_eq!(part.hear(), "all taken");
    }
    for part in parts {
        assert!(part.end().success());
    }
    wait_for("the publishers to know", || {
        publishers.iter().all(|publisher| publisher.subscription_count() == 0)
    });
}

#[test]
fn two_participants_in_one_process() {
    let (one, two) = (Participant::new(domain(146)).unwrap(), Participant::new(domain(146)).unwrap());
    let publisher = one.create_publisher::<Count>("/two", Qos::default(), LIMITS).unwrap();
    let subscription = two.create_subscription::<Count>("/two", Qos::default(), LIMITS).unwrap();
    let sampler = two.doorbell().claim_sampler().unwrap();
    wait_for("the publisher", || subscription.publisher_count() == 1);
    sampler.drain(|_| ());
    publisher.publish(&Count { n: 3 }).unwrap();
    assert_eq!(sampler.drain(|_| ()), 1, "the subscription's participant is the one that is rung");
    assert_eq!(take_all(&subscription), [3]);
    drop(one);
    publisher.publish(&Count { n: 4 }).unwrap();
    assert_eq!(take_all(&subscription), [4], "a publisher keeps its participant");
}

/// The other participant's janitor connects the subscription, in a thread of its own, while this one waits for that.
#[test]
fn a_subscription_gets_what_is_published_once_it_is_made() {
    let (one, two) = (Participant::new(domain(146)).unwrap(), Participant::new(domain(146)).unwrap());
    let publisher = one.create_publisher::<Count>("/made", Qos::default(), LIMITS).unwrap();
    for n in 0..2000 {
        let subscription = two.create_subscription::<Count>("/made", Qos::default(), LIMITS).unwrap();
        wait_for("the publisher", || subscription.publisher_count() == 1);
        publisher.publish(&Count { n }).unwrap();
        assert_eq!(take_all(&subscription), [n]);
    }
}

#[test]
fn publisher_and_subscription_move_between_threads() {
    let participant = Participant::new(domain(147)).unwrap();
    let (mut publisher, mut subscription) = ends::<Count>(&participant, "/move", Qos::default());
    let mut held = None;
    for n in 0..100u64 {
        let expected = n.checked_sub(1);
        (publisher, subscription, held) = std::thread::spawn(move || {
            // Taken in the thread before, read and dropped here.
            assert_eq!(held.map(|sample: tautline_transport::Sample<Count>| sample.n), expected);
            publisher.publish(&Count { n }).unwrap();
            let sample = subscription.try_take().unwrap();
            (publisher, subscription, sample)
        })
        .join()
        .unwrap();
    }
    assert_eq!(held.unwrap().n, 99);
}

#[test]
fn a_loan_is_always_a_valid_message() {
    let participant = Participant::new(domain(148)).unwrap();
    let (publisher, subscription) = ends::<Flag>(&participant, "/flag", Qos::default());
    assert_eq!(*publisher.loan().unwrap(), Flag { n: 0, raised: false });
    for n in 0..1000 {
        let mut loan = publisher.loan().unwrap();
        *loan = Flag { n, raised: n % 3 == 0 };
        loan.publish().unwrap();
        assert_eq!(*subscription.try_take().unwrap().unwrap(), Flag { n, raised: n % 3 == 0 });
    }
    assert_eq!(subscription.counters().invalid(), 0);
}

#[test]
fn keep_all_gives_the_loan_back() {
    let participant = Participant::new(domain(149)).unwrap();
    let (publisher, subscription) = ends::<Count>(&participant, "/all", Qos::keep_all(3));
    let last = participant.create_subscription::<Count>("/all", Qos::keep_last(1), LIMITS).unwrap();
    for n in 1..=3 {
        publisher.publish(&Count { n }).unwrap();
    }
    let mut loan = publisher.loan().unwrap();
    loan.n = 4;
    for _ in 0..10 {
        loan = match loan.publish() {
            Err(SendError { error: PublishError::Full, loan }) => loan,
            other => panic!("{other:?}"),
        };
        assert_eq!(loan.n, 4, "untouched");
    }
    assert_eq!(take_all(&last), [3], "a refused sample reached nobody");
    assert_eq!(publisher.publish(&Count { n: 5 }), Err(PublishError::Full));
    assert_eq!(subscription.try_take().unwrap().unwrap().n, 1);
    loan.publish().unwrap();
    assert_eq!(take_all(&subscription), [2, 3, 4]);
    assert_eq!((subscription.counters().lost(), subscription.counters().max_queue()), (0, 3));

    for n in 6..=8 {
        publisher.publish(&Count { n }).unwrap();
    }
    assert_eq!(publisher.publish(&Count { n: 9 }), Err(PublishError::Full));
    drop(subscription);
    publisher.publish(&Count { n: 9 }).expect("who has gone does not count");
}

#[test]
fn another_participants_thread_is_not_woken_directly() {
    // Their slots have the same numbers.
    let [here, there] = [(); 2].map(|()| Participant::new(domain(58)).unwrap());
    let seats = [&here, &there].map(|participant| participant.doorbell().claim_sampler().unwrap());
    let subscribe = |participant: &Participant| {
        participant.create_subscription::<Count>("/two", Qos::keep_last(4), LIMITS).unwrap()
    };
    let subscriptions = [subscribe(&here), subscribe(&there)];
    let publisher = here.create_publisher::<Count>("/two", Qos::keep_last(4), LIMITS).unwrap();
    let rung = || [&seats[0], &seats[1]].map(|seat| seat.drain(|_| {}));
    let bell = there.doorbell().claim_thread_bell().unwrap();
    subscriptions[0].as_ref().wake_thread(Some(&bell));
    rung();
    publisher.publish(&Count { n: 1 }).unwrap();
    assert_eq!(rung(), [1, 1], "both samplers");
    subscriptions[1].as_ref().wake_thread(Some(&bell));
    publisher.publish(&Count { n: 2 }).unwrap();
    assert_eq!(rung(), [1, 0], "one sampler, and the thread that is its participant's");
    bell.wait(std::time::Duration::ZERO);
    drop((publisher, subscriptions, bell, seats, here, there));
    clean(58);
}

#[test]
fn a_backlog_is_taken_without_further_rings() {
    let participant = Participant::new(domain(229)).unwrap();
    let seat = participant.doorbell().claim_sampler().unwrap();
    let (publisher, subscription) = ends::<Count>(&participant, "/backlog", Qos::keep_last(8));
    let publish = |n| publisher.publish(&Count { n }).unwrap();
    let mut context = std::task::Context::from_waker(std::task::Waker::noop());
    let mut take = || match subscription.poll_take(&mut context) {
        std::task::Poll::Ready(sample) => sample.map(|sample| sample.n),
        std::task::Poll::Pending => None,
    };
    assert_eq!(take(), None);
    seat.drain(|_| {});

    publish(1);
    assert_eq!(seat.drain(|_| {}), 1, "rung for the first");
    publish(2);
    assert_eq!(take(), Some(1));
    publish(3);
    assert_eq!(seat.drain(|_| {}), 1, "and while nothing shows that there is more than one");
    assert_eq!(take(), Some(2));
    publish(4);
    assert_eq!(seat.drain(|_| {}), 0, "not while what waits is taken");
    assert_eq!([take(), take(), take()], [Some(3), Some(4), None]);
    publish(5);
    assert_eq!(seat.drain(|_| {}), 1, "and again once all was taken");
    assert_eq!([take(), take()], [Some(5), None]);

    // Who goes on without polling comes to the end, too.
    (6..=8).for_each(publish);
    assert_eq!([take(), take()], [Some(6), Some(7)]);
    seat.drain(|_| {});
    assert_eq!(subscription.try_take().unwrap().unwrap().n, 8);
    assert!(subscription.try_take().unwrap().is_none());
    publish(9);
    assert_eq!(seat.drain(|_| {}), 1);
    drop((publisher, subscription, seat, participant));
    clean(229);
}

#[test]
fn a_burst_arrives_in_order_and_says_how_far_it_came() {
    let participant = Participant::new(domain(145)).unwrap();
    let counts = |numbers: std::ops::Range<u64>| numbers.map(|n| Count { n }).collect::<Vec<_>>();
    // Beyond the queue, as messages published one by one: the oldest are overwritten, and counted.
    let (publisher, subscription) = ends(&participant, "/bursts", Qos::keep_last(4));
    assert_eq!(publisher.publish_many(&[]), Ok(0));
    assert!(!AsRef::<tautline_transport::RawSubscription>::as_ref(&subscription).has_samples());
    assert_eq!(publisher.publish_many(&counts(0..3)), Ok(3));
    assert_eq!(take_all(&subscription), [0, 1, 2]);
    assert_eq!(publisher.publish_many(&counts(3..13)), Ok(10));
    assert_eq!(take_all(&subscription), [9, 10, 11, 12]);
    let counters = subscription.counters();
    assert_eq!((counters.received(), counters.lost(), counters.max_queue()), (7, 6, 4));
    // Nothing is overwritten where both keep all: those before the first for which there is no room were published.
    let (publisher, subscription) = ends(&participant, "/kept", Qos::keep_all(4));
    let refused = publisher.publish_many(&counts(0..10)).unwrap_err();
    assert_eq!((refused.published, refused.error), (4, PublishError::Full));
    assert!(refused.to_string().ends_with("(the 4 messages before that one were published)"), "{refused}");
    assert_eq!(take_all(&subscription), [0, 1, 2, 3]);
    assert_eq!(publisher.publish_many(&counts(4..8)), Ok(4));
    assert_eq!((take_all(&subscription), subscription.counters().lost()), (vec![4, 5, 6, 7], 0));
}

/// A callback may publish on the topic that it is subscribed to.
#[test]
fn each_message_taken_from_a_keep_all_queue_is_room_for_another() {
    let participant = Participant::new(domain(145)).unwrap();
    let qos = Qos::keep_all(80);
    let publisher = participant.create_publisher::<Count>("/at_a_time", qos, LIMITS).unwrap();
    // Twice: what a subscription had taken out of its queue when it went comes back, too.
    for _ in 0..2 {
        let subscription = participant.create_subscription::<Count>("/at_a_time", qos, LIMITS).unwrap();
        let raw: &tautline_transport::RawSubscription = subscription.as_ref();
        let take = || subscription.try_take().unwrap().map(|sample| sample.n);
        let publish = |n| publisher.publish(&Count { n });
        (0..80).for_each(|n| publish(n).unwrap());
        // The subscription takes an eighth of the depth out of its queue at a time.
        for n in 0..8 {
            assert_eq!((publish(80 + n), take()), (Err(PublishError::Full), Some(n)));
            assert_eq!((raw.has_samples(), raw.waiting()), (true, 79));
            publish(80 + n).unwrap();
        }
        assert_eq!(publish(88), Err(PublishError::Full));
        assert_eq!((8..88).find(|n| take() != Some(*n)), None);
        assert_eq!((take(), raw.has_samples(), publish(88)), (None, false, Ok(())));
        assert_eq!((take(), publish(89), publish(90), take()), (Some(88), Ok(()), Ok(()), Some(89)));
        let counters = subscription.counters();
        assert_eq!((counters.received(), counters.lost(), counters.max_queue()), (90, 0, 80));
    }
}

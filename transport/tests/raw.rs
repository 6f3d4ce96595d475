// SPDX-License-Identifier: MIT OR Apache-2.0
//! Topics of bytes: any length, in place, growing; beside typed ends; relayed from other hosts; types that must agree.

mod support;

use rand::RngExt;
use std::collections::VecDeque;
use support::{
    Count, Part, claimed, clean, domain, place_of, say, wait_for, wait_for_some, wait_for_the_end,
};
use tautline_msgs::Message;
use tautline_transport::{
    Claim, Gid, Limits, LoanError, MessageInfo, Participant, PublishError, Qos, RawSample, RawSubscription,
    TakeError, TopicType, TransportError,
};

const TEXT: &str = "test_msgs/msg/Text";

#[derive(Message, Clone, Copy, Debug)]
#[message(name = "test_msgs/msg/Flag", crate = "tautline_msgs")]
#[repr(C)]
struct Flag {
    n: u32,
    raised: bool,
}

fn limits(message_bytes: usize) -> Limits {
    Limits { message_bytes, ..Limits::default() }
}

/// A body of which every byte is its number.
fn body(len_bytes: usize, n: u8) -> Vec<u8> {
    vec![n; len_bytes]
}

fn take(subscription: &RawSubscription) -> Option<RawSample> {
    subscription.try_take().unwrap()
}

/// As soon as there is one: a segment that another process made is mapped by the janitor.
fn await_sample(subscription: &RawSubscription) -> RawSample {
    wait_for_some("a sample", || take(subscription))
}

/// The child's part of the tests here; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    let text = TopicType::new(TEXT);
    match part.as_str() {
        "publisher" => {
            let publisher =
                participant.create_raw_publisher("/text", &text, Qos::default(), limits(64)).unwrap();
            for n in 0..8 {
                let mut loan = publisher.loan(50 << n).unwrap();
                loan.copy_from_slice(&body(50 << n, n));
                let place = place_of(loan.as_ptr());
                loan.publish().unwrap();
                say(&format!("{} {} {}", place.path, place.inode, place.offset));
            }
            say(&format!("{} {:?}", std::process::id(), publisher.gid()));
            wait_for_the_end();
        }
        other => panic!("no part {other}"),
    }
}

#[test]
fn raw_and_typed_ends_share_a_topic() {
    let participant = Participant::new(domain(170)).unwrap();
    let count = TopicType::new(Count::TYPE_NAME);
    let (qos, limits) = (Qos::default(), Limits::default());
    let typed = participant.create_publisher::<Count>("/count", qos, limits).unwrap();
    let raw = participant.create_raw_publisher("/count", &count, qos, limits).unwrap();
    let typed_in = participant.create_subscription::<Count>("/count", qos, limits).unwrap();
    let raw_in = participant.create_raw_subscription("/count", &count, qos, limits).unwrap();
    typed.publish(&Count { n: 0x0102 }).unwrap();
    assert_eq!(take(&raw_in).unwrap().body(), [2, 1, 0, 0, 0, 0, 0, 0]);
    assert_eq!(typed_in.try_take().unwrap().unwrap().n, 0x0102);

    raw.publish(&7u64.to_le_bytes()).unwrap();
    let sample = typed_in.try_take().unwrap().unwrap();
    assert_eq!((sample.n, sample.as_ref().body()), (7, &7u64.to_le_bytes()[..]));
    assert_eq!(sample.info().publisher_gid, raw.gid());
    // Too short is published, and is no message; too long does not fit where the size is known.
    raw.publish(&[1; 5]).unwrap();
    assert!(matches!(typed_in.try_take(), Err(TakeError::Invalid(_))));
    assert_eq!(typed_in.counters().invalid(), 1);
    let sized = participant.create_raw_publisher("/count", &count.with_body_bytes(8), qos, limits).unwrap();
    assert_eq!(sized.publish(&[0; 9]), Err(PublishError::Loan(LoanError::TooLarge)));
    assert_eq!((raw.counters().growths(), sized.counters().growths()), (0, 0));
}

#[test]
fn a_body_has_its_length_its_alignment_and_a_zeroed_tail() {
    let participant = Participant::new(domain(171)).unwrap();
    let text = TopicType::new(TEXT);
    let publisher = participant.create_raw_publisher("/text", &text, Qos::default(), limits(64)).unwrap();
    let subscription =
        participant.create_raw_subscription("/text", &text, Qos::default(), limits(64)).unwrap();
    for len_bytes in [64, 1, 63, 0, 8, 17] {
        let mut loan = publisher.loan(len_bytes).unwrap();
        assert_eq!((loan.len(), loan.as_ptr().align_offset(8)), (len_bytes, 0));
        loan.fill(0xff);
        loan.publish().unwrap();
        let sample = take(&subscription).unwrap();
        assert_eq!(sample.body(), vec![0xff; len_bytes]);
        assert_eq!(sample.body().as_ptr().align_offset(8), 0);
    }
    let fixed = Limits { may_grow: false, ..limits(64) };
    let confined = participant.create_raw_publisher("/text", &text, Qos::default(), fixed).unwrap();
    assert_eq!(confined.publish(&[1; 64]), Ok(()));
    assert_eq!(confined.publish(&[1; 65]), Err(PublishError::Loan(LoanError::TooLarge)));
    assert_eq!(publisher.loan(usize::MAX).err(), Some(LoanError::TooLarge));
    assert_eq!(publisher.loan(Limits::MAX_MESSAGE_BYTES + 1).err(), Some(LoanError::TooLarge));
    for message_bytes in [0, Limits::MAX_MESSAGE_BYTES + 1] {
        let refused = participant.create_raw_publisher("/text", &text, Qos::default(), limits(message_bytes));
        assert!(matches!(refused, Err(TransportError::LimitRange { limit: "message_bytes", .. })));
    }
}

/// A take that comes before the janitor has mapped a new segment has the sample out of the queue, and it is there nevertheless.
#[test]
fn publishers_have_turns_unless_the_oldest_sample_is_asked_for() {
    let participant = Participant::new(domain(171)).unwrap();
    let text = TopicType::new(TEXT);
    let qos = Qos::keep_all(9);
    let publish = || participant.create_raw_publisher("/turns", &text, qos, limits(1)).unwrap();
    let publishers = [publish(), publish()];
    let subscription = participant.create_raw_subscription("/turns", &text, qos, limits(1)).unwrap();
    for order in [[0, 1, 1, 0, 0, 1], [1, 0, 0, 1, 1, 0]] {
        for is_asked in [false, true] {
            for (n, publisher) in (0..).zip(order) {
                publishers[publisher].publish(&[n]).unwrap();
            }
            let next = || {
                if is_asked {
                    subscription.turn_to_oldest();
                }
                take(&subscription).map(|sample| sample.body()[0])
            };
            let taken: Vec<_> = std::iter::from_fn(next).collect();
            assert_eq!(taken == [0, 1, 2, 3, 4, 5], is_asked, "{order:?}: {taken:?}");
        }
    }
}

#[test]
fn a_sample_that_could_not_be_reached_yet_is_seen_to_be_there() {
    let domain = domain(172);
    let (here, there) = (Participant::new(domain).unwrap(), Participant::new(domain).unwrap());
    let text = TopicType::new(TEXT);
    let publisher = here.create_raw_publisher("/seen", &text, Qos::default(), limits(64)).unwrap();
    let subscription = there.create_raw_subscription("/seen", &text, Qos::default(), limits(64)).unwrap();
    wait_for("a connection", || publisher.subscription_count() == 1 && subscription.publisher_count() == 1);
    let mut unreached = 0;
    for n in 0..12 {
        publisher.publish(&body(100 << n, n)).unwrap();
        // Taken at once, or only asked for.
        let found = if n % 2 == 0 { take(&subscription) } else { None };
        unreached += u32::from(found.is_none());
        let sample = found.unwrap_or_else(|| {
            wait_for("a sample that is seen", || subscription.has_samples());
            take(&subscription).expect("what is seen can be taken")
        });
        assert_eq!(sample.body(), body(100 << n, n));
        drop(sample);
        assert!(!subscription.has_samples() && subscription.waiting() == 0);
        let waiting = u64::from(n) % 3;
        (0..waiting).for_each(|_| publisher.publish(&[1]).unwrap());
        assert_eq!(subscription.waiting(), waiting);
        (0..waiting).for_each(|_| assert!(take(&subscription).is_some()));
    }
    println!("{unreached} of 12 were not taken at once: 6 were only asked for");
}

#[test]
fn samples_stay_readable_while_the_memory_grows() {
    const DOMAIN: u32 = 172;
    let mut random = tautline_seed::random();
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let text = TopicType::new(TEXT);
    let publisher = participant.create_raw_publisher("/text", &text, Qos::default(), limits(100)).unwrap();
    let subscription =
        participant.create_raw_subscription("/text", &text, Qos::keep_last(10), limits(100)).unwrap();
    let first = claimed(DOMAIN);
    let loans: Vec<_> = (0..limits(100).loans).map(|_| publisher.loan(100).unwrap()).collect();
    assert_eq!(publisher.loan(1000).err(), Some(LoanError::Exhausted));
    assert_eq!(publisher.counters().growths(), 0, "refused, so nothing grew");
    drop(loans);
    let (mut held, mut waiting, mut largest) = (VecDeque::new(), VecDeque::new(), 0);
    for n in 0..2000usize {
        // Up to 100, then ever larger, to 1 MB.
        let most = if n < 1000 { 100 } else { 100 + (n - 1000) * 1000 };
        let len_bytes = random.random_range(0..=most);
        largest = largest.max(len_bytes);
        publisher.publish(&body(len_bytes, n as u8)).unwrap();
        waiting.push_back((len_bytes, n as u8));
        if n == 999 {
            assert_eq!((publisher.counters().growths(), claimed(DOMAIN)), (0, first));
        }
        if waiting.len() == 10 || random.random_ratio(1, 3) {
            while waiting.len() > random.random_range(0..10) {
                // Held as long as may be: three are, while the fourth is taken.
                if held.len() == 3 {
                    held.pop_front();
                }
                let sample = take(&subscription).unwrap();
                held.push_back((sample, waiting.pop_front().unwrap()));
            }
        }
        for (sample, (len_bytes, n)) in &held {
            assert!(sample.body() == body(*len_bytes, *n), "sample {n} of {len_bytes} bytes");
        }
    }
    let growths = publisher.counters().growths();
    println!("{growths} growths to {largest} bytes");
    assert!((8..=14).contains(&growths), "from 100 to {largest} bytes by powers of two: {growths}");
    let counters = subscription.counters();
    assert_eq!((counters.lost(), counters.invalid(), counters.refused()), (0, 0, 0));
    // Old segments go with their last sample: what is left is one of ten queued, four held and four loaned.
    held.clear();
    while take(&subscription).is_some() {}
    publisher.publish(&[1]).unwrap();
    publisher.publish(&[2]).unwrap();
    drop(participant.create_raw_subscription("/text", &text, Qos::keep_last(10), limits(100)).unwrap());
    let last = 22 * ((largest + 64).next_power_of_two() as u64 + 4096);
    assert!(claimed(DOMAIN) < first + last, "{} of {last}", claimed(DOMAIN));
    drop((publisher, subscription));
    assert!(claimed(DOMAIN) <= first, "{} of {first}", claimed(DOMAIN));
}

#[test]
fn a_loan_of_any_size_is_read_where_another_process_wrote_it() {
    let participant = Participant::new(domain(173)).unwrap();
    let text = TopicType::new(TEXT);
    let limits = Limits { held: 9, ..limits(64) };
    let subscription = participant.create_raw_subscription("/text", &text, Qos::default(), limits).unwrap();
    let late = participant.create_raw_subscription("/text", &text, Qos::default(), limits).unwrap();
    let mut part = Part::start("publisher", 173);
    let mut held = Vec::new();
    for n in 0..8 {
        let written = part.hear();
        if n == 0 {
            await_sample(&late);
        }
        let sample = await_sample(&subscription);
        let read = place_of(sample.body().as_ptr());
        assert_eq!(format!("{} {} {}", read.path, read.inode, read.offset), written);
        assert!(read.path.starts_with("/dev/shm/taut_173_"), "{read:?}");
        held.push((n, sample));
    }
    part.hear();
    part.kill();
    wait_for("the janitor", || subscription.publisher_count() == 0);
    assert!(take(&subscription).is_none());
    for (n, sample) in held {
        assert!(sample.body() == body(50 << n, n), "a held sample outlives its publisher and its segment");
    }
    // Who took only one before the kill gets what was mapped by then, and counts what was not.
    let counters = late.counters();
    wait_for("all to be received or lost", || {
        while take(&late).is_some() {}
        counters.received() + counters.lost() == 8
    });
    println!("one taken before the kill: {} received, {} lost", counters.received(), counters.lost());
    drop((subscription, late, participant));
    clean(173);
}

#[test]
fn names_hashes_and_sizes_must_agree_where_they_are_known() {
    let participant = Participant::new(domain(174)).unwrap();
    let hash = |digit: &str| format!("RIHS01_{}", digit.repeat(64));
    let known = TopicType::new(TEXT).with_hash(hash("a")).with_body_bytes(12);
    let (qos, limits) = (Qos::default(), Limits::default());
    let publisher = participant.create_raw_publisher("/text", &known, qos, limits).unwrap();
    for (other, matches) in [
        (known.clone(), true),
        (TopicType::new(TEXT), true),
        (TopicType::new(TEXT).with_hash(hash("a")), true),
        (known.clone().with_hash(hash("b")), false),
        (known.clone().with_body_bytes(16), false),
        (TopicType::new("test_msgs/msg/Other"), false),
    ] {
        let subscription = participant.create_raw_subscription("/text", &other, qos, limits).unwrap();
        assert_eq!(publisher.subscription_count(), usize::from(matches), "{other:?}");
        publisher.publish(&[1; 12]).unwrap();
        assert_eq!(take(&subscription).is_some(), matches, "{other:?}");
    }
    for bad in ["RIHS01_", "../../../etc/passwd"] {
        let bad_type = known.clone().with_hash(bad.to_owned());
        let refused = participant.create_raw_subscription("/text", &bad_type, qos, limits);
        let text = refused.err().unwrap().to_string();
        assert!(text.contains(bad) && text.contains("/text"), "{text}");
    }
}

#[test]
fn relayed_messages_keep_their_origin_and_losses_stay_the_ports() {
    let participant = Participant::new(domain(175)).unwrap();
    let text = TopicType::new(TEXT);
    let open = |depth| {
        participant.create_raw_subscription("/text", &text, Qos::keep_all(depth), limits(64)).unwrap()
    };
    let publisher = participant.create_raw_publisher("/text", &text, Qos::keep_all(3), limits(64)).unwrap();
    let subscription = open(3);
    let last = participant.create_raw_subscription("/text", &text, Qos::keep_last(1), limits(64)).unwrap();
    let source = |gid: u8, sequence_number: u64| MessageInfo {
        sequence_number,
        source_timestamp_ns: -5,
        released_ns: 1,
        publisher_gid: Gid([gid; 16]),
    };
    // Of two remote publishers, with gaps, twice the same, backwards; and one of its own.
    let sent = [source(1, 10), source(2, 7), source(1, 500), source(1, 500), source(2, 3), source(1, 501)];
    for (n, info) in sent.iter().enumerate() {
        let publish = || {
            let mut loan = publisher.loan(1).unwrap();
            loan[0] = n as u8;
            loan.publish_as(*info)
        };
        publish().unwrap();
        let sample = take(&subscription).unwrap();
        let seen = sample.info();
        assert_eq!(sample.body(), [n as u8]);
        assert_eq!((seen.sequence_number, seen.publisher_gid), (info.sequence_number, info.publisher_gid));
        assert_eq!((seen.source_timestamp_ns, sample.port_gid()), (-5, publisher.gid()));
        assert!(seen.released_ns > 1_000, "released here");
    }
    publisher.publish(&[9]).unwrap();
    let own = take(&subscription).unwrap().info();
    assert_eq!((own.sequence_number, own.publisher_gid), (7, publisher.gid()));
    assert_eq!((subscription.counters().lost(), subscription.counters().received()), (0, 7));
    assert_eq!(take(&last).unwrap().body(), [9]);
    assert_eq!(last.counters().lost(), 6, "what it did not take");
    // Of a recording: as it was, but of this publisher, and released when it says.
    for (number, seen) in [(70, 70), (0, 9)] {
        publisher.loan(0).unwrap().publish_again(source(1, number)).unwrap();
        let again = take(&subscription).unwrap().info();
        assert_eq!(again, MessageInfo { publisher_gid: publisher.gid(), ..source(1, seen) });
    }
    assert_eq!(subscription.counters().lost(), 0);
    // A full queue is seen as well.
    for n in 0..3 {
        publisher.loan(0).unwrap().publish_as(source(3, n)).unwrap();
    }
    assert_eq!(publisher.publish(&[]), Err(PublishError::Full));
    assert_eq!(take(&subscription).unwrap().info().sequence_number, 0);
    publisher.publish(&[]).unwrap();
}

#[test]
fn late_joiners_get_messages_of_any_size_and_origin() {
    let participant = Participant::new(domain(176)).unwrap();
    let text = TopicType::new(TEXT);
    let qos = Qos::keep_last(6).transient_local();
    let publisher = participant.create_raw_publisher("/text", &text, qos, limits(16)).unwrap();
    let lengths = [5, 100, 3000, 0, 70_000, 9];
    for (n, &len_bytes) in lengths.iter().enumerate() {
        let mut loan = publisher.loan(len_bytes).unwrap();
        loan.copy_from_slice(&body(len_bytes, n as u8));
        let publisher_gid = Gid([n as u8; 16]);
        let info = MessageInfo { sequence_number: 40, publisher_gid, ..MessageInfo::default() };
        loan.publish_as(info).unwrap();
    }
    for round in 0..2 {
        let subscription = participant.create_raw_subscription("/text", &text, qos, limits(16)).unwrap();
        for (n, &len_bytes) in lengths.iter().enumerate() {
            let sample = wait_for_some("the history", || take(&subscription));
            assert!(sample.body() == body(len_bytes, n as u8), "round {round}, message {n}");
            assert_eq!(sample.info().publisher_gid, Gid([n as u8; 16]));
            assert_eq!(sample.port_gid(), publisher.gid());
        }
        assert!(take(&subscription).is_none());
        assert_eq!((subscription.counters().lost(), subscription.counters().invalid()), (0, 0));
    }
}

#[test]
fn topics_are_listed_with_their_ends() {
    const DOMAIN: u32 = 177;
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let other = Participant::new(domain(DOMAIN)).unwrap();
    let epoch = participant.graph_epoch();
    assert!(participant.topics().unwrap().is_empty());
    assert_eq!(participant.wait_for_graph_change(epoch, std::time::Duration::ZERO), epoch);

    let hash = format!("RIHS01_{}", "c".repeat(64));
    let known = TopicType::new("test_msgs/msg/Known").with_hash(hash).with_body_bytes(12);
    let latched = Qos::keep_last(3).transient_local();
    let publisher = participant.create_raw_publisher("/a", &known, latched, Limits::default()).unwrap();
    let _subscription =
        other.create_raw_subscription("/a", &known, latched.best_effort(), Limits::default()).unwrap();
    let mut part = Part::start("publisher", DOMAIN);
    (0..8).for_each(|_| drop(part.hear()));
    let (pid, gid) = part.hear().split_once(' ').map(|(pid, gid)| (pid.to_owned(), gid.to_owned())).unwrap();

    let epoch_before = participant.graph_epoch();
    assert_ne!(epoch_before, epoch);
    let topics = participant.topics().unwrap();
    let names: Vec<_> = topics.iter().map(|topic| topic.name.as_str()).collect();
    assert_eq!(names, ["/a", "/text"], "sorted, and nothing of how it works inside");
    let [publisher_info] = &topics[0].publishers[..] else { panic!("{topics:?}") };
    let [subscription_info] = &topics[0].subscriptions[..] else { panic!("{topics:?}") };
    assert_eq!(participant.topic_type("/a").unwrap(), Some(known));
    assert_eq!((publisher_info.gid, publisher_info.qos), (publisher.gid(), latched));
    assert_eq!((publisher_info.pid, publisher_info.is_own), (Some(std::process::id()), true));
    assert_eq!((subscription_info.qos, subscription_info.is_own), (latched.best_effort(), false));
    let [remote] = &topics[1].publishers[..] else { panic!("{topics:?}") };
    assert_eq!((format!("{:?}", remote.gid), remote.pid.unwrap().to_string()), (gid, pid));
    assert!(!remote.is_own && topics[1].subscriptions.is_empty());
    assert_eq!(participant.graph_epoch(), epoch_before, "looking changes nothing");

    // Whoever sleeps on the epoch is woken by an end, also of one that was killed.
    drop(publisher);
    assert_ne!(participant.graph_epoch(), epoch_before);
    let epoch = participant.graph_epoch();
    part.kill();
    let half_a_minute = std::time::Duration::from_secs(30);
    let after = participant.wait_for_graph_change(epoch, half_a_minute);
    assert_ne!(after, epoch);
    assert!(participant.topics().unwrap().iter().all(|topic| topic.name != "/text"));
    drop((participant, other, _subscription));
    clean(DOMAIN);
}

#[test]
fn random_bytes_are_counted_as_invalid_or_read() {
    let mut random = tautline_seed::random();
    let participant = Participant::new(domain(178)).unwrap();
    let limits = limits(64);
    // The topic is made by one that knows no size, so that every length goes through.
    let unknown = TopicType::new(Flag::TYPE_NAME);
    let publisher = participant.create_raw_publisher("/flag", &unknown, Qos::default(), limits).unwrap();
    let subscription = participant.create_subscription::<Flag>("/flag", Qos::keep_last(1), limits).unwrap();
    let (mut read, mut refused) = (0, 0);
    for _ in 0..20_000 {
        let len_bytes = random.random_range(0..24);
        let mut bytes: Vec<u8> = (0..len_bytes).map(|_| random.random()).collect();
        if let Some(raised) = bytes.get_mut(4).filter(|_| random.random_ratio(1, 2)) {
            *raised %= 2;
        }
        publisher.publish(&bytes).unwrap();
        let fits = (5..=13).contains(&len_bytes) && bytes[4] < 2;
        match subscription.try_take() {
            Ok(Some(flag)) => {
                assert!(fits, "{bytes:?}");
                assert_eq!((flag.n.to_le_bytes().as_slice(), u8::from(flag.raised)), (&bytes[..4], bytes[4]));
                read += 1;
            }
            Err(TakeError::Invalid(_)) => {
                assert!(!fits, "{bytes:?}");
                refused += 1;
            }
            other => panic!("{other:?}"),
        }
    }
    println!("{read} read, {refused} refused");
    assert!(read > 1000 && subscription.counters().invalid() == refused);
}

/// A sample of this size has a page of its own and more: there are as many as were asked for.
const PAGE: usize = 4096;

#[test]
fn samples_of_many_loans_all_come_back() {
    let participant = Participant::new(domain(179)).unwrap();
    let topic_type = TopicType::new(TEXT).with_body_bytes(PAGE);
    let limits = Limits { held: 1, loans: 4, ..Limits::default() };
    let qos = Qos::keep_last(1);
    let publisher = participant.create_raw_publisher("/loans", &topic_type, qos, limits).unwrap();
    let subscription = participant.create_raw_subscription("/loans", &topic_type, qos, limits).unwrap();
    for round in 0..100 {
        let loans = [(); 4].map(|()| publisher.loan(PAGE).unwrap_or_else(|error| panic!("{round}: {error}")));
        for loan in loans {
            loan.publish().unwrap();
            drop(take(&subscription).unwrap());
        }
    }
}

#[test]
fn the_queue_of_one_that_has_gone_takes_no_memory_from_the_others() {
    let participant = Participant::new(domain(179)).unwrap();
    // Long enough that none is made to spare.
    let len = 256 << 10;
    let topic_type = TopicType::new(TEXT).with_body_bytes(len);
    let (limits, qos) = (Limits { held: 1, loans: 1, ..Limits::default() }, Qos::keep_last(10));
    let publisher = participant.create_raw_publisher("/gone", &topic_type, qos, limits).unwrap();
    let subscribe = || participant.create_raw_subscription("/gone", &topic_type, qos, limits).unwrap();
    let (stays, mut left) = (subscribe(), Vec::new());
    for _ in 0..3 {
        let goes = subscribe();
        publisher.publish(&vec![0; len]).unwrap();
        left.push(take(&goes).unwrap());
        for _ in 0..10 {
            publisher.publish(&vec![0; len]).expect("its queue is filled");
        }
        drop(goes);
        for _ in 0..25 {
            publisher.publish(&vec![0; len]).expect("what lies in the queue of one that has gone is extra");
        }
        while take(&stays).is_some() {}
    }
}

#[test]
fn samples_come_back_after_the_memory_was_made_anew() {
    let participant = Participant::new(domain(179)).unwrap();
    let topic_type = TopicType::new(TEXT);
    let limits = Limits { held: 1, loans: 1, message_bytes: 64, claim: Claim::OnUse, ..Limits::default() };
    let qos = Qos::keep_last(200);
    let publisher = participant.create_raw_publisher("/anew", &topic_type, qos, limits).unwrap();
    let subscribe = || participant.create_raw_subscription("/anew", &topic_type, qos, limits).unwrap();
    let first = subscribe();
    (0..150).for_each(|_| publisher.publish(&[1; 64]).unwrap());
    drop(first);
    // With this one all come back, and the next one's memory takes their place.
    publisher.publish(&[1; 64]).unwrap();
    publisher.publish(&[1; PAGE]).unwrap();
    let second = subscribe();
    for round in 0..6 {
        for n in 0..180 {
            let sent = publisher.publish(&[1; PAGE]);
            sent.unwrap_or_else(|error| panic!("round {round}, message {n}: {error}"));
        }
        while take(&second).is_some() {}
    }
}

#[test]
fn loans_never_want_memory_however_samples_are_held() {
    for topic_type in [TopicType::new(TEXT).with_body_bytes(PAGE), TopicType::new(TEXT)] {
        let mut random = tautline_seed::random();
        let participant = Participant::new(domain(179)).unwrap();
        let limits = Limits { held: 3, loans: 2, message_bytes: PAGE, ..Limits::default() };
        let publisher =
            participant.create_raw_publisher("/held", &topic_type, Qos::default(), limits).unwrap();
        let subscribe = |depth| {
            participant.create_raw_subscription("/held", &topic_type, Qos::keep_last(depth), limits).unwrap()
        };
        let mut subscriptions: Vec<_> = (0..5).map(|_| (subscribe(7), VecDeque::new())).collect();
        let (mut loan, mut left) = (None, VecDeque::new());
        for _ in 0..30_000 {
            let index = random.random_range(0..5);
            match random.random_range(0..100) {
                0..40 => {
                    // One loan is out most of the time: this is the second.
                    publisher.publish(&[1; PAGE]).expect("memory is sized for every case");
                    if loan.is_none() {
                        loan = Some(publisher.loan(PAGE).expect("memory is sized for every case"));
                    } else if random.random_ratio(1, 20) {
                        loan = None;
                    }
                }
                40..98 => {
                    let (subscription, held) = &mut subscriptions[index];
                    if held.len() == 3 {
                        held.remove(random.random_range(0..3));
                    }
                    held.extend(take(subscription));
                }
                _ => {
                    // It ends with samples in its queue and in its user's hands, which may stay there; another one takes its place.
                    left.push_back(subscriptions.remove(index).1);
                    left.truncate(random.random_range(0..=3));
                    subscriptions.push((subscribe(random.random_range(1..=7)), VecDeque::new()));
                }
            }
        }
        assert_eq!(publisher.counters().growths(), 0);
        drop(loan);
    }
}

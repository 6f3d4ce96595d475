// SPDX-License-Identifier: MIT OR Apache-2.0
//! What topics cost in memory, measured, and what `topic_memory` says. A file of its own: it measures the process.

mod support;

use support::{IMAGE_BYTES, Image, Part, claimed, domain, say};
use tautline_msgs::Message;
use tautline_transport::{Claim, Limits, Participant, Qos, TopicType, TransportError, topic_memory};

const MIB: u64 = 1 << 20;
/// For a topic of images.
const FEW: Limits = Limits { held: 1, loans: 1, spare_bytes: 8 << 20, ..support::LIMITS };

/// Each of a publisher's segments begins with a page, and there are the queues of its subscriptions.
fn margin() -> u64 {
    64 * page_bytes()
}

fn page_bytes() -> u64 {
    tautline_rt::shm::page_bytes() as u64
}

#[derive(Message, Clone, Copy)]
#[message(name = "test_msgs/msg/Eight", crate = "tautline_msgs")]
#[repr(C)]
struct Eight {
    n: [u64; 8],
}

/// The child's part; without its variable it is no test. A child for each measurement: a process of its own.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    match part.as_str() {
        "idle" => idle_topics(domain, &TopicType::of::<Eight>()),
        "idle texts" => idle_topics(domain, &TopicType::new("test_msgs/msg/Text")),
        "images" => images(domain, FEW),
        "images on use" => images(domain, Limits { claim: Claim::OnUse, ..FEW }),
        "locked images" => match tautline_rt::lock_memory(tautline_rt::MemoryLock::OnFault) {
            Ok(()) => images(domain, FEW),
            Err(error) => say(&format!("skipped: {error}")),
        },
        other => panic!("no part {other}"),
    }
}

/// Resident memory of this process in bytes: its own and of files. What is shared is counted as blocks.
fn resident() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = |name| status.lines().find_map(|line| line.strip_prefix(name)).unwrap().trim();
    let kib = |name| line(name).trim_end_matches(" kB").parse::<u64>().unwrap();
    println!("RssAnon {} RssFile {} RssShmem {} KiB", kib("RssAnon:"), kib("RssFile:"), kib("RssShmem:"));
    (kib("RssAnon:") + kib("RssFile:")) * 1024
}

fn idle_topics(domain: u32, topic_type: &TopicType) {
    let participant = Participant::new(domain).unwrap();
    let create = |n: usize| {
        let topic = format!("/idle_{n}");
        let (qos, limits) = (Qos::default(), Limits::default());
        let publisher = participant.create_raw_publisher(&topic, topic_type, qos, limits).unwrap();
        let subscription = participant.create_raw_subscription(&topic, topic_type, qos, limits).unwrap();
        (publisher, subscription)
    };
    // The first one brings in code and the allocator's first pages.
    let first = create(0);
    let before = (claimed(domain), resident());
    let topics: Vec<_> = (1..=20).map(create).collect();
    let after = (claimed(domain), resident());
    say(&format!("{} {}", after.0 - before.0, after.1.saturating_sub(before.1)));
    drop((first, topics));
}

/// Says what the publisher claims before a thousand messages, and after them.
fn images(domain: u32, limits: Limits) {
    let participant = Participant::new(domain).unwrap();
    let none = claimed(domain);
    let publisher = participant.create_publisher::<Image>("/image", Qos::default(), limits).unwrap();
    let subscriptions = [(); 3]
        .map(|()| participant.create_subscription::<Image>("/image", Qos::keep_last(10), limits).unwrap());
    let before = claimed(domain) - none;
    let mut held = [None, None, None];
    for n in 0..1000 {
        let mut loan = publisher.loan().unwrap();
        // Touches every page, as a message would.
        loan.data.iter_mut().step_by(4096).for_each(|byte| *byte = n as u8);
        loan.publish().unwrap();
        // Each holds one sample, of another age; the last one hardly ever takes.
        for (subscription, (held, every)) in subscriptions.iter().zip(held.iter_mut().zip([1, 7, 300])) {
            if n % every == 0 {
                *held = None;
                *held = subscription.try_take().unwrap();
            }
        }
    }
    say(&format!("{before} {}", claimed(domain) - none));
    drop(held);
    drop((publisher, subscriptions));
    assert!(claimed(domain) < none + margin(), "all of it is given back");
}

/// The numbers that a child says.
fn numbers(said: &str) -> Vec<u64> {
    said.split(' ').map(|number| number.parse().unwrap()).collect()
}

#[test]
fn twenty_idle_topics_cost_less_than_4_mib() {
    for (part, domain, body_bytes) in [("idle", 167, size_of::<Eight>()), ("idle texts", 181, 4096)] {
        let mut child = Part::start(part, domain);
        let said = child.hear();
        assert!(child.end().success());
        let computed =
            topic_memory(body_bytes, Qos::default(), Limits::default(), 1, 10).claimed_bytes as u64;
        println!(
            "{part}: bytes in /dev/shm, bytes resident in the process: {said}; {computed} computed each"
        );
        let [shared, resident] = numbers(&said)[..] else { panic!("{said}") };
        assert!(shared + resident < 4 * MIB, "{said}");
        // Besides the samples: what samples and queues begin with, and the record.
        assert!((20 * computed..20 * (computed + 6 * page_bytes())).contains(&shared), "{said}");
    }
}

#[test]
fn images_claim_what_is_computed_and_no_more() {
    let computed = topic_memory(IMAGE_BYTES, Qos::default(), FEW, 3, 10);
    assert_eq!(computed.samples, 14, "ten queued, one in each of three hands, one loaned");
    let computed = computed.claimed_bytes as u64;
    for (part, domain) in [("images", 168), ("images on use", 182), ("locked images", 169)] {
        let mut child = Part::start(part, domain);
        let said = child.hear();
        assert!(child.end().success());
        if said.starts_with("skipped") {
            assert!(std::env::var_os("CI").is_none(), "{said}");
            println!("{said}");
            continue;
        }
        let [before, after] = numbers(&said)[..] else { panic!("{said}") };
        println!("{part}: {before} bytes before, {after} after, {computed} computed");
        if part == "images on use" {
            assert!(before < margin() && after > 12 * IMAGE_BYTES as u64, "{said}: what was needed by then");
        } else {
            assert!(before >= computed && before == after, "{said}: what is needed is there before");
        }
        assert!(after < computed + margin(), "{said}");
    }
}

/// 1,000 bytes are a KB; three figures, or two where they suffice.
fn in_words(bytes: usize) -> String {
    let (unit, name) = match bytes {
        0..1_000_000 => (1e3, "KB"),
        1_000_000..1_000_000_000 => (1e6, "MB"),
        _ => (1e9, "GB"),
    };
    let value = bytes as f64 / unit;
    if value >= 100.0 { format!("{value:.0} {name}") } else { format!("{value:.1} {name}") }
}

#[test]
fn the_documents_table_is_what_the_formula_says() {
    let text = include_str!("../../docs/memory.md");
    for (name, bytes) in [("64 B", 64), ("4 KiB", 4 << 10), ("1 MiB", 1 << 20), ("8 MiB", 8 << 20)] {
        let few = Limits { held: 1, loans: 1, ..Limits::default() };
        let [default, few] =
            [Limits::default(), few].map(|limits| topic_memory(bytes, Qos::default(), limits, 3, 10));
        let (claimed, least) = (in_words(default.claimed_bytes), in_words(few.claimed_bytes));
        let row = format!("| {name} | 10 | 3 | {claimed} | {least} |");
        assert!(text.contains(&row), "docs/memory.md lacks: {row}");
    }
}

/// 16 TiB of samples: more than there is, and than a piece of shared memory may be.
#[test]
fn a_publisher_that_finds_no_memory_leaves_none_behind() {
    const DOMAIN: u32 = 184;
    let participant = Participant::new(domain(DOMAIN)).unwrap();
    let limits =
        Limits { message_bytes: Limits::MAX_MESSAGE_BYTES, loans: Limits::MAX_HELD, ..Limits::default() };
    let text = TopicType::new("test_msgs/msg/Text");
    let refused = |n: usize| {
        let made = participant.create_raw_publisher(&format!("/vast_{n}"), &text, Qos::default(), limits);
        made.expect_err("there is no such memory")
    };
    let error = refused(0);
    assert!(matches!(error, TransportError::Memory { .. }), "{error}");
    println!("{error}");
    let before = claimed(DOMAIN);
    (1..=50).for_each(|n| drop(refused(n)));
    assert_eq!(claimed(DOMAIN), before);
    assert!(participant.create_raw_publisher("/vast_0", &text, Qos::default(), Limits::default()).is_ok());
}

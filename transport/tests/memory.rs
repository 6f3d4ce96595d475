// SPDX-License-Identifier: MIT OR Apache-2.0
//! What topics cost in memory, measured, and what `topic_memory` says. A file of its own: it measures the process.

mod support;

use support::{IMAGE_BYTES, Image, Part, say, shared_memory};
use tautline_msgs::Message;
use tautline_transport::{Limits, Participant, Qos, TopicType, topic_memory};

const MIB: u64 = 1 << 20;

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
        "images" => images(domain),
        "locked images" => match tautline_rt::lock_memory(tautline_rt::MemoryLock::OnFault) {
            Ok(()) => images(domain),
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

fn blocks(domain: u32) -> u64 {
    shared_memory(domain).values().sum()
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
    let before = (blocks(domain), resident());
    let topics: Vec<_> = (1..=20).map(create).collect();
    let after = (blocks(domain), resident());
    say(&format!("{} {}", after.0 - before.0, after.1.saturating_sub(before.1)));
    drop((first, topics));
}

fn images(domain: u32) {
    let participant = Participant::new(domain).unwrap();
    let limits = Limits::default();
    let publisher = participant.create_publisher::<Image>("/image", Qos::default(), limits).unwrap();
    let subscriptions = [(); 3]
        .map(|()| participant.create_subscription::<Image>("/image", Qos::keep_last(10), limits).unwrap());
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
    let segment = shared_memory(domain).into_iter().find(|(name, _)| name.ends_with(".data")).unwrap();
    say(&format!("{}", segment.1));
}

#[test]
fn twenty_idle_topics_cost_less_than_4_mib() {
    let mut part = Part::start("idle", 167);
    let said = part.hear();
    assert!(part.end().success());
    println!("bytes in /dev/shm, bytes resident in the process: {said}");
    let sum: u64 = said.split(' ').map(|bytes| bytes.parse::<u64>().unwrap()).sum();
    assert!(sum < 4 * MIB, "{said}");
}

#[test]
fn twenty_idle_topics_that_may_grow_cost_what_is_computed() {
    let mut part = Part::start("idle texts", 181);
    let said = part.hear();
    assert!(part.end().success());
    println!("bytes in /dev/shm, bytes resident in the process: {said}");
    let sum: u64 = said.split(' ').map(|bytes| bytes.parse::<u64>().unwrap()).sum();
    let books = topic_memory(4096, Limits::default(), 1, 10).growth_books_bytes as u64;
    assert!(sum < 20 * books + 4 * MIB, "{said}; books of {books} bytes each");
    assert!(sum > 20 * books, "nor is it less: {said}; {books}");
}

#[test]
fn images_keep_no_more_than_is_in_flight() {
    for (part, domain) in [("images", 168), ("locked images", 169)] {
        let mut child = Part::start(part, domain);
        let said = child.hear();
        assert!(child.end().success());
        if said.starts_with("skipped") {
            assert!(std::env::var_os("CI").is_none(), "{said}");
            println!("{said}");
            continue;
        }
        let measured: u64 = said.parse().unwrap();
        let computed = topic_memory(IMAGE_BYTES, Limits::default(), 3, 10).resident_bytes as u64;
        println!("{part}: {} MiB measured, {} MiB computed", measured / MIB, computed / MIB);
        // Ten queued, one in each of three hands, one loaned.
        let in_flight = 14 * IMAGE_BYTES as u64;
        assert!(measured <= in_flight * 3 / 2, "{measured} of {in_flight}");
        assert!(measured <= computed, "topic_memory must not promise less than is used");
        assert!(computed <= measured * 3 / 2, "nor much more");
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
        let memory = topic_memory(bytes, Limits::default(), 3, 10);
        let (reserved, resident) = (in_words(memory.reserved_bytes), in_words(memory.resident_bytes));
        let row = format!("| {name} | 10 | 3 | {reserved} | {resident} |");
        assert!(text.contains(&row), "docs/memory.md lacks: {row}");
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Creating and dropping leaves nothing: no descriptor, file, mapping or thread. A file of its own: it counts what the
//! whole process has.

mod support;

use support::{Count, domain, shared_memory, take_all};
use tautline_transport::{Limits, Participant, Qos};

const DOMAIN: u32 = 163;
const PORT_CYCLES: usize = 1_000;
/// Each starts and joins a thread, which takes its time on a loaded machine; `TAUT_LEAK_CYCLES` says otherwise.
const PARTICIPANT_CYCLES: usize = 200;

#[derive(Debug, PartialEq)]
struct Possessions {
    descriptors: usize,
    threads: usize,
    shared_mappings: usize,
    shared_memory: usize,
}

/// As three looks in a row say: for a moment the janitor has a file open.
fn possessions() -> Possessions {
    let (mut last, mut same) = (look(), 1);
    while same < 3 {
        let now = look();
        same = if now == last { same + 1 } else { 1 };
        last = now;
    }
    last
}

fn look() -> Possessions {
    let count = |folder| std::fs::read_dir(folder).unwrap().count();
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    Possessions {
        descriptors: count("/proc/self/fd"),
        threads: count("/proc/self/task"),
        shared_mappings: maps.lines().filter(|line| line.contains("/dev/shm/")).count(),
        shared_memory: shared_memory(DOMAIN).len(),
    }
}

fn use_topic(participant: &Participant, qos: Qos) {
    let limits = Limits::default();
    let publisher = participant.create_publisher::<Count>("/leak", qos, limits).unwrap();
    let subscription = participant.create_subscription::<Count>("/leak", qos, limits).unwrap();
    publisher.publish(&Count { n: 5 }).unwrap();
    assert_eq!(take_all(&subscription), [5]);
}

#[test]
fn a_thousand_cycles_leave_nothing() {
    drop(Participant::new(domain(DOMAIN)).unwrap());
    let before = possessions();
    let cycles =
        std::env::var("TAUT_LEAK_CYCLES").map_or(PARTICIPANT_CYCLES, |cycles| cycles.parse().unwrap());
    for _ in 0..cycles {
        let participant = Participant::new(domain(DOMAIN)).unwrap();
        use_topic(&participant, Qos::default());
    }
    assert_eq!(possessions(), before);

    let participant = Participant::new(domain(DOMAIN)).unwrap();
    use_topic(&participant, Qos::default());
    let before = possessions();
    assert!(before.shared_memory > 0 && before.shared_mappings > 0, "it looks in the right places");
    for cycle in 0..PORT_CYCLES {
        let qos = if cycle % 10 == 0 { Qos::default().transient_local() } else { Qos::default() };
        use_topic(&participant, qos);
    }
    assert_eq!(possessions(), before);
}

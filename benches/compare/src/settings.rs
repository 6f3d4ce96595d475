// SPDX-License-Identifier: MIT OR Apache-2.0
//! Payloads, lengths and rounds of each bench's experiments, for every mode that takes part.

use std::time::Duration;

use crate::plan::{Bench, Idle, Task};
use Kind::*;

/// How much of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extent {
    Smoke,
    Quick,
    Full,
}

/// One setting of an experiment, for every mode that takes part.
#[derive(Clone, Debug)]
pub struct Setting {
    /// As in the JSON.
    pub experiment: String,
    pub task: Task,
    pub payload_bytes: usize,
    pub idle: Idle,
    pub budget: Duration,
    pub rounds: u32,
}

/// An experiment without its idle states.
#[derive(Clone, Copy, Debug)]
enum Kind {
    Whole,
    Untouched,
    Quiet,
    Loaded,
    /// To so many subscriptions.
    OneProcess(usize),
    Processes(usize),
    Robot,
    AtOnce,
    Stream,
    StreamUntouched,
    FirstMessage,
    LateJoiner,
    HundredTopics,
    Request,
    Window,
}

impl Kind {
    /// Its name, how many subscriptions the name ends with, and what is done.
    fn parts(self) -> (&'static str, Option<usize>, Task) {
        // At a rate over all topics.
        let paced = |rate, topics, processes, subscribers| Task::Paced {
            rate,
            topics,
            processes,
            subscribers,
            is_loaded: matches!(self, Loaded),
            at_once: matches!(self, AtOnce),
        };
        match self {
            Whole => ("latency/whole", None, Task::RoundTrips { whole: true }),
            Untouched => ("latency/untouched", None, Task::RoundTrips { whole: false }),
            Quiet => ("open-loop/quiet", None, paced(1000.0, 1, 1, 1)),
            Loaded => ("open-loop/load", None, paced(1000.0, 1, 1, 1)),
            OneProcess(count) => ("fan-out/one-process", Some(count), paced(50.0, 1, 1, count)),
            Processes(count) => ("fan-out/processes", Some(count), paced(50.0, 1, count, 1)),
            Robot => ("robot/20x100Hz", None, paced(2000.0, 20, 1, 1)),
            AtOnce => ("robot/20x100Hz/at-once", None, paced(2000.0, 20, 1, 1)),
            Stream => ("throughput", None, Task::Stream { whole: true }),
            StreamUntouched => ("throughput/untouched", None, Task::Stream { whole: false }),
            FirstMessage => {
                ("start-up/first-message", None, Task::Start { topics: 1, is_late_joiner: false })
            }
            LateJoiner => ("start-up/late-joiner", None, Task::Start { topics: 1, is_late_joiner: true }),
            HundredTopics => {
                ("start-up/100-topics", None, Task::Start { topics: 100, is_late_joiner: false })
            }
            Request => ("request", None, Task::Requests),
            Window => ("window", None, Task::Window),
        }
    }
}

/// Each payload with all of these experiments before the next one.
struct Line {
    idle: Idle,
    kinds: &'static [Kind],
    bytes: &'static [usize],
    ms: u64,
    rounds: u32,
}

/// With idle states held off.
const fn held(kinds: &'static [Kind], bytes: &'static [usize], ms: u64, rounds: u32) -> Line {
    Line { idle: Idle::HeldOff, kinds, bytes, ms, rounds }
}

/// With idle states as shipped.
const fn shipped(kinds: &'static [Kind], bytes: &'static [usize], ms: u64, rounds: u32) -> Line {
    Line { idle: Idle::AsShipped, kinds, bytes, ms, rounds }
}

const KIB: usize = 1 << 10;
const MIB: usize = 1 << 20;
const LATENCIES: &[Kind] = &[Untouched, Whole];
const OPEN_LOOP: &[Kind] = &[Quiet, Loaded];
const START_UP: &[Kind] = &[FirstMessage, LateJoiner, HundredTopics];
/// Of which streams are measured besides 64 B and 1 MiB.
const STREAMS: &[usize] = &[4 * KIB, 16 * KIB, 64 * KIB, 256 * KIB, 4 * MIB, 8 * MIB];
const REMOTE_STREAMS: &[Kind] = &[Window, StreamUntouched];

const COMPARE_SMOKE: &[Line] = &[
    held(&[Whole], &[64, MIB], 60, 1),
    held(&[Untouched], &[64], 60, 1),
    shipped(&[Whole], &[64], 60, 1),
    held(OPEN_LOOP, &[KIB], 200, 1),
    held(&[OneProcess(2), Processes(2)], &[MIB], 200, 1),
    shipped(&[Robot], &[4 * KIB], 500, 1),
    shipped(&[AtOnce], &[4 * KIB], 200, 1),
    held(&[Stream], &[64, MIB], 100, 1),
    shipped(START_UP, &[64], 10, 1),
];
/// The slowest are to make some round trips of 8 MiB, too: twenty in all, of which a median is made. More rounds where most is promised, and
/// where a machine's phases show most.
const COMPARE_QUICK: &[Line] = &[
    held(&[Whole], &[64], 100, 3),
    held(&[Whole], &[MIB], 100, 2),
    held(&[Whole], &[8 * MIB], 650, 1),
    held(&[Untouched], &[64], 100, 1),
    shipped(&[Whole], &[64], 100, 2),
    shipped(&[Whole], &[MIB], 100, 1),
    held(OPEN_LOOP, &[KIB], 1000, 1),
    held(&[OneProcess(1), OneProcess(8), Processes(4)], &[MIB], 600, 1),
    shipped(&[Robot], &[4 * KIB], 1000, 1),
    shipped(&[AtOnce], &[4 * KIB], 600, 1),
    held(&[Stream], &[64, MIB], 400, 1),
    shipped(START_UP, &[64], 10, 1),
];
/// Powers of 4 and 8, and the two sizes of which most is promised.
const COMPARE_FULL: &[Line] = &[
    held(&[Whole], &[64], 100, 3),
    held(&[Whole], &[4 * KIB, 16 * KIB, 64 * KIB, 256 * KIB], 100, 2),
    held(&[Whole], &[MIB], 100, 3),
    held(&[Whole], &[4 * MIB], 200, 2),
    held(&[Whole], &[8 * MIB], 400, 3),
    held(&[Untouched], &[64, 4 * KIB, 64 * KIB, MIB], 100, 1),
    held(&[Untouched], &[8 * MIB], 400, 1),
    shipped(&[Whole], &[64], 100, 2),
    shipped(&[Whole], &[4 * KIB, 16 * KIB, 64 * KIB, 256 * KIB], 100, 1),
    shipped(&[Whole], &[MIB], 100, 2),
    shipped(&[Whole], &[4 * MIB], 200, 1),
    shipped(&[Whole], &[8 * MIB], 400, 2),
    shipped(&[Untouched], &[64, 4 * KIB, 256 * KIB], 100, 1),
    shipped(&[Untouched], &[8 * MIB], 400, 1),
    // More than 10,000 messages in all: enough for p99.9. The other setting has enough for p99.
    held(OPEN_LOOP, &[KIB], 5100, 2),
    shipped(OPEN_LOOP, &[KIB], 1100, 1),
    held(&[OneProcess(1), OneProcess(2), OneProcess(4), OneProcess(8), OneProcess(16)], &[MIB], 500, 1),
    held(&[Processes(2), Processes(4), Processes(8), Processes(16)], &[MIB], 500, 1),
    shipped(&[OneProcess(1), OneProcess(4), OneProcess(8), Processes(4), Processes(8)], &[MIB], 500, 1),
    // 20 s in all.
    shipped(&[Robot], &[4 * KIB], 5000, 4),
    shipped(&[AtOnce], &[4 * KIB], 700, 4),
    held(&[Robot], &[4 * KIB], 1000, 1),
    held(&[AtOnce], &[4 * KIB], 600, 1),
    held(&[Stream], &[64, MIB], 500, 3),
    held(&[Stream], STREAMS, 400, 2),
    shipped(&[Stream], &[64, MIB], 500, 1),
    shipped(&[Stream], STREAMS, 300, 1),
    shipped(START_UP, &[64], 10, 3),
    held(START_UP, &[64], 10, 1),
];
const WAKE_SMOKE: &[Line] = &[
    shipped(&[Untouched], &[64], 60, 1),
    shipped(&[Whole], &[MIB], 60, 1),
    held(&[Untouched], &[64], 60, 1),
    held(&[Whole], &[MIB], 60, 1),
];
const WAKE_QUICK: &[Line] = &[
    shipped(&[Untouched], &[64], 150, 3),
    shipped(&[Whole], &[MIB], 150, 3),
    shipped(&[Untouched], &[8 * MIB], 150, 3),
    held(&[Untouched], &[64], 150, 3),
    held(&[Whole], &[MIB], 150, 3),
    held(&[Untouched], &[8 * MIB], 150, 3),
];
const WAKE_FULL: &[Line] = &[
    shipped(LATENCIES, &[64, 4 * KIB, MIB, 8 * MIB], 200, 5),
    held(LATENCIES, &[64, 4 * KIB, MIB, 8 * MIB], 200, 5),
];

fn lines(bench: Bench, extent: Extent) -> &'static [Line] {
    match (bench, extent) {
        (Bench::Compare, Extent::Smoke) => COMPARE_SMOKE,
        (Bench::Compare, Extent::Quick) => COMPARE_QUICK,
        (Bench::Compare, Extent::Full) => COMPARE_FULL,
        (Bench::Wake, Extent::Smoke) => WAKE_SMOKE,
        (Bench::Wake, Extent::Quick) => WAKE_QUICK,
        (Bench::Wake, Extent::Full) => WAKE_FULL,
        (Bench::Services, Extent::Smoke) => const { &[held(&[Request], &[64, 4 * KIB, MIB], 60, 1)] },
        (Bench::Services, Extent::Quick) => const { &[held(&[Request], &[64, 4 * KIB, MIB], 200, 3)] },
        (Bench::Services, Extent::Full) => const { &[held(&[Request], &[64, 4 * KIB, MIB], 1000, 7)] },
        (Bench::Network, Extent::Smoke) => const { &network(200, 1) },
        (Bench::Network, Extent::Quick) => const { &network(500, 2) },
        (Bench::Network, Extent::Full) => const { &network(1500, 7) },
    }
}

const fn network(ms: u64, rounds: u32) -> [Line; 2] {
    [
        shipped(&[Untouched], &[64, 4 * KIB, MIB], ms, rounds),
        shipped(REMOTE_STREAMS, &[64 * KIB, MIB], ms, rounds),
    ]
}

/// Those of a bench, in the order in which they are measured within an experiment.
pub fn settings(bench: Bench, extent: Extent) -> Vec<Setting> {
    let setting = |line: &Line, payload_bytes, kind: &Kind| {
        let (name, count, task) = kind.parts();
        let idle = if line.idle == Idle::HeldOff { "held-off" } else { "as-shipped" };
        let count = count.map_or(String::new(), |count| format!("/{count}"));
        Setting {
            experiment: format!("{name}/{idle}{count}"),
            task,
            payload_bytes,
            idle: line.idle,
            budget: Duration::from_millis(line.ms),
            rounds: line.rounds,
        }
    };
    let of_line = |line: &'static Line| {
        let of_size = |&bytes| line.kinds.iter().map(move |kind| setting(line, bytes, kind));
        line.bytes.iter().flat_map(of_size).collect::<Vec<_>>()
    };
    lines(bench, extent).iter().flat_map(of_line).collect()
}

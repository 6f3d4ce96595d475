// SPDX-License-Identifier: MIT OR Apache-2.0
//! What must hold within a run, a function for each experiment; and where a rival is ahead, with the cause.

use tautline_harness::claims::{Claim, Goal, Ways, judge};
use tautline_harness::rows::{Metric, Row};
use tautline_harness::table::distinct;
use tautline_harness::verdict::{Outcome, Verdict};

use crate::callbacks::{FLOOD, MESSAGE_BYTES, QUIET, TOPICS};

const KIB: usize = 1 << 10;
const MIB: usize = 1 << 20;

/// Our ways that sleep; the last serves all topics by one callback.
const SLEEPING: &[&str] = &["blocking", "direct", "one-thread"];
/// The same with idle states as shipped, and the way that holds these off by itself.
const AS_SHIPPED: &[&str] = &["blocking", "direct", "one-thread", "own-default"];
/// Those with a thread for each callback.
const THREADS: &[&str] = &["blocking", "direct"];

/// Of large payloads: buffers that are written in turn, or around the caches.
const FLOORS: &[&str] = &["futex", "streaming"];

const RIVALS: [&str; 5] = ["fastdds", "cyclonedds", "zenoh", "hiroz", "r2r"];

fn ours<'a>(experiment: &'a str, bytes: usize, modes: &'a [&'a str]) -> Ways<'a> {
    Ways::new(experiment, bytes, "tautline", modes)
}

/// All of what was measured.
pub fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    [
        latency(rows),
        large_messages(rows),
        wake(rows),
        open_loop(rows),
        fan_out(rows),
        robot(rows),
        streams(rows),
        start_up(rows),
        requests(rows),
        gateways(rows),
        callbacks(rows),
    ]
    .concat()
}

fn latency(rows: &[Row]) -> Vec<Verdict> {
    let (held, shipped) = ("latency/whole/held-off", "latency/whole/as-shipped");
    let mut claims = Vec::new();
    for bytes in [64, 4 * KIB, 16 * KIB, 64 * KIB, 256 * KIB, MIB, 4 * MIB, 8 * MIB] {
        for (experiment, modes) in [(held, SLEEPING), (shipped, AS_SHIPPED)] {
            let at_most = |system, theirs| {
                let theirs = Ways::new(experiment, bytes, system, theirs);
                Claim::new(Metric::P50, ours(experiment, bytes, modes), Goal::Times(1.0, theirs))
            };
            claims.extend(RIVALS.map(|rival| at_most(rival, &[])));
            claims.push(at_most("iceoryx2", &["waitset"]));
        }
    }
    let shared = Ways::new(held, 64, "cyclonedds", &["shared-memory"]);
    let claim = Claim::new(Metric::P50, ours(held, 64, &["blocking"]), Goal::Times(1.0, shared));
    claims.push(claim.because(TWO_WAKES));
    claims.extend(RIVALS.map(|rival| {
        let theirs = Ways::new(held, 64, rival, &[]);
        Claim::new(Metric::P99, ours(held, 64, SLEEPING), Goal::Times(1.0, theirs))
    }));
    let polling = Ways::new(held, 64, "iceoryx2", &["busy-poll"]);
    let claim = Claim::new(Metric::P50, ours(held, 64, &["busy-poll"]), Goal::Times(1.0, polling));
    claims.push(claim.because(A_BARE_RECEIVE));
    // Each system with its own defaults.
    let fastdds = Ways::new(shipped, 64, "fastdds", &[]);
    claims.push(Claim::new(Metric::P50, ours(shipped, 64, &["own-default"]), Goal::Times(0.7, fastdds)));
    judge(rows, claims)
}

/// Written and read whole: near the floor, and several times faster than who copies.
fn large_messages(rows: &[Row]) -> Vec<Verdict> {
    let (held, shipped) = ("latency/whole/held-off", "latency/whole/as-shipped");
    let sharing = Ways::new(held, MIB, "fastdds", &["data-sharing"]);
    let mut claims = vec![Claim::new(Metric::P50, ours(held, MIB, SLEEPING), Goal::Times(0.5, sharing))];
    for bytes in [MIB, 8 * MIB] {
        let floor = Ways::new(held, bytes, "floor", FLOORS);
        claims.push(Claim::new(Metric::P50, ours(held, bytes, SLEEPING), Goal::Times(1.15, floor)));
        let at_most = |times, experiment, modes, system, theirs| {
            let theirs = Ways::new(experiment, bytes, system, theirs);
            let floor = Some(Ways::new(experiment, bytes, "floor", FLOORS));
            let goal = Goal::Times(times, theirs);
            Claim { floor, ..Claim::new(Metric::P50, ours(experiment, bytes, modes), goal) }
        };
        claims.extend([
            at_most(1.0 / 1.5, held, SLEEPING, "fastdds", &["tuned"]),
            at_most(0.1, held, SLEEPING, "fastdds", &["default"]),
            at_most(0.1, held, &["image"], "r2r", &["typed"]),
            at_most(0.1, shipped, &["own-default"], "fastdds", &["default"]),
            at_most(0.1, shipped, &["image"], "r2r", &["typed"]),
        ]);
    }
    judge(rows, claims)
}

/// Of 64 B that nobody touches, beside a bare futex and iceoryx2's polling; and of 8 MiB beside it.
fn wake(rows: &[Row]) -> Vec<Verdict> {
    let (held, shipped) = ("latency/untouched/held-off", "latency/untouched/as-shipped");
    let floor = |experiment, mode| Ways::new(experiment, 64, "floor", mode);
    let to_floor = |metric, more, experiment, mode, theirs| {
        Claim::new(metric, ours(experiment, 64, mode), Goal::More(more, floor(experiment, theirs)))
    };
    let at_most =
        |times, mode, theirs| Claim::new(Metric::P50, ours(shipped, 64, mode), Goal::Times(times, theirs));
    let polling = Ways::new(shipped, 64, "iceoryx2", &["busy-poll"]);
    let small = Goal::Times(1.2, ours(shipped, 64, &["blocking"]));
    judge(
        rows,
        [
            at_most(1.35, &["blocking"], floor(shipped, &["futex"])),
            to_floor(Metric::P50, 6.0, held, &["blocking"], &["futex"]),
            to_floor(Metric::P99, 12.0, held, &["blocking"], &["futex"]),
            to_floor(Metric::P50, 6.0, shipped, &["one-core"], &["one-core"]),
            to_floor(Metric::P99, 12.0, shipped, &["one-core"], &["one-core"]),
            at_most(2.0, &["busy-poll"], polling),
            Claim::new(Metric::P50, ours(shipped, 8 * MIB, &["blocking"]), small),
        ],
    )
}

fn open_loop(rows: &[Row]) -> Vec<Verdict> {
    let [loaded, quiet] = ["open-loop/load/held-off", "open-loop/quiet/held-off"]
        .map(|experiment| ours(experiment, KIB, &["blocking"]));
    let claim = Claim::new(Metric::P999, loaded, Goal::Times(3.0, quiet));
    let shared = Ways::new("open-loop/load/held-off", KIB, "cyclonedds", &["shared-memory"]);
    let to_shared = Claim::new(Metric::P50, loaded, Goal::Times(1.0, shared));
    judge(rows, [Claim { beside: &[Metric::Steal], ..claim }, to_shared.because(TWO_WAKES)])
}

/// Within a process the sampler wakes once per message, not once per subscription.
fn fan_out(rows: &[Row]) -> Vec<Verdict> {
    let most = ["16", "8", "4", "2"].map(|count| format!("fan-out/one-process/held-off/{count}"));
    let is_measured = |experiment: &&String| {
        rows.iter().any(|row| (&row.experiment, &*row.name()) == (*experiment, "tautline blocking"))
    };
    let Some(experiment) = most.iter().find(is_measured) else { return Vec::new() };
    let claim = Claim::new(Metric::SamplerWakes, ours(experiment, MIB, &["blocking"]), Goal::Number(1.5));
    judge(rows, [Claim { beside: &[Metric::OtherWakes], ..claim }])
}

fn robot(rows: &[Row]) -> Vec<Verdict> {
    let (apart, at_once) = ("robot/20x100Hz/as-shipped", "robot/20x100Hz/at-once/as-shipped");
    let claim = |metric, experiment, modes, times, system, cause| {
        let theirs = Ways::new(experiment, 4 * KIB, system, &[]);
        let floor = Some(Ways::new(experiment, 4 * KIB, "floor", &["ring"]));
        let claim = Claim::new(metric, ours(experiment, 4 * KIB, modes), Goal::Times(times, theirs));
        Claim { floor, ..claim.because(cause) }
    };
    let half = |experiment, rival, cause| claim(Metric::CpuTime, experiment, SLEEPING, 0.5, rival, cause);
    judge(
        rows,
        [
            half(apart, "fastdds", SLEEPS),
            half(apart, "r2r", SLEEPS),
            half(at_once, "fastdds", QUEUES),
            half(at_once, "r2r", QUEUES),
            claim(Metric::Memory, apart, THREADS, 1.5, "cyclonedds", STACKS),
        ],
    )
}

/// Cyclone DDS without shared memory, over which it loses messages: its sender is not held back.
fn streams(rows: &[Row]) -> Vec<Verdict> {
    let experiment = "throughput/held-off";
    let theirs: [(&str, &[&str]); 4] =
        [("fastdds", &[]), ("iceoryx2", &[]), ("zenoh", &[]), ("cyclonedds", &["default", "tuned"])];
    let claim = |times, bytes, (system, modes)| {
        let theirs = Ways::new(experiment, bytes, system, modes);
        Claim::new(Metric::Interval, ours(experiment, bytes, THREADS), Goal::Times(times, theirs))
    };
    let large = [64 * KIB, 256 * KIB, MIB, 4 * MIB, 8 * MIB];
    let rivals = large.iter().flat_map(|bytes| theirs.map(|rival| claim(1.0, *bytes, rival)));
    let sharing: &[&str] = &["data-sharing"];
    let cause = |rival: &str| if rival == "zenoh" { BATCHES } else { UNKNOWN };
    let small = [64, 4 * KIB, 16 * KIB];
    let small =
        small.iter().flat_map(|bytes| theirs.map(|rival| claim(1.0, *bytes, rival).because(cause(rival.0))));
    let large = rivals.chain([claim(0.5, MIB, ("fastdds", sharing)), claim(1.15, MIB, ("floor", &["ring"]))]);
    judge(rows, small.chain(large))
}

fn start_up(rows: &[Row]) -> Vec<Verdict> {
    let claim = |experiment, rival| {
        let theirs = Ways::new(experiment, 64, rival, &[]);
        Claim::new(Metric::Start, ours(experiment, 64, THREADS), Goal::Times(1.1, theirs))
    };
    let rivals = ["fastdds", "cyclonedds", "iceoryx2", "zenoh", "r2r"];
    let first = rivals.map(|rival| claim("start-up/first-message/as-shipped", rival));
    let each_of_100 = rivals.map(|rival| claim("start-up/100-topics/as-shipped", rival).because(CONNECTED));
    judge(rows, first.into_iter().chain(each_of_100))
}

fn requests(rows: &[Row]) -> Vec<Verdict> {
    let of = |bytes, mode| ours("request/held-off", bytes, mode);
    let small = || of(64, &["service"]);
    let to_topics = Claim::new(Metric::P50, small(), Goal::Times(1.2, of(64, &["topics"])));
    let large = Claim::new(Metric::P50, of(MIB, &["service"]), Goal::Times(1.2, small()));
    judge(rows, [to_topics, large])
}

/// Over gateways, beside plain Zenoh.
fn gateways(rows: &[Row]) -> Vec<Verdict> {
    let (trips, window, stream) =
        ("latency/untouched/as-shipped", "window/as-shipped", "throughput/untouched/as-shipped");
    let mut claims = Vec::new();
    for (bytes, times, cause) in [(64, 1.3, THREE_WAKES), (MIB, 0.75, COPIED_ONCE_MORE)] {
        let modes: [&[&str]; 2] = [&["tcp"], &["tcp-ordinary"]];
        claims.extend(modes.map(|mode| {
            let theirs = Ways::new(trips, bytes, "zenoh", mode);
            let goal = Goal::Times(times, theirs);
            Claim::new(Metric::P50, ours(trips, bytes, &["gateway"]), goal).because(cause)
        }));
    }
    for bytes in [64 * KIB, MIB] {
        claims.extend([window, stream].map(|experiment| {
            let theirs = Ways::new(experiment, bytes, "zenoh", &["tcp", "tcp-ordinary"]);
            let goal = Goal::AtLeastTimes(1.0, theirs);
            Claim::new(Metric::Rate, ours(window, bytes, &["gateway"]), goal).because(TWO_PROCESSES)
        }));
    }
    judge(rows, claims)
}

/// With a flood from the network and without.
fn callbacks(rows: &[Row]) -> Vec<Verdict> {
    let topics = TOPICS.map(|topic| [topic]);
    let claim = |topic| {
        let goal = Goal::Times(1.1, ours(QUIET, 0, topic));
        let claim = Claim::new(Metric::P99, ours(FLOOD, MESSAGE_BYTES, topic), goal);
        Claim { however_few: true, ..claim }
    };
    judge(rows, topics.iter().map(|topic| claim(&topic[..])))
}

/// A rival's system and its ways.
type Rival = (&'static str, &'static [&'static str]);

const BESIDE_BLOCKING: [Rival; 6] = [
    ("iceoryx2", &["waitset"]),
    ("fastdds", &[]),
    ("cyclonedds", &[]),
    ("r2r", &[]),
    ("zenoh", &[]),
    ("hiroz", &[]),
];
/// Those that never sleep.
const BESIDE_POLLING: [Rival; 2] = [("iceoryx2", &["busy-poll"]), ("taktora", &[])];

/// Where a rival is ahead of Tautline's default: blocking, and busy-poll beside rivals that never sleep.
pub fn ahead(rows: &[Row]) -> Vec<Verdict> {
    let mut verdicts = Vec::new();
    for (experiment, bytes) in distinct(rows.iter().map(|row| (row.experiment.as_str(), row.payload_bytes))) {
        let claim = |mode, (system, modes): Rival, metric, cause| {
            let goal = Goal::Times(1.05, Ways::new(experiment, bytes, system, modes));
            Claim::new(metric, ours(experiment, bytes, mode), goal).because(cause)
        };
        for (metric, cause) in behind(experiment, bytes) {
            let instead = Some(ours(experiment, bytes, &["direct", "one-thread"]));
            let blocking = |rival: Rival| {
                let cause = if cause == BATCHES && rival.0 != "zenoh" { UNKNOWN } else { cause };
                Claim { instead, ..claim(&["blocking"], rival, metric, cause) }
            };
            verdicts.extend(judge(rows, BESIDE_BLOCKING.map(blocking)));
        }
        for (metric, cause) in behind_polling(experiment, bytes) {
            let polling = |rival| claim(&["busy-poll"], rival, metric, cause);
            verdicts.extend(judge(rows, BESIDE_POLLING.map(polling)));
        }
    }
    verdicts.retain(|verdict| verdict.outcome == Outcome::Missed);
    verdicts
}

/// Sizes from here on are filling and reading, of which waking is a small part.
const LARGE: usize = 256 * KIB;

/// What blocking is compared by, and why it may be behind.
fn behind(experiment: &str, bytes: usize) -> Vec<(Metric, &'static str)> {
    let rare = [(Metric::P99, RARE), (Metric::P999, RARE)];
    let of_robot = |cause| vec![(Metric::P50, cause), (Metric::CpuTime, cause), (Metric::Memory, STACKS)];
    match experiment.split('/').collect::<Vec<_>>()[..] {
        ["latency", ..] if bytes >= LARGE => [&[(Metric::P50, FILLING)], &rare[..]].concat(),
        ["latency" | "open-loop", ..] => [&[(Metric::P50, TWO_WAKES)], &rare[..]].concat(),
        ["fan-out", ..] => vec![(Metric::P50, TO_ALL), (Metric::CpuTime, JANITOR)],
        ["robot", _, "at-once", ..] => of_robot(A_THREAD_EACH),
        ["robot", ..] => of_robot(TWO_WAKES),
        ["throughput", ..] if bytes >= LARGE => vec![(Metric::Interval, FILLING)],
        ["throughput", ..] => vec![(Metric::Interval, BATCHES)],
        ["start-up", "100-topics", ..] => vec![(Metric::Start, CONNECTED)],
        ["start-up", ..] => vec![(Metric::Start, UNKNOWN)],
        _ => Vec::new(),
    }
}

/// The same of busy-poll.
fn behind_polling(experiment: &str, bytes: usize) -> Vec<(Metric, &'static str)> {
    let [p50, rare] = if bytes >= LARGE { [FILLING, RARE] } else { [A_BARE_RECEIVE; 2] };
    match experiment.starts_with("latency/") {
        true => vec![(Metric::P50, p50), (Metric::P99, rare), (Metric::P999, rare)],
        false => Vec::new(),
    }
}

// Causes.
const A_BARE_RECEIVE: &str = "its row is a bare receive() of bytes; Tautline's goes to a callback: a header that is checked, numbers that tell what was lost, release and response time of each job";
const A_THREAD_EACH: &str = "a thread for each callback, so that each has its own priority: they are woken one after the other, where one thread of the rival's takes all; one-thread does as it does";
const BATCHES: &str = "it packs many small messages into one packet, which goes from core to core as a whole; of each of Tautline's, which is a sample with a job of its own, some cache lines go there, and come back when it is returned";
const CONNECTED: &str = "each publisher is announced and connected as it is made, some tens of µs; the rest is the tries, one in 10 ms, of which every system needs more than one, and a little more is a whole try more";
const COPIED_ONCE_MORE: &str =
    "each message wakes three threads more, and is copied once more, from Zenoh's packets into shared memory";
const FILLING: &str = "nearly all of it is filling and reading the payload, whose cost is where its lines are: where two cores share less cache than the kernel says, more buffers in turn than Tautline uses would be faster, and where they share the second level, fewer";
const JANITOR: &str = "in each process a janitor thread looks at the ports when they have changed, which here is spread over some tens of messages; and with several subscriptions in a process a thread is woken for each";
const QUEUES: &str = "beyond the floor is what loaning, queueing and taking each of the 20 messages costs, and nobody sleeps between them";
const RARE: &str = "no cause in Tautline is known: a tail of few messages, which changes from run to run";
const SLEEPS: &str = "most of it is what every system pays here: for each message the sender sleeps, is woken by a timer and interrupts an idle core";
const STACKS: &str = "each of the 20 callbacks has a thread, whose whole stack is touched and locked before it starts (CallbackOptions::stack_bytes sets its size); one-thread does without";
const THREE_WAKES: &str = "each message wakes three threads more, one after the other: the sending gateway's, the receiving node's sampler and its callback; those wake-ups alone make it 1.2 times as long, and for the rest no reason is known";
const TO_ALL: &str = "the sampler's wake comes before the callbacks', and each subscription's callback has a thread of its own";
const TWO_PROCESSES: &str =
    "two processes more take and publish each message, and share the cores of the nodes";
const TWO_WAKES: &str = "blocking wakes two threads one after the other, the sampler and the callback's, which is what keeps priorities apart and can be bounded; direct and one-thread wake one";
const UNKNOWN: &str = "no reason is known";

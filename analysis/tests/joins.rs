// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that wait for several topics: hand-computed cases, files, and random systems in which the synchronizers' own
//! policies decide, on simulated cores, and nothing takes longer or is more than its bound.

use std::collections::HashMap;
use std::ops::Range;
use std::time::Duration;

use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng, rngs::StdRng};
use tautline_analysis::file::SystemFile;
use tautline_analysis::system::{Callback, Chain, Core, Matching, System, SystemReport, Transfer};
use tautline_analysis::{AnalysisError, Order, Task};
use tautline_join::{ApproximateEpsilonTime, ApproximateTime, Arrival, ExactTime, LatestTime, Policy};

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn task(name: &str, period: u64, wcet: u64, priority: u8) -> Task {
    Task::new(name, ms(period), ms(wcet), priority)
}

/// Two sensors on cores of their own, and what waits for both on a third, with the highest priority there.
/// The only way through a chain.
fn stages_of(chain: &Chain) -> &[usize] {
    &chain.parts[0].ways[0]
}

fn two_sensors(periods: [u64; 2], matching: Matching) -> System {
    let taker = |name: &str, source| {
        let task = Task::new(name, ms(1), Duration::from_nanos(1), 2).group(0, Order::Any);
        Callback::new(task, 2).triggered_by(source, Transfer::LOCAL)
    };
    let callbacks = vec![
        Callback::new(task("left", periods[0], 1, 1), 0),
        Callback::new(task("right", periods[1], 2, 1), 1),
        taker("takes left", 0),
        taker("takes right", 1),
        Callback::new(task("fuse", 1, 3, 2).group(0, Order::Any), 2).joining(vec![2, 3], matching),
    ];
    let chain = |stages: [usize; 3]| Chain::new("way", stages.to_vec());
    System {
        cores: vec![Core::default(); 3],
        callbacks,
        chains: vec![chain([0, 2, 4]), chain([1, 3, 4])],
        ..System::default()
    }
}

fn in_ms(ns: &[u64]) -> Vec<u64> {
    ns.iter().map(|ns| ns / 1_000_000).collect()
}

#[test]
fn the_newest_of_each_runs_at_the_pace_of_the_slowest() {
    let report = two_sensors([10, 40], Matching::Newest).analyse().unwrap();
    let join = report.joins[4].clone().unwrap();
    // It or a later message of the fast one is in a set after the slow one's period and response, and the other way round.
    assert_eq!(in_ms(&join.reflected_ns.unwrap()), [42, 11]);
    // Itself only until the next, one period and response later.
    assert_eq!((in_ms(&join.wait_ns), join.queue_size), (vec![11, 11], 1));
    let fuse = report.callbacks[4].as_ref().unwrap();
    assert_eq!((fuse.period_ns / 1_000_000, fuse.jitter_ns / 1_000_000), (40, 42));
    let chain = report.chains[0].as_ref().unwrap();
    // 1 ms of the sensor, the wait for the other one, and twice the callback: the one before may just have begun.
    assert_eq!(
        (chain.latency_ns / 1_000_000, chain.reaction_ns.unwrap() / 1_000_000),
        (1 + 11 + 6, 10 + 1 + 42 + 6)
    );
}

/// An executor of ROS 2 takes one message in a run, and passes a set on while others wait.
#[test]
fn the_newest_that_was_taken_may_be_a_response_older() {
    let report = two_sensors([10, 40], Matching::NewestTaken).analyse().unwrap();
    let join = report.joins[4].clone().unwrap();
    assert_eq!(in_ms(&join.reflected_ns.unwrap()), [42 + 6, 11 + 6]);
    assert_eq!((in_ms(&join.wait_ns), join.queue_size), (vec![11 + 6; 2], 1));
    let fuse = report.callbacks[4].as_ref().unwrap();
    assert_eq!((fuse.period_ns / 1_000_000, fuse.jitter_ns / 1_000_000), (40, 42));
}

#[test]
fn close_stamps_meet_when_everyone_has_sent_something_later() {
    let report = two_sensors([10, 40], Matching::Approximate { window_ns: 11_000_000 }).analyse().unwrap();
    let join = report.joins[4].clone().unwrap();
    // Window 11, then the slow one's next stamp: at most 40 + 2 later, and it comes within 2. A stamp is up to R after the release.
    assert_eq!(in_ms(&join.wait_ns), [11 + 44 + 1, 11 + 44 + 2]);
    assert_eq!(in_ms(&join.reflected_ns.unwrap()), [42 + 42 + 44 + 1, 42 + 42 + 44 + 2]);
    assert!(join.starved_by.is_empty());
    // Of the fast one: those stamped within 55 ms and what its own thread needs.
    assert_eq!(
        join.queue_size,
        (55_u64 + report.callbacks[4].as_ref().unwrap().from_arrival_ns / 1_000_000 + 1).div_ceil(10)
    );

    let report = two_sensors([40, 40], Matching::Approximate { window_ns: 5_000_000 }).analyse().unwrap();
    let (join, chain) = (report.joins[4].as_ref().unwrap(), report.chains[0].as_ref().unwrap());
    assert_eq!(
        (join.starved_by.clone(), join.reflected_ns.clone(), chain.reaction_ns),
        (vec![(0, 41_000_000)], None, None)
    );
    assert!(chain.latency_ns > 0);
}

#[test]
fn equal_stamps_wait_for_the_longer_way() {
    let mut system = two_sensors([10, 10], Matching::Exact);
    // Both filters of one source.
    system.callbacks[1] = Callback::new(task("filter", 10, 4, 1), 1).triggered_by(0, Transfer::LOCAL);
    system.callbacks[0].task.bcet_ns = 1_000_000;
    system.chains[1].parts[0].ways[0] = vec![0, 1, 3, 4];
    let report = system.analyse().unwrap();
    let join = report.joins[4].clone().unwrap();
    // The short way is 1 ms, the long one 1 + 0 to 4.
    assert_eq!((in_ms(&join.wait_ns), join.queue_size), (vec![4, 4], 1));
    assert_eq!(report.callbacks[4].as_ref().unwrap().jitter_ns, 4_000_000);
    let latencies: Vec<u64> =
        report.chains.iter().map(|chain| chain.as_ref().unwrap().latency_ns / 1_000_000).collect();
    assert_eq!(latencies, [8, 8], "1 + 4 + 3 on either way");
}

/// Two sensors that publish one topic, and one that publishes another, each on a core of its own, and what waits for both topics.
fn shared_topic(periods: [u64; 3], matching: Matching) -> System {
    let taker = |name: &str, source| {
        let task = Task::new(name, ms(1), Duration::from_nanos(1), 2).group(0, Order::Any);
        Callback::new(task, 3).triggered_by(source, Transfer::LOCAL)
    };
    let fuse = task("fuse", 1, 3, 2).group(0, Order::Any);
    let mut callbacks: Vec<Callback> =
        (0..3).map(|i| Callback::new(task("sensor", periods[i], 1, 1), i)).collect();
    callbacks.extend((0..3).map(|i| taker("takes", i)));
    callbacks.push(Callback::new(fuse, 3).joining_ports(vec![3, 4, 5], vec![0, 0, 1], matching));
    System { cores: vec![Core::default(); 4], callbacks, chains: vec![], ..System::default() }
}

#[test]
fn publishers_of_one_topic_count_together() {
    let report = shared_topic([60, 30, 40], Matching::Newest).analyse().unwrap();
    let join = report.joins[6].clone().unwrap();
    // For the other topic 40 and its response, of which the next of the faster of two, 31 later, takes the place; that one waits for this.
    assert_eq!(in_ms(&join.wait_ns), [31, 31, 31]);
    let fuse = report.callbacks[6].as_ref().unwrap();
    assert_eq!((fuse.period_ns, fuse.jitter_ns), (40_000_000, 41_000_000), "the other one is the slowest");
    // An earlier message of the other publisher may be taken after it, and be in its set; the next set comes one gap and one response later.
    let next = 41 + fuse.from_arrival_ns / 1_000_000;
    assert_eq!(in_ms(&join.reflected_ns.unwrap()), [41 + next, 41 + next, 31]);
    let report = shared_topic([60, 30, 10], Matching::Newest).analyse().unwrap();
    let fuse = report.callbacks[6].as_ref().unwrap();
    // One in 20 ms, with 20 * ((60 + 1) / 60 + (30 + 1) / 30) of jitter.
    assert_eq!((fuse.period_ns, fuse.jitter_ns / 1_000), (20_000_000, 41_000));

    let report =
        shared_topic([60, 30, 40], Matching::Approximate { window_ns: 70_000_000 }).analyse().unwrap();
    let join = report.joins[6].clone().unwrap();
    // The window, then the next stamp of the other one: at most 40 + 1 later, and it comes within 1. The two have one within 32.
    assert_eq!(in_ms(&join.wait_ns), [70 + 42 + 1; 3]);
    // Stamps of the two that are kept are at most 31, 1 on the way and what the thread takes apart, of the other 41.
    let thread = report.callbacks[6].as_ref().unwrap().from_arrival_ns / 1_000_000;
    assert!((9..=12).contains(&thread), "{thread}");
    assert_eq!(in_ms(&join.reflected_ns.unwrap()), [31 + 1 + thread + 70 + 42 + 1; 3]);
    // Of the two, stamped within 70 + 41 + 1 and what the thread takes.
    let within = 70 + 42 + thread + 1;
    assert_eq!(join.queue_size, (within + 1).div_ceil(60) + (within + 1).div_ceil(30));

    let error = shared_topic([60, 60, 60], Matching::Exact).analyse().unwrap_err();
    assert!(
        matches!(error, AnalysisError::BadJoin { problem, .. } if problem.contains("several publishers"))
    );
    let error = shared_topic([60, 30, 40], Matching::LatestTime).analyse().unwrap_err();
    assert!(matches!(error, AnalysisError::BadJoin { problem, .. } if problem.contains("no rate")));
    let mut odd = shared_topic([60, 30, 40], Matching::Newest);
    odd.callbacks[6].join.as_mut().unwrap().ports = vec![0, 0, 2];
    assert!(matches!(odd.analyse().unwrap_err(), AnalysisError::BadJoin { .. }));
}

#[test]
fn a_publisher_that_is_always_overtaken_fills_no_gap() {
    // One of a topic every 10 ms, 300 ms late; one every 100 ms; and every 200 ms, in between these, one of the other topic.
    let mut policy = ApproximateTime::new(100).max_interval(Duration::from_nanos(30));
    policy.start(2);
    let stream = |input, period: i64, offset: i64, late: i64| {
        (0..200_i64).map(move |i| (i * period + offset + late, input, i * period + offset))
    };
    let mut messages: Vec<(i64, usize, i64)> =
        stream(0, 10, 5, 300).chain(stream(0, 100, 0, 0)).chain(stream(1, 200, 50, 0)).collect();
    messages.sort_unstable();
    let (mut kept, mut sets) = (Vec::new(), 0);
    for (_, input, stamp) in messages.into_iter().filter(|(at, ..)| (300..2_000).contains(at)) {
        if policy.arrived(input, stamp) != Arrival::Refuse && input == 0 {
            kept.push(stamp);
        }
        while policy.decide(&mut |_| ()) {
            sets += 1;
        }
    }
    assert!(kept[1..].windows(2).all(|pair| pair[1] - pair[0] == 100) && sets == 0, "{kept:?}");

    let with_window = |window: u64| {
        let mut system =
            shared_topic([10, 100, 200], Matching::Approximate { window_ns: window * 1_000_000 });
        let late = Transfer { least_ns: 300_000_000, most_ns: 300_000_000 };
        system.callbacks[3].trigger = Some((0, late));
        system.analyse().unwrap().joins[6].clone().unwrap()
    };
    assert_eq!((with_window(30).starved_by, with_window(30).reflected_ns), (vec![(0, 101_000_000)], None));
    assert!(with_window(102).reflected_ns.is_some());
}

#[test]
fn a_tolerance_waits_for_the_set_alone() {
    let matching = Matching::ApproximateEpsilon { window_ns: 11_000_000 };
    let report = two_sensors([10, 40], matching).analyse().unwrap();
    let join = report.joins[4].clone().unwrap();
    // The tolerance and 2 on its way, not the next stamp.
    assert_eq!(in_ms(&join.wait_ns), [11 + 2 + 1, 11 + 2 + 2]);
    assert_eq!(in_ms(&join.reflected_ns.unwrap()), [42 + 42 + 2 + 1, 42 + 42 + 2 + 2]);
    // Of three topics a set may always be missed.
    let mut system = shared_topic([10, 10, 40], Matching::ApproximateEpsilon { window_ns: 20_000_000 });
    system.callbacks[6].join.as_mut().unwrap().ports = vec![0, 1, 2];
    system.chains = vec![Chain::new("way", vec![0, 3, 6])];
    let report = system.analyse().unwrap();
    let (join, chain) = (report.joins[6].as_ref().unwrap(), report.chains[0].as_ref().unwrap());
    assert_eq!((&join.reflected_ns, &join.starved_by, chain.reaction_ns), (&None, &vec![], None));
    assert!(chain.latency_ns > 0);
}

#[test]
fn the_fastest_sets_the_pace() {
    let report = two_sensors([10, 40], Matching::LatestTime).analyse().unwrap();
    let join = report.joins[4].clone().unwrap();
    // Used until the next one is taken: the period, 1 or 2 of jitter, and the thread's 3 or 6; reflected with the next of the fastest.
    let response = report.callbacks[4].as_ref().unwrap().from_arrival_ns / 1_000_000;
    assert_eq!(in_ms(&join.wait_ns), [10 + 1 + response, 40 + 2 + response]);
    assert_eq!(in_ms(&join.reflected_ns.unwrap()), [0, 10 + 1 + response]);
    assert_eq!(report.callbacks[4].as_ref().unwrap().period_ns, 8_000_000, "whatever comes may be the pace");
    let report = two_sensors([10, 12], Matching::LatestTime).analyse().unwrap();
    let (join, chain) = (report.joins[4].as_ref().unwrap(), report.chains[0].as_ref().unwrap());
    assert_eq!((&join.reflected_ns, &join.starved_by, chain.reaction_ns), (&None, &vec![(1, 999_997)], None));
}

/// A camera and a lidar, each on its core, and what waits for both.
const FILE: &str = r#"
[hosts.robot]
cores = 3
[nodes.camera]
core = 0
[nodes.lidar]
core = 1
[nodes.fusion]
core = 2
[callbacks.image]
node = "camera"
period = "30ms"
wcet = "2ms"
publishes = "/image"
[callbacks.cloud]
node = "lidar"
period = "100ms"
wcet = "5ms"
publishes = "/cloud"
[callbacks.fuse]
node = "fusion"
all = ["/image", "/cloud"]
window = "32ms"
wcet = "8ms"
take = "50us"
publishes = "/objects"
[callbacks.plan]
node = "fusion"
topic = "/objects"
wcet = "3ms"
[[chains]]
name = "cloud to plan"
path = ["cloud", "fuse", "plan"]
deadline = "400ms"
"#;

#[test]
fn a_file_says_what_is_waited_for() {
    let checked = SystemFile::parse(FILE).unwrap().check();
    let fuse = checked.callbacks.iter().find(|callback| callback.entry.name == "fuse").unwrap();
    let join = fuse.join.as_ref().unwrap();
    assert_eq!(fuse.entry.topics, ["/image", "/cloud"]);
    assert_eq!(join.window_ns, Some(32_000_000));
    assert!(join.inputs.iter().map(|(topic, _)| topic).eq(&fuse.entry.topics));
    // 32 of the window, 100 + 5 to the next cloud and 5 on its way, and a stamp may be taken when the sensor's run ends.
    assert_eq!(
        join.inputs.iter().map(|(_, wait)| wait.unwrap() / 1_000_000).collect::<Vec<_>>(),
        [32 + 110 + 2, 32 + 110 + 5]
    );
    assert!((5..=6).contains(&join.queue_size), "{join:?}");
    // Its queues take one message each, and its releases are messages.
    assert_eq!((fuse.capacity, fuse.releases.len()), (Some(1), 2));
    assert!(
        checked.schedulable && checked.warnings.iter().all(|warning| warning.contains("[overheads]")),
        "{checked:?}"
    );
    let chain = &checked.chains[0];
    assert!(chain.latency_ns < chain.reaction_ns && chain.reaction_ns < Some(500_000_000), "{chain:?}");

    let narrow = SystemFile::parse(&FILE.replace("window = \"32ms\"", "window = \"10ms\"")).unwrap().check();
    assert!(
        narrow.warnings.iter().any(|warning| warning.contains("messages of `/image` may lie further apart"))
    );
    assert_eq!(narrow.chains[0].reaction_ns, None);
    // Two publishers of a topic: its queues hold what both send.
    let shared = FILE.replace("publishes = \"/image\"", "publishes = [\"/image\", \"/cloud\"]");
    let shared = SystemFile::parse(&shared).unwrap().check();
    let (fuse, join) = (&shared.callbacks[2], shared.callbacks[2].join.as_ref().unwrap());
    assert_eq!((fuse.capacity, fuse.releases.len(), join.inputs.len()), (Some(3), 3, 2), "{fuse:?}");
    assert!(join.queue_size >= 4 && shared.chains[0].reaction_ns.is_some(), "{join:?}");
    let fastest = FILE.replace("window = \"32ms\"", "policy = \"latest_time\"");
    let checked = SystemFile::parse(&fastest).unwrap().check();
    assert_eq!(checked.callbacks[2].join.as_ref().unwrap().queue_size, 1);
    assert!(checked.chains[0].reaction_ns.is_some(), "{checked:?}");
    let close = SystemFile::parse(&fastest.replace("\"100ms\"", "\"31ms\"")).unwrap().check();
    assert!(close.warnings.iter().any(|warning| warning.contains("`/cloud` may come as close")), "{close:?}");
    let first = FILE.replace("window =", "policy = \"approximate_epsilon_time\"\nwindow =");
    let first = SystemFile::parse(&first).unwrap().check();
    assert!(first.chains[0].reaction_ns < chain.reaction_ns && first.chains[0].reaction_ns.is_some());
    let newest = SystemFile::parse(&FILE.replace("window = \"32ms\"", "")).unwrap().check();
    assert_eq!(newest.callbacks[2].join.as_ref().unwrap().window_ns, None);
    assert!(newest.chains[0].latency_ns < chain.latency_ns);
}

#[test]
fn what_is_wrong_with_a_join_is_said_with_its_line() {
    let wrong = |piece: &str, replacement: &str, line: usize, message: &str| {
        assert!(FILE.contains(piece), "{piece}");
        let problems = SystemFile::parse(&FILE.replacen(piece, replacement, 1)).unwrap_err().to_string();
        assert!(problems.contains(message), "{problems}");
        assert!(problems.starts_with(&format!("{line}:")), "{line}: {problems}");
    };
    let all = "all = [\"/image\", \"/cloud\"]";
    wrong(all, "all = [\"/image\"]", 22, "waits for 1 topic(s) in `all`: list 2 to 9, or use `topic`");
    wrong(all, "all = [\"/image\", \"/image\"]", 22, "`all` of callback `fuse` lists topic `/image` twice");
    wrong(all, "all = [\"/image\", \"/clout\"]", 22, "did you mean `/cloud`?");
    wrong(all, "topic = \"/image\"", 23, "`window` of callback `fuse` is without `all`");
    wrong(all, "all = [\"/image\", \"/cloud\"]\nperiod = \"1s\"", 23, "two triggers, `all` and `period`");
    wrong(all, "all = [\"/cloud\", \"/image\"]\ntopic = \"/image\"", 22, "two triggers, `topic` and `all`");
    wrong("window = \"32ms\"", "window = \"0ms\"", 23, "do not come from one source");
    wrong("window = \"32ms\"", "window = \"soon\"", 23, "soon");
    wrong("take = \"50us\"", "take = \"9ms\"", 25, "`take` of callback `fuse` exceeds its wcet");
    let exact = FILE.replace("window = \"32ms\"", "window = \"0ms\"");
    let shared = exact.replace("publishes = \"/image\"", "publishes = [\"/image\", \"/cloud\"]");
    let shared = SystemFile::parse(&shared).unwrap_err().to_string();
    assert!(shared.starts_with("23:") && shared.contains("`/cloud` reaches it in 2 ways"), "{shared}");
    assert!(shared.contains("give each publisher a topic of its own"), "{shared}");
    wrong("window = \"32ms\"", "policy = \"latest\"", 23, "unknown `policy` \"latest\" in callback `fuse`");
    wrong("window = \"32ms\"", "policy = \"approximate_epsilon_time\"", 23, "set its `window`");
    wrong(
        "window = \"32ms\"",
        "window = \"0ms\"\npolicy = \"approximate_epsilon_time\"",
        24,
        "for equal stamps leave out the policy",
    );
    wrong("window = \"32ms\"", "window = \"1ms\"\npolicy = \"latest_time\"", 24, "leave out one of them");
    wrong(
        all,
        "topic = \"/image\"\npolicy = \"latest_time\"",
        23,
        "`policy` of callback `fuse` is without `all`",
    );
    let latest = FILE.replace("window = \"32ms\"", "policy = \"latest_time\"");
    for (piece, replacement, message) in [
        ("period = \"100ms\"", "period = \"30ms\"", "`/image` and `/cloud` have the same period"),
        (
            "publishes = \"/image\"",
            "publishes = [\"/image\", \"/cloud\"]",
            "`/cloud` comes from several publishers",
        ),
    ] {
        let problems = SystemFile::parse(&latest.replace(piece, replacement)).unwrap_err().to_string();
        assert!(problems.starts_with("23:") && problems.contains(message), "{problems}");
        assert!(problems.contains("put the others into `reads`"), "{problems}");
    }
    wrong(
        "publishes = \"/cloud\"",
        "publishes = \"/cloud\"\n[callbacks.more]\nnode = \"lidar\"\nall = [\"/objects\", \"/image\"]\nwcet = \"1ms\"\nwindow = \"1ms\"",
        22,
        "those of `/objects` are not known",
    );
    wrong("period = \"100ms\"", "all = [\"/image\", \"/objects\"]", 15, "in a circle");
    let outside = "[topics]\n\"/left\" = { period = \"30ms\" }\n\"/right\" = { period = \"PERIOD\" }\n[hosts.robot]\ncores = 1\n\
                   [nodes.n]\n[callbacks.c]\nall = [\"/left\", \"/right\"]\nwindow = \"0ms\"\nwcet = \"1ms\"\n";
    // A hardware trigger may keep topics from outside in step, if they have one period.
    assert!(SystemFile::parse(&outside.replace("PERIOD", "30ms")).unwrap().check().schedulable);
    let uneven = SystemFile::parse(&outside.replace("PERIOD", "40ms")).unwrap_err().to_string();
    assert!(uneven.contains("have different periods"), "{uneven}");
}

#[test]
fn joins_without_a_meaning_are_refused() {
    let refused = |system: System| system.analyse().unwrap_err();
    let uneven = refused(two_sensors([10, 40], Matching::Exact));
    assert!(
        matches!(&uneven, AnalysisError::BadJoin { problem, .. } if problem.contains("different periods")),
        "{uneven}"
    );
    let mut alone = two_sensors([10, 40], Matching::Newest);
    alone.callbacks[4].join.as_mut().unwrap().inputs.pop();
    assert!(matches!(refused(alone), AnalysisError::BadJoin { .. }));
    let mut itself = two_sensors([10, 40], Matching::Newest);
    itself.callbacks[2].trigger = Some((4, Transfer::LOCAL));
    assert!(matches!(refused(itself), AnalysisError::Cycle { .. }));
    let mut nothing = two_sensors([10, 40], Matching::Newest);
    nothing.callbacks[4].join.as_mut().unwrap().inputs[0] = 9;
    assert!(matches!(refused(nothing), AnalysisError::BadReference { index: 9, .. }));
}

/// A random system with joins: sources, filters, what waits for some of them, what follows it, and bystanders.
fn random_system(rng: &mut StdRng) -> System {
    let mut callbacks: Vec<Callback> = Vec::new();
    let mut chains = Vec::new();
    let mut ways: Vec<Vec<usize>> = Vec::new();
    let ns = Duration::from_nanos;
    let add = |callbacks: &mut Vec<Callback>, rng: &mut StdRng, period: u64, trigger: Option<usize>| {
        let wcet = rng.random_range(1..=period / 8);
        let mut task =
            Task::new(format!("{}", callbacks.len()), ns(period), ns(wcet), rng.random_range(1..=9));
        task.bcet_ns = rng.random_range(0..=wcet);
        let mut callback = Callback::new(task, rng.random_range(0..3));
        match trigger {
            Some(source) => {
                let least_ns = rng.random_range(0..=9);
                let network = Transfer { least_ns, most_ns: least_ns + rng.random_range(0..=20) };
                let way = if rng.random_bool(0.5) { Transfer::LOCAL } else { network };
                callback = callback.triggered_by(source, way);
            }
            None if rng.random_bool(0.5) => callback.task.jitter_ns = rng.random_range(0..=period / 2),
            None => {}
        }
        callbacks.push(callback);
        callbacks.len() - 1
    };
    let kind = rng.random_range(0..5);
    let inputs = rng.random_range(2..=3);
    let source = (kind == 1).then(|| add(&mut callbacks, rng, 100, None));
    let (mut ports, fast) = (Vec::new(), rng.random_range(0..inputs));
    for port in 0..inputs {
        // Equal stamps, and rates, are of one publisher.
        let publishers = if [1, 4].contains(&kind) { 1 } else { *[1, 1, 2, 3].choose(rng).unwrap() };
        for _ in 0..publishers {
            let period = match kind {
                4 if port == fast => rng.random_range(20..=60),
                4 => rng.random_range(60..=300),
                _ => rng.random_range(40..=200),
            };
            let root = source.unwrap_or_else(|| add(&mut callbacks, rng, period, None));
            let mut way = vec![root];
            if source.is_some() || rng.random_bool(0.5) {
                way.push(add(&mut callbacks, rng, period.min(100), Some(root)));
            }
            ways.push(way);
            ports.push(port);
        }
    }
    let longest = ways.iter().map(|way| callbacks[way[0]].task.period_ns).max().unwrap();
    let window_ns = rng.random_range(1..=longest * 3 / 2);
    let matching = match kind {
        0 => Matching::Newest,
        1 => Matching::Exact,
        2 => Matching::Approximate { window_ns },
        3 => Matching::ApproximateEpsilon { window_ns },
        _ => Matching::LatestTime,
    };
    let (core, priority) = (rng.random_range(0..3), rng.random_range(1..=9));
    let group = |task: Task| task.group(7, Order::Any);
    for way in &mut ways {
        let from = *way.last().unwrap();
        let taker =
            group(Task::new(format!("{}", callbacks.len()), ns(1), ns(rng.random_range(1..=2)), priority));
        // Messages of one publisher may be overtaken by later ones of another.
        let longest = if rng.random_bool(0.2) { 400 } else { 9 };
        let least_ns = rng.random_range(0..=longest);
        let transfer = Transfer { least_ns, most_ns: least_ns + rng.random_range(0..=9) };
        way.push(callbacks.len());
        callbacks.push(Callback::new(taker, core).triggered_by(from, transfer));
    }
    let takers: Vec<usize> = ways.iter().map(|way| *way.last().unwrap()).collect();
    let join = callbacks.len();
    let mut fuse = group(Task::new("fuse", ns(1), ns(rng.random_range(1..=12)), priority));
    fuse.bcet_ns = rng.random_range(0..=fuse.wcet_ns);
    callbacks.push(Callback::new(fuse, core).joining_ports(takers, ports, matching));
    let after = rng.random_bool(0.7).then(|| add(&mut callbacks, rng, 40, Some(join)));
    for _ in 0..rng.random_range(0..=2) {
        let period = rng.random_range(20..=100);
        add(&mut callbacks, rng, period, None);
    }
    for way in ways {
        let stages = way.into_iter().chain([join]).chain(after).collect();
        chains.push(Chain::new("way", stages));
    }
    System { cores: vec![Core::default(); 3], callbacks, chains, ..System::default() }
}

/// One job. In `origins`, of each chain that it is a part of: the nominal release of the chain's first job.
#[derive(Clone)]
struct Job {
    callback: usize,
    arrival: i64,
    work: i64,
    stamp: i64,
    origins: Vec<Option<i64>>,
    /// Of each chain: the latest nominal release of its first job that this one reflects.
    reflects: Vec<Option<i64>>,
}

/// The messages that wait in a join.
struct Waiting {
    policy: Decider,
    queues: Vec<Vec<Job>>,
    last_arrival: i64,
    may_refuse: bool,
}

impl Waiting {
    /// The sets that a message completes, which is taken now.
    fn add(&mut self, input: usize, job: Job, now: i64) -> Vec<Vec<Job>> {
        self.last_arrival = self.last_arrival.max(job.arrival);
        let queues = &mut self.queues;
        let take = |queues: &mut Vec<Vec<Job>>| queues.iter_mut().map(|queue| queue.remove(0)).collect();
        let policy = match &mut self.policy {
            Decider::Newest => {
                queues[input] = vec![job];
                let is_set = queues.iter().all(|queue| !queue.is_empty());
                return if is_set { vec![take(queues)] } else { Vec::new() };
            }
            Decider::Rates(policy) => {
                queues[input] = vec![job];
                let is_set = policy.arrived(input, now) && queues.iter().all(|queue| !queue.is_empty());
                return if is_set { vec![queues.concat()] } else { Vec::new() };
            }
            Decider::Stamps(policy) => policy,
        };
        match policy.arrived(input, job.stamp) {
            Arrival::Wait(place) => queues[input].insert(place, job),
            refused => {
                assert!(self.may_refuse && refused == Arrival::Refuse, "the stamps of one publisher ascend");
                return Vec::new();
            }
        }
        let mut sets = Vec::new();
        loop {
            let mut drop = |input: usize| {
                queues[input].remove(0);
            };
            if !policy.decide(&mut drop) {
                return sets;
            }
            sets.push(take(queues));
        }
    }

    /// Of the input of which most wait.
    fn most(&self) -> u64 {
        self.queues.iter().map(Vec::len).max().unwrap_or(0) as u64
    }
}

enum Decider {
    Newest,
    Rates(Box<LatestTime>),
    Stamps(Box<dyn Policy>),
}

/// What was seen at most: responses by callback, waits and reflections by stream of the join, what waited, latencies and reflections by
/// chain, from the nominal release of its first job.
#[derive(Default)]
struct Seen {
    responses: Vec<i64>,
    waits: Vec<i64>,
    reflections: Vec<i64>,
    waiting: u64,
    latencies: Vec<i64>,
    reactions: Vec<i64>,
    sets: u64,
}

const UNTIL: i64 = 6_000;

/// Runs a system for a while, in which each core stops once. Stamps are nominal releases, real ones, or the ends of the first jobs.
fn simulate(system: &System, rng: &mut StdRng, join: usize, stops: &[Range<i64>]) -> Seen {
    let count = system.callbacks.len();
    let matching = system.callbacks[join].join.as_ref().unwrap();
    let inputs = matching.ports.iter().max().unwrap() + 1;
    let streams = matching.inputs.len();
    let by_stamp = !matches!(matching.matching, Matching::Newest | Matching::LatestTime);
    let taker_of = |callback: usize| matching.inputs.iter().position(|taker| *taker == callback);
    let mut seen = Seen {
        responses: vec![0; count],
        waits: vec![0; streams],
        reflections: vec![0; streams],
        latencies: vec![0; system.chains.len()],
        reactions: vec![0; system.chains.len()],
        ..Seen::default()
    };
    let policy = match matching.matching {
        // Which one takes when is the runtime's simulation's.
        Matching::Newest | Matching::NewestTaken => Decider::Newest,
        Matching::Exact => {
            let mut policy = ExactTime::new(1_000);
            policy.start(inputs);
            Decider::Stamps(Box::new(policy))
        }
        Matching::Approximate { window_ns } => {
            let mut policy = ApproximateTime::new(1_000).max_interval(Duration::from_nanos(window_ns));
            if rng.random_bool(0.5) {
                policy = policy.age_penalty(rng.random_range(0.0..2.0));
            }
            policy.start(inputs);
            Decider::Stamps(Box::new(policy))
        }
        Matching::ApproximateEpsilon { window_ns } => {
            let mut policy = ApproximateEpsilonTime::new(1_000, Duration::from_nanos(window_ns));
            policy.start(inputs);
            Decider::Stamps(Box::new(policy))
        }
        Matching::LatestTime => Decider::Rates(Box::default()),
    };
    let queues = vec![Vec::new(); inputs];
    let mut waiting = Waiting { policy, queues, last_arrival: 0, may_refuse: streams > inputs };
    let stamp_of = rng.random_range(0..3);
    let mut pending: Vec<Job> = Vec::new();
    // Of each chain: the nominal releases of its first jobs, with their stamps, or with when their messages came to the join.
    let mut known: Vec<Vec<(i64, i64)>> = vec![Vec::new(); system.chains.len()];
    for (i, callback) in system.callbacks.iter().enumerate().filter(|(_, c)| !c.is_triggered()) {
        let (period, jitter) = (callback.task.period_ns as i64, callback.task.jitter_ns as i64);
        let late = rng.random_bool(0.5);
        let (mut nominal, mut last) = (rng.random_range(0..=period), 0);
        while nominal < UNTIL {
            let delay = if late && nominal < UNTIL / 3 { jitter } else { rng.random_range(0..=jitter) };
            last = last.max(nominal + delay);
            let begins = |chain: &Chain| (stages_of(chain)[0] == i).then_some(nominal);
            let origins: Vec<Option<i64>> = system.chains.iter().map(begins).collect();
            let stamp = if stamp_of == 0 { nominal } else { last };
            for (known, origin) in known.iter_mut().zip(&origins) {
                known.extend(origin.filter(|_| by_stamp && stamp_of != 2).map(|origin| (origin, stamp)));
            }
            pending.push(Job {
                callback: i,
                arrival: last,
                work: execution(system, i, rng),
                stamp,
                reflects: origins.clone(),
                origins,
            });
            nominal += period;
        }
    }
    // Bounds hold once everyone sends: from when the first message of each has come.
    let (mut has_come, mut all_since) = (vec![false; streams], None);
    // What has come in each stream, and to each chain's first job, and is not yet in what followed; and what followed.
    let mut unreflected: Vec<Vec<(i64, i64)>> = vec![Vec::new(); streams];
    let mut newest_set = vec![i64::MIN; inputs];
    let mut unanswered: Vec<Vec<i64>> = vec![Vec::new(); system.chains.len()];
    let mut ready: Vec<Job> = Vec::new();
    let mut delivered: HashMap<usize, i64> = HashMap::new();
    let mut now = 0;
    while !(pending.is_empty() && ready.is_empty()) {
        let (arrived, rest): (Vec<Job>, _) = pending.into_iter().partition(|job| job.arrival <= now);
        pending = rest;
        for job in arrived {
            if let Some(taker) = taker_of(job.callback) {
                has_come[taker] = true;
                let key = if by_stamp { job.stamp } else { job.arrival };
                for (known, origin) in known.iter_mut().zip(&job.origins).filter(|_| !by_stamp) {
                    known.extend(origin.map(|origin| (origin, key)));
                }
                if all_since.is_some() {
                    // By stamp something later may have been in a set before this one came.
                    if key > newest_set[matching.ports[taker]] {
                        unreflected[taker].push((key, job.arrival));
                    }
                } else if has_come.iter().all(|has_come| *has_come) {
                    all_since = Some(job.arrival);
                }
            }
            for (chain, origin) in job.origins.iter().enumerate() {
                if let Some(origin) = origin
                    .filter(|_| stages_of(&system.chains[chain])[0] == job.callback && all_since.is_some())
                {
                    unanswered[chain].push(origin);
                }
            }
            ready.push(job);
        }
        let edges = stops.iter().flat_map(|stop| [stop.start, stop.end]).filter(|edge| *edge > now);
        let next = pending.iter().map(|job| job.arrival).chain(edges).min();
        let running: Vec<usize> = (0..system.cores.len())
            .filter(|core| !stops[*core].contains(&now))
            .filter_map(|core| {
                let here = (0..ready.len()).filter(|j| system.callbacks[ready[*j].callback].core == core);
                // A set is worked on before the next message is taken.
                let rank = |j: &usize| {
                    let job = &ready[*j];
                    (
                        system.callbacks[job.callback].task.priority,
                        job.callback == join,
                        -job.arrival,
                        -(*j as i64),
                    )
                };
                here.max_by_key(rank)
            })
            .collect();
        let work = running.iter().map(|j| ready[*j].work);
        let Some(step) = work.chain(next.map(|next| next - now)).min() else { break };
        now += step;
        running.iter().for_each(|j| ready[*j].work -= step);
        let (done, rest): (Vec<Job>, _) = ready.into_iter().partition(|job| job.work == 0);
        ready = rest;
        for mut job in done {
            seen.responses[job.callback] = (now - job.arrival).max(seen.responses[job.callback]);
            if stamp_of == 2 && !system.callbacks[job.callback].is_triggered() {
                job.stamp = now;
                for (known, origin) in known.iter_mut().zip(&job.origins) {
                    known.extend(origin.filter(|_| by_stamp).map(|origin| (origin, now)));
                }
            }
            for (chain, (origin, reflects)) in job.origins.iter().zip(&job.reflects).enumerate() {
                let is_last = stages_of(&system.chains[chain]).last() == Some(&job.callback);
                if let Some(origin) = origin.filter(|_| is_last) {
                    let counts = all_since.is_some_and(|since| origin >= since);
                    let latency = if counts { now - origin } else { 0 };
                    seen.latencies[chain] = latency.max(seen.latencies[chain]);
                }
                if let Some(origin) = reflects.filter(|_| is_last) {
                    let worst = &mut seen.reactions[chain];
                    unanswered[chain].retain(|before| {
                        *worst = if *before <= origin { (now - before).max(*worst) } else { *worst };
                        *before > origin
                    });
                }
            }
            for (i, callback) in system.callbacks.iter().enumerate() {
                let Some((_, way)) = callback.trigger.filter(|(source, _)| *source == job.callback) else {
                    continue;
                };
                let last = delivered.entry(i).or_default();
                *last = (now + rng.random_range(way.least_ns..=way.most_ns) as i64).max(*last);
                let follows = |(chain, origin): (usize, &Option<i64>)| {
                    let stages = stages_of(&system.chains[chain]);
                    origin.filter(|_| stages.windows(2).any(|pair| pair == [job.callback, i]))
                };
                let origins = job.origins.iter().enumerate().map(follows).collect();
                let reflects = job.reflects.iter().enumerate().map(follows).collect();
                pending.push(Job {
                    callback: i,
                    arrival: *last,
                    work: execution(system, i, rng),
                    stamp: job.stamp,
                    origins,
                    reflects,
                });
            }
            if let Some(taker) = taker_of(job.callback) {
                for set in waiting.add(matching.ports[taker], job, now) {
                    seen.sets += 1;
                    // It may be a message that only shows that no better set comes.
                    let activation = waiting.last_arrival;
                    // At the end some have sent their last message, and bounds hold no more.
                    let is_due = activation < UNTIL;
                    let key = |port: usize| if by_stamp { set[port].stamp } else { set[port].arrival };
                    for (port, message) in set.iter().enumerate() {
                        let counts = is_due && all_since.is_some_and(|since| message.arrival >= since);
                        let wait = if counts { activation - message.arrival } else { 0 };
                        let taker = taker_of(message.callback).unwrap();
                        seen.waits[taker] = wait.max(seen.waits[taker]);
                        newest_set[port] = newest_set[port].max(key(port));
                    }
                    for (taker, unreflected) in unreflected.iter_mut().enumerate() {
                        let (newest, worst) = (key(matching.ports[taker]), &mut seen.reflections[taker]);
                        unreflected.retain(|(key, arrival)| {
                            *worst = if *key <= newest && is_due {
                                (activation - arrival).max(*worst)
                            } else {
                                *worst
                            };
                            *key > newest
                        });
                    }
                    let port_of = |chain: usize| {
                        let stages = stages_of(&system.chains[chain]);
                        let from = stages.windows(2).find(|pair| pair[1] == join)?[0];
                        Some(matching.ports[taker_of(from)?])
                    };
                    let reflected = |chain: usize| {
                        let newest = key(port_of(chain)?);
                        let until = known[chain].partition_point(|(_, key)| *key <= newest);
                        Some(known[chain].get(until.checked_sub(1)?)?.0)
                    };
                    let chains = 0..system.chains.len();
                    ready.push(Job {
                        callback: join,
                        arrival: activation,
                        work: execution(system, join, rng),
                        stamp: 0,
                        origins: chains
                            .clone()
                            .map(|chain| set[port_of(chain)?].origins[chain].filter(|_| is_due))
                            .collect(),
                        reflects: chains.map(|chain| reflected(chain).filter(|_| is_due)).collect(),
                    });
                }
                seen.waiting = waiting.most().max(seen.waiting);
            }
        }
    }
    // What was never answered, as far as there was time to.
    for (chain, origins) in unanswered.iter().enumerate() {
        let over = origins.first().map_or(0, |origin| UNTIL - origin);
        seen.reactions[chain] = seen.reactions[chain].max(over);
    }
    seen
}

fn execution(system: &System, callback: usize, rng: &mut StdRng) -> i64 {
    let task = &system.callbacks[callback].task;
    if rng.random_bool(0.5) {
        return task.wcet_ns as i64;
    }
    rng.random_range(task.bcet_ns.max(1)..=task.wcet_ns) as i64
}

/// What was seen exceeds no bound.
fn check(system: &System, report: &SystemReport, seen: &Seen, join: usize, context: &dyn Fn() -> String) {
    for (i, (worst, bound)) in seen.responses.iter().zip(&report.callbacks).enumerate() {
        let bound = bound.as_ref().unwrap().from_arrival_ns as i64;
        assert!(*worst <= bound, "response of {i}: {worst} > {bound}: {}", context());
    }
    let bound = report.joins[join].as_ref().unwrap();
    for (i, (worst, bound)) in seen.waits.iter().zip(&bound.wait_ns).enumerate() {
        assert!(*worst <= *bound as i64, "wait of stream {i}: {worst} > {bound}: {}", context());
    }
    for (i, worst) in seen.reflections.iter().enumerate() {
        let bound = bound.reflected_ns.as_ref().map_or(i64::MAX, |reflected| reflected[i] as i64);
        assert!(*worst <= bound, "reflection of stream {i}: {worst} > {bound}: {}", context());
    }
    assert!(seen.waiting <= bound.queue_size, "{} wait > {}: {}", seen.waiting, bound.queue_size, context());
    for (i, chain) in report.chains.iter().enumerate() {
        let chain = chain.as_ref().unwrap();
        let (worst, bound) = (seen.latencies[i], chain.latency_ns as i64);
        assert!(worst <= bound, "latency of chain {i}: {worst} > {bound}: {}", context());
        // The reaction time has a period before the first release.
        let period = report.callbacks[stages_of(&system.chains[i])[0]].as_ref().unwrap().period_ns;
        let bound = chain.reaction_ns.map_or(i64::MAX, |reaction| (reaction - period) as i64);
        let worst = seen.reactions[i];
        assert!(worst <= bound, "reaction of chain {i}: {worst} > {bound}: {}", context());
    }
}

#[test]
fn simulated_joins_stay_within_their_bounds() {
    let seed = tautline_seed::seed();
    let count = std::env::var("SYSTEMS").ok().and_then(|count| count.parse().ok()).unwrap_or(2_000);
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut checked, mut several, mut starved, mut sets) = ([0; 5], 0, 0, 0);
    // How close what was seen came to its bound, in percent: waits, reflections, what waits.
    let mut close = [0_i64; 3];
    for round in 0..count {
        let system = random_system(&mut rng);
        // In half of them each core stands still once: all is as if it had been blocked for that long.
        let longest = if rng.random_bool(0.5) { 150 } else { 0 };
        let mut stop = |from: i64| from..from + rng.random_range(0..=longest);
        let stops = [stop(1_000), stop(1_050), stop(1_150)];
        let mut blocked = system.clone();
        for callback in &mut blocked.callbacks {
            callback.task.blocking_ns += (stops[callback.core].end - stops[callback.core].start) as u64;
        }
        let report = blocked.analyse().unwrap();
        if report.callbacks.iter().any(Result::is_err) {
            continue;
        }
        let join = system.callbacks.iter().position(|callback| callback.join.is_some()).unwrap();
        let seen = simulate(&system, &mut rng, join, &stops);
        check(&system, &report, &seen, join, &|| format!("seed {seed}, system {round}: {system:#?}"));
        let bound = report.joins[join].as_ref().unwrap();
        let share = |worst: i64, bound: u64| if bound > 20 { worst * 100 / bound as i64 } else { 0 };
        for (i, worst) in seen.waits.iter().enumerate() {
            close[0] = close[0].max(share(*worst, bound.wait_ns[i]));
            if let Some(reflected) = &bound.reflected_ns {
                close[1] = close[1].max(share(seen.reflections[i], reflected[i]));
            }
        }
        close[2] = close[2].max(seen.waiting as i64 * 100 / bound.queue_size as i64);
        let of = system.callbacks[join].join.as_ref().unwrap();
        several += usize::from(of.ports.windows(2).any(|pair| pair[0] == pair[1]));
        checked[match of.matching {
            Matching::Newest | Matching::NewestTaken => 0,
            Matching::Exact => 1,
            Matching::Approximate { .. } => 2,
            Matching::ApproximateEpsilon { .. } => 3,
            Matching::LatestTime => 4,
        }] += 1;
        starved += usize::from(bound.reflected_ns.is_none());
        sets += seen.sets;
    }
    println!(
        "{checked:?} of each kind, {several} with several publishers of a topic, {starved} may starve, {sets} sets; as near as {close:?} \
         % of the bounds"
    );
    assert!(
        checked.iter().all(|checked| *checked > count / 20)
            && several > count / 8
            && starved > 0
            && sets > 1_000
    );
}

#[test]
fn what_is_longer_than_any_clock_has_no_bound() {
    let long = "15000000000s";
    let text = format!(
        "[hosts.h]\ncores = 1\n[nodes.n]\n[topics]\n\"/a\" = {{ period = \"{long}\" }}\n\"/b\" = {{ period = \"{long}\" }}\n\
         [callbacks.fuse]\nall = [\"/a\", \"/b\"]\nwindow = \"{long}\"\nwcet = \"1ms\"\n"
    );
    // Beyond what 64 bits hold: no bound, and no panic.
    let checked = SystemFile::parse(&text).unwrap().check();
    assert!(!checked.schedulable && checked.callbacks[0].response_ns.is_none(), "{checked:?}");
}

#[test]
fn joins_of_joins_are_walked_once() {
    let topics = |level: usize| (0..9).map(|n| format!("\"/t{level}_{n}\"")).collect::<Vec<_>>().join(", ");
    let mut text = format!(
        "[hosts.h]\ncores = 1\n[nodes.n]\n[callbacks.first]\nperiod = \"1s\"\nwcet = \"1us\"\npublishes = [{}]\n",
        topics(0)
    );
    for level in 1..12 {
        let (all, publishes) = (topics(level - 1), topics(level));
        text +=
            &format!("[callbacks.join{level}]\nall = [{all}]\nwcet = \"1us\"\npublishes = [{publishes}]\n");
    }
    // Eleven levels of nine ways each.
    let file = SystemFile::parse(&text).unwrap();
    assert_eq!(file.system().period_ns(file.system().callbacks.len() - 1), 1_000_000_000);
    assert_eq!(file.check().callbacks.len(), 12);
}

#[test]
fn the_fastest_of_joins_is_left_to_the_analysis() {
    let text = "[hosts.h]\ncores = 1\n[nodes.n]\n[callbacks]\n\
        a = { period = \"10ms\", wcet = \"1us\", publishes = \"/a\" }\n\
        b = { period = \"100ms\", wcet = \"1us\", publishes = \"/b\" }\n\
        ja = { all = [\"/a\", \"/a2\"], wcet = \"1us\", publishes = \"/ja\" }\n\
        jb = { all = [\"/b\", \"/b2\"], wcet = \"1us\", publishes = \"/jb\" }\n\
        a2 = { period = \"10ms\", wcet = \"1us\", publishes = \"/a2\" }\n\
        b2 = { period = \"100ms\", wcet = \"1us\", publishes = \"/b2\" }\n\
        fuse = { all = [\"/ja\", \"/jb\"], policy = \"latest_time\", wcet = \"1us\" }\n";
    let file = SystemFile::parse(text).unwrap();
    let system = file.system();
    let fuse = system.callbacks.iter().position(|callback| callback.task.name == "fuse").unwrap();
    // One each 10 ms and one each 100 ms.
    assert_eq!(system.period_ns(fuse), 100_000_000 / 11);
}

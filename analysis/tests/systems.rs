// SPDX-License-Identifier: MIT OR Apache-2.0
//! Chains over several cores: hand-computed cases, what must be refused, and a simulation of random systems that never
//! exceeds the bounds.

use std::time::Duration;

use rand::{RngExt, SeedableRng, rngs::StdRng};
use tautline_analysis::system::{Callback, Chain, Core, System, Transfer};
use tautline_analysis::{AnalysisError, Order, Task, sensitivity};

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn chain(stages: &[usize]) -> Chain {
    Chain::new("chain", stages.to_vec())
}

fn system(cores: usize, callbacks: Vec<Callback>, stages: &[usize]) -> System {
    System {
        cores: vec![Core::default(); cores],
        callbacks,
        chains: vec![chain(stages)],
        ..System::default()
    }
}

fn task(name: &str, period: u64, wcet: u64, priority: u8) -> Task {
    Task::new(name, ms(period), ms(wcet), priority)
}

#[test]
fn jitter_is_passed_on_over_cores_and_hosts() {
    // Core 0: sense delayed by nothing; core 1: plan, triggered over a network, delays act, which it triggers.
    let network = Transfer { least_ns: 1_000_000, most_ns: 3_000_000 };
    let callbacks = vec![
        Callback::new(task("sense", 10, 2, 2), 0),
        Callback::new(task("other", 20, 4, 1), 0),
        Callback::new(task("plan", 10, 3, 2), 1).triggered_by(0, network),
        Callback::new(task("act", 10, 1, 1), 1).triggered_by(2, Transfer::LOCAL),
    ];
    let report = system(2, callbacks.clone(), &[0, 2, 3]).analyse().unwrap();
    let found: Vec<_> = report.callbacks.iter().map(|c| c.as_ref().unwrap().clone()).collect();
    // J(plan) = 2 + (3 - 1) = 4; R from arrival 3, from nominal 7. J(act) = 7, but it ends 4 after the arrival for `plan`.
    assert_eq!(found.iter().map(|r| r.jitter_ns / 1_000_000).collect::<Vec<_>>(), [0, 0, 4, 7]);
    assert_eq!(found.iter().map(|r| r.from_arrival_ns / 1_000_000).collect::<Vec<_>>(), [2, 6, 3, 4]);
    let bound = report.chains[0].clone().unwrap();
    assert_eq!((bound.latency_ns, bound.reaction_ns, bound.age_ns), (9_000_000, Some(19_000_000), 9_000_000));
    assert!(report.schedulable());

    // Knowing the least execution times makes jitter smaller, and the latency no longer.
    let mut known = callbacks;
    known[0].task.bcet_ns = 2_000_000;
    known[2].task.bcet_ns = 3_000_000;
    let report = system(2, known, &[0, 2, 3]).analyse().unwrap();
    assert_eq!(report.callbacks[3].as_ref().unwrap().jitter_ns, 2_000_000);
    assert_eq!(report.chains[0].as_ref().unwrap().latency_ns, 9_000_000);
}

/// What one thread does for a release is done before the thread idles: its own lateness does not bring the stages closer together.
#[test]
fn a_chain_within_one_thread_is_counted_by_what_starts_it() {
    let stage = |i: usize| match (i, Callback::new(task("stage", 100, 6, 2).group(0, Order::Any), 0)) {
        (0, first) => first,
        (_, stage) => stage.triggered_by(i - 1, Transfer::LOCAL),
    };
    let mut callbacks: Vec<_> = (0..8).map(stage).collect();
    callbacks.push(Callback::new(task("below", 100, 6, 1), 0));
    let report = system(1, callbacks, &[0, 1, 2, 3, 4, 5, 6, 7]).analyse().unwrap();
    for (i, found) in report.callbacks.iter().enumerate() {
        let found = found.as_ref().unwrap_or_else(|error| panic!("{i}: {error}"));
        assert_eq!(found.response_ns, if i < 8 { 48_000_000 } else { 54_000_000 }, "{i}");
        assert_eq!(found.queue_capacity().unwrap(), 1, "{i}");
    }
    assert_eq!(report.chains[0].as_ref().unwrap().latency_ns, 48_000_000);
}

#[test]
fn registers_between_topics_of_the_published_set() {
    let set = [(10, 2, 20), (20, 4, 19), (50, 5, 18), (100, 15, 17), (200, 50, 16)];
    let callbacks = set.map(|(t, c, priority)| Callback::new(task("topic", t, c, priority), 0)).to_vec();
    let system = system(1, callbacks, &[0, 1, 2]);
    let bound = system.analyse().unwrap().chains[0].clone().unwrap();
    assert_eq!(
        (bound.latency_ns, bound.reaction_ns, bound.age_ns),
        (101_000_000, Some(101_000_000), 51_000_000)
    );

    assert_eq!(sensitivity::load(&system), 1_111);
    // Topic 5 alone may take 70 ms in its 200 ms: 200 - 40 - 40 - 20 - 30 = 70.
    assert_eq!(sensitivity::wcet(&system, &[4]), 1_400);
    assert_eq!(sensitivity::wcet(&system, &[5]), 0);
    assert_eq!(sensitivity::overhead(&system), 1_000_000);
}

#[test]
fn what_has_no_bound_says_why() {
    let callbacks = vec![
        Callback::new(task("greedy", 10, 11, 2).deadline(ms(20)), 0),
        Callback::new(task("victim", 10, 1, 2), 1).triggered_by(0, Transfer::LOCAL),
        Callback::new(task("bystander", 10, 1, 1), 1),
        Callback::new(task("spared", 10, 1, 3), 1),
    ];
    let report = system(2, callbacks, &[0, 1]).analyse().unwrap();
    assert!(matches!(report.callbacks[0], Err(AnalysisError::Overload { priority: 2, .. })));
    for i in [1, 2] {
        assert!(
            matches!(&report.callbacks[i], Err(AnalysisError::Upstream { .. })),
            "{:?}",
            report.callbacks[i]
        );
    }
    assert_eq!(
        report.callbacks[1].as_ref().unwrap_err().to_string(),
        "task `victim` has no bounded response time because `greedy`, which triggers or delays it, has none"
    );
    assert!(report.callbacks[3].is_ok());
    assert!(report.chains[0].is_err() && !report.schedulable());
}

#[test]
fn chains_that_delay_each_other_in_a_circle_are_given_up() {
    // Each chain's first stage is delayed by the other chain's last: its jitter lengthens its own cause.
    let callbacks = vec![
        Callback::new(task("a1", 10, 5, 1), 0),
        Callback::new(task("a2", 10, 5, 2), 1).triggered_by(0, Transfer::LOCAL),
        Callback::new(task("b1", 10, 5, 1), 1),
        Callback::new(task("b2", 10, 4, 2), 0).triggered_by(2, Transfer::LOCAL),
    ];
    let report = system(2, callbacks, &[0, 1]).analyse().unwrap();
    assert!(!report.schedulable());
    let errors: Vec<_> =
        report.callbacks.iter().filter_map(|c| c.as_ref().err()).map(ToString::to_string).collect();
    assert!(!errors.is_empty() && errors.iter().any(|e| e.contains('%')), "{errors:?}");
}

#[test]
fn what_refers_to_nothing_or_to_itself_is_refused() {
    let own = Callback::new(task("own", 10, 1, 1), 0);
    let bad = |callback: Callback| system(1, vec![own.clone(), callback], &[]).analyse().unwrap_err();
    let elsewhere = bad(Callback { core: 7, ..own.clone() });
    assert!(matches!(elsewhere, AnalysisError::BadReference { what: "core", index: 7, count: 1, .. }));
    let nothing = bad(own.clone().triggered_by(9, Transfer::LOCAL));
    assert!(matches!(nothing, AnalysisError::BadReference { what: "task", index: 9, .. }));
    let itself = bad(own.clone().triggered_by(1, Transfer::LOCAL));
    assert!(matches!(&itself, AnalysisError::Cycle { tasks } if tasks == "`own`"));
    let report = system(1, vec![own], &[3]).analyse().unwrap();
    assert!(matches!(report.chains[0], Err(AnalysisError::BadReference { index: 3, .. })));
    assert!(system(1, vec![], &[]).analyse().unwrap().chains[0].is_ok(), "an empty chain takes no time");
}

/// One job of the simulation below.
struct Job {
    callback: usize,
    /// When the chain's first job was released.
    origin: i64,
    arrival: i64,
    work: i64,
}

#[test]
fn simulated_chains_stay_within_their_bounds() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let mut checked = 0;
    for set in 0..2_000 {
        let system = random_system(&mut rng);
        let report = system.analyse().unwrap();
        if report.callbacks.iter().any(Result::is_err) {
            continue;
        }
        let (responses, latencies) = simulate(&system, &mut rng, 1_500);
        let context = || format!("seed {seed}, set {set}: {system:#?}");
        for (worst, bound) in responses.iter().zip(&report.callbacks) {
            let bound = bound.as_ref().unwrap().from_arrival_ns as i64;
            assert!(*worst <= bound, "response {worst} > {bound}: {}", context());
        }
        for (chain, bound) in system.chains.iter().zip(&report.chains) {
            let (worst, bound) = (
                latencies[*chain.parts[0].ways[0].last().unwrap()],
                bound.as_ref().unwrap().latency_ns as i64,
            );
            assert!(worst <= bound, "latency {worst} > {bound}: {}", context());
        }
        checked += 1;
    }
    println!("{checked} systems simulated");
    assert!(checked > 500);
}

/// Two to three chains of two to four stages over three cores.
fn random_system(rng: &mut StdRng) -> System {
    let mut callbacks = Vec::new();
    let mut chains = Vec::new();
    let ns = Duration::from_nanos;
    for _ in 0..rng.random_range(2..=3) {
        let period = rng.random_range(20..=100);
        let mut stages: Vec<usize> = Vec::new();
        for _ in 0..rng.random_range(2..=4) {
            let wcet = rng.random_range(1..=period / 5);
            let mut task =
                Task::new(format!("{}", callbacks.len()), ns(period), ns(wcet), rng.random_range(1..=9));
            task.bcet_ns = rng.random_range(0..=wcet);
            let mut callback = Callback::new(task, rng.random_range(0..3));
            if let Some(last) = stages.last() {
                let least_ns = rng.random_range(0..=9);
                let local = rng.random_bool(0.5);
                let network = Transfer { least_ns, most_ns: least_ns + rng.random_range(0..=20) };
                callback = callback.triggered_by(*last, if local { Transfer::LOCAL } else { network });
            } else if rng.random_bool(0.5) {
                callback.task.jitter_ns = rng.random_range(0..=period);
            }
            stages.push(callbacks.len());
            callbacks.push(callback);
        }
        chains.push(chain(&stages));
    }
    System { cores: vec![Core::default(); 3], callbacks, chains, ..System::default() }
}

/// Random offsets, jitter, execution times and transfers; each job publishes when it ends. The longest response from
/// arrival of each callback, and the longest time from the nominal release of its chain.
fn simulate(system: &System, rng: &mut StdRng, until: i64) -> (Vec<i64>, Vec<i64>) {
    let count = system.callbacks.len();
    let (mut responses, mut latencies) = (vec![0; count], vec![0; count]);
    let mut pending: Vec<Job> = Vec::new();
    for (i, callback) in system.callbacks.iter().enumerate().filter(|(_, c)| c.trigger.is_none()) {
        let (period, jitter) = (callback.task.period_ns as i64, callback.task.jitter_ns as i64);
        let late = rng.random_bool(0.5);
        let (mut origin, mut last) = (rng.random_range(0..=period), 0);
        while origin < until {
            // All as late as they can come until some point, then early: bursts.
            let delay = if late && origin < until / 3 { jitter } else { rng.random_range(0..=jitter) };
            last = last.max(origin + delay);
            pending.push(Job { callback: i, origin, arrival: last, work: execution(system, i, rng) });
            origin += period;
        }
    }
    let mut ready: Vec<Job> = Vec::new();
    // Messages of one publisher do not overtake each other.
    let mut delivered = vec![0; count];
    let mut now = 0;
    while !(pending.is_empty() && ready.is_empty()) {
        let (arrived, rest) = pending.into_iter().partition(|job| job.arrival <= now);
        pending = rest;
        ready.extend::<Vec<Job>>(arrived);
        let next = pending.iter().map(|job| job.arrival).min();
        let running: Vec<usize> = (0..system.cores.len())
            .filter_map(|core| {
                let here = (0..ready.len()).filter(|j| system.callbacks[ready[*j].callback].core == core);
                let rank = |j: &usize| {
                    (
                        system.callbacks[ready[*j].callback].task.priority,
                        -ready[*j].arrival,
                        -ready[*j].origin,
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
        for job in done {
            responses[job.callback] = (now - job.arrival).max(responses[job.callback]);
            latencies[job.callback] = (now - job.origin).max(latencies[job.callback]);
            for (i, callback) in system.callbacks.iter().enumerate() {
                let Some((_, way)) = callback.trigger.filter(|(source, _)| *source == job.callback) else {
                    continue;
                };
                let arrival = (now + rng.random_range(way.least_ns..=way.most_ns) as i64).max(delivered[i]);
                delivered[i] = arrival;
                pending.push(Job {
                    callback: i,
                    origin: job.origin,
                    arrival,
                    work: execution(system, i, rng),
                });
            }
        }
    }
    (responses, latencies)
}

fn execution(system: &System, callback: usize, rng: &mut StdRng) -> i64 {
    let task = &system.callbacks[callback].task;
    if rng.random_bool(0.5) {
        return task.wcet_ns as i64;
    }
    rng.random_range(task.bcet_ns.max(1)..=task.wcet_ns) as i64
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! A simulation of the runtime as docs/system-toml.md describes it, written from that page and not from the analysis: random systems near the limit,
//! each run several times with other phases, execution times and delays, of which the worst so far are changed a little and tried again. No
//! response, latency, age, reaction or queue is above its bound. `TAUT_SEED` chooses the systems, `SYSTEMS` how many.
//!
//! Times are whole microseconds. It has every key of docs/system.schema.json that bounds depend on:
//!
//! - hosts: cores, `stall` (which queues outlast), `overheads` of one of them; nodes and their `client`; a network that reorders
//! - triggers: `period`, several topics and publishers, topics from outside with `jitter` and `min_distance`, `depth`; late timers, which keep their newest
//!   release; nodes that start later than others, from whose start bounds hold
//! - joins (`all`, `window`, `policy`, `take`), by the synchronizers' own policies; `reads`, chains
//! - groups: first in, first out, with what they take ahead; any order; by `priority`, with timers, also in executors of two nodes, whose threads may have the
//!   priorities of their callbacks
//! - `priority`, stated or by each policy; `overrun` with each value; `reservation` on a core or any; `non_preemptive` sections
//! - `locks` of both protocols, several of a callback; all `[overheads]`, with `tick` and `throttling`
//!
//! Without effect on a bound are `type`, `priority` and `express` of topics, and `input_max`. `sampler_priority` is above all, or the file has a fault.
//! joins.rs has the synchronizers' reaction times for topics with several publishers.

#[path = "runtime/mod.rs"]
mod runtime;

use std::collections::BTreeMap;

use rand::SeedableRng;
use rand::rngs::StdRng;
use runtime::machine::{Run, Seen, simulate};
use runtime::made_up::{Budget, Model};
use tautline_analysis::file::{CheckedCallback, CheckedSystem, SystemFile};

/// Runs of one system: random ones, then changes of the one that came closest to a bound.
const RUNS: u64 = 12;
/// Of these, how many are random.
const RANDOM: u64 = 6;

#[test]
fn nothing_exceeds_its_bound() {
    hold_against(2_000, "");
}

#[test]
fn nothing_exceeds_its_bound_in_groups_that_go_by_ranks() {
    hold_against(200, "ranks");
}

#[test]
fn nothing_exceeds_its_bound_beside_threads_that_have_the_priorities_of_their_callbacks() {
    hold_against(200, "lowered");
}

/// Searches that run beside each other, each with a seed of its own.
const SEARCHES: u64 = 4;

/// Some systems, all of which have this feature.
fn hold_against(count: u64, feature: &str) {
    let seed = tautline_seed::seed();
    let count = std::env::var("SYSTEMS").ok().and_then(|count| count.parse().ok()).unwrap_or(count);
    let (mut bounded, mut unbounded, mut found) = (0, 0, Found::new());
    std::thread::scope(|scope| {
        let search = |n| scope.spawn(move || search(seed, n, count / SEARCHES, feature));
        for search in (0..SEARCHES).map(search).collect::<Vec<_>>() {
            let (with, without, ratios) = search.join().expect("no response exceeds its bound");
            (bounded, unbounded) = (bounded + with, unbounded + without);
            ratios.into_iter().for_each(|(feature, more)| found.entry(feature).or_default().extend(more));
        }
    });
    println!("{bounded} callbacks with a bound, {unbounded} without; bound / seen:");
    for (feature, ratios) in &mut found {
        ratios.sort_by(f64::total_cmp);
        let at = |share: f64| ratios[((ratios.len() - 1) as f64 * share) as usize];
        println!("  {feature:18} {:6} times, median {:.2}, p90 {:.2}", ratios.len(), at(0.5), at(0.9));
        assert!(*feature != "all responses" || at(0.1) < 1.3);
    }
    assert!(bounded as u64 > count);
}

/// How much larger the bounds are than what was seen, by what the systems have.
type Found = BTreeMap<&'static str, Vec<f64>>;

/// The `n`th search: how many callbacks have a bound and how many have none, and their ratios.
fn search(seed: u64, n: u64, count: u64, feature: &str) -> (usize, usize, Found) {
    let mut rng = StdRng::seed_from_u64(seed.wrapping_add(n));
    let (mut bounded, mut unbounded, mut found) = (0, 0, Found::new());
    for round in 0..count {
        let mut model = Model::random(&mut rng);
        while !feature.is_empty() && !model.features().contains(&feature) {
            model = Model::random(&mut rng);
        }
        let text = model.text();
        // What has no meaning is drawn now and then.
        let senseless = [
            "in a circle",
            "more than its period",
            "in several ways",
            "waits for equal stamps",
            "goes by stamps",
            "at the pace of the fastest",
            "cannot be assigned",
        ];
        let file = match SystemFile::parse(&text) {
            Ok(file) => file,
            Err(problems)
                if problems
                    .0
                    .iter()
                    .all(|problem| senseless.iter().any(|what| problem.message.contains(what))) =>
            {
                continue;
            }
            Err(problems) => panic!("{problems}\n{text}"),
        };
        let checked = file.check();
        for (callback, checked) in model.callbacks.iter_mut().zip(&checked.callbacks) {
            callback.charged = checked.charged_ns / 1_000;
            if model.policy.is_some() && checked.entry.rank.is_none() {
                callback.priority = checked.entry.priority;
            }
        }
        let queue_sizes = |of: &CheckedCallback| of.join.as_ref().map_or(1_000, |join| join.queue_size);
        let queue_sizes: Vec<usize> = checked.callbacks.iter().map(queue_sizes).collect();
        let mut worst = Seen::new(&model);
        let mut closest: Option<(u64, Run)> = None;
        for draw in 0..RUNS {
            let run = match &closest {
                Some((_, run)) if draw >= RANDOM => run.changed(&model, &mut rng),
                _ => Run {
                    is_wild: draw % 2 == 1,
                    queue_sizes: queue_sizes.clone(),
                    ..Run::random(&model, &mut rng)
                },
            };
            let seen = simulate(&model, &run);
            worst.take(&seen);
            let near = nearness(&checked, &seen);
            if closest.as_ref().is_none_or(|(nearest, _)| near >= *nearest) {
                closest = Some((near, run.clone()));
            }
            if model.stall > 0 {
                // Stalls are in no bound but the queues'.
                worst.stalled(&simulate(&model, &Run { stalls: true, is_wild: false, ..run }));
            }
        }
        let mut ratios = Ratios { of: &model.features(), found: &mut found };
        compare(&checked, &worst, &mut ratios, || {
            format!("seed {seed}, search {n}, system {round}:\n{text}")
        });
        if model.stall > 0 {
            say_no_more_with_stalls(&checked, &model, &text);
        }
        let has_bound =
            checked.callbacks.iter().filter(|callback| callback.response_overhead_ns.is_some()).count();
        bounded += has_bound;
        unbounded += checked.callbacks.len() - has_bound;
    }
    (bounded, unbounded, found)
}

/// Stalls make queues deeper and change nothing else; a queue that then has no bound is warned of.
fn say_no_more_with_stalls(checked: &CheckedSystem, model: &Model, text: &str) {
    for callback in checked.callbacks.iter().filter(|of| of.capacity_without_stall.is_some()) {
        let what = format!("callback `{}` has no capacity", callback.entry.name);
        let is_said = checked.warnings.iter().any(|warning| warning.starts_with(&what));
        assert!(callback.capacity.is_some() || is_said, "{text}");
    }
    if model.callbacks.iter().all(|callback| callback.budget == Budget::Tell) {
        let running: Vec<&str> = text.lines().filter(|line| !line.starts_with("stall")).collect();
        let running = SystemFile::parse(&running.join("\n")).unwrap().check();
        assert_eq!((running.schedulable, &running.chains), (checked.schedulable, &checked.chains));
        for (a, b) in running.callbacks.iter().zip(&checked.callbacks) {
            let of = |of: &CheckedCallback| {
                (of.response_ns, of.response_overhead_ns, of.met, of.capacity_without_stall)
            };
            assert_eq!(of(a), of(b));
            assert!(b.capacity.is_none() || a.capacity <= b.capacity);
        }
    }
}

/// How near a response, or a chain, came to its bound, of a million.
fn nearness(checked: &CheckedSystem, seen: &Seen) -> u64 {
    let share = |seen: u64, bound: Option<u64>| seen * 1_000_000_000 / bound.unwrap_or(u64::MAX).max(1);
    let responses = checked.callbacks.iter().zip(&seen.responses);
    let responses = responses.map(|(of, seen)| share(*seen, of.response_overhead_ns));
    let ages = checked.chains.iter().zip(&seen.ages).map(|(of, seen)| share(*seen, of.age_ns));
    let waits = checked.callbacks.iter().zip(&seen.waits).flat_map(|(of, seen)| {
        let inputs = of.join.iter().flat_map(|join| &join.inputs);
        inputs.zip(seen).map(|((_, bound), seen)| share(*seen, *bound))
    });
    responses.chain(ages).chain(waits).max().unwrap_or(0)
}

/// Where the ratios of a system go.
struct Ratios<'r> {
    of: &'r [&'static str],
    found: &'r mut Found,
}

impl Ratios<'_> {
    fn add(&mut self, what: &'static str, bound: u64, seen: u64) {
        if seen > 0 {
            self.found.entry(what).or_default().push(bound as f64 / seen as f64);
        }
    }
}

fn compare(checked: &CheckedSystem, seen: &Seen, ratios: &mut Ratios<'_>, context: impl Fn() -> String) {
    for (i, callback) in checked.callbacks.iter().enumerate() {
        let name = &callback.entry.name;
        if let Some(bound) = callback.response_overhead_ns {
            let longest = seen.responses[i] * 1_000;
            assert!(longest <= bound, "{name}: a response of {longest} ns, bound {bound} ns: {}", context());
            for feature in ["all responses"].iter().chain(ratios.of) {
                ratios.add(feature, bound, longest);
            }
        }
        for (what, longest, capacity) in [
            ("queues", seen.queues_without_stall[i], callback.capacity_without_stall),
            ("queues, stalled", seen.queues[i], callback.capacity),
        ] {
            let Some(capacity) = capacity.filter(|_| !callback.entry.topics.is_empty()) else { continue };
            assert!(
                longest <= capacity,
                "{name}: {what}: {longest} wait, capacity {capacity}: {}",
                context()
            );
            ratios.add(what, capacity as u64, longest as u64);
        }
        let Some(join) = callback.join.as_ref() else { continue };
        let (longest, size) = (seen.held[i], join.queue_size);
        assert!(
            longest <= size,
            "{name}: {longest} messages wait in the join, its size is {size}: {}",
            context()
        );
        ratios.add("join queues", size as u64, longest as u64);
        for ((topic, bound), longest) in join.inputs.iter().zip(&seen.waits[i]) {
            let Some(bound) = bound else { continue };
            let longest = longest * 1_000;
            assert!(longest <= *bound, "{name}: {topic} waits {longest} ns, bound {bound} ns: {}", context());
            ratios.add("join waits", *bound, longest);
        }
    }
    for (i, chain) in checked.chains.iter().enumerate() {
        let name = &chain.name;
        for (what, longest, bound) in [
            ("latency", seen.latencies[i], chain.latency_ns.filter(|_| seen.is_direct[i])),
            ("age", seen.ages[i], chain.age_ns),
            ("reaction", seen.reactions[i], chain.reaction_ns.filter(|_| seen.reflects[i])),
        ] {
            let Some(bound) = bound else { continue };
            assert!(
                longest * 1_000 <= bound,
                "{name}: {what} of {longest} us, bound {bound} ns: {}",
                context()
            );
            ratios.add(what, bound, longest * 1_000);
        }
    }
}

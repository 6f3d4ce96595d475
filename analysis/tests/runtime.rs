// SPDX-License-Identifier: MIT OR Apache-2.0
//! A simulation of the runtime as docs/system-toml.md describes it, written from that page and not from the analysis: random systems near the limit,
//! each run several times with other phases, execution times and delays, of which the worst so far are changed a little and tried again. No
//! response, latency, age, reaction or queue is above its bound. `TAUT_SEED` chooses the systems, `SYSTEMS` how many.
//!
//! Times are whole microseconds. It has timers (late, newest release only), topics from outside, several publishers and triggers, groups, reads,
//! chains, hosts with gateways and a network that reorders, locks of both protocols, sections that nothing preempts, budgets that demote or suspend,
//! reservations, per-message work and ticks. Joins and stalls have simulations of their own (joins.rs, stalls.rs); throttling, floating reservations,
//! least distances and executors of ROS 2 are in no simulation.

mod runtime {
    pub mod machine;
    pub mod made_up;
}

use rand::SeedableRng;
use rand::rngs::StdRng;
use runtime::machine::{Seen, simulate};
use runtime::made_up::Model;
use tautline_analysis::file::{CheckedSystem, SystemFile};

/// Runs of one system: random ones, then changes of the one that came closest to a bound.
const RUNS: u64 = 12;

#[test]
fn nothing_exceeds_its_bound() {
    let seed = tautline_seed::seed();
    let count = std::env::var("SYSTEMS").ok().and_then(|count| count.parse().ok()).unwrap_or(2_000);
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut bounded, mut unbounded, mut ratios) = (0, 0, Vec::new());
    for round in 0..count {
        let model = Model::random(&mut rng);
        let text = model.text();
        // What has no meaning is drawn now and then.
        let senseless = ["in a circle", "more than its period", "in several ways"];
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
        let mut worst = Seen::new(&model);
        for run in 0..RUNS {
            worst.take(&simulate(&model, seed.wrapping_add(round * RUNS + run), run % 2 == 1));
        }
        compare(&checked, &worst, &mut ratios, || format!("seed {seed}, system {round}:\n{text}"));
        let has_bound =
            checked.callbacks.iter().filter(|callback| callback.response_overhead_ns.is_some()).count();
        bounded += has_bound;
        unbounded += checked.callbacks.len() - has_bound;
    }
    ratios.sort_by(f64::total_cmp);
    let at = |share: f64| ratios[((ratios.len() - 1) as f64 * share) as usize];
    println!(
        "{bounded} callbacks with a bound, {unbounded} without; bound / seen: median {:.2}, p90 {:.2}",
        at(0.5),
        at(0.9)
    );
    assert!(bounded as u64 > count && at(0.1) < 1.3);
}

fn compare(checked: &CheckedSystem, seen: &Seen, ratios: &mut Vec<f64>, context: impl Fn() -> String) {
    for (i, callback) in checked.callbacks.iter().enumerate() {
        let name = &callback.entry.name;
        if let Some(bound) = callback.response_overhead_ns {
            let longest = seen.responses[i] * 1_000;
            assert!(longest <= bound, "{name}: a response of {longest} ns, bound {bound} ns: {}", context());
            if longest > 0 {
                ratios.push(bound as f64 / longest as f64);
            }
        }
        if let Some(capacity) = callback.capacity.filter(|_| !callback.entry.topics.is_empty()) {
            assert!(
                seen.queues[i] <= capacity,
                "{name}: {} wait, capacity {capacity}: {}",
                seen.queues[i],
                context()
            );
        }
    }
    for (i, chain) in checked.chains.iter().enumerate() {
        let name = &chain.name;
        for (what, longest, bound) in [
            ("latency", seen.latencies[i], chain.latency_ns.filter(|_| seen.is_direct[i])),
            ("age", seen.ages[i], chain.age_ns),
            ("reaction", seen.reactions[i], chain.reaction_ns),
        ] {
            let Some(bound) = bound else { continue };
            assert!(
                longest * 1_000 <= bound,
                "{name}: {what} of {longest} us, bound {bound} ns: {}",
                context()
            );
        }
    }
}

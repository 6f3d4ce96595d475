// SPDX-License-Identifier: MIT OR Apache-2.0
//! Small random systems, and the steps of a run that other runtimes can follow.

use rand::RngExt;
use rand::rngs::StdRng;

use super::machine::{Run, Seen, Step, simulate};
use super::made_up::{Budget, Callback, Matching, Model, Order};

/// The core of the sensors, which delay nothing, and the one that is looked at.
pub const SENSORS: usize = 1;
pub const HERE: usize = 0;
/// How many messages a join keeps of each topic.
pub const KEPT: usize = 3;
/// The priority of what has none in the runtime, where it sleeps instead of working.
pub const SLEEPING: u8 = 50;

pub fn callback(core: usize, triggers: Vec<usize>) -> Callback {
    Callback {
        core,
        period: 1_000,
        jitter: 0,
        min_distance: 0,
        triggers,
        join: None,
        is_outside: false,
        wcet: 1,
        charged: 0,
        bcet: 1,
        priority: SLEEPING,
        group: None,
        budget: Budget::Tell,
        locks: Vec::new(),
        non_preemptive: 0,
        depth: usize::MAX,
        reads: None,
        also: None,
    }
}

/// Some sensors, each with a timer, or all behind one.
pub fn sensors(rng: &mut StdRng, most: u8, from_one: bool) -> Model {
    let mut callbacks = Vec::new();
    if from_one {
        callbacks.push(callback(SENSORS, Vec::new()));
    }
    for n in 0..rng.random_range(2..=most) {
        let triggers = if from_one { vec![0] } else { Vec::new() };
        let period = rng.random_range(5..40) * 100;
        let jitter = if rng.random_bool(0.3) { rng.random_range(0..period) } else { 0 };
        let wcet = rng.random_range(1..200);
        callbacks.push(Callback { period, jitter, wcet, priority: 60 + n, ..callback(SENSORS, triggers) });
    }
    Model {
        hosts: vec![0, 0],
        callbacks,
        groups: vec![Order::Fifo; 2],
        chains: Vec::new(),
        per_message: vec![0],
        gateway: vec![0],
        switch: 0,
        demotion: 0,
        tick: None,
        floats: false,
        throttling: None,
        stall: 0,
        executors: vec![None; 2],
        has_two_nodes: false,
        network: (0, 0),
        is_ceiling: false,
        policy: None,
    }
}

/// A group that takes a topic of each sensor, often too much of it. One that goes by ranks is an executor of ROS 2: some ranks are alike, and some
/// callbacks take two topics, the messages of both or the newest of each.
pub fn group(rng: &mut StdRng, order: Order) -> Model {
    let is_ranked = order == Order::Rank;
    let mut model = sensors(rng, if is_ranked { 5 } else { 3 }, false);
    let count = model.callbacks.len();
    model.groups[HERE] = order;
    model.executors[HERE] = is_ranked.then_some(0);
    let mut sensor = 0;
    while sensor < count {
        let wcet = rng.random_range(1..=model.callbacks[sensor].period);
        let (depth, priority) = (rng.random_range(1..=4), rng.random_range(1..=4));
        let mut triggers = vec![sensor];
        if is_ranked && sensor + 1 < count && rng.random_bool(0.5) {
            triggers.push(sensor + 1);
        }
        sensor += triggers.len();
        let join = (triggers.len() > 1 && rng.random_bool(0.5)).then_some((Matching::Newest, 1));
        let group = Some(HERE);
        model.callbacks.push(Callback { wcet, depth, priority, group, join, ..callback(HERE, triggers) });
    }
    model
}

/// A run in which what happens at once may happen in any order: what arrives when a job ends is there before the next begins.
pub fn run(rng: &mut StdRng, make: fn(&mut StdRng) -> Model) -> (Model, Seen) {
    loop {
        let model = make(rng);
        let queue_sizes = vec![KEPT; model.callbacks.len()];
        let run = Run { is_wild: true, queue_sizes, until: 20_000, ..Run::random(&model, rng) };
        let mut seen = simulate(&model, &run);
        seen.steps.retain(|(_, step)| model.callbacks[callback_of(step)].core == HERE);
        let resumed = seen.steps.iter().filter_map(|(_, step)| match step {
            Step::Suspended { callback, until } => Some((*until, Step::Resumed { callback: *callback })),
            _ => None,
        });
        seen.steps.extend(resumed.collect::<Vec<_>>());
        seen.steps.sort_by_key(|(at, step)| match step {
            Step::Arrived { .. } => (*at, 0),
            Step::Ended { .. } | Step::Unlocked { .. } | Step::Taken { .. } | Step::Resumed { .. } => {
                (*at, 1)
            }
            _ => (*at, 2),
        });
        if is_clear(&model, &seen.steps) {
            return (model, seen);
        }
    }
}

const fn callback_of(step: &Step) -> usize {
    match step {
        Step::Arrived { callback, .. }
        | Step::Taken { callback, .. }
        | Step::Begun { callback, .. }
        | Step::Demoted { callback }
        | Step::Suspended { callback, .. }
        | Step::Resumed { callback }
        | Step::Blocked { callback, .. }
        | Step::Locked { callback, .. }
        | Step::Unlocked { callback, .. }
        | Step::Ended { callback } => *callback,
    }
}

fn is_clear(model: &Model, steps: &[(u64, Step)]) -> bool {
    let arrivals: Vec<u64> =
        steps.iter().filter(|(_, step)| matches!(step, Step::Arrived { .. })).map(|(at, _)| *at).collect();
    let apart = arrivals.windows(2).all(|pair| pair[0] < pair[1]);
    let takes =
        |at: u64| steps.iter().filter(|(t, step)| *t == at && matches!(step, Step::Taken { .. })).count();
    // While one sleeps, no other uses up its budget, which takes time.
    let mut sleeping = 0;
    let alone = steps.iter().all(|(_, step)| {
        match step {
            Step::Suspended { .. } => sleeping += 1,
            Step::Resumed { .. } => sleeping -= 1,
            _ => {}
        }
        (0..=1).contains(&sleeping)
    });
    let ends = |at: u64| steps.iter().any(|(t, step)| *t == at && matches!(step, Step::Ended { .. }));
    // What a join takes lasts for a step each; threads preempt one another.
    let held = model.callbacks.iter().any(|callback| callback.core == HERE && callback.group.is_none());
    apart
        && alone
        && steps.iter().all(|(at, step)| match step {
            Step::Taken { .. } => {
                !arrivals.iter().any(|arrival| (at + 1 - takes(*at) as u64..=*at).contains(arrival))
            }
            Step::Ended { .. } | Step::Demoted { .. } | Step::Unlocked { .. } => {
                !held || !arrivals.contains(at)
            }
            Step::Resumed { .. } => !arrivals.contains(at) && !ends(*at),
            // Linux runs all that are demoted in turn.
            Step::Blocked { is_demoted, .. } => !is_demoted,
            _ => true,
        })
}

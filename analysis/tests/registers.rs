// SPDX-License-Identifier: MIT OR Apache-2.0
//! Chains whose stages read the latest value at their own pace: simulated reaction times and data ages stay within the
//! bounds, and come close to them.

use std::time::Duration;

use rand::{RngExt, SeedableRng, rngs::StdRng};
use tautline_analysis::system::{Callback, Chain, Core, System};
use tautline_analysis::{Task, response_times};

struct Job {
    stage: usize,
    release: i64,
    work: i64,
    started: Option<i64>,
    /// What it read: which job of the first stage it goes back to, and that job's release.
    input: Option<(usize, i64)>,
}

/// What a run showed.
#[derive(Default)]
struct Seen {
    age: i64,
    reaction: i64,
}

#[test]
fn reaction_times_and_data_ages_stay_within_their_bounds() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut checked, mut closest_age, mut closest_reaction) = (0, 0.0_f64, 0.0_f64);
    for set in 0..3_000 {
        let tasks = random_tasks(&mut rng);
        if !response_times(&tasks).is_ok_and(|found| found.iter().all(|r| r.met)) {
            continue;
        }
        let stages = (0..tasks.len()).collect();
        let chain = Chain::new("registers", stages);
        let callbacks = tasks.iter().map(|task| Callback::new(task.clone(), 0)).collect();
        let system =
            System { cores: vec![Core::default()], callbacks, chains: vec![chain], ..System::default() };
        let bound = system.analyse().unwrap().chains[0].clone().unwrap();
        let seen = simulate(&tasks, &mut rng);
        let context = || format!("seed {seed}, set {set}: {tasks:#?}");
        assert!(seen.age <= bound.age_ns as i64, "age {} > {}: {}", seen.age, bound.age_ns, context());
        let (worst, limit) = (seen.reaction, bound.reaction_ns.unwrap() as i64);
        assert!(worst <= limit, "reaction {worst} > {limit}: {}", context());
        closest_age = closest_age.max(seen.age as f64 / bound.age_ns as f64);
        closest_reaction = closest_reaction.max(worst as f64 / limit as f64);
        checked += 1;
    }
    println!(
        "{checked} chains; at most {closest_age:.2} of the age, {closest_reaction:.2} of the reaction time"
    );
    assert!(checked > 500 && closest_age > 0.7 && closest_reaction > 0.7);
}

/// Two to four stages on one core, in any order of priorities.
fn random_tasks(rng: &mut StdRng) -> Vec<Task> {
    let count = rng.random_range(2..=4);
    let task = |i: u8| {
        let period = rng.random_range(5..=60);
        let wcet = rng.random_range(1..=(period / 3).max(1));
        let ns = Duration::from_nanos;
        Task::new(format!("{i}"), ns(period), ns(wcet), rng.random_range(0..10) * 10 + i)
    };
    (0..count).map(task).collect()
}

/// One core, preemptive; a job reads when it starts and writes when it ends. Random offsets and execution times.
fn simulate(tasks: &[Task], rng: &mut StdRng) -> Seen {
    let mut pending = Vec::new();
    for (stage, task) in tasks.iter().enumerate() {
        let period = task.period_ns as i64;
        let offset = rng.random_range(0..period);
        for k in 0..(2_000 - offset) / period + 1 {
            let work =
                if rng.random_bool(0.6) { task.wcet_ns } else { rng.random_range(1..=task.wcet_ns) } as i64;
            pending.push(Job { stage, release: offset + k * period, work, started: None, input: None });
        }
    }
    pending.sort_by_key(|job| std::cmp::Reverse(job.release));
    let mut ready: Vec<Job> = Vec::new();
    let mut registers: Vec<Option<(usize, i64)>> = vec![None; tasks.len()];
    // When each job of the first stage read its input, and the last that an output has reflected.
    let (mut reads, mut reflected) = (Vec::new(), None);
    let (mut seen, mut now) = (Seen::default(), 0);
    loop {
        while let Some(job) = pending.pop_if(|job| job.release <= now) {
            ready.push(job);
        }
        let next = pending.last().map(|job| job.release);
        if now > 1_900 {
            return seen; // the stages stop one after the other
        }
        let rank = |i: &usize| (tasks[ready[*i].stage].priority, -ready[*i].release);
        let Some(running) = (0..ready.len()).max_by_key(rank) else {
            match next {
                Some(release) => now = release,
                None => return seen,
            }
            continue;
        };
        let job = &mut ready[running];
        if job.started.is_none() {
            job.started = Some(now);
            job.input = match job.stage {
                0 => {
                    reads.push(now);
                    Some((reads.len() - 1, job.release))
                }
                stage => registers[stage - 1],
            };
        }
        let step = next.map_or(job.work, |release| job.work.min(release - now));
        now += step;
        job.work -= step;
        if job.work > 0 {
            continue;
        }
        let done = ready.swap_remove(running);
        registers[done.stage] = done.input;
        let Some((source, sampled)) = done.input.filter(|_| done.stage == tasks.len() - 1) else { continue };
        seen.age = seen.age.max(now - sampled);
        // Events just after the read before are reflected for the first time.
        let fresh: Vec<usize> = (reflected.map_or(source, |last: usize| last + 1)..=source).collect();
        for missed in fresh.iter().filter_map(|i| i.checked_sub(1)) {
            seen.reaction = seen.reaction.max(now - reads[missed]);
        }
        reflected = Some(source);
    }
}

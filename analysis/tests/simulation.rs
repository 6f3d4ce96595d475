// SPDX-License-Identifier: MIT OR Apache-2.0
//! A discrete-event simulation of SCHED_FIFO on one core: it never exceeds the bound, and reaches it at the critical
//! instant.
mod random;

use std::cmp::Reverse;
use std::time::Duration;

use rand::{RngExt, SeedableRng, rngs::StdRng};
use tautline_analysis::timeline::critical_instant;
use tautline_analysis::{
    Order, Overheads, Rank, Response, Task, response_times, response_times_with_overheads,
};

/// `arrival` is nominal, `release` is when the job is ready.
#[derive(Clone, Copy)]
struct Job {
    task: usize,
    priority: u8,
    arrival: i64,
    release: i64,
    work: i64,
}

#[test]
fn simulator_runs_the_published_set_as_published() {
    let ms = Duration::from_millis;
    let set = [(10, 2), (20, 4), (50, 5), (100, 15), (200, 50)];
    let task = |(i, (t, c)): (usize, &(u64, u64))| Task::new(format!("{i}"), ms(*t), ms(*c), 20 - i as u8);
    let tasks: Vec<_> = set.iter().enumerate().map(task).collect();
    let end = busy_window(&tasks);
    let mut jobs = Vec::new();
    for (i, task) in tasks.iter().enumerate() {
        let releases = (0..).map(|k| k * task.period_ns as i64).take_while(|at| *at < end);
        jobs.extend(releases.map(|at| job(i, task, at, at)));
    }
    let bounds = response_times(&tasks).unwrap();
    let expected: Vec<_> = bounds.iter().map(|r| r.response_ns as i64).collect();
    assert_eq!(simulate(jobs, tasks.len()), expected);
}

#[test]
fn bound_is_reached_at_the_critical_instant() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    for set in 0..10_000 {
        let (tasks, overheads, bounds) = bounded_set(&mut rng);
        // Everything is released at 0, as late as its jitter allows; what follows comes as early as it can.
        let mut jobs = Vec::new();
        let end = busy_window(&with_messages(&tasks, &overheads));
        for (i, task) in with_messages(&tasks, &overheads).iter().enumerate() {
            let arrivals = (0..).map(|k| k * task.period_ns as i64 - task.jitter_ns as i64);
            jobs.extend(arrivals.take_while(|at| *at < end).map(|at| job(i, task, at, at.max(0))));
        }
        let worst = simulate(jobs, tasks.len());
        let expected: Vec<_> = bounds.iter().map(|r| r.response_ns as i64).collect();
        assert_eq!(worst, expected, "seed {seed}, set {set}: {overheads:?}, {tasks:#?}");
    }
}

#[test]
fn bound_is_never_exceeded() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    for set in 0..10_000 {
        let (mut tasks, overheads, _) = bounded_set(&mut rng);
        for task in &mut tasks {
            task.priority = task.priority.div_ceil(2); // equal priorities, too
        }
        let Ok(bounds) = response_times_with_overheads(&tasks, &overheads) else { continue };
        let mut jobs = Vec::new();
        for (i, task) in tasks.iter().enumerate() {
            let mut arrival = rng.random_range(0..=task.period_ns as i64);
            let mut released = 0;
            while arrival < 2_000 {
                // Jobs of one task stay in order.
                let release = arrival + rng.random_range(0..=task.jitter_ns as i64);
                released = release.max(released);
                let work = rng.random_range(1..=task.wcet_ns as i64);
                jobs.push(Job { work, ..job(i, task, arrival, released) });
                let message = task.message_overhead_ns.unwrap_or(overheads.per_message_ns) as i64;
                jobs.push(Job {
                    task: usize::MAX,
                    priority: u8::MAX,
                    arrival,
                    release: released,
                    work: message,
                });
                let sporadic = rng.random_range(0..=task.period_ns as i64 / 4);
                arrival += task.period_ns as i64 + sporadic;
            }
        }
        for (worst, bound) in simulate(jobs, tasks.len()).into_iter().zip(bounds) {
            let bound = bound.response_ns as i64;
            assert!(worst <= bound, "seed {seed}, set {set}: {worst} > {bound}: {overheads:?}, {tasks:#?}");
        }
    }
}

/// A random set of distinct priorities that has a bound everywhere, without blocking (nothing here shares a lock).
fn bounded_set(rng: &mut StdRng) -> (Vec<Task>, Overheads, Vec<Response>) {
    loop {
        let mut tasks = random::tasks(rng);
        for (i, task) in tasks.iter_mut().enumerate() {
            task.priority = 1 + i as u8;
            task.blocking_ns = 0;
            if rng.random_bool(0.2) {
                task.message_overhead_ns = Some(rng.random_range(0..=2));
            }
        }
        let per_message_ns = if rng.random_bool(0.5) { rng.random_range(0..=2) } else { 0 };
        let overheads = Overheads { per_message_ns, ..Overheads::NONE };
        if let Ok(bounds) = response_times_with_overheads(&tasks, &overheads) {
            return (tasks, overheads, bounds);
        }
    }
}

/// The tasks, followed by one of the highest priority for each task's messages.
fn with_messages(tasks: &[Task], overheads: &Overheads) -> Vec<Task> {
    let message = |task: &Task| {
        let wcet_ns = task.message_overhead_ns.unwrap_or(overheads.per_message_ns);
        Task { wcet_ns, priority: u8::MAX, ..task.clone() }
    };
    let messages = tasks.iter().map(message).filter(|task| task.wcet_ns > 0);
    tasks.iter().cloned().chain(messages).collect()
}

/// When the core first falls idle after the critical instant, by the sum of all demand.
fn busy_window(tasks: &[Task]) -> i64 {
    let mut end = 1;
    loop {
        let demand = tasks.iter().map(|t| (end + t.jitter_ns).div_ceil(t.period_ns) * t.wcet_ns).sum();
        if demand == end {
            return end as i64;
        }
        end = demand;
    }
}

fn job(task: usize, params: &Task, arrival: i64, release: i64) -> Job {
    Job { task, priority: params.priority, arrival, release, work: params.wcet_ns as i64 }
}

/// Runs the jobs to their end: highest priority first, then first released; returns each task's longest response.
fn simulate(mut jobs: Vec<Job>, tasks: usize) -> Vec<i64> {
    let mut worst = vec![0; tasks];
    jobs.sort_by_key(|job| Reverse(job.release));
    let mut ready: Vec<Job> = Vec::new();
    let mut now = 0;
    loop {
        while let Some(job) = jobs.pop_if(|job| job.release <= now) {
            ready.push(job);
        }
        let next_release = jobs.last().map(|job| job.release);
        let running = (0..ready.len())
            .max_by_key(|&i| (ready[i].priority, Reverse((ready[i].release, ready[i].arrival))));
        match (running, next_release) {
            (None, None) => return worst,
            (None, Some(release)) => now = release,
            (Some(i), release) => {
                let run = release.map_or(ready[i].work, |release| ready[i].work.min(release - now));
                now += run;
                ready[i].work -= run;
                if ready[i].work == 0 {
                    let done = ready.swap_remove(i);
                    if let Some(worst) = worst.get_mut(done.task) {
                        *worst = (now - done.arrival).max(*worst);
                    }
                }
            }
        }
    }
}

/// `high` is first. `low` is taken at the ceiling until 3, and then `own` preempts it until 6. `high` comes again at 8, and waits for `low`.
#[test]
fn a_thread_lowers_itself_once_it_has_taken_a_job() {
    let ns = Duration::from_nanos;
    let of_thread = |name: &str, period, wcet, own| {
        Task::new(name, ns(period), ns(wcet), 30)
            .group(0, Order::Priority)
            .rank(Rank::Of(own))
            .lowered_to(own)
    };
    let low = Task { executor_overhead_ns: 2, ..of_thread("low", 100, 5, 10) };
    let tasks = [of_thread("high", 8, 1, 30), low, Task::new("own", ns(100), ns(3), 20)];
    let timeline = critical_instant(&tasks, &Overheads::NONE, 13);
    let jobs: Vec<_> = timeline.jobs.iter().map(|job| (job.task, job.release_ns, job.end_ns)).collect();
    assert_eq!(jobs, [(0, 0, Some(1)), (1, 0, Some(11)), (2, 0, Some(6)), (0, 8, Some(12))]);
}

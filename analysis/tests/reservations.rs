// SPDX-License-Identifier: MIT OR Apache-2.0
//! SCHED_DEADLINE beside fixed priorities: known values, and a simulation of the kernel's server that never exceeds the bounds.

use std::collections::VecDeque;
use std::time::Duration;

use rand::{RngExt, SeedableRng, rngs::StdRng};
use tautline_analysis::{
    AnalysisError, Order, Overheads, Task, response_time_per_task, response_times,
    response_times_with_overheads,
};

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

#[test]
fn others_are_delayed_by_the_reservation_whatever_the_wcet() {
    let slow = Task::new("slow", ms(50), ms(10), 5);
    for wcet in [1, 3, 400] {
        let points = Task::new("points", ms(2_000), ms(wcet), 1).reserved(ms(4), ms(20));
        let found = response_time_per_task(&[points, slow.clone()], &Overheads::NONE);
        // 10 ms of its own, and two runtimes back to back.
        assert_eq!(found[1].as_ref().unwrap().response_ns, 18_000_000, "{wcet}");
    }
}

#[test]
fn a_job_has_its_runtime_at_once_or_waits_for_the_rest_of_each_period() {
    let of = |wcet, runtime, per_message_ns| {
        let task = Task::new("points", ms(50), ms(wcet), 1).reserved(ms(runtime), ms(20));
        let overheads = Overheads { per_message_ns, ..Overheads::NONE };
        response_times_with_overheads(&[task], &overheads).map(|found| found[0].clone())
    };
    let all = of(4, 4, 0).unwrap();
    assert_eq!((all.response_ns, all.waits_for_reservation), (4_000_000, false));
    // What wakes it may be late: not past the end of the period before, which is 30 ms away.
    assert_eq!(of(4, 5, 1_000_000).unwrap().response_ns, 5_000_000);
    // Its thread may do all of the work per message: 16 ms, 4 ms of runtime, 16 ms, 1 ms.
    assert_eq!(of(4, 4, 1_000_000).unwrap().response_ns, 37_000_000);
    // 16 ms, 4 ms of runtime, 16 ms, 2 ms.
    let parts = of(6, 4, 0).unwrap();
    assert_eq!((parts.response_ns, parts.waits_for_reservation), (38_000_000, true));
    assert!(matches!(
        of(11, 4, 0).unwrap_err(),
        AnalysisError::SmallReservation { charged_ns: 11_000_000, runtime_ns: 4_000_000, .. }
    ));
}

#[test]
fn a_job_for_each_period_needs_some_runtime_to_spare() {
    let of = |runtime_us| {
        let task = Task::new("points", ms(20), ms(4), 1).reserved(Duration::from_micros(runtime_us), ms(20));
        let overheads = Overheads { per_message_ns: 100_000, ..Overheads::NONE };
        response_times_with_overheads(&[task], &overheads).map(|found| found[0].response_ns)
    };
    // It may be woken 0.1 ms early, in a period whose runtime has been used up.
    assert!(of(4_050).is_err());
    assert!(of(4_100).is_err());
    assert_eq!(of(4_150).unwrap(), 4_100_000);
}

#[test]
fn what_has_no_meaning_is_refused() {
    let task = || Task::new("points", ms(20), ms(4), 1);
    let empty = task().reserved(Duration::ZERO, ms(20));
    let long = task().reserved(ms(21), ms(20));
    let shared = task().reserved(ms(5), ms(20)).group(1, Order::Fifo);
    for (task, what) in
        [(empty, "it is empty"), (long, "longer than its period"), (shared, "shares its thread")]
    {
        let error = response_times(&[task]).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
}

/// Times are whole numbers of these, far above what the kernel's rule is exact to.
const UNIT: u64 = 1 << 14;
const HORIZON: u64 = 1_500;

#[test]
fn a_simulation_never_exceeds_the_bounds() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut at_once, mut in_parts, mut fixed) = (0, 0, 0);
    for set in 0..6_000 {
        let (tasks, overheads) = draw(&mut rng);
        let bounds = response_time_per_task(&tasks, &overheads);
        let overruns = rng.random_bool(0.5);
        let worst = simulate(&tasks, &overheads, overruns, &mut rng);
        for (i, (bound, worst)) in bounds.iter().zip(worst).enumerate() {
            let Ok(bound) = bound else { continue };
            if tasks[i].reservation.is_some() {
                if overruns {
                    continue;
                }
                if bound.waits_for_reservation { in_parts += 1 } else { at_once += 1 }
            } else {
                fixed += 1;
            }
            assert!(
                worst * UNIT <= bound.response_ns,
                "seed {seed}, set {set}, task {i}: {} > {} units (overruns: {overruns}), {overheads:?}, {tasks:#?}",
                worst,
                bound.response_ns / UNIT
            );
        }
    }
    println!(
        "{at_once} reservations with their runtime at once, {in_parts} in parts, {fixed} fixed priorities"
    );
    assert!(at_once > 500 && in_parts > 200 && fixed > 3_000);
}

/// One reservation above one to four fixed priorities.
fn draw(rng: &mut StdRng) -> (Vec<Task>, Overheads) {
    let units = |n: u64| Duration::from_nanos(n * UNIT);
    let (period, parts): (u64, u64) = (rng.random_range(4..=60), rng.random_range(1..=3));
    let runtime = rng.random_range(1..=period.div_ceil(2));
    // One job a period, or one for some, which may be longer than the runtime.
    let apart = period * parts + rng.random_range(0..=2);
    let wcet = if rng.random_bool(0.5) {
        rng.random_range(1..=runtime)
    } else {
        rng.random_range(1..=runtime * parts)
    };
    let jitter = if rng.random_bool(0.3) { rng.random_range(0..=apart) } else { 0 };
    let reserved = Task::new("reserved", units(apart), units(wcet), 1).jitter(units(jitter));
    let mut tasks = vec![reserved.reserved(units(runtime), units(period))];
    let count = rng.random_range(1..=4);
    for i in 0..count {
        let period = rng.random_range(5..=120);
        let wcet = rng.random_range(1..=(period / 5).max(1));
        let jitter = if rng.random_bool(0.3) { rng.random_range(0..=period) } else { 0 };
        let task = Task::new(format!("fixed{i}"), units(period), units(wcet), count - i);
        tasks.push(task.jitter(units(jitter)));
    }
    let per_message_ns = rng.random_range(0..=1) * UNIT;
    (tasks, Overheads { per_message_ns, ..Overheads::NONE })
}

struct Job {
    nominal: u64,
    release: u64,
    left: u64,
}

/// The kernel's server, in units: `update_dl_entity`, `dl_entity_overflow`, `replenish_dl_entity` of kernel/sched/deadline.c.
struct Server {
    runtime: u64,
    period: u64,
    left: u64,
    deadline: u64,
    is_throttled: bool,
}

impl Server {
    fn wake(&mut self, now: u64) {
        if now >= self.deadline || self.left * self.period > (self.deadline - now) * self.runtime {
            (self.left, self.deadline, self.is_throttled) = (self.runtime, now + self.period, false);
        }
    }

    fn replenish(&mut self, now: u64) {
        if self.is_throttled && now >= self.deadline {
            (self.left, self.deadline, self.is_throttled) =
                (self.runtime, self.deadline + self.period, false);
        }
    }

    fn run(&mut self) {
        self.left -= 1;
        self.is_throttled = self.left == 0;
    }
}

/// The longest response of each task, from its nominal release, in units. Messages go through the sampler, one after the other, which
/// is above all fixed priorities, and above or below the reservation; whoever waits for one does not run before.
fn simulate(tasks: &[Task], overheads: &Overheads, overruns: bool, rng: &mut StdRng) -> Vec<u64> {
    let mut coming: Vec<VecDeque<Job>> = tasks
        .iter()
        .map(|task| {
            let (period, jitter, wcet) = (task.period_ns / UNIT, task.jitter_ns / UNIT, task.wcet_ns / UNIT);
            let mut nominal = rng.random_range(0..=period);
            let mut jobs: VecDeque<Job> = VecDeque::new();
            while nominal < HORIZON {
                let late = [0, jitter, rng.random_range(0..=jitter)][rng.random_range(0..3)];
                let release = (nominal + late).max(jobs.back().map_or(0, |job| job.release));
                let honest = if rng.random_bool(0.5) { wcet } else { rng.random_range(1..=wcet) };
                let grows = overruns && task.reservation.is_some() && rng.random_bool(0.2);
                let left = if grows { wcet * rng.random_range(2..=100) } else { honest };
                jobs.push_back(Job { nominal, release, left });
                nominal += period + if rng.random_bool(0.3) { rng.random_range(0..=period / 4) } else { 0 };
            }
            jobs
        })
        .collect();
    let reservation = tasks[0].reservation.unwrap();
    let (runtime, period) = (reservation.runtime_ns / UNIT, reservation.period_ns / UNIT);
    let mut server = Server { runtime, period, left: 0, deadline: 0, is_throttled: false };
    let per_message = overheads.per_message_ns / UNIT;
    let sampler_is_above = rng.random_bool(0.5);
    let mut worst = vec![0; tasks.len()];
    // What the sampler still has to do for each message, and whose it is.
    let mut sampler: VecDeque<(u64, usize, Job)> = VecDeque::new();
    let mut ready: Vec<VecDeque<Job>> = tasks.iter().map(|_| VecDeque::new()).collect();
    for now in 0..HORIZON + 2_000 {
        for (i, jobs) in coming.iter_mut().enumerate() {
            while jobs.front().is_some_and(|job| job.release <= now) {
                sampler.extend(jobs.pop_front().map(|job| (per_message, i, job)));
            }
        }
        while sampler.front().is_some_and(|(left, ..)| *left == 0) {
            let Some((_, i, job)) = sampler.pop_front() else { break };
            if i == 0 && ready[0].is_empty() {
                server.wake(now);
            }
            ready[i].push_back(job);
        }
        server.replenish(now);
        let reserved_runs = !ready[0].is_empty() && !server.is_throttled;
        let fixed = (1..tasks.len()).find(|i| !ready[*i].is_empty());
        let runs = match sampler.front_mut() {
            Some((left, ..)) if sampler_is_above || !reserved_runs => {
                *left -= 1;
                continue;
            }
            _ if reserved_runs => Some(0),
            _ => fixed,
        };
        let Some(i) = runs else { continue };
        if i == 0 {
            server.run();
        }
        if let Some(job) = ready[i].front_mut() {
            job.left -= 1;
            if job.left == 0 {
                worst[i] = worst[i].max(now + 1 - job.nominal);
                ready[i].pop_front();
            }
        }
    }
    worst
}

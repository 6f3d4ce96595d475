// SPDX-License-Identifier: MIT OR Apache-2.0
//! What goes beyond one thread for each task: non-preemptive work, shared threads, other release curves, ticks,
//! throttling, priority assignment.
mod random;

use std::time::Duration;

use rand::{SeedableRng, rngs::StdRng};
use tautline_analysis::timeline::critical_instant;
use tautline_analysis::{
    AnalysisError, Order, Overheads, Release, Task, Throttling, assign, hyperbolic_test, liu_layland_bound,
    response_time_per_task, response_times, response_times_with_overheads, utilisation,
};

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// Five topics of a published experiment (ECRTS 2025): (T, C) in ms.
const PAPER: [(u64, u64); 5] = [(10, 2), (20, 4), (50, 5), (100, 15), (200, 50)];

fn paper() -> Vec<Task> {
    let task =
        |(i, (t, c)): (usize, (u64, u64))| Task::new(format!("topic{}", i + 1), ms(t), ms(c), 20 - i as u8);
    PAPER.into_iter().enumerate().map(task).collect()
}

/// Tasks of falling priority from (C, T) in nanoseconds.
fn tasks(set: &[(u64, u64)]) -> Vec<Task> {
    let ns = Duration::from_nanos;
    let task = |(i, (c, t)): (usize, &(u64, u64))| Task::new(format!("{i}"), ns(*t), ns(*c), 50 - i as u8);
    set.iter().enumerate().map(task).collect()
}

fn bounds(tasks: &[Task]) -> Vec<u64> {
    response_times(tasks).unwrap().iter().map(|r| r.response_ns).collect()
}

#[test]
fn work_that_nothing_preempts() {
    let whole = |task: Task| Task { non_preemptive_ns: task.wcet_ns, ..task };
    let set: Vec<_> = tasks(&[(20, 70), (20, 80), (35, 200)]).into_iter().map(whole).collect();
    assert_eq!(bounds(&set), [54, 74, 75]);

    // A section at the end of the lowest task's job delays the others, and itself not at all.
    let mut set = tasks(&[(20, 70), (20, 80), (35, 200)]);
    let free = bounds(&set);
    set[2].non_preemptive_ns = 5;
    assert_eq!(bounds(&set), [free[0] + 4, free[1] + 4, free[2]]);
}

#[test]
fn messages_on_a_can_bus() {
    // Davis et al. 2007: the second job of C is the latest. In that model a frame that has just begun takes all its
    // time; here a nanosecond of it is over.
    let frame = |task: Task| Task { non_preemptive_ns: task.wcet_ns, ..task };
    let mut set: Vec<_> =
        tasks(&[(1_000, 2_500), (1_000, 3_500), (1_000, 3_500)]).into_iter().map(frame).collect();
    assert_eq!(bounds(&set), [1_999, 2_999, 3_500]);
    (set[0].blocking_ns, set[1].blocking_ns) = (1, 1);
    assert_eq!(bounds(&set), [2_000, 3_000, 3_500]);
}

#[test]
fn one_thread_for_all_topics() {
    let thread = |order| -> Vec<Task> {
        paper().into_iter().map(|task| Task { priority: 20, ..task }.group(0, order)).collect()
    };
    let fifo = response_times(&thread(Order::Fifo)).unwrap();
    assert!(fifo.iter().all(|r| r.response() == ms(76)));
    assert_eq!(fifo.iter().map(|r| r.queue_capacity().unwrap()).collect::<Vec<_>>(), [8, 4, 2, 1, 1]);
    assert_eq!(fifo.iter().map(|r| r.met).collect::<Vec<_>>(), [false, false, false, true, true]);

    let any = response_times(&thread(Order::Any)).unwrap();
    assert!(any.iter().all(|r| r.response() == ms(170)));

    // Higher priorities delay the thread; one below it does not.
    let mut mixed = thread(Order::Fifo);
    (mixed[0].group, mixed[0].priority) = (None, 21);
    let found = response_times(&mixed).unwrap();
    assert_eq!((found[0].response(), found[1].response()), (ms(2), ms(4 + 5 + 15 + 50 + 10 * 2)));

    mixed[1].priority = 19;
    assert!(matches!(
        response_time_per_task(&mixed, &Overheads::NONE)[1],
        Err(AnalysisError::MixedGroup { .. })
    ));
}

#[test]
fn threads_are_simulated_within_their_bounds_and_queues() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let mut checked = 0;
    for set in 0..2_000 {
        let mut tasks = random::tasks(&mut rng);
        for (i, task) in tasks.iter_mut().enumerate() {
            task.blocking_ns = 0;
            let order = if set % 2 == 0 { Order::Fifo } else { Order::Any };
            // The first ones share a thread; the others have one each.
            *task = match i {
                0..3 => Task { priority: 4, ..task.clone() }.group(1, order),
                _ => Task { priority: [2, 6, 8][i - 3], ..task.clone() },
            };
        }
        let outcomes = response_time_per_task(&tasks, &Overheads::NONE);
        let timeline = critical_instant(&tasks, &Overheads::NONE, 3_000);
        for (i, outcome) in outcomes.iter().enumerate() {
            let Ok(bound) = outcome else { continue };
            let jobs: Vec<_> = timeline.jobs.iter().filter(|job| job.task == i).collect();
            let context = || format!("seed {seed}, set {set}, task {i} of {tasks:#?}");
            let ended = jobs.iter().filter_map(|job| Some((job.release_ns, job.end_ns?)));
            let longest = ended.map(|(release, end)| end - release).max().unwrap_or(0);
            assert!(longest <= bound.from_arrival_ns, "{longest}: {}", context());
            let Ok(capacity) = bound.queue_capacity() else { continue };
            let open = |at: u64| {
                jobs.iter().filter(move |j| j.release_ns <= at && j.end_ns.is_none_or(|end| end > at))
            };
            let queued = jobs.iter().map(|job| open(job.release_ns).count()).max().unwrap_or(0);
            assert!(queued <= capacity, "{queued} > {capacity}: {}", context());
            checked += 1;
        }
    }
    assert!(checked > 2_000);
}

#[test]
fn a_trace_in_place_of_a_period() {
    // Bursts of three, 10 ms apart each, every 100 ms.
    let instants: Vec<_> =
        (0..20).flat_map(|k: u64| [0, 10, 20].map(|at| (k * 100 + at) * 1_000_000)).collect();
    let burst = Task::new("burst", ms(1), ms(8), 2).released(Release::from_trace(&instants).unwrap());
    let slow = Task::new("slow", ms(100), ms(10), 1);
    let as_sporadic = burst.clone().released(Release::sporadic(10_000_000));
    // 3 x 8 + 10 by the trace; by its shortest distance alone the burst would never end.
    assert_eq!(response_times(&[burst, slow.clone()]).unwrap()[1].response(), ms(34));
    assert_eq!(response_times(&[as_sporadic, slow]).unwrap()[1].response(), ms(50));
}

#[test]
fn a_minimum_distance_limits_bursts() {
    let late = Task::new("late", ms(10), ms(2), 2).jitter(ms(30));
    let low = Task::new("low", ms(100), ms(10), 1);
    let free = response_times(&[late.clone(), low.clone()]).unwrap();
    let apart = Task { min_distance_ns: 5_000_000, ..late };
    let limited = response_times(&[apart, low]).unwrap();
    // Four at once and one more on the way; against one every 5 ms.
    assert_eq!((free[1].response(), limited[1].response()), (ms(20), ms(18)));
    assert_eq!((free[0].queue_capacity(), limited[0].queue_capacity()), (Ok(4), Ok(1)));
}

#[test]
fn ticks_and_throttling() {
    let tick = Overheads { tick_period_ns: 4_000_000, tick_ns: 10_000, ..Overheads::NONE };
    let found = response_times_with_overheads(&paper(), &tick).unwrap();
    assert_eq!(found[0].response(), ms(2) + Duration::from_micros(10));
    assert_eq!(found[1].response(), ms(6) + Duration::from_micros(20));

    // 900 ms in each second are within Linux's 950: no pause. With 850 allowed, a pause may hit everyone.
    let limit = |runtime: u64| Throttling { runtime_ns: runtime * 1_000_000, ..Throttling::LINUX };
    let throttled = |limit| Overheads { throttling: Some(limit), ..Overheads::NONE };
    let free = response_times_with_overheads(&paper(), &throttled(limit(950))).unwrap();
    assert_eq!(free, response_times(&paper()).unwrap());
    let outcomes = response_time_per_task(&paper(), &throttled(limit(850)));
    assert_eq!(outcomes[0].as_ref().unwrap().response(), ms(152));
    assert!(matches!(outcomes[4], Err(AnalysisError::Overload { .. })));
}

#[test]
fn priorities_by_rate_by_deadline_and_by_search() {
    let mut set = paper();
    assert_eq!(assign::rate_monotonic(&set, 20).unwrap(), [20, 19, 18, 17, 16]);
    set[4].deadline_ns = 1_000_000;
    assert_eq!(assign::deadline_monotonic(&set, 9).unwrap(), [8, 7, 6, 5, 9]);
    assert!(matches!(
        assign::rate_monotonic(&set, 4),
        Err(AnalysisError::TooFewPriorities { levels: 5, highest: 4 })
    ));
    let found = assign::audsley(&paper(), &Overheads::NONE, 20).unwrap();
    assert_eq!(found, [20, 19, 18, 17, 16]);
    let error = assign::audsley(&set, &Overheads::NONE, 20).unwrap_err();
    assert!(error.to_string().contains("none of `topic4`, "), "{error}");
}

#[test]
fn search_finds_an_order_whenever_there_is_one() {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut found, mut none) = (0, 0);
    for set in 0..500 {
        let mut tasks = random::tasks(&mut rng);
        tasks.truncate(4);
        for task in &mut tasks {
            task.deadline_ns = task.period_ns.max(task.wcet_ns * 2);
        }
        let meets = |tasks: &[Task], order: &[u8]| {
            let placed =
                tasks.iter().zip(order).map(|(t, priority)| Task { priority: *priority, ..t.clone() });
            response_times(&placed.collect::<Vec<_>>()).is_ok_and(|found| found.iter().all(|r| r.met))
        };
        match assign::audsley(&tasks, &Overheads::NONE, 10) {
            Ok(order) => {
                assert!(meets(&tasks, &order), "seed {seed}, set {set}: {order:?} of {tasks:#?}");
                found += 1;
            }
            Err(AnalysisError::NoAssignment { .. }) => {
                let any = permutations(tasks.len()).into_iter().find(|order| meets(&tasks, order));
                assert_eq!(any, None, "seed {seed}, set {set}: {tasks:#?}");
                none += 1;
            }
            Err(error) => panic!("seed {seed}, set {set}: {error}"),
        }
    }
    assert!(found > 50 && none > 50, "{found} {none}");
}

fn permutations(count: usize) -> Vec<Vec<u8>> {
    if count == 0 {
        return vec![vec![]];
    }
    let shorter = permutations(count - 1);
    let insert = |at| shorter.iter().map(move |p: &Vec<u8>| [&p[..at], &[count as u8], &p[at..]].concat());
    (0..count).flat_map(insert).collect()
}

#[test]
fn tests_on_utilisation_never_pass_wrongly() {
    assert_eq!((liu_layland_bound(1), liu_layland_bound(0)), (1.0, 1.0));
    assert!((liu_layland_bound(1_000) - std::f64::consts::LN_2).abs() < 1e-3);
    assert!(!hyperbolic_test(&paper()), "nothing is known of 0.9");
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let mut passed = 0;
    for _ in 0..2_000 {
        let mut set = random::large(&mut rng);
        set.iter_mut().for_each(|task| task.jitter_ns = 0);
        let priorities = assign::rate_monotonic(&set, 99).unwrap();
        set.iter_mut().zip(priorities).for_each(|(task, priority)| task.priority = priority);
        if utilisation(&set) <= liu_layland_bound(set.len()) {
            assert!(hyperbolic_test(&set), "seed {seed}: {set:#?}");
        }
        if hyperbolic_test(&set) {
            passed += 1;
            assert!(response_times(&set).unwrap().iter().all(|r| r.met), "seed {seed}: {set:#?}");
        }
    }
    assert!(passed > 500);
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Agreement with the crate `response-time-analysis`, which implements machine-checked proofs, on random task sets.
//! It counts from the actual arrival, as `Response::from_arrival_ns` does.
mod random;

use rand::SeedableRng;
use rand::rngs::StdRng;
use response_time_analysis::arrival::Sporadic;
use response_time_analysis::demand::{RBF, Slice};
use response_time_analysis::fixed_priority::{floating_nonpreemptive, fully_nonpreemptive};
use response_time_analysis::time::{Duration, Service};
use response_time_analysis::{fifo, wcet::Scalar};
use tautline_analysis::{AnalysisError, Order, Overheads, Task, response_time_per_task};

/// Longer than any busy window of the random sets that are not overloaded.
const BOUNDED: u64 = 1_000_000_000;

/// Long enough to call a busy window endless; at exactly 100 % it grows too slowly for more.
const ENDLESS: u64 = 500_000;

/// Compares every task of every set; returns how many had a bound, and how many had none.
fn compare(
    sets: usize,
    draw: fn(&mut StdRng) -> Vec<Task>,
    oracle: fn(&[Task], usize, u64) -> Option<u64>,
) -> (usize, usize) {
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut bounded, mut unbounded) = (0, 0);
    for set in 0..sets {
        let tasks = draw(&mut rng);
        for (i, found) in response_time_per_task(&tasks, &Overheads::NONE).into_iter().enumerate() {
            let context = || format!("seed {seed}, set {set}, task {i} of {tasks:#?}");
            match found {
                Ok(response) => {
                    assert_eq!(Some(response.from_arrival_ns), oracle(&tasks, i, BOUNDED), "{}", context());
                    // Own jitter comes on top for the first job of a window, and at most for later ones.
                    let added = response.response_ns - response.from_arrival_ns;
                    assert!(added <= tasks[i].jitter_ns, "{}", context());
                    if response.response_ns <= tasks[i].period_ns && tasks[i].non_preemptive_ns == 0 {
                        assert_eq!(added, tasks[i].jitter_ns, "{}", context());
                    }
                    bounded += 1;
                }
                Err(AnalysisError::Overload { .. } | AnalysisError::NoSlack { .. }) => {
                    assert_eq!(None, oracle(&tasks, i, ENDLESS), "{}", context());
                    unbounded += 1;
                }
                // Its busy window ends, but nobody follows it there.
                Err(AnalysisError::IterationLimit { utilisation, .. }) if utilisation > 0.999 => {}
                Err(error) => panic!("{error}: {}", context()),
            }
        }
    }
    println!("equal: {bounded} bounds; {unbounded} without a bound");
    (bounded, unbounded)
}

#[test]
fn agrees_on_10_000_sets_of_2_to_20_tasks() {
    let (bounded, _) = compare(10_000, random::large, preemptive);
    assert!(bounded > 50_000);
}

#[test]
fn agrees_on_small_sets_with_blocking_jitter_and_overload() {
    let (bounded, unbounded) = compare(10_000, random::tasks, preemptive);
    assert!(bounded > 10_000 && unbounded > 1_000);
}

#[test]
fn agrees_where_nothing_is_preempted() {
    let draw = |rng: &mut StdRng| {
        let tasks = random::tasks(rng).into_iter();
        tasks.map(|task| Task { blocking_ns: 0, non_preemptive_ns: task.wcet_ns, ..task }).collect()
    };
    let (bounded, unbounded) = compare(5_000, draw, non_preemptive);
    assert!(bounded > 5_000 && unbounded > 1_000);
}

#[test]
fn agrees_on_first_in_first_out_threads() {
    let draw = |rng: &mut StdRng| {
        // A single task has a thread of its own, which is another analysis.
        let tasks = std::iter::repeat_with(|| random::tasks(rng)).find(|tasks| tasks.len() > 1);
        let group = |task: Task| Task { blocking_ns: 0, priority: 1, ..task }.group(7, Order::Fifo);
        tasks.into_iter().flatten().map(group).collect()
    };
    let seed = tautline_seed::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let mut bounded = 0;
    for set in 0..5_000 {
        let tasks: Vec<Task> = draw(&mut rng);
        let rbfs: Vec<_> = tasks.iter().map(rbf).collect();
        let limit = |ns: u64| fifo::dedicated_uniproc_rta(&Slice::of(&rbfs), Duration::from(ns)).ok();
        for found in response_time_per_task(&tasks, &Overheads::NONE) {
            let found = found.ok().map(|response| response.from_arrival_ns);
            let expected = limit(if found.is_some() { BOUNDED } else { ENDLESS }).map(u64::from);
            assert_eq!(found, expected, "seed {seed}, set {set} {tasks:#?}");
            bounded += usize::from(found.is_some());
        }
    }
    assert!(bounded > 5_000);
}

fn rbf(task: &Task) -> RBF<Sporadic, Scalar> {
    let (period, jitter) = (Duration::from(task.period_ns), Duration::from(task.jitter_ns));
    RBF::new(Sporadic::new(period, jitter), Scalar::new(Service::from(task.wcet_ns)))
}

fn interference(tasks: &[Task], index: usize) -> Vec<RBF<Sporadic, Scalar>> {
    let competes = |(other, task): &(usize, &Task)| *other != index && task.priority >= tasks[index].priority;
    tasks.iter().enumerate().filter(competes).map(|(_, task)| rbf(task)).collect()
}

fn preemptive(tasks: &[Task], index: usize, horizon: u64) -> Option<u64> {
    use floating_nonpreemptive::{TaskUnderAnalysis, dedicated_uniproc_rta};
    let blocking_bound = Service::from(tasks[index].blocking_ns);
    let analysed = TaskUnderAnalysis { rbf: &rbf(&tasks[index]), blocking_bound };
    let outcome = dedicated_uniproc_rta(&analysed, &interference(tasks, index), Duration::from(horizon));
    outcome.ok().map(u64::from)
}

fn non_preemptive(tasks: &[Task], index: usize, horizon: u64) -> Option<u64> {
    use fully_nonpreemptive::{TaskUnderAnalysis, dedicated_uniproc_rta};
    let task = &tasks[index];
    let lower = tasks.iter().filter(|other| other.priority < task.priority);
    let analysed = TaskUnderAnalysis {
        wcet: Scalar::new(Service::from(task.wcet_ns)),
        arrivals: &Sporadic::new(Duration::from(task.period_ns), Duration::from(task.jitter_ns)),
        blocking_bound: Service::from(lower.map(|other| other.wcet_ns - 1).max().unwrap_or(0)),
    };
    let outcome = dedicated_uniproc_rta(&analysed, &interference(tasks, index), Duration::from(horizon));
    outcome.ok().map(u64::from)
}

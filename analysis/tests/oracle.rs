// SPDX-License-Identifier: MIT OR Apache-2.0
//! Agreement with the crate `response-time-analysis`, which implements machine-checked proofs, on random task sets.
mod random;

use rand::SeedableRng;
use rand::rngs::StdRng;
use response_time_analysis::fixed_priority::floating_nonpreemptive::{
    TaskUnderAnalysis, dedicated_uniproc_rta,
};
use response_time_analysis::time::{Duration, Service};
use response_time_analysis::{arrival::Sporadic, demand::RBF, wcet::Scalar};
use tautline_analysis::{AnalysisError, Overheads, Task, response_time_per_task};

/// Longer than any busy window of the random sets that are not overloaded.
const BOUNDED: u64 = 1_000_000_000;

/// Long enough to call a busy window endless; at exactly 100 % it grows too slowly for more.
const ENDLESS: u64 = 500_000;

#[test]
fn agrees_on_random_task_sets() {
    let seed = random::seed();
    let mut rng = StdRng::seed_from_u64(seed);
    let (mut bounded, mut own_jitter, mut unbounded) = (0, 0, 0);
    for set in 0..10_000 {
        let tasks = random::tasks(&mut rng);
        for (i, found) in response_time_per_task(&tasks, &Overheads::NONE).into_iter().enumerate() {
            let task = &tasks[i];
            let context = || format!("seed {seed}, set {set}, task {i} of {tasks:#?}");
            match found {
                // The oracle counts from the actual release, so own jitter comes on top for the first job only.
                Ok(response) if task.jitter_ns > 0 => {
                    let window = oracle(&tasks, i, BOUNDED).unwrap_or_else(|| panic!("{}", context()));
                    let added = response.response_ns - window;
                    assert!(added <= task.jitter_ns, "{}", context());
                    if response.response_ns <= task.period_ns {
                        assert_eq!(added, task.jitter_ns, "{}", context());
                        own_jitter += 1;
                    }
                }
                Ok(response) => {
                    assert_eq!(Some(response.response_ns), oracle(&tasks, i, BOUNDED), "{}", context());
                    bounded += 1;
                }
                Err(AnalysisError::Overload { .. } | AnalysisError::NoSlack { .. }) => {
                    assert_eq!(None, oracle(&tasks, i, ENDLESS), "{}", context());
                    unbounded += 1;
                }
                Err(error) => panic!("{error}: {}", context()),
            }
        }
    }
    println!("equal: {bounded} bounds, {own_jitter} more with own jitter; {unbounded} without a bound");
    assert!(bounded > 10_000 && own_jitter > 1_000 && unbounded > 1_000);
}

fn oracle(tasks: &[Task], index: usize, horizon: u64) -> Option<u64> {
    let rbf = |task: &Task| {
        let (period, jitter) = (Duration::from(task.period_ns), Duration::from(task.jitter_ns));
        RBF::new(Sporadic::new(period, jitter), Scalar::new(Service::from(task.wcet_ns)))
    };
    let competes = |(other, task): &(usize, &Task)| *other != index && task.priority >= tasks[index].priority;
    let interference: Vec<_> = tasks.iter().enumerate().filter(competes).map(|(_, task)| rbf(task)).collect();
    let analysed = TaskUnderAnalysis {
        rbf: &rbf(&tasks[index]),
        blocking_bound: Service::from(tasks[index].blocking_ns),
    };
    dedicated_uniproc_rta(&analysed, &interference, Duration::from(horizon)).ok().map(u64::from)
}

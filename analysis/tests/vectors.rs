// SPDX-License-Identifier: MIT OR Apache-2.0
//! Published and hand-computed results, and what must be refused.
use std::time::Duration;

use tautline_analysis::{
    AnalysisError, Overheads, Task, response_time_per_task, response_times, response_times_with_overheads,
};

/// Tasks of falling priority from (C, T) in microseconds.
fn tasks(set: &[(u64, u64)]) -> Vec<Task> {
    let us = Duration::from_micros;
    let task =
        |(i, (c, t)): (usize, &(u64, u64))| Task::new(format!("task{}", i + 1), us(*t), us(*c), 50 - i as u8);
    set.iter().enumerate().map(task).collect()
}

/// Five topics of a published experiment (ECRTS 2025), in microseconds.
fn paper() -> Vec<Task> {
    tasks(&[(2_000, 10_000), (4_000, 20_000), (5_000, 50_000), (15_000, 100_000), (50_000, 200_000)])
}

/// Response times in nanoseconds.
fn bounds(tasks: &[Task]) -> Vec<u64> {
    response_times(tasks).unwrap().iter().map(|r| r.response_ns).collect()
}

fn us(values: &[u64]) -> Vec<u64> {
    values.iter().map(|us| us * 1_000).collect()
}

#[test]
fn classic_sets() {
    for (set, expected) in [
        (&[(3, 7), (3, 12), (5, 20)][..], &[3, 6, 20][..]),
        (&[(5, 20), (10, 40), (40, 80)], &[5, 15, 80]),
        (&[(1, 4), (1, 5), (3, 9), (3, 18)], &[1, 2, 7, 18]),
        // Lehoczky 1990, examples 3 and 2: the longest response is not that of the first job.
        (&[(26, 70), (62, 100)], &[26, 118]),
        (&[(52, 100), (52, 140)], &[52, 156]),
        (&[(52, 140), (52, 100)], &[52, 108]),
    ] {
        assert_eq!(bounds(&tasks(set)), us(expected), "{set:?}");
    }
    assert_eq!(response_times(&[]), Ok(vec![]));
}

#[test]
fn paper_set() {
    assert_eq!(bounds(&paper()), us(&[2_000, 6_000, 13_000, 36_000, 170_000]));
    for response in response_times(&paper()).unwrap() {
        assert!(response.met);
        assert_eq!(response.queue_capacity(), Ok(1));
    }
    // The order of the tasks does not matter, only their priorities.
    let mut reversed = paper();
    reversed.reverse();
    assert_eq!(bounds(&reversed), us(&[170_000, 36_000, 13_000, 6_000, 2_000]));
}

#[test]
fn paper_set_with_message_overhead() {
    for (overhead_us, expected_us) in [
        (15, [2_075, 6_075, 13_090, 36_135, 172_510]),
        (60, [2_300, 6_300, 13_360, 36_540, 174_040]),
        (200, [3_000, 7_000, 14_200, 37_800, 178_800]),
        (300, [3_500, 7_500, 14_800, 38_700, 188_800]),
        (500, [4_500, 8_500, 16_000, 47_500, 198_500]),
    ] {
        let overheads = Overheads { per_message_ns: overhead_us * 1_000, ..Overheads::NONE };
        let responses = response_times_with_overheads(&paper(), &overheads).unwrap();
        let found: Vec<_> = responses.iter().map(|r| r.response_ns).collect();
        assert_eq!(found, us(&expected_us), "{overhead_us} µs");

        // The same overhead given task by task.
        let own = paper().into_iter().map(|t| t.message_overhead(Duration::from_micros(overhead_us)));
        let own: Vec<_> = own.collect();
        assert_eq!(response_times_with_overheads(&own, &Overheads::NONE).as_ref(), Ok(&responses));
        assert_eq!(response_times(&own), response_times(&paper()), "the classic analysis ignores overheads");
    }
}

#[test]
fn critical_scaling_is_one_over_the_utilisation() {
    let scaled = |permille: u64| -> Vec<Task> {
        let scale = |task: Task| Task { wcet_ns: task.wcet_ns * permille / 1_000, ..task };
        paper().into_iter().map(scale).collect()
    };
    assert!(response_times(&scaled(1_111)).unwrap().iter().all(|r| r.met));
    assert!(matches!(response_times(&scaled(1_112)), Err(AnalysisError::Overload { priority: 46, .. })));
}

#[test]
fn context_switches_are_charged_twice_for_each_job() {
    let overheads = Overheads { context_switch_ns: 500, ..Overheads::NONE };
    let with = response_times_with_overheads(&paper(), &overheads).unwrap();
    let inflated: Vec<_> = paper().into_iter().map(|t| Task { wcet_ns: t.wcet_ns + 1_000, ..t }).collect();
    assert_eq!(with, response_times(&inflated).unwrap());
}

#[test]
fn jitter_and_blocking() {
    let ms = Duration::from_micros;
    let mut set = tasks(&[(2, 10), (4, 20), (5, 50)]);
    set[0] = set[0].clone().jitter(ms(3));
    set[1] = set[1].clone().blocking(ms(4));
    // R1 = 2 + 3. w2 = 4 + 4 + 2 ceil(13 / 10) = 12. w3 = 5, 9 + 4, 5 + 4 + 2 * 2 = 13.
    assert_eq!(bounds(&set), us(&[5, 12, 13]));
    // Jitter beyond the period: two jobs are ready at once, and the second was nominally due at -2.
    let late = [tasks(&[(2, 10)])[0].clone().jitter(ms(12)).deadline(ms(13))];
    let response = &response_times(&late).unwrap()[0];
    assert_eq!((response.response_ns, response.met), (14_000, false));
    assert_eq!(response.queue_capacity(), Ok(2));
}

#[test]
fn equal_priorities_delay_each_other() {
    let mut set = tasks(&[(2, 10), (4, 20)]);
    set[1].priority = set[0].priority;
    assert_eq!(bounds(&set), us(&[6, 6]));
}

#[test]
fn a_full_level_gives_bounds_but_no_queue() {
    let set = tasks(&[(5, 20), (10, 40), (40, 80)]);
    let responses = response_times(&set).unwrap();
    assert_eq!(responses[1].queue_capacity(), Ok(1));
    assert!(matches!(responses[2].queue_capacity(), Err(AnalysisError::NoSlack { priority: 48, .. })));

    let jitter = [set[0].clone().jitter(Duration::from_nanos(1)), set[1].clone(), set[2].clone()];
    assert!(matches!(response_times(&jitter), Err(AnalysisError::NoSlack { priority: 48, .. })));
}

#[test]
fn overload_names_its_level_and_spares_those_above() {
    let set = tasks(&[(5, 10), (6, 10), (1, 1_000)]);
    let outcomes = response_time_per_task(&set, &Overheads::NONE);
    assert_eq!(outcomes[0].as_ref().unwrap().response_ns, 5_000);
    assert_eq!(
        outcomes[1].as_ref().unwrap_err().to_string(),
        "task `task2` has no bounded response time: the work at priority 49 and above, overheads included, needs \
         110.0 % of the core (the limit is 100 %): lower a rate or a wcet, or move a task to another core"
    );
    assert!(matches!(outcomes[2], Err(AnalysisError::Overload { priority: 48, .. })));
    assert_eq!(response_times(&set), Err(outcomes[1].clone().unwrap_err()));
}

#[test]
fn a_busy_window_without_end_in_sight_is_given_up() {
    let endless = [
        Task::new("short", Duration::from_nanos(3), Duration::from_nanos(2), 2),
        Task::new(
            "long",
            Duration::from_nanos(3_000_000_000_001),
            Duration::from_nanos(1_000_000_000_000),
            1,
        )
        .jitter(Duration::from_secs(1_000_000_000)),
    ];
    assert!(matches!(response_times(&endless), Err(AnalysisError::IterationLimit { priority: 1, .. })));
}

#[test]
fn bad_input_is_an_error() {
    let good = paper().swap_remove(0);
    let check = |task: Task| response_times(&[task]).unwrap_err();
    let name = || good.name.clone();
    assert_eq!(check(Task { period_ns: 0, ..good.clone() }), AnalysisError::ZeroPeriod { task: name() });
    assert_eq!(check(Task { wcet_ns: 0, ..good.clone() }), AnalysisError::ZeroWcet { task: name() });
    assert_eq!(
        check(good.clone().jitter(Duration::MAX)),
        AnalysisError::TooLong { task: name(), field: "jitter" }
    );
    // One nanosecond under the limit in every field: the result no longer fits.
    let most =
        Task { jitter_ns: u64::MAX - 1, blocking_ns: u64::MAX - 1, period_ns: u64::MAX - 1, ..good.clone() };
    assert_eq!(check(most), AnalysisError::Overflow { task: name() });
    let overheads = Overheads { context_switch_ns: u64::MAX, per_message_ns: u64::MAX, ..Overheads::NONE };
    let error = response_times_with_overheads(std::slice::from_ref(&good), &overheads).unwrap_err();
    assert_eq!(error, AnalysisError::Overflow { task: name() });
}

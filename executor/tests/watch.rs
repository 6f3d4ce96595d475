// SPDX-License-Identifier: MIT OR Apache-2.0
//! Budgets, deadlines and their handlers: called after the job, on its thread, before the next one.

mod common;

use std::time::Duration;

use common::Log;
use futures::{StreamExt, stream};
use tautline_executor::{CallbackGroup, CallbackOptions, Executor, ExecutorError, Realtime, job};
use tautline_rt::clock;

const LITTLE: Duration = Duration::from_millis(1);
/// An emulated machine takes some milliseconds for the first of anything.
const MUCH: Duration = Duration::from_millis(40);

/// Options that log what is told to their handlers, and where.
fn watching(log: &Log, name: &str) -> CallbackOptions {
    let (overruns, misses) = (log.clone(), log.clone());
    CallbackOptions::other()
        .name(name)
        .on_overrun(move |overrun| {
            assert!(overrun.execution_ns > overrun.budget_ns);
            let thread = std::thread::current();
            overruns.add(format!("overrun of job {} on {}", overrun.job, thread.name().unwrap_or_default()));
        })
        .on_deadline_miss(move |miss| {
            assert!(miss.response_ns > miss.deadline_ns);
            misses.add(format!("miss of job {}", miss.job));
        })
}

/// Far in the past, and far in the future: whatever the machine does, the one job is late and the other is not.
const LATE: u64 = 1;
const EARLY: u64 = u64::MAX;

/// Hands out (work, release), as subscriptions do: a job ends when the next item is asked for.
fn jobs(items: Vec<(Duration, u64)>) -> impl futures::Stream<Item = Duration> + Send {
    let mut running: Option<job::Job> = None;
    stream::iter(items).map(Some).chain(stream::iter([None])).filter_map(move |item| {
        if let Some(job) = running.take() {
            job.finish();
        }
        let work = item.map(|(work, release_ns)| {
            running = Some(job::begin(release_ns));
            work
        });
        async move { work }
    })
}

#[test]
fn handlers_are_told_after_the_job_and_before_the_next() {
    let log = Log::default();
    let options = watching(&log, "w").budget(MUCH / 2).deadline(LITTLE);
    let items = vec![(LITTLE, EARLY), (MUCH, EARLY), (LITTLE, LATE), (MUCH, LATE), (LITTLE, EARLY)];
    let work_log = log.clone();
    let work = jobs(items).for_each(move |work| {
        clock::burn_cpu(work);
        work_log.add("work");
        async {}
    });
    let executor = Executor::new(Realtime::Off);
    let callback = executor.spawn_callback(options, work).unwrap();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    let overrun = |job| format!("overrun of job {job} on cb:w");
    let expected =
        ["work", "work", &overrun(2), "work", "miss of job 3", "work", &overrun(4), "miss of job 4", "work"];
    assert_eq!(log.events(), expected);
    assert_eq!((stats.completions(), stats.overruns(), stats.deadline_misses()), (5, 2, 2));
    assert_eq!((stats.budget(), stats.deadline()), (Some(MUCH / 2), Some(LITTLE)));
}

#[test]
fn what_a_handler_uses_is_charged_to_no_job() {
    let log = Log::default();
    let handler_log = log.clone();
    let options = CallbackOptions::other().budget(MUCH).on_overrun(move |overrun| {
        clock::burn_cpu(2 * MUCH);
        handler_log.add(format!("overrun of job {}", overrun.job));
    });
    let items = vec![(2 * MUCH, EARLY), (LITTLE, EARLY), (LITTLE, EARLY)];
    let work = jobs(items).for_each(|work| async move { clock::burn_cpu(work) });
    let executor = Executor::new(Realtime::Off);
    let callback = executor.spawn_callback(options, work).unwrap();
    callback.join().unwrap();
    assert_eq!(log.events(), ["overrun of job 1"]);
}

#[test]
fn without_limits_nothing_is_told() {
    let log = Log::default();
    let work = jobs(vec![(MUCH, LATE)]).for_each(|work| async move { clock::burn_cpu(work) });
    let executor = Executor::new(Realtime::Off);
    let callback = executor.spawn_callback(watching(&log, "free"), work).unwrap();
    let stats = callback.stats().clone();
    callback.join().unwrap();
    assert_eq!((stats.completions(), stats.overruns(), stats.deadline_misses()), (1, 0, 0));
    assert!(log.events().is_empty());
}

#[test]
fn members_of_a_group_have_limits_of_their_own() {
    let log = Log::default();
    let mut group = CallbackGroup::new();
    let add = |group: &mut CallbackGroup, options: CallbackOptions, releases: Vec<(Duration, u64)>| {
        let work_log = log.clone();
        let name = options.name.clone();
        group.add(
            options,
            stream::iter(releases),
            |item| item.1,
            move |(work, _)| {
                clock::burn_cpu(work);
                work_log.add(name.clone());
                async {}
            },
        )
    };
    let a = add(&mut group, watching(&log, "a").budget(MUCH / 2), vec![(LITTLE, 1), (MUCH, 3)]);
    let b = add(&mut group, watching(&log, "b").deadline(LITTLE), vec![(MUCH, 2)]);
    let executor = Executor::new(Realtime::Off);
    let total = executor.spawn_group(CallbackOptions::other().name("group"), group).unwrap();
    let all = total.stats().clone();
    total.join().unwrap();
    assert_eq!(log.events(), ["a", "b", "miss of job 1", "a", "overrun of job 2 on cb:group"]);
    assert_eq!((a.overruns(), a.deadline_misses(), b.overruns(), b.deadline_misses()), (1, 0, 0, 1));
    assert_eq!(
        (all.completions(), all.overruns(), all.deadline_misses()),
        (3, 0, 0),
        "it was given no limits"
    );
}

#[test]
fn a_handler_that_could_never_be_called_is_refused() {
    let options = watching(&Log::default(), "x").execution_time(false);
    let error = Executor::new(Realtime::Off).spawn_callback(options, async {}).unwrap_err();
    assert!(matches!(error, ExecutorError::UnmeasuredBudget { .. }), "{error}");
    assert!(error.to_string().starts_with("callback `x` has a handler for overruns"), "{error}");
    // Its thread is the group's, and so is whether its execution times are measured.
    let mut group = CallbackGroup::new();
    group.add(watching(&Log::default(), "y"), stream::empty::<u64>(), |release| *release, |_| async {});
    let options = CallbackOptions::other().execution_time(false);
    let error = Executor::new(Realtime::Off).spawn_group(options, group).unwrap_err();
    assert!(error.to_string().starts_with("callback `y` has a handler for overruns"), "{error}");
}

#[test]
fn options_are_equal_if_their_handlers_are_the_same() {
    let options = watching(&Log::default(), "x");
    assert_eq!(options, options.clone());
    assert_ne!(options, watching(&Log::default(), "x"));
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Budgets that hold: a job that uses more goes on below all others, and so does what has waited for it.

mod common;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::task::Poll;
use std::time::Duration;

use common::{Log, cores, realtime};
use futures::StreamExt;
use futures::channel::mpsc;
use tautline_executor::{
    CallbackGroup, CallbackOptions, Executor, ExecutorError, Realtime, job, stop_requested,
};
use tautline_rt::{Policy, clock, current_policy};

fn budget() -> Duration {
    clock::test_time(Duration::from_millis(2))
}

/// What a job is to do: released when, with how much work.
type Order = (u64, Duration);

/// Hands out orders as subscriptions do: a job ends when the next item is asked for.
fn jobs(orders: mpsc::UnboundedReceiver<Order>) -> impl futures::Stream<Item = Duration> + Send {
    let mut running: Option<job::Job> = None;
    let mut orders = orders;
    futures::stream::poll_fn(move |context| {
        if let Some(job) = running.take() {
            job.finish();
        }
        if stop_requested() {
            return Poll::Pending;
        }
        orders.poll_next_unpin(context).map(|order| {
            let (release_ns, work) = order?;
            running = Some(job::begin(release_ns));
            Some(work)
        })
    })
}

fn level() -> &'static str {
    match current_policy().unwrap() {
        Policy::Fifo(_) => "own",
        Policy::Other { .. } => "below",
        _ => "else",
    }
}

#[test]
fn what_waited_for_an_overrun_is_done_below_too_and_what_comes_later_is_not() {
    if !realtime() {
        return;
    }
    let (orders, receiver) = mpsc::unbounded();
    let (log, ends) = (Log::default(), Arc::new(AtomicU64::new(0)));
    let (work_log, work_ends) = (log.clone(), ends.clone());
    let work = jobs(receiver).for_each(move |work| {
        let begins = level();
        clock::burn_cpu(work);
        work_log.add(format!("{begins} {}", level()));
        work_ends.fetch_add(1, Ordering::SeqCst);
        async {}
    });
    let executor = Executor::new(Realtime::Required);
    let options = CallbackOptions::fifo(20).name("held").budget(budget()).demote_on_overrun();
    let callback = executor.spawn_callback(options, work).unwrap();
    let send = |release_ns, work| orders.unbounded_send((release_ns, work)).unwrap();
    let done = |count| {
        while ends.load(Ordering::SeqCst) < count {
            std::thread::yield_now();
        }
    };
    let little = budget() / 4;
    send(clock::monotonic_ns(), little);
    done(1);
    // Ten times the budget, and two that are released meanwhile, whenever the thread comes to them.
    let now = clock::monotonic_ns();
    send(now, budget() * 10);
    send(now + 1, little);
    send(now + 2, budget() * 3);
    done(4);
    // What the job before has to be over for is its end, which comes before the thread takes another.
    while callback.stats().completions() < 4 {
        std::thread::yield_now();
    }
    send(clock::monotonic_ns(), little);
    done(5);
    let (stats, control) = (callback.stats().clone(), callback.clone());
    drop(orders);
    control.join().unwrap();
    assert_eq!(log.events(), ["own own", "own below", "below below", "below below", "own own"]);
    assert_eq!((stats.completions(), stats.overruns(), stats.demotions()), (5, 2, 3));
}

#[test]
fn a_job_whose_stream_is_dropped_leaves_later_ones_their_budgets() {
    if !realtime() {
        return;
    }
    let ((first_order, first), (orders, receiver)) = (mpsc::unbounded(), mpsc::unbounded());
    let (log, ends) = (Log::default(), Arc::new(AtomicU64::new(0)));
    let (work_log, work_ends) = (log.clone(), ends.clone());
    let work = async move {
        let mut first = Box::pin(jobs(first));
        first.next().await;
        drop(first);
        jobs(receiver)
            .for_each(move |work| {
                clock::burn_cpu(work);
                work_log.add(level());
                work_ends.fetch_add(1, Ordering::SeqCst);
                async {}
            })
            .await;
    };
    let executor = Executor::new(Realtime::Required);
    let options = CallbackOptions::fifo(20).name("dropped").budget(budget()).demote_on_overrun();
    let callback = executor.spawn_callback(options, work).unwrap();
    let little = budget() / 4;
    first_order.unbounded_send((clock::monotonic_ns(), little)).unwrap();
    for (number, work) in [(1, budget() * 3), (2, little)] {
        orders.unbounded_send((clock::monotonic_ns(), work)).unwrap();
        // The next one is released after this one has ended.
        while ends.load(Ordering::SeqCst) < number || callback.stats().completions() < number {
            std::thread::yield_now();
        }
    }
    let (stats, control) = (callback.stats().clone(), callback.clone());
    drop((orders, first_order));
    control.join().unwrap();
    assert_eq!(log.events(), ["below", "own"]);
    assert_eq!((stats.completions(), stats.demotions()), (2, 1));
}

#[test]
fn a_callback_that_is_to_end_does_no_other_job() {
    if !realtime() {
        return;
    }
    let (orders, receiver) = mpsc::unbounded();
    let log = Log::default();
    let work_log = log.clone();
    let work = jobs(receiver).for_each(move |work| {
        clock::burn_cpu(work);
        work_log.add(level());
        async {}
    });
    let little = budget() / 4;
    for work in [little, budget() * 5, little] {
        orders.unbounded_send((clock::monotonic_ns(), work)).unwrap();
    }
    let executor = Executor::new(Realtime::Required);
    let told = Log::default();
    let handler_told = told.clone();
    let options = CallbackOptions::fifo(20).name("last").budget(budget()).end_on_overrun();
    let options = options.on_overrun(move |overrun| handler_told.add(format!("job {}", overrun.job)));
    let callback = executor.spawn_callback(options, work).unwrap();
    let stats = callback.stats().clone();
    // Nobody closes the channel: it ends by itself.
    callback.join().unwrap();
    assert_eq!(
        (log.events(), told.events()),
        (vec!["own".to_owned(), "below".to_owned()], vec!["job 2".to_owned()])
    );
    let seen = tautline_executor::CallbackSnapshot::of(&stats).unwrap();
    assert_eq!((seen.completions, seen.demotions, seen.ended), (2, 1, true));
    drop(orders);
}

#[test]
fn a_lower_priority_runs_while_a_higher_one_overruns() {
    if !realtime() {
        return;
    }
    let core = cores()[0];
    let executor = Executor::new(Realtime::Required);
    // The higher one works until the lower one has run, on the same core: for ever, if its budget were not held.
    let (high, from_high) = mpsc::unbounded();
    let (low, from_low) = mpsc::unbounded();
    let ran = Arc::new(AtomicBool::new(false));
    let (seen, log) = (ran.clone(), Log::default());
    let high_log = log.clone();
    let hog = jobs(from_high).for_each(move |_| {
        let end_ns = clock::monotonic_ns() + 10_000_000_000;
        while !seen.load(Ordering::SeqCst) && clock::monotonic_ns() < end_ns {
            std::hint::spin_loop();
        }
        high_log.add(if seen.load(Ordering::SeqCst) { "the lower one has run" } else { "in vain" });
        async {}
    });
    let options = |priority| CallbackOptions::fifo(priority).core(core);
    let held = options(20).name("hog").budget(budget()).demote_on_overrun();
    let hog = executor.spawn_callback(held, hog).unwrap();
    let modest = jobs(from_low).for_each(move |_| {
        ran.store(true, Ordering::SeqCst);
        async {}
    });
    let modest = executor.spawn_callback(options(10).name("modest"), modest).unwrap();
    for _ in 0..20 {
        high.unbounded_send((clock::monotonic_ns(), budget())).unwrap();
    }
    low.unbounded_send((clock::monotonic_ns(), budget())).unwrap();
    drop((high, low));
    let stats = hog.stats().clone();
    hog.join().unwrap();
    modest.join().unwrap();
    assert_eq!(log.events(), vec!["the lower one has run"; 20]);
    assert!(stats.demotions() >= 1);
}

#[test]
fn a_group_holds_each_member_to_its_own_budget() {
    if !realtime() {
        return;
    }
    let (log, mut group, mut members) = (Log::default(), CallbackGroup::new(), Vec::new());
    for (name, budget, work, releases) in
        [("modest", budget() * 20, budget() * 2, [1, 3]), ("greedy", budget(), budget() * 2, [2, 4])]
    {
        let log = log.clone();
        // Released in the future: nothing waits for anything.
        let items = futures::stream::iter(releases.map(|release| u64::MAX - 10 + release));
        let stats = group.add(
            name,
            items,
            |release| *release,
            move |_| {
                clock::burn_cpu(work);
                log.add(format!("{name} {}", level()));
                async {}
            },
        );
        stats.set_budget(Some(budget));
        members.push(stats);
    }
    let executor = Executor::new(Realtime::Required);
    let options = CallbackOptions::fifo(20).name("group").demote_on_overrun();
    let callback = executor.spawn_group(options, group).unwrap();
    members.push(callback.stats().clone());
    callback.join().unwrap();
    assert_eq!(log.events(), ["modest own", "greedy below", "modest own", "greedy below"]);
    // Of the members, and of the whole group.
    assert_eq!(members.iter().map(|stats| stats.demotions()).collect::<Vec<_>>(), [0, 2, 2]);
}

#[test]
fn a_groups_budget_is_for_each_job_of_its_members() {
    if !realtime() {
        return;
    }
    let (log, mut group) = (Log::default(), CallbackGroup::new());
    for (name, work) in [("modest", budget() / 4), ("greedy", budget() * 2)] {
        let log = log.clone();
        // Released in the future: nothing waits for anything.
        let items = futures::stream::iter([u64::MAX - 10]);
        group.add(
            name,
            items,
            |release| *release,
            move |_| {
                clock::burn_cpu(work);
                log.add(format!("{name} {}", level()));
                async {}
            },
        );
    }
    let executor = Executor::new(Realtime::Required);
    let options = CallbackOptions::fifo(20).name("group").budget(budget()).demote_on_overrun();
    executor.spawn_group(options, group).unwrap().join().unwrap();
    assert_eq!(log.events(), ["modest own", "greedy below"]);
}

#[test]
fn what_cannot_be_demoted_says_why() {
    let executor = Executor::new(Realtime::Off);
    let refused = |options: CallbackOptions| {
        let error = executor.spawn_callback(options.name("x").demote_on_overrun(), async {}).unwrap_err();
        assert!(matches!(error, ExecutorError::CannotHold { .. }), "{error}");
        error.to_string()
    };
    let fifo = CallbackOptions::fifo(20).budget(budget());
    assert!(refused(CallbackOptions::fifo(20)).contains("state it with `.budget(..)`"));
    assert!(refused(CallbackOptions::other().budget(budget())).contains("no real-time priority"));
    assert!(refused(fifo.clone().execution_time(false)).contains("not measured"));
    assert!(refused(fifo.clone().core(0).busy_poll()).contains("polls busily"));
    let mut group = CallbackGroup::new();
    group.add("member", futures::stream::empty::<u64>(), |release| *release, |_| async {});
    let error = executor.spawn_group(CallbackOptions::fifo(20).demote_on_overrun(), group).unwrap_err();
    assert!(error.to_string().contains("state it with `.budget(..)`"), "{error}");
    // Without real time there is nothing to hold, and nothing is refused.
    executor.spawn_callback(fifo.demote_on_overrun(), async {}).unwrap().join().unwrap();
}

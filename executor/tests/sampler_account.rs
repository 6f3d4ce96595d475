// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is taken from the sampler's core, and what it uses of it.

use std::time::Duration;

use tautline_executor::{CallbackStats, Executor, MomentKind, Realtime};
use tautline_rt::clock::{burn_cpu, monotonic_ns};

fn moments(stats: &CallbackStats) -> Vec<(MomentKind, u64)> {
    let seen = tautline_executor::CallbackSnapshot::of(stats).unwrap().moments;
    // What a busy machine takes meanwhile is not asked for.
    let kinds = [MomentKind::WokenLate, MomentKind::Served];
    seen.iter().filter(|of| kinds.contains(&of.kind)).map(|of| (of.kind, of.length_ns)).collect()
}

#[test]
fn the_sampler_notes_what_it_used_and_how_late_it_woke() {
    let executor = Executor::new(Realtime::Off).account_core_time(Some(Duration::ZERO));
    let sampler = executor.sampler_statistics().unwrap().unwrap();
    let (stats, account) = (sampler.stats(), sampler.account().unwrap());
    assert_eq!(tautline_executor::CallbackSnapshot::of(stats).unwrap().tid, tautline_rt::current_tid());
    account.sleeps();
    assert_eq!(moments(stats), [], "it has not woken");
    let due_ns = monotonic_ns() + 1_000_000;
    std::thread::sleep(Duration::from_millis(6));
    account.woke(Some(due_ns));
    burn_cpu(Duration::from_millis(2));
    account.sleeps();
    let [(MomentKind::WokenLate, late_ns), (MomentKind::Served, used_ns)] = moments(stats)[..] else {
        panic!("{:?}", moments(stats))
    };
    assert!(late_ns >= 5_000_000 && used_ns >= 2_000_000, "{late_ns} {used_ns}");
    // Nothing was due.
    account.woke(None);
    account.sleeps();
    assert_eq!(moments(stats).last().map(|of| of.0), Some(MomentKind::Served));
    assert_eq!(moments(stats).len(), 3);
}

#[test]
fn without_an_account_there_is_none_of_the_sampler() {
    let executor = Executor::new(Realtime::Off);
    assert!(executor.sampler_statistics().unwrap().is_none());
}

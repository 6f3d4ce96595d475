// SPDX-License-Identifier: MIT OR Apache-2.0
//! Busy polling runs without wakes, and starves nobody.

mod common;

use std::fs;
use std::future::{pending, poll_fn};
use std::path::{Path, PathBuf};
use std::task::Poll;

use common::{cores, realtime};
use tautline_executor::{CallbackOptions, CoreSet, Executor, ExecutorError, Policy, Realtime, busy_polling};
use tautline_rt::set_affinity;

#[test]
fn a_busy_callback_is_polled_without_wakes_until_it_ends_or_is_stopped() {
    let executor = Executor::new(Realtime::Off);
    let options = CallbackOptions::fifo(1).core(cores()[0]).busy_poll();
    let mut polls = 0;
    let count = poll_fn(move |_| {
        assert!(busy_polling());
        polls += 1;
        if polls == 10_000 { Poll::Ready(()) } else { Poll::Pending }
    });
    executor.spawn_callback(options.clone(), count).unwrap().join().unwrap();

    let endless = executor.spawn_callback(options, pending()).unwrap();
    endless.stop();
    endless.join().unwrap();
}

#[test]
fn a_plain_callback_knows_that_it_parks() {
    let executor = Executor::new(Realtime::Off);
    let future = async { assert!(!busy_polling()) };
    executor.spawn_callback(CallbackOptions::other(), future).unwrap().join().unwrap();
}

#[test]
fn without_one_core_of_its_own_it_is_refused() {
    let executor = Executor::new(Realtime::Required);
    let cores = cores();
    if cores.len() > 1 {
        let both = CoreSet::one(cores[0]).with(cores[1]);
        let error =
            executor.spawn_callback(CallbackOptions::fifo(1).cores(both).busy_poll().name("b"), pending());
        let message = error.unwrap_err().to_string();
        assert!(message.starts_with(&format!("callback `b` cannot busy-poll on cores {both}")), "{message}");
    }
    // Refused before any thread starts, so no privilege is needed to see it.
    let core = CoreSet::one(cores[0]);
    let _sampler = executor.register_thread("sampler", Policy::Fifo(30), core).unwrap();
    let error =
        executor.spawn_callback(CallbackOptions::fifo(30).cores(core).busy_poll(), pending()).unwrap_err();
    match error {
        ExecutorError::Starved { starved, busy_priority, .. } => {
            assert_eq!((starved.as_str(), busy_priority), ("sampler", 30));
        }
        ExecutorError::BusyPollOnlyCore { .. } => assert_eq!(cores.len(), 1),
        other => panic!("{other}"),
    }
}

/// A cpuset of one core, with either version of cgroups; `None` if there is none to be had.
fn cpuset(core: usize) -> Option<PathBuf> {
    ["/sys/fs/cgroup/cpuset", "/sys/fs/cgroup"].into_iter().find_map(|root| {
        let folder = Path::new(root).join(format!("taut_test_{}", std::process::id()));
        fs::create_dir(&folder).ok()?;
        let set = |(file, value): (&str, usize)| {
            use std::io::Write;
            fs::OpenOptions::new()
                .write(true)
                .open(folder.join(file))?
                .write_all(value.to_string().as_bytes())
        };
        let made = [("cpuset.cpus", core), ("cpuset.mems", 0)].into_iter().try_for_each(set);
        if made.is_err() {
            let _ = fs::remove_dir(&folder);
        }
        made.ok().map(|()| folder)
    })
}

/// The janitor and the thread that spawns it would never run again. Runs itself again, in a cpuset.
#[test]
fn the_only_core_of_a_cpuset_is_not_its_own() {
    const FOLDER: &str = "TAUTLINE_CPUSET";
    if let Some(folder) = std::env::var_os(FOLDER) {
        fs::write(Path::new(&folder).join("cgroup.procs"), std::process::id().to_string()).unwrap();
        let options = CallbackOptions::fifo(1).core(cores()[0]).busy_poll();
        let error = Executor::new(Realtime::Required).spawn_callback(options, pending()).unwrap_err();
        assert!(matches!(error, ExecutorError::BusyPollOnlyCore { priority: 1, .. }), "{error}");
        return;
    }
    let Some(folder) = cpuset(cores()[0]) else { return println!("skipped: no cpuset can be made") };
    let mut child = std::process::Command::new(std::env::current_exe().unwrap());
    let child = child.args(["--exact", "the_only_core_of_a_cpuset_is_not_its_own"]).env(FOLDER, &folder);
    let ended = child.status();
    let _ = fs::remove_dir(&folder);
    assert!(ended.unwrap().success());
}

#[test]
fn who_would_starve_below_it_is_refused_until_it_ends() {
    if !realtime() {
        return;
    }
    let cores = cores();
    let [first, .., last] = cores[..] else { return println!("skipped: needs two cores") };
    // Out of the busy poller's way.
    set_affinity(CoreSet::one(first)).unwrap();
    let executor = Executor::new(Realtime::Required);
    let busy = executor.spawn_callback(CallbackOptions::fifo(5).core(last).busy_poll(), pending()).unwrap();
    let late = CallbackOptions::fifo(5).core(last).name("late");
    let message = executor.spawn_callback(late.clone(), pending()).unwrap_err().to_string();
    assert!(message.contains("would starve `late`") && message.contains("a priority above 5"), "{message}");
    executor.spawn_callback(CallbackOptions::fifo(6).core(last), async {}).unwrap().join().unwrap();
    busy.stop();
    busy.join().unwrap();
    executor.spawn_callback(late, async {}).unwrap().join().unwrap();
    executor.shutdown().unwrap();
}

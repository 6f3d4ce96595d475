// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is set is what the kernel reports.

use std::sync::mpsc;

use tautline_rt::permission::{realtime_permitted, test_needs};
use tautline_rt::{
    CoreSet, Policy, Realtime, RtError, ThreadBuilder, clock, current_affinity, current_policy, current_tid,
    page_faults, policy_of, set_affinity, set_affinity_of, set_own_priority, set_policy, set_policy_of,
    switch_own_priority, threads,
};

/// Real-time tests need the privilege; with CI set they must run.
fn realtime() -> bool {
    test_needs(realtime_permitted(20)).is_some()
}

/// Each policy change happens on a thread of its own, so that tests do not disturb each other.
fn on_a_thread(test: impl FnOnce() + Send + 'static) {
    std::thread::spawn(test).join().unwrap();
}

#[test]
fn policies_read_back() {
    if !realtime() {
        return;
    }
    on_a_thread(|| {
        for policy in [Policy::Fifo(1), Policy::Fifo(20), Policy::RoundRobin(7), Policy::Other { nice: 3 }] {
            set_policy(policy).unwrap();
            assert_eq!(current_policy().unwrap(), policy);
        }
    });
}

#[test]
fn a_thread_switches_between_priorities_of_its_own() {
    if !realtime() {
        return;
    }
    on_a_thread(|| {
        set_own_priority(20).unwrap();
        for priority in [3, 20, 1, 20] {
            switch_own_priority(priority).unwrap();
            assert_eq!(current_policy().unwrap(), Policy::Fifo(priority));
            let child = std::thread::spawn(|| current_policy().unwrap()).join().unwrap();
            assert_eq!(child, Policy::Other { nice: 0 });
        }
        assert!(matches!(switch_own_priority(0), Err(RtError::BadPriority { priority: 0 })));
    });
}

#[test]
fn a_reservation_reads_back_and_holds() {
    if !realtime() {
        return;
    }
    let policy = Policy::Deadline { runtime_ns: 2_000_000, period_ns: 20_000_000 };
    let thread = ThreadBuilder::new("reserved").policy(policy);
    let used = || {
        // It may start threads, which are not like it.
        let child = std::thread::spawn(|| current_policy().unwrap()).join().unwrap();
        let begin_ns = clock::monotonic_ns();
        clock::burn_cpu(std::time::Duration::from_millis(9));
        (child, clock::monotonic_ns() - begin_ns)
    };
    let thread = thread.spawn(move || used).unwrap();
    let info = thread.info().clone();
    assert_eq!((info.policy, info.cores), (policy, CoreSet::allowed().unwrap()));
    assert_eq!(info.policy.realtime_priority(), Some(Policy::RESERVATION));
    let (child, taken_ns) = thread.join().unwrap();
    assert_eq!(child, Policy::Other { nice: 0 });
    // At most 2 ms at once and 2 ms in the period that begins with the thread's next wake-up: three periods to wait for.
    assert!(taken_ns > 40_000_000, "9 ms of work in {taken_ns} ns");
}

#[test]
fn a_reservation_that_is_bound_is_granted_or_refused_with_words() {
    let cores = CoreSet::allowed().unwrap();
    if !realtime() || cores.len() < 2 {
        return;
    }
    let policy = Policy::Deadline { runtime_ns: 1_000_000, period_ns: 20_000_000 };
    let one = CoreSet::one(cores.iter().next().unwrap());
    match ThreadBuilder::new("bound").policy(policy).cores(one).spawn(|| || ()) {
        Ok(thread) => {
            assert_eq!((thread.info().policy, thread.info().cores), (policy, one));
            thread.join().unwrap();
        }
        Err(error @ RtError::ReservationBound { .. }) => {
            let message = error.to_string();
            assert!(message.contains("kernel.sched_rt_runtime_us=-1") && message.contains("core = \"any\""));
        }
        Err(error) => panic!("{error}"),
    }
    // A thread that is bound already gets none either, unless the kernel lets it.
    on_a_thread(move || {
        set_affinity(one).unwrap();
        let refused = set_policy(policy).err();
        assert!(matches!(refused, None | Some(RtError::ReservationBound { .. })), "{refused:?}");
    });
}

#[test]
fn another_thread_can_be_set_by_its_id() {
    let (tid_sender, tid) = mpsc::channel();
    let (release, released) = mpsc::channel::<()>();
    let thread = std::thread::spawn(move || {
        tid_sender.send(current_tid()).unwrap();
        let _ = released.recv();
    });
    let tid = tid.recv().unwrap();
    let first = CoreSet::one(CoreSet::allowed().unwrap().iter().next().unwrap());
    set_affinity_of(tid, first).unwrap();
    set_policy_of(tid, Policy::Other { nice: 5 }).unwrap();
    assert_eq!(policy_of(tid).unwrap(), Policy::Other { nice: 5 });
    if realtime() {
        set_policy_of(tid, Policy::RoundRobin(4)).unwrap();
        assert_eq!(policy_of(tid).unwrap(), Policy::RoundRobin(4));
    }
    drop(release);
    thread.join().unwrap();
    for nobody in [0, u32::MAX] {
        assert!(matches!(policy_of(nobody), Err(RtError::NoSuchThread { .. })));
    }
}

#[test]
fn affinities_read_back() {
    on_a_thread(|| {
        let allowed = CoreSet::allowed().unwrap();
        for core in allowed.iter() {
            set_affinity(CoreSet::one(core)).unwrap();
            assert_eq!(current_affinity().unwrap(), CoreSet::one(core));
        }
        // Bound to one core, all are still allowed.
        assert_eq!(CoreSet::allowed().unwrap(), allowed);
        set_affinity(allowed).unwrap();
        assert_eq!(current_affinity().unwrap(), allowed);
    });
}

#[test]
fn a_built_thread_is_as_asked_before_spawn_returns() {
    if !realtime() {
        return;
    }
    let core = CoreSet::one(CoreSet::allowed().unwrap().iter().last().unwrap());
    let (release, released) = mpsc::channel::<()>();
    let thread = ThreadBuilder::new("a-thread-with-a-long-name")
        .policy(Policy::Fifo(9))
        .cores(core)
        .stack_bytes(128 * 1024)
        .spawn(move || {
            let in_setup = current_policy().unwrap();
            let not_send = std::rc::Rc::new(in_setup);
            move || {
                let _ = released.recv();
                (*not_send, current_policy().unwrap())
            }
        })
        .unwrap();
    let listed = threads().unwrap().into_iter().find(|info| info.tid == thread.info().tid).unwrap();
    assert_eq!(&listed, thread.info());
    assert_eq!(
        (listed.name.as_str(), listed.policy, listed.cores),
        ("a-thre~ong-name", Policy::Fifo(9), core)
    );
    drop(release);
    let (in_setup, in_body) = thread.join().unwrap();
    assert_eq!(in_setup.realtime_priority(), None, "the set-up runs before the thread is real-time");
    assert_eq!(in_body, Policy::Fifo(9));
}

#[test]
fn the_body_has_its_stack_already() {
    #[inline(never)]
    fn use_stack() {
        std::hint::black_box(&mut [0u8; 300 * 1024]);
    }
    let thread = ThreadBuilder::new("stack").stack_bytes(512 * 1024).spawn(|| {
        || {
            let before = page_faults().minor;
            use_stack();
            page_faults().minor - before
        }
    });
    assert_eq!(thread.unwrap().join().unwrap(), 0);
}

#[test]
fn realtime_off_keeps_the_policy_and_applies_the_cores() {
    let core = CoreSet::one(CoreSet::allowed().unwrap().iter().next().unwrap());
    let thread = ThreadBuilder::new("off").policy(Policy::Fifo(9)).cores(core).realtime(Realtime::Off);
    let thread = thread.spawn(|| || (current_policy().unwrap(), current_affinity().unwrap())).unwrap();
    assert_eq!(thread.join().unwrap(), (current_policy().unwrap(), core));
}

#[test]
fn a_thread_that_cannot_be_set_up_is_an_error_and_leaves_nothing_behind() {
    let name = "doomed";
    let error = ThreadBuilder::new(name).cores(CoreSet::one(1023)).spawn(|| || ()).unwrap_err();
    assert!(matches!(error, RtError::UnknownCore { core: 1023, .. }), "{error}");
    let error = ThreadBuilder::new(name).spawn(|| -> fn() { panic!("set-up of {}", 7) }).unwrap_err();
    assert_eq!(error.to_string(), "thread `doomed` panicked: set-up of 7");
    let error = ThreadBuilder::new(name).stack_bytes(usize::MAX).spawn(|| || ()).unwrap_err();
    assert!(matches!(error, RtError::StackTooLarge { .. }), "{error}");
    let error = ThreadBuilder::new(name).policy(Policy::Fifo(0)).spawn(|| || ()).unwrap_err();
    assert!(matches!(error, RtError::BadPriority { priority: 0 }), "{error}");
    // A joined thread may stay listed for a moment: until then this turns, and a leaked one makes it turn for ever.
    while threads().unwrap().iter().any(|thread| thread.name == name) {
        std::thread::yield_now();
    }
}

#[test]
fn a_panic_is_reported_by_join_with_the_full_name() {
    let thread = ThreadBuilder::new("cb:/a/topic/with/a/long/name").spawn(|| || panic!("lost")).unwrap();
    let error = thread.join().unwrap_err();
    assert_eq!(error.to_string(), "thread `cb:/a/topic/with/a/long/name` panicked: lost");
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! A process that forks while its nodes run, as Python's multiprocessing does.

mod common;

use std::io::Read;
use std::os::fd::AsRawFd;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use common::{Log, Number};
use futures::StreamExt;
use tautline::{CallbackOptions, Context, LoanError, Node, PublishError, Qos, Realtime};
use tautline_rt::clock::test_time;
use tautline_system::{Admission, Gate};

/// Runs in a forked child, which then ends without anything else of a process's end. A child that hangs is killed after a minute.
fn in_a_fork(run: impl FnOnce()) {
    // SAFETY: the child has only this thread and does not return from here.
    let pid = unsafe { libc::fork() };
    if pid == 0 {
        let done = catch_unwind(AssertUnwindSafe(run));
        // SAFETY: ends the process.
        unsafe { libc::_exit(i32::from(done.is_err())) };
    }
    assert!(pid > 0, "fork");
    let (mut status, begin) = (0, Instant::now());
    // SAFETY: `status` is writable; it is this process's child.
    while unsafe { libc::waitpid(pid, &raw mut status, libc::WNOHANG) } == 0 {
        if begin.elapsed() > test_time(Duration::from_secs(60)) {
            // SAFETY: it is this process's child, which has not been waited for.
            unsafe { libc::kill(pid, libc::SIGKILL) };
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 0, "the child ended with {status:x}");
}

#[test]
fn a_child_ends_or_begins_anew_and_its_parent_goes_on() {
    static HEARD: Log<u64> = Log::new();
    let make = || Context::builder().domain(219).realtime(Realtime::Off).build().unwrap();
    let context = make();
    let mut node = Node::create(context.clone(), "parent", "").unwrap();
    let publisher = node.create_publisher::<Number>("/forks", Qos::default()).unwrap();
    let subscription = node.subscribe::<Number>("/forks", Qos::default()).unwrap();
    let hears = subscription.for_each(|number| {
        HEARD.add(number.value);
        async {}
    });
    let callback = node.spawn_callback(CallbackOptions::other().name("hears"), hears).unwrap();
    let spinning = {
        let node = Node::create(context.clone(), "spins", "").unwrap();
        std::thread::spawn(move || node.spin())
    };
    publisher.publish(&Number { value: 1 }).unwrap();
    HEARD.wait_for(1);

    let ends = (publisher, node, callback, context);
    // SAFETY: the child's own copy, which nothing else of it uses.
    in_a_fork(|| drop(unsafe { std::ptr::read(&raw const ends) }));
    in_a_fork(|| {
        let error = ends.0.publish(&Number { value: 2 }).unwrap_err();
        assert_eq!(error, PublishError::Loan(LoanError::Forked));
        assert!(Node::create(ends.3.clone(), "child", "").unwrap_err().to_string().contains("forked"));
        let own = make();
        let mut node = Node::create(own.clone(), "child", "").unwrap();
        let publisher = node.create_publisher::<Number>("/forks", Qos::default()).unwrap();
        let begin = Instant::now();
        while publisher.subscription_count() == 0 && begin.elapsed() < test_time(Duration::from_secs(30)) {
            std::thread::sleep(Duration::from_millis(1));
        }
        publisher.publish(&Number { value: 3 }).unwrap();
    });
    assert_eq!(HEARD.wait_for(2), [1, 3]);
    ends.0.publish(&Number { value: 4 }).unwrap();
    assert_eq!(HEARD.wait_for(3), [1, 3, 4]);
    ends.3.shutdown();
    spinning.join().unwrap().unwrap();
}

#[test]
fn a_child_does_not_keep_the_gate_of_a_parent_that_is_killed() {
    const DOMAIN: u32 = 214;
    let _context = Context::builder().domain(DOMAIN).realtime(Realtime::Off).build().unwrap();
    let (until, here) = std::io::pipe().unwrap();
    in_a_fork(|| {
        let gate = Gate::enter(DOMAIN, Admission::Check).unwrap();
        // SAFETY: its child has only this thread and does not return from here.
        if unsafe { libc::fork() } == 0 {
            // SAFETY: the child's own copy, which nothing else of it uses.
            unsafe { libc::close(here.as_raw_fd()) };
            let _ = (&until).read(&mut [0]);
            // SAFETY: ends the process.
            unsafe { libc::_exit(0) };
        }
        // As if it were killed.
        std::mem::forget(gate);
    });
    assert!(Gate::is_free(DOMAIN), "its child runs until this process ends the pipe");
    drop(here);
}

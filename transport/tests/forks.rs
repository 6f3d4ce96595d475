// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a forked child inherits: nothing that is its parent's.

mod support;

use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};
use std::sync::atomic::{AtomicBool, Ordering};
use support::{Count, Part, clean, domain, participants, say, take_all, wait_for, wait_for_the_end};
use tautline_transport::{Limits, LoanError, Participant, Publisher, Qos, Subscription, TransportError};

/// The child's part; without its variable it is no test.
#[test]
fn child_main() {
    let Some((part, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    let node = participant.create_node("parent", "/").unwrap();
    let (publisher, subscription) = (new_publisher(&participant), new_subscription(&participant));
    match part.as_str() {
        "fork that waits" => {
            let child = fork(|| {
                loop {
                    std::thread::sleep(std::time::Duration::from_secs(1));
                }
            });
            say(&child.as_raw_nonzero().to_string());
            wait_for_the_end();
        }
        "fork that drops" => {
            let ends = (node, publisher, subscription, participant);
            let child = fork(|| {
                // SAFETY: the child has its own copy, which nothing else of it uses: it ends after this.
                drop(unsafe { std::ptr::read(&raw const ends) });
            });
            assert_eq!(end_of(child), Some(0));
            say("dropped");
            wait_for_the_end();
        }
        "fork that goes on" => {
            let child = fork(|| {
                let error = participant.create_publisher::<Count>("/x", Qos::keep_last(1), Limits::default());
                assert!(matches!(error, Err(TransportError::Forked { .. })));
                assert!(matches!(participant.create_node("x", "/"), Err(TransportError::Forked { .. })));
                assert_eq!(publisher.loan().map(drop).unwrap_err(), LoanError::Forked);
                assert!(subscription.try_take().unwrap().is_none());
                let own = Participant::new(domain).unwrap();
                let publisher = new_publisher(&own);
                wait_for("both subscriptions", || publisher.subscription_count() == 2);
                publisher.publish(&Count { n: 7 }).unwrap();
            });
            assert_eq!(end_of(child), Some(0));
            publisher.publish(&Count { n: 8 }).unwrap();
            wait_for("the child's and its own", || take_all(&subscription).contains(&8));
            say("went on");
            wait_for_the_end();
        }
        "fork of many threads" => {
            static ENDS: AtomicBool = AtomicBool::new(false);
            // They hold each lock of a participant's beginning and end at some time or other.
            let churn = move || {
                while !ENDS.load(Ordering::Relaxed) {
                    drop(Participant::new(domain).unwrap());
                }
            };
            let threads = [std::thread::spawn(churn), std::thread::spawn(churn)];
            for number in 0..40 {
                let child = fork(|| drop(Participant::new(domain).unwrap()));
                assert_eq!(end_of(child), Some(0), "child {number}");
            }
            ENDS.store(true, Ordering::Relaxed);
            threads.into_iter().for_each(|thread| thread.join().unwrap());
            say("went on");
            wait_for_the_end();
        }
        "bystander" => {
            say("ready");
            wait_for_the_end();
        }
        other => panic!("no part {other}"),
    }
}

/// Forks a child that does this and then ends, with 1 if it panics.
fn fork(run: impl FnOnce()) -> Pid {
    // SAFETY: the child has only this thread, takes no lock that another one may hold, and does not return from here.
    let pid = unsafe { libc::fork() };
    if pid == 0 {
        // SAFETY: no conditions. It ends in any case.
        unsafe { libc::alarm(60) };
        let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(run));
        // SAFETY: ends the process.
        unsafe { libc::_exit(i32::from(done.is_err())) };
    }
    Pid::from_raw(pid).expect("fork")
}

fn end_of(child: Pid) -> Option<i32> {
    let mut end = None;
    wait_for("the end of a forked child", || {
        end = waitpid(Some(child), WaitOptions::NOHANG).unwrap();
        end.is_some()
    });
    end?.1.exit_status()
}

fn new_publisher(participant: &Participant) -> Publisher<Count> {
    participant.create_publisher("/forks", Qos::keep_last(10), Limits::default()).unwrap()
}

fn new_subscription(participant: &Participant) -> Subscription<Count> {
    participant.create_subscription("/forks", Qos::keep_last(10), Limits::default()).unwrap()
}

/// A process that is killed when this is dropped.
struct Killed(Pid);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = kill_process(self.0, Signal::KILL);
    }
}

/// A participant that is killed is cleaned up after by whoever is the warden.
fn somebody_cleans_up(domain: u32, others: usize) {
    let mut bystander = Part::start("bystander", domain);
    bystander.hear();
    assert_eq!(participants(domain).len(), others + 1);
    bystander.kill();
    wait_for("the cleanup after a killed process", || participants(domain).len() == others);
}

#[test]
fn a_parent_that_dies_is_noticed_though_its_child_lives() {
    let domain = domain(118);
    let mut parent = Part::start("fork that waits", domain);
    let child = Killed(Pid::from_raw(parent.hear().parse().unwrap()).unwrap());
    // The parent came first: it is the warden.
    let own = Participant::new(domain).unwrap();
    parent.kill();
    wait_for("the cleanup after the parent", || participants(domain).len() == 1);
    somebody_cleans_up(domain, 1);
    kill_process(child.0, Signal::CONT).expect("the child lives");
    drop((child, own));
    clean(domain);
}

#[test]
fn children_begin_anew_whatever_their_parents_threads_were_doing() {
    let domain = domain(118);
    let mut parent = Part::start("fork of many threads", domain);
    assert_eq!(parent.hear(), "went on");
    assert!(parent.end().success());
    clean(domain);
}

#[test]
fn a_child_that_drops_what_it_inherits_leaves_its_parent_alone() {
    let domain = domain(119);
    let mut parent = Part::start("fork that drops", domain);
    parent.hear();
    let own = Participant::new(domain).unwrap();
    let graph = own.graph().unwrap();
    assert!(graph.nodes.iter().any(|node| node.name.name == "parent"), "{graph:?}");
    assert_eq!(graph.endpoints.iter().filter(|end| end.topic == "/forks").count(), 2);
    somebody_cleans_up(domain, 2);
    assert!(parent.end().success());
    drop(own);
    clean(domain);
}

#[test]
fn a_child_that_goes_on_is_refused_what_it_inherits_and_may_join_anew() {
    let domain = domain(117);
    let own = Participant::new(domain).unwrap();
    let subscription = new_subscription(&own);
    let mut parent = Part::start("fork that goes on", domain);
    assert_eq!(parent.hear(), "went on");
    let mut taken = Vec::new();
    wait_for("both messages", || {
        taken.extend(take_all(&subscription));
        taken.len() == 2
    });
    taken.sort_unstable();
    assert_eq!(taken, [7, 8]);
    assert!(parent.end().success());
    drop((subscription, own));
    clean(domain);
}

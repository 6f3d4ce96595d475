// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tasks that the sampler wakes for messages, for room in a keep-all queue, and for a sample that comes back.

#[path = "../../transport/tests/support/mod.rs"]
mod support;

use futures::StreamExt;
use futures::executor::{LocalPool, block_on};
use futures::task::LocalSpawnExt;
use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;
use support::{Count, Part, domain, say, wait_for_the_end};
use tautline_rt::ThreadBuilder;
use tautline_sampler::Sampler;
use tautline_transport::{Limits, LoanError, Participant, PublishError, Publisher, Qos, Subscription};

fn publisher(participant: &Participant, qos: Qos) -> Publisher<Count> {
    participant.create_publisher("/messages", qos, Limits::default()).unwrap()
}

fn subscription(participant: &Participant, qos: Qos) -> Subscription<Count> {
    participant.create_subscription("/messages", qos, Limits::default()).unwrap()
}

#[test]
fn publish_when_ready_waits_for_a_take() {
    let participant = Participant::new(domain(182)).unwrap();
    let mut sampler = Sampler::new(&participant).unwrap();
    let (publisher, subscription) =
        (publisher(&participant, Qos::keep_all(2)), subscription(&participant, Qos::keep_all(2)));
    let log = Rc::new(RefCell::new(Vec::new()));
    let mut pool = LocalPool::new();
    let task = {
        let log = log.clone();
        async move {
            for n in 1..=4 {
                let mut loan = publisher.loan().unwrap();
                loan.n = n;
                loan.publish_when_ready().await.unwrap();
                log.borrow_mut().push(format!("published {n}"));
            }
        }
    };
    pool.spawner().spawn_local(task).unwrap();
    pool.run_until_stalled();
    for _ in 0..4 {
        let taken = Subscription::try_take(&subscription).unwrap().unwrap().n;
        log.borrow_mut().push(format!("took {taken}"));
        while sampler.spin_once(Some(Duration::ZERO)) != 0 {}
        pool.run_until_stalled();
    }
    assert_eq!(
        *log.borrow(),
        ["published 1", "published 2", "took 1", "published 3", "took 2", "published 4", "took 3", "took 4"]
    );
    assert_eq!(subscription.counters().lost(), 0);
}

#[test]
fn nothing_is_lost_through_a_keep_all_queue_of_4() {
    const EACH: u64 = 50_000;
    let participant = Participant::new(domain(183)).unwrap();
    let sampler = Sampler::new(&participant).unwrap().start(ThreadBuilder::new("sampler")).unwrap();
    let subscription = subscription(&participant, Qos::keep_all(4));
    let publishers = [(); 2].map(|()| publisher(&participant, Qos::keep_all(4)));
    let threads = publishers.map(|publisher| {
        std::thread::spawn(move || {
            block_on(async {
                for n in 1..=EACH {
                    let mut loan = publisher.loan().unwrap();
                    loan.n = n;
                    loan.publish_when_ready().await.unwrap();
                }
            });
            publisher
        })
    });
    let counters = subscription.counters();
    let mut next = std::collections::HashMap::new();
    block_on(subscription.take(2 * EACH as usize).for_each(|sample| {
        let expected = next.entry(sample.info().publisher_gid).or_insert(1);
        assert_eq!((sample.n, sample.info().sequence_number), (*expected, *expected));
        *expected += 1;
        futures::future::ready(())
    }));
    assert_eq!((counters.received(), counters.lost()), (2 * EACH, 0));
    assert!(counters.max_queue() <= 4);
    for thread in threads {
        thread.join().unwrap();
    }
    sampler.stop().unwrap();
}

#[test]
fn a_publisher_that_waits_is_freed_when_the_subscription_goes() {
    let participant = Participant::new(domain(184)).unwrap();
    let sampler = Sampler::new(&participant).unwrap().start(ThreadBuilder::new("sampler")).unwrap();
    let (publisher, subscription) =
        (publisher(&participant, Qos::keep_all(1)), subscription(&participant, Qos::keep_all(1)));
    publisher.publish(&Count { n: 1 }).unwrap();
    let waiting = std::thread::spawn(move || block_on(publisher.loan().unwrap().publish_when_ready()));
    drop(subscription);
    waiting.join().unwrap().unwrap();
    sampler.stop().unwrap();
}

#[test]
fn a_publisher_that_waits_is_freed_when_its_node_ends() {
    let participant = Participant::new(domain(184)).unwrap();
    let sampler = Sampler::new(&participant).unwrap().start(ThreadBuilder::new("sampler")).unwrap();
    let node = participant.create_node("waits", "/").unwrap();
    let publisher = publisher(&participant.for_node(&node), Qos::keep_all(1));
    let _full = subscription(&participant, Qos::keep_all(1));
    publisher.publish(&Count { n: 1 }).unwrap();
    let (loaned, is_loaned) = std::sync::mpsc::channel();
    let waiting = std::thread::spawn(move || {
        let loan = publisher.loan().unwrap();
        loaned.send(()).unwrap();
        block_on(loan.publish_when_ready())
    });
    is_loaned.recv().unwrap();
    node.end();
    assert!(matches!(waiting.join().unwrap(), Err(PublishError::Loan(LoanError::Ended))));
    sampler.stop().unwrap();
}

#[test]
fn a_stream_goes_on_when_a_held_sample_is_dropped() {
    let participant = Participant::new(domain(185)).unwrap();
    let mut sampler = Sampler::new(&participant).unwrap();
    let limits = Limits { held: 2, ..Limits::default() };
    let subscription = participant.create_subscription::<Count>("/held", Qos::default(), limits).unwrap();
    let publisher = participant.create_publisher::<Count>("/held", Qos::default(), limits).unwrap();
    let counters = subscription.counters();
    let held = Rc::new(RefCell::new(Vec::new()));
    let mut pool = LocalPool::new();
    {
        let held = held.clone();
        let keep = subscription.for_each(move |sample| {
            held.borrow_mut().push(sample);
            futures::future::ready(())
        });
        pool.spawner().spawn_local(keep).unwrap();
    }
    for n in 1..=3 {
        publisher.publish(&Count { n }).unwrap();
    }
    while sampler.spin_once(Some(Duration::ZERO)) != 0 {}
    pool.run_until_stalled();
    let numbers = || held.borrow().iter().map(|sample| sample.n).collect::<Vec<_>>();
    assert_eq!((numbers(), counters.refused()), (vec![1, 2], 1));
    // No ring: the drop itself wakes the task.
    drop(held.borrow_mut().remove(0));
    pool.run_until_stalled();
    assert_eq!(numbers(), [2, 3]);
    std::thread::scope(|scope| {
        let sample = held.borrow_mut().pop();
        scope.spawn(move || drop(sample));
    });
    publisher.publish(&Count { n: 4 }).unwrap();
    while sampler.spin_once(Some(Duration::ZERO)) != 0 {}
    pool.run_until_stalled();
    assert_eq!(numbers(), [2, 4]);
}

#[test]
fn each_message_wakes_its_task_from_another_participant() {
    let (here, there) = (Participant::new(domain(186)).unwrap(), Participant::new(domain(186)).unwrap());
    let samplers =
        [&here, &there].map(|one| Sampler::new(one).unwrap().start(ThreadBuilder::new("sampler")).unwrap());
    let ping = here.create_publisher::<Count>("/ping", Qos::default(), Limits::default()).unwrap();
    let pong = there.create_publisher::<Count>("/pong", Qos::default(), Limits::default()).unwrap();
    let mut pings = there.create_subscription::<Count>("/ping", Qos::default(), Limits::default()).unwrap();
    let mut pongs = here.create_subscription::<Count>("/pong", Qos::default(), Limits::default()).unwrap();
    let echo = std::thread::spawn(move || {
        block_on(async {
            while let Some(sample) = pings.next().await {
                pong.publish(&sample).unwrap();
                if sample.n == 5000 {
                    break;
                }
            }
        });
    });
    block_on(async {
        for n in 1..=5000 {
            ping.publish(&Count { n }).unwrap();
            assert_eq!(pongs.next().await.unwrap().n, n);
        }
    });
    echo.join().unwrap();
    for sampler in samplers {
        sampler.stop().unwrap();
    }
}

/// The child's part: a transient-local publisher whose process the parent stops. Without its variable it is no test.
#[test]
fn child_main() {
    let Some((_, domain)) = support::part() else { return };
    let participant = Participant::new(domain).unwrap();
    let _publisher = publisher(&participant, Qos::keep_last(3).transient_local());
    say("ready");
    wait_for_the_end();
}

#[test]
fn a_publisher_that_does_not_answer_keeps_no_one_from_what_is_live() {
    let mut silent = Part::start("silent publisher", 187);
    assert_eq!(silent.hear(), "ready");
    silent.stop();

    let participant = Participant::new(domain(187)).unwrap();
    let sampler = Sampler::new(&participant).unwrap().start(ThreadBuilder::new("sampler")).unwrap();
    let live = publisher(&participant, Qos::default().transient_local());
    let mut joiner = subscription(&participant, Qos::default().transient_local());
    live.publish(&Count { n: 1 }).unwrap();
    // Announced while the joiner still waits for the history, and never again.
    assert_eq!(block_on(joiner.next()).unwrap().n, 1);
    assert!(silent.end().success());
    sampler.stop().unwrap();
}

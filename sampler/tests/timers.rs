// SPDX-License-Identifier: MIT OR Apache-2.0
//! Timers: absolute, without drift; what is missed is counted; order of events; stopping.
//!
//! Setting the system's clock cannot be tried on a machine that others use. Instead: a timer's releases are numbers on
//! CLOCK_MONOTONIC, which the clock's setting does not move, and the tests here give such numbers, far in the past and
//! near in the future, and get exactly them back.

#[path = "../../transport/tests/support/mod.rs"]
mod support;

use futures::StreamExt;
use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use std::cell::RefCell;
use std::rc::Rc;
use std::sync::{Arc, mpsc};
use std::task::{Context, Poll, Wake, Waker};
use std::time::Duration;
use tautline_rt::ThreadBuilder;
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Events, Sampler, Sleep, Tick, Timer, Wait};
use tautline_transport::Participant;

const MS: u64 = 1_000_000;
const HOUR: Duration = Duration::from_secs(3600);

fn sampler(domain: u32) -> Sampler {
    Sampler::new(&Participant::new(support::domain(domain)).unwrap()).unwrap()
}

fn poll(timer: &mut Timer) -> Poll<Tick> {
    timer.poll_tick(&mut Context::from_waker(Waker::noop()))
}

/// Spins until the timer ticks.
fn next(sampler: &mut Sampler, timer: &mut Timer) -> Tick {
    loop {
        if let Poll::Ready(tick) = poll(timer) {
            return tick;
        }
        sampler.spin_once(Some(HOUR));
    }
}

#[test]
fn releases_are_absolute() {
    let mut sampler = sampler(170);
    let (start, period) = (monotonic_ns() + 2 * MS, 3 * MS);
    let mut timer = Timer::starting_at(sampler.events(), start, Duration::from_nanos(period)).unwrap();
    let mut index = 0;
    for turn in 1..=30 {
        let tick = next(&mut sampler, &mut timer);
        assert_eq!(tick.release_ns, start + (tick.index - 1) * period, "no drift, whatever came before");
        assert!(monotonic_ns() >= tick.release_ns, "never early");
        assert_eq!(tick.missed, tick.index - index - 1);
        index = tick.index;
        // A slow task now and then.
        if turn % 10 == 3 {
            tautline_rt::clock::sleep_until_monotonic(tick.release_ns + 2 * period + period / 2);
        }
    }
    assert!(timer.missed() >= 3, "one or more in each slow turn");
}

#[test]
fn missed_releases_are_counted_and_come_as_one() {
    let mut sampler = sampler(171);
    // 5 releases ago and a half; so long a period that no other one passes meanwhile.
    let (now, late) = (monotonic_ns(), 5);
    let period = now / 8;
    let start = now - late * period - period / 2;
    let mut timer = Timer::starting_at(sampler.events(), start, Duration::from_nanos(period)).unwrap();
    let tick = next(&mut sampler, &mut timer);
    assert_eq!(
        tick,
        Tick {
            release_ns: start + late * period,
            since_ns: start + late * period,
            index: late + 1,
            missed: late
        }
    );
    assert_eq!(sampler.spin_once(Some(Duration::ZERO)), 0);
    assert!(poll(&mut timer).is_pending(), "one tick, not a bunch");
    assert_eq!(timer.missed(), late);
}

#[test]
fn timers_are_released_in_order() {
    let mut sampler = sampler(172);
    let log = Rc::new(RefCell::new(Vec::new()));
    let mut pool = LocalPool::new();
    let start = monotonic_ns() + 5 * MS;
    // Armed in another order than they are due. One period so long that it ticks once.
    for (name, at) in [("third", 9), ("first", 1), ("fourth", 13), ("second", 5)] {
        let mut timer = Timer::starting_at(sampler.events(), start + at * MS, HOUR).unwrap();
        let log = log.clone();
        let task = async move {
            let tick = timer.tick().await;
            assert_eq!(tick.missed, 0);
            log.borrow_mut().push((tick.release_ns - start, name));
        };
        pool.spawner().spawn_local(task).unwrap();
    }
    while log.borrow().len() < 4 {
        pool.run_until_stalled();
        sampler.spin_once(Some(HOUR));
        pool.run_until_stalled();
    }
    let expected = [(MS, "first"), (5 * MS, "second"), (9 * MS, "third"), (13 * MS, "fourth")];
    // Late by more than 4 ms on a loaded machine, two wake together; their releases tell the order.
    let mut log = log.borrow().clone();
    log.sort();
    assert_eq!(log, expected);
}

/// A sleep is told with what is due, and that it is over, too if a ring ends it.
#[test]
fn sleeps_are_told_with_what_is_due() {
    let mut sampler = sampler(226);
    let events = sampler.events().clone();
    let due_ns = monotonic_ns() + HOUR.as_nanos() as u64;
    let _timer = Timer::starting_at(&events, due_ns, HOUR).unwrap();
    let mut told = Vec::new();
    sampler.spin_told(|sleep| {
        told.push(sleep);
        events.stop();
    });
    assert_eq!(told, [Sleep::Begins, Sleep::Ends { due_ns: Some(due_ns) }]);
}

#[test]
fn a_timer_may_be_dropped_and_another_made_while_the_sampler_sleeps() {
    let sampler = sampler(173);
    let thread = sampler.start(ThreadBuilder::new("sampler")).unwrap();
    let long = Timer::new(thread.events(), HOUR).unwrap();
    drop(long);
    for _ in 0..100 {
        let mut timer = Timer::new(thread.events(), Duration::from_micros(300)).unwrap();
        let ticks: Vec<_> = futures::executor::block_on(timer.by_ref().take(3).collect());
        assert!(ticks.is_sorted_by(|a, b| a.index < b.index));
    }
    assert!(thread.stop().unwrap().is_some());
}

#[test]
fn spin_once_returns_at_its_timeout_and_not_before() {
    for (domain, wait) in [(174, Wait::Block), (175, Wait::Adaptive(Duration::from_micros(200)))] {
        let mut sampler = sampler(domain).with_wait(wait);
        sampler.spin_once(Some(Duration::ZERO));
        for timeout in [0, 1, 3].map(Duration::from_millis) {
            let start = monotonic_ns();
            assert_eq!(sampler.spin_once(Some(timeout)), 0);
            assert!(monotonic_ns() - start >= timeout.as_nanos() as u64);
        }
        // A timer ends the longest timeout there is.
        let mut timer = Timer::new(sampler.events(), Duration::from_millis(2)).unwrap();
        while poll(&mut timer).is_pending() {
            assert!(sampler.spin_once(Some(Duration::MAX)) > 0);
        }
    }
}

#[test]
fn guard_conditions_from_any_thread() {
    for (domain, wait) in [(176, Wait::Block), (177, Wait::Adaptive(Duration::from_micros(50)))] {
        let thread = sampler(domain).with_wait(wait).start(ThreadBuilder::new("sampler")).unwrap();
        let mut condition = thread.events().guard_condition().unwrap();
        let (send, acknowledged) = mpsc::channel();
        let triggers: Vec<_> = (0..4).map(|_| condition.clone()).collect();
        let task = std::thread::spawn(move || {
            futures::executor::block_on(async move {
                while send.send(()).is_ok() {
                    condition.triggered().await;
                }
            });
        });
        acknowledged.recv().unwrap();
        for n in 0..2000 {
            let trigger = triggers[n % 4].clone();
            match n % 100 {
                0 => std::thread::spawn(move || trigger.trigger()).join().unwrap(),
                _ => trigger.trigger(),
            }
            // Every trigger wakes the task: without that this would hang.
            acknowledged.recv().unwrap();
        }
        drop(acknowledged);
        triggers[0].trigger();
        task.join().unwrap();
    }
}

#[test]
fn triggers_before_the_wait_are_one() {
    let mut sampler = sampler(178);
    let mut condition = sampler.events().guard_condition().unwrap();
    let mut context = Context::from_waker(Waker::noop());
    assert!(condition.poll_triggered(&mut context).is_pending());
    condition.trigger();
    condition.trigger();
    assert!(sampler.spin_once(None) >= 1);
    assert!(condition.poll_triggered(&mut context).is_ready());
    assert!(condition.poll_triggered(&mut context).is_pending());
}

#[test]
fn stopped_from_another_thread_and_before_it_began() {
    let mut sampler = sampler(179);
    let events = sampler.events().clone();
    let thread = std::thread::spawn(move || {
        sampler.spin();
        sampler
    });
    events.stop();
    let mut sampler = thread.join().unwrap();
    assert!(events.is_stopped());
    sampler.spin();
    sampler.spin_once(None);
    // Dropping the handle stops as well.
    let thread = self::sampler(180).start(ThreadBuilder::new("sampler")).unwrap();
    let events = thread.events().clone();
    drop(thread);
    assert!(events.is_stopped());
}

/// Stops the sampler when it is woken.
struct Stop(Events);

impl Wake for Stop {
    fn wake(self: Arc<Self>) {
        self.0.stop();
    }
}

/// A stop that comes while the sampler serves is served with the rest; the sampler must not sleep then. The sampler's own slot is behind that of
/// the task that stops it, so that one look finds both.
#[test]
fn a_stop_while_it_serves_ends_it() {
    let participant = Participant::new(support::domain(192)).unwrap();
    // Slots are claimed in turn.
    while participant.claim_slot().unwrap().index() < 512 {}
    let mut sampler = Sampler::new(&participant).unwrap();
    while participant.claim_slot().unwrap().index() > 512 {}
    let events = sampler.events().clone();
    let mut condition = events.guard_condition().unwrap();
    let waker = Waker::from(Arc::new(Stop(events)));
    assert!(condition.poll_triggered(&mut Context::from_waker(&waker)).is_pending());
    condition.trigger();
    let mut sleeps = 0;
    sampler.spin_told(|_| sleeps += 1);
    assert_eq!(sleeps, 0);
}

#[test]
fn thousands_of_timers_tick_and_their_slots_come_back() {
    const MANY: usize = 3000;
    let mut sampler = sampler(181);
    let mut most = None;
    for _ in 0..3 {
        // Due at once, and then for an hour no more.
        let start = monotonic_ns();
        let timer = |_| Timer::starting_at(sampler.events(), start, HOUR).unwrap();
        let mut timers: Vec<Timer> = (0..MANY).map(timer).collect();
        let mut conditions: Vec<_> = (0..MANY).map(|_| sampler.events().guard_condition().unwrap()).collect();
        let mut slots: Vec<usize> = timers.iter().map(|timer| timer.slot().index()).collect();
        slots.sort_unstable();
        slots.dedup();
        assert_eq!(slots.len(), MANY, "each has its own");
        let greatest = *slots.last().unwrap();
        assert!(greatest <= *most.get_or_insert(greatest), "what came back is used again");
        conditions.iter().for_each(|condition| condition.trigger());
        let mut context = Context::from_waker(Waker::noop());
        while !timers.is_empty() || !conditions.is_empty() {
            sampler.spin_once(Some(HOUR));
            timers.retain_mut(|timer| match poll(timer) {
                Poll::Ready(tick) => {
                    assert_eq!(tick, Tick { release_ns: start, since_ns: start, index: 1, missed: 0 });
                    false
                }
                Poll::Pending => true,
            });
            conditions.retain_mut(|condition| condition.poll_triggered(&mut context).is_pending());
        }
    }
}

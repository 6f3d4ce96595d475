// SPDX-License-Identifier: MIT OR Apache-2.0
//! Watchdogs and alarms: exactly what did not happen in time expires, in order, never early.
//!
//! The times of what happened are numbers, which the tests give as they like; the sampler's are real.

#[path = "../../transport/tests/support/mod.rs"]
mod support;

use std::task::{Context, Poll, Waker};
use std::time::Duration;
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Alarm, Expiry, Sampler, Watchdog};
use tautline_transport::{ActivityKind, Participant, Slot};

const MS: u64 = 1_000_000;
const HOUR: Duration = Duration::from_secs(3600);
const HOUR_NS: u64 = HOUR.as_nanos() as u64;

fn poll(watchdog: &mut Watchdog) -> Poll<Expiry> {
    watchdog.poll_expired(&mut Context::from_waker(Waker::noop()))
}

#[test]
fn two_hundred_topics_of_which_every_second_is_fed() {
    let participant = Participant::new(support::domain(115)).unwrap();
    let mut sampler = Sampler::new(&participant).unwrap();
    let slots: Vec<Slot> = (0..200).map(|_| participant.claim_slot().unwrap()).collect();
    let start = monotonic_ns() + 1000 * MS;
    // What happened a minute before 100 us, 200 us ... after the start. In another order than the slots'. (Not an hour: the machine
    // may not have been up for that long.)
    let minute = Duration::from_secs(60);
    let due = |index: usize| start + (index as u64 * 77 % 200) * MS / 10;
    let mut watchdogs: Vec<_> = slots
        .iter()
        .enumerate()
        .map(|(index, slot)| {
            slot.note(ActivityKind::Sample, due(index) - 60_000 * MS);
            Watchdog::new(sampler.events(), slot.activity(ActivityKind::Sample), minute).unwrap()
        })
        .collect();
    // Happens again in time.
    for (index, slot) in slots.iter().enumerate().filter(|(index, _)| index % 2 == 0) {
        slot.note(ActivityKind::Sample, due(index));
    }
    let mut expired = Vec::new();
    while expired.len() < 100 {
        sampler.spin_once(Some(Duration::from_secs(1)));
        for (index, watchdog) in watchdogs.iter_mut().enumerate() {
            if let Poll::Ready(expiry) = poll(watchdog) {
                assert!(monotonic_ns() >= expiry.due_ns, "never early");
                assert_eq!(expiry, Expiry { due_ns: due(index), count: 1, change: 1 });
                expired.push((expiry.due_ns, index));
            }
        }
    }
    assert!(expired.iter().all(|(_, index)| index % 2 == 1), "those that were fed do not expire");
    assert!(watchdogs.iter_mut().all(|watchdog| poll(watchdog).is_pending()), "and each once");
}

#[test]
fn silence_expires_once_in_each_period_and_nothing_before_the_first_sign() {
    let participant = Participant::new(support::domain(115)).unwrap();
    let mut sampler = Sampler::new(&participant).unwrap();
    let slot = participant.claim_slot().unwrap();
    let (activity, period_ns) = (slot.activity(ActivityKind::Liveliness), 2 * MS);
    let mut watchdog = Watchdog::new(sampler.events(), activity, Duration::from_nanos(period_ns)).unwrap();
    let end = monotonic_ns() + 5 * period_ns;
    while monotonic_ns() < end {
        sampler.spin_once(Some(Duration::from_nanos(period_ns)));
        assert!(poll(&mut watchdog).is_pending(), "nothing has begun");
    }
    let begun = monotonic_ns();
    slot.note(ActivityKind::Liveliness, begun);
    slot.note(ActivityKind::Sample, begun + HOUR_NS);
    let mut count = 0;
    while count < 5 {
        sampler.spin_once(Some(HOUR));
        if let Poll::Ready(expiry) = poll(&mut watchdog) {
            count += expiry.change;
            assert_eq!((expiry.count, expiry.due_ns), (count, begun + count * period_ns));
            assert!(monotonic_ns() >= expiry.due_ns, "never early");
        }
    }
}

#[test]
fn an_alarm_rings_when_it_is_set_to_and_can_be_set_anew() {
    let participant = Participant::new(support::domain(115)).unwrap();
    let mut sampler = Sampler::new(&participant).unwrap();
    let mut alarm = Alarm::new(sampler.events()).unwrap();
    let mut rung = |alarm: &tautline_sampler::Alarm| {
        sampler.spin_once(Some(Duration::ZERO));
        alarm.poll(&mut Context::from_waker(Waker::noop())).is_ready()
    };
    assert!(!rung(&alarm));
    alarm.set(Some(monotonic_ns() + HOUR_NS));
    assert!(!rung(&alarm));
    let soon = monotonic_ns() + 2 * MS;
    alarm.set(Some(soon));
    while !rung(&alarm) {}
    assert!(monotonic_ns() >= soon);
    alarm.set(None);
    assert!(!rung(&alarm));
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Setting the system's clock does not disturb timers. Runs alone, since all programs see the step: `cargo xtask ci`
//! does so where it may set the clock, with `TAUT_STEP_CLOCK=1`.

use futures::task::noop_waker_ref;
use rustix::time::{ClockId, Timespec, clock_gettime, clock_settime};
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_rt::clock::monotonic_ns;
use tautline_sampler::{Sampler, Tick, Timer};
use tautline_transport::Participant;

const HOUR: i64 = 3_600;
const PERIOD: Duration = Duration::from_millis(2);

/// The clock, put right again however the test ends: it is what it was, plus the time that passed.
struct Stepped {
    wall: Timespec,
    at_ns: u64,
}

impl Stepped {
    fn by(seconds: i64) -> Self {
        let stepped = Stepped { wall: clock_gettime(ClockId::Realtime), at_ns: monotonic_ns() };
        let wall = Timespec { tv_sec: stepped.wall.tv_sec + seconds, ..stepped.wall };
        clock_settime(ClockId::Realtime, wall).expect("this user may set the clock");
        stepped
    }
}

impl Drop for Stepped {
    fn drop(&mut self) {
        let passed_ns = (monotonic_ns() - self.at_ns) as i64 + self.wall.tv_nsec;
        let wall = Timespec {
            tv_sec: self.wall.tv_sec + passed_ns / 1_000_000_000,
            tv_nsec: passed_ns % 1_000_000_000,
        };
        let _ = clock_settime(ClockId::Realtime, wall);
    }
}

#[test]
fn a_clock_step_does_not_disturb_timers() {
    if std::env::var_os("TAUT_STEP_CLOCK").is_none() {
        println!("skipped: sets the system's clock for some milliseconds; TAUT_STEP_CLOCK=1 allows it");
        return;
    }
    let participant = Participant::new(193).unwrap();
    let mut sampler = Sampler::new(&participant).unwrap();
    let first_ns = monotonic_ns();
    let mut timer = Timer::starting_at(sampler.events(), first_ns, PERIOD).unwrap();
    let mut next = || loop {
        if let Poll::Ready(tick) = timer.poll_tick(&mut Context::from_waker(noop_waker_ref())) {
            return tick;
        }
        sampler.spin_once(Some(Duration::from_secs(30)));
    };
    let mut expect = |after: u64| -> u64 {
        let Tick { release_ns, index, missed, .. } = next();
        assert!(release_ns <= monotonic_ns(), "release {index} came early");
        assert_eq!(release_ns, first_ns + (index - 1) * PERIOD.as_nanos() as u64);
        assert_eq!(index, after + missed + 1, "every release is counted once");
        index
    };
    let mut last = 0;
    for step in [0, HOUR, -HOUR] {
        let _stepped = (step != 0).then(|| Stepped::by(step));
        for _ in 0..10 {
            last = expect(last);
        }
        // An hour late or a bunch of an hour's releases would show here.
        let elapsed = (monotonic_ns() - first_ns) / PERIOD.as_nanos() as u64 + 1;
        assert!(last <= elapsed, "{last} releases in {elapsed} periods");
    }
}

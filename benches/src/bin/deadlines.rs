// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long after a missed deadline does its event come, when one sampler watches 200 topics of 100 Hz?
//!
//! A thread on one core publishes on all topics, one after the other, every 10 ms; sampler and callback have the other core. In
//! alternating parts of one run and under the same load three things are due at times of their own: events of deadlines that are
//! missed because a message is left out; ticks of a timer, in a callback too; and the ends of bare sleeps (`clock_nanosleep`) in a
//! thread of the sampler's priority on the sampler's core, which is as exactly as this machine keeps any time: its timers'
//! resolution. How late each was is what is printed.

use futures::StreamExt;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tautline::std_msgs::msg::UInt64;
use tautline::{CallbackOptions, ContextBuilder, Node, Publisher, Qos, SubscriptionEvent};
use tautline_benches::Stage;
use tautline_harness::claims::{Claim, Goal, Ways, judge};
use tautline_harness::rows::{Metric, Row};
use tautline_harness::table::of_rows;
use tautline_harness::verdict::{self, Verdict};
use tautline_harness::{Beside, Distribution, Disturbance, Result, Run, TurnRow, Turns, machine, program};
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline_rt::{CoreSet, Policy};

const TOPICS: u64 = 200;
const PERIOD_NS: u64 = 10_000_000;
/// Missed when one message is left out, and not before.
const DEADLINE_NS: u64 = PERIOD_NS * 3 / 2;
/// Each topic leaves out one of so many messages: 400 misses a second.
const LEFT_OUT: u64 = 50;
/// Of ticks and bare sleeps: as many as there are misses, and at all phases of what is published.
const OTHER_PERIOD_NS: u64 = PERIOD_NS * LEFT_OUT / TOPICS + 7_001;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    BareSleep,
    Timer,
    Deadline,
}

impl Part {
    const ALL: [Part; 3] = [Part::BareSleep, Part::Timer, Part::Deadline];

    fn name(self) -> &'static str {
        match self {
            Part::BareSleep => "bare sleep",
            Part::Timer => "timer, in a callback",
            Part::Deadline => "deadline event, in a callback",
        }
    }
}

/// Where the part that is measured now records.
#[derive(Default)]
struct Recorder {
    /// One more than the index of the part; zero: nothing is recorded.
    part: AtomicUsize,
    now: Mutex<Distribution>,
    told: AtomicU64,
    left_out: AtomicU64,
}

impl Recorder {
    fn is_on(&self, part: Part) -> bool {
        self.part.load(Ordering::Acquire) == part as usize + 1
    }

    fn record(&self, part: Part, late_ns: u64) {
        // Never taken by another thread while something is recorded.
        if self.is_on(part)
            && let Ok(mut now) = self.now.try_lock()
        {
            now.record(late_ns);
        }
    }
}

fn main() -> ExitCode {
    program("deadlines", "Measures how late events of missed deadlines are", measure)
}

fn measure(options: &Run) -> Result {
    let (rounds, part) =
        if options.quick { (3, Duration::from_secs(1)) } else { (15, Duration::from_secs(3)) };
    let (machine, disturbance) = (machine(), Disturbance::start());
    let stage = Stage::new()?;
    let (core, publishing_core) = (stage.core, stage.other_core);
    let mut node = Node::create(stage.context.clone(), "deadlines_bench", "")?;
    let recorder = Arc::new(Recorder::default());

    let qos = Qos::keep_last(1).deadline(Duration::from_nanos(DEADLINE_NS));
    let (mut publishers, mut subscriptions, mut events) = (Vec::new(), Vec::new(), Vec::new());
    for index in 0..TOPICS {
        let topic = format!("/deadlines_bench/topic_{index}");
        publishers.push(node.create_publisher::<UInt64>(&topic, qos)?);
        let subscription = node.subscribe::<UInt64>(&topic, qos)?;
        events.push(node.subscription_events(&subscription)?);
        subscriptions.push(subscription);
    }
    let of_events = recorder.clone();
    let watch = futures::stream::select_all(events).for_each(move |event| {
        let now_ns = monotonic_ns();
        if let SubscriptionEvent::RequestedDeadlineMissed(missed) = event {
            of_events.record(Part::Deadline, now_ns.saturating_sub(missed.due_ns));
            of_events.told.fetch_add(missed.total_count_change, Ordering::Relaxed);
        }
        async {}
    });
    let options_of = |name: &str| CallbackOptions::fifo(40).core(core).name(name);
    let mut callbacks = vec![node.spawn_callback(options_of("events"), watch)?];
    let of_timer = recorder.clone();
    let tick = node.create_wall_timer(Duration::from_nanos(OTHER_PERIOD_NS))?.for_each(move |tick| {
        of_timer.record(Part::Timer, monotonic_ns().saturating_sub(tick.release_ns));
        async {}
    });
    callbacks.push(node.spawn_callback(options_of("timer"), tick)?);
    let policy = |priority: u8| stage.realtime.then_some(Policy::Fifo(priority));
    let measured = stage.spin_while(callbacks, || {
        // As a driver: what it leaves out is what is missed, and no more.
        let (to, below) = (recorder.clone(), policy(ContextBuilder::SAMPLER_PRIORITY - 1));
        let publishing = Beside::start(move |stop| publish(&publishers, &to, publishing_core, below, stop));
        let (to, same) = (recorder.clone(), policy(ContextBuilder::SAMPLER_PRIORITY));
        let sleeping = Beside::start(move |stop| sleep(&to, core, same, stop));
        let measured = run(&recorder, rounds, part);
        let (published, slept) = (publishing.end(), sleeping.end());
        published?;
        slept?;
        measured
    })?;
    drop(subscriptions);
    let (mut rows, disturbance) = (measured?, disturbance.report());
    for row in &mut rows {
        (row.disturbance, row.row.unfit) = (disturbance.clone(), stage.unfit());
        row.realtime = row.row.unfit.is_none();
    }
    println!("µs after the time that it was due, while {TOPICS} topics of 100 Hz are published\n");
    println!("{}\n\n{machine}\n{disturbance}\n", of_rows(rows.iter().map(|row| &row.row)));
    options.write(&rows)?;
    verdict::print(&verdicts(&rows.into_iter().map(|row| row.row).collect::<Vec<_>>()))
}

/// An event may come one resolution of the machine's timers after an exact one would; each missed deadline has one.
fn verdicts(rows: &[Row]) -> Vec<Verdict> {
    let [sleep, event] = [[Part::BareSleep.name()], [Part::Deadline.name()]];
    let event = Ways::new("lateness", None, "tautline", &event);
    let late = Goal::Times(2.0, Ways::new("lateness", None, "linux", &sleep));
    let late = Claim { however_few: true, ..Claim::new(Metric::P99, event, late) };
    judge(rows, [late, Claim::new(Metric::Lost, event, Goal::Number(0.0))])
}

/// All topics, one after the other, in each period; while deadlines are measured some messages are left out.
fn publish(
    publishers: &[Publisher<UInt64>],
    recorder: &Recorder,
    core: usize,
    policy: Option<Policy>,
    stop: &AtomicBool,
) -> std::result::Result<(), tautline_rt::RtError> {
    tautline_rt::set_affinity(CoreSet::one(core))?;
    policy.map_or(Ok(()), tautline_rt::set_policy)?;
    let start_ns = monotonic_ns() + PERIOD_NS;
    for round in 0.. {
        for (index, publisher) in (0..).zip(publishers) {
            if stop.load(Ordering::Relaxed) {
                return Ok(());
            }
            sleep_until_monotonic(start_ns + round * PERIOD_NS + index * (PERIOD_NS / TOPICS));
            if recorder.is_on(Part::Deadline) && (round + index) % LEFT_OUT == 0 {
                recorder.left_out.fetch_add(1, Ordering::Relaxed);
            } else {
                // Nobody takes: the newest is kept.
                let _ = publisher.publish(&UInt64 { data: round });
            }
        }
    }
    Ok(())
}

fn sleep(
    recorder: &Recorder,
    core: usize,
    policy: Option<Policy>,
    stop: &AtomicBool,
) -> std::result::Result<(), tautline_rt::RtError> {
    tautline_rt::set_affinity(CoreSet::one(core))?;
    policy.map_or(Ok(()), tautline_rt::set_policy)?;
    let mut due_ns = monotonic_ns();
    while !stop.load(Ordering::Relaxed) {
        // While others are measured it is not in their way.
        let period_ns = if recorder.is_on(Part::BareSleep) { OTHER_PERIOD_NS } else { 10 * PERIOD_NS };
        due_ns = (due_ns + period_ns).max(monotonic_ns());
        sleep_until_monotonic(due_ns);
        recorder.record(Part::BareSleep, monotonic_ns().saturating_sub(due_ns));
    }
    Ok(())
}

/// How late things were in each part of all rounds.
fn run(recorder: &Recorder, rounds: u32, part: Duration) -> Result<Vec<TurnRow>> {
    // Until what was left out before, or is left out last, has been told: some deadlines.
    let pause = Duration::from_nanos(10 * DEADLINE_NS);
    std::thread::sleep(pause);
    let mut lost = [0; Part::ALL.len()];
    let turns: [Turns; Part::ALL.len()] = Turns::take(rounds, |index| {
        recorder.told.store(0, Ordering::Relaxed);
        recorder.left_out.store(0, Ordering::Relaxed);
        recorder.part.store(index + 1, Ordering::Release);
        std::thread::sleep(part);
        recorder.part.store(0, Ordering::Release);
        if Part::ALL[index] == Part::Deadline {
            // The last ones are due after their messages were left out: published again, and recorded no more.
            std::thread::sleep(pause);
            let (left_out, told) =
                (recorder.left_out.load(Ordering::Relaxed), recorder.told.load(Ordering::Relaxed));
            lost[index] += left_out.saturating_sub(told);
        }
        std::thread::sleep(pause);
        let mut now = recorder.now.lock().map_err(|_| "a callback panicked")?;
        Ok::<_, &str>(std::mem::take(&mut *now))
    })?;
    let of_part = |((part, turns), lost): ((Part, Turns), u64)| {
        let system = if part == Part::BareSleep { "linux" } else { "tautline" };
        let mut row = turns.row("lateness", system, part.name(), "bare sleep");
        // Missed deadlines of which no event came.
        (row.row.payload_bytes, row.row.lost) = (size_of::<u64>(), lost);
        row
    };
    Ok(Part::ALL.into_iter().zip(turns).zip(lost).map(of_part).collect())
}

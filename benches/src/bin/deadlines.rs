// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long after a missed deadline does its event come, when one sampler watches 200 topics of 100 Hz?
//!
//! A thread on one core publishes on all topics, one after the other, every 10 ms; sampler and callback have the other core. In
//! alternating parts of one run and under the same load three things are due at times of their own: events of deadlines that are
//! missed because a message is left out; ticks of a timer, in a callback too; and the ends of bare sleeps (`clock_nanosleep`) in a
//! thread of the sampler's priority on the sampler's core, which is as exactly as this machine keeps any time: its timers'
//! resolution. How late each was is what is printed.

use clap::Parser;
use futures::StreamExt;
use serde::Serialize;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tautline::rt::clock::{monotonic_ns, sleep_until_monotonic};
use tautline::std_msgs::msg::UInt64;
use tautline::{CallbackOptions, ContextBuilder, Node, Publisher, Qos, SubscriptionEvent};
use tautline_benches::{Distribution, Disturbance, Stage, Turns, machine, print_no_verdict, print_verdict};
use tautline_rt::{CoreSet, Policy};

const TOPICS: u64 = 200;
const PERIOD_NS: u64 = 10_000_000;
/// Missed when one message is left out, and not before.
const DEADLINE_NS: u64 = PERIOD_NS * 3 / 2;
/// Each topic leaves out one of so many messages: 400 misses a second.
const LEFT_OUT: u64 = 50;
/// Of ticks and bare sleeps: as many as there are misses, and at all phases of what is published.
const OTHER_PERIOD_NS: u64 = PERIOD_NS * LEFT_OUT / TOPICS + 7_001;
/// An event may come one resolution after what is exact.
const RATIO_LIMIT: f64 = 2.0;

/// Measures how late events of missed deadlines are.
#[derive(Parser)]
struct Options {
    /// Fewer and shorter rounds: some seconds
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<std::path::PathBuf>,
}

/// What is due in this part of the run.
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

/// How late things were in one part of all rounds.
struct Lateness {
    part: Part,
    turns: Turns,
    /// Missed deadlines of which no event came.
    lost: u64,
}

#[derive(Serialize)]
struct Row {
    experiment: &'static str,
    system: &'static str,
    mode: &'static str,
    payload_bytes: usize,
    n: u64,
    p50_us: f64,
    p99_us: f64,
    p999_us: f64,
    max_us: f64,
    lost: u64,
    /// Of the 99th percentile to that of the bare sleeps: the median of the rounds, the least and the greatest.
    ratio: [f64; 3],
    realtime: bool,
    disturbance: String,
}

/// Where the part that is measured now records.
#[derive(Default)]
struct Recorder {
    /// One more than the index of the part; zero: nothing is recorded.
    part: AtomicUsize,
    now: Mutex<Distribution>,
    told: AtomicU64,
    left_out: AtomicU64,
    stop: AtomicBool,
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
    tautline_benches::exit("deadlines", measure(&Options::parse()))
}

fn measure(options: &Options) -> Result<(), Box<dyn std::error::Error>> {
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
        let publishing = std::thread::spawn({
            // As a driver: what it leaves out is what is missed, and no more.
            let (recorder, policy) = (recorder.clone(), policy(ContextBuilder::SAMPLER_PRIORITY - 1));
            move || publish(&publishers, &recorder, publishing_core, policy)
        });
        let sleeping = std::thread::spawn({
            let (recorder, policy) = (recorder.clone(), policy(ContextBuilder::SAMPLER_PRIORITY));
            move || sleep(&recorder, core, policy)
        });
        let measured = run(&recorder, rounds, part);
        recorder.stop.store(true, Ordering::Relaxed);
        publishing.join().map_err(|_| "the publishing thread panicked")??;
        sleeping.join().map_err(|_| "the sleeping thread panicked")??;
        measured
    })?;
    drop(subscriptions);
    report(&measured?, options, stage.is_fit(), &machine, &disturbance.report())
}

/// All topics, one after the other, in each period; while deadlines are measured some messages are left out.
fn publish(
    publishers: &[Publisher<UInt64>],
    recorder: &Recorder,
    core: usize,
    policy: Option<Policy>,
) -> Result<(), tautline_rt::RtError> {
    tautline_rt::set_affinity(CoreSet::one(core))?;
    policy.map_or(Ok(()), tautline_rt::set_policy)?;
    let start_ns = monotonic_ns() + PERIOD_NS;
    for round in 0.. {
        for (index, publisher) in (0..).zip(publishers) {
            if recorder.stop.load(Ordering::Relaxed) {
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

fn sleep(recorder: &Recorder, core: usize, policy: Option<Policy>) -> Result<(), tautline_rt::RtError> {
    tautline_rt::set_affinity(CoreSet::one(core))?;
    policy.map_or(Ok(()), tautline_rt::set_policy)?;
    let mut due_ns = monotonic_ns();
    while !recorder.stop.load(Ordering::Relaxed) {
        // While others are measured it is not in their way.
        let period_ns = if recorder.is_on(Part::BareSleep) { OTHER_PERIOD_NS } else { 10 * PERIOD_NS };
        due_ns = (due_ns + period_ns).max(monotonic_ns());
        sleep_until_monotonic(due_ns);
        recorder.record(Part::BareSleep, monotonic_ns().saturating_sub(due_ns));
    }
    Ok(())
}

fn run(
    recorder: &Recorder,
    rounds: usize,
    part: Duration,
) -> Result<Vec<Lateness>, Box<dyn std::error::Error>> {
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
    let of_part = |((part, turns), lost)| Lateness { part, turns, lost };
    Ok(Part::ALL.into_iter().zip(turns).zip(lost).map(of_part).collect())
}

fn report(
    results: &[Lateness],
    options: &Options,
    is_judged: bool,
    machine: &str,
    disturbance: &str,
) -> Result<(), Box<dyn std::error::Error>> {
    let row = |of: &Lateness| {
        let times = &of.turns.of_all;
        Row {
            experiment: "lateness",
            system: if of.part == Part::BareSleep { "linux" } else { "tautline" },
            mode: of.part.name(),
            payload_bytes: size_of::<u64>(),
            n: times.len(),
            p50_us: times.quantile_us(0.5),
            p99_us: times.quantile_us(0.99),
            p999_us: times.quantile_us(0.999),
            max_us: times.max_us(),
            lost: of.lost,
            ratio: of.turns.ratio(),
            realtime: is_judged,
            disturbance: disturbance.to_owned(),
        }
    };
    let rows: Vec<Row> = results.iter().map(row).collect();
    println!("µs after the time that it was due, while {TOPICS} topics of 100 Hz are published\n");
    println!(
        "{:<30}  {:>6}  {:>7}  {:>7}  {:>7}  {:>7}  {:>5}  p99 to the bare sleep's",
        "what", "n", "p50", "p99", "p99.9", "max", "lost"
    );
    for Row { mode, n, p50_us, p99_us, p999_us, max_us, lost, ratio, .. } in &rows {
        let [median, least, greatest] = ratio;
        println!(
            "{mode:<30}  {n:>6}  {p50_us:7.1}  {p99_us:7.1}  {p999_us:7.1}  {max_us:7.1}  {lost:>5}  {median:.2} ({least:.2} to \
             {greatest:.2})"
        );
    }
    println!("\n{machine}\n{disturbance}\n");
    if let Some(path) = &options.json {
        tautline_benches::write_json(path, &rows)?;
    }
    let Some(of_event) = rows.last().filter(|_| is_judged) else {
        print_no_verdict();
        return Ok(());
    };
    let ratio = of_event.ratio[0];
    print_verdict(
        ratio <= RATIO_LIMIT,
        &format!(
            "an event comes at most one resolution of this machine's timers after an exact one would: p99 {ratio:.2} times that of a \
             bare sleep (median of rounds), limit {RATIO_LIMIT}"
        ),
    );
    print_verdict(of_event.lost == 0, &format!("every missed deadline is told: {} were not", of_event.lost));
    Ok(())
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does a callback that overruns its budget make others miss their deadlines?
//!
//! Four callbacks of one core, with rate-monotonic priorities, each a timer and work that takes a part of its budget. One after the
//! other, jobs chosen at random do 2 to 100 times their work; in parts of one run those are only counted, demoted or suspended when
//! their budget is used up, or do not happen while something else computes below the callbacks, which is what this machine does to
//! deadlines by itself. What is printed is in how many runs any other
//! callback missed a deadline, how often, and in how many of these runs a job was late that would have been in time with what was taken from
//! the core while it waited and ran: not the overrun's doing.

use clap::Parser;
use futures::StreamExt;
use serde::Serialize;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;
use tautline::rt::clock::{burn_cpu, monotonic_ns};
use tautline::{CallbackHandle, CallbackOptions, CallbackStats, Context, Moment, MomentKind, Node};
use tautline_analysis::taken::{self, Taken, TakenTimes};
use tautline_benches::{Disturbance, Stage, machine, print_no_verdict, print_verdict};
use tautline_rt::CoreSet;

/// Periods in ms, which are the deadlines.
const PERIODS_MS: [u64; 4] = [5, 10, 20, 40];
/// The work of a job is so much of its period, the budget half as much again.
const WORK: f64 = 0.08;

/// Measures what overruns of one callback do to the deadlines of others.
#[derive(Parser)]
struct Options {
    /// A twentieth of the runs: half a minute
    #[arg(long)]
    quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    json: Option<std::path::PathBuf>,
    /// Repeat the choices of a run that printed this seed
    #[arg(long)]
    seed: Option<u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    None,
    Counted,
    Demoted,
    Suspended,
}

impl Part {
    fn name(self) -> &'static str {
        match self {
            Part::None => "nobody, others compute",
            Part::Counted => "overruns are counted",
            Part::Demoted => "overruns are demoted",
            Part::Suspended => "overruns are suspended",
        }
    }
}

#[derive(Serialize)]
struct Row {
    part: &'static str,
    runs: u64,
    runs_with_misses: u64,
    /// Of these runs: those in which what the host took from the core explains each late job.
    runs_explained: u64,
    /// What it took in all runs.
    taken_ms: f64,
    longest_taken_ms: f64,
    misses: u64,
    overruns: u64,
    demotions: u64,
    realtime: bool,
    disturbance: String,
}

fn main() -> ExitCode {
    tautline_benches::exit("budgets", measure(&Options::parse()))
}

fn measure(options: &Options) -> Result<(), Box<dyn std::error::Error>> {
    let runs = if options.quick { 50 } else { 1_000 };
    let seed = options.seed.unwrap_or_else(tautline::rt::clock::monotonic_ns);
    println!("seed {seed}");
    let (machine, mut rows) = (machine(), Vec::new());
    // A fifth of the runs shows what happens if nothing is held.
    let parts =
        [(Part::None, runs), (Part::Counted, runs / 5), (Part::Demoted, runs), (Part::Suspended, runs)];
    for (part, runs) in parts {
        rows.push(measure_part(part, runs, seed)?);
    }
    report(&rows, options, &machine)
}

fn measure_part(part: Part, runs: u64, seed: u64) -> Result<Row, Box<dyn std::error::Error>> {
    let stage = Stage::with(Context::builder().account_core_time(Some(Duration::from_micros(100))))?;
    let disturbance = Disturbance::start();
    let mut node = Node::create(stage.context.clone(), "budgets_bench", "")?;
    let more: [Arc<AtomicU64>; PERIODS_MS.len()] = Default::default();
    let mut callbacks = Vec::new();
    for (i, (period_ms, more)) in PERIODS_MS.into_iter().zip(&more).enumerate() {
        let period = Duration::from_millis(period_ms);
        let (work, more) = (period.mul_f64(WORK), more.clone());
        let timer = node.create_wall_timer(period)?.for_each(move |_| {
            burn_cpu(work * u32::try_from(more.swap(0, Ordering::AcqRel)).unwrap_or(1).max(1));
            async {}
        });
        let thread = CallbackOptions::fifo(40 - i as u8).core(stage.core).name(format!("{period_ms} ms"));
        let thread = thread.period(period).budget(work.mul_f64(1.5)).bound(period);
        let thread = match part {
            Part::Demoted if stage.realtime => thread.demote_on_overrun(),
            Part::Suspended if stage.realtime => thread.suspend_on_overrun(),
            _ => thread,
        };
        callbacks.push(node.spawn_callback(thread, timer)?);
    }
    let watched: Vec<CallbackHandle> = callbacks.clone();
    let core = stage.core;
    let sampler = stage.context.sampler_statistics();
    let seen = stage.spin_while(callbacks, || run(part, runs, seed, core, &more, &watched, sampler))?;
    let pieces = || seen.taken.iter();
    let sum = |of: fn(&CallbackHandle) -> u64| watched.iter().map(of).sum();
    Ok(Row {
        part: part.name(),
        runs,
        runs_with_misses: seen.runs,
        runs_explained: seen.explained,
        taken_ms: pieces().sum::<u64>() as f64 / 1e6,
        longest_taken_ms: pieces().max().copied().unwrap_or(0) as f64 / 1e6,
        misses: seen.misses,
        overruns: sum(|callback| callback.stats().overruns()),
        demotions: sum(|callback| callback.stats().demotions()),
        realtime: stage.is_fit(),
        disturbance: disturbance.report(),
    })
}

/// What others missed.
#[derive(Default)]
struct Seen {
    runs: u64,
    explained: u64,
    misses: u64,
    /// The pieces that the host took, in ns.
    taken: Vec<u64>,
}

/// One overrun after the other. In how many runs others missed deadlines, and how many.
fn run(
    part: Part,
    runs: u64,
    seed: u64,
    core: usize,
    more: &[Arc<AtomicU64>],
    callbacks: &[CallbackHandle],
    sampler: Option<&Arc<CallbackStats>>,
) -> Seen {
    let longest = Duration::from_millis(PERIODS_MS[PERIODS_MS.len() - 1]);
    let stop = Arc::new(AtomicBool::new(part != Part::None));
    // A core that computes is one from which a hypervisor takes time: so it does while something overruns.
    let computing = std::thread::spawn({
        let stop = stop.clone();
        move || {
            let bound = tautline_rt::set_affinity(CoreSet::one(core));
            while bound.is_ok() && !stop.load(Ordering::Relaxed) {
                std::hint::spin_loop();
            }
        }
    });
    std::thread::sleep(2 * longest);
    let mut random = seed | 1;
    let mut below = |limit: u64| {
        // Marsaglia's xorshift: the same choices in each part.
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random % limit
    };
    let mut seen = Seen::default();
    for _ in 0..runs {
        let (who, times) = (below(callbacks.len() as u64) as usize, 2 + below(99));
        let others = || {
            let others = callbacks.iter().enumerate().filter(|(i, _)| *i != who);
            others.map(|(_, callback)| missed(callback)).sum::<u64>()
        };
        let (before, over, begin_ns) = (others(), callbacks[who].stats().overruns(), monotonic_ns());
        if part == Part::None {
            std::thread::sleep(longest * 7 / 2);
        } else {
            more[who].store(times, Ordering::Release);
            while callbacks[who].stats().overruns() == over {
                std::thread::sleep(longest / 10);
            }
            // Until what has waited for it is done, and every other one has had its turn.
            std::thread::sleep(2 * longest);
        }
        let now = others() - before;
        seen.misses += now;
        seen.runs += u64::from(now > 0);
        let (late, taken) = moments(callbacks, sampler, who, begin_ns);
        seen.taken.extend(taken.pieces().iter().map(|piece| piece.length_ns));
        let is_explained = |(moment, deadline_ns): &(Moment, u64)| {
            // As far back as the job before may have ended.
            let window_ns = moment.length_ns + deadline_ns;
            moment.length_ns.saturating_sub(taken.before(moment.to_ns, window_ns)) <= *deadline_ns
        };
        seen.explained += u64::from(now > 0 && !late.is_empty() && late.iter().all(is_explained));
    }
    stop.store(true, Ordering::Relaxed);
    // It only computes.
    let _ = computing.join();
    seen
}

/// The late jobs of all callbacks but `who` that began since `begin_ns`, each with its deadline, and what was taken from the core since.
fn moments(
    callbacks: &[CallbackHandle],
    sampler: Option<&Arc<CallbackStats>>,
    who: usize,
    begin_ns: u64,
) -> (Vec<(Moment, u64)>, TakenTimes) {
    let (mut late, mut taken) = (Vec::new(), Vec::new());
    for (i, stats) in callbacks.iter().map(CallbackHandle::stats).chain(sampler).enumerate() {
        let Some(seen) = stats.snapshot() else { continue };
        for moment in seen.moments.into_iter().filter(|moment| moment.to_ns >= begin_ns) {
            let Moment { from_ns, to_ns, length_ns, .. } = moment;
            let piece = |seen| Taken { from_ns, to_ns, length_ns, seen };
            match moment.kind {
                MomentKind::Taken => taken.push(piece(taken::Seen::Running)),
                MomentKind::WokenLate => taken.push(piece(taken::Seen::WokenLate)),
                MomentKind::Late if i != who => late.push((moment, seen.bound_ns.unwrap_or(0))),
                MomentKind::Late | MomentKind::Overran | MomentKind::Served | MomentKind::Waited => {}
            }
        }
    }
    (late, TakenTimes::new(taken))
}

/// Deadlines that jobs missed, and releases for which there was no job because the one before had not ended.
fn missed(callback: &CallbackHandle) -> u64 {
    callback.stats().snapshot().map_or(0, |seen| seen.deadline_misses + seen.lost)
}

fn report(rows: &[Row], options: &Options, machine: &str) -> Result<(), Box<dyn std::error::Error>> {
    println!("\nmissed deadlines of the others, while a callback does 2 to 100 times its work\n");
    println!(
        "{:<22}  {:>5}  {:>9}  {:>9}  {:>7}  {:>9}  {:>9}",
        "", "runs", "with some", "explained", "misses", "overruns", "held"
    );
    for row in rows {
        println!(
            "{:<22}  {:>5}  {:>9}  {:>9}  {:>7}  {:>9}  {:>9}",
            row.part,
            row.runs,
            row.runs_with_misses,
            row.runs_explained,
            row.misses,
            row.overruns,
            row.demotions
        );
    }
    println!("\n{machine}");
    for row in rows {
        println!(
            "{}: the host took {:.1} ms of the core, at most {:.1} ms at once; {}",
            row.part, row.taken_ms, row.longest_taken_ms, row.disturbance
        );
    }
    println!();
    if let Some(path) = &options.json {
        tautline_benches::write_json(path, rows)?;
    }
    let [none, _, demoted, suspended] = rows else { return Err("a part is missing".into()) };
    if !(demoted.realtime && suspended.realtime) {
        print_no_verdict();
        return Ok(());
    }
    // What the machine does by itself may happen a little more often or less.
    let unexplained = |row: &Row| row.runs_with_misses - row.runs_explained;
    let most = 2 * unexplained(none) + 1;
    print_verdict(
        unexplained(demoted) <= most && unexplained(suspended) <= most,
        &format!(
            "an overrun costs no other callback its deadline: in {} of {} runs with demotion and {} of {} with suspension some was missed \
             that what the host took does not explain, in {} of {} while nobody overran",
            unexplained(demoted),
            demoted.runs,
            unexplained(suspended),
            suspended.runs,
            unexplained(none),
            none.runs
        ),
    );
    Ok(())
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does a callback that overruns its budget make others miss their deadlines?
//!
//! Four callbacks of one core, with rate-monotonic priorities, each a timer and work that takes a part of its budget. One after the
//! other, jobs chosen at random do 2 to 100 times their work; in parts of one run those are only counted, demoted when their budget
//! is used up, or do not
//! happen while something else computes below the callbacks, which is what this machine does to deadlines by itself. What is printed is in how many runs any other
//! callback missed a deadline, and how often.

use clap::Parser;
use futures::StreamExt;
use serde::Serialize;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;
use tautline::rt::clock::burn_cpu;
use tautline::{CallbackHandle, CallbackOptions, Node};
use tautline_benches::{Disturbance, Stage, machine, print_no_verdict, print_verdict};
use tautline_rt::CoreSet;
use tautline_rt::host::steal_ticks;

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
}

impl Part {
    fn name(self) -> &'static str {
        match self {
            Part::None => "nobody, others compute",
            Part::Counted => "overruns are counted",
            Part::Demoted => "overruns are demoted",
        }
    }
}

#[derive(Serialize)]
struct Row {
    part: &'static str,
    runs: u64,
    runs_with_misses: u64,
    /// Of these runs: those in which the hypervisor took time of the core.
    runs_with_misses_and_steal: u64,
    misses: u64,
    overruns: u64,
    demotions: u64,
    realtime: bool,
    disturbance: String,
}

fn main() -> ExitCode {
    match measure(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("budgets: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(options: &Options) -> Result<(), Box<dyn std::error::Error>> {
    let runs = if options.quick { 50 } else { 1_000 };
    let seed = options.seed.unwrap_or_else(tautline::rt::clock::monotonic_ns);
    println!("seed {seed}");
    let (machine, mut rows) = (machine(), Vec::new());
    // A fifth of the runs shows what happens if nothing is held.
    for (part, runs) in [(Part::None, runs), (Part::Counted, runs / 5), (Part::Demoted, runs)] {
        rows.push(measure_part(part, runs, seed)?);
    }
    report(&rows, options, &machine)
}

fn measure_part(part: Part, runs: u64, seed: u64) -> Result<Row, Box<dyn std::error::Error>> {
    let (stage, disturbance) = (Stage::new()?, Disturbance::start());
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
        let thread = thread.period(period).budget(work.mul_f64(1.5));
        let thread =
            if part == Part::Demoted && stage.realtime { thread.demote_on_overrun() } else { thread };
        callbacks.push(node.spawn_callback(thread, timer)?);
    }
    let watched: Vec<CallbackHandle> = callbacks.clone();
    let core = stage.core;
    let seen = stage.spin_while(callbacks, || run(part, runs, seed, core, &more, &watched))?;
    let sum = |of: fn(&CallbackHandle) -> u64| watched.iter().map(of).sum();
    Ok(Row {
        part: part.name(),
        runs,
        runs_with_misses: seen.runs,
        runs_with_misses_and_steal: seen.runs_with_steal,
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
    runs_with_steal: u64,
    misses: u64,
}

/// One overrun after the other. In how many runs others missed deadlines, and how many.
fn run(
    part: Part,
    runs: u64,
    seed: u64,
    core: usize,
    more: &[Arc<AtomicU64>],
    callbacks: &[CallbackHandle],
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
        let (before, over, steal) = (others(), callbacks[who].stats().overruns(), steal_ticks(Some(core)));
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
        seen.runs_with_steal += u64::from(now > 0 && steal_ticks(Some(core)) > steal);
    }
    stop.store(true, Ordering::Relaxed);
    // It only computes.
    let _ = computing.join();
    seen
}

/// Deadlines that jobs missed, and releases for which there was no job because the one before had not ended.
fn missed(callback: &CallbackHandle) -> u64 {
    callback.stats().snapshot().map_or(0, |seen| seen.deadline_misses + seen.lost)
}

fn report(rows: &[Row], options: &Options, machine: &str) -> Result<(), Box<dyn std::error::Error>> {
    println!("\nmissed deadlines of the others, while a callback does 2 to 100 times its work\n");
    println!(
        "{:<22}  {:>5}  {:>9}  {:>9}  {:>7}  {:>9}  {:>9}",
        "", "runs", "with some", "and steal", "misses", "overruns", "demotions"
    );
    for row in rows {
        println!(
            "{:<22}  {:>5}  {:>9}  {:>9}  {:>7}  {:>9}  {:>9}",
            row.part,
            row.runs,
            row.runs_with_misses,
            row.runs_with_misses_and_steal,
            row.misses,
            row.overruns,
            row.demotions
        );
    }
    println!("\n{machine}");
    rows.iter().for_each(|row| println!("{}: {}", row.part, row.disturbance));
    println!();
    if let Some(path) = &options.json {
        std::fs::write(path, serde_json::to_string_pretty(rows)?)?;
    }
    let [none, _, demoted] = rows else { return Err("a part is missing".into()) };
    if !demoted.realtime {
        print_no_verdict();
        return Ok(());
    }
    // What the machine does by itself may happen a little more often or less.
    let unexplained = |row: &Row| row.runs_with_misses - row.runs_with_misses_and_steal;
    print_verdict(
        unexplained(demoted) <= 2 * unexplained(none) + 1,
        &format!(
            "an overrun costs no other callback its deadline: in {} of {} runs some was missed though the hypervisor took no time, in \
             {} of {} while nobody overran",
            unexplained(demoted),
            demoted.runs,
            unexplained(none),
            none.runs
        ),
    );
    Ok(())
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does a callback that overruns its budget make others miss their deadlines?
//!
//! Four callbacks of one core, with rate-monotonic priorities, each a timer and work that takes a part of its budget. One after the
//! other, jobs chosen at random do 2 to 100 times their work; in parts of one run those are only counted, demoted or suspended when
//! their budget is used up, or do not happen while something else computes below the callbacks, which is what this machine does to
//! deadlines by itself. What is printed is in how many runs any other
//! callback missed a deadline, how often, and in how many of these runs each late job would have been in time without what the host took from
//! the core: not the overrun's doing. Of the rest, waits for the core may be the host's doing or the overrun's. A suspended overrun lasts
//! long, and the host takes what it takes by time: so the rest is judged by the minute, against that of the part in which nobody overran.

use clap::Parser;
use futures::StreamExt;
use serde::Serialize;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tautline::{CallbackHandle, CallbackOptions, CallbackStats, Context, ContextBuilder, Node};
use tautline_analysis::taken::{self, Sight, Taken, TakenTimes};
use tautline_analysis::{Response, Task, response_times};
use tautline_benches::Stage;
use tautline_executor::{CallbackSnapshot, Moment, MomentKind};
use tautline_harness::readings::{Reading, judge};
use tautline_harness::table::Column::{Number, Words};
use tautline_harness::table::Table;
use tautline_harness::{Beside, Disturbance, Result, Run, cells, machine, verdict};
use tautline_rt::CoreSet;
use tautline_rt::clock::{burn_cpu, monotonic_ns};

/// Periods in ms, which are the deadlines.
const PERIODS_MS: [u64; 4] = [5, 10, 20, 40];
/// The work of a job is so much of its period, the budget half as much again.
const WORK: f64 = 0.08;
/// Of the callback with the shortest period; the others are below it.
const PRIORITY: u8 = 40;

/// Measures what overruns of one callback do to the deadlines of others.
#[derive(Parser)]
struct Options {
    #[command(flatten)]
    run: Run,
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

#[derive(Default, Serialize)]
struct Row {
    part: &'static str,
    runs: u64,
    /// In which others missed deadlines.
    runs_with_misses: u64,
    /// Of these runs: those in which what the host took from the core explains each late job.
    runs_explained: u64,
    /// Others: those in which it does with what threads waited for the core.
    runs_waited: u64,
    minutes: f64,
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
    tautline_harness::exit("budgets", measure(&Options::parse()))
}

fn measure(options: &Options) -> Result {
    let runs = if options.run.quick { 50 } else { 1_000 };
    let seed = options.seed.unwrap_or_else(tautline_rt::clock::monotonic_ns);
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

fn measure_part(part: Part, runs: u64, seed: u64) -> Result<Row> {
    let stage = Stage::with(Context::builder().account_core_time(Some(ContextBuilder::CORE_TIME_PIECE)))?;
    let disturbance = Disturbance::start();
    let mut node = Node::create(stage.context.clone(), "budgets_bench", "")?;
    let more: [Arc<AtomicU64>; PERIODS_MS.len()] = Default::default();
    let (mut callbacks, mut tasks) = (Vec::new(), Vec::new());
    for (i, (period_ms, more)) in PERIODS_MS.into_iter().zip(&more).enumerate() {
        let period = Duration::from_millis(period_ms);
        let (work, more) = (period.mul_f64(WORK), more.clone());
        let timer = node.create_wall_timer(period)?.for_each(move |_| {
            burn_cpu(work * u32::try_from(more.swap(0, Ordering::AcqRel)).unwrap_or(1).max(1));
            async {}
        });
        let (name, budget, priority) = (format!("{period_ms} ms"), work.mul_f64(1.5), PRIORITY - i as u8);
        tasks.push(Task::new(&name, period, budget, priority));
        let thread = CallbackOptions::fifo(priority).core(stage.core).name(name);
        let thread = thread.period(period).budget(budget).bound(period);
        let thread = match part {
            Part::Demoted if stage.realtime => thread.demote_on_overrun(),
            Part::Suspended if stage.realtime => thread.suspend_on_overrun(),
            _ => thread,
        };
        callbacks.push(node.spawn_callback(thread, timer)?);
    }
    let watched: Vec<CallbackHandle> = callbacks.clone();
    let (bounds, sampler) = (response_times(&tasks)?, stage.context.sampler_statistics());
    let watch = Watch { callbacks: &watched, tasks, bounds, sampler };
    let begin_ns = monotonic_ns();
    let seen = stage.spin_while(callbacks, || run(part, runs, seed, stage.core, &more, &watch))?;
    let sum = |of: fn(&CallbackHandle) -> u64| watched.iter().map(of).sum();
    Ok(Row {
        part: part.name(),
        runs,
        minutes: (monotonic_ns() - begin_ns) as f64 / 60e9,
        overruns: sum(|callback| callback.stats().overruns()),
        demotions: sum(|callback| callback.stats().demotions()),
        realtime: stage.unfit().is_none(),
        disturbance: disturbance.report(),
        ..seen
    })
}

/// One overrun after the other: what others missed.
fn run(part: Part, runs: u64, seed: u64, core: usize, more: &[Arc<AtomicU64>], watch: &Watch) -> Row {
    let callbacks = watch.callbacks;
    let longest = Duration::from_millis(PERIODS_MS[PERIODS_MS.len() - 1]);
    // A core that computes is one from which a hypervisor takes time: so it does while something overruns.
    let computing = Beside::start(move |stop| {
        let bound = tautline_rt::set_affinity(CoreSet::one(core));
        while part == Part::None && bound.is_ok() && !stop.load(Ordering::Relaxed) {
            std::hint::spin_loop();
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
    let mut seen = Row::default();
    for _ in 0..runs {
        let (who, times) = (below(callbacks.len() as u64) as usize, 2 + below(99));
        let missed = || callbacks.iter().map(Missed::so_far).collect::<Vec<_>>();
        let (before, begin_ns) = (missed(), monotonic_ns());
        if part == Part::None {
            std::thread::sleep(longest * 7 / 2);
        } else {
            more[who].store(times, Ordering::Release);
            while callbacks[who].stats().overruns() == before[who].overruns {
                std::thread::sleep(longest / 10);
            }
            // Until what has waited for it is done, which takes a suspended one some periods, and every other one has had its turn.
            std::thread::sleep(if part == Part::Suspended { 5 * longest } else { 2 * longest });
        }
        let others = missed().into_iter().zip(&before).enumerate().filter(|(i, _)| *i != who);
        let now =
            others.map(|(_, (now, before))| now.late + now.passed - before.late - before.passed).sum::<u64>();
        let (cause, taken) = watch.cause(who, begin_ns, &before);
        seen.misses += now;
        seen.runs_with_misses += u64::from(now > 0);
        seen.runs_explained += u64::from(now > 0 && cause == Cause::Host);
        seen.runs_waited += u64::from(now > 0 && cause == Cause::Waits);
        for piece in taken.pieces() {
            let taken_ms = piece.length_ns as f64 / 1e6;
            seen.taken_ms += taken_ms;
            seen.longest_taken_ms = seen.longest_taken_ms.max(taken_ms);
        }
    }
    computing.end();
    seen
}

/// What a callback has not done in time so far.
struct Missed {
    late: u64,
    /// Releases for which there was no job.
    passed: u64,
    overruns: u64,
}

impl Missed {
    fn so_far(callback: &CallbackHandle) -> Missed {
        let seen = CallbackSnapshot::of(callback.stats());
        let (late, passed) = seen.map_or((0, 0), |seen| (seen.deadline_misses, seen.lost));
        Missed { late, passed, overruns: callback.stats().overruns() }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cause {
    Host,
    Waits,
    Unknown,
}

/// What a callback but the one that overran has not done in time, with its deadline and priority.
struct Late {
    /// Without: a release for which there was no job.
    job: Option<Moment>,
    deadline_ns: u64,
    /// So long it takes at most if all keep their budgets.
    bound_ns: u64,
    priority: Option<u8>,
}

impl Late {
    /// Whether it would have been in time if nothing of this had been lost.
    fn is_explained_by(&self, taken: &TakenTimes) -> bool {
        // What is shorter than a piece is not noted.
        let accounted_ns = ContextBuilder::CORE_TIME_PIECE.as_nanos() as u64;
        match self.job {
            // As far back as the job before may have ended.
            Some(job) => {
                let lost_ns = taken.before(job.to_ns, job.length_ns + self.deadline_ns);
                job.length_ns.saturating_sub(lost_ns) <= self.deadline_ns + accounted_ns
            }
            // Since the release before.
            None => {
                taken.most_within(2 * self.deadline_ns) + self.bound_ns + accounted_ns >= self.deadline_ns
            }
        }
    }
}

struct Watch<'a> {
    callbacks: &'a [CallbackHandle],
    tasks: Vec<Task>,
    bounds: Vec<Response>,
    sampler: Option<&'a Arc<CallbackStats>>,
}

impl Watch<'_> {
    /// Why callbacks but `who` missed deadlines since `begin_ns`, and what the host took since. A callback that overran itself since
    /// `before` has the host to blame: its work is less than its budget, and the rest was charged for what the host took.
    fn cause(&self, who: usize, begin_ns: u64, before: &[Missed]) -> (Cause, TakenTimes) {
        let (mut late, mut sights, mut is_held) = (Vec::new(), Vec::new(), false);
        for (i, callback) in self.callbacks.iter().enumerate() {
            let Some(seen) = CallbackSnapshot::of(callback.stats()) else { continue };
            let (task, bound_ns) = (&self.tasks[i], self.bounds[i].response_ns);
            let priority = Some(task.priority);
            let of = |job| Late { job, deadline_ns: task.period_ns, bound_ns, priority };
            let keeps = i != who && seen.overruns == before[i].overruns;
            is_held |= i != who && !keeps;
            late.extend((keeps && seen.lost > before[i].passed).then(|| of(None)));
            for moment in seen.moments.into_iter().filter(|moment| moment.to_ns >= begin_ns) {
                let length_ns = moment.length_ns;
                let (seen, length_ns) = match moment.kind {
                    MomentKind::Late if keeps => {
                        late.push(of(Some(moment)));
                        continue;
                    }
                    MomentKind::Taken => (taken::Seen::Running, length_ns),
                    // Who overruns waits for itself.
                    MomentKind::Overran if i != who => (taken::Seen::Overran, length_ns),
                    MomentKind::Waited if i != who => {
                        (taken::Seen::Waited, length_ns.saturating_sub(bound_ns - task.wcet_ns))
                    }
                    _ => continue,
                };
                sights.push(sight(&moment, seen, length_ns, i as u64, priority));
            }
        }
        let sampler = self.sampler.and_then(|sampler| CallbackSnapshot::of(sampler));
        for moment in sampler.into_iter().flat_map(|seen| seen.moments).filter(|of| of.to_ns >= begin_ns) {
            let seen = match moment.kind {
                MomentKind::Taken => taken::Seen::Running,
                MomentKind::WokenLate => taken::Seen::WokenLate,
                MomentKind::Waited => taken::Seen::Waited,
                _ => continue,
            };
            sights.push(sight(&moment, seen, moment.length_ns, u64::MAX, Some(u8::MAX)));
        }
        let pieces = sights.iter().map(|sight| sight.taken);
        let known = TakenTimes::new(pieces.filter(|piece| piece.seen != taken::Seen::Waited));
        let with_waits = |late: &Late| late.is_explained_by(&TakenTimes::with_waits(&sights, late.priority));
        let cause = match () {
            () if late.is_empty() && !is_held => Cause::Unknown,
            () if late.iter().all(|late| late.is_explained_by(&known)) => Cause::Host,
            () if late.iter().all(with_waits) => Cause::Waits,
            () => Cause::Unknown,
        };
        (cause, known.seen(&[taken::Seen::Running, taken::Seen::WokenLate]))
    }
}

fn sight(moment: &Moment, seen: taken::Seen, length_ns: u64, thread: u64, priority: Option<u8>) -> Sight {
    let taken = Taken { from_ns: moment.from_ns, to_ns: moment.to_ns, length_ns, seen };
    Sight { taken, thread, priority }
}

fn report(rows: &[Row], options: &Options, machine: &str) -> Result {
    println!("\nmissed deadlines of the others, while a callback does 2 to 100 times its work\n");
    let numbers = ["runs", "minutes", "with some", "explained", "waited", "misses", "overruns", "held"];
    let columns = [Words("")].into_iter().chain(numbers.map(Number)).collect::<Vec<_>>();
    let mut table = Table::new(0, columns);
    for row in rows {
        table.add(cells![
            row.part,
            row.runs,
            format!("{:.1}", row.minutes),
            row.runs_with_misses,
            row.runs_explained,
            row.runs_waited,
            row.misses,
            row.overruns,
            row.demotions
        ]);
    }
    println!("{table}\n\n{machine}");
    for row in rows {
        println!(
            "{}: the host took {:.1} ms of the core, at most {:.1} ms at once; {}",
            row.part, row.taken_ms, row.longest_taken_ms, row.disturbance
        );
    }
    options.run.write(rows)?;
    let [none, rest @ ..] = rows else { return Err("nothing was measured".into()) };
    let unexplained = |row: &Row| row.runs_with_misses - row.runs_explained;
    let part = |row: &Row| format!("{} of {} runs ({:.1} minutes)", unexplained(row), row.runs, row.minutes);
    let reading = |row: &Row| {
        // What the machine does by itself may happen a little more often or less.
        let usual = 2.0 * unexplained(none) as f64 * row.minutes / none.minutes + 1.0;
        let what = "runs with missed deadlines that nothing taken from the core explains, to twice those in as many minutes while nobody overran, + 1";
        let one = Reading::of(row.part, 0, what, "x").value(unexplained(row) as f64 / usual);
        let one = match row.part == Part::Counted.name() {
            // Overruns that nothing holds are seen: else nothing would be proven.
            true => one.at_least(1.01),
            // A held one costs no other callback its deadline.
            false => one.at_most(1.0),
        };
        let unfit = (!row.realtime).then_some("it takes real-time priorities and two cores");
        one.note(format!("{}, while nobody overran {}", part(row), part(none))).unfit(unfit)
    };
    let mut readings: Vec<Reading> = rest.iter().map(reading).collect();
    println!();
    verdict::print(&judge(&mut readings))
}

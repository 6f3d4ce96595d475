// SPDX-License-Identifier: MIT OR Apache-2.0
//! All runs, rivals next to each other, and again those in which the core was taken away.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar};
use tautline_harness::{Disturbance, progress_bar};
use tautline_paper::priorities;
use tautline_rt::{CoreSet, IdleHold, Interruptions, Policy, Realtime, ThreadBuilder};

use crate::Result;
use crate::ledger::{Entry, Ledger};
use crate::plan::{Cell, Plan};
use crate::process::{self, Run};

/// How long the core is watched before the runs: not so long that the kernel's limit for real-time threads is seen.
const NOISE_WINDOW: Duration = Duration::from_millis(500);

/// How often a run may fail, as when its processes do not find each other, before hours of others are given up.
const ATTEMPTS: u32 = 3;

pub struct Results {
    pub cells: Vec<CellRuns>,
    /// Sessions, failures, what the machine itself took.
    pub ledger: Ledger,
}

impl Results {
    /// The runs of the plan that were not made yet, as time was up: repetitions aside.
    pub fn missing(&self, plan: &Plan) -> usize {
        self.cells.iter().map(|cell| (plan.runs as usize).saturating_sub(cell.planned())).sum()
    }
}

/// The runs of one cell, in the order in which they were made.
#[derive(Clone, Debug)]
pub struct CellRuns {
    pub cell: Cell,
    pub runs: Vec<Run>,
}

impl CellRuns {
    fn planned(&self) -> usize {
        self.runs.iter().filter(|run| !run.repetition).count()
    }

    fn undisturbed(&self) -> usize {
        self.runs.iter().filter(|run| !run.is_disturbed()).count()
    }

    /// Whether another run is due: every run counts at first; then disturbed ones are repeated, a limited number of times.
    fn wants_repetition(&self, plan: &Plan) -> bool {
        let repeated = self.runs.len() - self.planned();
        self.undisturbed() < plan.runs as usize && repeated < plan.repeats as usize
    }
}

/// Measures everything in the plan that `results` does not hold yet, until `limit` is over.
pub fn run(plan: &Plan, results: Option<&Path>, limit: Option<Duration>) -> Result<Results> {
    let interrupted = tautline_harness::interrupted()?;
    if let Err(reason) = &plan.r2r {
        eprintln!("r2r is left out: {reason}");
    }
    let ledger = Ledger::open(results, plan)?;
    let of_before = |cell: &Cell| {
        let name = cell.to_string();
        let runs = ledger.runs.iter().filter(|(of, _)| *of == name).map(|(_, run)| run.clone());
        CellRuns { cell: *cell, runs: runs.collect() }
    };
    let cells = plan.cells.iter().map(of_before).collect();
    let mut results = Results { cells, ledger };
    if results.missing(plan) > 0 || results.cells.iter().any(|cell| cell.wants_repetition(plan)) {
        let measured = measure(plan, &mut results, limit, &interrupted);
        if let (Err(_), Some(path)) = (&measured, results.ledger.path()) {
            let path = path.display();
            eprintln!("what has been measured is in {path}: the same command goes on from there");
        }
        measured?;
    }
    Ok(results)
}

fn measure(
    plan: &Plan,
    results: &mut Results,
    limit: Option<Duration>,
    interrupted: &AtomicBool,
) -> Result<()> {
    let (disturbance, started) = (Disturbance::start(), Instant::now());
    results.ledger.begin(&watch_core(plan)?)?;
    // For both systems alike. Ignored: where it is refused, all wake-ups are slower by the same.
    let _idle = IdleHold::new();

    let bar = start_bar(plan, results);
    let time_is_up = || limit.is_some_and(|limit| started.elapsed() >= limit);
    let measured = all(plan, results, &bar, started, time_is_up, interrupted);
    bar.finish_and_clear();
    // Also of a session that was interrupted.
    results.ledger.add(Entry::End { disturbance: disturbance.report() })?;
    measured
}

/// Round after round, then the repetitions, until time is up.
fn all(
    plan: &Plan,
    results: &mut Results,
    bar: &ProgressBar,
    started: Instant,
    time_is_up: impl Fn() -> bool,
    interrupted: &AtomicBool,
) -> Result<()> {
    let Results { cells, ledger } = results;
    let mut number = 0;
    let mut once = |cell: &mut CellRuns, repetition| -> Result<()> {
        let mut attempts = 0;
        loop {
            (number, attempts) = (number + 1, attempts + 1);
            let namespace = format!("/paper_{}_{number}", std::process::id());
            let error = match process::run(plan, cell.cell, namespace, interrupted) {
                Ok(run) => {
                    let run = Run { repetition, ..run };
                    cell.runs.push(run.clone());
                    let (cell, at_s) = (cell.cell.to_string(), started.elapsed().as_secs_f64());
                    return ledger.add(Entry::Run { cell, at_s, run });
                }
                Err(error) => format!("{}: {error}", cell.cell),
            };
            if attempts == ATTEMPTS || interrupted.load(Ordering::Relaxed) {
                return Err(error.into());
            }
            eprintln!("{error}; once more");
            ledger.add(Entry::Failed(error))?;
        }
    };
    for round in 1..=plan.runs {
        let due: Vec<_> = cells.iter_mut().filter(|cell| cell.planned() < round as usize).collect();
        if due.is_empty() {
            continue;
        }
        for cell in due {
            if time_is_up() {
                return Ok(());
            }
            bar.set_message(format!("run {round} of {}: {}", plan.runs, cell.cell));
            bar.inc(1);
            once(cell, false)?;
        }
        tell(bar, &format!("run {round} of {} is done", plan.runs));
    }
    for repeat in 1..=plan.repeats {
        for cell in cells.iter_mut().filter(|cell| cell.wants_repetition(plan)) {
            if time_is_up() {
                return Ok(());
            }
            let what = format!("repetition {repeat}: {}", cell.cell);
            tell(bar, &what);
            bar.set_message(what);
            bar.inc_length(1);
            bar.inc(1);
            once(cell, true)?;
        }
    }
    Ok(())
}

/// Sees what the machine itself takes from the core, at a priority that no run has.
fn watch_core(plan: &Plan) -> Result<Interruptions> {
    if !plan.realtime {
        return Ok(Interruptions::default());
    }
    let thread = ThreadBuilder::new("noise")
        .policy(Policy::Fifo(priorities::PUBLISHER + 1))
        .cores(CoreSet::one(plan.core))
        .realtime(Realtime::Required)
        .spawn(|| || Interruptions::watch(NOISE_WINDOW))?;
    Ok(thread.join()?)
}

/// A bar on a terminal, else a line for each round: see [`tell`].
fn start_bar(plan: &Plan, results: &Results) -> ProgressBar {
    let all = plan.cells.len() * plan.runs as usize;
    let runs = results.missing(plan);
    let expected = Duration::from_secs_f64(plan.expected_seconds() * runs as f64 / all.max(1) as f64);
    let rest = if runs < all { format!(", the rest of {all}") } else { String::new() };
    eprintln!("{runs} runs on core {}{rest}, about {}", plan.core, HumanDuration(expected));
    let bar = progress_bar(runs as u64);
    bar.enable_steady_tick(Duration::from_secs(1));
    bar
}

fn tell(bar: &ProgressBar, what: &str) {
    if bar.is_hidden() {
        eprintln!("{what}, {} s so far", bar.elapsed().as_secs());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::{Experiment, TAUTLINE};
    use tautline_paper::Variant;

    fn run(steal_ticks: u64, repetition: bool) -> Run {
        Run { steal_ticks, repetition, ..Run::default() }
    }

    #[test]
    fn disturbed_runs_are_repeated_but_not_for_ever() {
        let plan = Plan { repeats: 2, ..crate::report::tests::plan() };
        let cell = Cell { system: TAUTLINE, experiment: Experiment::Paper(Variant::FUTURES_RT) };
        let wants = |runs: &[Run]| CellRuns { cell, runs: runs.to_vec() }.wants_repetition(&plan);
        assert!(!wants(&[run(0, false), run(0, false)]));
        assert!(wants(&[run(0, false), run(1, false)]));
        assert!(!wants(&[run(0, false), run(1, false), run(0, true)]));
        assert!(wants(&[run(1, false), run(1, false), run(1, true)]));
        assert!(!wants(&[run(1, false), run(1, false), run(1, true), run(1, true)]));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! All runs, rivals next to each other, and again those in which the core was taken away.

use std::io::IsTerminal;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressStyle};
use tautline_benches::Disturbance;
use tautline_paper::priorities;
use tautline_rt::{CoreSet, IdleHold, Interruptions, Policy, Realtime, ThreadBuilder};

use crate::Result;
use crate::ledger::Ledger;
use crate::plan::{Cell, Plan};
use crate::process::{self, Run};

/// How long the core is watched before the runs: not so long that the kernel's limit for real-time threads is seen.
const NOISE_WINDOW: Duration = Duration::from_millis(500);

/// How often a run may fail, as when its processes do not find each other, before hours of others are given up.
const ATTEMPTS: u32 = 3;

/// Everything that was measured.
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
    /// Runs that are no repetitions.
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
    let interrupted = tautline_benches::interrupted()?;
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

    let mut progress = Progress::new(plan, results);
    let time_is_up = || limit.is_some_and(|limit| started.elapsed() >= limit);
    let measured = all(plan, results, &mut progress, started, time_is_up, interrupted);
    progress.end();
    // Also of a session that was interrupted.
    results.ledger.end(disturbance.report())?;
    measured
}

/// Round after round, then the repetitions, until time is up.
fn all(
    plan: &Plan,
    results: &mut Results,
    progress: &mut Progress,
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
                    return ledger.keep(cell.cell.to_string(), started.elapsed().as_secs_f64(), run);
                }
                Err(error) => format!("{}: {error}", cell.cell),
            };
            if attempts == ATTEMPTS || interrupted.load(Ordering::Relaxed) {
                return Err(error.into());
            }
            eprintln!("{error}; once more");
            ledger.failed(error)?;
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
            progress.next(&format!("run {round} of {}: {}", plan.runs, cell.cell));
            once(cell, false)?;
        }
        progress.round(&format!("run {round} of {} is done", plan.runs));
    }
    for repeat in 1..=plan.repeats {
        for cell in cells.iter_mut().filter(|cell| cell.wants_repetition(plan)) {
            if time_is_up() {
                return Ok(());
            }
            progress.more(&format!("repetition {repeat}: {}", cell.cell));
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

/// A bar on a terminal, else a line for each round.
struct Progress {
    bar: ProgressBar,
    terminal: bool,
    started: Instant,
}

impl Progress {
    fn new(plan: &Plan, results: &Results) -> Self {
        let all = plan.cells.len() * plan.runs as usize;
        let runs = results.missing(plan);
        let expected = Duration::from_secs_f64(plan.expected_seconds() * runs as f64 / all.max(1) as f64);
        let terminal = std::io::stderr().is_terminal();
        let rest = if runs < all { format!(", the rest of {all}") } else { String::new() };
        eprintln!("{runs} runs on core {}{rest}, about {}", plan.core, HumanDuration(expected));
        let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed}, {eta} left  {msg}");
        let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = ProgressBar::new(runs as u64).with_style(style);
        bar.enable_steady_tick(Duration::from_secs(1));
        Progress { bar, terminal, started: Instant::now() }
    }

    fn next(&self, what: &str) {
        self.bar.set_message(what.to_owned());
        self.bar.inc(1);
    }

    fn more(&mut self, what: &str) {
        self.bar.inc_length(1);
        self.next(what);
        self.round(what);
    }

    fn round(&mut self, what: &str) {
        if !self.terminal {
            eprintln!("{what}, {} s so far", self.started.elapsed().as_secs());
        }
    }

    fn end(&self) {
        self.bar.finish_and_clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::{Experiment, System};
    use tautline_paper::{Measured, Published, Variant};

    fn run(steal_ticks: u64, repetition: bool) -> Run {
        Run { published: Published::default(), measured: Measured::default(), steal_ticks, repetition }
    }

    #[test]
    fn disturbed_runs_are_repeated_but_not_for_ever() {
        let plan = Plan {
            runs: 2,
            seconds: 1.0,
            repeats: 2,
            core: 0,
            realtime: true,
            r2r: Err("a test".into()),
            paper: crate::application::paper().unwrap(),
            capacity: crate::application::capacity().unwrap(),
            cells: Vec::new(),
        };
        let cell = Cell { system: System::Tautline, experiment: Experiment::Paper(Variant::FUTURES_RT) };
        let wants = |runs: &[Run]| CellRuns { cell, runs: runs.to_vec() }.wants_repetition(&plan);
        assert!(!wants(&[run(0, false), run(0, false)]));
        assert!(wants(&[run(0, false), run(1, false)]));
        assert!(!wants(&[run(0, false), run(1, false), run(0, true)]));
        assert!(wants(&[run(1, false), run(1, false), run(1, true)]));
        assert!(!wants(&[run(1, false), run(1, false), run(1, true), run(1, true)]));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! All runs, rivals next to each other, and again those in which the core was taken away.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressStyle};
use signal_hook::consts::{SIGINT, SIGTERM};
use tautline_benches::Disturbance;
use tautline_paper::priorities;
use tautline_rt::{CoreSet, IdleHold, Interruptions, Policy, Realtime, ThreadBuilder};

use crate::Result;
use crate::plan::{Cell, Plan};
use crate::process::{self, Run};

/// How long the core is watched before the runs: not so long that the kernel's limit for real-time threads is seen.
const NOISE_WINDOW: Duration = Duration::from_millis(500);

/// How often a run may fail, as when its processes do not find each other, before hours of others are given up.
const ATTEMPTS: u32 = 3;

/// Everything that was measured.
pub struct Results {
    pub cells: Vec<CellRuns>,
    /// What the machine itself takes from the core.
    pub interruptions: Interruptions,
    pub disturbance: String,
    /// Runs that failed and were made again, and why they failed.
    pub failed: Vec<String>,
    pub took: Duration,
}

/// The runs of one cell, in the order in which they were made.
#[derive(Clone, Debug)]
pub struct CellRuns {
    pub cell: Cell,
    pub runs: Vec<Run>,
}

impl CellRuns {
    fn undisturbed(&self) -> usize {
        self.runs.iter().filter(|run| !run.is_disturbed()).count()
    }

    /// Whether another run is due: every run counts at first; then disturbed ones are repeated, a limited number of times.
    fn wants_repetition(&self, plan: &Plan) -> bool {
        let repeated = self.runs.iter().filter(|run| run.repetition).count();
        self.undisturbed() < plan.runs as usize && repeated < plan.repeats as usize
    }
}

/// Measures everything in the plan.
pub fn run(plan: &Plan) -> Result<Results> {
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // The second one ends at once.
        signal_hook::flag::register_conditional_default(signal, Arc::clone(&interrupted))?;
        signal_hook::flag::register(signal, Arc::clone(&interrupted))?;
    }
    if let Err(reason) = &plan.r2r {
        eprintln!("r2r is left out: {reason}");
    }
    let (disturbance, started) = (Disturbance::start(), Instant::now());
    let interruptions = watch_core(plan)?;
    // For both systems alike. Ignored: where it is refused, all wake-ups are slower by the same.
    let _idle = IdleHold::new();

    let mut progress = Progress::new(plan);
    let mut cells: Vec<_> =
        plan.cells.iter().map(|cell| CellRuns { cell: *cell, runs: Vec::new() }).collect();
    let (mut number, mut failed) = (0, Vec::new());
    let mut once = |cell: &mut CellRuns, repetition| -> Result<()> {
        let mut attempts = 0;
        loop {
            (number, attempts) = (number + 1, attempts + 1);
            let namespace = format!("/paper_{}_{number}", std::process::id());
            let error = match process::run(plan, cell.cell, namespace, &interrupted) {
                Ok(run) => {
                    cell.runs.push(Run { repetition, ..run });
                    return Ok(());
                }
                Err(error) => format!("{}: {error}", cell.cell),
            };
            if attempts == ATTEMPTS || interrupted.load(Ordering::Relaxed) {
                return Err(error.into());
            }
            eprintln!("{error}; once more");
            failed.push(error);
        }
    };
    for round in 1..=plan.runs {
        for cell in &mut cells {
            progress.next(&format!("run {round} of {}: {}", plan.runs, cell.cell));
            once(cell, false)?;
        }
        progress.round(&format!("run {round} of {} is done", plan.runs));
    }
    for repeat in 1..=plan.repeats {
        for cell in cells.iter_mut().filter(|cell| cell.wants_repetition(plan)) {
            progress.more(&format!("repetition {repeat}: {}", cell.cell));
            once(cell, true)?;
        }
    }
    progress.end();
    let (disturbance, took) = (disturbance.report(), started.elapsed());
    Ok(Results { cells, interruptions, disturbance, failed, took })
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
    fn new(plan: &Plan) -> Self {
        let expected = Duration::from_secs_f64(plan.expected_seconds());
        let runs = plan.cells.len() as u64 * u64::from(plan.runs);
        let terminal = std::io::stderr().is_terminal();
        eprintln!("{runs} runs on core {}, about {}", plan.core, HumanDuration(expected));
        let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed}, {eta} left  {msg}");
        let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = ProgressBar::new(runs).with_style(style);
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rounds to and fro over all cases, and what they found.

use std::collections::BTreeSet;
use std::fs;
use std::sync::atomic::{AtomicBool, Ordering};

use indicatif::{ProgressBar, ProgressStyle};
use tautline_benches::{Distribution, Scratch};
use tautline_rt::IdleHold;
use tautline_rt::host::steal_ticks;

use crate::Result;
use crate::pair::{Found, Setup};
use crate::plan::{Case, Idle, Plan, Task};

/// A case and what was found.
pub struct Cell {
    pub case: Case,
    pub times: Distribution,
    pub lost: u64,
    pub cpu_ns: u64,
    pub messages: u64,
    pub seconds: f64,
    /// The most of a round.
    pub memory_kib: u64,
    pub switches: Option<f64>,
    /// Of each round.
    pub p50_us: Vec<f64>,
    pub steal_ticks: u64,
    /// Why idle states were as shipped where they should not have been.
    pub idle_refused: Option<String>,
    /// Of the last round that failed.
    pub failure: Option<String>,
}

impl Cell {
    fn new(case: Case) -> Self {
        Cell {
            case,
            times: Distribution::new(),
            lost: 0,
            cpu_ns: 0,
            messages: 0,
            seconds: 0.0,
            memory_kib: 0,
            switches: None,
            p50_us: Vec::new(),
            steal_ticks: 0,
            idle_refused: None,
            failure: None,
        }
    }

    fn add(&mut self, found: &Found) {
        let mut round = Distribution::new();
        found.times_ns.iter().for_each(|&time_ns| round.record(time_ns));
        self.p50_us.push(round.quantile_us(0.5));
        found.times_ns.iter().for_each(|&time_ns| self.times.record(time_ns));
        self.lost += found.lost;
        self.cpu_ns += found.cpu_ns;
        self.messages += found.messages;
        self.seconds += found.seconds;
        self.memory_kib = self.memory_kib.max(found.memory_kib);
        self.switches = found.switches.or(self.switches);
    }
}

/// Measures all cases. One that fails does not end the run: it says so in its row.
pub fn run(plan: &Plan, interrupted: &AtomicBool) -> Result<Vec<Cell>> {
    let scratch = Scratch::new("compare")?;
    let setup = Setup { plan, scratch: &scratch, interrupted };
    let mut cells: Vec<Cell> = plan.cases.iter().map(|&case| Cell::new(case)).collect();
    let mut order: Vec<usize> = (0..cells.len()).collect();
    let progress = progress_bar(plan.runs());
    for round in 1..=plan.rounds {
        // To and fro, so that a drift of the machine meets all rivals.
        order.reverse();
        for &index in &order {
            let cell = &mut cells[index];
            if round > cell.case.rounds {
                continue;
            }
            progress.set_message(format!("round {round}: {}", cell.case.name()));
            measure(&setup, cell, &format!("/compare/run_{}/case_{round}_{index}", std::process::id()));
            if interrupted.load(Ordering::Relaxed) {
                return Err("interrupted".into());
            }
            if let Some(failure) = &cell.failure {
                progress.suspend(|| eprintln!("{}: {failure}", cell.case.name()));
            }
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    Ok(cells)
}

fn measure(setup: &Setup<'_>, cell: &mut Cell, topic: &str) {
    // Taken and released for each: rivals run side by side, and no other round is affected.
    let hold = match cell.case.idle {
        Idle::AsShipped => None,
        Idle::HeldOff => match IdleHold::new() {
            Ok(hold) => Some(hold),
            Err(error) => {
                cell.idle_refused = Some(error.to_string());
                None
            }
        },
    };
    let before = segments();
    let steal = steal_ticks(None);
    let found = match cell.case.task {
        Task::RoundTrips { .. } => setup.round_trips(&cell.case, topic),
        Task::Paced { .. } | Task::Stream => setup.flow(&cell.case, topic),
        Task::Start { .. } => setup.start_up(&cell.case, topic),
    };
    drop(hold);
    cell.steal_ticks += steal_ticks(None).saturating_sub(steal);
    match found {
        Ok(found) => {
            cell.failure = None;
            cell.add(&found);
        }
        Err(error) => cell.failure = Some(error.to_string()),
    }
    sweep(&before);
}

/// Removes what killed peers of Fast DDS and Cyclone DDS left since `before`, unless somebody has it mapped.
fn sweep(before: &BTreeSet<String>) {
    let left: Vec<String> = segments().difference(before).cloned().collect();
    if left.is_empty() {
        return;
    }
    let mut mapped = String::new();
    for process in fs::read_dir("/proc").into_iter().flatten().flatten() {
        mapped += &fs::read_to_string(process.path().join("maps")).unwrap_or_default();
    }
    for name in left.iter().filter(|name| !mapped.contains(name.as_str())) {
        // With its lock and its semaphore. Ignored: somebody else's, or there is none.
        for file in [name.clone(), format!("{name}_el"), format!("sem.{name}_mutex")] {
            let _ = fs::remove_file(format!("/dev/shm/{file}"));
        }
    }
}

/// Fast DDS's files in shared memory, its locks apart: they are mapped by nobody.
fn segments() -> BTreeSet<String> {
    let names = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    let names = names.filter_map(|entry| entry.file_name().into_string().ok());
    let is_segment = |name: &String| {
        (name.starts_with("fastrtps_") || name.starts_with("fast_datasharing_")) && !name.ends_with("_el")
    };
    names.filter(is_segment).collect()
}

fn progress_bar(steps: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} of about {duration}  {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(steps).with_style(style)
}

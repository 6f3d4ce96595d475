// SPDX-License-Identifier: MIT OR Apache-2.0
//! Rounds to and fro over all cases, and what they found.

use std::collections::BTreeSet;
use std::fs;
use std::sync::atomic::Ordering;

use tautline_harness::rows::{Tally, rounded};
use tautline_harness::{Distribution, progress_bar};
use tautline_rt::IdleHold;
use tautline_rt::host::steal_ticks;

use crate::Result;
use crate::modes::Part;
use crate::pair::{Found, Setup};
use crate::plan::{Case, Idle, Task};

/// A case and what was found.
pub struct Cell {
    pub case: Case,
    /// Of the rounds that did not fail.
    pub tally: Tally,
    /// Of them all but their times and losses, added up; of memory the most of a round.
    pub total: Found,
    pub steal_ticks: u64,
    /// Why idle states were as shipped where they should not have been.
    pub idle_refused: Option<String>,
    /// Of each round that failed.
    pub failures: Vec<String>,
}

impl Cell {
    fn new(case: Case) -> Self {
        Cell {
            case,
            tally: Tally::default(),
            total: Found::default(),
            steal_ticks: 0,
            idle_refused: None,
            failures: Vec::new(),
        }
    }

    fn add(&mut self, round: u32, found: &Found) {
        let (of, mut times) = (&found.of, Distribution::new());
        of.times_ns.iter().for_each(|&time_ns| times.record(time_ns));
        let of_round = self.tally.add(round, &times);
        of_round.cpu_us_per_msg = found.cpu_us_per_msg();
        of_round.msgs_per_s = (of.seconds > 0.0).then(|| rounded(found.per_second(of.messages)));
        of_round.rss_mib = found.rss_mib();
        self.tally.lost += of.lost;
        let total = &mut self.total.of;
        total.cpu_ns += of.cpu_ns;
        total.messages += of.messages;
        total.seconds += of.seconds;
        if of.memory.kib > total.memory.kib {
            total.memory = of.memory;
        }
        total.late += of.late;
        total.refused += of.refused;
        self.total.wakes = found.wakes.or(self.total.wakes);
        self.total.throttled = self.total.throttled.max(found.throttled);
    }
}

/// Measures all cases. One that fails does not end the run: it says so in its row.
pub fn run(setup: &Setup<'_>) -> Result<Vec<Cell>> {
    let Setup { plan, interrupted, .. } = *setup;
    let mut cells: Vec<Cell> = plan.cases.iter().cloned().map(Cell::new).collect();
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
            let failures = cell.failures.len();
            measure(setup, cell, round, &format!("/compare/run_{}/case_{round}_{index}", std::process::id()));
            if interrupted.load(Ordering::Relaxed) {
                return Err("interrupted".into());
            }
            if let Some(failure) = cell.failures.get(failures) {
                progress.suspend(|| eprintln!("{}: {failure}", cell.case.name()));
            }
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    Ok(cells)
}

fn measure(setup: &Setup<'_>, cell: &mut Cell, round: u32, topic: &str) {
    // Taken and released for each: rivals run side by side, and no other round is affected.
    let hold = match (cell.case.idle, cell.case.mode.part) {
        (Idle::AsShipped, Part::AsShipped) => {
            // It holds them off by itself, if it can: only a warning says that it could not.
            cell.idle_refused = match setup.plan.realtime {
                true => IdleHold::new().err().map(|error| error.to_string()),
                false => Some("only real-time mode does so".to_owned()),
            };
            None
        }
        (Idle::AsShipped, _) => None,
        (Idle::HeldOff, _) => {
            IdleHold::new().map_err(|error| cell.idle_refused = Some(error.to_string())).ok()
        }
    };
    let before = segments();
    let steal = steal_ticks(None);
    let found = setup.around(&cell.case).and_then(|mut around| {
        let found = match cell.case.task {
            Task::RoundTrips { .. } | Task::Requests => setup.round_trips(&cell.case, topic),
            Task::Window => setup.window(&cell.case, topic),
            Task::Paced { .. } | Task::Stream { .. } => setup.flow(&cell.case, topic),
            Task::Start { .. } => setup.start_up(&cell.case, topic),
        };
        around.still_runs()?;
        Ok(Found { throttled: around.throttled(), ..found? })
    });
    drop(hold);
    cell.steal_ticks += steal_ticks(None).saturating_sub(steal);
    match found {
        Ok(found) => cell.add(round, &found),
        Err(error) => cell.failures.push(error.to_string()),
    }
    sweep(&before);
}

/// Removes what peers of Fast DDS and Zenoh left since `before`, unless somebody has it mapped.
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

/// Fast DDS's and Zenoh's files in shared memory, locks apart: they are mapped by nobody.
fn segments() -> BTreeSet<String> {
    let names = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
    let names = names.filter_map(|entry| entry.file_name().into_string().ok());
    let is_segment = |name: &String| {
        let is_fastdds = name.starts_with("fastrtps_") || name.starts_with("fast_datasharing_");
        is_fastdds && !name.ends_with("_el") || name.ends_with(".zenoh")
    };
    names.filter(is_segment).collect()
}

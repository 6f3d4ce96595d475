// SPDX-License-Identifier: MIT OR Apache-2.0
//! The parent: starts the pairs in alternating rounds and merges what they measured.

use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use tautline_benches::pair::{self, Measured};
use tautline_benches::rows::{Row, Tally};
use tautline_benches::{Disturbance, Scratch, interrupted, progress_bar};
use tautline_rt::IdleHold;

use crate::plan::{Idle, Job, Mode, Payload, Plan, Role};
use crate::report::Rows;
use crate::{Result, futex};

/// How long a process may take to set itself up.
const PATIENCE: Duration = Duration::from_secs(10);

/// Measures everything in the plan.
pub fn run(plan: &Plan) -> Result<Rows> {
    let scratch = Scratch::new("wake")?;
    let interrupted = interrupted()?;
    let mut parent = Parent { plan, scratch: &scratch, interrupted: &interrupted, pair: 0 };

    let mut cells = cells(plan);
    let disturbance = Disturbance::start();
    let mut idle_refused = None;
    let progress = progress_bar(plan.runs().into());
    for round in 1..=plan.rounds {
        // To and fro, so that a drift of the machine meets all rivals.
        cells.reverse();
        for cell in &mut cells {
            let (system, mode) = cell.mode.names();
            progress.set_message(format!("round {round}: {system} {mode}, {} B", cell.payload.bytes));
            // Taken and released for each pair: rivals run side by side, and no other round is affected.
            let hold = match cell.idle {
                Idle::Default => None,
                Idle::Poll => match IdleHold::new() {
                    Ok(hold) => Some(hold),
                    Err(error) => {
                        idle_refused = Some(error.to_string());
                        progress.inc(1);
                        continue;
                    }
                },
            };
            let measured = parent.measure(cell.mode, cell.payload).map_err(|error| {
                format!("{system} {mode}, {} B, round {round}: {error}", cell.payload.bytes)
            })?;
            drop(hold);
            cell.tally.add_measured(round, &measured);
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    cells.sort_by_key(|cell| cell.position);
    let rows = cells.iter().filter(|cell| !cell.tally.times.is_empty()).map(Cell::row).collect();
    Ok(Rows { rows, disturbance: disturbance.report(), idle_refused })
}

/// A line of the result in the making.
struct Cell {
    /// Its place in the report.
    position: usize,
    mode: Mode,
    payload: Payload,
    idle: Idle,
    tally: Tally,
}

/// All cells, rivals next to each other.
fn cells(plan: &Plan) -> Vec<Cell> {
    let mut cells = Vec::new();
    for idle in Idle::ALL {
        for &payload in &plan.payloads {
            for &mode in &plan.modes {
                let (position, tally) = (cells.len(), Tally::default());
                cells.push(Cell { position, mode, payload, idle, tally });
            }
        }
    }
    cells
}

impl Cell {
    fn row(&self) -> Row {
        let (system, mode) = self.mode.names();
        self.tally.row(self.idle.experiment(self.payload.touched), system, mode, self.payload.bytes)
    }
}

struct Parent<'a> {
    plan: &'a Plan,
    scratch: &'a Scratch,
    interrupted: &'a AtomicBool,
    pair: u32,
}

impl Parent<'_> {
    /// Runs one pair of processes to its end.
    fn measure(&mut self, mode: Mode, payload: Payload) -> Result<Measured> {
        self.pair += 1;
        let [sender, receiver] = self.plan.cores;
        let budget = self.plan.budget();
        let job = Job {
            role: Role::Pong,
            mode,
            payload,
            budget,
            cores: if mode.is_one_core() { [receiver; 2] } else { [sender, receiver] },
            realtime: self.plan.realtime,
            pair: self.pair,
            prefix: self.scratch.prefix().to_owned(),
            directory: self.scratch.directory().to_owned(),
        };
        futex::make_memory(&job)?;
        let command = |job: &Job| -> Result<Command> {
            let mut command = Command::new(std::env::current_exe()?);
            command.arg("--child").arg(serde_json::to_string(job)?);
            Ok(command)
        };
        let pair = [command(&job)?, command(&Job { role: Role::Ping, ..job })?];
        let (measured, mut ends) = pair::measure(pair, PATIENCE + 2 * budget, self.interrupted)?;
        ends.iter_mut().try_for_each(|end| end.finish())?;
        Ok(measured)
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Starts the pairs in alternating rounds and merges what they measured.

use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use tautline_benches::rows::{Row, Tally, median, rounded};
use tautline_benches::{Distribution, Gateways, Host, Process, progress_bar};
use tautline_exchange::{Exchange, Job, Line, Measured, Role, Way};

use crate::Result;
use crate::plan::{Case, Plan, System};

/// The near and the far host's. Nobody else measures there, and no test runs there.
pub const DOMAINS: [u32; 2] = [117, 118];
/// In which their gateways meet.
const NETWORK_DOMAIN: u32 = 119;
/// hiroz's, where both of its ends are.
const HIROZ_DOMAIN: u32 = 116;
/// How long a process may take to set itself up.
const PATIENCE: Duration = Duration::from_secs(30);

/// Measures all cases.
pub fn run(plan: &Plan, interrupted: &AtomicBool) -> Result<Vec<Row>> {
    let mut cells: Vec<Cell> = plan.cases.iter().map(|&case| Cell::new(case)).collect();
    let progress = progress_bar(plan.runs());
    let mut order: Vec<usize> = (0..cells.len()).collect();
    for round in 1..=plan.rounds {
        // To and fro, so that a drift of the machine meets all rivals.
        order.reverse();
        for &index in &order {
            let cell = &mut cells[index];
            let case = cell.case;
            let name = format!("{:?} {}, {} B", case.system, case.mode(), case.payload_bytes);
            progress.set_message(format!("round {round}: {name}"));
            let topic = format!("/bench/run_{}/pair_{round}_{index}", std::process::id());
            // Started for each: nobody else's idle threads disturb a rival.
            let mut gateways = match case.system {
                System::Tautline => Some(gateways(plan, plan.cores, [plan.realtime; 2], interrupted)?),
                _ => None,
            };
            let measured = pair(plan, case, topic, interrupted)
                .map_err(|error| format!("{name}, round {round}: {error}"))?;
            cell.add(round, &measured);
            if let Some(gateways) = &mut gateways {
                let throttled = [0, 1].map(|host| gateways.stats(host)["throttled"].as_u64().unwrap_or(0));
                cell.throttled = cell.throttled.max(throttled.into_iter().max());
            }
            progress.inc(1);
        }
    }
    progress.finish_and_clear();
    Ok(cells.iter().map(Cell::row).collect())
}

/// The two hosts' gateways, on their cores.
pub fn gateways<'a>(
    plan: &Plan,
    cores: [Option<usize>; 2],
    realtime: [bool; 2],
    interrupted: &'a AtomicBool,
) -> Result<Gateways<'a>> {
    let host = |at: usize| Host { domain: DOMAINS[at], core: cores[at], realtime: realtime[at] };
    Gateways::start(&plan.gateway, [host(0), host(1)], NETWORK_DOMAIN, interrupted)
}

/// Runs one pair of processes to its end.
fn pair(plan: &Plan, case: Case, topic: String, interrupted: &AtomicBool) -> Result<Measured> {
    let job = |role| Job {
        role,
        exchange: case.exchange,
        payload_bytes: case.payload_bytes,
        budget: plan.budget,
        core: plan.cores[usize::from(role == Role::Far)],
        realtime: case.realtime,
        domain: match case.system {
            System::Tautline => DOMAINS[usize::from(role == Role::Far)],
            _ => HIROZ_DOMAIN,
        },
        topic: topic.clone(),
        endpoint: None,
        way: Way::default(),
    };
    let mut far = start(plan, case.system, &job(Role::Far), interrupted)?;
    let endpoint = far.expect(PATIENCE, Line::ready)?;
    let mut near = start(plan, case.system, &Job { endpoint, ..job(Role::Near) }, interrupted)?;
    let patience = PATIENCE + plan.budget * 3;
    let measured = match case.exchange {
        Exchange::RoundTrips => near.expect(patience, Line::measured)?,
        _ => far.expect(patience, Line::measured)?,
    };
    near.finish()?;
    far.finish()?;
    if measured.times_ns.is_empty() { Err("nothing arrived".into()) } else { Ok(measured) }
}

/// One end of an exchange.
pub fn start<'a>(
    plan: &Plan,
    system: System,
    job: &Job,
    interrupted: &'a AtomicBool,
) -> Result<Process<'a, Line>> {
    let text = serde_json::to_string(job)?;
    let mut command = match system {
        System::Hiroz => Command::new(plan.hiroz.clone()?),
        _ => Command::new(std::env::current_exe()?),
    };
    match system {
        System::Tautline => command.args(["--child", "tautline", &text]),
        System::Zenoh => command.args(["--child", "zenoh", &text]),
        System::Hiroz => command.arg(&text),
    };
    Process::start(&mut command, format!("{:?} end", job.role), interrupted)
}

/// A line of the result in the making.
struct Cell {
    case: Case,
    tally: Tally,
    throttled: Option<u64>,
}

impl Cell {
    fn new(case: Case) -> Self {
        Cell { case, tally: Tally::default(), throttled: None }
    }

    fn add(&mut self, round: u32, measured: &Measured) {
        let mut times = Distribution::new();
        measured.times_ns.iter().for_each(|&time_ns| times.record(time_ns));
        let msgs_per_s = measured.times_ns.len() as f64 / measured.seconds.max(1e-9);
        self.tally.add(round, &times).msgs_per_s = Some(rounded(msgs_per_s));
        self.tally.lost += measured.lost;
    }

    fn row(&self) -> Row {
        let Case { experiment, system, payload_bytes, exchange, .. } = self.case;
        let row = self.tally.row(experiment.names()[0], system.name(), self.case.mode(), payload_bytes);
        let rates = row.rounds.iter().filter_map(|round| row.mb_per_s(round));
        let mb_per_s = median(rates.collect()).filter(|_| exchange != Exchange::RoundTrips).map(rounded);
        Row { throttled: self.throttled, mb_per_s, ..row }
    }
}

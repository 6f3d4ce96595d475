// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tables and the JSON.

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{Cell as TableCell, CellAlignment, Table};
use serde::{Deserialize, Serialize};
use tautline_benches::{Distribution, machine, version_of};
use tautline_exchange::APPLICATION_PRIORITY;

use crate::Result;
use crate::load::LOAD;
use crate::modes::NOT_JOINED;
use crate::plan::{Experiment, Plan, Task};
use crate::rounds::Cell;
use crate::verdict::{Verdict, verdicts};

/// A line of the result. Times are `None` where nothing was measured; the note says why.
#[derive(Debug, Serialize, Deserialize)]
pub struct Row {
    pub experiment: String,
    pub system: String,
    pub mode: String,
    pub payload_bytes: usize,
    pub n: u64,
    pub p50_us: Option<f64>,
    pub p99_us: Option<f64>,
    pub p999_us: Option<f64>,
    pub max_us: Option<f64>,
    pub lost: u64,
    /// Of the sending and the receiving together.
    pub cpu_us_per_msg: Option<f64>,
    /// Of all processes; what they share counts once.
    pub rss_mib: Option<f64>,
    pub note: String,
    #[serde(skip)]
    pub details: Option<Details>,
}

/// What the page shows beside.
#[derive(Debug)]
pub struct Details {
    pub times: Distribution,
    /// Least and most of the rounds.
    pub p50_us: (f64, f64),
    pub messages_per_s: f64,
    /// CPU time of all processes per second.
    pub cpu_share: f64,
    pub steal_ticks: u64,
    pub switches: Option<f64>,
}

/// The result of a run.
pub struct Report {
    pub rows: Vec<Row>,
    pub verdicts: Vec<Verdict>,
    /// Machine, versions, conditions: a line each.
    pub machine: Vec<String>,
    pub is_realtime: bool,
    failures: Vec<String>,
}

impl Report {
    pub fn new(plan: &Plan, cells: Vec<Cell>, disturbance: String) -> Self {
        let failed = |cell: &Cell| {
            let failure = cell.failure.as_ref().filter(|_| cell.case.mode.system == "tautline")?;
            Some(format!("{}: {failure}", cell.case.name()))
        };
        let failures = cells.iter().filter_map(failed).collect();
        let mut rows: Vec<Row> = cells.into_iter().map(row).collect();
        for (mode, reason) in &plan.missing {
            rows.push(missing(mode.system, mode.mode, reason));
        }
        for (system, mode, reason) in NOT_JOINED.iter().filter(|(system, ..)| plan.is_wanted(system)) {
            rows.push(missing(system, mode, reason));
        }
        let verdicts = verdicts(&rows);
        let machine = notes(plan, disturbance);
        Report { rows, verdicts, machine, is_realtime: plan.realtime, failures }
    }

    /// Of an earlier run.
    pub fn of_rows(rows: Vec<Row>) -> Self {
        let verdicts = verdicts(&rows);
        Report { rows, verdicts, machine: Vec::new(), is_realtime: true, failures: Vec::new() }
    }

    /// Prints the machine, a table per experiment and what must hold.
    pub fn print(&self) {
        self.machine.iter().for_each(|line| println!("{line}"));
        if !self.is_realtime {
            println!("\n*** measured without real-time priorities: these are not the numbers to compare ***");
        }
        for (title, rows) in self.tables() {
            println!("\n{title}\n{}", table(&rows));
        }
        println!();
        self.verdicts.iter().for_each(|verdict| println!("{verdict}"));
    }

    /// The rows of each experiment, under its title.
    pub fn tables(&self) -> Vec<(&'static str, Vec<&Row>)> {
        let of = |prefix: &str| self.rows.iter().filter(|row| row.experiment.starts_with(prefix)).collect();
        let tables: [(&str, Vec<&Row>); 7] = [
            ("Half round trips", of("latency/")),
            ("One way, 1 kHz, quiet and under load", of("open-loop/")),
            ("Fan-out: to the last subscription", of("fan-out/")),
            ("A robot's worth: 20 topics at 100 Hz", of("robot/")),
            ("Throughput: times between arrivals", of("throughput")),
            ("Start-up and discovery", of("start-up/")),
            ("Not measured", of("-")),
        ];
        tables.into_iter().filter(|(_, rows)| !rows.is_empty()).collect()
    }

    pub fn json(&self) -> Result<String> {
        Ok(serde_json::to_string_pretty(&self.rows)? + "\n")
    }

    /// What Tautline could not do: nothing that a rival's row may hide.
    pub fn failure_of_our_own(&self) -> Option<String> {
        (!self.failures.is_empty()).then(|| self.failures.join("\n"))
    }
}

fn missing(system: &str, mode: &str, reason: &str) -> Row {
    Row {
        experiment: "-".to_owned(),
        system: system.to_owned(),
        mode: mode.to_owned(),
        payload_bytes: 0,
        n: 0,
        p50_us: None,
        p99_us: None,
        p999_us: None,
        max_us: None,
        lost: 0,
        cpu_us_per_msg: None,
        rss_mib: None,
        note: format!("not measured: {reason}"),
        details: None,
    }
}

fn row(cell: Cell) -> Row {
    let Cell { case, times, .. } = &cell;
    let is_there = !times.is_empty();
    let time = |quantile| is_there.then(|| round(times.quantile_us(quantile)));
    let per_message = |ns: u64| round(ns as f64 / 1e3 / cell.messages.max(1) as f64);
    let is_start = matches!(case.task, Task::Start { .. });
    Row {
        experiment: case.experiment(),
        system: case.mode.system.to_owned(),
        mode: case.mode.mode.to_owned(),
        payload_bytes: case.payload_bytes,
        n: times.len(),
        p50_us: time(0.5),
        p99_us: time(0.99),
        p999_us: time(0.999),
        max_us: is_there.then(|| round(times.max_us())),
        lost: cell.lost,
        cpu_us_per_msg: (is_there && !is_start && cell.cpu_ns > 0).then(|| per_message(cell.cpu_ns)),
        rss_mib: (is_there && cell.memory_kib > 0).then(|| round(cell.memory_kib as f64 / 1024.0)),
        note: note(&cell),
        details: is_there.then(|| details(&cell)),
    }
}

fn details(cell: &Cell) -> Details {
    let least = cell.p50_us.iter().copied().fold(f64::INFINITY, f64::min);
    let most = cell.p50_us.iter().copied().fold(0.0, f64::max);
    Details {
        times: cell.times.clone(),
        p50_us: (least, most),
        messages_per_s: cell.messages as f64 / cell.seconds.max(1e-9),
        cpu_share: cell.cpu_ns as f64 / 1e9 / cell.seconds.max(1e-9),
        steal_ticks: cell.steal_ticks,
        switches: cell.switches,
    }
}

fn note(cell: &Cell) -> String {
    let mut words = Vec::new();
    if let Some(failure) = &cell.failure {
        let first = failure.lines().next().unwrap_or_default();
        words.push(format!("FAILED: {first}"));
    }
    if let Some(error) = &cell.idle_refused {
        words.push(format!("IDLE STATES WERE NOT HELD OFF: {error}"));
    }
    if cell.times.is_empty() {
        return words.join("; ");
    }
    let rate = cell.messages as f64 / cell.seconds.max(1e-9);
    match cell.case.task {
        Task::Stream => {
            let gb_per_s = rate * cell.case.payload_bytes as f64 / 1e9;
            let loss = if cell.lost == 0 { "the sender is held back" } else { "the sender is not held back" };
            words.push(format!("{rate:.0} messages/s, {gb_per_s:.3} GB/s, {loss}"));
        }
        Task::Paced { .. } if cell.case.experiment == Experiment::Robot => {
            let percent = cell.cpu_ns as f64 / 1e7 / cell.seconds.max(1e-9);
            words.push(format!("{percent:.1} % of a core for all processes"));
        }
        _ => {}
    }
    let is_ours = cell.case.experiment == Experiment::FanOut && cell.case.mode.system == "tautline";
    if let Some(switches) = cell.switches.filter(|_| is_ours) {
        words.push(format!("the receiver's sampler woke {switches:.2} times per message"));
    }
    if cell.p50_us.len() > 1 {
        let rounds: Vec<_> = cell.p50_us.iter().map(|p50| format!("{p50:.1}")).collect();
        words.push(format!("p50 of the rounds {}", rounds.join(", ")));
    }
    words.push(format!("steal {} ticks", cell.steal_ticks));
    words.join("; ")
}

/// Three digits after the point are enough.
fn round(number: f64) -> f64 {
    (number * 1e3).round() / 1e3
}

fn notes(plan: &Plan, disturbance: String) -> Vec<String> {
    let version = |package| version_of(package).unwrap_or("?");
    let priorities = if plan.realtime {
        format!("SCHED_FIFO {APPLICATION_PRIORITY} for every thread that sends or receives")
    } else {
        "NO REAL-TIME PRIORITY".to_owned()
    };
    let [near, far] = plan.cores;
    let mut versions =
        vec![format!("tautline {}", version("tautline")), format!("iceoryx2 {}", version("iceoryx2"))];
    versions.extend(["fastdds", "cyclonedds"].into_iter().filter_map(|name| plan.programs.version(name)));
    vec![
        machine(),
        disturbance,
        versions.join(", "),
        format!(
            "sender on core {near}, receivers on core {far}; {priorities}; {} rounds to and fro",
            plan.rounds
        ),
        format!("load: {LOAD}"),
    ]
}

fn table(rows: &[&Row]) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED);
    table.set_header([
        "experiment",
        "payload",
        "system",
        "n",
        "p50",
        "p99",
        "p99.9",
        "max µs",
        "lost",
        "CPU µs",
        "MiB",
        "note",
    ]);
    for row in rows {
        let number = |value: Option<f64>| value.map_or("-".to_owned(), short);
        let numbers = [
            row.n.to_string(),
            number(row.p50_us),
            number(row.p99_us),
            number(row.p999_us),
            number(row.max_us),
            row.lost.to_string(),
            number(row.cpu_us_per_msg),
            number(row.rss_mib),
        ];
        let words =
            [row.experiment.clone(), payload(row.payload_bytes), format!("{} {}", row.system, row.mode)];
        let cells = words.into_iter().map(TableCell::new);
        let numbers =
            numbers.into_iter().map(|text| TableCell::new(text).set_alignment(CellAlignment::Right));
        table.add_row(cells.chain(numbers).chain([TableCell::new(&row.note)]));
    }
    table
}

/// Three digits.
pub fn short(number: f64) -> String {
    match number {
        number if number < 10.0 => format!("{number:.2}"),
        number if number < 100.0 => format!("{number:.1}"),
        number => format!("{number:.0}"),
    }
}

/// With its unit.
pub fn payload(bytes: usize) -> String {
    match bytes {
        0 => "-".to_owned(),
        bytes if bytes >= 1 << 20 => format!("{} MiB", bytes >> 20),
        bytes if bytes >= 1 << 10 => format!("{} KiB", bytes >> 10),
        bytes => format!("{bytes} B"),
    }
}

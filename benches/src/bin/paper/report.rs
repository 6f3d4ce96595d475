// SPDX-License-Identifier: MIT OR Apache-2.0
//! What was found: the data of all outputs, the table for the terminal, the JSON.

use tautline_harness::table::Column::{Number, Words};
use tautline_harness::table::{Cell, Table, distinct, figure, markdown};
use tautline_harness::verdict::Verdict;
use tautline_harness::{cells, machine, version_of};
use tautline_paper::{Topic, Variant};

use crate::Result;
use crate::plan::{Experiment, Plan, R2R, TAUTLINE};
use crate::predict;
use crate::rounds::{CellRuns, Results};
use crate::stats::{self, Row, counted, p99_ms};
use crate::verdict::verdicts;

pub struct Report {
    pub rows: Vec<Row>,
    pub verdicts: Vec<Verdict>,
    pub notes: Notes,
    /// Runs in which the core was not ours, the replaced ones and those that count nevertheless.
    pub disturbed: Vec<Disturbed>,
}

pub struct Notes {
    pub method: Vec<String>,
    pub machine: Vec<String>,
}

pub struct Disturbed {
    pub cell: String,
    pub run: usize,
    pub steal_ticks: u64,
    pub missed_releases: u64,
    /// Whether a repetition stands in for it.
    pub replaced: bool,
    pub p99_ms: Vec<f64>,
}

impl Report {
    pub fn new(plan: &Plan, results: &Results) -> Result<Report> {
        let mut rows: Vec<_> = measured(results).flat_map(|cell| stats::rows(plan, cell)).collect();
        let mut overheads = Vec::new();
        for system in [TAUTLINE, R2R] {
            let runs = measured(results).find(|cell| {
                cell.cell.system == system && cell.cell.experiment == Experiment::Paper(Variant::FUTURES_RT)
            });
            let Some(runs) = runs else { continue };
            let overhead_ns = stats::overhead_ns(&counted(&runs.runs, plan.runs as usize));
            overheads.push((system, overhead_ns));
            let bounds =
                predict::response_times_ns(&plan.paper.topics, overhead_ns, &results.ledger.interruptions());
            for row in rows.iter_mut().filter(|row| row.cell == runs.cell) {
                row.rta_overhead_ms = bounds[row.index].map(stats::ms);
            }
        }
        let verdicts = verdicts(&rows, plan.capacity.computed());
        let notes = Notes { method: method(plan), machine: circumstances(plan, results, &overheads)? };
        let disturbed = results.cells.iter().flat_map(|cell| disturbed(plan, cell)).collect();
        Ok(Report { rows, verdicts, notes, disturbed })
    }
}

fn measured(results: &Results) -> impl Iterator<Item = &CellRuns> {
    results.cells.iter().filter(|cell| !cell.runs.is_empty())
}

fn disturbed(plan: &Plan, cell: &CellRuns) -> Vec<Disturbed> {
    let counted = counted(&cell.runs, plan.runs as usize);
    let runs = cell.runs.iter().enumerate().filter(|(_, run)| run.is_disturbed());
    runs.map(|(index, run)| Disturbed {
        cell: cell.cell.to_string(),
        run: index + 1,
        steal_ticks: run.steal_ticks,
        missed_releases: run.published.missed,
        replaced: !counted.iter().any(|other| std::ptr::eq(*other, run)),
        p99_ms: run.measured.topics.iter().map(|of| p99_ms(&of.latencies_ns).unwrap_or(f64::NAN)).collect(),
    })
    .collect()
}

fn method(plan: &Plan) -> Vec<String> {
    let real = if plan.realtime {
        "The publisher's main thread and middleware run at SCHED_FIFO 25, its worker at 24; the subscriber's sampler and \
         middleware at 21, its callbacks at 20 to 16 (rate-monotonic), workers for all topics at 20; variants called nort- \
         leave the subscriber at SCHED_OTHER."
    } else {
        "MEASURED WITHOUT REAL-TIME PRIORITIES: these are not the numbers to compare."
    };
    vec![
        format!(
            "A publisher and a subscriber process, both on core {}; five topics of 10, 20, 50, 100 and 200 ms, whose callbacks \
             compute for 2, 4, 5, 15 and 50 ms of CPU time: 90 % of the core. Queues keep the last 100 messages.",
            plan.core
        ),
        real.into(),
        "A response time is from the scheduled release of a message to the end of its callback. All topics are first released \
         together. Percentiles are of all runs together (nearest rank); the deviation is that of the runs' 99th percentiles."
            .into(),
        format!(
            "{} runs of {} s for each variant and system, rivals after each other. A run from which the hypervisor took the \
             core (steal in /proc/stat), or whose publisher, above everything else, missed a release, is repeated, at most {} \
             times per variant; the undisturbed runs count, else the least \
             disturbed ones, and all are listed.",
            plan.runs, plan.seconds, plan.repeats
        ),
        "futures-rt-mw-below has sampler and middleware at 15, below the callbacks. In futures-rt-mw-other Fast DDS's own \
         threads are SCHED_OTHER and r2r's main thread has 21, as in the paper; Tautline has no such threads, so there its \
         sampler is SCHED_OTHER. The paper's C++ variants, rclcpp-st and rclcpp-rt, are not part of this."
            .into(),
        "The prediction (RTA+) is response-time analysis with the CPU time for each message that publisher and subscriber were \
         seen to use besides the callbacks, at the highest priority, and what the machine was seen to take from the core \
         before the runs."
            .into(),
        format!(
            "Capacity: while a callback computes for 76.5 ms every 125 ms, another, below it, gets a message every 5 ms. Its queue \
             must hold {}, as `taut check examples/systems/capacity.toml` computes.",
            plan.capacity.computed()
        ),
    ]
}

fn circumstances(plan: &Plan, results: &Results, overheads: &[(&str, u64)]) -> Result<Vec<String>> {
    let version = |package| version_of(package).unwrap_or("?");
    let mut lines = vec![
        machine(),
        format!(
            "tautline {}, iceoryx2 {}, tokio {}",
            version("tautline"),
            version("iceoryx2"),
            version("tokio")
        ),
        match &plan.r2r {
            Ok(program) => crate::process::version(program)?,
            Err(reason) => format!("r2r LEFT OUT: {reason}"),
        },
    ];
    let missing = results.missing(plan);
    if missing > 0 {
        let all = plan.cells.len() * plan.runs as usize;
        lines.push(format!("INCOMPLETE: {missing} of {all} runs are not made yet: the same command goes on"));
    }
    let ledger = &results.ledger;
    for session in &ledger.sessions {
        lines.push(match &session.disturbance {
            Some(disturbance) => disturbance.clone(),
            None => "a session was killed: what the machine did in its last run is not known".to_owned(),
        });
    }
    if ledger.builds() > 1 {
        lines.push(format!("{} builds of this program made the runs", ledger.builds()));
    }
    let seen = ledger.interruptions();
    lines.push(format!(
        "the core before the runs: interruptions of {:.0} µs that take {:.2} % (longest {:.0} µs)",
        seen.regular_ns as f64 / 1e3,
        100.0 * seen.total_ns as f64 / seen.window_ns.max(1) as f64,
        seen.longest_ns as f64 / 1e3
    ));
    for (system, overhead_ns) in overheads {
        lines.push(format!("{system}: {:.1} µs of middleware per message", *overhead_ns as f64 / 1e3));
    }
    lines.extend(ledger.failed.iter().map(|error| format!("a run that failed and was made again: {error}")));
    let all = results.cells.iter().flat_map(|cell| &cell.runs);
    let (runs, disturbed) =
        all.clone().fold((0, 0), |(n, d), run| (n + 1, d + u32::from(run.is_disturbed())));
    let missed: u64 = all.map(|run| run.published.missed).sum();
    lines.push(format!(
        "{runs} runs in {:.0} s, {disturbed} of them disturbed; releases that the publishers missed: {missed}",
        ledger.sessions.iter().map(|session| session.took_s).sum::<f64>()
    ));
    Ok(lines)
}

/// Prints the table and the circumstances.
pub fn print(report: &Report) {
    println!("{}", table(&report.rows));
    println!(
        "Times in ms, from scheduled release to end of callback; ± is the deviation of the runs' p99.\n"
    );
    for run in &report.disturbed {
        let fate = run.fate();
        let (steal, missed) = (run.steal_ticks, run.missed_releases);
        println!(
            "disturbed {}, run {}: steal {steal} ticks, {missed} releases missed; {fate}",
            run.cell, run.run
        );
    }
    report.notes.machine.iter().for_each(|line| println!("{line}"));
}

pub fn table(rows: &[Row]) -> Table {
    let words = ["variant", "system", "topic"].map(Words);
    let times = ["mean", "p50", "p99", "±", "max", "RTA", "RTA+", "deadline"].map(Number);
    let counts = ["late", "lost", "steal ticks"].map(Number);
    let mut table = Table::new(2, [&words[..], &["runs", "n"].map(Number), &times, &counts].concat());
    for row in rows {
        let Row { mean_ms, p50_ms, p99_ms, p99_std_ms, max_ms, rta_ms, rta_overhead_ms, .. } = *row;
        let times = [mean_ms, p50_ms, p99_ms, p99_std_ms, max_ms, rta_ms, rta_overhead_ms];
        let counts = [Cell::bad(row.misses), Cell::bad(row.lost), row.steal_ticks.into()];
        let cells = cells![&row.variant, row.system, &row.topic, row.runs, row.n].into_iter();
        let cells = cells.chain(times.map(|ms| time(ms).into())).chain([row.deadline_ms.into()]);
        table.add(cells.chain(counts));
    }
    table
}

/// 99th percentiles: a line for each of the paper's variants, Tautline's and r2r's for each topic.
pub fn document(plan: &Plan, report: &Report) -> String {
    let rows: Vec<_> =
        report.rows.iter().filter(|row| matches!(row.cell.experiment, Experiment::Paper(_))).collect();
    let line = |variant: &String| {
        let cell = |topic: &Topic| {
            let of = rows.iter().filter(|row| (&row.variant, &row.topic) == (variant, &topic.name));
            let mark = |row: &Row| if row.meets_deadline() { "" } else { "*" };
            of.map(|row| figure(row.p99_ms) + mark(row)).collect::<Vec<_>>().join(" / ")
        };
        [variant.clone()].into_iter().chain(plan.paper.topics.iter().map(cell)).collect()
    };
    let heads =
        plan.paper.topics.iter().map(|topic| format!("{} ({})", topic.name, stats::ms(topic.deadline_ns)));
    let titles = ["variant".to_owned()].into_iter().chain(heads);
    let table = markdown(titles, 1, distinct(rows.iter().map(|row| &row.variant)).into_iter().map(line));
    let runs = rows.iter().map(|row| row.runs).min().unwrap_or(0);
    let most_ticks = rows.iter().map(|row| row.steal_ticks).max().unwrap_or(0);
    format!(
        "{table}\n`cargo xtask bench paper`: 99th percentiles in ms, Tautline / r2r over Fast DDS, deadlines in brackets; \\* marks \
         missed deadlines or lost messages; at least {runs} runs of {} s of each variant, of which the hypervisor took at most \
         {most_ticks} ticks of 10 ms from one variant; {}.\n",
        plan.seconds,
        // The machine and all versions.
        report.notes.machine[..report.notes.machine.len().min(3)].join("; ")
    )
}

pub fn time(ms: Option<f64>) -> String {
    ms.map_or(String::new(), |ms| format!("{ms:.2}"))
}

impl Disturbed {
    pub fn fate(&self) -> &'static str {
        if self.replaced { "replaced by a repetition" } else { "counts nevertheless" }
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::plan::Cell;
    use serde_json::Value;

    /// A plan of two runs of everything.
    pub fn plan() -> Plan {
        Plan {
            runs: 2,
            seconds: 1.0,
            repeats: 1,
            core: 0,
            realtime: true,
            r2r: Err("a test".into()),
            paper: crate::application::paper().unwrap(),
            capacity: crate::application::capacity().unwrap(),
            cells: Vec::new(),
        }
    }

    pub fn report(rows: Vec<Row>) -> Report {
        let notes = Notes { method: vec!["a <method>".into()], machine: vec!["a machine".into()] };
        let verdicts = verdicts(&rows, plan().capacity.computed());
        Report { verdicts, rows, notes, disturbed: Vec::new() }
    }

    pub fn row(system: &'static str, name: &str, index: usize, latencies_ms: &[f64]) -> Row {
        let plan = plan();
        let experiment = match name.strip_prefix("capacity-") {
            Some(depth) => Experiment::Capacity(depth.parse().unwrap()),
            None => Experiment::Paper(name.parse().unwrap()),
        };
        let cell = Cell { system, experiment };
        let mut row = stats::rows(&plan, &CellRuns { cell, runs: Vec::new() }).swap_remove(index);
        row.latencies_ns = latencies_ms.iter().map(|ms| (ms * 1e6) as u64).collect();
        row.n = latencies_ms.len() as u64;
        (row.runs, row.published) = (1, row.n);
        row.misses = latencies_ms.iter().filter(|ms| **ms > row.deadline_ms).count() as u64;
        let longest = latencies_ms.iter().copied().reduce(f64::max);
        (row.p50_ms, row.p99_ms, row.max_ms, row.mean_ms) = (longest, longest, longest, longest);
        (row.p99_std_ms, row.rta_overhead_ms) = (Some(0.5), row.rta_ms);
        row
    }

    #[test]
    fn the_documents_table_has_both_systems_and_marks_what_failed() {
        let rows = [
            row(TAUTLINE, "tokio", 0, &[2.0]),
            row(TAUTLINE, "tokio", 1, &[3.0]),
            row(R2R, "tokio", 0, &[123.4]),
            row(TAUTLINE, "capacity-16", 0, &[70.0]),
        ];
        let table = document(&plan(), &report(rows.into()));
        let lines: Vec<_> = table.lines().collect();
        assert!(lines[0].starts_with("| variant | topic1 (10) | topic2 (20) |"), "{table}");
        assert!(lines[2].starts_with("| tokio | 2.00 / 123* | 3.00 |"), "{table}");
        assert!(lines[3].is_empty() && table.contains("at least 1 runs of 1 s"), "{table}");
    }

    #[test]
    fn json_keeps_its_contract() {
        let text = serde_json::to_string_pretty(&[row(TAUTLINE, "futures-rt", 0, &[2.1])]).unwrap();
        let list: Value = serde_json::from_str(&text).unwrap();
        let first = &list[0];
        assert_eq!(
            (&first["system"], &first["variant"], &first["n"]),
            (&"tautline".into(), &"futures-rt".into(), &1.into())
        );
        let keys = "system variant topic runs n p50_ms p99_ms max_ms p99_std_ms rta_ms deadline_ms misses lost steal_ticks";
        let places: Vec<_> =
            keys.split(' ').map(|key| text.find(&format!("\"{key}\":")).expect(key)).collect();
        assert!(places.is_sorted() && text.find("\"mean_ms\"").unwrap() > *places.last().unwrap(), "{text}");
    }
}

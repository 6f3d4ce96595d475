// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tables and the JSON.

use tautline_exchange::{APPLICATION_PRIORITY, LATE};
use tautline_harness::rows::{Details, Row, Tally, Wakes, is_enough, median, rounded};
use tautline_harness::table::{of_rows, short};
use tautline_harness::verdict::{self, Verdict};
use tautline_harness::{machine, version_of};

use crate::claims;
use crate::load::LOAD;
use crate::modes::{NOT_JOINED, SYSTEMS};
use crate::plan::{Bench, Plan, Task};
use crate::rounds::Cell;
use crate::settings::Extent;
use crate::smoke::faults;

/// The heading of where a rival is ahead of us.
pub const AHEAD: &str =
    "Where a rival is ahead of Tautline's default (blocking, for rivals that never sleep busy-poll), and why";

/// The result of a run.
pub struct Report {
    pub rows: Vec<Row>,
    pub verdicts: Vec<Verdict>,
    /// See [`AHEAD`].
    pub ahead: Vec<Verdict>,
    /// Machine, versions, conditions: a line each.
    pub machine: Vec<String>,
    pub is_realtime: bool,
    failures: Vec<String>,
}

impl Report {
    /// Of what was measured; `more` rows are of no case.
    pub fn new(plan: &Plan, cells: Vec<Cell>, more: Vec<Row>, disturbance: String) -> Self {
        let ours = cells.iter().filter(|cell| cell.case.mode.system == "tautline");
        let of_cell = |cell: &Cell| {
            let late =
                matches!(cell.case.task, Task::RoundTrips { .. } | Task::Requests) && cell.total.of.late > 0;
            let failures = cell.failures.iter().cloned().chain(late.then(|| took_long(cell)));
            failures.map(|failure| format!("{}: {failure}", cell.case.name())).collect::<Vec<_>>()
        };
        let mut failures: Vec<String> = ours.flat_map(of_cell).collect();
        let is_held = cells.iter().all(|cell| cell.idle_refused.is_none());
        let mut rows: Vec<Row> = cells.iter().map(|cell| row(cell, plan)).chain(more).collect();
        let mut machine = vec![machine(), disturbance, versions(plan)];
        rows.push(Row { note: conditions(plan, is_held, &machine), ..missing("machine", "-", "") });
        for (mode, reason) in &plan.missing {
            rows.push(missing(mode.system, mode.mode, reason));
        }
        if plan.bench == Bench::Compare {
            let wanted = NOT_JOINED.into_iter().filter(|(system, _)| plan.is_wanted(system));
            rows.extend(wanted.map(|(system, reason)| missing(system, "-", reason)));
        }
        if plan.extent == Extent::Smoke {
            failures.extend(faults(plan, &rows));
        }
        machine.extend(notes(plan));
        Report { machine, is_realtime: plan.realtime, failures, ..Report::of_rows(rows) }
    }

    /// Of an earlier run.
    pub fn of_rows(rows: Vec<Row>) -> Self {
        let (verdicts, ahead) = (claims::verdicts(&rows), claims::ahead(&rows));
        Report { rows, verdicts, ahead, machine: Vec::new(), is_realtime: true, failures: Vec::new() }
    }

    /// Prints the machine, a table per experiment and what must hold.
    pub fn print(&self) {
        self.machine.iter().for_each(|line| println!("{line}"));
        if !self.is_realtime {
            println!("\n*** measured without real-time priorities: these are not the numbers to compare ***");
        }
        for (title, rows) in self.tables() {
            println!("\n{title}\n{}", of_rows(rows));
        }
        print!("\n{}", verdict::text(&self.verdicts));
        if !self.ahead.is_empty() {
            print!("\n{AHEAD}:\n{}", verdict::text(&self.ahead));
        }
    }

    /// The rows of each experiment, under its title.
    pub fn tables(&self) -> Vec<(&'static str, Vec<&Row>)> {
        let rows = self.rows.iter().filter(|row| row.system != "machine");
        let of = |prefix: &str| rows.clone().filter(|row| row.experiment.starts_with(prefix)).collect();
        let tables: [(&str, Vec<&Row>); 10] = [
            ("Half round trips", of("latency/")),
            ("One way, 1 kHz, quiet and under load", of("open-loop/")),
            ("Fan-out: to the last subscription", of("fan-out/")),
            ("A robot's worth: 20 topics at 100 Hz", of("robot/")),
            ("Throughput: times between arrivals", of("throughput")),
            ("The same with 4 MiB that are not confirmed", of("window/")),
            ("Round trips of a request and its response", of("request/")),
            ("Response times of local callbacks that load a core to 90 %", of("callbacks/")),
            ("Start-up and discovery", of("start-up/")),
            ("Not measured", of("-")),
        ];
        tables.into_iter().filter(|(_, rows)| !rows.is_empty()).collect()
    }

    /// What Tautline could not do, which no rival's row may hide; of a smoke run, what else is missing.
    pub fn failure(&self) -> Option<String> {
        (!self.failures.is_empty()).then(|| self.failures.join("\n"))
    }
}

/// What was not measured.
pub fn missing(system: &str, mode: &str, reason: &str) -> Row {
    let note = format!("not measured: {reason}");
    Row { note, ..Tally::default().row("-", system, mode, 0) }
}

fn row(cell: &Cell, plan: &Plan) -> Row {
    let Cell { case, tally, total, .. } = cell;
    let is_there = !tally.times.is_empty();
    let is_start = matches!(case.task, Task::Start { .. });
    let row = tally.row(&case.experiment, case.mode.system, case.mode.mode, case.payload_bytes);
    let rare = |time: Option<f64>, quantile| time.filter(|_| is_enough(row.n, quantile));
    Row {
        p99_us: rare(row.p99_us, 0.99),
        p999_us: rare(row.p999_us, 0.999),
        cpu_us_per_msg: total.cpu_us_per_msg().filter(|_| is_there && !is_start),
        rss_mib: total.rss_mib().filter(|_| is_there),
        throttled: total.throttled,
        mb_per_s: rate(cell),
        note: note(cell),
        unfit: unfit(cell, plan),
        details: is_there.then(|| details(cell)),
        ..row
    }
}

/// What arrives of a stream: the median round.
fn rate(cell: &Cell) -> Option<f64> {
    let is_stream = matches!(cell.case.task, Task::Stream { .. } | Task::Window);
    let rates = cell.tally.rounds.iter().filter_map(|round| round.msgs_per_s);
    let rate = median(rates.filter(|_| is_stream).collect())?;
    Some(rounded(rate * cell.case.payload_bytes as f64 / 1e6))
}

/// Of round trips.
fn took_long(cell: &Cell) -> String {
    let (late, limit) = (cell.total.of.late, LATE.as_millis());
    format!("{late} round trips took {limit} ms or more: a wake-up was lost, or the machine stood still")
}

/// Why a row must not be compared, but for lost messages.
fn unfit(cell: &Cell, plan: &Plan) -> Option<String> {
    if !plan.realtime {
        return Some("was measured with --no-rt".to_owned());
    }
    if cell.idle_refused.is_some() {
        return Some("was measured while idle states were not held off".to_owned());
    }
    let (failed, all) = (cell.failures.len(), cell.failures.len() + cell.tally.rounds.len());
    (failed > 0).then(|| format!("failed in {failed} of {all} rounds"))
}

fn details(cell: &Cell) -> Details {
    let total = &cell.total;
    Details {
        times: cell.tally.times.clone(),
        messages_per_s: total.per_second(total.of.messages),
        cpu_share: total.per_second(total.of.cpu_ns) / 1e9,
        steal_ticks: cell.steal_ticks,
        wakes: total.wakes,
    }
}

fn note(cell: &Cell) -> String {
    let (of, mut words) = (&cell.total.of, Vec::new());
    if let Some(failure) = cell.failures.last() {
        let (failed, all) = (cell.failures.len(), cell.failures.len() + cell.tally.rounds.len());
        words.push(format!("FAILED: {failed} of {all} rounds failed: {}", shortened(failure)));
    }
    if let Some(error) = &cell.idle_refused {
        words.push(format!("IDLE STATES WERE NOT HELD OFF: {error}"));
    }
    if cell.tally.times.is_empty() {
        return words.join("; ");
    }
    match cell.case.task {
        Task::Stream { .. } => {
            let rate = cell.total.per_second(of.messages);
            let is_held = cell.case.mode.holds_sender_back(cell.case.payload_bytes);
            let not = if is_held { "" } else { "not " };
            words.push(format!("{rate:.0} messages/s, the sender is {not}held back"));
        }
        Task::Paced { .. } if cell.case.experiment.starts_with("robot/") => {
            let percent = cell.total.per_second(of.cpu_ns) / 1e7;
            words.push(format!("{percent:.1} % of a core for all processes"));
        }
        _ => {}
    }
    let is_ours = cell.case.experiment.starts_with("fan-out/") && cell.case.mode.system == "tautline";
    if let Some(wakes) = cell.total.wakes.filter(|_| is_ours) {
        let Wakes { sampler, others } = wakes;
        words.push(format!(
            "per message a receiver's sampler woke {sampler:.2} times, its other threads {others:.2} times in sum"
        ));
    }
    if cell.tally.rounds.len() > 1 {
        let rounds: Vec<_> = cell.tally.rounds.iter().map(|round| format!("{:.1}", round.p50_us)).collect();
        words.push(format!("p50 of the rounds {}", rounds.join(", ")));
    }
    match cell.case.task {
        _ if of.late == 0 => {}
        Task::RoundTrips { .. } | Task::Requests => words.push(took_long(cell)),
        _ => words.push(format!("{} sent late: stamped with the time at which they were due", of.late)),
    }
    if of.refused > 0 {
        words.push(format!("{} not taken from the sender", of.refused));
    }
    if of.memory.shared_kib > 0 {
        let mib = short(of.memory.shared_kib as f64 / 1024.0);
        words.push(format!("{mib} MiB of the memory are shared"));
    }
    words.push(format!("steal {} ticks", cell.steal_ticks));
    words.join("; ")
}

/// The longest that a note repeats of a failure.
const FAILURE: usize = 300;

/// In one line.
fn shortened(failure: &str) -> String {
    let lines: Vec<&str> = failure.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    let line = lines.join(" | ");
    match line.char_indices().nth(FAILURE) {
        Some((end, _)) => format!("{}...", &line[..end]),
        None => line,
    }
}

/// What whoever quotes figures must say beside them.
fn conditions(plan: &Plan, is_held: bool, machine: &[String]) -> String {
    let priority = if plan.realtime { "SCHED_FIFO" } else { "NO REAL-TIME PRIORITY" };
    let idle = if is_held { "held off where the experiment says so" } else { "NOT HELD OFF" };
    let extent = if plan.extent == Extent::Full { "a full run" } else { "a quick run of few messages" };
    format!("{}; {priority}; idle states {idle}; {extent}", machine.join("; "))
}

/// Of all that takes part.
fn versions(plan: &Plan) -> String {
    let locked = |system: &str| match system {
        "tautline" | "iceoryx2" | "hiroz" | "zenoh" => version_of(system),
        "taktora" => version_of("taktora-executor"),
        _ => None,
    };
    let takes_part = |system: &&str| plan.cases.iter().any(|case| case.mode.system == *system);
    let version = |system: &str| match locked(system) {
        Some(version) => Some(format!("{system} {version}")),
        None => plan.programs.version(system),
    };
    SYSTEMS.into_iter().filter(takes_part).filter_map(version).collect::<Vec<_>>().join(", ")
}

fn notes(plan: &Plan) -> Vec<String> {
    let priorities = if plan.realtime {
        format!(
            "SCHED_FIFO {APPLICATION_PRIORITY} for the threads that send or are called back and for those that a library \
             starts, {} for Tautline's samplers; memory locked (on fault) and kept by malloc in all processes",
            APPLICATION_PRIORITY + 10
        )
    } else {
        "NO REAL-TIME PRIORITY".to_owned()
    };
    let [near, far] = plan.cores;
    let cores = match plan.is_pinned {
        true => format!("sender on core {near}, receivers on core {far}"),
        false => "threads on any core".to_owned(),
    };
    let rounds = format!("at most {} rounds to and fro", plan.rounds);
    let queues = "queues of all systems: 10 messages, for throughput at 64 B 100";
    let load = (plan.bench == Bench::Compare).then(|| format!("load: {LOAD}"));
    [format!("{cores}; {priorities}; {rounds}; {queues}")].into_iter().chain(load).collect()
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::callbacks::{FLOOD, MESSAGE_BYTES, QUIET, TOPICS};
    use crate::modes::{MODES, Part};
    use crate::plan::measurable;
    use tautline_harness::Distribution;
    use tautline_harness::table::size;
    use tautline_harness::verdict::Outcome::NotMeasured;

    /// A round of 10,000 times.
    pub fn row(experiment: &str, system: &str, mode: &str, bytes: usize, us: f64) -> Row {
        let (mut times, mut tally) = (Distribution::new(), Tally::default());
        times.add(&[((us * 1e3) as u64, 10_000)]);
        let round = tally.add(1, &times);
        (round.cpu_us_per_msg, round.rss_mib, round.msgs_per_s) = (Some(us), Some(us), Some(1e6 / us));
        tally.row(experiment, system, mode, bytes)
    }

    /// A row for all that can be measured.
    fn everything() -> Vec<Row> {
        let of_mode = |(experiment, bytes): (String, usize)| {
            MODES.iter().map(move |mode| row(&experiment, mode.system, mode.mode, bytes, 2.0))
        };
        let topics = [(QUIET, 0), (FLOOD, MESSAGE_BYTES)].into_iter().flat_map(|(experiment, bytes)| {
            TOPICS.map(|topic| row(experiment, "tautline", topic, bytes, 2.0))
        });
        let wakes = Some(Wakes { sampler: 1.0, others: 1.0 });
        let (times, steal_ticks) = (Distribution::new(), 0);
        let details = Details { times, messages_per_s: 1.0, cpu_share: 1.0, steal_ticks, wakes };
        let all = measurable().into_iter().flat_map(of_mode).chain(topics);
        all.map(|row| Row { details: Some(details.clone()), ..row }).collect()
    }

    #[test]
    fn every_claim_is_about_what_is_measured() {
        let all = everything();
        let report = Report::of_rows(all.clone());
        // 104 of latency, 13 of large messages, 7 of wakes, 2 under load, 1 of fan-out, 5 of the robot, 34 of streams, 10 of starts, 2 of
        // requests, 8 over gateways, 5 of callbacks.
        assert_eq!(report.verdicts.len(), 191);
        for verdict in report.verdicts {
            assert!(verdict.outcome != NotMeasured, "{verdict}");
        }
        assert!(report.ahead.is_empty() && Report::of_rows(Vec::new()).verdicts.is_empty());
    }

    #[test]
    fn what_sleeps_is_compared_with_what_sleeps_and_the_better_mode_is_named() {
        let held = "latency/whole/held-off";
        let rows = [
            row(held, "tautline", "blocking", 64, 6.0),
            row(held, "tautline", "direct", 64, 4.0),
            row(held, "tautline", "busy-poll", 64, 1.2),
            row(held, "cyclonedds", "tuned", 64, 5.0),
            row(held, "iceoryx2", "busy-poll", 64, 1.0),
            row(held, "fastdds", "default", 64, 9.0),
            row(held, "floor", "futex", 64, 2.0),
        ];
        let lines = verdict::text(&Report::of_rows(rows.into()).ahead);
        for line in [
            "MISSED        latency/whole/held-off, 64 B, p50: blocking 6.00 µs, 1.20 x cyclonedds tuned; at most 1.05 x; direct 4.00 µs\n",
            "MISSED        latency/whole/held-off, 64 B, p50: busy-poll 1.20 µs, 1.20 x iceoryx2 busy-poll; at most 1.05 x\n",
            "              why: blocking wakes two threads",
        ] {
            assert!(lines.contains(line), "{line}\n{lines}");
        }
        assert_eq!(lines.matches(", p50:").count(), 2, "{lines}");
    }

    #[test]
    fn wherever_a_rival_is_ahead_it_is_said() {
        let payloads = measurable();
        for mode in MODES.iter().filter(|mode| !["floor", "tautline"].contains(&mode.system)) {
            let kinds: &[&str] = match mode.part {
                Part::All => &["latency", "open-loop", "fan-out", "robot", "throughput", "start-up"],
                Part::RoundTrips => &["latency"],
                _ => continue,
            };
            let ours = if ["busy-poll", "items"].contains(&mode.mode) { "busy-poll" } else { "blocking" };
            let takes_part = |experiment: &String| {
                kinds.iter().any(|kind| experiment.split('/').next() == Some(kind))
                    // Plain Zenoh's alone.
                    && experiment != "throughput/untouched/as-shipped"
            };
            let of = |system, mode, us| {
                payloads.iter().map(move |(experiment, bytes)| row(experiment, system, mode, *bytes, us))
            };
            let rows = of("tautline", ours, 2.0).chain(of(mode.system, mode.mode, 1.0)).collect();
            let ahead = Report::of_rows(rows).ahead;
            for (experiment, bytes) in payloads.iter().filter(|(experiment, _)| takes_part(experiment)) {
                let what = format!("{experiment}, {}", size(*bytes));
                let is_said = ahead.iter().any(|verdict| verdict.what.starts_with(&what));
                assert!(is_said, "{what}, {} {}", mode.system, mode.mode);
            }
        }
    }
}

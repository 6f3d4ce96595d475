// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a run was: times beside their bounds, losses, and how well the lane was kept.

use std::path::Path;
use std::time::Duration;

use comfy_table::{CellAlignment, LineStyle, Table, TableStyle};
use serde::Serialize;
use tautline_alks::drive::Drive;
use tautline_alks::job::Job;
use tautline_alks::records::{Part, Span, Summary, losses, published, summaries};
use tautline_analysis::file::SystemFile;

use crate::Result;

/// What the paper says of its chain: 99 % below this.
const PAPER: Duration = Duration::from_micros(800);
/// From the lane's centre, in m: where a car of 1.95 m touches the line of a lane of 3.75 m, less 0.3 m.
const LATERAL_M: f64 = 0.6;
/// The chain's name in the system files.
const CHAIN: &str = "odometry";

/// What the analysis says.
#[derive(Clone, Debug)]
pub struct Bounds {
    chain: Option<Duration>,
    control: Option<Duration>,
}

impl Bounds {
    /// Of a system file; without real-time priorities nothing is bounded.
    pub fn read(path: &Path, realtime: bool) -> Result<Bounds> {
        let checked = SystemFile::read(path)?.check();
        let chain =
            checked.chains.iter().find(|chain| chain.name == CHAIN).and_then(|chain| chain.latency_ns);
        let control = checked.callbacks.iter().find(|callback| callback.entry.name == "control");
        let control = control.and_then(|callback| callback.response_overhead_ns);
        let [chain, control] = [chain, control].map(|ns| ns.filter(|_| realtime).map(Duration::from_nanos));
        Ok(Bounds { chain, control })
    }

    fn of(&self, span: Span) -> Option<Duration> {
        match span {
            Span::Chain => self.chain,
            // Its duration is part of its response.
            Span::Timer | Span::Planning => self.control,
            _ => None,
        }
    }
}

/// A row of the table.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    #[serde(flatten)]
    pub times: Summary,
    pub bound_ms: Option<f64>,
    pub kept: Option<bool>,
}

/// Of all rounds of one system.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    pub system: String,
    pub shared: &'static str,
    pub realtime: bool,
    pub rows: Vec<Row>,
    /// Share of the chain's latencies that are below 0.8 ms, as 99 % of the paper's are.
    pub chain_below_paper: f64,
    /// Messages that did not come: of each topic that lost some, and how many of how many.
    pub lost: Vec<(String, u64, u64)>,
    pub published: u64,
    pub steal_ticks: u64,
    /// Of the first round.
    pub drive: Drive,
}

impl Report {
    pub fn new(
        system: &str,
        job: &Job,
        rounds: &[Vec<Part>],
        bounds: Option<&Bounds>,
        steal_ticks: u64,
    ) -> Result<Report> {
        let rows: Vec<Row> =
            summaries(rounds.iter().flatten()).into_iter().map(|times| row(times, bounds)).collect();
        let chain = rows
            .iter()
            .find(|row| row.times.span == Span::Chain)
            .ok_or("no message came through the chain")?;
        let drive =
            rounds.iter().flatten().find_map(|part| part.drive.clone()).ok_or("nothing was driven")?;
        Ok(Report {
            system: system.to_owned(),
            shared: job.shared.as_str(),
            realtime: job.realtime,
            chain_below_paper: chain.times.share_below(PAPER),
            rows,
            lost: rounds.iter().flat_map(|parts| losses(parts)).collect(),
            published: rounds.iter().map(|parts| published(parts)).sum(),
            steal_ticks,
            drive,
        })
    }

    /// How it is called beside others.
    pub fn label(&self) -> String {
        format!("{}, {}", self.system, self.shared)
    }

    /// What was not kept. Of others than Tautline nothing was promised.
    pub fn complaints(&self) -> Vec<String> {
        if self.system != "Tautline" {
            return Vec::new();
        }
        let mut complaints = lane_complaints(&self.drive);
        for row in self.rows.iter().filter(|row| row.kept == Some(false)) {
            let (name, max_ms) = (&row.times.name, row.times.max_ms);
            let bound_ms = row.bound_ms.unwrap_or(0.0);
            complaints.push(format!(
                "{name}: {max_ms:.3} ms, the bound is {bound_ms:.3} ms; the host took {} ms in this run (steal); of a run by itself `taut report --watch` meanwhile explains each response above its bound",
                self.steal_ticks * 10
            ));
        }
        for (topic, lost, sent) in &self.lost {
            complaints.push(format!("{topic}: {lost} of {sent} messages did not come"));
        }
        complaints
    }
}

fn row(times: Summary, bounds: Option<&Bounds>) -> Row {
    let bound = bounds.and_then(|bounds| bounds.of(times.span));
    let bound_ms = bound.map(|bound| bound.as_secs_f64() * 1e3);
    Row { kept: bound_ms.map(|bound_ms| times.max_ms <= bound_ms), bound_ms, times }
}

/// What was wrong with how the lane was kept.
pub fn lane_complaints(drive: &Drive) -> Vec<String> {
    let mut complaints = Vec::new();
    if drive.lateral_max_m > LATERAL_M {
        complaints.push(format!(
            "the car was {:.2} m off the lane's centre, {LATERAL_M} m are allowed",
            drive.lateral_max_m
        ));
    }
    if drive.collisions > 0 {
        complaints.push(format!("the car touched others {} times", drive.collisions));
    }
    complaints
}

/// A sentence on a drive.
pub fn about(drive: &Drive) -> String {
    let gap = drive
        .gap_min_m
        .map_or(String::new(), |gap_m| format!(", never nearer than {gap_m:.0} m to who was ahead"));
    format!(
        "Drove {:.1} km in {:.0} s, {:.0} % of it in curves, with {} cut-ins{gap}: at most {:.3} m off the lane's centre, {:.3} m rms (seed {}).",
        drive.kilometres,
        drive.seconds,
        drive.in_curves * 100.0,
        drive.cut_ins,
        drive.lateral_max_m,
        drive.lateral_rms_m,
        drive.seed
    )
}

/// All reports, for people.
pub fn print(reports: &[Report]) -> Result<()> {
    for report in reports {
        println!("{}{}", report.label(), if report.realtime { "" } else { ", without real-time priorities" });
        print!("{}", table(report));
        println!(
            "{:.2} % of the chain below 0.8 ms (the paper: about 99 %). {} messages published, {} lost. Steal: {} ticks of 10 ms.",
            report.chain_below_paper * 100.0,
            report.published,
            report.lost.iter().map(|(_, lost, _)| lost).sum::<u64>(),
            report.steal_ticks
        );
        println!("{}", about(&report.drive));
        let complaints = report.complaints();
        complaints.iter().for_each(|complaint| println!("NOT KEPT: {complaint}"));
        if complaints.is_empty() && report.system == "Tautline" {
            println!("Kept: the lane, the bounds, every message.");
        }
        println!();
    }
    Ok(())
}

fn table(report: &Report) -> String {
    let style = TableStyle::new().header_separator(LineStyle::none().fill('─').junction('─'));
    let mut table = Table::new();
    table.load_style(style).set_header(["", "n", "p50 ms", "p99 ms", "p99.9 ms", "max ms", "bound ms"]);
    let ms = |ms: f64| format!("{ms:.3}");
    for Row { times, bound_ms, .. } in &report.rows {
        table.add_row([
            times.name.clone(),
            times.n.to_string(),
            ms(times.p50_ms),
            ms(times.p99_ms),
            ms(times.p999_ms),
            ms(times.max_ms),
            bound_ms.map_or_else(String::new, ms),
        ]);
    }
    for (index, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, 2));
        if index > 0 {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table.lines().map(|line| line.trim_end().to_owned() + "\n").collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::own_file;
    use std::collections::BTreeSet;

    #[test]
    fn the_system_files_are_schedulable_and_describe_the_same_callbacks() {
        let names = |file: &str| {
            let checked = SystemFile::read(own_file(file)).unwrap().check();
            assert!(checked.schedulable, "{file}");
            checked.callbacks.iter().map(|callback| callback.entry.name.clone()).collect::<BTreeSet<_>>()
        };
        assert_eq!(names("system.toml"), names("computed.toml"));
        assert_eq!(names("system.toml").len(), 20);
    }

    #[test]
    fn the_priorities_are_those_of_the_papers_table() {
        let checked = SystemFile::read(own_file("system.toml")).unwrap();
        assert!(checked.cores().iter().all(|core| core.sampler_priority == 20));
        for callback in checked.callbacks() {
            let expected = if callback.name == "control" { 5 } else { 10 };
            assert_eq!(callback.priority, expected, "{}", callback.name);
        }
        let subscribers = checked.callbacks().iter().filter(|of| of.group.as_deref() == Some("subscribers"));
        assert_eq!(subscribers.count(), 11);
        let bounds = Bounds::read(&own_file("system.toml"), true).unwrap();
        assert!(bounds.chain.unwrap() < Duration::from_millis(10) && bounds.control.is_some());
        assert!(Bounds::read(&own_file("system.toml"), false).unwrap().chain.is_none());
    }
}

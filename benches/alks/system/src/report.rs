// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a run was: times beside their bounds, losses, and how well the lane was kept.

use std::path::Path;
use std::time::Duration;

use serde::Serialize;
use tautline_alks::drive::Drive;
use tautline_alks::job::Job;
use tautline_alks::records::{Part, Span, Summary, losses, published, summaries};
use tautline_analysis::file::SystemFile;
use tautline_harness::Distribution;
use tautline_harness::readings::{Column, Reading, judge, table};
use tautline_harness::verdict::{self, Outcome, Verdict};

use crate::Result;

/// What the paper says of its chain: 99 % below this.
const PAPER: Duration = Duration::from_micros(800);
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

    pub fn of(&self, span: Span) -> Option<Duration> {
        match span {
            Span::Chain => self.chain,
            // Its duration is part of its response.
            Span::Timer | Span::Planning => self.control,
            _ => None,
        }
    }
}

/// Of all rounds of one system.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    pub system: &'static str,
    pub shared: &'static str,
    pub realtime: bool,
    pub rows: Vec<Reading>,
    /// What must hold of Tautline; of others nothing was promised.
    pub verdicts: Vec<Verdict>,
    /// Messages that did not come: of each topic that lost some, and how many of how many.
    pub lost: Vec<(String, u64, u64)>,
    pub steal_ticks: u64,
    /// Of the first round.
    pub drive: Drive,
    /// For pictures.
    #[serde(skip)]
    pub times: Vec<Summary>,
    #[serde(skip)]
    pub bounds: Option<Bounds>,
}

impl Report {
    pub fn new(
        system: &'static str,
        job: &Job,
        rounds: &[Vec<Part>],
        bounds: Option<Bounds>,
        steal_ticks: u64,
    ) -> Result<Report> {
        let times = summaries(rounds.iter().flatten());
        let chain =
            times.iter().find(|of| of.span == Span::Chain).ok_or("no message came through the chain")?;
        let drive =
            rounds.iter().flatten().find_map(|part| part.drive.clone()).ok_or("nothing was driven")?;
        let lost: Vec<_> = rounds.iter().flat_map(|parts| losses(parts)).collect();
        let number = |what: &str, unit, value| {
            Reading::of(job.shared.as_str(), 0, what, unit).system(system).value(value)
        };
        let below = number("of the chain below 0.8 ms", "%", chain.share_below(PAPER) * 100.0);
        let all_lost =
            number("messages lost", "messages", lost.iter().map(|(_, lost, _)| *lost as f64).sum());
        let all_lost = all_lost.at_most(0.0).must();
        let sent = rounds.iter().map(|parts| published(parts)).sum::<u64>();
        let mut rows = Vec::new();
        for of in &times {
            let mut times = Distribution::new();
            times.add(&of.values);
            let row =
                Reading::of(job.shared.as_str(), 0, &of.name, "ms").system(system).times_in(&times, 1e3);
            rows.push(match bounds.as_ref().and_then(|bounds| bounds.of(of.span)) {
                None => row,
                Some(bound) => {
                    let bound_ms = bound.as_secs_f64() * 1e3;
                    row.at_most_of(Column::Max, bound_ms).note(format!("bound {bound_ms:.3} ms"))
                }
            });
        }
        rows.push(below.note("in the paper about 99 %"));
        rows.push(all_lost.note(format!("of {sent}")));
        rows.extend(lane(&drive).map(|row| Reading {
            experiment: job.shared.as_str().to_owned(),
            system,
            ..row
        }));
        if bounds.is_none() {
            rows.iter_mut().for_each(|row| row.aim = None);
        }
        let verdicts = judge(&mut rows);
        let (shared, realtime) = (job.shared.as_str(), job.realtime);
        Ok(Report { system, shared, realtime, rows, verdicts, lost, steal_ticks, drive, times, bounds })
    }

    /// How it is called beside others.
    pub fn label(&self) -> String {
        let realtime = if self.realtime { "" } else { ", without real-time priorities" };
        format!("{}, {}{realtime}", self.system, self.shared)
    }

    /// What is to be known of a bound that was not kept, and of what was lost.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = vec![about(&self.drive)];
        notes.push(format!("The host took {} ms in this run (steal).", self.steal_ticks * 10));
        if self.rows.iter().any(|row| row.aim.is_some_and(|aim| !aim.must && aim.is_met == Some(false))) {
            notes.push(
                "Of a run by itself `taut report --watch` meanwhile explains each response above its bound."
                    .to_owned(),
            );
        }
        notes.extend(
            self.lost
                .iter()
                .map(|(topic, lost, sent)| format!("{topic}: {lost} of {sent} messages did not come")),
        );
        notes
    }
}

/// How well the lane was kept: a car of 1.95 m touches the line of a lane of 3.75 m 0.9 m off its centre; 0.3 m are left.
fn lane(drive: &Drive) -> [Reading; 2] {
    [
        Reading::of("drive", 0, "off the lane's centre", "m").value(drive.lateral_max_m).at_most(0.6).must(),
        Reading::of("drive", 0, "collisions", "collisions")
            .value(f64::from(drive.collisions))
            .at_most(0.0)
            .must(),
    ]
}

/// What must hold of a drive.
pub fn verdicts_of_drive(drive: &Drive) -> Vec<Verdict> {
    judge(&mut lane(drive))
}

/// Whether nothing was missed.
pub fn all_hold<'v>(verdicts: impl IntoIterator<Item = &'v Verdict>) -> bool {
    verdicts.into_iter().all(|verdict| verdict.outcome != Outcome::Missed)
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
pub fn print(reports: &[Report]) {
    for report in reports {
        println!("{}\n{}", report.label(), table(&report.rows));
        report.notes().iter().for_each(|note| println!("{note}"));
        println!("{}", verdict::text(&report.verdicts));
    }
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tables, the JSON, and whether aims are met.

use crate::{Experiment, Result};
use clap::ValueEnum;
use serde::Serialize;
use tautline_harness::readings::{Column, Reading, judge, shown, table};
use tautline_harness::table::{distinct, markdown};
use tautline_harness::verdict::{self, Verdict};
use tautline_harness::{machine, version_of};

/// How it was measured.
pub struct Circumstances {
    /// The limit of each process.
    pub open_files: u64,
    pub disturbance: String,
    pub realtime: bool,
    pub quick: bool,
}

#[derive(Serialize)]
pub struct Report {
    machine: String,
    versions: String,
    /// The limit of each process.
    open_files: u64,
    disturbance: String,
    realtime: bool,
    quick: bool,
    rows: Vec<Reading>,
    #[serde(skip)]
    verdicts: Vec<Verdict>,
}

impl Report {
    /// Judges the rows.
    pub fn new(mut rows: Vec<Reading>, circumstances: Circumstances) -> Self {
        let verdicts = judge(&mut rows);
        let Circumstances { open_files, disturbance, realtime, quick } = circumstances;
        let version = |package| version_of(package).unwrap_or("?");
        let versions = format!("tautline {}, iceoryx2 {}", version("tautline"), version("iceoryx2"));
        Report { machine: machine(), versions, open_files, disturbance, realtime, quick, rows, verdicts }
    }

    /// Those that were measured, each with its rows.
    fn experiments(&self) -> impl Iterator<Item = (Experiment, Vec<&Reading>)> {
        let of = |experiment: &Experiment| {
            let name = experiment.name();
            (*experiment, self.rows.iter().filter(|row| row.experiment == name).collect::<Vec<_>>())
        };
        Experiment::value_variants().iter().map(of).filter(|(_, rows)| !rows.is_empty())
    }

    /// The tables of the documents: one for each experiment.
    pub fn document(&self) -> String {
        let tables: String =
            self.experiments().map(|(experiment, rows)| document(experiment, &rows) + "\n").collect();
        format!(
            "{tables}`cargo xtask bench domain`: medians unless a line says otherwise; {}; {}; {}.\n",
            self.versions, self.disturbance, self.machine
        )
    }

    pub fn print(&self) {
        println!("{}", self.machine);
        println!("{}; {} open files at most (ulimit -n)", self.versions, self.open_files);
        println!("{}", self.disturbance);
        let priorities = if self.realtime { "real-time priorities" } else { "NO REAL-TIME PRIORITIES" };
        println!(
            "messages with {priorities}; all else as ordinary threads{}",
            if self.quick { "; a quick run" } else { "" }
        );
        for (experiment, rows) in self.experiments() {
            println!("\n{}\n{}", title(experiment), table(rows.iter().copied()));
        }
    }

    /// Prints whether aims are met.
    ///
    /// # Errors
    /// One that must be is not.
    pub fn print_verdicts(&self) -> Result<()> {
        println!();
        verdict::print(&self.verdicts)
    }
}

fn title(experiment: Experiment) -> String {
    let help = experiment.to_possible_value().and_then(|value| value.get_help().map(ToString::to_string));
    format!("{}: {}", experiment.name(), help.unwrap_or_default())
}

/// What an experiment was done with, at the head of its table in the documents; `#` is the number at the head of a column.
fn heading(experiment: Experiment) -> &'static str {
    match experiment {
        Experiment::Processes => "# processes with the ten endpoints of every ROS node each",
        Experiment::Topics => "# topics between two processes",
        Experiment::Storm => "# processes that start at once",
        Experiment::Nodes => "# such nodes in one process",
        Experiment::Crowd => "# publishers and as many subscriptions of one topic",
        Experiment::Load => "# topics x 2 subscriptions x 100 Hz",
        Experiment::Images => "8 MB at 30 Hz to # subscriptions",
        Experiment::FanOut => "# subscriptions of one topic at 100 Hz",
        Experiment::Readers => "# processes with a subscription each of one topic at 100 Hz",
        Experiment::Clouds => "# topics of 64 KiB x 2 subscriptions x 100 Hz",
        Experiment::Sizes => "payloads of # bytes at 100 Hz, written and read in part",
    }
}

/// A line for each question, a column for each size: medians; with an aim for another column of the report, that one.
fn document(experiment: Experiment, rows: &[&Reading]) -> String {
    let mut sizes = distinct(rows.iter().map(|row| row.size).filter(|size| *size > 0));
    sizes.sort_unstable();
    let line = |(system, what): (&'static str, &String)| {
        let same: Vec<&Reading> =
            rows.iter().filter(|row| (row.system, &row.what) == (system, what)).copied().collect();
        let of = same.iter().find_map(|row| row.aim).map_or(Column::P50, |aim| aim.of);
        let cell = |size: &u64| {
            // One that holds for all sizes together stands in the last column.
            let is_here =
                |row: &&&Reading| row.size == *size || (row.size == 0 && Some(size) == sizes.last());
            let Some(row) = same.iter().find(is_here) else { return String::new() };
            let is_missed = row.aim.is_some_and(|aim| aim.is_met == Some(false));
            let number = row.column(of).map_or("-".to_owned(), shown);
            number + if is_missed { " (missed)" } else { "" }
        };
        let system = if system == "tautline" { String::new() } else { format!("{system}: ") };
        let column = if of == Column::P50 { String::new() } else { format!(", {}", of.name()) };
        let title = format!("{system}{what}{column}, {}", same[0].unit);
        [title, limits(&same)].into_iter().chain(sizes.iter().map(cell)).collect()
    };
    let titles = [heading(experiment), "at most"].map(str::to_owned).into_iter();
    let titles = titles.chain(sizes.iter().map(u64::to_string));
    markdown(titles, 2, distinct(rows.iter().map(|row| (row.system, &row.what))).into_iter().map(line))
}

/// One limit if it is that of all, else each with its size.
fn limits(rows: &[&Reading]) -> String {
    let limit = |row: &&Reading| Some((row.size, shown(row.aim?.at_most?)));
    let limits: Vec<(u64, String)> = rows.iter().filter_map(limit).collect();
    match &limits[..] {
        [(_, first), ..] if limits.len() == rows.len() && limits.iter().all(|(_, limit)| limit == first) => {
            first.clone()
        }
        _ => limits.iter().map(|(size, limit)| format!("{size}: {limit}")).collect::<Vec<_>>().join("; "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_harness::Distribution;
    use tautline_harness::readings::Aim;

    #[test]
    fn the_documents_tables_have_a_column_for_each_size() {
        let mut times = Distribution::new();
        (1..=200).for_each(|time| times.record(time * 330));
        let row = |size, what: &str| Reading::of(Experiment::Processes, size, what, "µs");
        let judged = |reading: Reading, of, at_most: f64, is_met| {
            let (at_most, is_met) = (Some(at_most), Some(is_met));
            Reading { aim: Some(Aim { at_most, at_least: None, of, is_met, must: false }), ..reading }
        };
        let rows = vec![
            row(1, "a look").times(&times),
            judged(row(60, "a look").times(&times), Column::Max, 50.0, false),
            judged(row(1, "files").value(2.0), Column::P50, 0.0, false),
            judged(row(60, "files").value(0.0), Column::P50, 0.0, true),
            row(0, "of all").value(7.0),
            Reading::of(Experiment::Load, 200, "publishing", "µs").system("iceoryx2").value(4321.0),
        ];
        let (machine, versions, disturbance) = (String::new(), String::new(), String::new());
        let (open_files, realtime, quick, verdicts) = (1024, true, true, Vec::new());
        let tables =
            Report { machine, versions, open_files, disturbance, realtime, quick, rows, verdicts }.document();
        for line in [
            "| # processes with the ten endpoints of every ROS node each | at most | 1 | 60 |\n|---|---|--:|--:|\n",
            "| a look, max, µs | 60: 50.0 | 66.0 | 66.0 (missed) |\n",
            "| files, µs | 0 | 2.00 (missed) | 0 |\n",
            "| of all, µs |  |  | 7.00 |\n",
            "| # topics x 2 subscriptions x 100 Hz | at most | 200 |\n",
            "| iceoryx2: publishing, µs |  | 4321 |\n",
        ] {
            assert!(tables.contains(line), "{line}\n{tables}");
        }
    }
}

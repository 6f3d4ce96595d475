// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table, the JSON, and whether aims are met. A missed aim is printed, not an error, because it depends on the machine.

use crate::Experiment;
use clap::ValueEnum;
use serde::Serialize;
use tautline_benches::claims::Verdict;
use tautline_benches::table::Column::{Number, Words};
use tautline_benches::table::{Cell, Table};
use tautline_benches::{Distribution, Disturbance, machine, version_of};

/// One measurement at one size.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub experiment: String,
    /// Processes, topics or subscriptions, depending on the experiment; 0: the experiment as a whole.
    pub size: u64,
    pub system: &'static str,
    pub what: String,
    pub unit: &'static str,
    pub n: u64,
    /// The median, or a single value.
    pub p50: f64,
    pub p99: Option<f64>,
    pub p999: Option<f64>,
    pub max: Option<f64>,
    pub aim: Option<Aim>,
}

/// An upper bound.
#[derive(Clone, Debug, Serialize)]
pub struct Aim {
    pub at_most: f64,
    /// The judged column.
    pub of: &'static str,
    pub is_met: bool,
}

impl Row {
    pub fn of(experiment: Experiment, size: usize, what: impl Into<String>, unit: &'static str) -> Self {
        Row {
            experiment: experiment.name(),
            size: size as u64,
            system: "tautline",
            what: what.into(),
            unit,
            n: 1,
            p50: f64::NAN,
            p99: None,
            p999: None,
            max: None,
            aim: None,
        }
    }

    pub fn system(mut self, system: &'static str) -> Self {
        self.system = system;
        self
    }

    /// A single number.
    pub fn value(mut self, value: f64) -> Self {
        self.p50 = value;
        self
    }

    /// Times, in units of the given number of µs.
    pub fn times_in(mut self, times: &Distribution, unit_us: f64) -> Self {
        self.n = times.len();
        let enough_for =
            |quantile: f64, least: u64| (times.len() >= least).then(|| times.quantile_us(quantile) / unit_us);
        (self.p50, self.p99) = (times.quantile_us(0.5) / unit_us, enough_for(0.99, 100));
        (self.p999, self.max) = (enough_for(0.999, 1000), Some(times.max_us() / unit_us));
        self
    }

    /// Times in µs.
    pub fn times(self, times: &Distribution) -> Self {
        self.times_in(times, 1.0)
    }

    /// Sets an upper bound of the value or median.
    pub fn at_most(self, at_most: f64) -> Self {
        let p50 = self.p50;
        self.judged("p50", Some(p50), at_most)
    }

    /// Sets an upper bound of the 99th percentile, or of the maximum below 100 times.
    pub fn p99_at_most(self, at_most: f64) -> Self {
        let (p99, max) = (self.p99, self.max);
        match p99 {
            Some(_) => self.judged("p99", p99, at_most),
            None => self.judged("max", max, at_most),
        }
    }

    pub fn max_at_most(self, at_most: f64) -> Self {
        let max = self.max;
        self.judged("max", max, at_most)
    }

    fn judged(mut self, of: &'static str, number: Option<f64>, at_most: f64) -> Self {
        self.aim = Some(Aim { at_most, of, is_met: number.is_some_and(|number| number <= at_most) });
        self
    }
}

/// The result of a run.
#[derive(Serialize)]
pub struct Report {
    machine: String,
    versions: String,
    /// The limit per process.
    open_files: u64,
    disturbance: String,
    realtime: bool,
    quick: bool,
    rows: Vec<Row>,
}

impl Report {
    pub fn new(quick: bool, realtime: bool, open_files: u64) -> Self {
        let version = |package| version_of(package).unwrap_or("?");
        let versions = format!("tautline {}, iceoryx2 {}", version("tautline"), version("iceoryx2"));
        let disturbance = String::new();
        Report { machine: machine(), versions, open_files, disturbance, realtime, quick, rows: Vec::new() }
    }

    pub fn add(&mut self, rows: Vec<Row>) {
        self.rows.extend(rows);
    }

    pub fn finish(&mut self, disturbance: &Disturbance) {
        self.disturbance = disturbance.report();
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
        for &experiment in Experiment::value_variants() {
            let name = experiment.name();
            let rows: Vec<_> = self.rows.iter().filter(|row| row.experiment == name).collect();
            if !rows.is_empty() {
                println!("\n{}\n{}", title(experiment), table(&rows));
            }
        }
        println!();
        for row in &self.rows {
            if let Some(aim) = &row.aim {
                let number = match aim.of {
                    "p99" => row.p99.unwrap_or(f64::NAN),
                    "max" => row.max.unwrap_or(f64::NAN),
                    _ => row.p50,
                };
                let size = if row.size == 0 { String::new() } else { format!(" {}", row.size) };
                let claim = format!("{}{size}: {}", row.experiment, row.what);
                let found = format!("{} {}, at most {}", shown(number), row.unit, shown(aim.at_most));
                println!("{}", Verdict::new(claim, found, Some(aim.is_met)));
            }
        }
    }
}

fn title(experiment: Experiment) -> String {
    let help = experiment.to_possible_value().and_then(|value| value.get_help().map(ToString::to_string));
    format!("{}: {}", experiment.name(), help.unwrap_or_default())
}

fn table(rows: &[&Row]) -> Table {
    let words = [Number("size"), Words("system"), Words("what"), Words("unit")];
    let numbers = ["n", "p50 / value", "p99", "p99.9", "max"].map(Number);
    let mut table = Table::new(1, [&words[..], &numbers, &[Words("aim")]].concat());
    for row in rows {
        let words: [Cell; 5] =
            [row.size.into(), row.system.into(), (&row.what).into(), row.unit.into(), row.n.into()];
        let numbers = [Some(row.p50), row.p99, row.p999, row.max];
        let numbers = numbers.map(|number| number.map_or(String::new(), shown).into());
        let aim = row.aim.as_ref().map_or(String::new(), |aim| {
            format!("{} <= {} {}", aim.of, shown(aim.at_most), if aim.is_met { "holds" } else { "MISSED" })
        });
        table.add(words.into_iter().chain(numbers).chain([aim.into()]));
    }
    table
}

/// With significant digits only.
fn shown(number: f64) -> String {
    match number.abs() {
        size if size == 0.0 || size >= 1000.0 => format!("{number:.0}"),
        size if size >= 10.0 => format!("{number:.1}"),
        _ => format!("{number:.2}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aims_are_judged_by_the_column_that_they_name() {
        let mut times = Distribution::new();
        (1..=200).for_each(|time| times.record(time * 1000));
        let row = || Row::of(Experiment::Storm, 1, "x", "µs").times(&times);
        let is_met = |row: Row| row.aim.is_some_and(|aim| aim.is_met);
        assert!(is_met(row().at_most(101.0)) && !is_met(row().at_most(99.0)));
        assert!(is_met(row().p99_at_most(199.0)) && !is_met(row().p99_at_most(190.0)));
        assert!(is_met(row().max_at_most(201.0)) && !is_met(row().max_at_most(199.0)));
        assert!(row().p999.is_none(), "too few for that");
        assert!(!is_met(Row::of(Experiment::Storm, 1, "x", "µs").at_most(1.0)), "nothing was measured");
    }
}

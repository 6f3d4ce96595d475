// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table, the JSON, and whether aims are met. A miss is printed, never an error: the machine has its part in it.

use crate::Experiment;
use clap::ValueEnum;
use serde::Serialize;
use tautline_benches::claims::Verdict;
use tautline_benches::table::Column::{Number, Words};
use tautline_benches::table::Table;
use tautline_benches::{Distribution, cells, machine, version_of};

/// One thing that was measured at one size.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    pub experiment: String,
    /// Processes, topics or subscriptions, as the experiment has them; 0: of the experiment as a whole.
    pub size: u64,
    pub system: &'static str,
    pub what: String,
    pub unit: &'static str,
    pub n: u64,
    /// The median, or the value if it is one.
    pub p50: f64,
    pub p99: Option<f64>,
    pub p999: Option<f64>,
    pub max: Option<f64>,
    pub aim: Option<Aim>,
}

#[derive(Clone, Debug, Serialize)]
pub struct Aim {
    pub at_most: f64,
    /// The column that is judged.
    pub of: &'static str,
    pub is_met: bool,
    #[serde(skip)]
    number: Option<f64>,
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

    pub fn value(mut self, value: f64) -> Self {
        self.p50 = value;
        self
    }

    /// Times, in units of so many µs.
    pub fn times_in(mut self, times: &Distribution, unit_us: f64) -> Self {
        self.n = times.len();
        let enough_for =
            |quantile: f64, least: u64| (times.len() >= least).then(|| times.quantile_us(quantile) / unit_us);
        (self.p50, self.p99) = (times.quantile_us(0.5) / unit_us, enough_for(0.99, 100));
        (self.p999, self.max) = (enough_for(0.999, 1000), Some(times.max_us() / unit_us));
        self
    }

    pub fn times(self, times: &Distribution) -> Self {
        self.times_in(times, 1.0)
    }

    /// A value, or a median, that is to be at most so much.
    pub fn at_most(self, at_most: f64) -> Self {
        let p50 = Some(self.p50);
        self.judged("p50", p50, at_most)
    }

    /// The 99th percentile, of fewer than 100 times the longest.
    pub fn p99_at_most(self, at_most: f64) -> Self {
        match self.p99 {
            None => self.max_at_most(at_most),
            p99 => self.judged("p99", p99, at_most),
        }
    }

    pub fn max_at_most(self, at_most: f64) -> Self {
        let max = self.max;
        self.judged("max", max, at_most)
    }

    fn judged(mut self, of: &'static str, number: Option<f64>, at_most: f64) -> Self {
        let is_met = number.is_some_and(|number| number <= at_most);
        self.aim = Some(Aim { at_most, of, is_met, number });
        self
    }
}

#[derive(Serialize)]
pub struct Report {
    machine: String,
    versions: String,
    /// The limit of each process.
    open_files: u64,
    pub disturbance: String,
    realtime: bool,
    quick: bool,
    pub rows: Vec<Row>,
}

impl Report {
    pub fn new(quick: bool, realtime: bool, open_files: u64) -> Self {
        let version = |package| version_of(package).unwrap_or("?");
        let versions = format!("tautline {}, iceoryx2 {}", version("tautline"), version("iceoryx2"));
        let disturbance = String::new();
        Report { machine: machine(), versions, open_files, disturbance, realtime, quick, rows: Vec::new() }
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
                let number = aim.number.unwrap_or(f64::NAN);
                let size = if row.size == 0 { String::new() } else { format!(" {}", row.size) };
                let claim = format!("{}{size}: {}", row.experiment, row.what);
                // A number by itself is no percentile.
                let of = if row.n > 0 { format!("{} ", aim.of) } else { String::new() };
                let found = format!("{of}{} {}, at most {}", shown(number), row.unit, shown(aim.at_most));
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
    let mut table = Table::new(1, [&words[..], &numbers].concat());
    for row in rows {
        let numbers = [Some(row.p50), row.p99, row.p999, row.max];
        let [p50, p99, p999, max] = numbers.map(|number| number.map_or(String::new(), shown));
        table.add(cells![row.size, row.system, &row.what, row.unit, row.n, p50, p99, p999, max]);
    }
    table
}

/// With as many digits as say something.
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

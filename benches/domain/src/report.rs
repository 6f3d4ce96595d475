// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table, the JSON, and whether aims are met. A miss is printed, never an error: the machine has its part in it.

use crate::Experiment;
use clap::ValueEnum;
use serde::Serialize;
use tautline_benches::claims::Verdict;
use tautline_benches::table::Column::{Number, Words};
use tautline_benches::table::{Table, distinct, markdown, short};
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
        self.judged("p50", at_most)
    }

    /// The 99th percentile, of fewer than 100 times the longest.
    pub fn p99_at_most(self, at_most: f64) -> Self {
        match self.p99 {
            None => self.max_at_most(at_most),
            Some(_) => self.judged("p99", at_most),
        }
    }

    pub fn max_at_most(self, at_most: f64) -> Self {
        self.judged("max", at_most)
    }

    /// A column, by its name.
    fn column(&self, name: &str) -> Option<f64> {
        match name {
            "p99" => self.p99,
            "max" => self.max,
            _ => Some(self.p50),
        }
    }

    fn judged(mut self, of: &'static str, at_most: f64) -> Self {
        let number = self.column(of);
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

    /// Those that were measured, each with its rows.
    fn experiments(&self) -> impl Iterator<Item = (Experiment, Vec<&Row>)> {
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
            println!("\n{}\n{}", title(experiment), table(&rows));
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

fn shown(number: f64) -> String {
    if number == 0.0 { "0".to_owned() } else { short(number) }
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
    }
}

/// A line for each question, a column for each size: medians; with an aim for another column of the report, that one.
fn document(experiment: Experiment, rows: &[&Row]) -> String {
    let mut sizes = distinct(rows.iter().map(|row| row.size).filter(|size| *size > 0));
    sizes.sort_unstable();
    let line = |(system, what): (&'static str, &String)| {
        let same: Vec<&Row> =
            rows.iter().filter(|row| (row.system, &row.what) == (system, what)).copied().collect();
        let of = same.iter().find_map(|row| row.aim.as_ref()).map_or("p50", |aim| aim.of);
        let cell = |size: &u64| {
            // One that holds for all sizes together stands in the last column.
            let is_here = |row: &&&Row| row.size == *size || (row.size == 0 && Some(size) == sizes.last());
            let Some(row) = same.iter().find(is_here) else { return String::new() };
            let is_missed = row.aim.as_ref().is_some_and(|aim| !aim.is_met);
            let number = row.column(of).map_or("-".to_owned(), shown);
            number + if is_missed { " (missed)" } else { "" }
        };
        let system = if system == "tautline" { String::new() } else { format!("{system}: ") };
        let column = if of == "p50" { String::new() } else { format!(", {of}") };
        let title = format!("{system}{what}{column}, {}", same[0].unit);
        [title, limits(&same)].into_iter().chain(sizes.iter().map(cell)).collect()
    };
    let titles = [heading(experiment), "at most"].map(str::to_owned).into_iter();
    let titles = titles.chain(sizes.iter().map(u64::to_string));
    markdown(titles, 2, distinct(rows.iter().map(|row| (row.system, &row.what))).into_iter().map(line))
}

/// One limit if it is that of all, else each with its size.
fn limits(rows: &[&Row]) -> String {
    let limit = |row: &&Row| row.aim.as_ref().map(|aim| (row.size, shown(aim.at_most)));
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

    #[test]
    fn the_documents_tables_have_a_column_for_each_size() {
        let mut times = Distribution::new();
        (1..=200).for_each(|time| times.record(time * 330));
        let row = |size, what: &str| Row::of(Experiment::Processes, size, what, "µs");
        let mut report = Report::new(true, true, 1024);
        report.rows = vec![
            row(1, "a look").times(&times),
            row(60, "a look").times(&times).max_at_most(50.0),
            row(1, "files").value(2.0).at_most(0.0),
            row(60, "files").value(0.0).at_most(0.0),
            row(0, "of all").value(7.0),
            Row::of(Experiment::Load, 200, "publishing", "µs").system("iceoryx2").value(4321.0),
        ];
        let tables = report.document();
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

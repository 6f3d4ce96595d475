// SPDX-License-Identifier: MIT OR Apache-2.0
//! The table, the JSON, and whether aims are met. A miss is printed, never an error: the machine has its part in it.

use crate::Experiment;
use clap::ValueEnum;
use serde::Serialize;
use tautline_benches::claims::{Aim, Column, Verdict};
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
    pub aim: Option<Judged>,
}

/// An aim, and whether it is met.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Judged {
    pub at_most: f64,
    /// The column that is judged.
    pub of: Column,
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

    fn column(&self, column: Column) -> Option<f64> {
        match column {
            Column::P50 => Some(self.p50),
            Column::P99 => self.p99,
            Column::Max => self.max,
        }
    }

    fn judge(&mut self, aim: &Aim) -> Verdict {
        let of = if aim.of == Column::P99 && self.p99.is_none() { Column::Max } else { aim.of };
        let number = self.column(of);
        let is_met = number.is_some_and(|number| number <= aim.at_most);
        self.aim = Some(Judged { at_most: aim.at_most, of, is_met });
        let size = if self.size == 0 { String::new() } else { format!(" {}", self.size) };
        let rival = if self.system == "tautline" { String::new() } else { format!(", {}", self.system) };
        let claim = format!("{}{size}{rival}: {}", self.experiment, self.what);
        let column = if self.n > 1 { of.name() } else { "it is" };
        let (number, most) = (number.map_or("-".to_owned(), shown), shown(aim.at_most));
        Verdict::new(claim, format!("{column} {number} {}, at most {most}", self.unit), Some(is_met))
    }
}

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
    rows: Vec<Row>,
    #[serde(skip)]
    verdicts: Vec<Verdict>,
}

impl Report {
    /// Judges the rows of experiments, each at its sizes.
    pub fn new(mut rows: Vec<Row>, aims: &[Aim], circumstances: Circumstances) -> Self {
        let measured = distinct(rows.iter().map(|row| (row.experiment.clone(), row.size)));
        let mut verdicts = Vec::new();
        for aim in aims.iter().filter(|aim| measured.iter().any(|(of, size)| aim.is_of(of, *size))) {
            let is_it = |row: &&mut Row| row.what == aim.what && aim.is_of(&row.experiment, row.size);
            let before = verdicts.len();
            verdicts.extend(rows.iter_mut().filter(is_it).map(|row| row.judge(aim)));
            if verdicts.len() == before {
                verdicts.push(Verdict::new(&aim.what, "not measured", None));
            }
        }
        let Circumstances { open_files, disturbance, realtime, quick } = circumstances;
        let version = |package| version_of(package).unwrap_or("?");
        let versions = format!("tautline {}, iceoryx2 {}", version("tautline"), version("iceoryx2"));
        Report { machine: machine(), versions, open_files, disturbance, realtime, quick, rows, verdicts }
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
        self.verdicts.iter().for_each(|verdict| println!("{verdict}"));
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
        let of = same.iter().find_map(|row| row.aim).map_or(Column::P50, |aim| aim.of);
        let cell = |size: &u64| {
            // One that holds for all sizes together stands in the last column.
            let is_here = |row: &&&Row| row.size == *size || (row.size == 0 && Some(size) == sizes.last());
            let Some(row) = same.iter().find(is_here) else { return String::new() };
            let is_missed = row.aim.is_some_and(|aim| !aim.is_met);
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
fn limits(rows: &[&Row]) -> String {
    let limit = |row: &&Row| row.aim.map(|aim| (row.size, shown(aim.at_most)));
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
    use tautline_benches::claims::aims;

    fn report(rows: Vec<Row>, aims: &[Aim]) -> Report {
        let disturbance = String::new();
        let circumstances = Circumstances { open_files: 1024, disturbance, realtime: true, quick: true };
        Report::new(rows, aims, circumstances)
    }

    fn aim(what: &str, of: Column, at_most: f64) -> Aim {
        Aim { what: what.to_owned(), of, at_most, ..Aim::default() }
    }

    #[test]
    fn aims_are_judged_by_the_column_that_they_name() {
        let mut times = Distribution::new();
        (1..=200).for_each(|time| times.record(time * 1000));
        let row = || Row::of(Experiment::Storm, 1, "x", "µs").times(&times);
        let holds = |row: Row, of, at_most| report(vec![row], &[aim("x", of, at_most)]).verdicts[0].holds;
        for (of, number) in [(Column::P50, 100.0), (Column::P99, 198.0), (Column::Max, 200.0)] {
            assert_eq!(holds(row(), of, number + 1.0), Some(true));
            assert_eq!(holds(row(), of, number - 1.0), Some(false));
        }
        let mut few = Distribution::new();
        few.record(7000);
        let few = Row::of(Experiment::Storm, 1, "x", "µs").times(&few);
        assert_eq!(holds(few, Column::P99, 6.0), Some(false), "the longest");
        assert!(row().p999.is_none(), "too few for that");
        assert_eq!(holds(Row::of(Experiment::Storm, 1, "x", "µs"), Column::P50, 1.0), Some(false), "nothing");
        assert_eq!(holds(Row::of(Experiment::Storm, 1, "y", "µs"), Column::P50, 1.0), None, "not measured");
    }

    #[test]
    fn the_aims_of_the_file_are_about_these_experiments() {
        let names: Vec<String> = Experiment::value_variants().iter().map(|one| one.name()).collect();
        for aim in aims().unwrap() {
            assert!(aim.experiments.iter().all(|name| names.contains(name)), "{aim:?}");
        }
    }

    #[test]
    fn the_documents_tables_have_a_column_for_each_size() {
        let mut times = Distribution::new();
        (1..=200).for_each(|time| times.record(time * 330));
        let row = |size, what: &str| Row::of(Experiment::Processes, size, what, "µs");
        let rows = vec![
            row(1, "a look").times(&times),
            row(60, "a look").times(&times),
            row(1, "files").value(2.0),
            row(60, "files").value(0.0),
            row(0, "of all").value(7.0),
            Row::of(Experiment::Load, 200, "publishing", "µs").system("iceoryx2").value(4321.0),
        ];
        let of_looks = Aim { sizes: vec![60], ..aim("a look", Column::Max, 50.0) };
        let tables = report(rows, &[of_looks, aim("files", Column::P50, 0.0)]).document();
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

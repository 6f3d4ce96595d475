// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a bench measured in other units than those of `rows`: a number or times, at one size.

use serde::Serialize;

use crate::Distribution;
use crate::table::Column::{Number, Words};
use crate::table::{Cell, Shown, Table, short, shown_of};
use crate::verdict::Verdict;

/// The column of a reading that is judged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Column {
    /// The median, or the number if it is one.
    #[default]
    P50,
    /// Of fewer than 100 times the longest.
    P99,
    P999,
    Max,
}

impl Column {
    pub fn name(self) -> &'static str {
        match self {
            Column::P50 => "p50",
            Column::P99 => "p99",
            Column::P999 => "p99.9",
            Column::Max => "max",
        }
    }
}

/// What a reading shall be, and whether it is.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Aim {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_most: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_least: Option<f64>,
    /// The column that is judged.
    pub of: Column,
    /// `None`: it is not judged.
    pub is_met: Option<bool>,
    /// Whether a miss is an error.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub must: bool,
}

/// One thing that was measured at one size.
#[derive(Clone, Debug, Serialize)]
pub struct Reading {
    pub experiment: String,
    /// Processes, topics, subscriptions or what else the experiment has; 0: of the experiment as a whole.
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
    #[serde(skip_serializing_if = "String::is_empty")]
    pub note: String,
    /// Why it must not be judged.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unfit: Option<String>,
    pub aim: Option<Aim>,
}

impl Reading {
    pub fn of(
        experiment: impl Into<String>,
        size: usize,
        what: impl Into<String>,
        unit: &'static str,
    ) -> Self {
        Reading {
            experiment: experiment.into(),
            size: size as u64,
            system: "tautline",
            what: what.into(),
            unit,
            n: 1,
            p50: f64::NAN,
            p99: None,
            p999: None,
            max: None,
            note: String::new(),
            unfit: None,
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

    pub fn note(mut self, note: impl Into<String>) -> Self {
        self.note = note.into();
        self
    }

    /// Not to be judged if there is a reason.
    pub fn unfit(mut self, reason: Option<&str>) -> Self {
        self.unfit = reason.map(str::to_owned);
        self
    }

    /// Its median, or the number, shall be at most this; no goal if there is none.
    pub fn at_most(self, limit: impl Into<Option<f64>>) -> Self {
        self.at_most_of(Column::P50, limit)
    }

    /// Like [`at_most`](Self::at_most), of another column.
    pub fn at_most_of(mut self, of: Column, limit: impl Into<Option<f64>>) -> Self {
        if let Some(limit) = limit.into() {
            self.aim = Some(Aim { at_most: Some(limit), of, ..self.aim.unwrap_or_default() });
        }
        self
    }

    /// Its median, or the number, shall be at least this.
    pub fn at_least(mut self, limit: f64) -> Self {
        self.aim = Some(Aim { at_least: Some(limit), ..self.aim.unwrap_or_default() });
        self
    }

    /// Missing its goal fails the bench, as no machine has a part in it.
    pub fn must(mut self) -> Self {
        self.aim = self.aim.map(|aim| Aim { must: true, ..aim });
        self
    }

    pub fn column(&self, column: Column) -> Option<f64> {
        match column {
            Column::P50 => Some(self.p50),
            Column::P99 => self.p99,
            Column::P999 => self.p999,
            Column::Max => self.max,
        }
    }

    /// For people.
    pub fn name(&self) -> String {
        let size = if self.size == 0 { String::new() } else { format!(" {}", self.size) };
        let rival = if self.system == "tautline" { String::new() } else { format!(", {}", self.system) };
        format!("{}{size}{rival}: {}", self.experiment, self.what)
    }

    /// Notes in its aim whether it is met. `None`: it has no aim.
    fn judge(&mut self) -> Option<Verdict> {
        let mut aim = self.aim?;
        if aim.of == Column::P99 && self.p99.is_none() {
            aim.of = Column::Max;
        }
        let number = self.column(aim.of).filter(|number| number.is_finite());
        let is_within = |number: f64| {
            aim.at_most.is_none_or(|most| number <= most) && aim.at_least.is_none_or(|least| number >= least)
        };
        aim.is_met = self.unfit.is_none().then(|| number.is_some_and(is_within));
        self.aim = Some(aim);
        let column = if self.n > 1 { format!("{} ", aim.of.name()) } else { String::new() };
        let limits = [("at least", aim.at_least), ("at most", aim.at_most)].into_iter();
        let limits = limits.filter_map(|(bound, limit)| Some(format!("{bound} {}", shown(limit?))));
        let notes = [Some(&self.note), self.unfit.as_ref()].into_iter().flatten();
        Some(Verdict {
            what: self.name(),
            figure: format!("{column}{} {}", number.map_or("-".to_owned(), shown), self.unit),
            goal: limits.collect::<Vec<_>>().join(", "),
            outcome: aim.is_met.into(),
            note: notes.filter(|note| !note.is_empty()).cloned().collect::<Vec<_>>().join("; "),
            cause: None,
            must: aim.must,
        })
    }
}

/// Judges the readings that have aims, and notes in these whether they are met.
pub fn judge(readings: &mut [Reading]) -> Vec<Verdict> {
    readings.iter_mut().filter_map(Reading::judge).collect()
}

const SHOWN: [Shown<Reading>; 10] = [
    (Number("size"), |one| if one.size == 0 { "all".into() } else { one.size.into() }),
    (Words("system"), |one| one.system.into()),
    (Words("what"), |one| one.what.as_str().into()),
    (Words("unit"), |one| one.unit.into()),
    (Number("n"), |one| one.n.into()),
    (Number("p50 / value"), |one| shown(one.p50).into()),
    (Number("p99"), |one| digits(one.p99)),
    (Number("p99.9"), |one| digits(one.p999)),
    (Number("max"), |one| digits(one.max)),
    (Words("note"), |one| one.note.as_str().into()),
];

/// Of one experiment; without their sizes if it has none.
pub fn table<'r>(readings: impl IntoIterator<Item = &'r Reading> + Clone) -> Table {
    let has_sizes = readings.clone().into_iter().any(|one| one.size > 0);
    if has_sizes { shown_of(1, &SHOWN, readings) } else { shown_of(0, &SHOWN[1..], readings) }
}

fn digits(number: Option<f64>) -> Cell {
    number.map_or(String::new(), shown).into()
}

/// As in the table.
pub fn shown(number: f64) -> String {
    match number {
        0.0 => "0".to_owned(),
        number if number.is_nan() => "-".to_owned(),
        number => short(number),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verdict::Outcome::{self, Held, Missed, NotMeasured};

    fn reading() -> Reading {
        Reading::of("storm", 1, "x", "µs")
    }

    fn outcome(reading: Reading) -> Outcome {
        judge(&mut [reading])[0].outcome
    }

    #[test]
    fn a_reading_is_judged_by_the_column_that_its_aim_names() {
        let mut times = Distribution::new();
        (1..=200).for_each(|time| times.record(time * 1000));
        for (of, number) in [(Column::P50, 100.0), (Column::P99, 198.0), (Column::Max, 200.0)] {
            let outcome = |limit: f64| outcome(reading().times(&times).at_most_of(of, limit));
            assert_eq!((outcome(number + 1.0), outcome(number - 1.0)), (Held, Missed));
        }
        let mut few = Distribution::new();
        few.record(7000);
        assert_eq!(outcome(reading().times(&few).at_most_of(Column::P99, 6.0)), Missed, "the longest");
    }

    #[test]
    fn what_is_missing_or_unfit_meets_no_aim() {
        let of = |number: f64| reading().value(number).at_least(0.99).at_most(1.01);
        let outcomes = [0.98, 1.0, 1.02, f64::NAN].map(|number| outcome(of(number)));
        assert_eq!(outcomes, [Missed, Held, Missed, Missed]);
        assert!(judge(&mut [reading().value(1.0).at_most(None).must()]).is_empty(), "it has no aim");
        let mut unfit = [of(1.0).note("of two").unfit(Some("it was late"))];
        let verdict = judge(&mut unfit).remove(0);
        assert_eq!((verdict.outcome, unfit[0].aim.unwrap().is_met), (NotMeasured, None));
        assert_eq!(
            verdict.to_string(),
            "not measured  storm 1: x: 1.00 µs; at least 0.99, at most 1.01; of two; it was late"
        );
    }
}

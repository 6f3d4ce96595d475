// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a bench measured in other units than those of `rows`: a number or times, at one size.

use serde::Serialize;

use crate::Distribution;
use crate::claims::{Column, Judged};
use crate::table::Column::{Number, Words};
use crate::table::{Cell, Shown, Table, short, shown_of};

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
    pub aim: Option<Judged>,
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

    pub fn column(&self, column: Column) -> Option<f64> {
        match column {
            Column::P50 => Some(self.p50),
            Column::P99 => self.p99,
            Column::Max => self.max,
        }
    }

    /// For people.
    pub fn name(&self) -> String {
        let size = if self.size == 0 { String::new() } else { format!(" {}", self.size) };
        let rival = if self.system == "tautline" { String::new() } else { format!(", {}", self.system) };
        format!("{}{size}{rival}: {}", self.experiment, self.what)
    }
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

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Aims: what a [`Reading`] shall be.

use super::{BadClaims, FILE, File, Names, Verdict};
use crate::readings::{Reading, shown};
use crate::table::distinct;
use serde::{Deserialize, Serialize};

/// A bench that has readings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Aimed {
    Alks,
    Bridge,
    Budgets,
    Domain,
    Paper,
    Tools,
}

/// As it is written.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub(super) struct Aim {
    /// None: all.
    #[serde(default)]
    what: Names,
    /// None: all.
    #[serde(default)]
    experiment: Names,
    /// None: all.
    #[serde(default)]
    sizes: Vec<u64>,
    #[serde(default)]
    of: Column,
    at_most: Option<f64>,
    at_least: Option<f64>,
    /// Whether a miss is an error.
    #[serde(default)]
    must: bool,
}

/// The column of a reading that is judged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Column {
    /// The median, or the number if it is one.
    #[default]
    P50,
    /// Of fewer than 100 times the longest.
    P99,
    Max,
}

impl Column {
    pub fn name(self) -> &'static str {
        match self {
            Column::P50 => "p50",
            Column::P99 => "p99",
            Column::Max => "max",
        }
    }
}

/// An aim of a reading, and whether it is met.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Judged {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_most: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at_least: Option<f64>,
    /// The column that is judged.
    pub of: Column,
    /// `None`: it cannot be judged.
    pub is_met: Option<bool>,
    /// Whether a miss is an error.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub must: bool,
}

/// Judges readings of a bench that has these experiments by the aims of `claims.toml`, and notes these in them.
///
/// # Errors
/// The file says what cannot be judged.
pub fn judge(
    bench: Aimed,
    experiments: &[String],
    readings: &mut [Reading],
) -> Result<Vec<Verdict>, BadClaims> {
    judge_by(FILE, bench, experiments, readings)
}

/// Judges a reading by a bound that was computed, which the file cannot know.
pub fn judge_by_bound(reading: &mut Reading, of: Column, bound: f64) -> Verdict {
    Aim { of, at_most: Some(bound), ..Aim::default() }.judge(reading)
}

fn judge_by(
    text: &str,
    bench: Aimed,
    experiments: &[String],
    readings: &mut [Reading],
) -> Result<Vec<Verdict>, BadClaims> {
    let file: File = toml::from_str(text).map_err(|error| BadClaims(error.to_string()))?;
    let measured = distinct(readings.iter().map(|one| (one.experiment.clone(), one.size)));
    let mut verdicts = Vec::new();
    for aim in file.aims.get(&bench).into_iter().flatten() {
        aim.check(experiments).map_err(|what| BadClaims(format!("{aim:?}: {what}")))?;
        let is_it = |one: &&mut Reading| aim.is_about(one);
        verdicts.extend(readings.iter_mut().filter(is_it).map(|one| aim.judge(one)));
        let covered = measured.iter().filter(|(experiment, size)| aim.is_of(experiment, *size));
        for experiment in distinct(covered.map(|(experiment, _)| experiment)) {
            let of_it =
                |one: &&Reading| one.experiment == *experiment && aim.is_of(&one.experiment, one.size);
            let is_there = |what: &&String| readings.iter().filter(of_it).any(|one| one.what == **what);
            verdicts.extend(aim.what.of().iter().filter(|what| !is_there(what)).map(|what| {
                let holds = aim.must.then_some(false);
                let verdict = Verdict::new(format!("{experiment}: {what}"), "not measured", holds);
                Verdict { is_must: aim.must, ..verdict }
            }));
        }
    }
    Ok(verdicts)
}

impl Aim {
    fn check(&self, experiments: &[String]) -> Result<(), String> {
        if self.at_most.or(self.at_least).is_none() {
            return Err("say 'at-most' or 'at-least'".to_owned());
        }
        match self.experiment.of().iter().find(|name| !experiments.contains(name)) {
            Some(name) => Err(format!("there is no '{name}'; there are {}", experiments.join(", "))),
            None => Ok(()),
        }
    }

    fn is_of(&self, experiment: &str, size: u64) -> bool {
        self.experiment.allow(experiment) && (self.sizes.is_empty() || self.sizes.contains(&size))
    }

    fn is_about(&self, one: &Reading) -> bool {
        self.what.allow(&one.what) && self.is_of(&one.experiment, one.size)
    }

    fn judge(&self, one: &mut Reading) -> Verdict {
        let Aim { at_most, at_least, .. } = *self;
        let of = if self.of == Column::P99 && one.p99.is_none() { Column::Max } else { self.of };
        let number = one.column(of).filter(|number| number.is_finite());
        let is_within = |number: f64| {
            at_most.is_none_or(|most| number <= most) && at_least.is_none_or(|least| number >= least)
        };
        let is_met = one.unfit.is_none().then(|| number.is_some_and(is_within));
        one.aim = Some(Judged { at_most, at_least, of, is_met, must: self.must });
        let column = if one.n > 1 { of.name() } else { "it is" };
        let mut found = format!("{column} {} {}", number.map_or("-".to_owned(), shown), one.unit);
        for (bound, limit) in [("at most", at_most), ("at least", at_least)] {
            found += &limit.map_or(String::new(), |limit| format!(", {bound} {}", shown(limit)));
        }
        for more in [Some(&one.note).filter(|note| !note.is_empty()), one.unfit.as_ref()] {
            found += &more.map_or(String::new(), |more| format!("; {more}"));
        }
        Verdict { is_must: self.must, ..Verdict::new(one.name(), found, is_met) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Distribution;
    use crate::claims::print_verdicts;

    fn aim(fields: &str) -> String {
        format!("claim = []\n[aims]\ndomain = [{{ {fields} }}]\n")
    }

    /// Of the reading `x`, by an aim of these fields.
    fn verdict(fields: &str, mut reading: Reading) -> Verdict {
        let text = aim(&format!("what = 'x', {fields}"));
        let verdicts = judge_by(&text, Aimed::Domain, &[], std::slice::from_mut(&mut reading)).unwrap();
        verdicts.into_iter().next().unwrap()
    }

    fn reading(what: &str) -> Reading {
        Reading::of("storm", 1, what, "µs")
    }

    #[test]
    fn a_reading_is_judged_by_the_column_that_its_aim_names() {
        let mut times = Distribution::new();
        (1..=200).for_each(|time| times.record(time * 1000));
        let all = reading("x").times(&times);
        for (of, number) in [("p50", 100), ("p99", 198), ("max", 200)] {
            let holds = |limit: i32| verdict(&format!("of = '{of}', at-most = {limit}"), all.clone()).holds;
            assert_eq!((holds(number + 1), holds(number - 1)), (Some(true), Some(false)));
        }
        let mut few = Distribution::new();
        few.record(7000);
        let few = reading("x").times(&few);
        assert_eq!(verdict("of = 'p99', at-most = 6.0", few).holds, Some(false), "the longest");
    }

    #[test]
    fn what_is_missing_or_unfit_meets_no_aim() {
        let between = "at-most = 1.01, at-least = 0.99";
        let of = |number| verdict(between, reading("x").value(number)).holds;
        assert_eq!([0.98, 1.0, 1.02, f64::NAN].map(of), [Some(false), Some(true), Some(false), Some(false)]);
        assert_eq!(verdict(between, reading("y")).to_string(), "not judged  storm: x: not measured");
        let must = verdict("at-most = 1, must = true", reading("y"));
        assert_eq!(must.to_string(), "MISSED      storm: x: not measured");
        assert!(print_verdicts(&[must]).unwrap_err().ends_with("must hold: storm: x"));
        let unfit = Reading { unfit: Some("it was late".into()), ..reading("x").value(1.0).note("of two") };
        assert_eq!(
            verdict(between, unfit).to_string(),
            "not judged  storm 1: x: it is 1.00 µs, at most 1.01, at least 0.99; of two; it was late"
        );
    }

    #[test]
    fn a_bad_aim_says_what_would_be_right() {
        let refused = |lines: &str| {
            let experiments = ["storm", "load"].map(str::to_owned);
            judge_by(&aim(lines), Aimed::Domain, &experiments, &mut []).unwrap_err().to_string()
        };
        let unknown = refused("what = 'x', experiment = 'strom', at-most = 1");
        assert!(unknown.ends_with(": there is no 'strom'; there are storm, load"), "{unknown}");
        assert!(refused("of = 'max'").ends_with(": say 'at-most' or 'at-least'"));
        assert!(refused("at-most = 1, wat = 1").contains("unknown field `wat`"));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The claims that must hold between the rows of a run, as `claims.toml` has them, and their judge.

mod aims;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::{Deserialize, Serialize};
use toml::Spanned;

use crate::rows::{By, Compared, Figure, Metric, Row};
use crate::table::{bytes_of, distinct, short, size};

use aims::Aim;
pub use aims::{Aimed, Column, Judged, judge, judge_by_bound};

const FILE: &str = include_str!("../../claims.toml");

/// What must hold, and what was found. `holds` is `None` where that cannot be judged; `found` says why.
#[derive(Clone, Debug, Serialize)]
pub struct Verdict {
    pub claim: String,
    pub found: String,
    pub holds: Option<bool>,
    /// Of a claim that is missed: why it stays so.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Whether the claim is told only where it is missed.
    #[serde(skip)]
    pub is_silent: bool,
    /// Whether a miss is an error: the machine has no part in it.
    #[serde(skip)]
    is_must: bool,
}

impl Verdict {
    /// Of a claim that needs no reason.
    pub fn new(claim: impl Into<String>, found: impl Into<String>, holds: Option<bool>) -> Self {
        let (claim, found) = (claim.into(), found.into());
        Verdict { claim, found, holds, reason: None, is_silent: false, is_must: false }
    }

    pub fn word(&self) -> &'static str {
        match self.holds {
            Some(true) => "holds",
            Some(false) => "MISSED",
            None => "not judged",
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:10}  {}: {}", self.word(), self.claim, self.found)?;
        match &self.reason {
            Some(reason) => write!(f, "; why it stays: {reason}"),
            None => Ok(()),
        }
    }
}

/// The bench whose rows a claim is about.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Bench {
    /// And `network`, `services` and `wake`, which are the same program.
    #[default]
    Compare,
    Deadlines,
    Messages,
    Parameters,
    Rmw,
}

/// What can be measured: what a claim names beside is a mistake, for it would never be judged.
#[derive(Debug, Default)]
pub struct Measurable {
    /// Experiments, each with its payloads in bytes.
    pub payloads: BTreeSet<(String, usize)>,
    /// Systems, each with its modes.
    pub modes: BTreeSet<(String, String)>,
}

impl Measurable {
    /// Of a bench that always measures all.
    pub fn of<'r>(rows: impl Iterator<Item = &'r Row> + Clone) -> Self {
        Measurable {
            payloads: rows.clone().map(|row| (row.experiment.clone(), row.payload_bytes)).collect(),
            modes: rows.map(|row| (row.system.clone(), row.mode.clone())).collect(),
        }
    }
}

/// Prints what must hold between the rows of a bench that always measures all.
///
/// # Errors
/// The file says what cannot be judged, or one that must hold is missed.
pub fn print(bench: Bench, rows: &[Row]) -> crate::Result {
    Ok(print_verdicts(&verdicts(bench, &Measurable::of(rows.iter()), rows)?)?)
}

/// Judges the claims about what was measured, or was to be: those that name an experiment and systems of these rows. Silent ones are
/// among them where they are missed.
///
/// # Errors
/// The file says what cannot be judged.
pub fn verdicts(bench: Bench, measurable: &Measurable, rows: &[Row]) -> Result<Vec<Verdict>, BadClaims> {
    Ok(told(&read(FILE, bench, measurable)?, rows))
}

fn told(claims: &[Claim], rows: &[Row]) -> Vec<Verdict> {
    let judged = claims.iter().filter(|claim| claim.is_about(rows)).map(|claim| claim.judge(rows));
    judged.filter(|verdict| !verdict.is_silent || verdict.holds == Some(false)).collect()
}

/// Prints verdicts.
///
/// # Errors
/// One that must hold is missed.
pub fn print_verdicts(verdicts: &[Verdict]) -> Result<(), String> {
    verdicts.iter().for_each(|verdict| println!("{verdict}"));
    let is_broken = |verdict: &&Verdict| verdict.is_must && verdict.holds == Some(false);
    let broken: Vec<&str> = verdicts.iter().filter(is_broken).map(|verdict| &*verdict.claim).collect();
    if broken.is_empty() { Ok(()) } else { Err(format!("missed, and must hold: {}", broken.join("; "))) }
}

/// What is wrong with the file: where, and what would be right.
#[derive(Debug)]
pub struct BadClaims(String);

impl fmt::Display for BadClaims {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "benches/claims.toml: {}", self.0)
    }
}

impl std::error::Error for BadClaims {}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    claim: Vec<Spanned<Entry>>,
    #[serde(default)]
    reasons: BTreeMap<String, String>,
    #[serde(default)]
    aims: BTreeMap<Aimed, Vec<Aim>>,
}

/// A claim as it is written.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Entry {
    #[serde(default)]
    bench: Bench,
    words: String,
    #[serde(default)]
    each: Vec<String>,
    #[serde(default)]
    experiment: Names,
    #[serde(default)]
    bytes: Names,
    #[serde(default)]
    metric: Names,
    #[serde(default)]
    however_few: bool,
    ours: Side,
    theirs: Option<Side>,
    floor: Option<Side>,
    at_most: Option<Limit>,
    at_least: Option<Limit>,
    #[serde(default)]
    instead: Vec<String>,
    #[serde(default)]
    beside: Vec<Metric>,
    reason: Option<String>,
    #[serde(default)]
    silent: bool,
    #[serde(default)]
    parts: Vec<Part>,
}

/// What a part of a claim says in place of the whole; without `each` that of the whole counts.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Part {
    #[serde(default)]
    each: Vec<String>,
    experiment: Names,
    #[serde(default)]
    bytes: Names,
    metric: Names,
    reason: Option<String>,
}

/// Which rows. What it does not say the claim says for all its sides.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Side {
    #[serde(default)]
    experiment: Names,
    system: String,
    #[serde(default)]
    modes: Vec<String>,
    #[serde(default)]
    except: Vec<String>,
    bytes: Option<String>,
}

/// One name or several.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged, expecting = "expected a name or a list of names")]
enum Names {
    One(String),
    Several(Vec<String>),
}

/// None.
impl Default for Names {
    fn default() -> Self {
        Names::Several(Vec::new())
    }
}

impl Names {
    fn of(&self) -> &[String] {
        match self {
            Names::One(name) => std::slice::from_ref(name),
            Names::Several(names) => names,
        }
    }

    /// The only one; empty if there is none.
    fn first(&self) -> &str {
        self.of().first().map_or("", String::as_str)
    }

    /// None are all.
    fn allow(&self, name: &str) -> bool {
        self.of().is_empty() || self.of().iter().any(|one| one == name)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Limit {
    /// Times theirs.
    Times(f64),
    /// More than theirs, in the metric's unit.
    More(f64),
    /// By itself, in the metric's unit.
    Number(f64),
}

/// Rows of a system, of which the best one counts.
struct Rows {
    experiments: Vec<String>,
    system: String,
    /// None: all.
    modes: Vec<String>,
    except: Vec<String>,
    /// `None`: an experiment has one size.
    bytes: Option<usize>,
}

/// A claim that can be judged.
struct Claim {
    words: String,
    figure: Figure,
    ours: Rows,
    /// And by what they are compared; `None`: by itself.
    theirs: Option<(Rows, By)>,
    floor: Option<Rows>,
    limit: f64,
    is_at_most: bool,
    /// Of our other modes.
    instead: Option<Rows>,
    beside: Vec<Metric>,
    reason: Option<String>,
    is_silent: bool,
}

fn read(text: &str, bench: Bench, measurable: &Measurable) -> Result<Vec<Claim>, BadClaims> {
    let file: File = toml::from_str(text).map_err(|error| BadClaims(error.to_string()))?;
    let mut claims = Vec::new();
    for entry in file.claim.iter().filter(|entry| entry.get_ref().bench == bench) {
        let line = 1 + text[..entry.span().start].matches('\n').count();
        let entry = entry.get_ref();
        let bad =
            |(field, what): Bad| BadClaims(format!("line {line}, '{field}' of \"{}\": {what}", entry.words));
        for one in entry.split(measurable).map_err(bad)? {
            claims.push(one.claim(measurable, &file.reasons).map_err(bad)?);
        }
    }
    Ok(claims)
}

/// A field, and what is wrong with it.
type Bad = (&'static str, String);

/// A name that is none of these.
fn unknown(field: &'static str, name: &str, known: impl Iterator<Item = impl AsRef<str>>) -> Bad {
    let known: Vec<_> = distinct(known.map(|name| name.as_ref().to_owned()));
    (field, format!("there is no '{name}'; there are {}", known.join(", ")))
}

/// An empty text in place of none.
fn or_empty(texts: &[String]) -> Vec<String> {
    if texts.is_empty() { vec![String::new()] } else { texts.to_vec() }
}

impl Entry {
    /// One for each claim that this is: with one name of each list, and words without marks.
    fn split(&self, measurable: &Measurable) -> Result<Vec<Entry>, Bad> {
        if !self.parts.is_empty() {
            let of_part = |part: &Part| {
                let Part { experiment, bytes, metric, reason, .. } = part.clone();
                let each = if part.each.is_empty() { self.each.clone() } else { part.each.clone() };
                let parts = Vec::new();
                Entry { each, experiment, bytes, metric, reason, parts, ..self.clone() }.split(measurable)
            };
            return Ok(self.parts.iter().map(of_part).collect::<Result<Vec<_>, _>>()?.concat());
        }
        if self.each.is_empty() && self.words.contains("{}") {
            return Err(("words", "it has a {}, and no 'each' says what to put there".to_owned()));
        }
        for (is_list, list, mark) in [
            (!self.each.is_empty(), "'each'", "{}"),
            (self.bytes.of().len() > 1, "several sizes", "{bytes}"),
            (self.metric.of().len() > 1, "several metrics", "{metric}"),
        ] {
            if is_list && !self.words.contains(mark) {
                let why = format!("with {list} it needs a {mark}, or all claims are called the same");
                return Err(("words", why));
            }
        }
        let mut all = Vec::new();
        for (experiment, bytes) in self.places(measurable)? {
            for metric in or_empty(self.metric.of()) {
                for text in or_empty(&self.each) {
                    let words =
                        self.words.replace("{experiment}", experiment.first()).replace("{bytes}", &bytes);
                    let words = words.replace("{metric}", &metric).replace("{}", &text);
                    let (bytes, metric) = (Names::One(bytes.clone()), Names::One(metric.clone()));
                    let (each, experiment) = (vec![text], experiment.clone());
                    all.push(Entry { words, each, experiment, bytes, metric, ..self.clone() });
                }
            }
        }
        Ok(all)
    }

    /// The experiments and the size of each claim.
    fn places(&self, measurable: &Measurable) -> Result<Vec<(Names, String)>, Bad> {
        if !self.words.contains("{experiment}") {
            let sizes = or_empty(self.bytes.of()).into_iter();
            return Ok(sizes.map(|size| (self.experiment.clone(), size)).collect());
        }
        let mut places = Vec::new();
        for named in self.experiment.of() {
            let is_named = |name: &str| name == named || named.ends_with('/') && name.starts_with(named);
            let of_name = measurable.payloads.iter().filter(|(name, _)| is_named(name));
            let of_name = of_name.map(|(name, bytes)| (Names::One(name.clone()), size(*bytes)));
            let before = places.len();
            places.extend(of_name.filter(|(_, size)| self.bytes.allow(size)));
            if places.len() == before {
                let why = format!("nothing is measured of '{named}', or nothing of such sizes");
                return Err(("experiment", why));
            }
        }
        Ok(places)
    }

    fn claim(&self, measurable: &Measurable, reasons: &BTreeMap<String, String>) -> Result<Claim, Bad> {
        let (text, size) = (self.each.first().map_or("", String::as_str), Some(self.bytes.first()));
        let size = size.filter(|size| !size.is_empty());
        let rows = |side: &Side| -> Result<Rows, Bad> {
            let put = |words: &String| words.replace("{}", text);
            let names = [&side.experiment, &self.experiment].into_iter().find(|names| !names.of().is_empty());
            let names =
                names.ok_or(("experiment", "missing: name it for the claim or for each side".to_owned()))?;
            let names: Vec<String> = names.of().iter().map(put).collect();
            let is_there = |name: &String| measurable.payloads.iter().any(|(other, _)| other == name);
            if let Some(name) = names.iter().find(|name| !is_there(name)) {
                return Err(unknown("experiment", name, measurable.payloads.iter().map(|(name, _)| name)));
            }
            let bytes = match (side.bytes.as_deref().or(size), self.bench) {
                (Some(size), _) => Some(size.replace("{}", text)),
                (None, Bench::Compare) => {
                    return Err(("bytes", "missing: say it for the claim or for each side".to_owned()));
                }
                (None, _) => None,
            };
            let bytes = bytes.map(|size| {
                let bytes = bytes_of(&size).ok_or_else(|| {
                    let example = "one is written as \"64 B\", \"4 KiB\" or \"1 MiB\"";
                    ("bytes", format!("'{size}' is no size; {example}"))
                })?;
                let is_measured = |name: &String| measurable.payloads.contains(&(name.clone(), bytes));
                match names.iter().find(|name| !is_measured(name)) {
                    Some(name) => Err(("bytes", format!("'{name}' is not measured with {size}"))),
                    None => Ok(bytes),
                }
            });
            let bytes = bytes.transpose()?;
            let system = put(&side.system);
            let modes: Vec<String> = side.modes.iter().map(put).collect();
            let is_missing = |mode: &&String| !measurable.modes.contains(&(system.clone(), (*mode).clone()));
            if let Some(mode) = modes.iter().find(is_missing) {
                let all = measurable.modes.iter().filter(|(other, _)| *other == system);
                let all: Vec<_> = all.map(|(_, mode)| mode.as_str()).collect();
                let all = all.join(", ");
                return Err(("modes", format!("'{system}' has no '{mode}'; it has {all}")));
            }
            if !measurable.modes.iter().any(|(other, _)| *other == system) {
                return Err(("system", format!("there is no '{system}'")));
            }
            let is_nowhere = |mode: &&String| !measurable.modes.iter().any(|(_, other)| other == *mode);
            if let Some(mode) = side.except.iter().find(is_nowhere) {
                return Err(("except", format!("no system has a '{mode}'")));
            }
            Ok(Rows { experiments: names, system, modes, except: side.except.clone(), bytes })
        };
        let (limit, is_at_most) = match (self.at_most, self.at_least) {
            (Some(limit), None) => (limit, true),
            (None, Some(limit)) => (limit, false),
            _ => return Err(("at-most", "say either 'at-most' or 'at-least'".to_owned())),
        };
        let theirs = self.theirs.as_ref().map(&rows).transpose()?;
        let (theirs, limit) = match (limit, theirs) {
            (Limit::Times(limit), Some(theirs)) => (Some((theirs, By::Ratio)), limit),
            (Limit::More(limit), Some(theirs)) => (Some((theirs, By::Difference)), limit),
            (Limit::Number(limit), None) => (None, limit),
            (Limit::Number(_), Some(_)) => {
                return Err((
                    "theirs",
                    "a { number } stands by itself: leave 'theirs' out, or give { times } or { more }"
                        .to_owned(),
                ));
            }
            (_, None) => return Err(("theirs", "missing: { times } and { more } are of theirs".to_owned())),
        };
        let metric = Metric::try_from(self.metric.first().to_owned()).map_err(|why| ("metric", why))?;
        let reason =
            |name: &String| reasons.get(name).cloned().ok_or_else(|| unknown("reason", name, reasons.keys()));
        let instead = Side { modes: self.instead.clone(), ..self.ours.clone() };
        Ok(Claim {
            words: self.words.clone(),
            figure: Figure { metric, however_few: self.however_few },
            ours: rows(&self.ours)?,
            theirs,
            floor: self.floor.as_ref().map(&rows).transpose()?,
            limit,
            is_at_most,
            instead: (!instead.modes.is_empty()).then(|| rows(&instead)).transpose()?,
            beside: self.beside.clone(),
            reason: self.reason.as_ref().map(reason).transpose()?,
            is_silent: self.silent,
        })
    }
}

impl Rows {
    fn is_of_size(&self, row: &Row) -> bool {
        self.bytes.is_none_or(|bytes| bytes == row.payload_bytes)
    }

    /// Of the first experiment that was measured.
    fn of<'a>(&self, rows: &'a [Row]) -> Vec<&'a Row> {
        let of_experiment = |experiment: &String| {
            let is_wanted = |row: &&Row| {
                (&row.experiment, &row.system) == (experiment, &self.system)
                    && self.is_of_size(row)
                    && (self.modes.is_empty() || self.modes.contains(&row.mode))
                    && !self.except.contains(&row.mode)
            };
            rows.iter().filter(is_wanted).collect::<Vec<_>>()
        };
        self.experiments.iter().map(of_experiment).find(|rows| !rows.is_empty()).unwrap_or_default()
    }
}

impl Claim {
    /// Whether rows say something about it, be it that they do not.
    fn is_about(&self, rows: &[Row]) -> bool {
        let is_ours = |row: &Row| {
            row.system == self.ours.system
                && self.ours.is_of_size(row)
                && self.ours.experiments.contains(&row.experiment)
        };
        let has_theirs = |(theirs, _): &(Rows, By)| rows.iter().any(|row| row.system == theirs.system);
        rows.iter().any(is_ours) && self.theirs.as_ref().is_none_or(has_theirs)
    }

    fn judge(&self, rows: &[Row]) -> Verdict {
        let ours = self.ours.of(rows);
        let (mut found, holds) = match &self.theirs {
            Some((theirs, by)) => self.compare(rows, &ours, &theirs.of(rows), *by),
            None => self.alone(&ours),
        };
        found += &ours.first().map_or(String::new(), |row| self.beside(row));
        let reason = self.reason.clone().filter(|_| holds == Some(false));
        Verdict { reason, is_silent: self.is_silent, ..Verdict::new(&self.words, found, holds) }
    }

    fn is_within(&self, number: f64) -> bool {
        if self.is_at_most { number <= self.limit } else { number >= self.limit }
    }

    fn bound(&self) -> &'static str {
        if self.is_at_most { "at most" } else { "at least" }
    }

    /// The best of ours beside the best of theirs. What is not fit to be compared never counts for us.
    fn compare(&self, rows: &[Row], ours: &[&Row], theirs: &[&Row], by: By) -> (String, Option<bool>) {
        let figure = self.figure;
        let (fit_ours, unfit_ours) = figure.sort(ours);
        let (fit_theirs, unfit_theirs) = figure.sort(theirs);
        let (Some(us), Some(them)) = (figure.best(&fit_ours), figure.best(&fit_theirs)) else {
            return (missing([("ours", fit_ours, unfit_ours), ("theirs", fit_theirs, unfit_theirs)]), None);
        };
        let Some(compared) = Compared::of(us, them, figure, by) else {
            return ("no round in which both were measured".to_owned(), None);
        };
        let unit = figure.metric.unit();
        let mut found = format!(
            "{}, {} {}: {} {unit} ({}) against {} {unit} ({})",
            compared.show(unit),
            self.bound(),
            by.show(self.limit, unit),
            figure.text(us),
            us.mode,
            figure.text(them),
            them.name()
        );
        let others = self.instead.as_ref().map(|others| figure.sort(&others.of(rows)).0).unwrap_or_default();
        let all: Vec<&Row> = [us].into_iter().chain(others).collect();
        if let Some(other) = figure.best(&all).filter(|other| other.mode != us.mode) {
            found += &format!("; {} {} {unit}", other.mode, figure.text(other));
        }
        if !unfit_ours.is_empty() {
            found += &format!("; of ours left out: {}", unfit_ours.join(", "));
        }
        let holds = match self.is_within(compared.median) {
            false => Some(false),
            true if unfit_theirs.is_empty() => Some(true),
            true => {
                found += &format!("; but not judged: {}", unfit_theirs.join(", "));
                None
            }
        };
        let floor = self.floor.as_ref().map(|floor| floor.of(rows)).unwrap_or_default();
        if let [floor] = floor[..]
            && let Some(compared) = Compared::of(floor, them, figure, by)
        {
            let beyond =
                if self.is_within(compared.median) { "" } else { ": the limit lies below the floor" };
            found += &format!("; the floor itself {}{beyond}", by.show(compared.median, unit));
        }
        (found, holds)
    }

    /// The best of ours by itself.
    fn alone(&self, ours: &[&Row]) -> (String, Option<bool>) {
        let (fit, unfit) = self.figure.sort(ours);
        let Some((row, number)) =
            self.figure.best(&fit).and_then(|row| Some((row, self.figure.median(row)?)))
        else {
            return (missing([("ours", fit, unfit)]), None);
        };
        let unit = self.figure.metric.unit();
        let (bound, limit) = (self.bound(), self.limit);
        let (number_text, limit) = (short(number), short(limit));
        let found = format!("{number_text} {unit}, {bound} {limit} ({}, {})", row.mode, row.experiment);
        (found, Some(self.is_within(number)))
    }

    fn beside(&self, row: &Row) -> String {
        let number = |metric: &Metric| {
            let number = Figure::from(*metric).median(row)?;
            Some(format!("; {} {}", short(number), metric.unit()))
        };
        self.beside.iter().filter_map(number).collect()
    }
}

/// Why there is nothing to judge: of each side, its rows that are fit, and why others are not.
fn missing<const N: usize>(sides: [(&str, Vec<&Row>, Vec<String>); N]) -> String {
    if sides.iter().all(|(_, fit, unfit)| fit.is_empty() && unfit.is_empty()) {
        return "not measured".to_owned();
    }
    let lacking = sides.into_iter().filter(|(_, fit, _)| fit.is_empty());
    let words = lacking.map(|(side, _, unfit)| match unfit.is_empty() {
        true => format!("{side} not measured"),
        false => unfit.join(", "),
    });
    let mut words: Vec<String> = words.collect();
    words.dedup();
    words.join("; ")
}

#[cfg(test)]
mod tests;

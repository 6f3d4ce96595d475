// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut report --wcet`: measured execution times, estimates of longer ones from their tail, and writing them into the system file.

mod edit;
mod sizes;
mod tail;

use super::explain::{INPUT_TOO_LARGE, Mark, WCET_EXCEEDED, quoted};
use super::system::{System, read};
use super::verdict::{Comparison, Measured, NOTHING, Row};
use crate::date::date;
use crate::table::{BAD, GOOD, ms, wrap, write_table};
use crate::verb::{Failure, Outcome};
use serde_json::{Value, json};
use sizes::{Class, Line};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;
use tail::{NoTail, Tail, tail, words};
use tautline::Bucket;

/// The measurement of a callback, and its consequences.
struct Fit<'r> {
    row: &'r Row,
    jobs: u64,
    max_ns: u64,
    tail: Result<Tail, NoTail>,
    /// Results by input size, if the jobs state it.
    classes: Vec<Class<'r>>,
    line: Option<Line>,
    /// The `wcet` that the file needs for all of this.
    wcet_ns: u64,
}

/// All callbacks with known execution times.
pub struct Fits<'r> {
    fits: Vec<Fit<'r>>,
    exceedance: f64,
    taken_at_s: u64,
}

/// Which values are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// Only values that are higher than those of the file, which may be computed.
    Raise,
    /// Also lower values, if their tail could be estimated.
    RaiseAndLower,
}

impl<'r> Fits<'r> {
    /// `exceedance`: one job in `1 / exceedance` may take longer than the estimate.
    pub fn new(comparison: &'r Comparison, exceedance: f64, taken_at_s: u64) -> Self {
        let fits = comparison.rows.iter().filter_map(|row| Fit::new(row, exceedance)).collect();
        Fits { fits, exceedance, taken_at_s }
    }

    /// Whether there were jobs, and none took longer, or had a larger input, than the file states.
    pub fn are_kept(&self) -> bool {
        !self.fits.is_empty() && self.fits.iter().all(Fit::is_kept)
    }

    /// Whether no job had a larger input than the file states, which another wcet does not fix.
    pub fn inputs_are_kept(&self) -> bool {
        self.fits.iter().all(|fit| !fit.is_marked(INPUT_TOO_LARGE))
    }

    pub fn write(&self, out: &mut impl Write) -> io::Result<()> {
        let estimate = format!("1 in {:.0}\nms", 1.0 / self.exceedance);
        let head = [
            "callback",
            "jobs",
            "used max\nms",
            &*estimate,
            "95 %: at most\nms",
            "allowed\nms",
            "wcet\nms",
            "needed\nms",
        ];
        let cells = |fit: &Fit<'_>| {
            let estimate =
                |of: fn(&Tail) -> f64| fit.tail.map_or("-".to_owned(), |tail| ms(Some(of(&tail) as u64)));
            vec![
                fit.name().to_owned(),
                fit.jobs.to_string(),
                ms(Some(fit.max_ns)),
                estimate(|tail| tail.estimate_ns),
                estimate(|tail| tail.upper_ns),
                ms(Some(fit.row.predicted.charged_ns)),
                ms(Some(fit.row.predicted.wcet_ns)),
                ms(Some(fit.wcet_ns)),
            ]
        };
        let rows = self.fits.iter().map(|fit| (fit.is_kept(), cells(fit))).collect();
        write_table(&head, 1, rows, out)?;
        writeln!(out)?;
        for fit in self.fits.iter().filter(|fit| !fit.classes.is_empty()) {
            sizes::write(fit.name(), &estimate, &fit.classes, out)?;
        }
        let mut unknown = BTreeMap::<String, Vec<String>>::new();
        for fit in &self.fits {
            if let Some(text) = fit.of_line() {
                writeln!(out, "{}", wrap(&format!("{}: {text}", fit.name())))?;
            }
            for mark in fit.marks() {
                let text = wrap(&format!("{}: {}: {}", fit.name(), mark.name, mark.explanation));
                let (first, rest) = text.split_at(fit.name().len() + 2 + mark.name.len());
                writeln!(out, "{BAD}{first}{BAD:#}{rest}")?;
            }
            if let (Err(none), None) = (fit.tail, fit.line) {
                unknown.entry(words(none)).or_default().push(fit.name().to_owned());
            }
            let mut without = BTreeMap::<String, usize>::new();
            for none in fit.classes.iter().filter_map(|class| class.tail.err()) {
                *without.entry(words(none)).or_default() += 1;
            }
            for (why, count) in without {
                let name = format!("{} ({count} of {} sizes)", fit.name(), fit.classes.len());
                unknown.entry(why).or_default().push(name);
            }
        }
        for (why, names) in unknown {
            writeln!(out, "{}", wrap(&format!("no estimate, {why}: {}", names.join(", "))))?;
        }
        if self.fits.is_empty() {
            writeln!(out, "{NOTHING}.")?;
        }
        if self.are_kept() {
            let jobs: u64 = self.fits.iter().map(|fit| fit.jobs).sum();
            writeln!(out, "{GOOD}No job of {jobs} used more than the file allows.{GOOD:#}")?;
        }
        Ok(())
    }

    pub fn to_json(&self) -> Value {
        let ms = |ns: f64| ns / 1e6;
        let callback = |fit: &Fit<'_>| {
            json!({
                "name": fit.name(), "jobs": fit.jobs, "max_ms": ms(fit.max_ns as f64),
                "estimate_ms": fit.tail.ok().map(|tail| ms(tail.estimate_ns)),
                "upper_ms": fit.tail.ok().map(|tail| ms(tail.upper_ns)),
                "shape": fit.tail.ok().map(|tail| tail.shape),
                "no_estimate": fit.tail.err().map(words),
                "allowed_ms": ms(fit.row.predicted.charged_ns as f64), "wcet_ms": ms(fit.row.predicted.wcet_ns as f64),
                "needed_wcet_ms": ms(fit.wcet_ns as f64), "exceeded": fit.is_marked(WCET_EXCEEDED),
                "input_max": fit.row.predicted.entry.input_max, "input_exceeded": fit.is_marked(INPUT_TOO_LARGE),
                "sizes": fit.classes.iter().map(Class::to_json).collect::<Vec<_>>(),
                "line": fit.line.map(Line::to_json),
            })
        };
        json!({
            "kept": self.are_kept(), "exceedance": self.exceedance, "confidence": tail::CONFIDENCE,
            "callbacks": self.fits.iter().map(callback).collect::<Vec<_>>(),
        })
    }

    /// Writes the needed values into the system file. Returns the changes in words, and whether the changed file is schedulable.
    ///
    /// # Errors
    /// The file differs from `system`, it cannot be read or written, or the new text is not a valid system file.
    pub fn put(&self, system: &System, path: &Path, change: Change) -> Outcome<(Vec<String>, bool)> {
        let changed: Vec<_> = self.fits.iter().filter(|fit| fit.is_changed(change)).collect();
        if changed.is_empty() {
            return Ok((Vec::new(), system.checked.schedulable));
        }
        let refuse =
            |reason: String| Failure::unusable(format!("`{}` cannot be changed: {reason}", path.display()));
        let mut text = read(path)?;
        if text != system.text {
            let reason = "it is no longer the file of this run: name the one to change with --system";
            return Err(refuse(reason.to_owned()));
        }
        for fit in &changed {
            text = edit::with(&text, fit.name(), &quoted(fit.wcet_ns), &self.source(fit)).map_err(refuse)?;
        }
        let anew = System::parse(path, &text)?;
        crate::replace::replace(path, &text).map_err(|error| Failure::unwritable(path, &error))?;
        let words = |fit: &&Fit<'_>| {
            format!("{}: wcet {} -> {}", fit.name(), quoted(fit.row.predicted.wcet_ns), quoted(fit.wcet_ns))
        };
        Ok((changed.iter().map(words).collect(), anew.checked.schedulable))
    }

    fn source(&self, fit: &Fit<'_>) -> String {
        let date = date((self.taken_at_s as i64).saturating_mul(1_000_000_000));
        let day = date.split(' ').next().unwrap_or_default();
        let most = quoted(fit.max_ns).replace('"', "");
        let rare = format!("1 in {:.0} above", 1.0 / self.exceedance);
        let estimate = match (fit.by_line(), fit.tail) {
            (Some((line, most)), _) => {
                let estimated = fit.classes.iter().filter(|class| class.tail.is_ok()).count();
                let (all, greatest) = (fit.classes.len(), fit.greatest_input());
                format!(
                    "{line} for sizes to {greatest} ({rare} at {estimated} of {all} sizes, 95 %), of which {most}"
                )
            }
            (None, Ok(tail)) => format!("{rare} {} (95 %)", quoted(tail.upper_ns as u64).replace('"', "")),
            (None, Err(_)) => "no estimate".to_owned(),
        };
        format!("{} {day}: at most {most} in {} jobs, {estimate}, with overheads", edit::SOURCE, fit.jobs)
    }
}

impl<'r> Fit<'r> {
    /// `None` without a measurement.
    fn new(row: &'r Row, exceedance: f64) -> Option<Self> {
        let Measured { execution, callback, .. } = row.measured.as_ref()?;
        let (jobs, max_ns) = (execution.n(), u64::try_from(execution.max().as_nanos()).unwrap_or(u64::MAX));
        if jobs == 0 {
            return None;
        }
        let buckets: Vec<Bucket> = execution.buckets().collect();
        let tail = tail(&buckets, max_ns, exceedance);
        let classes: Vec<Class<'_>> =
            callback.inputs.iter().map(|class| Class::new(class, exceedance)).collect();
        let line = Line::above(&classes);
        let by_line = line.zip(row.predicted.entry.input_max).map_or(0, |(line, most)| line.at(most));
        let by_tail = tail.map_or(0, |tail| tail.upper_ns as u64);
        let used_ns = max_ns.max(by_line).max(by_tail);
        // The measurement includes executor and transport in the thread, which the file charges in addition to the wcet.
        let overheads_ns = row.predicted.charged_ns - row.predicted.wcet_ns;
        let wcet_ns = used_ns.saturating_sub(overheads_ns).max(1).div_ceil(1000).saturating_mul(1000);
        Some(Fit { row, jobs, max_ns, tail, classes, line, wcet_ns })
    }

    fn name(&self) -> &'r str {
        &self.row.predicted.entry.name
    }

    fn is_kept(&self) -> bool {
        self.marks().next().is_none()
    }

    /// The violations, in the report's words.
    fn marks(&self) -> impl Iterator<Item = &'r Mark> {
        self.row.marks.iter().filter(|mark| [INPUT_TOO_LARGE, WCET_EXCEEDED].contains(&mark.name))
    }

    fn is_marked(&self, name: &str) -> bool {
        self.marks().any(|mark| mark.name == name)
    }

    /// The line from which the needed wcet was computed, and the file's `input_max`.
    fn by_line(&self) -> Option<(Line, u64)> {
        self.line.zip(self.row.predicted.entry.input_max)
    }

    fn greatest_input(&self) -> u64 {
        self.row.measured.as_ref().and_then(|seen| seen.callback.greatest_input()).unwrap_or(0)
    }

    /// The result by input size, or the reason why there is none.
    fn of_line(&self) -> Option<String> {
        let greatest = self.greatest_input();
        Some(match (self.line, self.row.predicted.entry.input_max) {
            (_, None) if self.classes.is_empty() => return None,
            (_, Some(_)) if self.classes.is_empty() => {
                "the file states `input_max`, but its jobs state no sizes: call `tautline::set_input_size` in it".to_owned()
            }
            (None, most) => {
                let unknown = most.filter(|most| *most > greatest);
                let unknown = unknown.map_or(String::new(), |most| format!(", nothing is known of `input_max = {most}`"));
                format!("no line, for all inputs were of about one size{unknown}: run it with small and large ones")
            }
            (Some(line), None) => format!(
                "no job used more than {line}; with `input_max = {greatest}` or more in the file, `wcet` is computed from that"
            ),
            (Some(line), Some(most)) if most > greatest => format!(
                "no job used more than {line}, which is continued to `input_max = {most}`: no input above {greatest} was seen"
            ),
            (Some(line), Some(most)) => format!("no job used more than {line}; `input_max = {most}`"),
        })
    }

    fn is_changed(&self, change: Change) -> bool {
        let stated_ns = self.row.predicted.wcet_ns;
        let is_estimated = match (self.by_line(), self.row.predicted.entry.input_max) {
            (Some(_), _) => self.classes.iter().all(|class| class.tail.is_ok()),
            // The file may state more because of larger inputs, which were not measured.
            (None, Some(most)) => most <= self.greatest_input() && self.tail.is_ok(),
            (None, None) => self.tail.is_ok(),
        };
        self.wcet_ns > stated_ns
            || change == Change::RaiseAndLower && self.wcet_ns < stated_ns && is_estimated
    }
}

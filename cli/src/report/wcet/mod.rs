// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut report --wcet`: execution times that were measured, what their tail says of longer ones, and both into the system file.

mod edit;
mod tail;

use super::explain::quoted;
use super::verdict::{Comparison, Mark, Measured, Row};
use super::{ReportError, System};
use crate::record::date;
use crate::table::{BAD, GOOD, ms, wrap, write_table};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;
use tail::{NoTail, Tail, tail};
use tautline::Bucket;
use tautline_analysis::file::{FileError, SystemFile};

/// What was measured of a callback, and what follows.
struct Fit<'r> {
    row: &'r Row,
    jobs: u64,
    max_ns: u64,
    tail: Result<Tail, NoTail>,
    /// What the file would have to state for all of that.
    wcet_ns: u64,
}

/// All callbacks of which execution times are known.
pub struct Fits<'r> {
    fits: Vec<Fit<'r>>,
    exceedance: f64,
    taken_at_s: u64,
}

/// Which values are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// None that is less than what the file states: it may be computed.
    Raise,
    /// Those, too, where the tail could be estimated.
    RaiseAndLower,
}

impl<'r> Fits<'r> {
    /// `exceedance`: one job in `1 / exceedance` may take longer than the estimate.
    pub fn new(comparison: &'r Comparison, exceedance: f64, taken_at_s: u64) -> Self {
        let fits = comparison.rows.iter().filter_map(|row| Fit::new(row, exceedance)).collect();
        Fits { fits, exceedance, taken_at_s }
    }

    /// Whether no job took longer than the file states.
    pub fn are_kept(&self) -> bool {
        self.fits.iter().all(Fit::is_kept)
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
        let mut unknown = BTreeMap::<String, Vec<&str>>::new();
        for fit in &self.fits {
            if let Some(mark) = fit.exceeded() {
                let text = wrap(&format!("{}: {}: {}", fit.name(), mark.name, mark.explanation));
                let (first, rest) = text.split_at(fit.name().len() + 2 + mark.name.len());
                writeln!(out, "{BAD}{first}{BAD:#}{rest}")?;
            }
            if let Err(none) = fit.tail {
                unknown.entry(words(none)).or_default().push(fit.name());
            }
        }
        for (why, names) in unknown {
            writeln!(out, "{}", wrap(&format!("no estimate, {why}: {}", names.join(", "))))?;
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
                "needed_wcet_ms": ms(fit.wcet_ns as f64), "exceeded": !fit.is_kept(),
            })
        };
        json!({
            "kept": self.are_kept(), "exceedance": self.exceedance, "confidence": tail::CONFIDENCE,
            "callbacks": self.fits.iter().map(callback).collect::<Vec<_>>(),
        })
    }

    /// Puts what is needed into the system file; what was changed, in words, and whether the file is schedulable with that.
    ///
    /// # Errors
    /// The file cannot be written; what was to be written is no system file.
    pub fn put(
        &self,
        system: &System,
        path: &Path,
        change: Change,
    ) -> Result<(Vec<String>, bool), ReportError> {
        let changed: Vec<_> = self.fits.iter().filter(|fit| fit.is_changed(change)).collect();
        if changed.is_empty() {
            return Ok((Vec::new(), system.checked.schedulable));
        }
        let mut text = system.text.clone();
        for fit in &changed {
            let refuse = |reason| ReportError::Unwritable { path: path.into(), reason };
            text = edit::with(&text, fit.name(), &quoted(fit.wcet_ns), &self.source(fit)).map_err(refuse)?;
        }
        let anew =
            SystemFile::parse(&text).map_err(|source| FileError::Content { path: path.into(), source })?;
        edit::save(path, &text).map_err(|source| ReportError::Write { path: path.into(), source })?;
        let words = |fit: &&Fit<'_>| {
            format!("{}: wcet {} -> {}", fit.name(), quoted(fit.row.predicted.wcet_ns), quoted(fit.wcet_ns))
        };
        Ok((changed.iter().map(words).collect(), anew.check().schedulable))
    }

    /// Where a value of the file is from.
    fn source(&self, fit: &Fit<'_>) -> String {
        let date = date((self.taken_at_s as i64).saturating_mul(1_000_000_000));
        let day = date.split(' ').next().unwrap_or_default();
        let most = quoted(fit.max_ns).replace('"', "");
        let estimate = match fit.tail {
            Ok(tail) => format!(
                "1 in {:.0} above {} (95 %)",
                1.0 / self.exceedance,
                quoted(tail.upper_ns as u64).replace('"', "")
            ),
            Err(_) => "no estimate".to_owned(),
        };
        format!("{} {day}: at most {most} in {} jobs, {estimate}, with overheads", edit::SOURCE, fit.jobs)
    }
}

impl<'r> Fit<'r> {
    /// `None`: nothing was measured of it.
    fn new(row: &'r Row, exceedance: f64) -> Option<Self> {
        let Measured { execution, .. } = row.measured.as_ref()?;
        let (jobs, max_ns) = (execution.n(), u64::try_from(execution.max().as_nanos()).unwrap_or(u64::MAX));
        if jobs == 0 {
            return None;
        }
        let buckets: Vec<Bucket> = execution.buckets().collect();
        let tail = tail(&buckets, max_ns, exceedance);
        let used_ns = tail.map_or(max_ns, |tail| max_ns.max(tail.upper_ns.min(u64::MAX as f64) as u64));
        // What executor and transport use in the thread is in the measurement, and charged by the file on top of the wcet.
        let overheads_ns = row.predicted.charged_ns - row.predicted.wcet_ns;
        let wcet_ns = used_ns.saturating_sub(overheads_ns).max(1).div_ceil(1000).saturating_mul(1000);
        Some(Fit { row, jobs, max_ns, tail, wcet_ns })
    }

    fn name(&self) -> &'r str {
        &self.row.predicted.entry.name
    }

    fn is_kept(&self) -> bool {
        self.max_ns <= self.row.predicted.charged_ns
    }

    /// As the report says it, if it was.
    fn exceeded(&self) -> Option<&'r Mark> {
        self.row.marks.iter().find(|mark| mark.name == "wcet exceeded")
    }

    fn is_changed(&self, change: Change) -> bool {
        let stated_ns = self.row.predicted.wcet_ns;
        self.wcet_ns > stated_ns
            || change == Change::RaiseAndLower && self.wcet_ns < stated_ns && self.tail.is_ok()
    }
}

fn words(none: NoTail) -> String {
    match none {
        NoTail::TooFewJobs(needed) => format!("for it takes {needed} jobs"),
        NoTail::AllAlike => "for nearly all jobs took the same time: what is needed is their maximum".to_owned(),
        NoTail::TooHeavy => {
            "for long jobs are too frequent: look what makes them so long, as interrupts, page faults or a second kind of input"
                .to_owned()
        }
        NoTail::NoFit => {
            "for long jobs are of several kinds, so these say nothing of longer ones: measure each kind by itself".to_owned()
        }
    }
}

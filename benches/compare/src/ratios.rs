// SPDX-License-Identifier: MIT OR Apache-2.0
//! Figures of two rows, compared round by round: rivals run next to each other in each.

use std::fmt;

use crate::report::{Round, Row};

/// A figure that is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Figure {
    P50,
    P99,
    P999,
    CpuTime,
    Memory,
    /// Of a stream, from one message to the next, in µs.
    Interval,
    /// Of a start, in µs: one each round.
    Start,
}

impl Figure {
    pub fn name(self) -> &'static str {
        match self {
            Figure::P50 => "p50",
            Figure::P99 => "p99",
            Figure::P999 => "p99.9",
            Figure::CpuTime => "CPU time",
            Figure::Memory => "memory",
            Figure::Interval => "time per message",
            Figure::Start => "time",
        }
    }

    /// Of a round with enough times for it.
    fn of(self, round: &Round) -> Option<f64> {
        let figure = match self {
            Figure::P50 | Figure::Start => Some(round.p50_us),
            Figure::P99 => Some(round.p99_us),
            Figure::P999 => Some(round.p999_us),
            Figure::CpuTime => round.cpu_us_per_msg,
            Figure::Memory => round.rss_mib,
            Figure::Interval => round.msgs_per_s.map(|rate| 1e6 / rate.max(1e-9)),
        };
        figure.filter(|_| self.is_of_enough(round.n))
    }

    /// Of all rounds together.
    fn pooled(self, row: &Row) -> Option<f64> {
        let figure = match self {
            Figure::P50 | Figure::Start => row.p50_us,
            Figure::P99 => row.p99_us,
            Figure::P999 => row.p999_us,
            Figure::CpuTime => row.cpu_us_per_msg,
            Figure::Memory => row.rss_mib,
            Figure::Interval => None,
        };
        figure.filter(|_| self.is_of_enough(row.n))
    }

    /// The median of a row's rounds; of all together where each of them has too few times.
    pub fn median(self, row: &Row) -> Option<f64> {
        let rounds: Vec<f64> = row.rounds.iter().filter_map(|round| self.of(round)).collect();
        median(rounds).or_else(|| self.pooled(row))
    }

    /// Whether so many times say something about it.
    pub fn is_of_enough(self, times: u64) -> bool {
        match self {
            Figure::P50 => is_enough(times, 0.5),
            Figure::P99 => is_enough(times, 0.99),
            Figure::P999 => is_enough(times, 0.999),
            Figure::CpuTime | Figure::Memory | Figure::Interval | Figure::Start => times > 0,
        }
    }
}

/// Whether at least ten of so many times lie above a quantile.
pub fn is_enough(times: u64, quantile: f64) -> bool {
    // Half a time for what a quantile cannot say exactly in binary.
    times as f64 * (1.0 - quantile) >= 10.0 - 1e-6
}

fn median(mut numbers: Vec<f64>) -> Option<f64> {
    numbers.sort_by(f64::total_cmp);
    let middle = numbers.len() / 2;
    match numbers.len() {
        0 => None,
        len if len % 2 == 1 => Some(numbers[middle]),
        _ => Some(f64::midpoint(numbers[middle - 1], numbers[middle])),
    }
}

/// The rows that can be compared, and why the others cannot.
pub fn sort<'a>(rows: &[&'a Row], figure: Figure) -> (Vec<&'a Row>, Vec<String>) {
    let (mut fit, mut unfit) = (Vec::new(), Vec::new());
    for row in rows {
        match unfit_for(row, figure) {
            None => fit.push(*row),
            Some(reason) => unfit.push(format!("{} {} {reason}", row.system, row.mode)),
        }
    }
    (fit, unfit)
}

pub fn unfit_for(row: &Row, figure: Figure) -> Option<String> {
    match row {
        Row { unfit: Some(reason), .. } => Some(reason.clone()),
        Row { lost: 1.., .. } => Some(format!("lost {} messages", row.lost)),
        _ if row.n > 0 && !figure.is_of_enough(row.n) => {
            Some(format!("has {} times, too few for {}", row.n, figure.name()))
        }
        _ if figure.median(row).is_none() => Some("has no figures".to_owned()),
        _ => None,
    }
}

/// The one with the least median.
pub fn best<'a>(rows: &[&'a Row], figure: Figure) -> Option<&'a Row> {
    let median = |row: &&Row| figure.median(row).unwrap_or(f64::MAX);
    rows.iter().copied().min_by(|a, b| median(a).total_cmp(&median(b)))
}

/// Ratios of the rounds that two rows have in common; of all rounds together where each has too few times.
pub struct Ratios {
    pub median: f64,
    least: f64,
    most: f64,
    rounds: usize,
}

impl Ratios {
    pub fn of(ours: &Row, theirs: &Row, figure: Figure) -> Option<Self> {
        let ratio = |us: &Round| {
            let them = theirs.rounds.iter().find(|them| them.round == us.round)?;
            Some(figure.of(us)? / figure.of(them)?)
        };
        let mut ratios: Vec<f64> = ours.rounds.iter().filter_map(ratio).collect();
        let rounds = ratios.len();
        if ratios.is_empty() {
            ratios.push(figure.pooled(ours)? / figure.pooled(theirs)?);
        }
        Some(Ratios {
            least: ratios.iter().copied().fold(f64::INFINITY, f64::min),
            most: ratios.iter().copied().fold(0.0, f64::max),
            rounds,
            median: median(ratios)?,
        })
    }
}

impl fmt::Display for Ratios {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.rounds {
            0 => write!(f, "{:.2} x, all rounds together", self.median),
            1 => write!(f, "{:.2} x in one round", self.median),
            rounds => {
                let Ratios { median, least, most, .. } = self;
                write!(f, "{median:.2} x, the median of {rounds} rounds ({least:.2} to {most:.2})")
            }
        }
    }
}

/// What was measured.
pub struct Rows<'a>(pub &'a [Row]);

impl<'a> Rows<'a> {
    pub fn find(&self, experiment: &str, system: &str, modes: &[&str], bytes: usize) -> Vec<&'a Row> {
        let mut rows = self.all(experiment, system, bytes);
        rows.retain(|row| modes.contains(&row.mode.as_str()));
        rows
    }

    /// All configurations of a system.
    pub fn all(&self, experiment: &str, system: &str, bytes: usize) -> Vec<&'a Row> {
        let is_wanted =
            |row: &&Row| row.experiment == experiment && row.system == system && row.payload_bytes == bytes;
        self.0.iter().filter(is_wanted).collect()
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a bench measured of systems beside each other: a row for each way of each system, with its rounds.
//!
//! A machine has slow and fast phases, so rows are compared round by round: rivals run next to each other in each.

use serde::{Deserialize, Serialize};

use crate::Distribution;
use crate::table::short;

/// A line of the result. Times are `None` where nothing was measured; the note says why.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Row {
    /// What was done, such as `latency/whole/held-off`.
    pub experiment: String,
    pub system: String,
    /// The system's way to do it.
    pub mode: String,
    pub payload_bytes: usize,
    pub n: u64,
    pub p50_us: Option<f64>,
    pub p99_us: Option<f64>,
    pub p999_us: Option<f64>,
    pub max_us: Option<f64>,
    pub lost: u64,
    /// Of the sending and the receiving together.
    pub cpu_us_per_msg: Option<f64>,
    /// Of all processes; what they share counts once.
    pub rss_mib: Option<f64>,
    /// How often a gateway used up its budget, in the round where it was most: after that its threads are ordinary ones for a while.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub throttled: Option<u64>,
    /// What arrived, of a stream or of the flood beside callbacks: the median round.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mb_per_s: Option<f64>,
    #[serde(default)]
    pub note: String,
    /// What is compared.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub rounds: Vec<Round>,
    /// Why the row must not be compared with others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unfit: Option<String>,
    /// Of this run alone: not in the JSON.
    #[serde(skip)]
    pub details: Option<Details>,
}

/// What a round found.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Round {
    /// From 1.
    pub round: u32,
    pub n: u64,
    pub p50_us: f64,
    pub p99_us: f64,
    pub p999_us: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cpu_us_per_msg: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub msgs_per_s: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rss_mib: Option<f64>,
}

/// What a page shows beside.
#[derive(Clone, Debug)]
pub struct Details {
    pub times: Distribution,
    pub messages_per_s: f64,
    /// CPU time of all processes per second.
    pub cpu_share: f64,
    pub steal_ticks: u64,
    pub wakes: Option<Wakes>,
}

/// How often the threads of a process stopped waiting, per message that it was sent.
#[derive(Clone, Copy, Debug)]
pub struct Wakes {
    /// Its main thread, which is Tautline's sampler.
    pub sampler: f64,
    /// All others together.
    pub others: f64,
}

/// A row in the making: the times of all rounds.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    pub times: Distribution,
    pub lost: u64,
    pub rounds: Vec<Round>,
}

impl Tally {
    /// Adds a round, which is returned for what else it found.
    pub fn add(&mut self, round: u32, times: &Distribution) -> &mut Round {
        self.times.add(&times.counts());
        let quantile = |quantile| rounded(times.quantile_us(quantile));
        let (p50_us, p99_us, p999_us) = (quantile(0.5), quantile(0.99), quantile(0.999));
        self.rounds.push(Round { round, n: times.len(), p50_us, p99_us, p999_us, ..Round::default() });
        let last = self.rounds.len() - 1;
        &mut self.rounds[last]
    }

    /// The row of all rounds.
    pub fn row(&self, experiment: impl Into<String>, system: &str, mode: &str, payload_bytes: usize) -> Row {
        let quantile = |quantile| (!self.times.is_empty()).then(|| rounded(self.times.quantile_us(quantile)));
        Row {
            experiment: experiment.into(),
            system: system.to_owned(),
            mode: mode.to_owned(),
            payload_bytes,
            n: self.times.len(),
            p50_us: quantile(0.5),
            p99_us: quantile(0.99),
            p999_us: quantile(0.999),
            max_us: quantile(1.0),
            lost: self.lost,
            rounds: self.rounds.clone(),
            ..Row::default()
        }
    }
}

/// Three digits after the point are enough.
pub fn rounded(number: f64) -> f64 {
    (number * 1e3).round() / 1e3
}

impl Row {
    /// Its system and its mode.
    pub fn name(&self) -> String {
        format!("{} {}", self.system, self.mode)
    }

    /// Least and most of a figure of the rounds.
    pub fn spread(&self, figure: impl Fn(&Round) -> Option<f64>) -> Option<(f64, f64)> {
        let mut figures = self.rounds.iter().filter_map(figure);
        let first = figures.next()?;
        Some(figures.fold((first, first), |(least, most), figure| (least.min(figure), most.max(figure))))
    }

    /// Megabytes that arrived per second in a round.
    pub fn mb_per_s(&self, round: &Round) -> Option<f64> {
        Some(round.msgs_per_s? * self.payload_bytes as f64 / 1e6)
    }
}

/// A number of a row that is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    P50,
    P99,
    P999,
    CpuTime,
    Memory,
    /// Of a stream, from one message to the next.
    Interval,
    /// Of a stream.
    Rate,
    /// Of a start: one time each round.
    Start,
    SamplerWakes,
    OtherWakes,
    Steal,
    /// What did not arrive, or was not told.
    Lost,
}

impl Metric {
    pub fn name(self) -> &'static str {
        self.name_and_unit().0
    }

    /// What stands behind a number of it.
    pub fn unit(self) -> &'static str {
        self.name_and_unit().1
    }

    fn name_and_unit(self) -> (&'static str, &'static str) {
        match self {
            Metric::P50 => ("p50", "µs"),
            Metric::P99 => ("p99", "µs"),
            Metric::P999 => ("p99.9", "µs"),
            Metric::CpuTime => ("CPU time", "µs"),
            Metric::Memory => ("memory", "MiB"),
            Metric::Interval => ("time per message", "µs"),
            Metric::Rate => ("rate", "MB/s"),
            Metric::Start => ("time", "µs"),
            Metric::SamplerWakes => ("sampler wakes", "wakes of the sampler per message"),
            Metric::OtherWakes => ("other wakes", "wakes of the process's other threads per message, in sum"),
            Metric::Steal => ("steal", "ticks of 10 ms of steal"),
            Metric::Lost => ("lost", "lost"),
        }
    }

    /// Of a round; whether it has enough times for it is another question.
    fn of(self, row: &Row, round: &Round) -> Option<f64> {
        match self {
            Metric::P50 | Metric::Start => Some(round.p50_us),
            Metric::P99 => Some(round.p99_us),
            Metric::P999 => Some(round.p999_us),
            Metric::CpuTime => round.cpu_us_per_msg,
            Metric::Memory => round.rss_mib,
            Metric::Interval => round.msgs_per_s.map(|rate| 1e6 / rate.max(1e-9)),
            Metric::Rate => row.mb_per_s(round),
            Metric::SamplerWakes | Metric::OtherWakes | Metric::Steal | Metric::Lost => None,
        }
    }

    /// Of all rounds together.
    fn pooled(self, row: &Row) -> Option<f64> {
        let details = || row.details.as_ref();
        match self {
            Metric::P50 | Metric::Start => row.p50_us,
            Metric::P99 => row.p99_us,
            Metric::P999 => row.p999_us,
            Metric::CpuTime => row.cpu_us_per_msg,
            Metric::Memory => row.rss_mib,
            Metric::Interval | Metric::Rate => None,
            Metric::SamplerWakes => Some(details()?.wakes?.sampler),
            Metric::OtherWakes => Some(details()?.wakes?.others),
            Metric::Steal => Some(details()?.steal_ticks as f64),
            Metric::Lost => Some(row.lost as f64),
        }
    }

    /// Whether so many times say something about it.
    fn is_of_enough(self, times: u64) -> bool {
        match self {
            Metric::P50 => is_enough(times, 0.5),
            Metric::P99 => is_enough(times, 0.99),
            Metric::P999 => is_enough(times, 0.999),
            _ => times > 0,
        }
    }
}

/// Whether at least ten of so many times lie above a quantile.
pub fn is_enough(times: u64, quantile: f64) -> bool {
    // Half a time for what a quantile cannot say exactly in binary.
    times as f64 * (1.0 - quantile) >= 10.0 - 1e-6
}

/// A metric as it is taken from rows: a quantile of too few times does not count, unless they are said to do.
#[derive(Clone, Copy, Debug)]
pub struct Figure {
    pub metric: Metric,
    pub however_few: bool,
}

impl From<Metric> for Figure {
    fn from(metric: Metric) -> Self {
        Figure { metric, however_few: false }
    }
}

impl Figure {
    fn is_of_enough(self, times: u64) -> bool {
        self.however_few || self.metric.is_of_enough(times)
    }

    fn of(self, row: &Row, round: &Round) -> Option<f64> {
        self.metric.of(row, round).filter(|_| self.is_of_enough(round.n))
    }

    fn pooled(self, row: &Row) -> Option<f64> {
        self.metric.pooled(row).filter(|_| self.is_of_enough(row.n))
    }

    /// The median of a row's rounds; of all together where each of them has too few times.
    pub fn median(self, row: &Row) -> Option<f64> {
        let rounds: Vec<f64> = row.rounds.iter().filter_map(|round| self.of(row, round)).collect();
        median(rounds).or_else(|| self.pooled(row))
    }

    /// The same with its digits.
    pub fn text(self, row: &Row) -> String {
        self.median(row).map_or("-".to_owned(), short)
    }

    /// The rows that can be compared, and why the others cannot.
    pub fn sort<'a>(self, rows: &[&'a Row]) -> (Vec<&'a Row>, Vec<String>) {
        let (mut fit, mut unfit) = (Vec::new(), Vec::new());
        for row in rows {
            match self.unfit(row) {
                None => fit.push(*row),
                Some(reason) => unfit.push(format!("{} {reason}", row.name())),
            }
        }
        (fit, unfit)
    }

    fn unfit(self, row: &Row) -> Option<String> {
        match row {
            Row { unfit: Some(reason), .. } => Some(reason.clone()),
            Row { lost: 1.., .. } if self.metric != Metric::Lost => {
                Some(format!("lost {} messages", row.lost))
            }
            _ if row.n > 0 && !self.is_of_enough(row.n) => {
                Some(format!("has {} times, too few for {}", row.n, self.metric.name()))
            }
            _ if self.median(row).is_none() => Some("has no figures".to_owned()),
            _ => None,
        }
    }

    /// The row with the least median; of rates, the most.
    pub fn best<'a>(self, rows: &[&'a Row]) -> Option<&'a Row> {
        let sign = if self.metric == Metric::Rate { -1.0 } else { 1.0 };
        let median = |row: &&Row| self.median(row).map_or(f64::MAX, |median| sign * median);
        rows.iter().copied().min_by(|a, b| median(a).total_cmp(&median(b)))
    }
}

/// The median, the mean of the middle two of an even number.
pub fn median(mut numbers: Vec<f64>) -> Option<f64> {
    numbers.sort_by(f64::total_cmp);
    let middle = numbers.len() / 2;
    match numbers.len() {
        0 => None,
        len if len % 2 == 1 => Some(numbers[middle]),
        _ => Some(f64::midpoint(numbers[middle - 1], numbers[middle])),
    }
}

/// The least, the median (of an even number the greater one in the middle) and the greatest; NaN of none.
pub fn extent(mut numbers: Vec<f64>) -> [f64; 3] {
    numbers.sort_by(f64::total_cmp);
    let at = |index: usize| numbers.get(index).copied().unwrap_or(f64::NAN);
    [at(0), at(numbers.len() / 2), at(numbers.len().saturating_sub(1))]
}

/// How two rows are set against each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum By {
    /// How many times theirs ours is.
    Ratio,
    /// How much more ours is, in the metric's unit.
    Difference,
}

/// Of the rounds that two rows have in common; of all rounds together where each has too few times.
#[derive(Clone, Copy, Debug)]
pub struct Compared {
    pub median: f64,
    least: f64,
    most: f64,
    rounds: usize,
    by: By,
}

impl Compared {
    /// `None` if there is nothing that they have in common.
    pub fn of(ours: &Row, theirs: &Row, figure: Figure, by: By) -> Option<Self> {
        let compare = |us: f64, them: f64| if by == By::Ratio { us / them } else { us - them };
        let of_round = |us: &Round| {
            let them = theirs.rounds.iter().find(|them| them.round == us.round)?;
            Some(compare(figure.of(ours, us)?, figure.of(theirs, them)?))
        };
        let mut all: Vec<f64> = ours.rounds.iter().filter_map(of_round).collect();
        let rounds = all.len();
        if all.is_empty() {
            all.push(compare(figure.pooled(ours)?, figure.pooled(theirs)?));
        }
        Some(Compared {
            least: all.iter().copied().fold(f64::INFINITY, f64::min),
            most: all.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            rounds,
            by,
            median: median(all)?,
        })
    }
}

impl By {
    /// A number of it, for people.
    pub fn show(self, number: f64, unit: &str) -> String {
        match self {
            By::Ratio => format!("{number:.2} x"),
            By::Difference => format!("{number:+.2} {unit}"),
        }
    }
}

impl Compared {
    /// For people: the median beside whom, and its spread over the rounds.
    pub fn show(&self, unit: &str, theirs: &str) -> String {
        let Compared { median, least, most, rounds, by } = *self;
        let to = if by == By::Ratio { "" } else { "to " };
        let spread = (rounds > 1).then(|| format!(" ({least:.2} to {most:.2} in {rounds} rounds)"));
        format!("{} {to}{theirs}{}", by.show(median, unit), spread.unwrap_or_default())
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Goals between the rows of a run: a claim is a metric of ours and what it is compared with. A missed one is printed and does not fail
//! the bench, for the machine has its part in it.

use crate::rows::{By, Compared, Figure, Metric, Row};
use crate::table::{short, size};
use crate::verdict::Verdict;

/// Ways of a system at one experiment, of which the best counts.
#[derive(Clone, Copy, Debug)]
pub struct Ways<'a> {
    experiment: &'a str,
    /// `None`: the experiment has one size.
    bytes: Option<usize>,
    system: &'a str,
    /// None: all.
    modes: &'a [&'a str],
}

impl<'a> Ways<'a> {
    pub fn new(
        experiment: &'a str,
        bytes: impl Into<Option<usize>>,
        system: &'a str,
        modes: &'a [&'a str],
    ) -> Self {
        Ways { experiment, bytes: bytes.into(), system, modes }
    }

    fn is_measured(&self, row: &Row) -> bool {
        (&*row.experiment, &*row.system) == (self.experiment, self.system)
            && self.bytes.is_none_or(|bytes| bytes == row.payload_bytes)
    }

    fn of<'r>(&self, rows: &'r [Row]) -> Vec<&'r Row> {
        let has = |row: &&Row| self.modes.is_empty() || self.modes.contains(&&*row.mode);
        rows.iter().filter(|row| self.is_measured(row)).filter(has).collect()
    }

    fn size(&self) -> Option<String> {
        self.bytes.filter(|bytes| *bytes > 0).map(size)
    }
}

#[derive(Clone, Copy, Debug)]
pub enum Goal<'a> {
    /// At most so many times theirs: the median of the rounds' ratios.
    Times(f64, Ways<'a>),
    AtLeastTimes(f64, Ways<'a>),
    /// At most so much more than theirs, in the metric's unit.
    More(f64, Ways<'a>),
    /// At most this.
    Number(f64),
}

#[derive(Clone, Debug)]
pub struct Claim<'a> {
    pub metric: Metric,
    pub ours: Ways<'a>,
    pub goal: Goal<'a>,
    /// A quantile counts even if it is of fewer times than it takes.
    pub however_few: bool,
    /// What no system can be faster than: said beside.
    pub floor: Option<Ways<'a>>,
    /// Ways of ours that users may choose instead: said where the best of them is better.
    pub instead: Option<Ways<'a>>,
    /// Further metrics of ours that are said.
    pub beside: &'a [Metric],
    /// Why it stays so where it is missed.
    pub cause: Option<&'static str>,
}

/// Judges the claims that these rows are about.
pub fn judge<'a>(rows: &[Row], claims: impl IntoIterator<Item = Claim<'a>>) -> Vec<Verdict> {
    claims.into_iter().filter_map(|claim| claim.judge(rows)).collect()
}

impl<'a> Claim<'a> {
    pub fn new(metric: Metric, ours: Ways<'a>, goal: Goal<'a>) -> Self {
        Claim { metric, ours, goal, however_few: false, floor: None, instead: None, beside: &[], cause: None }
    }

    pub fn because(self, cause: &'static str) -> Self {
        Claim { cause: Some(cause), ..self }
    }

    fn theirs(&self) -> Option<(Ways<'a>, By)> {
        match self.goal {
            Goal::Times(_, theirs) | Goal::AtLeastTimes(_, theirs) => Some((theirs, By::Ratio)),
            Goal::More(_, theirs) => Some((theirs, By::Difference)),
            Goal::Number(_) => None,
        }
    }

    fn is_within(&self, number: f64) -> bool {
        match self.goal {
            Goal::Times(limit, _) | Goal::More(limit, _) | Goal::Number(limit) => number <= limit,
            Goal::AtLeastTimes(limit, _) => number >= limit,
        }
    }

    fn limit(&self) -> String {
        let unit = self.metric.unit();
        match self.goal {
            Goal::Times(limit, _) => format!("at most {}", By::Ratio.show(limit, unit)),
            Goal::AtLeastTimes(limit, _) => format!("at least {}", By::Ratio.show(limit, unit)),
            Goal::More(limit, _) => format!("at most {}", By::Difference.show(limit, unit)),
            Goal::Number(limit) => format!("at most {}", short(limit)),
        }
    }

    /// `None`: ours was not to be measured, or their system takes no part.
    fn judge(&self, rows: &[Row]) -> Option<Verdict> {
        let takes_part = |(theirs, _): (Ways<'_>, By)| rows.iter().any(|row| row.system == theirs.system);
        if !rows.iter().any(|row| self.ours.is_measured(row)) || !self.theirs().is_none_or(takes_part) {
            return None;
        }
        let (figure, is_held, notes) = self.measured(rows);
        let parts =
            [Some(self.ours.experiment.to_owned()), self.ours.size(), Some(self.metric.name().to_owned())];
        Some(Verdict {
            what: parts.into_iter().flatten().collect::<Vec<_>>().join(", "),
            figure,
            goal: self.limit(),
            outcome: is_held.into(),
            note: notes.join("; "),
            cause: self.cause.filter(|_| is_held == Some(false)),
            must: false,
        })
    }

    /// The best of ours beside the best of theirs. What is not fit to be compared never counts for us.
    fn measured(&self, rows: &[Row]) -> (String, Option<bool>, Vec<String>) {
        let (figure, ours) = (self.figure(), self.ours.of(rows));
        let (fit, mut notes) = figure.sort(&ours);
        let Some(us) = figure.best(&fit) else { return self.missing("ours", notes) };
        notes = notes.into_iter().map(|unfit| format!("left out: {unfit}")).collect();
        let unit = self.metric.unit();
        let mut found = format!("{} {} {unit}", us.mode, figure.text(us));
        let mut is_held = figure.median(us).map(|number| self.is_within(number));
        if let Some((side, by)) = self.theirs() {
            let theirs = side.of(rows);
            let (fit, unfit) = figure.sort(&theirs);
            let Some(them) = figure.best(&fit) else {
                return self.missing(side.system, unfit);
            };
            let Some(compared) = Compared::of(us, them, figure, by) else {
                return self.missing("", vec!["no round in which both were measured".to_owned()]);
            };
            found += &format!(", {}", compared.show(unit, &self.name(&side, them)));
            is_held = Some(self.is_within(compared.median)).filter(|is_held| !is_held || unfit.is_empty());
            if is_held.is_none() {
                notes.extend(unfit.into_iter().map(|unfit| format!("not judged: {unfit}")));
            }
            notes.extend(self.at_the_floor(rows, them, by));
        }
        notes.extend(self.better_way(rows, us));
        let beside = |metric: &Metric| {
            let number = Figure::from(*metric).median(ours.first()?)?;
            Some(format!("{} {}", short(number), metric.unit()))
        };
        notes.extend(self.beside.iter().filter_map(beside));
        (found, is_held, notes)
    }

    fn figure(&self) -> Figure {
        Figure { metric: self.metric, however_few: self.however_few }
    }

    fn at_the_floor(&self, rows: &[Row], them: &Row, by: By) -> Option<String> {
        let floors = self.floor?.of(rows);
        let compared = Compared::of(floors.first()?, them, self.figure(), by)?;
        let beyond = if self.is_within(compared.median) { "" } else { ", so no system can meet the goal" };
        Some(format!("the floor is at {}{beyond}", by.show(compared.median, self.metric.unit())))
    }

    /// The best of our other ways, if it is better.
    fn better_way(&self, rows: &[Row], us: &Row) -> Option<String> {
        let figure = self.figure();
        let others = self.instead?.of(rows);
        let (mut all, _) = figure.sort(&others);
        all.insert(0, us);
        let best = figure.best(&all).filter(|best| best.mode != us.mode)?;
        Some(format!("{} {} {}", best.mode, figure.text(best), self.metric.unit()))
    }

    /// What was to be compared, and why there is nothing to judge.
    fn missing(&self, side: &str, unfit: Vec<String>) -> (String, Option<bool>, Vec<String>) {
        let notes = if unfit.is_empty() { vec![format!("{side} not measured")] } else { unfit };
        let theirs = self.theirs().map(|(side, _)| format!("to {} {}", side.system, side.modes.join(", ")));
        let words = [self.ours.modes.join(", "), theirs.unwrap_or_default()];
        (words.join(" ").trim().to_owned(), None, notes)
    }

    /// A row of theirs, and where it was measured if that is elsewhere.
    fn name(&self, side: &Ways<'_>, row: &Row) -> String {
        let place = (side.experiment != self.ours.experiment).then(|| format!(" in {}", side.experiment));
        let size = side.size().filter(|_| side.bytes != self.ours.bytes).map(|size| format!(" at {size}"));
        [Some(row.name()), place, size].into_iter().flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Distribution;
    use crate::rows::Tally;
    use crate::verdict::Outcome::{self, Held, Missed, NotMeasured};

    const HELD: &str = "latency/whole/held-off";

    /// Each round has 10,000 times of so many µs.
    fn row(system: &str, mode: &str, p50s_us: &[f64]) -> Row {
        let mut tally = Tally::default();
        for (index, us) in p50s_us.iter().enumerate() {
            let mut times = Distribution::new();
            times.add(&[((us * 1e3) as u64, 10_000)]);
            tally.add(index as u32 + 1, &times).cpu_us_per_msg = Some(*us);
        }
        tally.row(HELD, system, mode, 64)
    }

    fn ours(p50s_us: &[f64]) -> Row {
        row("tautline", "blocking", p50s_us)
    }

    const OURS: Ways<'static> = Ways { experiment: HELD, bytes: Some(64), system: "tautline", modes: &[] };
    const THEIRS: Ways<'static> = Ways { system: "rival", ..OURS };

    fn faster() -> Claim<'static> {
        Claim::new(Metric::P50, OURS, Goal::Times(1.0, THEIRS))
    }

    fn line(claim: &Claim<'_>, rows: &[Row]) -> String {
        claim.judge(rows).unwrap().to_string()
    }

    fn outcome(claim: &Claim<'_>, rows: &[Row]) -> Outcome {
        claim.judge(rows).unwrap().outcome
    }

    #[test]
    fn the_best_of_each_side_counts_and_what_was_not_measured_is_no_success() {
        let rows = [
            ours(&[6.0]),
            row("tautline", "direct", &[4.0]),
            row("rival", "default", &[10.0]),
            row("rival", "tuned", &[5.0]),
        ];
        assert_eq!(
            line(&faster(), &rows),
            "held          latency/whole/held-off, 64 B, p50: direct 4.00 µs, 0.80 x rival tuned; at most 1.00 x"
        );
        let floor = Some(Ways { system: "floor", ..OURS });
        let blocking = Claim { floor, instead: Some(OURS), ..faster().because("why") };
        let ours_alone = Claim { ours: Ways { modes: &["blocking"], ..OURS }, ..blocking };
        let rows = [&rows[..], &[row("floor", "futex", &[7.5])]].concat();
        let verdict = ours_alone.judge(&rows).unwrap();
        assert_eq!((verdict.outcome, verdict.cause), (Missed, Some("why")));
        assert_eq!(verdict.note, "the floor is at 1.50 x, so no system can meet the goal; direct 4.00 µs");
        assert!(faster().judge(&rows[..2]).is_none(), "a system that takes no part");
        assert!(faster().judge(&rows[2..]).is_none(), "nothing of ours was to be measured");
        let elsewhere = [ours(&[1.0]), Row { experiment: "else".into(), ..row("rival", "x", &[2.0]) }];
        assert!(line(&faster(), &elsewhere).ends_with(", p50: to rival; at most 1.00 x; rival not measured"));
    }

    #[test]
    fn rounds_are_compared_with_their_own_rivals() {
        // The machine was slow in one round and in the next it was not: pooled figures would say 14 against 11.
        let rows = [ours(&[8.0, 16.0, 14.0]), row("rival", "tuned", &[10.0, 20.0, 11.0])];
        assert_eq!(outcome(&faster(), &rows), Held);
        assert!(line(&faster(), &rows).contains("0.80 x rival tuned (0.80 to 1.27 in 3 rounds)"));
        let mut late = rows.clone();
        late[1].rounds.iter_mut().for_each(|round| round.round += 1);
        assert!(line(&faster(), &late).contains("1.15 x rival tuned (0.70 to 1.60 in 2 rounds)"));
    }

    #[test]
    fn what_failed_lost_or_is_of_too_few_is_not_judged() {
        let of = |metric, ours: Row, theirs: Row| outcome(&Claim { metric, ..faster() }, &[ours, theirs]);
        let both = |ours: Row, theirs: Row| {
            [Metric::P50, Metric::P99].map(|of_it| of(of_it, ours.clone(), theirs.clone()))
        };
        let (us, them) = (|| ours(&[6.0]), || row("rival", "default", &[10.0]));
        assert_eq!(both(us(), them()), [Held; 2]);
        assert_eq!(both(Row { lost: 1, ..us() }, them()), [NotMeasured; 2]);
        assert_eq!(both(us(), Row { lost: 1, ..them() }), [NotMeasured; 2]);
        assert_eq!(both(Row { unfit: Some("failed".to_owned()), ..us() }, them()), [NotMeasured; 2]);
        assert_eq!(both(Row { n: 999, ..us() }, them()), [Held, NotMeasured]);
        assert_eq!(both(Row { n: 1000, ..us() }, them()), [Held; 2]);
        let few = Claim { metric: Metric::P99, however_few: true, ..faster() };
        assert_eq!(outcome(&few, &[Row { n: 999, ..us() }, them()]), Held);
        // A better way that lost messages does not count; a rival's that did leaves open who is ahead.
        let other = |system| Row { lost: 1, ..row(system, "lossy", &[1.0]) };
        assert!(
            line(&faster(), &[us(), other("tautline"), them()]).contains("left out: tautline lossy lost 1")
        );
        assert_eq!(outcome(&faster(), &[us(), them(), other("rival")]), NotMeasured);
    }

    #[test]
    fn limits_are_of_a_ratio_a_difference_or_a_number() {
        let rows = [ours(&[8.0]), row("rival", "default", &[4.0])];
        let claim = |metric, goal| Claim::new(metric, OURS, goal);
        let more = line(&claim(Metric::P50, Goal::More(6.0, THEIRS)), &rows);
        assert!(
            more.ends_with("p50: blocking 8.00 µs, +4.00 µs to rival default; at most +6.00 µs"),
            "{more}"
        );
        assert_eq!(outcome(&claim(Metric::CpuTime, Goal::AtLeastTimes(3.0, THEIRS)), &rows), Missed);
        let alone = Claim { beside: &[Metric::CpuTime], ..claim(Metric::P50, Goal::Number(9.5)) };
        assert!(line(&alone, &rows).ends_with("p50: blocking 8.00 µs; at most 9.50; 8.00 µs"));
        let larger = Row { payload_bytes: 128, ..rows[0].clone() };
        let to_larger = Goal::Times(1.0, Ways { bytes: Some(128), ..OURS });
        assert!(
            line(&claim(Metric::P50, to_larger), &[rows[0].clone(), larger])
                .contains("tautline blocking at 128 B;")
        );
    }
}

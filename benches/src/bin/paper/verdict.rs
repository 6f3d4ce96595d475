// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the paper says of its variants, as readings of the rows with their goals.

use tautline_harness::readings::{Reading, judge};
use tautline_harness::verdict::Verdict;
use tautline_paper::{Scheduling, Structure, Variant};

use crate::plan::{Experiment, R2R, TAUTLINE};
use crate::stats::Row;

/// How many times r2r's our p99 may be before it counts as above.
const FACTOR: f64 = 1.01;
/// What share of the prediction p99 may be off before it counts as off.
const SHARE: f64 = 0.05;

/// All verdicts. `capacity` is the depth that the analysis asks for.
pub fn verdicts(rows: &[Row], capacity: usize) -> Vec<Verdict> {
    let systems = [TAUTLINE, R2R];
    let of_variants = systems.map(|system| {
        let of = SystemVariants { system, variants: variants(rows, system) };
        [of.late(), of.others_in_time(), of.fastest_in_time(), of.ablation(), of.nort_tokio()]
    });
    let mut readings: Vec<Reading> = of_variants.into_iter().flatten().collect();
    readings.push(beside_r2r(rows));
    readings.extend(systems.map(|system| prediction(rows, system)));
    readings.extend(capacities(rows, capacity));
    judge(&mut readings)
}

fn variants<'r>(rows: &'r [Row], system: &str) -> Vec<(Variant, Vec<&'r Row>)> {
    let mut found: Vec<(Variant, Vec<&Row>)> = Vec::new();
    for row in rows.iter().filter(|row| row.system == system) {
        let Experiment::Paper(variant) = row.cell.experiment else { continue };
        match found.iter_mut().find(|(other, _)| *other == variant) {
            Some((_, rows)) => rows.push(row),
            None => found.push((variant, vec![row])),
        }
    }
    found
}

fn rows_of<'r>(rows: &'r [Row], system: &str, experiment: Experiment) -> Vec<&'r Row> {
    rows.iter().filter(|row| row.system == system && row.cell.experiment == experiment).collect()
}

/// What was measured of a system's variants.
struct SystemVariants<'r> {
    system: &'static str,
    variants: Vec<(Variant, Vec<&'r Row>)>,
}

impl<'r> SystemVariants<'r> {
    fn reading(&self, what: &str, unit: &'static str, value: f64) -> Reading {
        Reading::of("variants", 0, what, unit).system(self.system).value(value)
    }

    fn rows_of(&self, variant: Variant) -> &[&'r Row] {
        self.variants.iter().find(|(other, _)| *other == variant).map_or(&[], |(_, rows)| &rows[..])
    }

    /// All but the proposed one.
    fn others(&self) -> impl Iterator<Item = &(Variant, Vec<&'r Row>)> + Clone {
        self.variants.iter().filter(|(variant, _)| *variant != Variant::FUTURES_RT)
    }

    fn late(&self) -> Reading {
        let rows = self.rows_of(Variant::FUTURES_RT);
        let bad: u64 = rows.iter().map(|row| row.misses + row.lost).sum();
        let is_whole = rows.iter().all(|row| row.n > 0);
        let value = if is_whole { bad as f64 } else { f64::NAN };
        let of_all = rows.iter().map(|row| row.n).sum::<u64>();
        let note = if is_whole && bad == 0 { format!("of {of_all}") } else { failures(rows) };
        let what = "messages of futures-rt that are late or lost";
        self.reading(what, "messages", value).at_most(0.0).note(note).unfit(unmeasured(rows.is_empty()))
    }

    fn others_in_time(&self) -> Reading {
        let count = self.others().count();
        let meets = |(_, rows): &&(Variant, Vec<&Row>)| rows.iter().all(|row| row.meets_deadline());
        let met: Vec<_> = self.others().filter(meets).map(|(variant, _)| variant.to_string()).collect();
        let note = if met.is_empty() { format!("all {count} fail") } else { met.join(", ") };
        let what = "other variants that meet every deadline";
        self.reading(what, "variants", met.len() as f64).at_most(0.0).note(note).unfit(unmeasured(count == 0))
    }

    fn fastest_in_time(&self) -> Reading {
        let papers = self.others().filter(|(variant, _)| !variant.is_ablation());
        let met = papers.clone().flat_map(|(variant, rows)| {
            let met = rows.iter().take(3).filter(|row| row.meets_deadline());
            met.map(move |row| format!("{variant} {}", row.topic))
        });
        let met: Vec<_> = met.collect();
        let what = "of other variants, topics 1 to 3 that meet their deadlines, unlike in the paper";
        let one = self.reading(what, "topics", met.len() as f64).at_most(0.0).note(met.join(", "));
        one.unfit(unmeasured(papers.count() == 0))
    }

    fn ablation(&self) -> Reading {
        let of_ablation = self.others().filter(|(variant, _)| variant.is_ablation());
        let (mut in_time, mut texts) = (0, Vec::new());
        for (variant, rows) in of_ablation {
            let late: u64 = rows.iter().map(|row| row.misses).sum();
            let n: u64 = rows.iter().map(|row| row.n).sum();
            let first = rows.first().and_then(|row| row.p99_ms);
            in_time += u32::from(late == 0);
            texts.push(format!("{variant} {late} of {n} late, p99 of topic1 {} ms", number(first)));
        }
        let what =
            "variants of futures-rt without the middleware above the callbacks, of which nothing is late";
        let one = self.reading(what, "variants", f64::from(in_time)).at_most(0.0);
        one.note(texts.join("; ")).unfit(unmeasured(texts.is_empty()))
    }

    fn nort_tokio(&self) -> Reading {
        let name = Variant::new(Structure::Tokio, Scheduling::Other);
        let tokio = self.rows_of(name);
        let rivals = self.variants.iter().filter(|(variant, _)| *variant != name && !variant.is_ablation());
        let longest =
            |index: usize| rivals.clone().filter_map(|(_, rows)| rows[index].p99_ms).fold(0.0, f64::max);
        let worst = (0..tokio.len())
            .filter(|index| tokio[*index].p99_ms.is_none_or(|p99| p99 >= longest(*index)))
            .map(|index| tokio[index].topic.as_str());
        let worst: Vec<_> = worst.collect();
        let what = "topics on which nort-tokio has the longest p99 of the paper's variants";
        let one = self.reading(what, "topics", worst.len() as f64).at_least(3.0).note(worst.join(", "));
        one.unfit(unmeasured(tokio.is_empty()))
    }
}

fn unmeasured(is_it: bool) -> Option<&'static str> {
    is_it.then_some("not measured")
}

/// Which topics missed how many deadlines, with the disturbances that may be the reason.
fn failures(rows: &[&Row]) -> String {
    let failed = rows.iter().filter(|row| !row.meets_deadline());
    let texts: Vec<_> = failed
        .map(|row| format!("{} ({} of {} late, {} lost)", row.topic, row.misses, row.n, row.lost))
        .collect();
    let (steal, missed) = rows.first().map_or((0, 0), |row| (row.steal_ticks, row.missed_releases));
    let mut text = texts.join(", ");
    if steal > 0 || missed > 0 {
        text += &format!(
            "; in these runs {steal} ticks of steal, and {missed} releases that the publisher missed"
        );
    }
    text
}

fn beside_r2r(rows: &[Row]) -> Reading {
    let of = |system| rows_of(rows, system, Experiment::Paper(Variant::FUTURES_RT));
    let pairs = of(TAUTLINE).into_iter().zip(of(R2R));
    let pairs = pairs.map(|(ours, theirs)| (ours, theirs.p99_ms));
    let what = format!("p99 of futures-rt above {FACTOR} x r2r's, on the worst topic");
    worst_topic("beside r2r", what, pairs, |ours, theirs| ours - theirs * FACTOR).at_most(0.1)
}

fn prediction(rows: &[Row], system: &'static str) -> Reading {
    let rows = rows_of(rows, system, Experiment::Paper(Variant::FUTURES_RT));
    let pairs = rows.into_iter().take(4).map(|row| (row, row.rta_overhead_ms));
    let percent = SHARE * 100.0;
    let what = format!(
        "p99 of futures-rt off the prediction with overheads by more than {percent:.0} %, worst of topics 1 to 4"
    );
    let off = |p99: f64, predicted: f64| (p99 - predicted).abs() - predicted * SHARE;
    worst_topic("prediction", what, pairs, off).at_most(0.2).system(system)
}

/// By how much a topic's p99 is beyond the other number where it is most; not below 0.
fn worst_topic<'r>(
    experiment: &str,
    what: String,
    pairs: impl Iterator<Item = (&'r Row, Option<f64>)>,
    beyond: fn(f64, f64) -> f64,
) -> Reading {
    let (mut worst, mut texts) = (0.0_f64, Vec::new());
    for (row, other) in pairs {
        // One that is missing makes the whole unknown.
        let here = row.p99_ms.zip(other).map_or(f64::NAN, |(p99, other)| beyond(p99, other));
        worst = if here.is_nan() || worst.is_nan() { f64::NAN } else { worst.max(here) };
        texts.push(format!("{} {} / {}", row.topic, number(row.p99_ms), number(other)));
    }
    let note = format!("{} ms", texts.join(", "));
    Reading::of(experiment, 0, what, "ms").value(worst).note(note).unfit(unmeasured(texts.is_empty()))
}

fn capacities(rows: &[Row], capacity: usize) -> [Reading; 4] {
    let lost = |system: &'static str, depth: usize, what: &str| {
        let rows = rows_of(rows, system, Experiment::Capacity(depth));
        let lost: u64 = rows.iter().map(|row| row.lost).sum();
        let counted: Option<u64> = rows.iter().map(|row| row.counted_lost).sum();
        let published: u64 = rows.iter().map(|row| row.published).sum();
        let runs = rows.first().map_or(0, |row| row.runs);
        let one = Reading::of("capacity", depth, what, "messages").system(system).value(lost as f64);
        let one = one.note(format!("of {published} in {runs} runs")).unfit(unmeasured(published == 0));
        (one, counted.map_or(f64::NAN, |counted| lost.abs_diff(counted) as f64))
    };
    let (computed, _) = lost(TAUTLINE, capacity, "lost with the computed capacity");
    let (one_less, uncounted) = lost(TAUTLINE, capacity - 1, "lost with one place less");
    let what = "lost with one place less, and not counted".to_owned();
    let uncounted = Reading { what, ..one_less.clone() }.value(uncounted).at_most(0.0);
    let (of_r2r, _) = lost(R2R, capacity, "lost by the fixed channel of 10");
    [computed.at_most(0.0), one_less.at_least(1.0), uncounted, of_r2r.at_least(1.0)]
}

fn number(ms: Option<f64>) -> String {
    ms.map_or("-".into(), |ms| format!("{ms:.2}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::{plan, row};
    use tautline_harness::verdict::Outcome::{Held, Missed, NotMeasured};

    const RTA: [f64; 5] = [2.0, 6.0, 13.0, 36.0, 170.0];

    /// futures-rt as predicted, futures late, the deep queue as computed, on both systems.
    fn rows() -> Vec<Row> {
        let mut rows = Vec::new();
        for system in [TAUTLINE, R2R] {
            for (index, rta) in RTA.iter().enumerate() {
                rows.push(row(system, "futures-rt", index, &[rta + 0.05]));
                rows.push(row(system, "futures", index, &[70.0]));
                rows.push(row(system, "futures-rt-mw-below", index, &[70.0]));
            }
            let deep = row(system, "capacity-16", 1, &[77.0]);
            rows.push(Row { lost: if system == R2R { 5 } else { 0 }, ..deep });
        }
        rows.push(Row { lost: 1, counted_lost: Some(1), ..row(TAUTLINE, "capacity-15", 1, &[77.0]) });
        rows
    }

    fn about<'v>(verdicts: &'v [Verdict], words: &str) -> &'v Verdict {
        verdicts.iter().find(|verdict| verdict.what.contains(words)).unwrap()
    }

    #[test]
    fn what_the_paper_found_holds() {
        assert_eq!(plan().capacity.computed(), 16);
        let verdicts = verdicts(&rows(), 16);
        for verdict in &verdicts {
            assert_ne!(verdict.outcome, Missed, "{verdict}");
        }
        // Of nort-tokio nothing was measured, with either system.
        assert_eq!(verdicts.iter().filter(|verdict| verdict.outcome == NotMeasured).count(), 2);
        assert_eq!(verdicts.len(), 17);
    }

    #[test]
    fn what_was_not_measured_does_not_hold() {
        let mut rows = rows();
        rows.retain(|row| row.variant == "futures-rt" || row.variant.starts_with("capacity"));
        rows.iter_mut().filter(|row| row.variant == "capacity-16").for_each(|row| row.published = 0);
        let verdicts = verdicts(&rows, 16);
        for claim in
            ["other variants that meet", "topics 1 to 3", "lost with the computed", "lost by the fixed"]
        {
            assert_eq!(about(&verdicts, claim).outcome, NotMeasured, "{claim}");
        }
    }

    #[test]
    fn what_differs_is_said() {
        let mut rows = rows();
        for row in rows.iter_mut().filter(|row| row.variant == "futures") {
            (row.misses, row.p99_ms) = (0, Some(1.0));
        }
        for row in rows.iter_mut().filter(|row| row.variant == "futures-rt" && row.system == TAUTLINE) {
            (row.misses, row.steal_ticks) = (1, 2);
            row.p99_ms = row.p99_ms.map(|p99| p99 * 1.1);
        }
        let verdicts = verdicts(&rows, 15);
        let late = about(&verdicts, "variants: messages of futures-rt that are late");
        assert_eq!(late.outcome, Missed);
        assert!(late.note.contains("topic1 (1 of 1 late, 0 lost)"), "{late}");
        assert!(late.note.contains("2 ticks of steal"), "{late}");
        assert_eq!(about(&verdicts, "variants, r2r: messages of futures-rt").outcome, Held);
        let others = about(&verdicts, "variants, r2r: other variants");
        assert!(others.outcome == Missed && others.note == "futures", "{others}");
        let fastest = about(&verdicts, "variants: of other variants, topics 1 to 3");
        assert!(
            fastest.to_string().contains("3.00 topics; at most 0; futures topic1, futures topic2"),
            "{fastest}"
        );
        assert_eq!(about(&verdicts, "beside r2r").outcome, Missed);
        assert_eq!(about(&verdicts, "prediction: ").outcome, Missed);
        assert_eq!(about(&verdicts, "prediction, r2r: ").outcome, Held);
        assert_eq!(about(&verdicts, "capacity 15: lost with the computed").outcome, Missed);
        assert_eq!(about(&verdicts, "lost with one place less").outcome, NotMeasured);
    }
}

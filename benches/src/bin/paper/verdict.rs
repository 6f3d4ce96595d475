// SPDX-License-Identifier: MIT OR Apache-2.0
//! What must hold between the rows. A miss is printed, never an error: the machine has its part in it.

use tautline_benches::claims::Verdict;
use tautline_paper::{Scheduling, Structure, Variant};

use crate::plan::{Experiment, System};
use crate::stats::Row;

/// How much longer than r2r's our p99 may be.
const FACTOR: f64 = 1.01;
const SLACK_MS: f64 = 0.1;
/// How far from the prediction p99 may be.
const SHARE: f64 = 0.05;
const MARGIN_MS: f64 = 0.2;

/// All verdicts, in the order in which they are promised. `capacity` is the depth that the analysis asks for.
pub fn verdicts(rows: &[Row], capacity: usize) -> Vec<Verdict> {
    const SYSTEMS: [System; 2] = [System::Tautline, System::R2r];
    let mut verdicts = Vec::new();
    for system in SYSTEMS {
        verdicts.extend([only_futures_rt(rows, system), others_fail(rows, system)]);
    }
    verdicts.push(no_slower_than_r2r(rows));
    verdicts.extend(SYSTEMS.map(|system| as_predicted(rows, system)));
    for system in SYSTEMS {
        verdicts.extend([ablation(rows, system), nort_tokio(rows, system)]);
    }
    verdicts.extend([
        computed_capacity(rows, capacity),
        one_less(rows, capacity),
        fixed_channel(rows, capacity),
    ]);
    verdicts
}

fn variants(rows: &[Row], system: System) -> Vec<(Variant, Vec<&Row>)> {
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

fn rows_of(rows: &[Row], system: System, experiment: Experiment) -> Vec<&Row> {
    rows.iter().filter(|row| row.system == system && row.cell.experiment == experiment).collect()
}

fn unmeasured(claim: String) -> Verdict {
    Verdict::new(claim, "not measured", None)
}

fn only_futures_rt(rows: &[Row], system: System) -> Verdict {
    let claim = format!("{system}: futures-rt, and no other variant, meets every deadline");
    let variants = variants(rows, system);
    let Some((_, proposed)) = variants.iter().find(|(variant, _)| *variant == Variant::FUTURES_RT) else {
        return unmeasured(claim);
    };
    let meets = |rows: &[&Row]| rows.iter().all(|row| row.meets_deadline());
    let others: Vec<_> = variants
        .iter()
        .filter(|(variant, rows)| *variant != Variant::FUTURES_RT && meets(rows))
        .map(|(variant, _)| variant.to_string())
        .collect();
    let mut found = if meets(proposed) {
        let n: u64 = proposed.iter().map(|row| row.n).sum();
        format!("futures-rt had {n} messages, none late, none lost")
    } else {
        format!("futures-rt did not: {}", failures(proposed))
    };
    if variants.len() == 1 {
        found += "; no other was measured";
    } else if others.is_empty() {
        found += &format!("; all {} others failed", variants.len() - 1);
    } else {
        found += &format!("; here these did as well: {}", others.join(", "));
    }
    // That no other does is not known if there is none.
    let is_alone = meets(proposed) && variants.len() == 1;
    Verdict::new(claim, found, (!is_alone).then_some(meets(proposed) && others.is_empty()))
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

fn others_fail(rows: &[Row], system: System) -> Verdict {
    let claim = format!("{system}: every other variant misses deadlines of topics 1 to 3, as in the paper");
    let variants = variants(rows, system);
    let mut differ = Vec::new();
    let mut count = 0;
    for (variant, rows) in &variants {
        if *variant == Variant::FUTURES_RT || variant.is_ablation() {
            continue;
        }
        count += 1;
        let met: Vec<_> =
            rows.iter().take(3).filter(|row| row.meets_deadline()).map(|row| row.topic.as_str()).collect();
        if !met.is_empty() {
            differ.push(format!("{variant} met {}", met.join(", ")));
        }
    }
    if count == 0 {
        return unmeasured(claim);
    }
    let found =
        if differ.is_empty() { format!("all {count} do") } else { format!("here {}", differ.join("; ")) };
    Verdict::new(claim, found, Some(differ.is_empty()))
}

fn no_slower_than_r2r(rows: &[Row]) -> Verdict {
    let claim =
        format!("futures-rt: Tautline's p99 is at most {FACTOR} x r2r's + {SLACK_MS} ms on every topic");
    let of = |system| rows_of(rows, system, Experiment::Paper(Variant::FUTURES_RT));
    let pairs = of(System::Tautline).into_iter().zip(of(System::R2r));
    let pairs = pairs.map(|(ours, theirs)| (ours, theirs.p99_ms));
    each_topic(claim, pairs, |ours, theirs| ours <= theirs * FACTOR + SLACK_MS)
}

fn as_predicted(rows: &[Row], system: System) -> Verdict {
    let claim = format!(
        "{system}: futures-rt's p99 of topics 1 to 4 is within {:.0} % + {MARGIN_MS} ms of the prediction with overheads",
        SHARE * 100.0
    );
    let rows = rows_of(rows, system, Experiment::Paper(Variant::FUTURES_RT));
    let pairs = rows.into_iter().take(4).map(|row| (row, row.rta_overhead_ms));
    each_topic(claim, pairs, |p99, predicted| (p99 - predicted).abs() <= predicted * SHARE + MARGIN_MS)
}

/// Whether each topic's p99 is to the other number as it should be.
fn each_topic<'r>(
    claim: String,
    pairs: impl Iterator<Item = (&'r Row, Option<f64>)>,
    is_right: fn(f64, f64) -> bool,
) -> Verdict {
    let (mut holds, mut texts) = (true, Vec::new());
    for (row, other) in pairs {
        holds &= row.p99_ms.zip(other).is_some_and(|(p99, other)| is_right(p99, other));
        texts.push(format!("{} {} / {}", row.topic, number(row.p99_ms), number(other)));
    }
    match texts.is_empty() {
        true => unmeasured(claim),
        false => Verdict::new(claim, format!("{} ms", texts.join(", ")), Some(holds)),
    }
}

fn ablation(rows: &[Row], system: System) -> Verdict {
    let claim = format!("{system}: without the middleware above the callbacks, futures-rt misses deadlines");
    let of_ablation: Vec<_> =
        variants(rows, system).into_iter().filter(|(variant, _)| variant.is_ablation()).collect();
    if of_ablation.is_empty() {
        return unmeasured(claim);
    }
    let (mut holds, mut texts) = (true, Vec::new());
    for (variant, rows) in &of_ablation {
        let late: u64 = rows.iter().map(|row| row.misses).sum();
        let n: u64 = rows.iter().map(|row| row.n).sum();
        let first = rows.first().and_then(|row| row.p99_ms);
        holds &= late > 0;
        texts.push(format!("{variant} {late} of {n} late, p99 of topic1 {} ms", number(first)));
    }
    Verdict::new(claim, texts.join("; "), Some(holds))
}

fn nort_tokio(rows: &[Row], system: System) -> Verdict {
    let claim =
        format!("{system}: nort-tokio has the longest p99 of the paper's variants on three of five topics");
    let variants = variants(rows, system);
    let name = Variant::new(Structure::Tokio, Scheduling::Other);
    let Some((_, tokio)) = variants.iter().find(|(variant, _)| *variant == name) else {
        return unmeasured(claim);
    };
    let rivals = variants.iter().filter(|(variant, _)| *variant != name && !variant.is_ablation());
    let longest =
        |index: usize| rivals.clone().filter_map(|(_, rows)| rows[index].p99_ms).fold(0.0, f64::max);
    let worst: Vec<_> = (0..tokio.len())
        .filter(|index| tokio[*index].p99_ms.is_none_or(|p99| p99 >= longest(*index)))
        .map(|index| tokio[index].topic.as_str())
        .collect();
    let found = if worst.is_empty() { "on none".into() } else { format!("on {}", worst.join(", ")) };
    Verdict::new(claim, found, Some(worst.len() >= 3))
}

fn computed_capacity(rows: &[Row], capacity: usize) -> Verdict {
    let claim = format!("tautline: with the computed capacity {capacity} nothing is lost");
    lossless(rows_of(rows, System::Tautline, Experiment::Capacity(capacity)), claim, true)
}

fn one_less(rows: &[Row], capacity: usize) -> Verdict {
    let claim = format!("tautline: with {}, messages are lost, and counted", capacity - 1);
    let rows = rows_of(rows, System::Tautline, Experiment::Capacity(capacity - 1));
    let counted: Option<u64> = rows.iter().map(|row| row.counted_lost).sum();
    let lost: u64 = rows.iter().map(|row| row.lost).sum();
    let verdict = lossless(rows, claim, false);
    let counted_word = counted.map_or("not counted".to_owned(), |counted| format!("{counted} counted"));
    Verdict {
        holds: verdict.holds.map(|holds| holds && counted == Some(lost)),
        found: format!("{}, {counted_word} by the subscriptions", verdict.found),
        ..verdict
    }
}

fn fixed_channel(rows: &[Row], capacity: usize) -> Verdict {
    let claim =
        format!("r2r: with quality of service 'keep last {capacity}' its fixed channel of 10 loses messages");
    lossless(rows_of(rows, System::R2r, Experiment::Capacity(capacity)), claim, false)
}

fn lossless(rows: Vec<&Row>, claim: String, wanted: bool) -> Verdict {
    let lost: u64 = rows.iter().map(|row| row.lost).sum();
    let published: u64 = rows.iter().map(|row| row.published).sum();
    if published == 0 {
        return unmeasured(claim);
    }
    let runs = rows[0].runs;
    let found = format!("{lost} of {published} lost in {runs} runs");
    Verdict::new(claim, found, Some((lost == 0) == wanted))
}

fn number(ms: Option<f64>) -> String {
    ms.map_or("-".into(), |ms| format!("{ms:.2}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::{plan, row};

    const RTA: [f64; 5] = [2.0, 6.0, 13.0, 36.0, 170.0];

    /// futures-rt as predicted, futures late, the deep queue as computed, on both systems.
    fn rows() -> Vec<Row> {
        let mut rows = Vec::new();
        for system in [System::Tautline, System::R2r] {
            for (index, rta) in RTA.iter().enumerate() {
                rows.push(row(system, "futures-rt", index, &[rta + 0.05]));
                rows.push(row(system, "futures", index, &[70.0]));
                rows.push(row(system, "futures-rt-mw-below", index, &[70.0]));
            }
            let deep = row(system, "capacity-16", 1, &[77.0]);
            rows.push(Row { lost: if system == System::R2r { 5 } else { 0 }, ..deep });
        }
        rows.push(Row { lost: 1, counted_lost: Some(1), ..row(System::Tautline, "capacity-15", 1, &[77.0]) });
        rows
    }

    fn about<'v>(verdicts: &'v [Verdict], words: &str) -> &'v Verdict {
        verdicts.iter().find(|verdict| verdict.claim.contains(words)).unwrap()
    }

    #[test]
    fn what_the_paper_found_holds() {
        assert_eq!(plan().capacity.computed(), 16);
        for verdict in verdicts(&rows(), 16) {
            assert_ne!(verdict.holds, Some(false), "{verdict}");
        }
    }

    #[test]
    fn what_was_not_measured_does_not_hold() {
        let mut rows = rows();
        rows.retain(|row| row.variant == "futures-rt" || row.variant.starts_with("capacity"));
        rows.iter_mut().filter(|row| row.variant == "capacity-16").for_each(|row| row.published = 0);
        let verdicts = verdicts(&rows, 16);
        for claim in ["r2r: futures-rt, and no other", "every other variant", "computed capacity 16"] {
            assert_eq!(about(&verdicts, claim).holds, None, "{claim}");
        }
    }

    #[test]
    fn what_differs_is_said() {
        let mut rows = rows();
        for row in rows.iter_mut().filter(|row| row.variant == "futures") {
            (row.misses, row.p99_ms) = (0, Some(1.0));
        }
        for row in rows.iter_mut().filter(|row| row.variant == "futures-rt" && row.system == System::Tautline)
        {
            (row.misses, row.steal_ticks) = (1, 2);
            row.p99_ms = row.p99_ms.map(|p99| p99 * 1.1);
        }
        let verdicts = verdicts(&rows, 15);
        let only = about(&verdicts, "tautline: futures-rt, and no other");
        assert_eq!(only.holds, Some(false));
        assert!(only.found.contains("topic1 (1 of 1 late, 0 lost)"), "{only}");
        assert!(
            only.found.contains("2 ticks of steal") && only.found.ends_with("as well: futures"),
            "{only}"
        );
        assert_eq!(about(&verdicts, "r2r: futures-rt, and no other").holds, Some(false));
        assert!(about(&verdicts, "every other variant").found.starts_with("here futures met topic1"));
        assert_eq!(about(&verdicts, "1.01 x r2r").holds, Some(false));
        assert_eq!(about(&verdicts, "tautline: futures-rt's p99").holds, Some(false));
        assert_eq!(about(&verdicts, "r2r: futures-rt's p99").holds, Some(true));
        assert_eq!(about(&verdicts, "computed capacity 15").holds, Some(false));
        assert_eq!(about(&verdicts, "with 14, messages").holds, None);
        assert_eq!(about(&verdicts, "nort-tokio").holds, None);
    }
}

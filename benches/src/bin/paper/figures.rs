// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's figures, drawn anew from the rows of a run.

use tautline_harness::bars::{Bar, Mark, bars};
use tautline_harness::table::short;
use tautline_harness::{Series, histogram};

use crate::Result;
use crate::plan::{R2R, TAUTLINE};
use crate::stats::Row;

fn systems(rows: &[&Row]) -> Vec<&'static str> {
    let is_there = |system: &&str| rows.iter().any(|row| row.system == *system);
    [TAUTLINE, R2R].into_iter().filter(is_there).collect()
}

/// Draws the rows of these variants, in this order, one picture below the other.
///
/// The scale of a topic ends where its longest bar of a real-time variant does; those that are longer end in a triangle.
pub fn p99_bars(rows: &[Row], variants: &[String]) -> Result<String> {
    let rows: Vec<&Row> = rows.iter().filter(|row| variants.contains(&row.variant)).collect();
    let systems = systems(&rows);
    let topics = rows.iter().filter(|row| row.variant == variants[0] && row.system == systems[0]);
    let mut pictures = String::new();
    for topic in topics {
        let mut all = Vec::new();
        for variant in variants {
            for system in &systems {
                let wanted =
                    |row: &&&Row| (row.system, &row.variant, row.index) == (*system, variant, topic.index);
                all.extend(rows.iter().find(wanted).map(|row| bar(row)));
            }
        }
        let realtime =
            rows.iter().filter(|row| row.index == topic.index && !row.variant.starts_with("nort-"));
        let longest = realtime.filter_map(|row| row.p99_ms).fold(0.0, f64::max);
        let end_ms = longest.max(topic.deadline_ms).max(topic.rta_ms.unwrap_or(0.0)) * 1.08;
        let analysis = topic.rta_ms.map_or(String::new(), |ms| format!(", analysis {} (line)", short(ms)));
        let title = format!("{}: p99 in ms, deadline {} (dashed){analysis}", topic.topic, topic.deadline_ms);
        let marks: Vec<Mark> =
            topic.rta_ms.map(Mark::Bound).into_iter().chain([Mark::Deadline(topic.deadline_ms)]).collect();
        pictures += &bars(&title, &all, Some(end_ms), &marks)?.unwrap_or_default();
    }
    Ok(pictures)
}

fn bar(row: &Row) -> Bar {
    Bar {
        label: format!("{} {}", row.variant, row.system),
        system: row.system.to_owned(),
        value: row.p99_ms,
        spread: row.p99_ms.zip(row.p99_std_ms).map(|(p99, deviation)| (p99 - deviation, p99 + deviation)),
        text: row.p99_ms.map_or("nothing received".to_owned(), short),
    }
}

/// Response times of the fastest topic with the middleware above the callbacks and not: a picture for each system.
pub fn ablation_histograms(rows: &[Row], variants: &[String]) -> Result<String> {
    let rows: Vec<&Row> =
        rows.iter().filter(|row| row.index == 0 && variants.contains(&row.variant)).collect();
    let mut pictures = String::new();
    for system in systems(&rows) {
        let of_system: Vec<&Row> = rows.iter().filter(|row| row.system == system).copied().collect();
        let name = |row: &Row| {
            let p99 = row.p99_ms.map_or("-".to_owned(), short);
            format!("{}: p99 {p99} ms, {} late", row.variant, row.misses)
        };
        let times = |row: &&Row| (name(row), row.latencies_ns.iter().map(|ns| (*ns, 1)).collect::<Vec<_>>());
        let times: Vec<_> = of_system.iter().map(times).collect();
        let series: Vec<_> = times.iter().map(|(name, counts)| Series { name, counts }).collect();
        let deadline = of_system.first().map(|row| ("deadline", row.deadline_ms));
        pictures += &histogram(&format!("{system}: response time of topic1"), &series, deadline)?;
    }
    Ok(pictures)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::row;

    #[test]
    fn every_bar_has_its_number_and_what_is_too_long_ends_in_a_triangle() {
        let mut rows: Vec<_> = (0..5).map(|index| row(TAUTLINE, "futures-rt", index, &[1.5])).collect();
        rows.extend((0..5).map(|index| row(R2R, "nort-tokio", index, &[12_345.0])));
        rows.push(row(R2R, "futures", 0, &[77.7]));
        let svg = p99_bars(&rows, &["futures-rt".into(), "nort-tokio".into()]).unwrap();
        assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"));
        let count = |words: &str| svg.matches(words).count();
        assert_eq!((count("1.50"), count("12345"), count("<polygon")), (5, 5, 5));
        assert_eq!(
            (count("topic5: p99 in ms, deadline "), count("nort-tokio r2r"), count("77.7")),
            (1, 5, 0)
        );
    }

    #[test]
    fn a_topic_without_messages_is_named() {
        let rows = [row(TAUTLINE, "tokio", 0, &[])];
        assert!(p99_bars(&rows, &["tokio".into()]).unwrap().contains("nothing received"));
    }

    #[test]
    fn each_variant_of_each_system_has_its_histogram() {
        let variants: Vec<String> = ["futures-rt", "futures-rt-mw-below"].map(str::to_owned).to_vec();
        let mut rows = Vec::new();
        for system in [TAUTLINE, R2R] {
            rows.push(row(system, "futures-rt", 0, &[2.1, 2.2]));
            rows.push(row(system, "futures-rt-mw-below", 0, &[2.1, 68.0]));
            rows.push(row(system, "futures-rt", 1, &[6.0]));
        }
        let svg = ablation_histograms(&rows, &variants).unwrap();
        let count = |words: &str| svg.matches(words).count();
        assert_eq!(
            (count("0 late (n = 2)"), count("1 late (n = 2)"), count("futures-rt-mw-below")),
            (2, 2, 2)
        );
        assert_eq!((count("r2r: response time"), count("deadline")), (1, 2));
    }
}

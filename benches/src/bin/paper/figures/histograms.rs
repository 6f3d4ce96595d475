// SPDX-License-Identifier: MIT OR Apache-2.0
//! Response times of the fastest topic with the middleware above the callbacks and not: a row for each, a column for each
//! system.

use tautline_harness::bars::colour;
use tautline_harness::canvas::{Align, Canvas, DEADLINE, FAINT, GRID, Words};

use super::{systems, ticks};
use crate::Result;
use crate::plan::R2R;
use crate::stats::Row;

const LEFT: i32 = 52;
const COLUMN: i32 = 430;
const GAP: i32 = 50;
const TOP: i32 = 40;
const HEADING: i32 = 26;
const PLOT: i32 = 96;
const ROW: i32 = HEADING + PLOT + 24;
const BINS: usize = 86;
const BIN: i32 = COLUMN / BINS as i32;
/// The scale ends here even if a response time does not.
const LONGEST_MS: f64 = 120.0;

/// Draws the first topic of these variants, a row for each.
pub fn ablation_histograms(rows: &[Row], variants: &[String]) -> Result<String> {
    let rows: Vec<&Row> =
        rows.iter().filter(|row| row.index == 0 && variants.contains(&row.variant)).collect();
    let systems = systems(&rows);
    let longest = rows.iter().filter_map(|row| row.max_ms).fold(0.0, f64::max);
    let deadline_ms = rows.iter().map(|row| row.deadline_ms).fold(0.0, f64::max);
    let end_ms = (longest * 1.05).min(LONGEST_MS).max(deadline_ms * 1.2);
    let size = (LEFT + (COLUMN + GAP) * systems.len() as i32, TOP + ROW * variants.len() as i32 + 20);

    let mut svg = String::new();
    let canvas = Canvas::new(&mut svg, size)?;
    for (place, system) in systems.iter().enumerate() {
        let left = LEFT + (COLUMN + GAP) * place as i32;
        let name = if *system == R2R { "r2r over Fast DDS" } else { "Tautline" };
        canvas.text(name, (left, 18), Words { pixels: 15, ..Words::TITLE })?;
        for (line, variant) in variants.iter().enumerate() {
            let top = TOP + ROW * line as i32;
            if let Some(row) = rows.iter().find(|row| (row.system, &row.variant) == (*system, variant)) {
                draw(&canvas, row, (left, top), end_ms)?;
            }
        }
        let caption = "response time of topic1 in ms; messages (logarithmic)";
        canvas.text(caption, (left + COLUMN / 2, size.1 - 10), Words { pixels: 11, ..Words::SMALL })?;
    }
    canvas.finish()?;
    Ok(svg)
}

fn draw(canvas: &Canvas, row: &Row, (left, top): (i32, i32), end_ms: f64) -> Result<()> {
    canvas.text(&row.variant, (left, top + 12), Words::TITLE)?;
    let p99 = row.p99_ms.map_or("-".into(), |ms| format!("{ms:.2}"));
    let found = format!("n {}, p99 {p99} ms, {} late", row.n, row.misses);
    let colour_of_text = if row.misses > 0 { DEADLINE } else { FAINT };
    let words = Words { colour: colour_of_text, align: Align::Right, ..Words::PLAIN };
    canvas.text(&found, (left + COLUMN, top + 12), words)?;

    let (top, bottom) = (top + HEADING, top + HEADING + PLOT);
    let counts = bins(&row.latencies_ns, end_ms);
    let most = counts.iter().copied().max().unwrap_or(0).max(10);
    // Half a step below 1, so that a single message can be seen.
    let y = |count: u64| {
        let share = ((count as f64).log10() + 0.3) / ((most as f64).log10() + 0.3);
        bottom - (share * f64::from(PLOT)).round() as i32
    };
    for decade in 0..=(most as f64).log10() as u32 {
        let count = 10_u64.pow(decade);
        canvas.line((left, y(count)), (left + COLUMN, y(count)), GRID, 1)?;
        let words = Words { align: Align::Right, ..Words::SMALL };
        canvas.text(&count.to_string(), (left - 6, y(count)), words)?;
    }
    let x = |ms: f64| left + (ms / end_ms * f64::from(BIN * BINS as i32)).round() as i32;
    for ms in ticks(end_ms, 8.0) {
        canvas.text(&format!("{ms}"), (x(ms), bottom + 10), Words::SMALL)?;
    }
    for (bin, count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
        let from = left + bin as i32 * BIN;
        canvas.rectangle((from, y(*count)), (from + BIN - 1, bottom), colour(row.system))?;
    }
    canvas.line((left, bottom), (left + COLUMN, bottom), FAINT, 1)?;
    canvas.deadline(x(row.deadline_ms), top, bottom)
}

/// How many response times lie in each bin; the last holds those beyond the scale.
fn bins(latencies_ns: &[u64], end_ms: f64) -> Vec<u64> {
    let mut counts = vec![0; BINS];
    for latency in latencies_ns {
        let bin = (*latency as f64 / 1e6 / end_ms * BINS as f64) as usize;
        counts[bin.min(BINS - 1)] += 1;
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::TAUTLINE;
    use crate::report::tests::row;

    #[test]
    fn no_response_time_is_left_out() {
        let counts = bins(&[0, 1_000_000, 85_999_999, 86_000_000, 9_000_000_000], 86.0);
        assert_eq!((counts[0], counts[1], counts[85], counts.iter().sum::<u64>()), (1, 1, 3, 5));
    }

    #[test]
    fn each_variant_of_each_system_has_its_own() {
        let variants: Vec<String> = ["futures-rt", "futures-rt-mw-below"].map(str::to_owned).to_vec();
        let mut rows = Vec::new();
        for system in [TAUTLINE, R2R] {
            rows.push(row(system, "futures-rt", 0, &[2.1, 2.2]));
            rows.push(row(system, "futures-rt-mw-below", 0, &[2.1, 68.0]));
            rows.push(row(system, "futures-rt", 1, &[6.0]));
        }
        let svg = ablation_histograms(&rows, &variants).unwrap();
        let count = |words: &str| svg.matches(words).count();
        assert_eq!((count("0 late"), count("1 late"), count("futures-rt-mw-below")), (2, 2, 2));
    }
}

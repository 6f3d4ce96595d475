// SPDX-License-Identifier: MIT OR Apache-2.0
//! 99th percentiles: a row for each variant, a column for each topic, a bar for each system.

use plotters::style::{RGBColor, WHITE};
use tautline_harness::canvas::{Align, Canvas, FAINT, GRID, INK, Words};
use tautline_harness::table::short;

use super::{BOUND, colour, label, on_bar, systems, ticks};
use crate::Result;
use crate::plan::System;
use crate::stats::Row;

const LABELS: i32 = 176;
const COLUMN: i32 = 164;
const GAP: i32 = 18;
const TOP: i32 = 78;
const BAR: i32 = 11;
const BETWEEN: i32 = 9;
const BOTTOM: i32 = 26;
const WHISKER: RGBColor = RGBColor(20, 20, 20);

/// Draws the rows of these variants, in this order.
///
/// The scale of a topic ends where its longest bar of a real-time variant does; those that are longer end in a triangle.
pub fn p99_bars(rows: &[Row], variants: &[String]) -> Result<String> {
    let rows: Vec<&Row> = rows.iter().filter(|row| variants.contains(&row.variant)).collect();
    let systems = systems(&rows);
    let topics: Vec<&Row> =
        rows.iter().filter(|row| row.variant == variants[0] && row.system == systems[0]).copied().collect();
    let step = BAR * systems.len() as i32 + BETWEEN;
    let bottom = TOP + step * variants.len() as i32;
    let size = (LABELS + (COLUMN + GAP) * topics.len() as i32 + 10, bottom + BOTTOM);

    let mut svg = String::new();
    let canvas = Canvas::new(&mut svg, size)?;
    legend(&canvas, &systems)?;
    for (index, variant) in variants.iter().enumerate() {
        let y = TOP + step * index as i32 + (step - BETWEEN) / 2;
        let bold = variant == "futures-rt";
        canvas.text(variant, (LABELS - 12, y), Words { align: Align::Right, bold, ..Words::PLAIN })?;
    }
    for (index, topic) in topics.iter().enumerate() {
        let column =
            Column { left: LABELS + (COLUMN + GAP) * index as i32, bottom, end_ms: end_ms(&rows, topic) };
        column.draw_frame(&canvas, topic)?;
        let mut bars = Vec::new();
        for (place, variant) in variants.iter().enumerate() {
            for (turn, system) in systems.iter().enumerate() {
                let wanted =
                    |row: &&&Row| (row.system, &row.variant, row.index) == (*system, variant, topic.index);
                let y = TOP + step * place as i32 + BAR * turn as i32;
                bars.extend(rows.iter().find(wanted).map(|row| (*row, y)));
            }
        }
        bars.iter().try_for_each(|(row, y)| column.draw_bar(&canvas, row, *y))?;
        column.draw_lines(&canvas, topic)?;
        bars.iter().try_for_each(|(row, y)| column.draw_number(&canvas, row, *y))?;
    }
    canvas.finish()?;
    Ok(svg)
}

fn end_ms(rows: &[&Row], topic: &Row) -> f64 {
    let realtime = rows.iter().filter(|row| row.index == topic.index && !row.variant.starts_with("nort-"));
    let longest = realtime.filter_map(|row| row.p99_ms).fold(0.0, f64::max);
    longest.max(topic.deadline_ms).max(topic.rta_ms.unwrap_or(0.0)) * 1.08
}

struct Column {
    left: i32,
    bottom: i32,
    end_ms: f64,
}

impl Column {
    fn x(&self, ms: f64) -> i32 {
        self.left + (ms.clamp(0.0, self.end_ms) / self.end_ms * f64::from(COLUMN)).round() as i32
    }

    fn draw_frame(&self, canvas: &Canvas, topic: &Row) -> Result<()> {
        canvas.text(&topic.topic, (self.left, TOP - 30), Words::TITLE)?;
        let period = format!("deadline {} ms", topic.deadline_ms);
        let words = Words { align: Align::Right, ..Words::SMALL };
        canvas.text(&period, (self.left + COLUMN, TOP - 30), words)?;
        for ms in ticks(self.end_ms, 4.0) {
            canvas.line((self.x(ms), TOP - 12), (self.x(ms), self.bottom), GRID, 1)?;
            canvas.text(&format!("{ms}"), (self.x(ms), self.bottom + 10), Words::SMALL)?;
        }
        canvas.line((self.left, TOP - 12), (self.left, self.bottom), FAINT, 1)
    }

    fn draw_bar(&self, canvas: &Canvas, row: &Row, top: i32) -> Result<()> {
        let (middle, Some(p99)) = (top + BAR / 2, row.p99_ms) else { return Ok(()) };
        let end = self.x(p99);
        canvas.rectangle((self.left, top), (end, top + BAR - 1), colour(row.system))?;
        if p99 > self.end_ms {
            return canvas.beyond(end, middle, colour(row.system));
        }
        let Some(deviation) = row.p99_std_ms.filter(|deviation| *deviation > 0.0) else { return Ok(()) };
        draw_whisker(canvas, [self.x(p99 - deviation), self.x(p99 + deviation)], middle)
    }

    /// The bar's number: beside the bar and its whisker if there is room, else within it; over lines that pass there.
    fn draw_number(&self, canvas: &Canvas, row: &Row, top: i32) -> Result<()> {
        let middle = top + BAR / 2;
        let Some(p99) = row.p99_ms else {
            let words = Words { align: Align::Left, ..Words::SMALL };
            return canvas.text("nothing received", (self.left + 4, middle), words);
        };
        // A bar that goes beyond the scale has no whisker.
        let deviation = row.p99_std_ms.filter(|_| p99 <= self.end_ms).unwrap_or(0.0);
        let text = short(p99);
        let width = 6 * text.len() as i32 + 6;
        let beside = self.x(p99 + deviation) + 4;
        let (left, background, colour) = if beside + width < self.left + COLUMN {
            (beside, WHITE, INK)
        } else {
            (self.x(p99 - deviation) - 4 - width, colour(row.system), on_bar(row.system))
        };
        canvas.rectangle((left, top), (left + width, top + BAR - 1), background)?;
        let words = Words { pixels: 10, colour, align: Align::Centre, bold: true };
        canvas.text(&text, (left + width / 2, middle), words)
    }

    /// The bound and the deadline, over the bars.
    fn draw_lines(&self, canvas: &Canvas, topic: &Row) -> Result<()> {
        if let Some(rta) = topic.rta_ms {
            canvas.line((self.x(rta), TOP - 12), (self.x(rta), self.bottom), BOUND, 1)?;
        }
        canvas.deadline(self.x(topic.deadline_ms), TOP - 12, self.bottom)
    }
}

fn draw_whisker(canvas: &Canvas, ends: [i32; 2], y: i32) -> Result<()> {
    canvas.line((ends[0], y), (ends[1], y), WHISKER, 1)?;
    ends.into_iter().try_for_each(|x| canvas.line((x, y - 3), (x, y + 3), WHISKER, 1))
}

fn legend(canvas: &Canvas, systems: &[System]) -> Result<()> {
    let y = 18;
    let mut x = LABELS;
    for system in systems {
        canvas.rectangle((x, y - 6), (x + 12, y + 6), colour(*system))?;
        canvas.text(label(*system), (x + 18, y), Words::PLAIN)?;
        x += 44 + 7 * label(*system).len() as i32;
    }
    draw_whisker(canvas, [x, x + 20], y)?;
    canvas.text("standard deviation of the runs", (x + 28, y), Words::PLAIN)?;
    canvas.line((x + 232, y - 8), (x + 232, y + 8), BOUND, 1)?;
    canvas.text("response-time analysis", (x + 240, y), Words::PLAIN)?;
    canvas.deadline(x + 396, y - 8, y + 8)?;
    canvas.text("deadline (ms)", (x + 404, y), Words::PLAIN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::row;

    #[test]
    fn every_bar_has_its_number_and_what_is_too_long_ends_in_a_triangle() {
        let mut rows: Vec<_> =
            (0..5).map(|index| row(System::Tautline, "futures-rt", index, &[1.5])).collect();
        rows.extend((0..5).map(|index| row(System::R2r, "nort-tokio", index, &[12_345.0])));
        rows.push(row(System::R2r, "futures", 0, &[77.7]));
        let svg = p99_bars(&rows, &["futures-rt".into(), "nort-tokio".into()]).unwrap();
        assert!(svg.starts_with("<svg ") && svg.trim_end().ends_with("</svg>"));
        let count = |words: &str| svg.matches(words).count();
        assert_eq!((count("1.50"), count("12345"), count("<polygon")), (5, 5, 5));
        assert_eq!(
            (count("topic5"), count("Tautline"), count("r2r over Fast DDS"), count("77.7")),
            (1, 1, 1, 0)
        );
    }

    #[test]
    fn a_topic_without_messages_is_named() {
        let rows = [row(System::Tautline, "tokio", 0, &[])];
        assert!(p99_bars(&rows, &["tokio".into()]).unwrap().contains("nothing received"));
    }
}

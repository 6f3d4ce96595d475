// SPDX-License-Identifier: MIT OR Apache-2.0
//! The picture of a demo run: for each topic a histogram of its response times, with prediction and deadline.
use plotters::style::text_anchor::HPos;
use plotters::style::{FontTransform, RGBColor, WHITE};

use super::report::{DemoReport, TopicReport};
use crate::verb::{Failure, Outcome};

mod bins;
pub mod canvas;

use bins::Bins;
use canvas::{Canvas, DEADLINE, bold, text};

const WIDTH: i32 = 960;
const LEFT: i32 = 76;
/// Each bin is this many pixels wide, its gap included.
const BIN: i32 = 5;
const BINS: i32 = 170;
const RIGHT: i32 = LEFT + BINS * BIN;
const TOP: i32 = 98;
const BOTTOM: i32 = 34;
/// Height of a panel: its heading, the plot, and the numbers below.
const PANEL: i32 = 136;
const HEADING: i32 = 24;
const PLOT: i32 = 80;
/// Room above the highest bar, where the mark of p99 goes.
const HEADROOM: i32 = 12;

pub const INK: RGBColor = RGBColor(34, 40, 49);
pub const FAINT: RGBColor = RGBColor(102, 110, 122);
pub const GRID: RGBColor = RGBColor(226, 230, 235);
const ON_TIME: RGBColor = RGBColor(76, 132, 196);
const LATE: RGBColor = RGBColor(226, 102, 82);

/// Draws the report as a self-contained SVG document.
///
/// # Errors
/// There is nothing to draw, or the drawing library fails.
pub fn render_svg(report: &DemoReport) -> Outcome<String> {
    if report.topics.is_empty() {
        return Err(Failure::unusable("the report has no topics: a picture needs at least one"));
    }
    let panels = i32::try_from(report.topics.len()).unwrap_or(i32::MAX).min(1_000);
    let height = TOP + PANEL * panels + BOTTOM;
    let mut svg = String::new();
    let canvas = Canvas::new(&mut svg, (WIDTH, height));
    canvas.rectangle((0, 0), (WIDTH, height), WHITE)?;
    draw_title(&canvas, report)?;
    for (panel, topic) in (0..panels).zip(&report.topics) {
        draw_topic(&canvas, topic, TOP + PANEL * panel)?;
    }
    let middle = TOP + PANEL * panels / 2;
    let upright = text(12, FAINT, HPos::Center).transform(FontTransform::Rotate270);
    canvas.text("messages (logarithmic)", (22, middle), upright)?;
    let caption = "response time in ms, from scheduled release to end of callback";
    canvas.text(caption, ((LEFT + RIGHT) / 2, height - 20), text(12, FAINT, HPos::Center))?;
    canvas.finish()?;
    Ok(svg)
}

fn draw_title(canvas: &Canvas, report: &DemoReport) -> Outcome {
    let title = "Response times: predicted and measured";
    canvas.text(title, (LEFT, 28), bold(text(20, INK, HPos::Left)))?;
    let kernel = format!("Linux {} ({})", shorten(&report.kernel, 26), shorten(&report.preemption, 16));
    canvas.text(&kernel, (RIGHT, 28), text(12, FAINT, HPos::Right))?;
    let circumstances = format!(
        "{} · {:.0} s on core {} · {:.1} µs of middleware per message · steal {} ticks",
        if report.realtime { "real-time" } else { "not real-time: no bound applies" },
        report.seconds,
        report.core,
        report.overhead_us,
        report.steal_ticks
    );
    let colour = if report.realtime { FAINT } else { DEADLINE };
    canvas.text(&circumstances, (LEFT, 52), text(12, colour, HPos::Left))?;

    let y = 76;
    let label = |x, words| canvas.text(words, (x, y), text(12, INK, HPos::Left));
    canvas.rectangle((LEFT, y - 6), (LEFT + 12, y + 6), ON_TIME)?;
    label(LEFT + 18, "on time")?;
    canvas.rectangle((LEFT + 90, y - 6), (LEFT + 102, y + 6), LATE)?;
    label(LEFT + 108, "late")?;
    canvas.mark(LEFT + 166, y - 4)?;
    label(LEFT + 178, "p99")?;
    canvas.line((LEFT + 236, y - 8), (LEFT + 236, y + 8), INK, 2)?;
    label(LEFT + 246, "predicted worst case (RTA + overhead)")?;
    canvas.dashed(LEFT + 524, y - 8, y + 8)?;
    label(LEFT + 534, "deadline")
}

fn draw_topic(canvas: &Canvas, topic: &TopicReport, top: i32) -> Outcome {
    let bins = Bins::new(topic, BINS as usize);
    let x = |time_ms: f64| LEFT + (time_ms / bins.bin_ms * f64::from(BIN)).round() as i32;
    draw_heading(canvas, topic, bins.beyond, top + 12)?;
    let (top, bottom) = (top + HEADING, top + HEADING + PLOT);

    // Grid and numbers: powers of ten upwards, round times to the right.
    let most = bins.counts.iter().copied().max().unwrap_or(0).max(10);
    let decades = (most as f64).log10();
    let y = |count: u64| {
        // Half a step below 1, so that a single message can be seen.
        let share = ((count as f64).log10() + 0.3) / (decades + 0.3);
        bottom - (share * f64::from(PLOT - HEADROOM)).round() as i32
    };
    let every = if decades > 4.5 { 2 } else { 1 };
    for decade in (0..=decades as u32).step_by(every) {
        let y = y(10_u64.pow(decade));
        canvas.line((LEFT, y), (RIGHT, y), GRID, 1)?;
        let number = 10_u64.pow(decade).to_string();
        canvas.text(&number, (LEFT - 8, y), text(11, FAINT, HPos::Right))?;
    }
    let step = round_step(bins.end_ms() / 8.0);
    for tick in 0..=(bins.end_ms() / step) as u32 {
        let time = f64::from(tick) * step;
        let x = x(time);
        canvas.line((x, bottom), (x, bottom + 4), FAINT, 1)?;
        let number = format!("{}", (time * 1e6).round() / 1e6);
        canvas.text(&number, (x, bottom + 13), text(11, FAINT, HPos::Center))?;
    }

    let longest = x(topic.max_ms.unwrap_or(0.0).min(bins.end_ms()));
    for (bin, count) in bins.counts.iter().enumerate().filter(|(_, count)| **count > 0) {
        let colour = if bin >= bins.on_time { LATE } else { ON_TIME };
        let from = LEFT + bin as i32 * BIN;
        // The last bar ends where the measurement does, so that it never seems to pass the prediction.
        let to = (from + BIN - 1).min(longest.max(from + 2));
        canvas.rectangle((from, y(*count)), (to, bottom), colour)?;
    }
    canvas.line((LEFT, bottom), (RIGHT, bottom), FAINT, 1)?;
    canvas.dashed(x(topic.deadline_ms), top, bottom)?;
    if let Some(bound) = topic.rta_overhead_ms.filter(|bound| *bound <= bins.end_ms()) {
        canvas.line((x(bound) + 1, top), (x(bound) + 1, bottom), INK, 2)?;
    }
    match topic.p99_ms {
        Some(p99) => canvas.mark(x(p99.min(bins.end_ms())), top + 1),
        None => {
            let middle = ((LEFT + RIGHT) / 2, (top + bottom) / 2);
            canvas.rectangle((middle.0 - 90, middle.1 - 12), (middle.0 + 90, middle.1 + 12), WHITE)?;
            canvas.text("no message received", middle, text(13, FAINT, HPos::Center))
        }
    }
}

/// The two texts above the plot: the topic, and its result.
fn draw_heading(canvas: &Canvas, topic: &TopicReport, off_scale: u64, y: i32) -> Outcome {
    let name = shorten(&topic.topic, 20);
    canvas.text(&name, (LEFT, y), bold(text(13, INK, HPos::Left)))?;
    let mut found = format!("n {}", topic.n);
    if let (Some(p99), Some(max)) = (topic.p99_ms, topic.max_ms) {
        found += &format!(" · p99 {p99:.2} · max {max:.2}");
    }
    found +=
        &topic.rta_overhead_ms.map_or(" · no bound".into(), |bound| format!(" · predicted {bound:.2} ms"));
    found += &format!(" · {} late", topic.deadline_misses);
    if topic.lost > 0 {
        found += &format!(", {} lost", topic.lost);
    }
    if off_scale > 0 {
        found += &format!(" ({off_scale} off scale)");
    }
    let failed = topic.deadline_misses > 0 || topic.lost > 0 || topic.n == 0;
    let colour = if failed { DEADLINE } else { INK };
    canvas.text(&found, (RIGHT, y), text(12, colour, HPos::Right))?;

    let what =
        format!("every {} ms, {} ms of work, priority {}", topic.period_ms, topic.wcet_ms, topic.priority);
    // Generous estimates of text widths, because the viewer chooses the font. Text that does not fit is omitted.
    let width = |text: &str, per_char: f64| (text.chars().count() as f64 * per_char) as i32;
    let from = LEFT + width(&name, 8.0) + 16;
    if from + width(&what, 6.5) + width(&found, 6.5) > RIGHT {
        return Ok(());
    }
    canvas.text(&what, (from, y), text(12, FAINT, HPos::Left))
}

/// The largest of 1, 2, 5, 10, ... (or their decimal parts) that does not exceed the wish by half.
pub fn round_step(wish: f64) -> f64 {
    let decade = 10_f64.powf(wish.log10().floor());
    let factor = [10.0, 5.0, 2.0, 1.0].into_iter().find(|factor| factor * decade <= wish * 1.5);
    factor.unwrap_or(1.0) * decade
}

pub fn shorten(text: &str, most: usize) -> String {
    if text.chars().count() <= most {
        return text.to_owned();
    }
    text.chars().take(most - 1).chain(['…']).collect()
}

#[cfg(test)]
mod tests;

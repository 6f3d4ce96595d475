// SPDX-License-Identifier: MIT OR Apache-2.0
//! The pictures: lines over a logarithmic or a plain scale, and bars with their spread.

use plotters::style::{RGBColor, WHITE};
use tautline_harness::canvas::{Align, Canvas, FAINT, GRID, INK, Words};
use tautline_harness::rows::Row;
use tautline_harness::table::{short, size};

use crate::Result;

const LEFT: i32 = 70;
const WIDTH: i32 = 720;
const LABELS: i32 = 230;
const TOP: i32 = 40;
const HEIGHT: i32 = 400;
/// Lines of at most so many points have a mark at each.
const MARKED: usize = 12;
/// Between two labels.
const LABEL: i32 = 14;
const BAR: i32 = 20;

/// A system's colour.
fn colour(system: &str) -> RGBColor {
    match system {
        "tautline" => RGBColor(28, 98, 196),
        "floor" => RGBColor(120, 126, 134),
        "iceoryx2" => RGBColor(0, 148, 120),
        "fastdds" => RGBColor(214, 96, 22),
        "cyclonedds" => RGBColor(150, 84, 180),
        "r2r" => RGBColor(200, 40, 70),
        "zenoh" => RGBColor(150, 130, 0),
        "hiroz" => RGBColor(90, 70, 40),
        "taktora" => RGBColor(110, 190, 60),
        _ => RGBColor(60, 160, 200),
    }
}

/// Of a system's ways, one after the other.
const DASHES: [i32; 9] = [0, 8, 3, 14, 5, 2, 20, 11, 1];
/// Less is a copy of some bytes, which would take half of a logarithmic scale.
const LEAST_US: f64 = 0.1;

/// A line of a picture.
pub struct Line {
    pub label: String,
    pub colour: RGBColor,
    /// How many pixels of a line are drawn before as many are left out; 0: all are drawn.
    pub dash: i32,
    pub points: Vec<(f64, f64)>,
}

impl Line {
    /// Of a system; its modes differ by their dashes.
    fn of(row: &Row, points: Vec<(f64, f64)>, turn: usize) -> Self {
        let label = row.name();
        Line { label, colour: colour(&row.system), dash: DASHES[turn % DASHES.len()], points }
    }
}

/// An axis: what it says, where its marks are, whether it is logarithmic.
struct Axis {
    title: &'static str,
    marks: Vec<(f64, String)>,
    is_log: bool,
}

impl Axis {
    /// The share of the axis at which a number is.
    fn place(&self, number: f64) -> f64 {
        let scaled = |number: f64| if self.is_log { number.max(1e-9).log10() } else { number };
        let (from, to) = (scaled(self.marks[0].0), scaled(self.marks[self.marks.len() - 1].0));
        ((scaled(number) - from) / (to - from).max(1e-9)).clamp(0.0, 1.0)
    }

    /// Decades of µs from the least to the most of some numbers.
    fn decades(numbers: impl Iterator<Item = f64> + Clone) -> Self {
        let least = numbers.clone().fold(f64::INFINITY, f64::min).max(1e-3).log10().floor();
        let most = numbers.fold(0.0, f64::max).max(1e-3).log10().ceil().max(least + 1.0);
        let mark = |exponent: i32| {
            let us = 10_f64.powi(exponent);
            (us, if us >= 1000.0 { format!("{} ms", us / 1000.0) } else { format!("{us} µs") })
        };
        Axis { title: "", marks: (least as i32..=most as i32).map(mark).collect(), is_log: true }
    }
}

/// Medians by size, both scales logarithmic.
pub fn latency_by_size(rows: &[Row], experiment: &str) -> Result<Option<String>> {
    let point = |row: &Row| Some((row.payload_bytes as f64, row.p50_us.filter(|p50| *p50 >= LEAST_US)?));
    let lines = lines_of(rows, experiment, point);
    let mut sizes: Vec<usize> =
        rows.iter().filter(|row| row.experiment == experiment).map(|row| row.payload_bytes).collect();
    sizes.sort_unstable();
    sizes.dedup();
    if lines.is_empty() || sizes.len() < 2 {
        return Ok(None);
    }
    let marks = sizes.iter().map(|&bytes| (bytes as f64, size(bytes))).collect();
    let x = Axis { title: "payload", marks, is_log: true };
    let times = lines.iter().flat_map(|line| line.points.iter().map(|point| point.1));
    chart(&lines, &x, &Axis { title: "half a round trip, p50", ..Axis::decades(times) }).map(Some)
}

/// Shares of the messages by time.
pub fn distributions(
    rows: &[Row],
    experiment: &str,
    bytes: usize,
    axis: &'static str,
) -> Result<Option<String>> {
    let mut lines: Vec<Line> = Vec::new();
    for row in rows.iter().filter(|row| row.experiment == experiment && row.payload_bytes == bytes) {
        let Some(details) = row.details.as_ref().filter(|_| row.mode != "memcpy") else { continue };
        let mut sum = 0;
        let share = |(time_ns, count): (u64, u64)| {
            sum += count;
            (time_ns as f64 / 1e3, sum as f64 / details.times.len() as f64)
        };
        let points = details.times.counts().into_iter().map(share).collect();
        let turn = lines.iter().filter(|line| line.colour == colour(&row.system)).count();
        lines.push(Line::of(row, points, turn));
    }
    if lines.is_empty() {
        return Ok(None);
    }
    // The last one in ten thousand is in the table.
    for line in &mut lines {
        // But at least one point: all times may be the same.
        let kept = line.points.partition_point(|point| point.1 < 0.9999).max(1);
        line.points.truncate(kept);
    }
    lines.retain(|line| !line.points.is_empty());
    let times = lines.iter().flat_map(|line| line.points.iter().map(|point| point.0));
    let x = Axis { title: axis, ..Axis::decades(times) };
    let marks = (0..=4).map(|quarter| (f64::from(quarter) * 0.25, format!("{} %", quarter * 25))).collect();
    chart(&lines, &x, &Axis { title: "messages", marks, is_log: false }).map(Some)
}

/// Times to the last subscription by their number.
pub fn fan_out(rows: &[Row], kind: &str) -> Result<Option<String>> {
    let count = |row: &Row| row.experiment.strip_prefix(kind)?.strip_prefix('/')?.parse::<u32>().ok();
    let mut lines: Vec<Line> = Vec::new();
    for row in rows.iter().filter(|row| count(row).is_some()) {
        let Some(point) = count(row).map(f64::from).zip(row.p50_us) else { continue };
        add_point(&mut lines, row, point);
    }
    let mut counts: Vec<u32> = rows.iter().filter_map(count).collect();
    counts.sort_unstable();
    counts.dedup();
    if lines.is_empty() || counts.len() < 2 {
        return Ok(None);
    }
    let marks = counts.iter().map(|&count| (f64::from(count), count.to_string())).collect();
    let x = Axis { title: "subscriptions", marks, is_log: true };
    let times = lines.iter().flat_map(|line| line.points.iter().map(|point| point.1));
    chart(&lines, &x, &Axis { title: "to the last one, p50", ..Axis::decades(times) }).map(Some)
}

fn lines_of(rows: &[Row], experiment: &str, point: impl Fn(&Row) -> Option<(f64, f64)>) -> Vec<Line> {
    let mut lines = Vec::new();
    for row in rows.iter().filter(|row| row.experiment == experiment) {
        if let Some(point) = point(row) {
            add_point(&mut lines, row, point);
        }
    }
    lines
}

fn add_point(lines: &mut Vec<Line>, row: &Row, point: (f64, f64)) {
    let label = row.name();
    match lines.iter_mut().find(|line| line.label == label) {
        Some(line) => line.points.push(point),
        None => {
            let turn = lines.iter().filter(|line| line.colour == colour(&row.system)).count();
            lines.push(Line::of(row, vec![point], turn));
        }
    }
}

fn chart(lines: &[Line], x: &Axis, y: &Axis) -> Result<String> {
    let mut svg = String::new();
    let height = HEIGHT.max(LABEL * lines.len() as i32);
    let canvas = Canvas::new(&mut svg, (LEFT + WIDTH + LABELS, TOP + height + 46))?;
    let (right, bottom) = (LEFT + WIDTH, TOP + height);
    let at = |(across, up): (f64, f64)| {
        let across = LEFT + (x.place(across) * f64::from(WIDTH)).round() as i32;
        (across, bottom - (y.place(up) * f64::from(height)).round() as i32)
    };
    for (number, text) in &x.marks {
        let (place, _) = at((*number, y.marks[0].0));
        canvas.line((place, TOP), (place, bottom), GRID, 1)?;
        canvas.text(text, (place, bottom + 14), Words::SMALL)?;
    }
    for (number, text) in &y.marks {
        let (_, place) = at((x.marks[0].0, *number));
        canvas.line((LEFT, place), (right, place), GRID, 1)?;
        canvas.text(text, (LEFT - 8, place), Words { align: Align::Right, ..Words::SMALL })?;
    }
    canvas.text(y.title, (LEFT, TOP - 18), Words::PLAIN)?;
    canvas.text(x.title, (right, bottom + 32), Words { align: Align::Right, ..Words::PLAIN })?;
    for line in lines {
        let mut points: Vec<_> = line.points.iter().map(|point| at(*point)).collect();
        points.dedup();
        let mut drawn = 0.0;
        for pair in points.windows(2) {
            drawn = dashed(&canvas, pair[0], pair[1], line, drawn)?;
        }
        if points.len() <= MARKED {
            for (across, up) in points {
                canvas.rectangle((across - 2, up - 2), (across + 3, up + 3), line.colour)?;
            }
        }
    }
    label(&canvas, lines, |line| at(line.points[line.points.len() - 1]).1, (right, bottom))?;
    canvas.finish()?;
    Ok(svg)
}

/// Each line's label beside its end, moved where two would cover one another.
fn label(
    canvas: &Canvas,
    lines: &[Line],
    end: impl Fn(&Line) -> i32,
    (right, bottom): (i32, i32),
) -> Result<()> {
    let mut ends: Vec<(i32, &Line)> = lines.iter().map(|line| (end(line), line)).collect();
    ends.sort_by_key(|(place, _)| *place);
    // Downwards as far as needed, then upwards from the bottom.
    for index in 1..ends.len() {
        ends[index].0 = ends[index].0.max(ends[index - 1].0 + LABEL);
    }
    let mut limit = bottom;
    for (place, _) in ends.iter_mut().rev() {
        *place = (*place).min(limit);
        limit = *place - LABEL;
    }
    for (place, line) in ends {
        dashed(canvas, (right + 8, place), (right + 36, place), line, 0.0)?;
        canvas.text(&line.label, (right + 42, place), Words { pixels: 11, ..Words::PLAIN })?;
    }
    Ok(())
}

/// Draws a piece of a line of which so many pixels are drawn already; returns how many then are.
fn dashed(canvas: &Canvas, from: (i32, i32), to: (i32, i32), line: &Line, drawn: f64) -> Result<f64> {
    let length = f64::from(to.0 - from.0).hypot(f64::from(to.1 - from.1));
    if line.dash == 0 {
        canvas.line(from, to, line.colour, 2)?;
        return Ok(drawn + length);
    }
    let along = |done: f64| {
        let share = (done / length).clamp(0.0, 1.0);
        let between = |a: i32, b: i32| (f64::from(a) + f64::from(b - a) * share).round() as i32;
        (between(from.0, to.0), between(from.1, to.1))
    };
    let dash = f64::from(line.dash);
    // Where the dash began that the piece before ended in.
    let mut start = -(drawn % (2.0 * dash));
    while start < length {
        if start + dash > 0.0 {
            canvas.line(along(start), along(start + dash), line.colour, 2)?;
        }
        start += 2.0 * dash;
    }
    Ok(drawn + length)
}

/// A bar and its spread.
pub struct Bar {
    pub label: String,
    pub system: String,
    pub value: f64,
    /// From the least to the most.
    pub spread: Option<(f64, f64)>,
    pub text: String,
}

impl Bar {
    /// Of a row's number.
    pub fn new(row: &Row, value: f64, spread: Option<(f64, f64)>) -> Self {
        let label = row.name();
        Bar { label, system: row.system.clone(), value, spread, text: short(value) }
    }
}

/// Bars from 0; the scale ends where the longest bar does, or at `end` if that is less: longer ones then end in a triangle.
pub fn bars(title: &str, bars: &[Bar], end: Option<f64>) -> Result<Option<String>> {
    if bars.is_empty() {
        return Ok(None);
    }
    let most = bars.iter().map(|bar| bar.spread.map_or(bar.value, |spread| spread.1.max(bar.value)));
    let most = most.fold(0.0, f64::max);
    let end = end.map_or(most, |end| end.min(most)).max(1e-9);
    let (left, width) = (LABELS, WIDTH - 60);
    let mut svg = String::new();
    let canvas = Canvas::new(&mut svg, (left + width + 90, TOP + BAR * bars.len() as i32 + 10))?;
    canvas.text(title, (10, 18), Words::TITLE)?;
    let x = |value: f64| left + (value.min(end) / end * f64::from(width)).round() as i32;
    for (index, bar) in bars.iter().enumerate() {
        let top = TOP + BAR * index as i32;
        let middle = top + (BAR - 4) / 2;
        canvas.text(&bar.label, (left - 10, middle), Words { align: Align::Right, ..Words::PLAIN })?;
        canvas.rectangle((left, top), (x(bar.value).max(left + 1), top + BAR - 4), colour(&bar.system))?;
        let mut beside = x(bar.value);
        if bar.value > end {
            canvas.beyond(beside, middle, colour(&bar.system))?;
            beside += 6;
        } else if let Some((least, most)) = bar.spread.filter(|(least, most)| most > least) {
            let (from, to) = (x(least), x(most));
            canvas.line((from, middle), (to, middle), INK, 1)?;
            canvas.line((from, middle - 4), (from, middle + 4), INK, 1)?;
            canvas.line((to, middle - 4), (to, middle + 4), INK, 1)?;
            beside = beside.max(to);
        }
        canvas.rectangle(
            (beside + 4, top),
            (beside + 6 + 7 * bar.text.len() as i32, top + BAR - 4),
            WHITE,
        )?;
        let words = Words { pixels: 11, align: Align::Left, ..Words::SMALL };
        canvas.text(&bar.text, (beside + 6, middle), Words { colour: INK, ..words })?;
    }
    canvas.line((left, TOP - 4), (left, TOP + BAR * bars.len() as i32), FAINT, 1)?;
    canvas.finish()?;
    Ok(Some(svg))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::row;
    use tautline_harness::Distribution;
    use tautline_harness::rows::Details;

    #[test]
    fn every_line_and_every_bar_has_its_label() {
        let mut rows = Vec::new();
        for (bytes, us) in [(64, 6.0), (1 << 20, 60.0)] {
            rows.push(row("latency/whole/held-off", "tautline", "blocking", bytes, us));
            rows.push(row("latency/whole/held-off", "fastdds", "default", bytes, us * 2.0));
            rows.push(row("latency/whole/as-shipped", "fastdds", "tuned", bytes, us));
        }
        let svg = latency_by_size(&rows, "latency/whole/held-off").unwrap().unwrap();
        let count = |words: &str| svg.matches(words).count();
        assert_eq!((count("tautline blocking"), count("fastdds default"), count("fastdds tuned")), (1, 1, 0));
        assert_eq!((count("1 MiB"), count("10 µs")), (1, 1));
        let all: Vec<_> =
            rows.iter().map(|row| Bar::new(row, row.p50_us.unwrap(), Some((1.0, 70.0)))).collect();
        let svg = bars("title", &all, Some(50.0)).unwrap().unwrap();
        assert_eq!((svg.matches("<polygon").count(), svg.matches("fastdds default").count()), (3, 2));
        assert!(bars("title", &[], None).unwrap().is_none());
    }

    #[test]
    fn times_that_are_all_the_same_are_a_line_too() {
        let mut times = Distribution::new();
        times.record(5000);
        let details = Details { times, messages_per_s: 1.0, cpu_share: 0.0, steal_ticks: 0, wakes: None };
        let row = Row { details: Some(details), ..row("x", "tautline", "blocking", 64, 5.0) };
        let svg = distributions(&[row], "x", 64, "time").unwrap().unwrap();
        assert!(svg.contains("tautline blocking"));
    }

    #[test]
    fn labels_do_not_cover_one_another() {
        let rows: Vec<_> = ["a", "b", "c"].map(|mode| row("x", "tautline", mode, 64, 5.0)).into();
        let mut all = rows;
        all.extend(["a", "b", "c"].map(|mode| row("x", "tautline", mode, 512, 5.0)));
        let svg = latency_by_size(&all, "x").unwrap().unwrap();
        let places: Vec<&str> = svg
            .split("<text ")
            .filter(|text| text.contains("tautline"))
            .filter_map(|text| text.split(" y=\"").nth(1)?.split('"').next())
            .collect();
        let distinct: std::collections::BTreeSet<_> = places.iter().collect();
        assert_eq!((places.len(), distinct.len()), (3, 3));
    }
}

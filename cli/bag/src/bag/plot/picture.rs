// SPDX-License-Identifier: MIT OR Apache-2.0
//! The picture: lines over time, with axes, a legend and the bag's name.

use super::columns::{Columns, Point};
use plotters::style::text_anchor::HPos;
use plotters::style::{RGBColor, WHITE};
use taut_cli::date::date;
use taut_cli::demo::plot::canvas::{Canvas, bold, text};
use taut_cli::demo::plot::{FAINT, GRID, INK, round_step, shorten};
use taut_cli::verb::Outcome;

/// The palette of Okabe and Ito, which people of any colour vision can distinguish, without its yellow, which is too pale for a line.
pub const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(0, 0, 0),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
];

/// The width of a letter in pixels, in the widest of the usual fonts.
const LETTER: f64 = 7.4;
const MARGIN: i32 = 20;
const TITLE: i32 = 40;
const LEGEND: i32 = 20;
/// The height of the numbers and their label below the picture.
const BELOW: i32 = 46;
/// Points that are at least this far apart are marked.
const APART: i32 = 12;
/// Greater numbers are shown as differences from the first one.
const MOST_DIGITS: f64 = 1e7;

const MOST_TICKS: u32 = 1000;

pub struct Picture<'p> {
    /// The bag's name.
    pub name: String,
    /// The time of reception of the bag's first message.
    pub start_ns: u64,
    pub from_ns: u64,
    pub to_ns: u64,
    /// Width and height in pixels.
    pub size: (i32, i32),
    pub series: Vec<&'p Series>,
}

/// One line of the picture.
pub struct Series {
    pub name: String,
    pub columns: Columns,
    /// A bool, which is drawn in steps: it keeps its value until it changes.
    pub is_step: bool,
    pub messages: u64,
    /// Messages without a number.
    pub gaps: u64,
}

/// The frame of the plot in pixels, and the ranges of its axes.
struct Frame {
    left: i32,
    right: i32,
    top: i32,
    bottom: i32,
    from_ns: u64,
    to_ns: u64,
    low: f64,
    high: f64,
}

impl Frame {
    fn x(&self, at_ns: u64) -> i32 {
        let share = at_ns.saturating_sub(self.from_ns) as f64 / (self.to_ns - self.from_ns).max(1) as f64;
        self.left + (share.min(1.0) * f64::from(self.right - self.left)).round() as i32
    }

    fn y(&self, value: f64) -> i32 {
        let share = (value - self.low) / (self.high - self.low);
        self.bottom - (share.clamp(0.0, 1.0) * f64::from(self.bottom - self.top)).round() as i32
    }
}

impl Picture<'_> {
    /// Draws a self-contained SVG document.
    ///
    /// # Errors
    /// The drawing library fails.
    pub fn draw(&self) -> Outcome<String> {
        let (width, height) = self.size;
        let (low, high) = self.values();
        let legend = self.legend(width - 2 * MARGIN);
        let rows = legend.last().map_or(0, |(_, row, _)| *row) + 1;
        let top = TITLE + LEGEND * rows + 14;
        let bottom = (height - BELOW).max(top + 40);
        let ticks = Ticks::new(low, high, f64::from(bottom - top) / 40.0);
        let left = MARGIN + (ticks.widest() as f64 * LETTER) as i32 + 6;
        let (right, from_ns, to_ns) = (width - MARGIN - 10, self.from_ns, self.to_ns);
        let frame = Frame { left, right, top, bottom, from_ns, to_ns, low, high };

        let mut svg = String::new();
        let canvas = Canvas::new(&mut svg, self.size);
        canvas.rectangle((0, 0), (width, height), WHITE)?;
        self.draw_title(&canvas, right)?;
        for ((x, row, name), colour) in legend.into_iter().zip(COLOURS) {
            let y = TITLE + LEGEND * row + 8;
            canvas.rectangle((x, y - 2), (x + 18, y + 2), colour)?;
            canvas.text(&name, (x + 24, y), text(12, INK, HPos::Left))?;
        }
        ticks.draw(&canvas, &frame)?;
        self.draw_times(&canvas, &frame)?;
        for (series, colour) in self.series.iter().zip(COLOURS) {
            for line in series.columns.lines() {
                draw_line(&canvas, &frame, &line, series.is_step, colour)?;
            }
        }
        canvas.line((left, top), (left, bottom), FAINT, 1)?;
        canvas.line((left, bottom), (right, bottom), FAINT, 1)?;
        canvas.finish()?;
        Ok(svg)
    }

    /// The lowest value and the highest, with some room around.
    fn values(&self) -> (f64, f64) {
        let ranges = self.series.iter().filter_map(|series| series.columns.range());
        let all = ranges.reduce(|one, other| (one.0.min(other.0), one.1.max(other.1)));
        let (low, high) = all.unwrap_or((0.0, 1.0));
        // A smaller range is rounding noise, and is drawn as one value.
        let least = (low.abs().max(high.abs()) * 1e-12).max(f64::MIN_POSITIVE * 1e10);
        let room = if high - low > least { (high - low) * 0.05 } else { (low.abs() * 0.1).max(0.5) };
        (low - room, high + room)
    }

    fn draw_title(&self, canvas: &Canvas, right: i32) -> Outcome {
        let seconds = (self.to_ns - self.from_ns) as f64 / 1e9;
        let when = format!("{} UTC · {} s", date(self.start_ns.cast_signed()), plain(seconds, 3));
        let letters = f64::from(right - MARGIN) - when.chars().count() as f64 * LETTER - 20.0;
        let name = shorten(&printable(&self.name), ((letters / 10.5) as usize).max(8));
        canvas.text(&name, (MARGIN, 24), bold(text(16, INK, HPos::Left)))?;
        canvas.text(&when, (right, 24), text(12, FAINT, HPos::Right))
    }

    /// The x position, the row and the label of each entry.
    fn legend(&self, width: i32) -> Vec<(i32, i32, String)> {
        let (mut x, mut row, mut entries) = (MARGIN, 0, Vec::new());
        for series in &self.series {
            let mut gaps = String::new();
            if series.gaps > 0 {
                gaps = format!(" ({} of {} are gaps)", series.gaps, series.messages);
            }
            let letters = (f64::from(width - 24) / LETTER) as usize;
            let name = printable(&series.name);
            let name = shorten(&name, letters.saturating_sub(gaps.chars().count()).max(8)) + &gaps;
            let long = 24 + (name.chars().count() as f64 * LETTER) as i32 + 16;
            if x > MARGIN && x + long > MARGIN + width {
                (x, row) = (MARGIN, row + 1);
            }
            entries.push((x, row, name));
            x += long;
        }
        entries
    }

    /// The axis of time, from the bag's beginning.
    fn draw_times(&self, canvas: &Canvas, frame: &Frame) -> Outcome {
        let span_ns = (self.to_ns - self.from_ns).max(1) as f64;
        let (unit, unit_ns) = match span_ns {
            span if span < 2e4 => ("µs", 1e3),
            span if span < 2e7 => ("ms", 1e6),
            _ => ("s", 1e9),
        };
        let first = (self.from_ns - self.start_ns) as f64 / unit_ns;
        let last = first + span_ns / unit_ns;
        let letters = plain(last, 0).len() as f64 + 3.0;
        let most = (f64::from(frame.right - frame.left) / (letters * LETTER + 34.0)).max(2.0);
        let step = round_step((last - first) / most);
        let digits = decimals(step);
        // Limited, because far from zero two ticks may round to the same number.
        let ticks = (0..MOST_TICKS).map(|n| ((first / step).ceil() + f64::from(n)) * step);
        for time in ticks.take_while(|time| *time <= last * (1.0 + 1e-12)) {
            let x = frame.x(self.start_ns.saturating_add((time * unit_ns).round() as u64));
            canvas.line((x, frame.top), (x, frame.bottom), GRID, 1)?;
            canvas.line((x, frame.bottom), (x, frame.bottom + 4), FAINT, 1)?;
            let style = text(11, FAINT, HPos::Center);
            canvas.text(&plain(time, digits), (x, frame.bottom + 14), style)?;
        }
        let caption = format!("time since the bag's first message, in {unit}");
        let middle = i32::midpoint(frame.left, frame.right);
        canvas.text(&caption, (middle, frame.bottom + 33), text(12, FAINT, HPos::Center))
    }
}

/// The numbers beside the axis of values.
struct Ticks {
    values: Vec<f64>,
    labels: Vec<String>,
    /// The number to add to each label.
    base: Option<String>,
}

impl Ticks {
    fn new(low: f64, high: f64, many: f64) -> Self {
        let step = round_step((high - low) / many.max(2.0));
        let values: Vec<f64> = (0..MOST_TICKS)
            .map(|n| ((low / step).ceil() + f64::from(n)) * step)
            .take_while(|value| *value <= high)
            .collect();
        let most = low.abs().max(high.abs());
        let first = values.first().copied().unwrap_or(low);
        // Times since 1970 and positions on a map change only in the last digits of long numbers.
        let is_far = most / step > MOST_DIGITS;
        let (base, label): (_, Box<dyn Fn(f64) -> String>) = if is_far {
            let base = if most >= 1e15 { format!("{first:e}") } else { plain(first, decimals(step)) };
            (Some(base), Box::new(move |value| plain_or_short(value - first, step)))
        } else {
            (None, Box::new(move |value| plain_or_short(value, step)))
        };
        let labels = values.iter().map(|value| label(*value)).collect();
        Ticks { values, labels, base }
    }

    fn widest(&self) -> usize {
        self.labels.iter().map(|label| label.chars().count()).max().unwrap_or(0)
    }

    fn draw(&self, canvas: &Canvas, frame: &Frame) -> Outcome {
        for (value, label) in self.values.iter().zip(&self.labels) {
            let y = frame.y(*value);
            canvas.line((frame.left, y), (frame.right, y), GRID, 1)?;
            canvas.line((frame.left - 4, y), (frame.left, y), FAINT, 1)?;
            canvas.text(label, (frame.left - 8, y), text(11, FAINT, HPos::Right))?;
        }
        let Some(base) = &self.base else { return Ok(()) };
        let words = format!("numbers are added to {base}");
        canvas.text(&words, (frame.left + 6, frame.top - 8), text(11, FAINT, HPos::Left))
    }
}

/// Draws a line, with marks at its points if they are sparse.
fn draw_line(canvas: &Canvas, frame: &Frame, line: &[Point], is_step: bool, colour: RGBColor) -> Outcome {
    let mut points: Vec<_> = line.iter().map(|(at_ns, value)| (frame.x(*at_ns), frame.y(*value))).collect();
    points.dedup();
    let width = points.last().zip(points.first()).map_or(0, |(last, first)| last.0 - first.0);
    let is_sparse = points.len() == 1 || width / APART >= points.len() as i32;
    let corner = |pair: &[(i32, i32)]| [pair[0], (pair[1].0, pair[0].1)];
    if is_step && let Some(last) = points.last() {
        let steps: Vec<_> = points.windows(2).flat_map(corner).chain([*last]).collect();
        canvas.path(&steps, colour, 1)?;
    } else if points.len() > 1 {
        canvas.path(&points, colour, 1)?;
    }
    if is_sparse {
        points.iter().try_for_each(|(x, y)| canvas.rectangle((x - 2, y - 2), (x + 2, y + 2), colour))?;
    }
    Ok(())
}

/// The number of decimals of a multiple of the step.
fn decimals(step: f64) -> usize {
    (-step.log10().floor()).clamp(0.0, 12.0) as usize
}

/// Formats a number without an exponent, and without a sign before zero.
fn plain(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    let is_zero = !text.contains(|c: char| c.is_ascii_digit() && c != '0');
    if is_zero { text.trim_start_matches('-').to_owned() } else { text }
}

/// Formats a number, with an exponent if it is too long without one.
fn plain_or_short(value: f64, step: f64) -> String {
    if value.abs() < step / 2.0 {
        return "0".to_owned();
    }
    if (1e-5..1e7).contains(&step) && value.abs() < 1e8 {
        return plain(value, decimals(step));
    }
    let digits = (value.abs().log10().floor() - step.log10().floor()).clamp(0.0, 9.0) as usize;
    format!("{value:.digits$e}")
}

/// Leaves out the characters that an SVG document must not contain.
fn printable(name: &str) -> String {
    name.chars().filter(|c| !c.is_control() && !('\u{fffe}'..='\u{ffff}').contains(c)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_time_has_an_end() {
        let ns = 1_000_000_000;
        for (from_ns, to_ns) in [
            (0, 0),
            (0, u64::MAX),
            (u64::MAX, u64::MAX),
            (1_763_918_546 * ns, 1_763_918_546 * ns + 1000),
            (5 * ns, 5 * ns + 7_000_000),
            (0, 90_000 * ns),
        ] {
            let mut columns = Columns::new(from_ns, to_ns, 300);
            [from_ns, to_ns].into_iter().for_each(|at_ns| columns.add(at_ns, Some(1.0)));
            let name = "/a.\u{1}<b>".to_owned();
            let series = Series { name, columns, is_step: false, messages: 2, gaps: 1 };
            let series = vec![&series];
            let name = "long".repeat(100);
            let picture = Picture { name, start_ns: 0, from_ns, to_ns, size: (320, 200), series };
            let svg = picture.draw().unwrap();
            assert!(svg.contains("/a.&lt;b&gt; (1 of 2 are gaps)") && svg.len() < 1_000_000, "{svg}");
        }
    }

    #[test]
    fn numbers_are_short_and_none_is_twice() {
        for (low, high) in [
            (-1.05, 1.05),
            (0.0, 1e-9),
            (1_763_918_546.0, 1_763_918_556.5),
            (-3e12, 9e12),
            (0.1 + 1e9, 0.2 + 1e9),
            (-1e300, 1e300),
            (99.5, 100.5),
            (4.9e5, 5.1e5),
        ] {
            let ticks = Ticks::new(low, high, 8.0);
            assert!((3..=20).contains(&ticks.values.len()), "{low} {high}: {:?}", ticks.labels);
            let mut labels = ticks.labels.clone();
            labels.dedup();
            assert_eq!(labels, ticks.labels);
            assert!(ticks.widest() <= 12, "{:?}", ticks.labels);
            assert!(ticks.values.iter().all(|value| (low..=high).contains(value)));
        }
        assert_eq!(Ticks::new(-0.105, 0.105, 4.0).labels, ["-0.10", "-0.05", "0", "0.05", "0.10"]);
    }
}

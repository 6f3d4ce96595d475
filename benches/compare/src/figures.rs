// SPDX-License-Identifier: MIT OR Apache-2.0
//! The pictures of lines, over a logarithmic or a plain scale.

use std::collections::BTreeMap;

use tautline_harness::bars::colour;
use tautline_harness::canvas::{Align, Canvas, GRID, Words};
use tautline_harness::rows::Row;
use tautline_harness::table::size;

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

/// Of a system's ways, one after the other.
const DASHES: [i32; 9] = [0, 8, 3, 14, 5, 2, 20, 11, 1];
/// Less is a copy of some bytes, which would take half of a logarithmic scale.
const LEAST_US: f64 = 0.1;

/// What the overview shows beside the floor: of the systems that were measured the first six, with their names for people and the ways
/// that sleep while they wait (none: all), of which the best counts at each size.
const OVERVIEW: [(&str, &str, &[&str]); 7] = [
    ("tautline", "Tautline", &["blocking", "direct"]),
    ("fastdds", "Fast DDS", &[]),
    ("cyclonedds", "Cyclone DDS", &[]),
    ("iceoryx2", "iceoryx2", &["waitset"]),
    ("zenoh", "Zenoh", &[]),
    ("r2r", "r2r", &[]),
    ("hiroz", "hiroz", &[]),
];
const HEADING: [&str; 2] = [
    "Half a round trip, by payload",
    "median; payload written and read whole; each system's best way that sleeps while it waits; both scales logarithmic, lower is better",
];

/// A line of a picture, in its system's colour.
struct Line {
    label: String,
    system: String,
    /// How many pixels of a line are drawn before as many are left out; 0: all are drawn.
    dash: i32,
    width: u32,
    points: Vec<(f64, f64)>,
}

/// The points of a row's way; the ways of a system differ by their dashes.
fn points<'l>(lines: &'l mut Vec<Line>, row: &Row) -> &'l mut Vec<(f64, f64)> {
    let (label, system) = (row.name(), row.system.clone());
    let known = lines.iter().position(|line| line.label == label);
    let at = known.unwrap_or(lines.len());
    if known.is_none() {
        let turn = lines.iter().filter(|line| line.system == system).count();
        let dash = DASHES[turn % DASHES.len()];
        lines.push(Line { label, system, dash, width: 2, points: Vec::new() });
    }
    &mut lines[at].points
}

/// An axis: what it says, where its marks are, whether it is logarithmic.
struct Axis<'a> {
    title: &'a str,
    marks: Vec<(f64, String)>,
    is_log: bool,
}

impl Axis<'_> {
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
        let marks = (least as i32..=most as i32).map(|exponent| mark(10_f64.powi(exponent))).collect();
        Axis { title: "", marks, is_log: true }
    }

    /// The same with marks at 1, 2 and 5, no farther than needed.
    fn steps(numbers: impl Iterator<Item = f64> + Clone) -> Self {
        let least = numbers.clone().fold(f64::INFINITY, f64::min);
        let most = numbers.fold(0.0, f64::max);
        let all = (-1..6).flat_map(|exponent| [1.0, 2.0, 5.0].map(|step| step * 10_f64.powi(exponent)));
        let is_needed = |us: &f64| us * 2.5 > least && *us < most * 2.5;
        Axis { title: "", marks: all.filter(is_needed).map(mark).collect(), is_log: true }
    }
}

fn mark(us: f64) -> (f64, String) {
    (us, if us >= 1000.0 { format!("{} ms", us / 1000.0) } else { format!("{us} µs") })
}

/// Medians by size of a few systems and the floor.
pub fn overview(rows: &[Row], experiment: &str) -> Result<Option<String>> {
    let line = |system: &str, label: &str, modes: &[&str], width| {
        let is_of_it = |row: &&Row| {
            (&*row.experiment, &*row.system) == (experiment, system)
                && (modes.is_empty() || modes.contains(&&*row.mode))
        };
        let mut best: BTreeMap<usize, f64> = BTreeMap::new();
        for (row, us) in rows.iter().filter(is_of_it).filter_map(|row| Some((row, row.p50_us?))) {
            best.entry(row.payload_bytes).and_modify(|best| *best = best.min(us)).or_insert(us);
        }
        let points = best.into_iter().map(|(bytes, us)| (bytes as f64, us)).collect();
        Line { label: label.to_owned(), system: system.to_owned(), dash: 0, width, points }
    };
    let of_systems = OVERVIEW.map(|(system, label, modes)| line(system, label, modes, 2));
    let floor = line("floor", "floor: a bare futex", &["futex"], 2);
    let mut lines: Vec<Line> = of_systems.into_iter().filter(|line| line.points.len() > 1).take(6).collect();
    lines.extend(Some(floor).filter(|line| line.points.len() > 1));
    let Some(longest) = lines.iter().max_by_key(|line| line.points.len()) else { return Ok(None) };
    let marks = longest.points.iter().map(|(bytes, _)| (*bytes, size(*bytes as usize))).collect();
    // Above all others.
    lines.reverse();
    lines.iter_mut().filter(|line| line.system == "tautline").for_each(|line| line.width = 4);
    let times = lines.iter().flat_map(|line| line.points.iter().map(|point| point.1));
    chart(&lines, &Axis { title: "", marks, is_log: true }, &Axis::steps(times), Some(HEADING)).map(Some)
}

/// Medians by size.
pub fn latency_by_size(rows: &[Row], experiment: &str) -> Result<Option<String>> {
    let bytes = |row: &Row| (row.experiment == experiment).then_some(row.payload_bytes);
    by_number(rows, ["payload", "half a round trip, p50"], size, bytes)
}

/// Times to the last subscription by their number.
pub fn fan_out(rows: &[Row], kind: &str) -> Result<Option<String>> {
    let count = |row: &Row| row.experiment.strip_prefix(kind)?.strip_prefix('/')?.parse().ok();
    by_number(rows, ["subscriptions", "to the last one, p50"], |count| count.to_string(), count)
}

/// Medians by a number that some rows have, both scales logarithmic; their titles, across first.
fn by_number(
    rows: &[Row],
    titles: [&str; 2],
    mark: fn(usize) -> String,
    number: impl Fn(&Row) -> Option<usize>,
) -> Result<Option<String>> {
    let (mut lines, mut numbers) = (Vec::new(), Vec::new());
    for (row, number) in rows.iter().filter_map(|row| Some((row, number(row)?))) {
        numbers.push(number);
        if let Some(p50) = row.p50_us.filter(|p50| *p50 >= LEAST_US) {
            points(&mut lines, row).push((number as f64, p50));
        }
    }
    numbers.sort_unstable();
    numbers.dedup();
    if lines.is_empty() || numbers.len() < 2 {
        return Ok(None);
    }
    let marks = numbers.into_iter().map(|number| (number as f64, mark(number))).collect();
    let x = Axis { title: titles[0], marks, is_log: true };
    let times = lines.iter().flat_map(|line| line.points.iter().map(|point| point.1));
    chart(&lines, &x, &Axis { title: titles[1], ..Axis::decades(times) }, None).map(Some)
}

/// Shares of the messages by time.
pub fn distributions(rows: &[Row], experiment: &str, bytes: usize, axis: &str) -> Result<Option<String>> {
    let mut lines: Vec<Line> = Vec::new();
    for row in rows.iter().filter(|row| row.experiment == experiment && row.payload_bytes == bytes) {
        let Some(details) = row.details.as_ref().filter(|_| row.mode != "memcpy") else { continue };
        let mut sum = 0;
        let share = |(time_ns, count): (u64, u64)| {
            sum += count;
            (time_ns as f64 / 1e3, sum as f64 / details.times.len() as f64)
        };
        points(&mut lines, row).extend(details.times.counts().into_iter().map(share));
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
    chart(&lines, &x, &Axis { title: "messages", marks, is_log: false }, None).map(Some)
}

/// With a heading, a line and one that explains it, labels have their lines' colours in place of a piece of the line.
fn chart(lines: &[Line], x: &Axis<'_>, y: &Axis<'_>, heading: Option<[&str; 2]>) -> Result<String> {
    let mut svg = String::new();
    let height = HEIGHT.max(LABEL * lines.len() as i32);
    let top = if heading.is_some() { 2 * TOP } else { TOP };
    let labels = if heading.is_some() { LABELS - 50 } else { LABELS };
    let canvas = Canvas::new(&mut svg, (LEFT + WIDTH + labels, top + height + 46))?;
    let (right, bottom) = (LEFT + WIDTH, top + height);
    if let Some([title, explanation]) = heading {
        canvas.text(title, (LEFT, 26), Words { pixels: 20, ..Words::TITLE })?;
        canvas.text(explanation, (LEFT, 52), Words { pixels: 12, align: Align::Left, ..Words::SMALL })?;
    }
    let at = |(across, up): (f64, f64)| {
        let across = LEFT + (x.place(across) * f64::from(WIDTH)).round() as i32;
        (across, bottom - (y.place(up) * f64::from(height)).round() as i32)
    };
    for (number, text) in &x.marks {
        let (place, _) = at((*number, y.marks[0].0));
        canvas.line((place, top), (place, bottom), GRID, 1)?;
        canvas.text(text, (place, bottom + 14), Words::SMALL)?;
    }
    for (number, text) in &y.marks {
        let (_, place) = at((x.marks[0].0, *number));
        canvas.line((LEFT, place), (right, place), GRID, 1)?;
        canvas.text(text, (LEFT - 8, place), Words { align: Align::Right, ..Words::SMALL })?;
    }
    canvas.text(y.title, (LEFT, top - 18), Words::PLAIN)?;
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
                canvas.rectangle((across - 2, up - 2), (across + 3, up + 3), colour(&line.system))?;
            }
        }
    }
    label(
        &canvas,
        lines,
        |line| at(line.points[line.points.len() - 1]).1,
        (right, bottom),
        heading.is_some(),
    )?;
    canvas.finish()?;
    Ok(svg)
}

/// Each line's label beside its end, moved where two would cover one another.
fn label(
    canvas: &Canvas,
    lines: &[Line],
    end: impl Fn(&Line) -> i32,
    (right, bottom): (i32, i32),
    is_coloured: bool,
) -> Result<()> {
    let mut ends: Vec<(i32, &Line)> = lines.iter().map(|line| (end(line), line)).collect();
    ends.sort_by_key(|(place, _)| *place);
    let apart = if is_coloured { LABEL + 3 } else { LABEL };
    // Downwards as far as needed, then upwards from the bottom.
    for index in 1..ends.len() {
        ends[index].0 = ends[index].0.max(ends[index - 1].0 + apart);
    }
    let mut limit = bottom;
    for (place, _) in ends.iter_mut().rev() {
        *place = (*place).min(limit);
        limit = *place - apart;
    }
    for (place, line) in ends {
        if is_coloured {
            let words =
                Words { pixels: 13, colour: colour(&line.system), bold: line.width > 2, ..Words::PLAIN };
            canvas.text(&line.label, (right + 10, place), words)?;
            continue;
        }
        dashed(canvas, (right + 8, place), (right + 36, place), line, 0.0)?;
        canvas.text(&line.label, (right + 42, place), Words { pixels: 11, ..Words::PLAIN })?;
    }
    Ok(())
}

/// Draws a piece of a line of which so many pixels are drawn already; returns how many then are.
fn dashed(canvas: &Canvas, from: (i32, i32), to: (i32, i32), line: &Line, drawn: f64) -> Result<f64> {
    let length = f64::from(to.0 - from.0).hypot(f64::from(to.1 - from.1));
    if line.dash == 0 {
        canvas.line(from, to, colour(&line.system), line.width)?;
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
            canvas.line(along(start), along(start + dash), colour(&line.system), line.width)?;
        }
        start += 2.0 * dash;
    }
    Ok(drawn + length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::tests::row;
    use tautline_harness::Distribution;
    use tautline_harness::rows::Details;

    #[test]
    fn every_line_has_its_label() {
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
    }

    #[test]
    fn the_overview_has_six_systems_by_their_best_way_and_the_floor() {
        let held = "latency/whole/held-off";
        let mut rows = Vec::new();
        for (bytes, us) in [(64, 6.0), (1 << 20, 60.0)] {
            let ways = [("tautline", "direct"), ("tautline", "busy-poll"), ("iceoryx2", "waitset")];
            let rivals = ["fastdds", "cyclonedds", "zenoh", "r2r", "hiroz"].map(|system| (system, "x"));
            rows.extend(
                ways.into_iter().chain(rivals).map(|(system, mode)| row(held, system, mode, bytes, us)),
            );
            rows.push(row(held, "floor", "futex", bytes, us / 2.0));
            rows.push(row(held, "fastdds", "y", bytes, us * 9.0));
        }
        let svg = overview(&rows, held).unwrap().unwrap();
        let labels = [
            "Tautline",
            "Fast DDS",
            "Cyclone DDS",
            "iceoryx2",
            "Zenoh",
            "r2r",
            "floor: a bare futex",
            "hiroz",
        ];
        let counts = labels.map(|label| svg.matches(&format!("{label}\n")).count());
        assert_eq!(counts, [1, 1, 1, 1, 1, 1, 1, 0], "{svg}");
        // No way that polls, and of Fast DDS's the faster one.
        let all: Vec<_> = ["20 µs", "50 µs", "100 µs", "200 µs", "1 µs"]
            .map(|mark| svg.contains(&format!("\n{mark}\n")))
            .into();
        assert_eq!(all, [true, true, true, false, false], "{svg}");
        assert!(overview(&rows[..1], held).unwrap().is_none());
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

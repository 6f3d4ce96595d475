// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bars with their spread, and the systems' colours.

use plotters::style::{RGBColor, WHITE};

use crate::Result;
use crate::canvas::{Align, Canvas, FAINT, INK, Words};

const LABELS: i32 = 230;
const WIDTH: i32 = 660;
/// Beside the longest bar, for its number.
const NUMBERS: i32 = 90;
const TOP: i32 = 40;
const BAR: i32 = 20;

/// A system's colour.
pub fn colour(system: &str) -> RGBColor {
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

/// A bar and its spread.
#[derive(Clone, Debug)]
pub struct Bar {
    pub label: String,
    pub system: String,
    /// `None`: there is a text alone.
    pub value: Option<f64>,
    /// From the least to the most.
    pub spread: Option<(f64, f64)>,
    pub text: String,
}

/// A vertical line over all bars.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mark {
    Bound(f64),
    /// Dashed.
    Deadline(f64),
}

/// Bars from 0; the scale ends where the longest bar or the last mark does, or at `end` if that is less: longer ones then end in a
/// triangle.
pub fn bars(title: &str, bars: &[Bar], end: Option<f64>, marks: &[Mark]) -> Result<Option<String>> {
    if bars.is_empty() {
        return Ok(None);
    }
    let of_bars = bars.iter().flat_map(|bar| [bar.value, bar.spread.map(|(_, most)| most)]).flatten();
    let of_marks = marks.iter().map(|(Mark::Bound(at) | Mark::Deadline(at))| *at);
    let most = of_bars.chain(of_marks).fold(0.0, f64::max);
    let end = end.map_or(most, |end| end.min(most)).max(1e-9);
    let bottom = TOP + BAR * bars.len() as i32;
    let mut svg = String::new();
    let canvas = Canvas::new(&mut svg, (LABELS + WIDTH + NUMBERS, bottom + 10))?;
    canvas.text(title, (10, 18), Words::TITLE)?;
    let x = |value: f64| LABELS + (value.clamp(0.0, end) / end * f64::from(WIDTH)).round() as i32;
    let places = || (TOP..).step_by(BAR as usize).map(|top| (top, top + (BAR - 4) / 2)).zip(bars);
    for ((top, middle), bar) in places() {
        canvas.text(&bar.label, (LABELS - 10, middle), Words { align: Align::Right, ..Words::PLAIN })?;
        if let Some(value) = bar.value {
            canvas.rectangle(
                (LABELS, top),
                (x(value).max(LABELS + 1), top + BAR - 4),
                colour(&bar.system),
            )?;
        }
    }
    for mark in marks {
        match *mark {
            Mark::Bound(at) => canvas.line((x(at), TOP - 4), (x(at), bottom), INK, 1)?,
            Mark::Deadline(at) => canvas.deadline(x(at), TOP - 4, bottom)?,
        }
    }
    for ((top, middle), bar) in places() {
        let mut beside = x(bar.value.unwrap_or(0.0));
        if bar.value.is_some_and(|value| value > end) {
            canvas.beyond(beside, middle, colour(&bar.system))?;
            beside += 6;
        } else if let Some((least, most)) = bar.spread.filter(|(least, most)| most > least) {
            let (from, to) = (x(least), x(most));
            canvas.line((from, middle), (to, middle), INK, 1)?;
            canvas.line((from, middle - 4), (from, middle + 4), INK, 1)?;
            canvas.line((to, middle - 4), (to, middle + 4), INK, 1)?;
            beside = beside.max(to);
        }
        // Over lines that pass there.
        let end = beside + 6 + 7 * bar.text.chars().count() as i32;
        canvas.rectangle((beside + 4, top), (end, top + BAR - 4), WHITE)?;
        let words = Words { pixels: 11, colour: INK, align: Align::Left, ..Words::SMALL };
        canvas.text(&bar.text, (beside + 6, middle), words)?;
    }
    canvas.line((LABELS, TOP - 4), (LABELS, bottom), FAINT, 1)?;
    canvas.finish()?;
    Ok(Some(svg))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bar_has_its_label_and_what_is_too_long_ends_in_a_triangle() {
        let bar = |label: &str, value: Option<f64>| Bar {
            label: label.to_owned(),
            system: "fastdds".to_owned(),
            value,
            spread: Some((1.0, 70.0)),
            text: value.map_or("nothing".to_owned(), |value| format!("{value} µs")),
        };
        let all = [bar("one", Some(6.0)), bar("two", Some(60.0)), bar("three", None)];
        let marks = [Mark::Bound(20.0), Mark::Deadline(30.0)];
        let svg = bars("title", &all, Some(50.0), &marks).unwrap().unwrap();
        let count = |words: &str| svg.matches(words).count();
        assert_eq!((count("<polygon"), count("title"), count("two"), count("60 µs")), (1, 1, 1, 1));
        assert_eq!(count("nothing"), 1);
        let without = bars("title", &all, Some(50.0), &[]).unwrap().unwrap();
        assert!(count("<polyline") > without.matches("<polyline").count() + 1, "a dashed one has several");
        assert!(bars("title", &[], None, &[]).unwrap().is_none());
    }
}

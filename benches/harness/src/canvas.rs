// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the figures of reports are drawn with.

use plotters::backend::SVGBackend;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::{Error, Result};

/// Text and axes.
pub const INK: RGBColor = RGBColor(34, 40, 49);
/// What explains.
pub const FAINT: RGBColor = RGBColor(102, 110, 122);
/// Lines behind what is shown.
pub const GRID: RGBColor = RGBColor(232, 235, 240);
/// What must not be exceeded.
pub const DEADLINE: RGBColor = RGBColor(204, 32, 38);

/// A drawing area in pixels, with the few shapes that the figures are made of.
#[expect(missing_debug_implementations, reason = "plotters' areas have none")]
pub struct Canvas<'a>(DrawingArea<SVGBackend<'a>, Shift>);

/// Where a text stands relative to its point; always in the middle of its height.
#[derive(Clone, Copy, Debug)]
pub enum Align {
    Left,
    Centre,
    Right,
}

/// A text's looks; `pixels` is the size that a browser shows.
#[derive(Clone, Copy, Debug)]
pub struct Words {
    pub pixels: u32,
    pub colour: RGBColor,
    pub align: Align,
    pub bold: bool,
}

impl Words {
    pub const PLAIN: Words = Words { pixels: 12, colour: INK, align: Align::Left, bold: false };
    pub const SMALL: Words = Words { pixels: 10, colour: FAINT, align: Align::Centre, bold: false };
    pub const TITLE: Words = Words { pixels: 13, colour: INK, align: Align::Left, bold: true };
}

impl<'a> Canvas<'a> {
    pub fn new(svg: &'a mut String, (width, height): (i32, i32)) -> Result<Self> {
        let area = SVGBackend::with_string(svg, (width as u32, height as u32)).into_drawing_area();
        let canvas = Self(area);
        canvas.rectangle((0, 0), (width, height), WHITE)?;
        Ok(canvas)
    }

    pub fn finish(self) -> Result {
        self.0.present().map_err(failed)
    }

    pub fn rectangle(&self, from: (i32, i32), to: (i32, i32), colour: RGBColor) -> Result {
        self.0.draw(&Rectangle::new([from, to], colour.filled())).map_err(failed)
    }

    pub fn line(&self, from: (i32, i32), to: (i32, i32), colour: RGBColor, width: u32) -> Result {
        self.0.draw(&PathElement::new([from, to], colour.stroke_width(width))).map_err(failed)
    }

    /// A deadline: vertical and dashed.
    pub fn deadline(&self, x: i32, top: i32, bottom: i32) -> Result {
        (top..bottom).step_by(8).try_for_each(|y| self.line((x, y), (x, (y + 5).min(bottom)), DEADLINE, 2))
    }

    /// A bar that goes on beyond the picture ends in this: a triangle that points to the right.
    pub fn beyond(&self, x: i32, y: i32, colour: RGBColor) -> Result {
        self.0.draw(&Polygon::new([(x, y - 5), (x, y + 5), (x + 6, y)], colour)).map_err(failed)
    }

    pub fn text(&self, text: &str, at: (i32, i32), words: Words) -> Result {
        // The SVG backend divides sizes by 1.24.
        let style = if words.bold { FontStyle::Bold } else { FontStyle::Normal };
        let font = FontDesc::new(FontFamily::SansSerif, f64::from(words.pixels) * 1.24, style);
        let horizontal = match words.align {
            Align::Left => HPos::Left,
            Align::Centre => HPos::Center,
            Align::Right => HPos::Right,
        };
        let style = TextStyle::from(font).color(&words.colour).pos(Pos::new(horizontal, VPos::Center));
        self.0.draw(&Text::new(text, at, style)).map_err(failed)
    }
}

fn failed(error: impl std::fmt::Display) -> Error {
    format!("a figure cannot be drawn: {error}").into()
}

// SPDX-License-Identifier: MIT OR Apache-2.0
use plotters::backend::SVGBackend;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use crate::verb::{Failure, Outcome};

pub const DEADLINE: RGBColor = RGBColor(204, 32, 38);
const PERCENTILE: RGBColor = RGBColor(214, 134, 0);

/// The drawing area in pixels, with the few shapes the picture is made of.
pub struct Canvas<'a>(DrawingArea<SVGBackend<'a>, Shift>);

impl<'a> Canvas<'a> {
    pub fn new(svg: &'a mut String, (width, height): (i32, i32)) -> Self {
        Self(SVGBackend::with_string(svg, (width as u32, height as u32)).into_drawing_area())
    }

    /// Completes the document.
    pub fn finish(self) -> Outcome {
        self.0.present().map_err(drawing)
    }

    pub fn rectangle(&self, from: (i32, i32), to: (i32, i32), colour: RGBColor) -> Outcome {
        self.0.draw(&Rectangle::new([from, to], colour.filled())).map_err(drawing)
    }

    pub fn line(&self, from: (i32, i32), to: (i32, i32), colour: RGBColor, width: u32) -> Outcome {
        self.0.draw(&PathElement::new([from, to], colour.stroke_width(width))).map_err(drawing)
    }

    pub fn path(&self, points: &[(i32, i32)], colour: RGBColor, width: u32) -> Outcome {
        self.0.draw(&PathElement::new(points, colour.stroke_width(width))).map_err(drawing)
    }

    /// The deadline: a vertical, dashed line.
    pub fn dashed(&self, x: i32, top: i32, bottom: i32) -> Outcome {
        (top..bottom).step_by(8).try_for_each(|y| self.line((x, y), (x, (y + 5).min(bottom)), DEADLINE, 2))
    }

    /// The p99: a triangle that points down.
    pub fn mark(&self, x: i32, y: i32) -> Outcome {
        self.0.draw(&Polygon::new([(x - 5, y), (x + 5, y), (x, y + 8)], PERCENTILE)).map_err(drawing)
    }

    pub fn text(&self, text: &str, at: (i32, i32), style: TextStyle<'_>) -> Outcome {
        self.0.draw(&Text::new(text, at, style)).map_err(drawing)
    }
}

/// A text style, centred vertically; `pixels` is the size a browser shows.
pub fn text(pixels: u32, colour: RGBColor, h: HPos) -> TextStyle<'static> {
    // The SVG backend divides sizes by 1.24.
    let font = FontDesc::new(FontFamily::SansSerif, f64::from(pixels) * 1.24, FontStyle::Normal);
    TextStyle { font, color: colour.to_backend_color(), pos: Pos::new(h, VPos::Center) }
}

pub fn bold(style: TextStyle<'_>) -> TextStyle<'_> {
    TextStyle { font: style.font.style(FontStyle::Bold), ..style }
}

fn drawing(error: impl std::fmt::Display) -> Failure {
    Failure::unusable(format!("the picture could not be drawn: {error}"))
}

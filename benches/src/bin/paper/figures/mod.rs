// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's figures, drawn anew from the rows of a run.

mod bars;
mod histograms;

pub use bars::p99_bars;
pub use histograms::ablation_histograms;

use plotters::style::{RGBColor, WHITE};
use tautline_harness::canvas::INK;

use crate::plan::System;
use crate::stats::Row;

const BOUND: RGBColor = RGBColor(34, 40, 49);

fn systems(rows: &[&Row]) -> Vec<System> {
    let is_there = |system: &System| rows.iter().any(|row| row.system == *system);
    [System::Tautline, System::R2r].into_iter().filter(is_there).collect()
}

/// Round numbers from 0 to `end`, about `count` of them.
fn ticks(end: f64, count: f64) -> impl Iterator<Item = f64> {
    let step = round_step(end / count);
    (0..=(end / step) as u32).map(move |tick| f64::from(tick) * step)
}

/// The largest of 1, 2, 5, 10, ... (or their decimal parts) that does not exceed the wish by half.
fn round_step(wish: f64) -> f64 {
    let decade = 10_f64.powf(wish.log10().floor());
    let factor = [10.0, 5.0, 2.0, 1.0].into_iter().find(|factor| factor * decade <= wish * 1.5);
    factor.unwrap_or(1.0) * decade
}

fn colour(system: System) -> RGBColor {
    match system {
        System::Tautline => RGBColor(64, 120, 190),
        System::R2r => RGBColor(236, 164, 72),
    }
}

/// What can be read on a bar of the system.
fn on_bar(system: System) -> RGBColor {
    match system {
        System::Tautline => WHITE,
        System::R2r => INK,
    }
}

fn label(system: System) -> &'static str {
    match system {
        System::Tautline => "Tautline",
        System::R2r => "r2r over Fast DDS",
    }
}

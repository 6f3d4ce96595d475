// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's figures, drawn anew from the rows of a run.

mod bars;
mod histograms;

pub use bars::p99_bars;
pub use histograms::ablation_histograms;

use crate::plan::{R2R, TAUTLINE};
use crate::stats::Row;

fn systems(rows: &[&Row]) -> Vec<&'static str> {
    let is_there = |system: &&str| rows.iter().any(|row| row.system == *system);
    [TAUTLINE, R2R].into_iter().filter(is_there).collect()
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

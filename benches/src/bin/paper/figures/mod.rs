// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's figures, drawn anew from the rows of a run.

mod bars;
mod histograms;

pub use bars::p99_bars;
pub use histograms::ablation_histograms;

use plotters::style::{RGBColor, WHITE};
use tautline_benches::canvas::INK;

use crate::plan::System;

const BOUND: RGBColor = RGBColor(34, 40, 49);

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

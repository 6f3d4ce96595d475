// SPDX-License-Identifier: MIT OR Apache-2.0
//! A histogram of the hot path's latencies.

use plotters::prelude::*;

use crate::Result;
use crate::report::Report;

const SIZE: (u32, u32) = (860, 320);
const BINS: u32 = 80;
const BAR: RGBColor = RGBColor(76, 132, 196);
const BOUND: RGBColor = RGBColor(204, 32, 38);

/// The latencies as an SVG document, with the bound as a line.
pub fn hot_path(report: &Report) -> Result<String> {
    let kpis = &report.kpis;
    let far = kpis.hot_path_worst_ms.max(report.hot_path_bound_ms.unwrap_or(0.0)) * 1.05;
    let bin_ms = (far / f64::from(BINS)).max(0.001);
    let bin_of = |ms: f64| (ms / bin_ms) as u32;
    let mut counts = vec![0_u32; BINS as usize + 1];
    for &ms in &kpis.hot_path_ms {
        counts[bin_of(ms).min(BINS) as usize] += 1;
    }
    let highest = counts.iter().copied().max().unwrap_or(0).max(1);
    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let title = format!(
        "FrontLidarDriver to ObjectCollisionEstimator: {} samples, {} ({})",
        kpis.hot_path_ms.len(),
        kpis.system,
        kpis.mode
    );
    let mut chart = ChartBuilder::on(&area)
        .caption(title, ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(0.0..f64::from(BINS) * bin_ms, 0..highest + highest / 10 + 1)?;
    chart.configure_mesh().disable_x_mesh().x_desc("latency in ms").y_desc("samples").draw()?;
    let bars = (0..).zip(&counts).filter(|&(_, &count)| count > 0).map(|(bin, &count)| {
        let left = f64::from(bin) * bin_ms;
        Rectangle::new([(left, 0), (left + 0.9 * bin_ms, count)], BAR.filled())
    });
    chart.draw_series(bars)?;
    if let Some(bound_ms) = report.hot_path_bound_ms {
        let line = [(bound_ms, 0), (bound_ms, highest)];
        chart.draw_series([PathElement::new(line, BOUND.stroke_width(2))])?;
        chart.draw_series([Text::new(
            "bound",
            (bound_ms - 5.0 * bin_ms, highest),
            ("sans-serif", 14).into_font().color(&BOUND),
        )])?;
    }
    area.present()?;
    drop(chart);
    drop(area);
    Ok(svg)
}

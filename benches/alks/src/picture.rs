// SPDX-License-Identifier: MIT OR Apache-2.0
//! A picture of a drive: where in its lane the car was, how fast, in which curves, and when others cut in.

use std::error::Error;

use plotters::coord::Shift;
use plotters::prelude::*;

use crate::drive::Drive;
use crate::road::LANE_M;
use crate::simulator::Truth;

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

const SIZE: (u32, u32) = (1_000, 620);
const INK: RGBColor = RGBColor(34, 40, 49);
const LATERAL: RGBColor = RGBColor(42, 111, 176);
const SPEED: RGBColor = RGBColor(26, 127, 55);
const CURVE: RGBColor = RGBColor(140, 92, 180);
const CUT_IN: RGBColor = RGBColor(252, 226, 187);
const LIMIT: RGBColor = RGBColor(204, 32, 38);
/// Where the car's side is over the line.
const MARGIN_M: f64 = (LANE_M - 1.95) / 2.0;

struct Panel {
    label: &'static str,
    range: std::ops::Range<f64>,
    colour: RGBColor,
    limits: Vec<f64>,
    value: fn(&Truth) -> f64,
}

/// The drive as an SVG document.
pub fn drive(drive: &Drive) -> Result<String> {
    let mut svg = String::new();
    let root = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let title = format!(
        "{}, {:.1} km at {:.0} km/h: at most {:.2} m off the lane's centre, {} cut-ins (shaded), seed {}",
        length(drive.seconds),
        drive.kilometres,
        drive.mean_kmh,
        drive.lateral_max_m,
        drive.cut_ins,
        drive.seed
    );
    let area = root.titled(&title, ("sans-serif", 18).into_font().color(&INK))?;
    let most = MARGIN_M + 0.1;
    let fastest = drive.course.iter().map(|truth| truth.speed_mps * 3.6).fold(140.0, f64::max);
    let panels = [
        Panel {
            label: "off centre in m, left +",
            range: -most..most,
            colour: LATERAL,
            limits: vec![-MARGIN_M, MARGIN_M],
            value: |truth| truth.lateral_m,
        },
        Panel {
            label: "speed in km/h",
            range: 0.0..fastest + 5.0,
            colour: SPEED,
            limits: vec![130.0],
            value: |truth| truth.speed_mps * 3.6,
        },
        Panel {
            label: "curvature in 1/km, left +",
            range: -1.4..1.4,
            colour: CURVE,
            limits: Vec::new(),
            value: |truth| truth.curvature * 1e3,
        },
    ];
    for (panel, part) in panels.iter().zip(area.split_evenly((3, 1))) {
        draw(panel, drive, &part)?;
    }
    root.present()?;
    drop((area, root));
    Ok(svg)
}

fn length(seconds: f64) -> String {
    if seconds < 120.0 { format!("{seconds:.0} s") } else { format!("{:.0} min", seconds / 60.0) }
}

fn draw(panel: &Panel, drive: &Drive, area: &DrawingArea<SVGBackend, Shift>) -> Result<()> {
    let end = drive.seconds.max(1.0);
    let mut chart = ChartBuilder::on(area)
        .margin(8)
        .x_label_area_size(32)
        .y_label_area_size(58)
        .build_cartesian_2d(0.0..end, panel.range.clone())?;
    let (low, high) = (panel.range.start, panel.range.end);
    for (from, to) in cut_ins(&drive.course) {
        chart.draw_series([Rectangle::new([(from, low), (to, high)], CUT_IN.filled())])?;
    }
    let style = ("sans-serif", 13).into_font().color(&INK);
    chart
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(TRANSPARENT)
        .x_desc("time in s")
        .y_desc(panel.label)
        .axis_desc_style(style)
        .draw()?;
    for &limit in &panel.limits {
        chart.draw_series([PathElement::new([(0.0, limit), (end, limit)], LIMIT.mix(0.6))])?;
    }
    // Points that lie beside each other on the screen are one.
    let step = drive.course.len() / 2_000 + 1;
    let points = drive.course.iter().step_by(step).map(|truth| (truth.time_s, (panel.value)(truth)));
    chart.draw_series(LineSeries::new(points, panel.colour.stroke_width(1)))?;
    Ok(())
}

/// From when to when somebody was ahead who had cut in.
fn cut_ins(course: &[Truth]) -> Vec<(f64, f64)> {
    course
        .chunk_by(|a, b| a.cut_in == b.cut_in)
        .filter_map(|chunk| chunk.first().filter(|truth| truth.cut_in).zip(chunk.last()))
        .map(|(first, last)| (first.time_s, last.time_s))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_is_drawn_with_its_cut_ins() {
        let truth = |i: u32, cut_in: bool| Truth {
            time_s: f64::from(i),
            speed_mps: 36.0,
            cut_in,
            ..Truth::default()
        };
        let course: Vec<_> = (0..10).map(|i| truth(i, (3..6).contains(&i) || i == 8)).collect();
        assert_eq!(cut_ins(&course), [(3.0, 5.0), (8.0, 8.0)]);
        let svg = drive(&Drive { seconds: 10.0, course, cut_ins: 2, ..Drive::default() }).unwrap();
        assert!(svg.starts_with("<svg") && svg.contains("off centre") && svg.contains("2 cut-ins"));
        assert!(drive(&Drive::default()).is_ok(), "nothing was driven");
    }
}

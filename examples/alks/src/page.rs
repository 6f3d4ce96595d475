// SPDX-License-Identifier: MIT OR Apache-2.0
//! The paper's four figures and the drive, on a page.

use std::fmt::Write;

use plotters::prelude::*;
use tautline_alks::picture;
use tautline_alks::records::{Span, Summary};

use crate::Result;
use crate::report::{Report, about};

const SIZE: (u32, u32) = (860, 280);
const BINS: usize = 100;
const COLOURS: [RGBColor; 4] =
    [RGBColor(42, 111, 176), RGBColor(204, 96, 32), RGBColor(26, 127, 55), RGBColor(140, 92, 180)];
const BOUND: RGBColor = RGBColor(204, 32, 38);
const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;color:#222831;max-width:1060px;margin:2em auto;padding:0 1em}\
svg{max-width:100%;height:auto}table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}\
th,td{padding:2px 9px;border-bottom:1px solid #e2e6eb;text-align:right;white-space:nowrap}th:first-child,td:first-child{text-align:left}";

/// What the paper's figures show.
const FIGURES: [(&str, &[Span]); 4] = [
    (
        "End-to-end latency of the odometry chain, and the duration of its first callback",
        &[Span::Chain, Span::Imu],
    ),
    ("Durations of the odometry's callbacks in ALKS and visualizer", &[Span::Odometry, Span::ShowOdometry]),
    ("Subscribers of the ALKS node: each callback, or run_until_stalled", &[Span::Subscriber, Span::Stalled]),
    ("The timer of the ALKS node: with and without planning", &[Span::Timer, Span::Planning]),
];

/// All reports as one HTML document.
pub fn page(reports: &[Report]) -> Result<String> {
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>Automated lane keeping</title><style>{STYLE}</style>\n\
         <h1>Automated lane keeping</h1>\n<p>A simulated car on a simulated motorway, three processes, eleven topics. Counts are on a \
         logarithmic scale.</p>\n"
    );
    for report in reports {
        writeln!(page, "<h2>{}</h2>\n<p>{}</p>", escape(&report.label()), escape(&about(&report.drive)))?;
        page.push_str("<table><tr><th></th><th>n</th><th>p50 ms</th><th>p99 ms</th><th>p99.9 ms</th><th>max ms</th><th>bound ms</th></tr>\n");
        for row in &report.rows {
            let Summary { name, n, p50_ms, p99_ms, p999_ms, max_ms, .. } = &row.times;
            let bound = row.bound_ms.map_or_else(String::new, |bound| format!("{bound:.3}"));
            writeln!(
                page,
                "<tr><td>{name}</td><td>{n}</td><td>{p50_ms:.3}</td><td>{p99_ms:.3}</td><td>{p999_ms:.3}</td><td>{max_ms:.3}</td><td>{bound}</td></tr>"
            )?;
        }
        writeln!(
            page,
            "</table>\n<p>{:.2} % of the chain below 0.8 ms; {} messages, {} lost; steal {} ms.</p>",
            report.chain_below_paper * 100.0,
            report.published,
            report.lost.iter().map(|(_, lost, _)| lost).sum::<u64>(),
            report.steal_ticks * 10
        )?;
        for (title, spans) in FIGURES {
            let shown: Vec<_> = report.rows.iter().filter(|row| spans.contains(&row.times.span)).collect();
            let bound = shown.iter().find(|row| row.times.span == Span::Chain).and_then(|row| row.bound_ms);
            let times: Vec<_> = shown.iter().map(|row| &row.times).collect();
            if !times.is_empty() {
                page.push_str(&histogram(title, &times, bound)?);
            }
        }
        page.push_str(&picture::drive(&report.drive)?);
    }
    page.push_str("</html>\n");
    Ok(page)
}

fn histogram(title: &str, all: &[&Summary], bound_ms: Option<f64>) -> Result<String> {
    let far = all.iter().map(|times| times.max_ms).chain(bound_ms).fold(0.01, f64::max) * 1.03;
    let bin_ms = far / BINS as f64;
    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let highest = all.iter().flat_map(|times| counts(times, bin_ms)).max().unwrap_or(1).max(10) as f64;
    let mut chart = ChartBuilder::on(&area)
        .caption(title, ("sans-serif", 16))
        .margin(10)
        .x_label_area_size(34)
        .y_label_area_size(56)
        .build_cartesian_2d(0.0..far, (0.8..highest * 2.0).log_scale())?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(TRANSPARENT)
        .x_desc("ms")
        .y_desc("samples")
        .draw()?;
    for (times, colour) in all.iter().zip(COLOURS) {
        let bars = (0..).zip(counts(times, bin_ms)).filter(|(_, count)| *count > 0).map(|(bin, count)| {
            let left = f64::from(bin) * bin_ms;
            Rectangle::new([(left, 0.8), (left + bin_ms, count as f64)], colour.mix(0.6).filled())
        });
        let label = format!("{} (n = {})", times.name, times.n);
        chart
            .draw_series(bars)?
            .label(label)
            .legend(move |(x, y)| Rectangle::new([(x, y - 5), (x + 12, y + 5)], colour.mix(0.6).filled()));
    }
    if let Some(bound_ms) = bound_ms {
        let line = [(bound_ms, 0.8), (bound_ms, highest)];
        chart
            .draw_series([PathElement::new(line, BOUND.stroke_width(2))])?
            .label("bound")
            .legend(|(x, y)| PathElement::new([(x, y), (x + 12, y)], BOUND.stroke_width(2)));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperMiddle)
        .background_style(WHITE.mix(0.8))
        .label_font(("sans-serif", 13))
        .draw()?;
    area.present()?;
    drop(chart);
    drop(area);
    Ok(svg)
}

fn counts(times: &Summary, bin_ms: f64) -> Vec<u64> {
    let mut counts = vec![0; BINS + 1];
    for (ns, count) in &times.values {
        counts[((*ns as f64 / 1e6 / bin_ms) as usize).min(BINS)] += count;
    }
    counts
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

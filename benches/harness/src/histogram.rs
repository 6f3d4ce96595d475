// SPDX-License-Identifier: MIT OR Apache-2.0

use plotters::prelude::*;

use crate::Result;
use crate::canvas::DEADLINE;

const SIZE: (u32, u32) = (860, 280);
const BINS: usize = 100;
const COLOURS: [RGBColor; 4] =
    [RGBColor(42, 111, 176), RGBColor(204, 96, 32), RGBColor(26, 127, 55), RGBColor(140, 92, 180)];

/// Times of one kind.
#[derive(Clone, Copy, Debug)]
pub struct Series<'a> {
    pub name: &'a str,
    /// In ns, with how often each occurred.
    pub counts: &'a [(u64, u64)],
}

impl Series<'_> {
    fn max_ms(&self) -> f64 {
        self.counts.iter().map(|(ns, _)| *ns).max().unwrap_or(0) as f64 / 1e6
    }

    fn bins(&self, bin_ms: f64) -> Vec<u64> {
        let mut bins = vec![0; BINS + 1];
        for (ns, count) in self.counts {
            bins[((*ns as f64 / 1e6 / bin_ms) as usize).min(BINS)] += count;
        }
        bins
    }
}

/// Histograms of up to four series over each other as an SVG document, counts on a logarithmic scale; a limit is a line, by its name.
///
/// # Errors
/// It cannot be drawn.
pub fn histogram(title: &str, all: &[Series<'_>], limit: Option<(&str, f64)>) -> Result<String> {
    let far = all.iter().map(Series::max_ms).chain(limit.map(|(_, ms)| ms)).fold(0.01, f64::max) * 1.03;
    let bin_ms = far / BINS as f64;
    let highest = all.iter().flat_map(|series| series.bins(bin_ms)).max().unwrap_or(1).max(10) as f64;
    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
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
    for (series, colour) in all.iter().zip(COLOURS) {
        let bars = (0..).zip(series.bins(bin_ms)).filter(|(_, count)| *count > 0).map(|(bin, count)| {
            let left = f64::from(bin) * bin_ms;
            Rectangle::new([(left, 0.8), (left + bin_ms, count as f64)], colour.mix(0.6).filled())
        });
        let n: u64 = series.counts.iter().map(|(_, count)| count).sum();
        chart
            .draw_series(bars)?
            .label(format!("{} (n = {n})", series.name))
            .legend(move |(x, y)| Rectangle::new([(x, y - 5), (x + 12, y + 5)], colour.mix(0.6).filled()));
    }
    if let Some((name, ms)) = limit {
        let line = [(ms, 0.8), (ms, highest)];
        chart
            .draw_series([PathElement::new(line, DEADLINE.stroke_width(2))])?
            .label(name)
            .legend(|(x, y)| PathElement::new([(x, y), (x + 12, y)], DEADLINE.stroke_width(2)));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_time_is_left_out_and_the_bound_is_drawn() {
        let series = Series { name: "chain", counts: &[(0, 1), (1_000_000, 2), (100_000_000, 3)] };
        assert_eq!((series.bins(1.0)[0], series.bins(1.0)[1], series.bins(1.0)[BINS]), (1, 2, 3));
        assert_eq!(series.bins(0.001).iter().sum::<u64>(), 6);
        let svg = histogram("times", &[series], Some(("bound", 120.0))).unwrap();
        assert!(svg.contains("chain (n = 6)") && svg.contains("bound"), "{svg}");
        assert!(histogram("nothing", &[], None).is_ok());
    }
}

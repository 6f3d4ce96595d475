// SPDX-License-Identifier: MIT OR Apache-2.0
//! The indicators of a run and whether the bounds were kept.

use serde::Serialize;
use std::time::Duration;
use tautline_harness::{Result, Series, histogram};
use tautline_reference::Kpis;

use crate::bounds::Bounds;

/// As the JSON has it.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    #[serde(flatten)]
    pub kpis: Kpis,
    /// None if nothing bounds it, or what the analysis assumes was not so.
    pub hot_path_bound_ms: Option<f64>,
    pub hot_path_kept: Option<bool>,
    pub planner_jitter_bound_ms: Option<f64>,
    pub planner_jitter_kept: Option<bool>,
}

impl Report {
    /// `bounds` of the system file that the run had, if it had one.
    pub fn new(kpis: Kpis, bounds: Option<&Bounds>) -> Report {
        let holds = bounds.filter(|bounds| why_no_bounds(&kpis, bounds).is_none());
        let ms = |bound: Duration| bound.as_secs_f64() * 1e3;
        let hot_path_bound_ms = holds.and_then(|bounds| bounds.hot_path).map(ms);
        let planner_jitter_bound_ms = holds.and_then(|bounds| bounds.planner).map(ms);
        Report {
            hot_path_kept: hot_path_bound_ms
                .map(|bound| kpis.both_lidars_worst_ms.max(kpis.hot_path_worst_ms) <= bound),
            planner_jitter_kept: planner_jitter_bound_ms.map(|bound| kpis.planner_jitter_worst_ms <= bound),
            kpis,
            hot_path_bound_ms,
            planner_jitter_bound_ms,
        }
    }

    /// The hot path's latencies as an SVG document, with their bound.
    ///
    /// # Errors
    /// It cannot be drawn.
    pub fn picture(&self) -> Result<String> {
        let counts: Vec<_> = self.kpis.hot_path_ms.iter().map(|ms| ((ms * 1e6) as u64, 1)).collect();
        let name = format!("{} ({})", self.kpis.system, self.kpis.mode);
        let series = Series { name: &name, counts: &counts };
        histogram(
            "FrontLidarDriver to ObjectCollisionEstimator",
            &[series],
            self.hot_path_bound_ms.map(|ms| ("bound", ms)),
        )
    }

    /// A sentence for below the table.
    pub fn about_the_bounds(&self, bounds: &Bounds) -> String {
        why_no_bounds(&self.kpis, bounds).unwrap_or_else(|| {
            format!(
                "The bounds are those of `taut check`, for runs of up to {:.1} ms; the hot path's is from the release of both lidars.",
                bounds.wcet.as_secs_f64() * 1e3
            )
        })
    }
}

fn why_no_bounds(kpis: &Kpis, bounds: &Bounds) -> Option<String> {
    let wcet_ms = bounds.wcet.as_secs_f64() * 1e3;
    if !kpis.realtime {
        Some("Without real-time priorities nothing is bounded.".to_owned())
    } else if kpis.crunch_ms > wcet_ms {
        let crunch_ms = kpis.crunch_ms;
        Some(format!(
            "No bound: a run takes {crunch_ms:.3} ms, and the system file says at most {wcet_ms:.3} ms. Change its `wcet`, or pass a smaller --cruncher-limit."
        ))
    } else {
        None
    }
}

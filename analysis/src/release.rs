// SPDX-License-Identifier: MIT OR Apache-2.0
use std::sync::Arc;

use crate::AnalysisError;

/// At most this many distances are kept of a trace.
const TRACE_DEPTH: usize = 1_000;

/// The shortest distances between releases seen in a trace; the first is that of two releases, the next of three.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Distances(Arc<[u64]>);

impl Distances {
    /// The shortest distances that any 2, 3, 4, ... consecutive instants span, in nanoseconds. What the
    /// trace is too short to show (and all past 1,000 releases) is bounded from that by superadditivity.
    ///
    /// A bound from a trace holds as long as the system never releases faster than it did in the trace.
    ///
    /// # Errors
    /// [`AnalysisError::BadTrace`] with fewer than two instants, instants out of order, or all of them at once.
    pub fn from_trace(instants_ns: &[u64]) -> Result<Self, AnalysisError> {
        let bad = |problem| Err(AnalysisError::BadTrace { problem });
        if instants_ns.len() < 2 {
            return bad("it has fewer than two instants");
        }
        if !instants_ns.is_sorted() {
            return bad("its instants are not in ascending order");
        }
        let deepest = (instants_ns.len() - 1).min(TRACE_DEPTH);
        let shortest =
            |steps: usize| instants_ns.windows(steps + 1).map(|w| w[steps] - w[0]).min().unwrap_or(0);
        let distances: Arc<[u64]> = (1..=deepest).map(shortest).collect();
        if distances[deepest - 1] == 0 {
            return bad("it shows no time between releases");
        }
        Ok(Self(distances))
    }

    /// The shortest distance from a release to the one `steps` after it; `u64::MAX` past 584 years.
    fn after(&self, steps: u64) -> u64 {
        let (block, whole) = (self.0.len() as u64, self.longest());
        let (blocks, rest) = (steps / block, (steps % block) as usize);
        let rest = if rest == 0 { 0 } else { self.0[rest - 1] };
        blocks.saturating_mul(whole).saturating_add(rest)
    }

    /// The most releases in a half-open window, which must not be empty.
    fn most_within(&self, window_ns: u64) -> u64 {
        let (block, whole) = (self.0.len() as u64, self.longest());
        let blocks = (window_ns - 1) / whole;
        let rest = window_ns - blocks * whole;
        let more = self.0.partition_point(|distance| *distance < rest) as u64;
        blocks.saturating_mul(block).saturating_add(more + 1)
    }

    fn longest(&self) -> u64 {
        self.0[self.0.len() - 1]
    }
}

/// How often a task is released: a bound on the number of releases in any window of time (an arrival curve). All
/// analyses see a task's releases through this.
///
/// ```
/// use tautline_analysis::Release;
/// let release = Release::periodic(10).jitter(15).min_distance(2);
/// // A burst of two, then at the period's pace; never two within less than 2 ns.
/// assert_eq!([1, 2, 3, 5, 6, 15, 16].map(|window| release.most_within(window)), [1, 1, 2, 2, 3, 3, 4]);
/// assert_eq!([0, 1, 2, 3].map(|steps| release.shortest_span(steps)), [0, 2, 5, 15]);
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Release {
    pub(crate) period_ns: u64,
    pub(crate) jitter_ns: u64,
    pub(crate) min_distance_ns: u64,
    pub(crate) distances: Option<Distances>,
}

impl Release {
    /// Once in each period.
    pub const fn periodic(period_ns: u64) -> Self {
        Self { period_ns, jitter_ns: 0, min_distance_ns: 0, distances: None }
    }

    /// At any time, but never sooner than this after the last release. For every bound of this crate that is as
    /// demanding as [`periodic`](Self::periodic).
    pub const fn sporadic(min_distance_ns: u64) -> Self {
        Self::periodic(min_distance_ns)
    }

    /// As often as seen in a trace; see [`Distances::from_trace`].
    ///
    /// # Errors
    /// As [`Distances::from_trace`].
    pub fn from_trace(instants_ns: &[u64]) -> Result<Self, AnalysisError> {
        let distances = Distances::from_trace(instants_ns)?;
        let period_ns = (distances.longest() / distances.0.len() as u64).max(1);
        Ok(Self { distances: Some(distances), ..Self::periodic(period_ns) })
    }

    /// How much later than nominal a release may come.
    #[must_use = "it returns the changed Release"]
    pub const fn jitter(mut self, jitter_ns: u64) -> Self {
        self.jitter_ns = jitter_ns;
        self
    }

    /// The least distance between two releases however large the jitter; 0 for none.
    #[must_use = "it returns the changed Release"]
    pub const fn min_distance(mut self, min_distance_ns: u64) -> Self {
        self.min_distance_ns = min_distance_ns;
        self
    }

    /// How much later than nominal a release may be, in nanoseconds.
    pub const fn jitter_ns(&self) -> u64 {
        self.jitter_ns
    }

    /// The most releases in any half-open window of this length: ceil((window + J) / T), and no more than
    /// ceil(window / minimum distance). `u64::MAX` if that is not known to be fewer.
    pub fn most_within(&self, window_ns: u64) -> u64 {
        if window_ns == 0 {
            return 0;
        }
        let nominal = match (window_ns.checked_add(self.jitter_ns), &self.distances) {
            (None, _) => return u64::MAX,
            (Some(window), None) => window.div_ceil(self.period_ns.max(1)),
            (Some(window), Some(distances)) => distances.most_within(window),
        };
        match self.min_distance_ns {
            0 => nominal,
            distance => nominal.min(window_ns.div_ceil(distance)),
        }
    }

    /// The shortest time from a release to the one `steps` after it; `u64::MAX` past 584 years.
    pub fn shortest_span(&self, steps: u64) -> u64 {
        let delayed = self.nominal_span(steps).saturating_sub(self.jitter_ns);
        delayed.max(steps.saturating_mul(self.min_distance_ns))
    }

    /// As [`shortest_span`](Self::shortest_span), between nominal releases.
    pub(crate) fn nominal_span(&self, steps: u64) -> u64 {
        match &self.distances {
            None => steps.saturating_mul(self.period_ns),
            Some(distances) => distances.after(steps),
        }
    }

    /// The long-run rate, as (releases, nanoseconds).
    pub(crate) fn rate(&self) -> (u64, u64) {
        match &self.distances {
            None => (1, self.period_ns),
            Some(distances) => (distances.0.len() as u64, distances.longest()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Release;

    #[test]
    fn a_trace_bounds_itself_and_what_is_past_it() {
        // A burst of three every 100.
        let burst = |at: u64| [at, at + 1, at + 5];
        let instants: Vec<_> = [0, 100, 200, 300].into_iter().flat_map(burst).collect();
        let release = Release::from_trace(&instants).unwrap();
        assert_eq!([1, 2, 3, 4, 5, 6].map(|n| release.shortest_span(n)), [1, 5, 100, 101, 105, 200]);
        for window in 1..400 {
            let seen = instants
                .iter()
                .map(|from| instants.iter().filter(move |t| (*from..from + window).contains(t)));
            let seen = seen.map(Iterator::count).max().unwrap() as u64;
            assert!(release.most_within(window) >= seen, "{window}");
        }
        // Distances and counts are each other's inverse, also past the trace.
        for steps in 1..100 {
            let span = release.shortest_span(steps);
            assert!(release.most_within(span) <= steps && release.most_within(span + 1) > steps, "{steps}");
        }
        assert_eq!(release.rate(), (11, 305));
    }

    #[test]
    fn bad_traces_are_refused() {
        for bad in [&[][..], &[1], &[2, 1], &[4, 4]] {
            assert!(Release::from_trace(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn a_steady_trace_is_a_period() {
        let instants: Vec<_> = (0..50).map(|k| k * 10).collect();
        let (trace, period) =
            (Release::from_trace(&instants).unwrap().jitter(7), Release::periodic(10).jitter(7));
        for window in 0..2_000 {
            assert_eq!(trace.most_within(window), period.most_within(window), "{window}");
            assert_eq!(trace.shortest_span(window), period.shortest_span(window), "{window}");
        }
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0

use hdrhistogram::Histogram;

/// Times from 1 ns to 10 s in 0.1 % steps; longer ones count as 10 s.
///
/// # Real-time
///
/// [`record`](Self::record) is wait-free and does not allocate.
#[derive(Clone, Debug)]
pub struct Distribution {
    histogram: Histogram<u64>,
}

impl Distribution {
    /// An empty one; allocates all it will ever need.
    pub fn new() -> Self {
        let histogram = Histogram::new_with_bounds(1, 10_000_000_000, 3).expect("valid bounds");
        Self { histogram }
    }

    pub fn record(&mut self, time_ns: u64) {
        self.histogram.saturating_record(time_ns);
    }

    /// The times and how often each occurred, for another process to [`add`](Self::add).
    pub fn counts(&self) -> Vec<(u64, u64)> {
        self.histogram.iter_recorded().map(|step| (step.value_iterated_to(), step.count_at_value())).collect()
    }

    /// Adds what another process counted.
    pub fn add(&mut self, counts: &[(u64, u64)]) {
        for &(time_ns, count) in counts {
            self.histogram.saturating_record_n(time_ns, count);
        }
    }

    /// How many times were recorded.
    pub fn len(&self) -> u64 {
        self.histogram.len()
    }

    pub fn is_empty(&self) -> bool {
        self.histogram.is_empty()
    }

    /// The time in µs that a share of `quantile` (0 to 1) does not exceed; 0 if empty.
    pub fn quantile_us(&self, quantile: f64) -> f64 {
        microseconds(self.histogram.value_at_quantile(quantile))
    }

    /// The longest time in µs; 0 if empty.
    pub fn max_us(&self) -> f64 {
        microseconds(self.histogram.max())
    }
}

impl Default for Distribution {
    fn default() -> Self {
        Self::new()
    }
}

fn microseconds(time_ns: u64) -> f64 {
    time_ns as f64 / 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_carry_a_distribution_to_another_process() {
        let mut child = Distribution::new();
        for time_ns in 1..=1000 {
            child.record(time_ns * 1000);
        }
        let mut parent = Distribution::new();
        parent.add(&child.counts());
        parent.add(&child.counts());
        assert_eq!(parent.len(), 2000);
        assert!((parent.quantile_us(0.5) / 500.0 - 1.0).abs() < 0.002);
        assert!((parent.max_us() / 1000.0 - 1.0).abs() < 0.002);
    }

    #[test]
    fn an_empty_one_has_zeroes() {
        let empty = Distribution::new();
        assert_eq!((empty.is_empty(), empty.quantile_us(0.99), empty.max_us()), (true, 0.0, 0.0));
    }
}

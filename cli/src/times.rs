// SPDX-License-Identifier: MIT OR Apache-2.0
//! Durations, also of many events, and their output.

use hdrhistogram::Histogram;
use serde_json::{Value, json};

/// Nanoseconds in milliseconds.
pub fn ms(ns: u64) -> f64 {
    ns as f64 / 1e6
}

/// Nanoseconds in microseconds.
pub fn us(ns: u64) -> f64 {
    ns as f64 / 1e3
}

/// A histogram of times in ns, with three significant digits, up to an hour.
pub struct Times(Histogram<u64>);

impl Default for Times {
    fn default() -> Self {
        Times(
            Histogram::new_with_bounds(1, 3_600_000_000_000, 3)
                .expect("it is a range, and 3 digits are allowed"),
        )
    }
}

impl Times {
    pub fn record(&mut self, ns: u64) {
        self.0.saturating_record(ns);
    }

    pub fn count(&self) -> u64 {
        self.0.len()
    }

    pub fn max_ns(&self) -> u64 {
        self.0.max()
    }

    pub fn clear(&mut self) {
        self.0.reset();
    }

    /// The median, the 99th percentile and the maximum in ms; `None` without a value.
    pub fn ms(&self) -> Option<[f64; 3]> {
        let all = || [self.0.value_at_quantile(0.5), self.0.value_at_quantile(0.99), self.0.max()].map(ms);
        (!self.0.is_empty()).then(all)
    }

    pub fn to_json(&self) -> Value {
        self.ms().map_or(Value::Null, |[p50, p99, max]| json!({ "p50": p50, "p99": p99, "max": max }))
    }

    pub fn cells(&self) -> [String; 3] {
        self.ms().map_or(["-", "-", "-"].map(String::from), |all| all.map(|ms| format!("{ms:.3}")))
    }
}

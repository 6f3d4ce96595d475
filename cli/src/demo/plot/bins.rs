// SPDX-License-Identifier: MIT OR Apache-2.0
use crate::demo::report::TopicReport;

/// The axis ends here even if a response time is longer, so that an outlier does not squeeze everything else into one bin.
const MAX_DEADLINES: f64 = 4.0;

/// Response times counted in bins of equal width, the deadline being the end of one of them.
pub struct Bins {
    pub counts: Vec<u64>,
    pub bin_ms: f64,
    /// How many bins lie before the deadline.
    pub on_time: usize,
    /// Response times past the axis, counted in the last bin.
    pub beyond: u64,
}

impl Bins {
    pub fn new(topic: &TopicReport, count: usize) -> Self {
        let deadline = topic.deadline_ms.max(1e-6);
        let longest = topic.max_ms.unwrap_or(0.0).max(topic.rta_overhead_ms.unwrap_or(0.0)).max(deadline);
        let end = (longest * 1.06).min(deadline * MAX_DEADLINES);
        let on_time = (deadline / end * count as f64).floor();
        let mut bins =
            Self { counts: vec![0; count], bin_ms: deadline / on_time, on_time: on_time as usize, beyond: 0 };
        let last = count - 1;
        for latency in &topic.latencies_ns {
            // A response time on the edge of two bins is in the lower one, so a response at the deadline is on time.
            let latency_ms = *latency as f64 / 1e6;
            let mut bin = ((latency_ms / bins.bin_ms).ceil() as usize).saturating_sub(1);
            if latency_ms <= deadline {
                bin = bin.min(bins.on_time - 1);
            }
            bins.beyond += u64::from(bin > last);
            bins.counts[bin.min(last)] += 1;
        }
        bins
    }

    pub fn end_ms(&self) -> f64 {
        self.bin_ms * self.counts.len() as f64
    }
}

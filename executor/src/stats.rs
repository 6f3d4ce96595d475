// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a callback did, readable while it goes on. Recording is in `hot.rs`.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Values below this are counted exactly, and each power of two above is cut into this many buckets: a bucket is at
/// most 1/128 of its values wide.
pub(crate) const SUB_BUCKETS: usize = 1 << SUB_BITS;
pub(crate) const SUB_BITS: u32 = 7;
/// Up to 2^38 ns, 274 s.
pub(crate) const BUCKETS: usize = (38 - SUB_BITS as usize + 1) * SUB_BUCKETS;

/// A histogram of durations in ns: fixed size (32 KiB), at most 1 % off, from 1 ns to 274 s (longer ones count as 274 s
/// but keep their maximum). One thread writes, any thread may read meanwhile.
#[derive(Debug)]
pub struct Histogram {
    pub(crate) buckets: Box<[AtomicU64]>,
    pub(crate) sum_ns: AtomicU64,
    pub(crate) max_ns: AtomicU64,
}

impl Histogram {
    /// An empty one.
    ///
    /// # Real-time
    /// Setup only: allocates, and touches what it allocates.
    pub fn new() -> Histogram {
        let buckets = (0..BUCKETS).map(|_| AtomicU64::new(0)).collect();
        Histogram { buckets, sum_ns: AtomicU64::new(0), max_ns: AtomicU64::new(0) }
    }

    /// A copy to evaluate. Values recorded meanwhile may be missing from it, or from its mean.
    ///
    /// # Real-time
    /// For other threads than the one that records: allocates 32 KiB.
    pub fn snapshot(&self) -> HistogramSnapshot {
        // Acquire: pairs with the Release in `record`, so the maximum read below covers every value counted here.
        let counts: Box<[u64]> = self.buckets.iter().map(|bucket| bucket.load(Ordering::Acquire)).collect();
        HistogramSnapshot {
            n: counts.iter().sum(),
            counts,
            sum_ns: self.sum_ns.load(Ordering::Relaxed),
            max_ns: self.max_ns.load(Ordering::Relaxed),
        }
    }
}

impl Default for Histogram {
    fn default() -> Histogram {
        Histogram::new()
    }
}

/// The bucket of a value.
pub(crate) const fn bucket_of(ns: u64) -> usize {
    if ns < SUB_BUCKETS as u64 {
        return ns as usize;
    }
    let exponent = ns.ilog2();
    let within = (ns >> (exponent - SUB_BITS)) as usize - SUB_BUCKETS;
    let index = (exponent - SUB_BITS + 1) as usize * SUB_BUCKETS + within;
    if index < BUCKETS { index } else { BUCKETS - 1 }
}

/// The lowest and highest value of a bucket; the last one is open upwards.
const fn bounds(index: usize) -> (u64, u64) {
    if index < SUB_BUCKETS {
        return (index as u64, index as u64);
    }
    let shift = index / SUB_BUCKETS - 1;
    let low = ((SUB_BUCKETS + index % SUB_BUCKETS) as u64) << shift;
    let high = if index == BUCKETS - 1 { u64::MAX } else { low + (1 << shift) - 1 };
    (low, high)
}

/// A histogram at one moment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HistogramSnapshot {
    counts: Box<[u64]>,
    n: u64,
    sum_ns: u64,
    max_ns: u64,
}

/// Values between two bounds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bucket {
    /// The lowest value of the bucket.
    pub low_ns: u64,
    /// The highest value of the bucket, itself included.
    pub high_ns: u64,
    /// How many were recorded.
    pub count: u64,
}

impl HistogramSnapshot {
    /// The number of values.
    pub fn n(&self) -> u64 {
        self.n
    }

    /// The value that a share `q` (0 to 1) of all values does not exceed: the upper bound of its bucket, so at most
    /// 1 % too high and never too low. Zero if there are no values.
    pub fn p(&self, q: f64) -> Duration {
        let rank = ((q.clamp(0.0, 1.0) * self.n as f64).ceil() as u64).max(1);
        let mut seen = 0;
        for bucket in self.buckets() {
            seen += bucket.count;
            if seen >= rank {
                return Duration::from_nanos(bucket.high_ns);
            }
        }
        self.max()
    }

    /// The highest value, exactly.
    pub fn max(&self) -> Duration {
        Duration::from_nanos(self.max_ns)
    }

    /// The mean; zero if there are no values.
    pub fn mean(&self) -> Duration {
        Duration::from_nanos(self.sum_ns.checked_div(self.n).unwrap_or(0))
    }

    /// The buckets that hold values, in ascending order.
    pub fn buckets(&self) -> impl Iterator<Item = Bucket> + '_ {
        self.counts.iter().enumerate().filter(|(_, count)| **count > 0).map(|(index, count)| {
            let (low_ns, high_ns) = bounds(index);
            Bucket { low_ns, high_ns: high_ns.min(self.max_ns), count: *count }
        })
    }
}

/// What is known of a callback: written by its thread, readable from any other while it runs.
#[derive(Debug)]
pub struct CallbackStats {
    name: String,
    pub(crate) releases: AtomicU64,
    pub(crate) completions: AtomicU64,
    pub(crate) overruns: AtomicU64,
    /// 0: none.
    pub(crate) deadline_ns: AtomicU64,
    execution: Histogram,
    response: Histogram,
}

impl CallbackStats {
    /// Statistics of nothing yet.
    pub(crate) fn new(name: impl Into<String>, deadline: Option<Duration>) -> CallbackStats {
        let stats = CallbackStats {
            name: name.into(),
            releases: AtomicU64::new(0),
            completions: AtomicU64::new(0),
            overruns: AtomicU64::new(0),
            deadline_ns: AtomicU64::new(0),
            execution: Histogram::new(),
            response: Histogram::new(),
        };
        stats.set_deadline(deadline);
        stats
    }

    /// The callback's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Jobs begun.
    pub fn releases(&self) -> u64 {
        self.releases.load(Ordering::Relaxed)
    }

    /// Jobs finished: at most one less than begun, except after a job that was stopped half-way.
    pub fn completions(&self) -> u64 {
        self.completions.load(Ordering::Relaxed)
    }

    /// Jobs whose response took longer than the deadline.
    pub fn overruns(&self) -> u64 {
        self.overruns.load(Ordering::Relaxed)
    }

    /// CPU time per job, with what the executor used to get to it (on a busy-polling thread: time from its begin to its
    /// end); empty where [`CallbackOptions::execution_time`](crate::CallbackOptions) is off.
    pub fn execution(&self) -> &Histogram {
        &self.execution
    }

    /// Time from a job's release to its end.
    pub fn response(&self) -> &Histogram {
        &self.response
    }

    /// The deadline that overruns are counted against.
    pub fn deadline(&self) -> Option<Duration> {
        match self.deadline_ns.load(Ordering::Relaxed) {
            0 => None,
            ns => Some(Duration::from_nanos(ns)),
        }
    }

    /// Changes the deadline, for jobs that end from now on. A deadline of zero is none.
    pub fn set_deadline(&self, deadline: Option<Duration>) {
        let ns = deadline.map_or(0, |time| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX));
        self.deadline_ns.store(ns, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buckets_join_without_gap_and_hold_their_bounds() {
        for index in 0..BUCKETS {
            let (low, high) = bounds(index);
            assert_eq!((bucket_of(low), bucket_of(high)), (index, index));
            if index + 1 < BUCKETS {
                assert_eq!(high + 1, bounds(index + 1).0);
                assert!(high - low <= low / 100, "bucket {index} is wider than 1 %");
            }
        }
        assert!(bounds(BUCKETS - 1).0 > 100_000_000_000);
    }

    #[test]
    fn extremes_and_nothing() {
        let histogram = Histogram::new();
        let empty = histogram.snapshot();
        assert_eq!((empty.n(), empty.p(0.5), empty.max(), empty.mean()), Default::default());
        for ns in [0, 1, u64::MAX / 2] {
            histogram.record(ns);
        }
        let full = histogram.snapshot();
        assert_eq!((full.n(), full.p(0.0).as_nanos(), full.p(0.5).as_nanos()), (3, 0, 1));
        assert_eq!(full.p(1.0), full.max());
        assert_eq!(full.max(), Duration::from_nanos(u64::MAX / 2));
    }

    #[test]
    fn responses_beyond_the_deadline_are_overruns() {
        let stats = CallbackStats::new("a", Some(Duration::from_nanos(100)));
        for response_ns in [99, 100, 101] {
            stats.complete(response_ns, Some(7));
        }
        stats.set_deadline(None);
        stats.complete(1_000_000, None);
        assert_eq!((stats.completions(), stats.overruns()), (4, 1));
        assert_eq!((stats.response().snapshot().n(), stats.execution().snapshot().n()), (4, 3));
    }
}

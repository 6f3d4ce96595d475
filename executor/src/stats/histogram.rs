// SPDX-License-Identifier: MIT OR Apache-2.0
//! Histograms of durations, readable during recording. Recording is in `hot.rs`.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tautline_rt::Words;

/// Values below this are counted exactly, and each power of two above is cut into this many buckets: a bucket is at
/// most 1/128 of its values wide.
pub(crate) const SUB_BUCKETS: usize = 1 << SUB_BITS;
pub(crate) const SUB_BITS: u32 = 7;
/// Up to 2^38 ns, 274 s.
pub(crate) const BUCKETS: usize = (38 - SUB_BITS as usize + 1) * SUB_BUCKETS;

/// Words of a histogram: the buckets, then the sum and the maximum. A reader that reads them in this order sees a maximum that covers
/// every value counted.
pub(crate) const HISTOGRAM_WORDS: usize = 2 + BUCKETS;

/// A histogram of durations in ns: fixed size (32 KiB), with an error of at most 1 %, from 1 ns to 274 s (longer
/// durations count as 274 s, but the maximum is exact). One thread writes, any thread may read meanwhile.
#[derive(Debug)]
pub struct Histogram {
    words: Arc<Words>,
    /// Its first index in `words`.
    at: usize,
}

impl Histogram {
    /// An empty histogram.
    ///
    /// # Real-time
    /// Setup only: allocates, and touches what it allocates.
    pub fn new() -> Histogram {
        Histogram { words: Arc::new(Words::private(HISTOGRAM_WORDS)), at: 0 }
    }

    /// The histogram that lies `at` words into a block.
    pub(crate) fn within(words: Arc<Words>, at: usize) -> Histogram {
        Histogram { words, at }
    }

    pub(crate) fn words(&self) -> &[AtomicU64] {
        self.words.get(self.at..self.at + HISTOGRAM_WORDS).unwrap_or(&[])
    }

    /// A copy for evaluation. Values that are recorded meanwhile may be missing in it, or in its mean.
    ///
    /// # Real-time
    /// Not for the recording thread: allocates 32 KiB.
    pub fn snapshot(&self) -> HistogramSnapshot {
        let words: Vec<u64> = self.words().iter().map(|word| word.load(Ordering::Acquire)).collect();
        HistogramSnapshot::of_words(&words)
    }
}

impl Default for Histogram {
    fn default() -> Histogram {
        Histogram::new()
    }
}

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

/// A snapshot of a histogram.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HistogramSnapshot {
    counts: Box<[u64]>,
    n: u64,
    sum_ns: u64,
    max_ns: u64,
}

/// The values between two bounds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bucket {
    /// The lowest value of the bucket.
    pub low_ns: u64,
    /// The highest value of the bucket, inclusive.
    pub high_ns: u64,
    /// The number of recorded values.
    pub count: u64,
}

impl HistogramSnapshot {
    /// Reads a histogram's words, which another process may have written; accepts any content.
    pub(crate) fn of_words(words: &[u64]) -> HistogramSnapshot {
        let (counts, sum_ns, max_ns) = match words {
            [counts @ .., sum, max] => (counts, *sum, *max),
            _ => (&[][..], 0, 0),
        };
        let n = counts.iter().fold(0u64, |sum, count| sum.saturating_add(*count));
        HistogramSnapshot { n, counts: counts.into(), sum_ns, max_ns }
    }

    /// Rebuilds a snapshot from its [`buckets`](Self::buckets), [`sum_ns`](Self::sum_ns) and [`max`](Self::max).
    pub fn of_buckets(
        buckets: impl IntoIterator<Item = Bucket>,
        sum_ns: u64,
        max_ns: u64,
    ) -> HistogramSnapshot {
        let (mut counts, mut n) = (vec![0u64; BUCKETS].into_boxed_slice(), 0u64);
        for Bucket { low_ns, count, .. } in buckets {
            let place = &mut counts[bucket_of(low_ns)];
            *place = place.saturating_add(count);
            n = n.saturating_add(count);
        }
        HistogramSnapshot { counts, n, sum_ns, max_ns }
    }

    /// The sum of all values.
    pub fn sum_ns(&self) -> u64 {
        self.sum_ns
    }

    /// The number of values.
    pub fn n(&self) -> u64 {
        self.n
    }

    /// The `q` quantile (0 to 1): the upper bound of its bucket, so at most 1 % too high and never too low. Zero if
    /// there are no values.
    pub fn p(&self, q: f64) -> Duration {
        let rank = ((q.clamp(0.0, 1.0) * self.n as f64).ceil() as u64).max(1);
        let mut seen = 0;
        for bucket in self.buckets() {
            seen = bucket.count.saturating_add(seen);
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
    fn taken_apart_and_put_together() {
        let histogram = Histogram::new();
        (0..100_000).step_by(77).for_each(|ns| histogram.record(ns));
        let snapshot = histogram.snapshot();
        let again = HistogramSnapshot::of_buckets(snapshot.buckets(), snapshot.sum_ns(), snapshot.max_ns);
        assert_eq!(again, snapshot);
    }
}

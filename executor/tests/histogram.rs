// SPDX-License-Identifier: MIT OR Apache-2.0
//! The histogram agrees with hdrhistogram, and can be read while it is written.

use std::sync::Arc;

use tautline_executor::Histogram;

/// splitmix64: random enough, and the same everywhere for a seed.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }

    /// Evenly spread over the orders of magnitude from 1 ns to 100 s.
    fn duration_ns(&mut self) -> u64 {
        let share = self.next() as f64 / u64::MAX as f64;
        10f64.powf(share * 11.0) as u64
    }
}

#[test]
fn quantiles_agree_with_hdrhistogram_within_one_percent() {
    let mut random = Random(tautline_seed::seed());
    let ours = Histogram::new();
    let mut theirs = hdrhistogram::Histogram::<u64>::new_with_bounds(1, 200_000_000_000, 4).unwrap();
    for _ in 0..50_000 {
        let ns = random.duration_ns();
        ours.record(ns);
        theirs.record(ns).unwrap();
    }
    let ours = ours.snapshot();
    assert_eq!(ours.n(), theirs.len());
    let close = |what: &str, mine: f64, other: f64, share: f64| {
        assert!((mine - other).abs() <= other * share + 1.0, "{what}: {mine} against {other}");
    };
    for q in [0.0, 0.001, 0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 0.999, 0.9999, 1.0] {
        close(&format!("p({q})"), ours.p(q).as_nanos() as f64, theirs.value_at_quantile(q) as f64, 0.01);
    }
    close("max", ours.max().as_nanos() as f64, theirs.max() as f64, 0.000_2);
    close("mean", ours.mean().as_nanos() as f64, theirs.mean(), 0.000_2);
    assert_eq!(ours.buckets().map(|bucket| bucket.count).sum::<u64>(), ours.n());
}

#[test]
fn a_reader_sees_a_histogram_that_is_whole_while_it_grows() {
    const VALUES: u64 = 200_000;
    let histogram = Arc::new(Histogram::new());
    let written = histogram.clone();
    let writer = std::thread::spawn(move || (1..=VALUES).for_each(|ns| written.record(ns)));
    let mut seen = 0;
    while seen < VALUES {
        let snapshot = histogram.snapshot();
        assert!(snapshot.n() >= seen);
        seen = snapshot.n();
        // The maximum covers every value counted.
        let highest = snapshot.buckets().last().map_or(0, |bucket| bucket.low_ns);
        assert!(snapshot.max().as_nanos() >= u128::from(highest));
    }
    writer.join().unwrap();
    assert_eq!(histogram.snapshot().max().as_nanos(), u128::from(VALUES));
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs every way of every case in turn, and times it.

use std::hint::black_box;
use std::time::Instant;

use tautline_benches::{Distribution, progress_bar, rows};

use crate::Result;
use crate::cases::{Case, Way};
use crate::report::Row;

/// What is done `BATCH` times is timed as one, where it takes less than the clock can tell.
const BATCH: u32 = 100;
const SMALL: usize = 16 << 10;

/// Alternates between the ways of each case; the first round is not counted.
pub fn run(cases: &mut [Case], quick: bool) -> Result<Vec<Row>> {
    let (rounds, samples) = if quick { (7, 30) } else { (41, 100) };
    let progress = progress_bar((cases.len() * (rounds + 1)) as u64);
    let mut rows = Vec::new();
    for case in cases {
        progress.set_message(case.name);
        let mut measured: Vec<_> = case.ways.iter().map(|_| Measured::default()).collect();
        for round in 0..=rounds {
            for (way, measured) in case.ways.iter_mut().zip(&mut measured) {
                let times = time(way, case.bytes, samples)?;
                if round > 0 {
                    measured.add(times);
                }
            }
            progress.inc(1);
        }
        let floor = measured.first().map(|floor| floor.rounds.clone()).unwrap_or_default();
        for (way, measured) in case.ways.iter().zip(measured) {
            rows.push(Row {
                case: case.name,
                implementation: way.implementation,
                bytes: case.bytes,
                n: measured.all.len() * u64::from(batch(case.bytes)),
                p50_us: measured.all.quantile_us(0.5),
                p99_us: measured.all.quantile_us(0.99),
                ratio_to_plain_buffer: median_ratio(&measured.rounds, &floor),
                rounds_ns: measured.rounds,
            });
        }
    }
    progress.finish_and_clear();
    Ok(rows)
}

#[derive(Default)]
struct Measured {
    all: Distribution,
    /// The median of each round in ns.
    rounds: Vec<f64>,
}

impl Measured {
    fn add(&mut self, times_ns: Vec<f64>) {
        for time in &times_ns {
            self.all.record(time.round() as u64);
        }
        self.rounds.push(median(times_ns));
    }
}

fn batch(bytes: usize) -> u32 {
    if bytes < SMALL { BATCH } else { 1 }
}

fn time(way: &mut Way, bytes: usize, samples: usize) -> Result<Vec<f64>> {
    let batch = batch(bytes);
    let mut times = Vec::with_capacity(samples);
    for _ in 0..samples {
        let start = Instant::now();
        for _ in 0..batch {
            black_box((way.run)()?);
        }
        times.push(start.elapsed().as_nanos() as f64 / f64::from(batch));
    }
    Ok(times)
}

/// The ratio of the median round: virtual cores change their speed between rounds.
pub fn median_ratio(ours: &[f64], theirs: &[f64]) -> f64 {
    median(ours.iter().zip(theirs).map(|(ours, theirs)| ours / theirs).collect())
}

fn median(values: Vec<f64>) -> f64 {
    rows::median(values).unwrap_or(f64::NAN)
}

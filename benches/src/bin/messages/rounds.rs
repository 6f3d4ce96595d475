// SPDX-License-Identifier: MIT OR Apache-2.0
//! Runs every way of every case in turn, and times it.

use std::hint::black_box;
use std::time::Instant;

use tautline_harness::rows::{Row, Tally, median};
use tautline_harness::{Distribution, progress_bar};

use crate::Result;
use crate::cases::{Case, Way};

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
        let mut measured: Vec<_> = case.ways.iter().map(|_| Tally::default()).collect();
        for round in 0..=rounds {
            for (way, measured) in case.ways.iter_mut().zip(&mut measured) {
                let times_ns = time(way, case.bytes, samples)?;
                if round > 0 {
                    add(measured, round as u32, times_ns);
                }
            }
            progress.inc(1);
        }
        for (way, measured) in case.ways.iter().zip(measured) {
            let row = measured.row(case.name, way.system, way.mode, case.bytes);
            rows.push(Row { n: row.n * u64::from(batch(case.bytes)), ..row });
        }
    }
    progress.finish_and_clear();
    Ok(rows)
}

/// Some take a few ns: the median of a round has more digits than each time.
fn add(measured: &mut Tally, round: u32, times_ns: Vec<f64>) {
    let mut times = Distribution::new();
    times_ns.iter().for_each(|time| times.record(time.round() as u64));
    measured.add(round, &times).p50_us = median(times_ns).unwrap_or(f64::NAN) / 1e3;
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

// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::Distribution;
use crate::rows::extent;

/// What was measured in one part of all rounds.
#[derive(Clone, Debug)]
pub struct Turns {
    /// Of all rounds.
    pub of_all: Distribution,
    /// Of each round: the 99th percentile to that of its first part. What disturbed one round is one of many.
    ratios: Vec<f64>,
}

impl Turns {
    /// Measures `N` parts of each round, by their index. Each comes first, second and so on equally often.
    pub fn take<const N: usize, E>(
        rounds: usize,
        mut measure: impl FnMut(usize) -> Result<Distribution, E>,
    ) -> Result<[Turns; N], E> {
        let mut turns: [Turns; N] =
            std::array::from_fn(|_| Turns { of_all: Distribution::new(), ratios: Vec::new() });
        for round in 0..rounds {
            eprint!("\rround {} of {rounds} ", round + 1);
            let mut p99_us = [0.0; N];
            for at in 0..N {
                let index = (at + round) % N;
                let now = measure(index)?;
                p99_us[index] = now.quantile_us(0.99);
                turns[index].of_all.add(&now.counts());
            }
            turns
                .iter_mut()
                .zip(p99_us)
                .for_each(|(part, p99_us_of_it)| part.ratios.push(p99_us_of_it / p99_us[0]));
        }
        eprintln!("\r                    ");
        Ok(turns)
    }

    /// Of the ratios: the median, the least and the greatest.
    pub fn ratio(&self) -> [f64; 3] {
        let [least, median, greatest] = extent(self.ratios.clone());
        [median, least, greatest]
    }
}

/// Prints whether what was asked for is so. A miss is never an error: the machine has its part in it.
pub fn print_verdict(holds: bool, what: &str) {
    println!("{}: {what}", if holds { "holds" } else { "MISSED" });
}

/// Instead of verdicts.
pub fn print_no_verdict() {
    println!("no verdict: it takes real-time priorities and two cores");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_take_turns_and_are_compared_with_the_first() {
        let mut order = Vec::new();
        let [first, second] = Turns::take(4, |part| {
            order.push(part);
            let mut now = Distribution::new();
            // The second takes 1, 2, 3 and 4 times as long.
            now.record(1000 * (1 + part * (order.len() - 1) / 2) as u64);
            Ok::<_, ()>(now)
        })
        .unwrap();
        assert_eq!(order, [0, 1, 1, 0, 0, 1, 1, 0]);
        assert_eq!((first.of_all.len(), first.ratio()), (4, [1.0; 3]));
        let [median, least, greatest] = second.ratio();
        assert!(least < 1.01 && (median - 3.0).abs() < 0.01 && (greatest - 4.0).abs() < 0.01, "{second:?}");
    }
}

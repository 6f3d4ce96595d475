// SPDX-License-Identifier: MIT OR Apache-2.0

use serde::Serialize;

use crate::Distribution;
use crate::rows::{Row, Tally, extent};

/// What was measured in one part of all rounds.
#[derive(Clone, Debug)]
pub struct Turns {
    pub tally: Tally,
    /// Of each round: the 99th percentile to that of its first part. What disturbed one round is one of many.
    ratios: Vec<f64>,
}

/// The row of a part, and what its JSON says beside.
#[derive(Clone, Debug, Default, Serialize)]
pub struct TurnRow {
    #[serde(flatten)]
    pub row: Row,
    /// Of the 99th percentile to that of the first part: the median of the rounds, the least and the greatest.
    pub ratio: Option<[f64; 3]>,
    pub steal_ticks: Option<u64>,
    pub realtime: bool,
    pub disturbance: String,
}

impl Turns {
    /// Measures `N` parts of each round, by their index. Each comes first, second and so on equally often.
    pub fn take<const N: usize, E>(
        rounds: u32,
        mut measure: impl FnMut(usize) -> Result<Distribution, E>,
    ) -> Result<[Turns; N], E> {
        let mut turns: [Turns; N] =
            std::array::from_fn(|_| Turns { tally: Tally::default(), ratios: Vec::new() });
        for round in 0..rounds {
            eprint!("\rround {} of {rounds} ", round + 1);
            let mut p99_us = [0.0; N];
            for at in 0..N {
                let index = (at + round as usize) % N;
                let now = measure(index)?;
                p99_us[index] = now.quantile_us(0.99);
                turns[index].tally.add(round + 1, &now);
            }
            turns.iter_mut().zip(p99_us).for_each(|(part, p99)| part.ratios.push(p99 / p99_us[0]));
        }
        eprintln!("\r                    ");
        Ok(turns)
    }

    /// The row of this part, which notes the ratios to the first one, `first`.
    pub fn row(&self, experiment: &str, system: &str, mode: &str, first: &str) -> TurnRow {
        let [least, median, greatest] = extent(self.ratios.clone());
        let mut row = self.tally.row(experiment, system, mode, 0);
        row.note = format!("p99 {median:.2} x ({least:.2} to {greatest:.2}) that of the {first}");
        TurnRow { row, ratio: Some([median, least, greatest]), ..TurnRow::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_take_turns_and_are_compared_with_the_first() {
        let mut order = Vec::new();
        let turns: [Turns; 2] = Turns::take(4, |part| {
            order.push(part);
            let mut now = Distribution::new();
            // The second takes 1, 2, 3 and 4 times as long.
            now.record(1000 * (1 + part * (order.len() - 1) / 2) as u64);
            Ok::<_, ()>(now)
        })
        .unwrap();
        assert_eq!(order, [0, 1, 1, 0, 0, 1, 1, 0]);
        let [first, second] = turns.map(|turns| turns.row("experiment", "system", "mode", "first"));
        assert_eq!((first.row.n, first.ratio), (4, Some([1.0; 3])));
        let [median, least, greatest] = second.ratio.unwrap();
        assert!(least < 1.01 && (median - 3.0).abs() < 0.01 && (greatest - 4.0).abs() < 0.01, "{second:?}");
    }
}

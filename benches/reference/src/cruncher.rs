// SPDX-License-Identifier: MIT OR Apache-2.0
//! The work of a node, and how much of it the graph asks for.

use std::hint::black_box;
use std::time::Duration;

use tautline_rt::clock::thread_cpu_ns;

use crate::graph::{CALLBACKS, rate_hz};

/// Up to where primes are counted, in the original: there are 564.
pub const CRUNCHER_LIMIT: u64 = 4096;
const TRIALS: usize = 9;
/// How much of a processor the graph should ask for at most: the rest of the system has to run as well.
const SENSIBLE_SHARE: f64 = 0.8;

/// Counts the primes up to `limit` by dividing each number by all that are smaller, until one divides it.
///
/// # Real-time
/// No allocation, no syscall; quadratic in `limit`.
pub fn number_cruncher(limit: u64) -> u64 {
    let is_prime = |candidate: u64| (2..candidate).all(|divisor| !candidate.is_multiple_of(divisor));
    (2..=limit).filter(|&candidate| black_box(is_prime(candidate))).count() as u64
}

#[derive(Clone, Copy, Debug)]
pub struct Load {
    /// Up to where primes are counted.
    pub cruncher_limit: u64,
    /// How long that takes: the median of some runs, in processor time.
    pub crunch: Duration,
    /// How many cores the work of all nodes keeps busy.
    pub cores_needed: f64,
    pub cores: usize,
}

impl Load {
    /// Measures the work on the calling thread: some tens of milliseconds.
    pub fn measure(cruncher_limit: u64) -> Load {
        let mut times_ns: Vec<u64> = (0..TRIALS)
            .map(|_| {
                let before_ns = thread_cpu_ns();
                black_box(number_cruncher(black_box(cruncher_limit)));
                thread_cpu_ns() - before_ns
            })
            .collect();
        times_ns.sort_unstable();
        let crunch = Duration::from_nanos(times_ns[TRIALS / 2]);
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Load::of(cruncher_limit, crunch, cores)
    }

    fn of(cruncher_limit: u64, crunch: Duration, cores: usize) -> Load {
        let rates = CALLBACKS.iter().filter(|callback| callback.works).map(rate_hz);
        let cores_needed = rates.sum::<f64>() * crunch.as_secs_f64();
        Load { cruncher_limit, crunch, cores_needed, cores }
    }

    /// The limit with which the graph fits, if with this one it does not.
    pub fn sensible_limit(&self) -> Option<u64> {
        let there = SENSIBLE_SHARE * self.cores as f64;
        // The work grows with the square of the limit, divided by its logarithm: this errs towards less.
        (self.cores_needed > there)
            .then(|| (self.cruncher_limit as f64 * (there / self.cores_needed).sqrt()) as u64)
    }
}

impl std::fmt::Display for Load {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let crunch_ms = self.crunch.as_secs_f64() * 1e3;
        let (limit, needed, cores) = (self.cruncher_limit, self.cores_needed, self.cores);
        write!(
            f,
            "counting the primes up to {limit} takes {crunch_ms:.3} ms; all nodes together need {needed:.2} of {cores} cores"
        )?;
        match self.sensible_limit() {
            Some(limit) => write!(f, ", which is too much: pass --cruncher-limit {limit}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_564_primes_up_to_4096() {
        assert_eq!(number_cruncher(CRUNCHER_LIMIT), 564);
        assert_eq!([0, 1, 2, 3, 4, 5].map(number_cruncher), [0, 0, 1, 2, 2, 3]);
    }

    #[test]
    fn too_much_work_is_said_with_what_fits() {
        let fits = Load::of(4096, Duration::from_millis(2), 2);
        assert!((fits.cores_needed - 0.38).abs() < 0.05, "{fits}");
        assert_eq!(fits.sensible_limit(), None);
        let too_much = Load::of(4096, Duration::from_millis(20), 2);
        let limit = too_much.sensible_limit().unwrap();
        assert!(too_much.to_string().ends_with(&format!("pass --cruncher-limit {limit}")));
        let cheaper = Duration::from_millis(20).mul_f64((limit as f64 / 4096.0).powi(2));
        assert_eq!(Load::of(limit, cheaper, 2).sensible_limit(), None);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tail of measured execution times, by extreme-value theory: the time that one job in a given number exceeds.
//!
//! Peaks over a threshold follow a generalized Pareto distribution (J. Pickands, Annals of Statistics 3(1), 1975). Its parameters are
//! fitted by probability-weighted moments; a parametric bootstrap gives the error of the fit. Jobs are assumed to be independent and
//! identically distributed, which no histogram can show.

use tautline::Bucket;

/// The share of the jobs that belong to the tail, and the minimum and maximum of their number.
const TAIL: f64 = 0.1;
const FEWEST: usize = 50;
const MOST: usize = 2000;
/// The largest extrapolation: an estimate is at most this many times as rare as one of all jobs.
const FURTHEST: f64 = 100.0;
/// The number of samples of the bootstrap.
const RESAMPLES: usize = 400;
/// The share of runs in which the true value shall be below the limit. The bootstrap achieves a little less: 0.79 to 0.93 in the test, least
/// for the heaviest tail; 0.87 to 0.99 if only the longest 64 jobs are known.
pub const CONFIDENCE: f64 = 0.95;
/// The significance level at which a fit is rejected.
const SIGNIFICANCE: f64 = 0.05;
/// The shape from which on the moments do not exist.
const HEAVIEST: f64 = 0.5;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tail {
    /// The shape: the tail is unbounded above 0, bounded below 0.
    pub shape: f64,
    /// The estimate: the time in nanoseconds that one job in the requested number exceeds.
    pub estimate_ns: f64,
    /// The upper limit of the estimate, with a confidence of 95 %.
    pub upper_ns: f64,
}

/// Why a tail cannot be estimated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NoTail {
    /// There are too few jobs; this many are needed.
    TooFewJobs(u64),
    /// All jobs took the same time.
    AllAlike,
    /// There are too many long jobs: they are of another kind than the others.
    TooHeavy,
    /// The bootstrap rejects the generalized Pareto distribution.
    NoFit,
}

/// The reason in words.
pub fn words(none: NoTail) -> String {
    match none {
        NoTail::TooFewJobs(needed) => format!("because that takes {needed} jobs"),
        NoTail::AllAlike => "because nearly all jobs took the same time: use their maximum".to_owned(),
        NoTail::TooHeavy => {
            "because long jobs are too frequent: find what makes them long, such as interrupts, page faults or a second kind of input"
                .to_owned()
        }
        NoTail::NoFit => {
            "because long jobs are of several kinds, which do not predict longer ones: measure each kind separately".to_owned()
        }
    }
}

/// A generalized Pareto distribution of the excesses over a threshold, with Hosking's sign of `k`: the shape is `-k`.
#[derive(Clone, Copy)]
struct Pareto {
    k: f64,
    scale: f64,
}

impl Pareto {
    /// Fits ascending values by probability-weighted moments (J. R. M. Hosking, J. R. Wallis, Technometrics 29(3), 1987, equation 7).
    fn fit(excesses: &[f64]) -> Option<Pareto> {
        let n = excesses.len() as f64;
        let mean = excesses.iter().sum::<f64>() / n;
        let weighed = |(j, x): (usize, &f64)| (1.0 - (j as f64 + 0.65) / n) * x;
        let moment = excesses.iter().enumerate().map(weighed).sum::<f64>() / n;
        let difference = mean - 2.0 * moment;
        (difference > 1e-9 * mean)
            .then(|| Pareto { k: mean / difference - 2.0, scale: 2.0 * mean * moment / difference })
    }

    /// The excess that one in `1 / beyond` exceeds.
    fn quantile(self, beyond: f64) -> f64 {
        if self.k.abs() < 1e-9 {
            return -self.scale * beyond.ln();
        }
        self.scale / self.k * (1.0 - beyond.powf(self.k))
    }

    fn cumulative(self, x: f64) -> f64 {
        if self.k.abs() < 1e-9 {
            return 1.0 - (-x / self.scale).exp();
        }
        1.0 - (1.0 - self.k * x / self.scale).max(0.0).powf(1.0 / self.k)
    }

    /// The distance of ascending values from this distribution: the statistic of Cramér and von Mises.
    fn distance(self, excesses: &[f64]) -> f64 {
        let n = excesses.len() as f64;
        let of_one = |(j, x): (usize, &f64)| (self.cumulative(*x) - (j as f64 + 0.5) / n).powi(2);
        excesses.iter().enumerate().map(of_one).sum::<f64>() + 1.0 / (12.0 * n)
    }
}

/// The time that one job in `1 / exceedance` exceeds, estimated from the tail of these jobs. The buckets are ascending; `max_ns` is the
/// longest job.
///
/// # Errors
/// The reason why there is no estimate.
pub fn tail(buckets: &[Bucket], max_ns: u64, exceedance: f64) -> Result<Tail, NoTail> {
    let jobs: u64 = buckets.iter().map(|bucket| bucket.count).sum();
    suffice(jobs, exceedance)?;
    let wanted = ((jobs as f64 * TAIL) as u64).min(MOST as u64);
    let (mut above, mut first) = (0, buckets.len());
    // The tail consists of whole buckets; the lower end of the first one is the threshold.
    while first > 0 && above < wanted {
        first -= 1;
        above += buckets[first].count;
    }
    if first == 0 {
        return Err(NoTail::AllAlike);
    }
    let (threshold_ns, share) = (buckets[first].low_ns as f64, above as f64 / jobs as f64);
    // If there are too many jobs, each value represents several.
    let step = (above as usize).div_ceil(10 * MOST) as u64;
    let mut excesses = Vec::new();
    for bucket in &buckets[first..] {
        let low = bucket.low_ns as f64;
        let width = (bucket.high_ns as f64 + 1.0 - low).max(0.0);
        // The jobs' places within a bucket are unknown.
        let spread = (0..bucket.count).step_by(step.max(1) as usize);
        excesses.extend(spread.map(|n| low - threshold_ns + width * (n as f64 + 0.5) / bucket.count as f64));
    }
    fit_above(threshold_ns, &excesses, share, exceedance, jobs ^ max_ns)
}

/// As [`tail`], if only the longest jobs are known: one of them is the threshold.
///
/// # Errors
/// As [`tail`].
pub fn tail_of_longest(longest_ns: &[u64], jobs: u64, max_ns: u64, exceedance: f64) -> Result<Tail, NoTail> {
    suffice(jobs, exceedance)?;
    let mut longest_ns = longest_ns.to_vec();
    longest_ns.sort_unstable();
    let wanted = ((jobs as f64 * TAIL) as usize).min(longest_ns.len().saturating_sub(1));
    let [threshold_ns, above @ ..] = &longest_ns[longest_ns.len().saturating_sub(wanted + 1)..] else {
        return Err(NoTail::AllAlike);
    };
    let excesses: Vec<f64> = above.iter().map(|ns| (ns - threshold_ns) as f64).collect();
    let share = excesses.len() as f64 / jobs as f64;
    fit_above(*threshold_ns as f64, &excesses, share, exceedance, jobs ^ max_ns)
}

fn suffice(jobs: u64, exceedance: f64) -> Result<(), NoTail> {
    let needed = ((FEWEST as f64 / TAIL) as u64).max((1.0 / (exceedance * FURTHEST)).round() as u64);
    if jobs < needed { Err(NoTail::TooFewJobs(needed)) } else { Ok(()) }
}

/// Fits the ascending excesses of a share of the jobs over a threshold.
fn fit_above(
    threshold_ns: f64,
    excesses: &[f64],
    share: f64,
    exceedance: f64,
    seed: u64,
) -> Result<Tail, NoTail> {
    let fitted = Pareto::fit(excesses).ok_or(NoTail::AllAlike)?;
    if -fitted.k >= HEAVIEST {
        return Err(NoTail::TooHeavy);
    }
    let beyond = (exceedance / share).min(1.0);
    let observed = fitted.distance(excesses);
    let (mut random, mut further, mut quantiles) = (Random(seed), 0, Vec::new());
    let mut drawn = vec![0.0; excesses.len()];
    for _ in 0..RESAMPLES {
        drawn.iter_mut().for_each(|x| *x = fitted.quantile(random.unit()));
        drawn.sort_by(f64::total_cmp);
        if let Some(again) = Pareto::fit(&drawn) {
            further += usize::from(again.distance(&drawn) >= observed);
            quantiles.push(again.quantile(beyond));
        }
    }
    if (further as f64) < SIGNIFICANCE * RESAMPLES as f64 {
        return Err(NoTail::NoFit);
    }
    quantiles.sort_by(f64::total_cmp);
    let estimate = fitted.quantile(beyond);
    let upper = quantiles.get((quantiles.len() as f64 * CONFIDENCE) as usize).copied().unwrap_or(estimate);
    Ok(Tail { shape: -fitted.k, estimate_ns: threshold_ns + estimate, upper_ns: threshold_ns + upper })
}

/// splitmix64 (G. Steele, D. Lea, C. Flood, OOPSLA 2014), so that a run always has the same estimate.
pub struct Random(pub u64);

impl Random {
    /// A number above 0 and below 1.
    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (((z ^ (z >> 31)) >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline::HistogramSnapshot;

    /// Draws jobs of a distribution, in the buckets of the statistics.
    fn run(jobs: u64, random: &mut Random, quantile: impl Fn(f64) -> f64) -> (Vec<Bucket>, u64) {
        let times: Vec<u64> = (0..jobs).map(|_| quantile(random.unit()) as u64).collect();
        let max_ns = times.iter().copied().max().unwrap();
        let bucket = |ns: &u64| Bucket { low_ns: *ns, high_ns: *ns, count: 1 };
        let histogram = HistogramSnapshot::of_buckets(times.iter().map(bucket), times.iter().sum(), max_ns);
        (histogram.buckets().collect(), max_ns)
    }

    /// The share of runs in which the true value is at most the upper limit, and the median error of the estimate.
    fn covered(quantile: impl Fn(f64) -> f64, exceedance: f64, of_longest: bool) -> (f64, f64) {
        let (mut random, truth) = (Random(7), quantile(exceedance));
        let (mut covered, mut off) = (0, Vec::new());
        for _ in 0..if of_longest { 100 } else { 30 } {
            let tail = if of_longest {
                let mut times: Vec<u64> = (0..5_000).map(|_| quantile(random.unit()) as u64).collect();
                times.sort_unstable();
                tail_of_longest(&times[5_000 - 64..], 5_000, times[4_999], exceedance)
            } else {
                let (buckets, max_ns) = run(5_000, &mut random, &quantile);
                tail(&buckets, max_ns, exceedance)
            };
            if let Ok(tail) = tail {
                covered += usize::from(tail.upper_ns >= truth);
                off.push((tail.estimate_ns / truth - 1.0).abs());
            }
        }
        off.sort_by(f64::total_cmp);
        println!("{covered} covered, {} estimates, median error {}", off.len(), off[off.len() / 2]);
        (covered as f64 / off.len() as f64, off[off.len() / 2])
    }

    #[test]
    fn the_true_value_is_below_the_limit() {
        // Distributions with known quantiles: exponential, uniform, Pareto of shape 0.2.
        let exponential = |u: f64| 1e6 - 5e4 * u.ln();
        let uniform = |u: f64| 1e6 + 5e5 * (1.0 - u);
        let pareto = |u: f64| 1e6 + 5e4 / 0.2 * (u.powf(-0.2) - 1.0);
        // docs/report.md states these numbers.
        for (of_longest, shares) in [(false, 0.785..0.935), (true, 0.865..0.995)] {
            for (name, (covered, off)) in [
                ("exponential", covered(exponential, 1e-5, of_longest)),
                ("uniform", covered(uniform, 1e-5, of_longest)),
                ("pareto", covered(pareto, 1e-5, of_longest)),
            ] {
                assert!(shares.contains(&covered) && off < 0.4, "{name}: {covered} covered, off by {off}");
            }
        }
    }

    #[test]
    fn without_enough_jobs_or_a_fit_there_is_no_estimate() {
        let mut random = Random(1);
        let (few, max) = run(9_999, &mut random, |u| 1e6 - 5e4 * u.ln());
        assert_eq!(tail(&few, max, 1e-6), Err(NoTail::TooFewJobs(10_000)));
        assert!(tail(&few, max, 1e-5).is_ok());
        let (same, max) = run(10_000, &mut random, |_| 1e6);
        assert_eq!(tail(&same, max, 1e-6), Err(NoTail::AllAlike));
        let (heavy, max) = run(10_000, &mut random, |u| 1e5 * u.powf(-1.0));
        assert_eq!(tail(&heavy, max, 1e-6), Err(NoTail::TooHeavy));
        // Two kinds of jobs: one in fifty takes twice as long.
        let two = |u: f64| if u < 0.02 { 2e6 + 1e4 * u } else { 1e6 + 1e4 * u };
        let (two, max) = run(10_000, &mut random, two);
        assert!(matches!(tail(&two, max, 1e-6), Err(NoTail::NoFit | NoTail::TooHeavy)));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is said of a run: the reference system's key performance indicators.

use serde::{Deserialize, Serialize};

use crate::graph::{CALLBACKS, FRONT_LIDAR, PLANNER, Trigger};
use crate::{Job, Load, Records, Usage};

/// The key performance indicators of one run, or of several.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Kpis {
    pub system: String,
    /// How it executes the callbacks.
    pub mode: String,
    pub realtime: bool,
    pub seconds: f64,
    /// Up to where nodes counted primes.
    pub cruncher_limit: u64,
    /// How long that took, measured before the run.
    pub crunch_ms: f64,
    /// Processor time of the process, of one core.
    pub cpu_percent: f64,
    /// Its resident memory at the end.
    pub rss_mib: f64,
    /// Messages that transforms missed.
    pub dropped_in_transforms: u64,
    /// Messages that any callback missed, also those that a fusion replaced by newer ones.
    pub dropped: u64,
    pub front_lidar_samples: u64,
    /// Of these, the ones that no run of the ObjectCollisionEstimator used.
    pub front_lidar_without_estimate: u64,
    /// Average time from the begin of the FrontLidarDriver's run to the end of the ObjectCollisionEstimator's.
    pub hot_path_average_ms: f64,
    pub hot_path_p99_ms: f64,
    pub hot_path_worst_ms: f64,
    pub hot_path_ms: Vec<f64>,
    /// Average time to that end from the begin of the run of whichever lidar came first: also what the front lidar's own run
    /// waited for the rear's is in it.
    pub both_lidars_average_ms: f64,
    pub both_lidars_worst_ms: f64,
    pub planner_runs: u64,
    /// Average difference between the time from one of its runs to the next, and its period.
    pub planner_jitter_average_ms: f64,
    pub planner_jitter_worst_ms: f64,
    /// How much later its last run began than it would have, had all periods since the first been exact.
    pub planner_drift_ms: f64,
    /// What the hypervisor gave to others, in ticks of 10 ms.
    pub steal_ticks: u64,
    pub callbacks: Vec<CallbackKpis>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CallbackKpis {
    pub name: String,
    pub runs: u64,
    /// Messages of its inputs that it missed.
    pub dropped: u64,
}

impl Kpis {
    pub fn new(system: &str, mode: &str, job: &Job, load: &Load, records: &Records, usage: &Usage) -> Kpis {
        let with_counts = || CALLBACKS.iter().enumerate().map(|(index, it)| (it, records.counts(index)));
        let dropped = |only_transforms: bool| {
            let counted = with_counts().filter(|(callback, _)| callback.is_transform || !only_transforms);
            counted.map(|(_, (_, dropped))| dropped).sum()
        };
        let samples =
            with_counts().find(|(callback, _)| callback.name == FRONT_LIDAR).map_or(0, |(_, (runs, _))| runs);
        let ms = |times_ns: Vec<u64>| times_ns.into_iter().map(|ns| ns as f64 / 1e6).collect::<Vec<_>>();
        let (hot_path_ms, both_lidars_ms) =
            (ms(records.hot_path_ns.to_vec()), ms(records.both_lidars_ns.to_vec()));
        let starts_ns = records.planner_starts_ns.to_vec();
        let (jitters_ms, planner_drift_ms) = punctuality(&starts_ns, planner_period_ns());
        let seconds = records.window.length().as_secs_f64();
        Kpis {
            system: system.to_owned(),
            mode: mode.to_owned(),
            realtime: job.realtime,
            seconds,
            cruncher_limit: job.cruncher_limit,
            crunch_ms: load.crunch.as_secs_f64() * 1e3,
            cpu_percent: usage.cpu_ns as f64 / (seconds * 1e9) * 100.0,
            rss_mib: usage.rss_bytes as f64 / f64::from(1 << 20),
            dropped_in_transforms: dropped(true),
            dropped: dropped(false),
            front_lidar_samples: samples,
            front_lidar_without_estimate: samples.saturating_sub(hot_path_ms.len() as u64),
            hot_path_average_ms: average(&hot_path_ms),
            hot_path_p99_ms: quantile(&hot_path_ms, 0.99),
            hot_path_worst_ms: worst(&hot_path_ms),
            hot_path_ms,
            both_lidars_average_ms: average(&both_lidars_ms),
            both_lidars_worst_ms: worst(&both_lidars_ms),
            planner_runs: starts_ns.len() as u64,
            planner_jitter_average_ms: average(&jitters_ms),
            planner_jitter_worst_ms: worst(&jitters_ms),
            planner_drift_ms,
            steal_ticks: usage.steal_ticks,
            callbacks: with_counts()
                .map(|(it, (runs, dropped))| CallbackKpis { name: it.name.to_owned(), runs, dropped })
                .collect(),
        }
    }

    /// Several runs as one: counts are added, latencies put together, the worst is the worst of all; processor time
    /// and other averages are averaged; memory and drift are the largest. `None` of none.
    pub fn pooled(rounds: &[Kpis]) -> Option<Kpis> {
        let mut all = rounds.first()?.clone();
        for round in &rounds[1..] {
            all.realtime &= round.realtime;
            all.seconds += round.seconds;
            all.dropped_in_transforms += round.dropped_in_transforms;
            all.dropped += round.dropped;
            all.front_lidar_samples += round.front_lidar_samples;
            all.front_lidar_without_estimate += round.front_lidar_without_estimate;
            all.hot_path_ms.extend(&round.hot_path_ms);
            all.both_lidars_worst_ms = all.both_lidars_worst_ms.max(round.both_lidars_worst_ms);
            all.planner_runs += round.planner_runs;
            all.planner_jitter_worst_ms = all.planner_jitter_worst_ms.max(round.planner_jitter_worst_ms);
            if round.planner_drift_ms.abs() > all.planner_drift_ms.abs() {
                all.planner_drift_ms = round.planner_drift_ms;
            }
            all.rss_mib = all.rss_mib.max(round.rss_mib);
            all.steal_ticks += round.steal_ticks;
            for (sum, one) in all.callbacks.iter_mut().zip(&round.callbacks) {
                sum.runs += one.runs;
                sum.dropped += one.dropped;
            }
        }
        let mean = |of: fn(&Kpis) -> f64| average(&rounds.iter().map(of).collect::<Vec<_>>());
        all.cpu_percent = mean(|round| round.cpu_percent);
        all.crunch_ms = mean(|round| round.crunch_ms);
        all.both_lidars_average_ms = mean(|round| round.both_lidars_average_ms);
        all.planner_jitter_average_ms = mean(|round| round.planner_jitter_average_ms);
        all.hot_path_average_ms = average(&all.hot_path_ms);
        all.hot_path_p99_ms = quantile(&all.hot_path_ms, 0.99);
        all.hot_path_worst_ms = worst(&all.hot_path_ms);
        Some(all)
    }
}

fn planner_period_ns() -> u64 {
    match CALLBACKS.iter().find(|callback| callback.name == PLANNER).map(|it| it.trigger) {
        Some(Trigger::Period(period)) => period.as_nanos() as u64,
        _ => unreachable!("the planner is cyclic"),
    }
}

/// How much each interval differs from the period, and how far the last start is from where it would be.
fn punctuality(starts_ns: &[u64], period_ns: u64) -> (Vec<f64>, f64) {
    let intervals = starts_ns.windows(2).map(|pair| pair[1] - pair[0]);
    let jitters_ms = intervals.map(|interval| interval.abs_diff(period_ns) as f64 / 1e6).collect();
    let drift_ms = starts_ns.first().zip(starts_ns.last()).map_or(0.0, |(first, last)| {
        let elapsed = last - first;
        let periods = (elapsed + period_ns / 2) / period_ns;
        (elapsed as f64 - (periods * period_ns) as f64) / 1e6
    });
    (jitters_ms, drift_ms)
}

fn average(values: &[f64]) -> f64 {
    if values.is_empty() { 0.0 } else { values.iter().sum::<f64>() / values.len() as f64 }
}

fn worst(values: &[f64]) -> f64 {
    values.iter().copied().fold(0.0, f64::max)
}

fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Window;
    use std::time::Duration;

    #[test]
    fn drift_survives_jitter_and_missed_runs() {
        // 1 ms late, on time, one run missed, 3 ms late in the end.
        let starts = [1_000_000, 101_000_000, 201_000_000, 401_000_000, 504_000_000];
        let (jitters, drift) = punctuality(&starts, 100_000_000);
        assert_eq!(jitters, [0.0, 0.0, 100.0, 3.0]);
        assert!((drift - 3.0).abs() < 1e-9);
        assert_eq!(punctuality(&[], 100), (vec![], 0.0));
    }

    fn kpis(latencies_ns: &[u64]) -> Kpis {
        let records = Records::new(Window { begin_ns: 0, end_ns: 1_000_000_000 });
        let index = |name| CALLBACKS.iter().position(|callback| callback.name == name).unwrap();
        (0..10).for_each(|_| records.note_run(index(FRONT_LIDAR), 0));
        records.note_run(index("RayGroundFilter"), 2);
        records.note_run(index("NDTLocalizer"), 3);
        latencies_ns.iter().for_each(|&latency| records.hot_path_ns.note(latency));
        let load = Load { cruncher_limit: 10, crunch: Duration::from_micros(5), cores_needed: 0.1, cores: 2 };
        let job = Job {
            seconds: 1.0,
            cruncher_limit: 10,
            realtime: true,
            system_file: None,
            placements: Vec::new(),
        };
        let usage = Usage { cpu_ns: 250_000_000, rss_bytes: 3 << 20, steal_ticks: 1 };
        Kpis::new("tautline", "test", &job, &load, &records, &usage)
    }

    #[test]
    fn what_callbacks_wrote_becomes_indicators() {
        let kpis = kpis(&[2_000_000, 4_000_000, 9_000_000]);
        assert_eq!((kpis.dropped_in_transforms, kpis.dropped), (2, 5));
        assert_eq!((kpis.front_lidar_samples, kpis.front_lidar_without_estimate), (10, 7));
        assert_eq!((kpis.hot_path_average_ms, kpis.hot_path_p99_ms, kpis.hot_path_worst_ms), (5.0, 9.0, 9.0));
        assert_eq!((kpis.cpu_percent, kpis.rss_mib), (25.0, 3.0));
    }

    #[test]
    fn rounds_are_pooled() {
        let pooled = Kpis::pooled(&[kpis(&[2_000_000]), kpis(&[8_000_000, 2_000_000])]).unwrap();
        assert_eq!(
            (pooled.front_lidar_samples, pooled.front_lidar_without_estimate, pooled.dropped),
            (20, 17, 10)
        );
        assert_eq!((pooled.hot_path_average_ms, pooled.hot_path_worst_ms), (4.0, 8.0));
        assert_eq!((pooled.seconds, pooled.cpu_percent), (2.0, 25.0));
        assert_eq!(Kpis::pooled(&[]), None);
    }
}

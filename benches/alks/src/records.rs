// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the callbacks of a process write down: memory that is there before they start.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use hdrhistogram::Histogram;
use serde::{Deserialize, Serialize};
use tautline_rt::clock::monotonic_ns;

use crate::drive::Drive;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Span {
    /// The odometry chain, from the release of the IMU's callback to the end of the visualizer's.
    Chain,
    /// The adapter's callback of the IMU: a step of the simulation, nine topics.
    Imu,
    /// The adapter's callback of vehicles and lines, with the curve fit.
    Perception,
    Odometry,
    /// Any of the eleven callbacks of the ALKS node.
    Subscriber,
    /// The time that these waited for what they share with the timer.
    Waited,
    /// The subscribers' thread from its wake-up until nothing is ready: r2r's `run_until_stalled`.
    Stalled,
    /// The timer's calls that do not plan.
    Timer,
    /// Those that plan.
    Planning,
    ShowOdometry,
    /// The visualizer's timer that draws.
    Draw,
}

impl Span {
    /// All, in the order of reports, each with its name for people.
    const ALL: [(Span, &'static str); 11] = [
        (Span::Chain, "odometry chain, end to end"),
        (Span::Imu, "adapter: IMU callback"),
        (Span::Perception, "adapter: vehicles and lines"),
        (Span::Odometry, "ALKS: odometry callback"),
        (Span::Subscriber, "ALKS: all subscribers"),
        (Span::Waited, "ALKS: of that waiting for the timer"),
        (Span::Stalled, "ALKS: run_until_stalled"),
        (Span::Timer, "ALKS: timer without planning"),
        (Span::Planning, "ALKS: timer with planning"),
        (Span::ShowOdometry, "visualizer: odometry callback"),
        (Span::Draw, "visualizer: markers"),
    ];
}

/// For times of one kind, up to a minute, to three digits.
fn histogram() -> Histogram<u64> {
    Histogram::new_with_bounds(1, 60_000_000_000, 3).expect("bounds that it can have")
}

/// What a process has to tell. Each span is one thread's at a time: its lock is free.
#[derive(Debug)]
pub struct Records {
    begin_ns: u64,
    times: Vec<Mutex<Histogram<u64>>>,
    sent: Vec<AtomicU64>,
    received: Vec<AtomicU64>,
    /// As the subscription counts.
    lost: Vec<OnceLock<AtomicU64>>,
}

/// The topics, by whose numbers messages are counted.
pub const TOPICS: [&str; 15] = [
    "/flexray/speed",
    "/flexray/steering_wheel_angle",
    "/flexray/gps",
    "/flexray/odometry",
    "/flexray/imu",
    "/flexray/wheel_speeds",
    "/flexray/pedals",
    "/flexray/status",
    "/flexray/driver",
    "/flexray/vehicles",
    "/flexray/lines",
    "/alks/odometry",
    "/alks/command",
    "/alks/trajectory",
    "/alks/state",
];

impl Records {
    /// Times from `begin_ns` on count, on `CLOCK_MONOTONIC`; messages always do.
    pub fn new(begin_ns: u64) -> Records {
        let times = Span::ALL.iter().map(|_| Mutex::new(histogram())).collect();
        let zeroes = || TOPICS.iter().map(|_| AtomicU64::new(0)).collect();
        let lost = TOPICS.iter().map(|_| OnceLock::new()).collect();
        Records { begin_ns, times, sent: zeroes(), received: zeroes(), lost }
    }

    /// A time that ended at `now_ns`.
    ///
    /// # Real-time
    /// O(1), no allocation.
    pub fn note(&self, span: Span, now_ns: u64, ns: u64) {
        if now_ns >= self.begin_ns
            && let Some(times) = self.times.get(span as usize)
        {
            times.lock().unwrap_or_else(PoisonError::into_inner).saturating_record(ns);
        }
    }

    pub fn timed<R>(&self, span: Span, work: impl FnOnce() -> R) -> R {
        let begin_ns = monotonic_ns();
        let result = work();
        let end_ns = monotonic_ns();
        self.note(span, end_ns, end_ns.saturating_sub(begin_ns));
        result
    }

    /// A message of topic number `topic` was published.
    pub fn sent(&self, topic: usize) {
        self.sent[topic].fetch_add(1, Ordering::Relaxed);
    }

    /// A message of topic number `topic` came; its subscription has lost so many until now, if it counts them.
    pub fn received(&self, topic: usize, lost: Option<u64>) {
        self.received[topic].fetch_add(1, Ordering::Relaxed);
        if let Some(lost) = lost {
            self.lost[topic].get_or_init(AtomicU64::default).store(lost, Ordering::Relaxed);
        }
    }

    pub fn part(&self, drive: Option<Drive>) -> Part {
        let counts = |of: &[AtomicU64]| of.iter().map(|count| count.load(Ordering::Relaxed)).collect();
        let times = Span::ALL.iter().zip(&self.times).filter_map(|((span, _), times)| {
            let times = times.lock().unwrap_or_else(PoisonError::into_inner);
            (!times.is_empty()).then(|| (*span, counts_of(&times)))
        });
        let lost = self.lost.iter().map(|lost| lost.get().map(|count| count.load(Ordering::Relaxed)));
        let (times, lost) = (times.collect(), lost.collect());
        Part { times, sent: counts(&self.sent), received: counts(&self.received), lost, drive }
    }
}

/// What one process tells the one that started it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Part {
    /// Of each span the values in ns with their counts, ascending.
    times: Vec<(Span, Vec<(u64, u64)>)>,
    sent: Vec<u64>,
    received: Vec<u64>,
    lost: Vec<Option<u64>>,
    pub drive: Option<Drive>,
}

fn counts_of(times: &Histogram<u64>) -> Vec<(u64, u64)> {
    times.iter_recorded().map(|value| (value.value_iterated_to(), value.count_at_value())).collect()
}

/// Times of one span: in ms.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    pub span: Span,
    pub name: String,
    pub n: u64,
    pub p50_ms: f64,
    pub p99_ms: f64,
    pub p999_ms: f64,
    pub max_ms: f64,
    /// Values in ns with their counts, ascending.
    pub values: Vec<(u64, u64)>,
}

impl Summary {
    /// Share of the times below `limit`, 0 to 1.
    pub fn share_below(&self, limit: Duration) -> f64 {
        let below = self.values.iter().filter(|(ns, _)| u128::from(*ns) < limit.as_nanos());
        below.map(|(_, count)| count).sum::<u64>() as f64 / self.n.max(1) as f64
    }
}

/// Summaries of all that several processes, or several runs, have told.
pub fn summaries<'p>(parts: impl Iterator<Item = &'p Part> + Clone) -> Vec<Summary> {
    let of_span = |(span, name): &(Span, &str)| {
        let mut all = histogram();
        for (_, values) in parts.clone().flat_map(|part| &part.times).filter(|(of, _)| of == span) {
            values.iter().for_each(|(value, count)| all.saturating_record_n(*value, *count));
        }
        let quantile_ms = |share: f64| all.value_at_quantile(share) as f64 / 1e6;
        (!all.is_empty()).then(|| Summary {
            span: *span,
            name: (*name).to_owned(),
            n: all.len(),
            p50_ms: quantile_ms(0.5),
            p99_ms: quantile_ms(0.99),
            p999_ms: quantile_ms(0.999),
            max_ms: all.max() as f64 / 1e6,
            values: counts_of(&all),
        })
    };
    Span::ALL.iter().filter_map(of_span).collect()
}

/// Messages that were published to a topic and did not come to one who subscribes to it: of each topic that lost some, and how many of how
/// many. As the subscription counts; if it does not, what was published and did not come, which contains what was published before it began
/// and after it ended.
pub fn losses(parts: &[Part]) -> Vec<(String, u64, u64)> {
    let of_topic = |(index, topic): (usize, &&str)| {
        let sent: u64 = parts.iter().filter_map(|part| part.sent.get(index)).sum();
        let of_part = |part: &Part| {
            let count = *part.received.get(index).filter(|count| **count > 0)?;
            Some(part.lost.get(index).copied().flatten().unwrap_or(sent.saturating_sub(count)))
        };
        let lost = parts.iter().filter_map(of_part).max().unwrap_or(0);
        (lost > 0).then(|| ((*topic).to_owned(), lost, sent))
    };
    TOPICS.iter().enumerate().filter_map(of_topic).collect()
}

pub fn published(parts: &[Part]) -> u64 {
    parts.iter().flat_map(|part| &part.sent).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_all_parts_and_what_came_before_the_begin_is_none() {
        let part = |values: std::ops::RangeInclusive<u64>| {
            let records = Records::new(1_000);
            records.note(Span::Chain, 999, 5);
            values.for_each(|value| records.note(Span::Chain, 1_000, value * 1_000_000));
            records.part(None)
        };
        let parts = [part(1..=50), part(51..=100)];
        let [all] = summaries(parts.iter()).try_into().unwrap();
        assert_eq!((all.span, all.n), (Span::Chain, 100));
        for (quantile, expected) in [(all.p50_ms, 50.0), (all.p99_ms, 99.0), (all.max_ms, 100.0)] {
            assert!((quantile / expected - 1.0).abs() < 2e-3, "{quantile} for {expected}");
        }
        assert!((all.share_below(Duration::from_millis(31)) - 0.3).abs() < 0.011);
    }

    #[test]
    fn what_is_sent_and_does_not_come_is_lost() {
        let (sender, reader, other) = (Records::new(0), Records::new(0), Records::new(0));
        (0..10).for_each(|_| sender.sent(3));
        (0..10).for_each(|_| reader.received(3, None));
        assert_eq!(losses(&[sender.part(None), reader.part(None), other.part(None)]), []);
        (0..8).for_each(|_| other.received(3, None));
        let parts = [sender.part(None), reader.part(None), other.part(None)];
        assert_eq!(losses(&parts), [("/flexray/odometry".to_owned(), 2, 10)]);
        // One that came later and left earlier, and one that was overrun.
        let [late, slow] = [0, 5].map(|lost| {
            let reader = Records::new(0);
            (0..4).for_each(|_| reader.received(3, Some(lost)));
            reader.part(None)
        });
        assert_eq!(losses(&[sender.part(None), late.clone()]), []);
        assert_eq!(losses(&[sender.part(None), late, slow]), [("/flexray/odometry".to_owned(), 5, 10)]);
        assert_eq!(published(&parts), 10);
    }
}

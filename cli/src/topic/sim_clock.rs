// SPDX-License-Identifier: MIT OR Apache-2.0
//! Simulated time: what `/clock` shows, and how fast it runs.

use super::tap::{Tap, ends};
use crate::verb::{End, Outcome};
use std::collections::VecDeque;
use std::time::{Duration, Instant};
use tautline_transport::{EndpointKind, RawSample, Visitor};

const TOPIC: &str = "/clock";
const TYPE: &str = "rosgraph_msgs/msg/Clock";
/// The interval at which a publisher of `/clock` is looked for.
const LOOK: Duration = Duration::from_millis(100);
/// Readings are kept for this time, of which the first half suffices for a rate.
const KEPT_NS: u64 = 2_000_000_000;
/// The maximum number of readings: `/clock` at 2 kHz.
const MAX_READINGS: usize = 4000;
/// A rate or a time that differs by more than this is not the system's.
const MAX_RATE_ERROR: f64 = 0.05;
const MAX_OFFSET_S: f64 = 1.0;

/// `/clock`, as an observer takes it.
pub struct SimClock {
    domain: u32,
    visitor: Visitor,
    tap: Option<Tap>,
    looked: Option<Instant>,
    readings: Readings,
    is_reported: bool,
}

/// The last messages of `/clock`.
#[derive(Default)]
struct Readings(VecDeque<Reading>);

/// A message of `/clock`, and the times of its publication.
#[derive(Clone, Copy, Debug)]
struct Reading {
    sim_ns: u64,
    monotonic_ns: u64,
    wall_ns: u64,
}

impl Reading {
    /// The reading of a message; `None` if it contains no valid time.
    fn new(sample: &RawSample) -> Option<Self> {
        let body = sample.body();
        let sec = i32::from_le_bytes(body.get(..4)?.try_into().ok()?);
        let nanosec = u32::from_le_bytes(body.get(4..8)?.try_into().ok()?);
        let info = sample.info();
        Some(Reading {
            sim_ns: u64::try_from(sec).ok()? * 1_000_000_000 + u64::from(nanosec),
            monotonic_ns: info.released_ns,
            wall_ns: u64::try_from(info.source_timestamp_ns).ok()?,
        })
    }
}

impl SimClock {
    pub fn new(domain: u32) -> Outcome<Self> {
        let visitor = Visitor::new(domain)?;
        Ok(SimClock {
            domain,
            visitor,
            tap: None,
            looked: None,
            readings: Readings::default(),
            is_reported: false,
        })
    }

    /// Waits for the first message.
    pub fn wait(&mut self, end: &End) -> Outcome {
        end.wait(
            || format!("a message on '{TOPIC}'"),
            || {
                self.poll()?;
                Ok((!self.readings.0.is_empty()).then_some(()))
            },
        )
    }

    /// Takes the new messages. Returns whether the time jumped back.
    pub fn poll(&mut self) -> Outcome<bool> {
        if self.tap.is_none() && self.looked.is_none_or(|looked| looked.elapsed() >= LOOK) {
            self.looked = Some(Instant::now());
            let graph = self.visitor.graph()?;
            let publisher = ends(&graph, TOPIC)
                .find(|end| end.kind == EndpointKind::Publisher && end.topic_type.name == TYPE);
            if let Some(publisher) = publisher {
                self.tap = Some(Tap::open(self.domain, TOPIC, publisher.topic_type.clone())?);
            }
        }
        let Some(tap) = &mut self.tap else { return Ok(false) };
        let mut has_jumped = false;
        while let Some(sample) = tap.take()? {
            let Some(reading) = Reading::new(&sample) else { continue };
            has_jumped |= self.readings.push(reading);
        }
        Ok(has_jumped)
    }

    /// The time that `/clock` shows now; 0 before its first message.
    pub fn now_ns(&self) -> u64 {
        self.readings.0.back().map_or(0, |reading| reading.sim_ns)
    }

    /// The time that `/clock` showed at this time of `CLOCK_MONOTONIC`; `None` if that was before the first kept message.
    pub fn at_monotonic(&self, ns: u64) -> Option<u64> {
        self.readings.last_with(|reading| reading.monotonic_ns <= ns)
    }

    /// The time that `/clock` showed at this time of the system's clock.
    pub fn at_wall(&self, ns: u64) -> Option<u64> {
        self.readings.last_with(|reading| reading.wall_ns <= ns)
    }

    /// Prints once that `/clock` differs from the system's clock, by which the verb measures: in rate, or with `with_offset` also in time.
    pub fn warn(&mut self, with_offset: bool) {
        if self.is_reported {
            return;
        }
        if let Some(difference) = self.readings.difference(with_offset) {
            self.is_reported = true;
            eprintln!(
                "taut: {TOPIC} {difference}; these numbers are by the system's clock, --sim-time counts by {TOPIC}"
            );
        }
    }
}

impl Readings {
    /// Returns whether the time jumped back. Times from before a jump are dropped.
    fn push(&mut self, reading: Reading) -> bool {
        let has_jumped = self.0.back().is_some_and(|last| reading.sim_ns < last.sim_ns);
        if has_jumped {
            self.0.clear();
        }
        self.0.push_back(reading);
        let is_old = |first: &Reading| first.monotonic_ns + KEPT_NS < reading.monotonic_ns;
        while self.0.len() > MAX_READINGS || self.0.front().is_some_and(is_old) {
            self.0.pop_front();
        }
        has_jumped
    }

    fn last_with(&self, condition: impl Fn(&Reading) -> bool) -> Option<u64> {
        self.0.iter().rev().find(|reading| condition(reading)).map(|reading| reading.sim_ns)
    }

    fn difference(&self, with_offset: bool) -> Option<String> {
        let (first, last) = (self.0.front()?, self.0.back()?);
        let offset_s = (last.sim_ns as f64 - last.wall_ns as f64) / 1e9;
        if with_offset && offset_s.abs() > MAX_OFFSET_S {
            let side = if offset_s < 0.0 { "behind" } else { "ahead of" };
            return Some(format!("is {:.0} s {side} the system's clock", offset_s.abs()));
        }
        let span_ns = last.monotonic_ns.saturating_sub(first.monotonic_ns);
        let rate = (last.sim_ns - first.sim_ns) as f64 / span_ns as f64;
        let differs = span_ns >= KEPT_NS / 2 && (rate - 1.0).abs() > MAX_RATE_ERROR;
        differs.then(|| format!("runs {rate:.2} times as fast as the system's clock"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn readings(times: &[(u64, u64)]) -> Readings {
        let mut readings = Readings::default();
        for (ms, sim_ms) in times {
            let wall_ns = 1_700_000_000_000_000_000 + ms * 1_000_000;
            readings.push(Reading { sim_ns: sim_ms * 1_000_000, monotonic_ns: ms * 1_000_000, wall_ns });
        }
        readings
    }

    #[test]
    fn a_time_is_that_of_the_last_message_before_it() {
        let mut clock = readings(&[(100, 5), (200, 10), (300, 15)]);
        let at =
            |clock: &Readings, ms: u64| clock.last_with(|reading| reading.monotonic_ns <= ms * 1_000_000);
        let expected = [None, Some(5_000_000), Some(10_000_000), Some(15_000_000)];
        assert_eq!([99, 100, 299, 1000].map(|ms| at(&clock, ms)), expected);
        assert!(clock.push(Reading { sim_ns: 0, monotonic_ns: 400_000_000, wall_ns: 0 }), "a jump back");
        assert_eq!([399, 400].map(|ms| at(&clock, ms)), [None, Some(0)]);
    }

    #[test]
    fn a_rate_that_is_not_the_systems_is_named() {
        let fast = readings(&[(0, 0), (500, 1000), (1000, 2000)]);
        assert_eq!(fast.difference(false).unwrap(), "runs 2.00 times as fast as the system's clock");
        assert!(readings(&[(0, 0), (900, 1800)]).difference(false).is_none(), "too short to know");
        let same = readings(&[(0, 7), (1000, 1009)]);
        assert_eq!(same.difference(false), None);
        assert_eq!(same.difference(true).unwrap(), "is 1700000000 s behind the system's clock");
        assert_eq!(readings(&[]).difference(true), None);
    }
}

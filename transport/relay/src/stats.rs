// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics per topic and direction: counted by the carrying threads, read by others.

use hdrhistogram::Histogram;
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use tautline_rt::PiMutex;
use tautline_rt::clock::wall_ns;
use tautline_transport::Gid;

use crate::program::{counted, rate};

/// The last value that a thread set for readers of other priorities. Neither side copies or drops a value while the other one waits.
#[derive(Debug, Default)]
pub struct Latest<T>(PiMutex<Arc<T>>);

impl<T> Latest<T> {
    /// Starts with a value.
    pub fn new(value: T) -> Self {
        Latest(PiMutex::new(Arc::new(value)))
    }

    /// The value as it is now.
    pub fn get(&self) -> Arc<T> {
        self.0.lock().clone()
    }

    /// Replaces the value.
    pub fn set(&self, value: T) {
        let mut value = Arc::new(value);
        std::mem::swap(&mut *self.0.lock(), &mut value);
    }
}

/// Largest difference of time stamps that counts as a latency.
const CLOCKS_AGREE_NS: i64 = 10_000_000_000;

/// How long a topic or service that has ended stays in the statistics.
const ENDED_TIME: Duration = Duration::from_secs(60);

/// The counters of topics or services by key. Beyond `MOST` keys, those that have ended are forgotten.
#[derive(Debug)]
pub(crate) struct StatsTable<K, C, const MOST: usize>(BTreeMap<K, Counted<C>>);

#[derive(Debug, Default)]
struct Counted<C> {
    counters: Arc<C>,
    since_end: Duration,
}

impl<C> Counted<C> {
    fn is_used(&self) -> bool {
        Arc::strong_count(&self.counters) > 1
    }
}

impl<K, C, const MOST: usize> Default for StatsTable<K, C, MOST> {
    fn default() -> Self {
        StatsTable(BTreeMap::new())
    }
}

impl<K: Ord, C: Default, const MOST: usize> StatsTable<K, C, MOST> {
    /// The counters of a topic or service, new or existing. It is in use as long as the result is held.
    pub(crate) fn counters(&mut self, key: K) -> Arc<C> {
        if self.0.len() >= MOST {
            self.0.retain(|_, counted| counted.is_used());
        }
        self.0.entry(key).or_default().counters.clone()
    }

    /// Reads all counters with `read`, which is told whether they are in use, `elapsed` after the last call. A minute after its end a
    /// topic or service is forgotten.
    pub(crate) fn read<S>(&mut self, elapsed: Duration, read: impl Fn(&K, &C, bool) -> S) -> Vec<S> {
        self.0.retain(|_, counted| {
            let since_end = counted.since_end.saturating_add(elapsed);
            counted.since_end = if counted.is_used() { Duration::ZERO } else { since_end };
            counted.since_end < ENDED_TIME
        });
        self.0.iter().map(|(key, counted)| read(key, &counted.counters, counted.is_used())).collect()
    }
}

/// Maximum of topics, in each direction one.
const MOST_TOPICS: usize = 4096;

/// The counters of all topics, by name and direction.
pub(crate) type TopicStatsTable<N, D> = StatsTable<(N, D), TopicCounters, MOST_TOPICS>;

impl<N: Clone + Ord, D: Copy + Ord> TopicStatsTable<N, D> {
    /// The statistics of all topics, with rates over `elapsed`, the time since the last call.
    pub(crate) fn stats(&mut self, elapsed: Duration) -> Vec<TopicStats<N, D>> {
        self.read(elapsed, |(name, direction), counters, active| {
            let reading = counters.read(elapsed);
            TopicStats { name: name.clone(), direction: *direction, active, reading }
        })
    }
}

/// Counters of one topic in one direction, shared by carrying threads and a reader of lower priority.
#[derive(Debug)]
pub struct TopicCounters(PiMutex<Counts>);

#[derive(Debug)]
struct Counts {
    /// The counters, without rates and latency.
    reading: Reading,
    /// Messages and bytes at the last reading.
    before: (u64, u64),
    /// Latencies in microseconds, up to the 10 s of `CLOCKS_AGREE_NS`.
    latency_us: Histogram<u64>,
}

impl Default for TopicCounters {
    fn default() -> Self {
        // hdrhistogram accepts these constant bounds; `new` alone would grow without bound.
        let histogram = Histogram::new_with_bounds(1, (CLOCKS_AGREE_NS / 1000) as u64, 2);
        let latency_us = histogram.unwrap_or_else(|_| unreachable!("1 to 10^7 in 2 digits"));
        let (reading, before) = Default::default();
        TopicCounters(PiMutex::new(Counts { reading, before, latency_us }))
    }
}

impl TopicCounters {
    /// Counts a forwarded message with a body of `bytes`, published at `source_ns` since 1970.
    pub fn passed(&self, bytes: usize, source_ns: i64) {
        let latency_ns = wall_ns().saturating_sub(source_ns);
        let Counts { reading, latency_us, .. } = &mut *self.0.lock();
        reading.messages += 1;
        reading.bytes += bytes as u64;
        if (0..CLOCKS_AGREE_NS).contains(&latency_ns) {
            latency_us.saturating_record((latency_ns / 1000) as u64);
        } else {
            reading.clocks_differ += 1;
        }
    }

    /// Counts messages that were lost before they arrived at this program.
    pub fn lost(&self, messages: u64) {
        self.0.lock().reading.lost += messages;
    }

    /// Counts a dropped message. Use few, fixed reasons: errors without numbers or names.
    pub fn dropped(&self, reason: impl ToString) {
        *self.0.lock().reading.dropped.entry(reason.to_string()).or_default() += 1;
    }

    /// Reads the counters, with rates over `elapsed`, the time since the last call; without rates if that is zero.
    pub(crate) fn read(&self, elapsed: Duration) -> Reading {
        let Counts { reading, before, latency_us: latency } = &mut *self.0.lock();
        let (messages, bytes) = std::mem::replace(before, (reading.messages, reading.bytes));
        let latency_us = (!latency.is_empty()).then(|| Latency {
            p50: latency.value_at_quantile(0.5),
            p99: latency.value_at_quantile(0.99),
            max: latency.max(),
        });
        let seconds = elapsed.as_secs_f64();
        let rate = |counted: u64| if elapsed.is_zero() { 0.0 } else { counted as f64 / seconds };
        let messages_per_s = rate(reading.messages - messages);
        let bytes_per_s = rate(reading.bytes - bytes);
        Reading { latency_us, messages_per_s, bytes_per_s, ..reading.clone() }
    }
}

/// Tracks the sequence numbers of a topic's publishers: gaps are losses.
#[derive(Debug, Default)]
pub struct Numbers(HashMap<Gid, u64>);

impl Numbers {
    /// Maximum of publishers; beyond it, which a hostile peer can cause, all are forgotten.
    const MOST: usize = 1024;
    /// Gaps of at least this length are not counted, and the numbers after them are ignored.
    const LONGEST: u64 = 1 << 32;

    /// The number of this publisher's messages that are missing before `number`; `None` for a repeated number.
    pub fn missing(&mut self, gid: Gid, number: u64) -> Option<u64> {
        if self.0.len() >= Self::MOST && !self.0.contains_key(&gid) {
            self.0.clear();
        }
        let Some(last) = self.0.get_mut(&gid) else {
            self.0.insert(gid, number);
            return Some(0);
        };
        let missing = number.checked_sub(*last)?.checked_sub(1)?;
        if missing >= Self::LONGEST {
            return Some(0);
        }
        *last = number;
        Some(missing)
    }

    /// Forgets the publishers for which `gone` is true.
    pub fn forget(&mut self, gone: impl Fn(&Gid) -> bool) {
        self.0.retain(|gid, _| !gone(gid));
    }
}

/// Counters of a topic in one direction.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Reading {
    /// Forwarded messages.
    pub messages: u64,
    /// Bytes of their bodies.
    pub bytes: u64,
    /// Messages per second, in the last second.
    pub messages_per_s: f64,
    /// Bytes per second, in the last second.
    pub bytes_per_s: f64,
    /// Messages lost before they arrived at this program: gaps in sequence numbers, or overwritten in a queue.
    pub lost: u64,
    /// Messages that this program dropped, by reason.
    pub dropped: BTreeMap<String, u64>,
    /// Time from the publisher's time stamp to forwarding, if the clocks agree. `None`: they do not, or there was no message.
    pub latency_us: Option<Latency>,
    /// Messages with a time stamp in the future or over 10 s old: the clocks differ, or they were kept for late joiners.
    pub clocks_differ: u64,
}

/// Latencies since the program started, in microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Latency {
    /// Median.
    pub p50: u64,
    /// 99th percentile.
    pub p99: u64,
    /// Maximum.
    pub max: u64,
}

/// A topic in one direction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TopicStats<N, D> {
    /// Its names.
    #[serde(flatten)]
    pub name: N,
    /// Its direction.
    pub direction: D,
    /// Whether messages are forwarded now.
    pub active: bool,
    /// Its counters.
    #[serde(flatten)]
    pub reading: Reading,
}

impl<N, D> TopicStats<N, D> {
    /// Converts names and directions.
    pub fn named<M, E>(self, name: impl Fn(N) -> M, direction: impl Fn(D) -> E) -> TopicStats<M, E> {
        let TopicStats { name: named, direction: way, active, reading } = self;
        TopicStats { name: name(named), direction: direction(way), active, reading }
    }
}

/// `out 4 topics 1.2 MB/s 100/s | in 1 topic 80 kB/s 10/s | lost 0, dropped 0`; `ways` has the names of the directions.
pub fn passing<N, D: Copy + PartialEq>(
    topics: &[TopicStats<N, D>],
    ways: [(D, &str); 2],
) -> impl fmt::Display {
    let mut text = String::new();
    for (direction, name) in ways {
        let of = || topics.iter().filter(move |topic| topic.active && topic.direction == direction);
        // Not `Iterator::sum`, which begins with -0.
        let sum = |of_topic: fn(&Reading) -> f64| of().fold(0.0, |sum, topic| sum + of_topic(&topic.reading));
        let (bytes, messages) = (sum(|reading| reading.bytes_per_s), sum(|reading| reading.messages_per_s));
        text += &format!(
            "{name} {} {} {messages:.0}/s | ",
            counted(of().count(), "topic", "topics"),
            rate(bytes)
        );
    }
    let lost: u64 = topics.iter().map(|topic| topic.reading.lost).sum();
    let dropped: u64 = topics.iter().flat_map(|topic| topic.reading.dropped.values()).sum();
    text + &format!("lost {lost}, dropped {dropped}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_keeps_the_value_that_it_got() {
        let latest = Latest::new(1);
        let read = latest.get();
        latest.set(2);
        assert_eq!((*read, *latest.get()), (1, 2));
    }

    #[test]
    fn gaps_are_losses_and_nonsense_is_none() {
        let mut numbers = Numbers::default();
        let (a, b) = (Gid([1; 16]), Gid([2; 16]));
        let all =
            [(a, 1), (a, 2), (b, 100), (a, 5), (b, 101), (a, 5), (a, 4), (a, 6), (b, u64::MAX), (b, 102)];
        let missing = all.map(|(gid, number)| numbers.missing(gid, number));
        let expected = [0, 0, 0, 2, 0, 9, 9, 0, 0, 0].map(|missing| Some(missing).filter(|n| *n != 9));
        assert_eq!(missing, expected, "9: repeated");
        numbers.forget(|gid| *gid == a);
        assert_eq!(numbers.missing(a, 100), Some(0));
        for n in 0..10_000u32 {
            let mut gid = Gid::default();
            gid.0[..4].copy_from_slice(&n.to_le_bytes());
            numbers.missing(gid, 1);
        }
        assert!(numbers.0.len() <= Numbers::MOST);
    }

    #[test]
    fn latency_where_clocks_allow() {
        let counters = TopicCounters::default();
        let now = wall_ns();
        for source in [now + 3_600_000_000_000, 0, i64::MIN, i64::MAX] {
            counters.passed(10, source);
        }
        let reading = counters.read(Duration::ZERO);
        assert_eq!((reading.messages, reading.bytes, reading.clocks_differ), (4, 40, 4));
        assert_eq!(reading.latency_us, None);
        counters.passed(10, now - 1_000_000_000);
        let latency = counters.read(Duration::ZERO).latency_us.unwrap();
        assert!(latency.max >= 1_000_000 && latency.p50 >= 990_000, "{latency:?}");
    }

    #[test]
    fn rates_the_line_and_json() {
        let mut stats = TopicStatsTable::default();
        let counters = stats.counters(("/x", "in"));
        counters.passed(100, 0);
        stats.stats(Duration::ZERO);
        counters.passed(100, 0);
        counters.passed(100, 0);
        counters.lost(2);
        counters.dropped("rate limit");
        let after = stats.stats(Duration::from_millis(500));
        let reading = &after[0].reading;
        assert_eq!((reading.messages, reading.messages_per_s, reading.bytes_per_s), (3, 4.0, 400.0));
        let line = passing(&after, [("out", "to ROS"), ("in", "from ROS")]).to_string();
        assert_eq!(line, "to ROS 0 topics 0 B/s 0/s | from ROS 1 topic 400 B/s 4/s | lost 2, dropped 1");
        let json = serde_json::to_value(TopicStats {
            name: BTreeMap::from([("topic", "/x")]),
            direction: "in",
            active: true,
            reading: reading.clone(),
        })
        .unwrap();
        assert_eq!(
            (&json["topic"], &json["dropped"]["rate limit"], &json["messages"]),
            (&"/x".into(), &1.into(), &3.into())
        );
    }

    #[test]
    fn of_too_many_topics_those_that_go_on_are_counted() {
        let mut stats = TopicStatsTable::default();
        let goes_on = stats.counters((7, ()));
        (0..=MOST_TOPICS).for_each(|topic| drop(stats.counters((topic, ()))));
        let left: Vec<_> =
            stats.stats(Duration::ZERO).into_iter().map(|topic| (topic.name, topic.active)).collect();
        assert_eq!(left, [(7, true), (MOST_TOPICS, false)]);
        drop(goes_on);
    }

    #[test]
    fn a_topic_that_has_ended_goes_after_a_while() {
        let mut stats = TopicStatsTable::default();
        let (ends, goes_on) = (stats.counters(("/ends", ())), stats.counters(("/goes_on", ())));
        let mut left = |elapsed| -> Vec<_> {
            stats.stats(elapsed).into_iter().map(|topic| (topic.name, topic.active)).collect()
        };
        assert_eq!(left(ENDED_TIME), [("/ends", true), ("/goes_on", true)]);
        drop(ends);
        assert_eq!(left(ENDED_TIME / 2), [("/ends", false), ("/goes_on", true)]);
        assert_eq!(left(ENDED_TIME / 2), [("/goes_on", true)]);
        drop(goes_on);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What passed and what did not, per topic and direction: counted where it happens, read by whoever asks.

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

/// Longest difference between two clocks for which the time between them is called a latency.
const CLOCKS_AGREE_NS: i64 = 10_000_000_000;

/// Counters of one topic in one direction. Carrying threads share them with one of a lower priority, which reads.
#[derive(Debug)]
pub struct TopicCounters(PiMutex<Counts>);

#[derive(Debug)]
struct Counts {
    /// Without rates and latency.
    reading: Reading,
    /// Microseconds, up to the ten seconds for which clocks agree.
    latency_us: Histogram<u64>,
}

impl Default for TopicCounters {
    fn default() -> Self {
        // The bounds are constants that hdrhistogram accepts; `new` alone would grow without a bound.
        let histogram = Histogram::new_with_bounds(1, (CLOCKS_AGREE_NS / 1000) as u64, 2);
        let latency_us = histogram.unwrap_or_else(|_| unreachable!("1 to 10^7 in 2 digits"));
        TopicCounters(PiMutex::new(Counts { reading: Reading::default(), latency_us }))
    }
}

impl TopicCounters {
    /// A message with a body of `bytes` went through, which was published at `source_ns` since 1970.
    pub fn passed(&self, bytes: usize, source_ns: i64) {
        let latency_ns = wall_ns().saturating_sub(source_ns);
        let Counts { reading, latency_us } = &mut *self.0.lock();
        reading.messages += 1;
        reading.bytes += bytes as u64;
        if (0..CLOCKS_AGREE_NS).contains(&latency_ns) {
            latency_us.saturating_record((latency_ns / 1000) as u64);
        } else {
            reading.clocks_differ += 1;
        }
    }

    /// Messages were lost before they came this far.
    pub fn lost(&self, messages: u64) {
        self.0.lock().reading.lost += messages;
    }

    /// A message did not go through. Reasons are few and fixed: errors without numbers or names in them.
    pub fn dropped(&self, reason: impl ToString) {
        *self.0.lock().reading.dropped.entry(reason.to_string()).or_default() += 1;
    }

    /// What they say now; rates are left to who knows what they said before.
    pub(crate) fn read(&self) -> Reading {
        let Counts { reading, latency_us: latency } = &*self.0.lock();
        let latency_us = (!latency.is_empty()).then(|| Latency {
            p50: latency.value_at_quantile(0.5),
            p99: latency.value_at_quantile(0.99),
            max: latency.max(),
        });
        Reading { latency_us, ..reading.clone() }
    }
}

/// Follows the numbers of a topic's publishers: a gap is what was lost on the way.
#[derive(Debug, Default)]
pub struct Numbers(HashMap<Gid, u64>);

impl Numbers {
    /// Publishers whose numbers are followed; of more, which a hostile peer can claim to be there, all are forgotten.
    const MOST: usize = 1024;
    /// Longer gaps are none, and such numbers are not followed: they can be anything.
    const LONGEST: u64 = 1 << 32;

    /// How many of this publisher's messages are missing before this one; `None` if it was there before.
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

    /// Publishers have gone.
    pub fn forget(&mut self, gone: impl Fn(&Gid) -> bool) {
        self.0.retain(|gid, _| !gone(gid));
    }
}

/// What passed and what did not.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Reading {
    /// Messages that went through.
    pub messages: u64,
    /// Their bodies.
    pub bytes: u64,
    /// In the second before.
    pub messages_per_s: f64,
    /// In the second before.
    pub bytes_per_s: f64,
    /// Messages that were lost before they came this far: gaps in the publishers' numbers, or overwritten in a queue.
    pub lost: u64,
    /// Messages that came and were dropped here, by reason.
    pub dropped: BTreeMap<String, u64>,
    /// From the publisher's clock to this host's: what the way so far took, if the clocks agree. `None`: they do not, or nothing came.
    pub latency_us: Option<Latency>,
    /// Messages whose time stamp is in the future, or more than 10 s old: the clocks differ, or they were kept for late joiners.
    pub clocks_differ: u64,
}

/// Microseconds since the program started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Latency {
    /// Half took less.
    pub p50: u64,
    /// 1 of 100 took more.
    pub p99: u64,
    /// The longest.
    pub max: u64,
}

/// A topic in one direction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TopicStats<N, D> {
    /// Which topic.
    #[serde(flatten)]
    pub name: N,
    /// Which way.
    pub direction: D,
    /// Whether messages are passed on now.
    pub active: bool,
    /// The numbers.
    #[serde(flatten)]
    pub reading: Reading,
}

impl<N, D> TopicStats<N, D> {
    /// In other words.
    pub fn named<M, E>(self, name: impl Fn(N) -> M, direction: impl Fn(D) -> E) -> TopicStats<M, E> {
        let TopicStats { name: named, direction: way, active, reading } = self;
        TopicStats { name: name(named), direction: direction(way), active, reading }
    }
}

/// The counters of all topics, by what they are called and which way they go.
#[derive(Debug)]
pub struct TopicStatsTable<N, D>(BTreeMap<(N, D), Counted>);

#[derive(Debug, Default)]
struct Counted {
    counters: Arc<TopicCounters>,
    /// Messages and bytes when they were read last.
    before: (u64, u64),
}

impl<N, D> Default for TopicStatsTable<N, D> {
    fn default() -> Self {
        TopicStatsTable(BTreeMap::new())
    }
}

impl<N: Clone + Ord, D: Copy + Ord> TopicStatsTable<N, D> {
    /// Topics that are counted; of more, those that are not passed on any more are forgotten.
    const MOST: usize = 4096;

    /// Those of a topic, from now on or as they were: it is passed on as long as somebody has them.
    pub fn counters(&mut self, name: N, direction: D) -> Arc<TopicCounters> {
        if self.0.len() >= Self::MOST {
            self.0.retain(|_, counted| counted.is_active());
        }
        self.0.entry((name, direction)).or_default().counters.clone()
    }

    /// What all of them say, with rates since the last time, which is so long ago.
    pub fn read(&mut self, elapsed: Duration) -> Vec<TopicStats<N, D>> {
        let read = |((name, direction), counted): (&(N, D), &mut Counted)| {
            let mut reading = counted.counters.read();
            let (messages, bytes) = std::mem::replace(&mut counted.before, (reading.messages, reading.bytes));
            if !elapsed.is_zero() {
                let seconds = elapsed.as_secs_f64();
                reading.messages_per_s = (reading.messages - messages) as f64 / seconds;
                reading.bytes_per_s = (reading.bytes - bytes) as f64 / seconds;
            }
            TopicStats { name: name.clone(), direction: *direction, active: counted.is_active(), reading }
        };
        self.0.iter_mut().map(read).collect()
    }
}

impl Counted {
    fn is_active(&self) -> bool {
        Arc::strong_count(&self.counters) > 1
    }
}

/// `out 4 topics 1.2 MB/s 100/s | in 1 topic 80 kB/s 10/s | lost 0, dropped 0`, by what the directions are called.
pub fn passing<N, D: Copy + PartialEq>(
    topics: &[TopicStats<N, D>],
    ways: [(D, &str); 2],
) -> impl fmt::Display {
    let mut text = String::new();
    for (direction, name) in ways {
        let of = || topics.iter().filter(move |topic| topic.active && topic.direction == direction);
        // Not `sum`, which begins with -0.
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
    fn gaps_are_losses_and_nonsense_is_none() {
        let mut numbers = Numbers::default();
        let (a, b) = (Gid([1; 16]), Gid([2; 16]));
        let all =
            [(a, 1), (a, 2), (b, 100), (a, 5), (b, 101), (a, 5), (a, 4), (a, 6), (b, u64::MAX), (b, 102)];
        let missing = all.map(|(gid, number)| numbers.missing(gid, number));
        let expected = [0, 0, 0, 2, 0, 9, 9, 0, 0, 0].map(|missing| Some(missing).filter(|n| *n != 9));
        assert_eq!(missing, expected, "9: it was there before");
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
        let reading = counters.read();
        assert_eq!((reading.messages, reading.bytes, reading.clocks_differ), (4, 40, 4));
        assert_eq!(reading.latency_us, None);
        counters.passed(10, now - 1_000_000_000);
        let latency = counters.read().latency_us.unwrap();
        assert!(latency.max >= 1_000_000 && latency.p50 >= 990_000, "{latency:?}");
    }

    #[test]
    fn rates_the_line_and_json() {
        let mut stats = TopicStatsTable::default();
        let counters = stats.counters("/x", "in");
        counters.passed(100, 0);
        stats.read(Duration::ZERO);
        counters.passed(100, 0);
        counters.passed(100, 0);
        counters.lost(2);
        counters.dropped("rate limit");
        let after = stats.read(Duration::from_millis(500));
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
        let goes_on = stats.counters(7, ());
        (0..=TopicStatsTable::<usize, ()>::MOST).for_each(|topic| drop(stats.counters(topic, ())));
        let left: Vec<_> =
            stats.read(Duration::ZERO).into_iter().map(|topic| (topic.name, topic.active)).collect();
        assert_eq!(left, [(7, true), (TopicStatsTable::<usize, ()>::MOST, false)]);
        drop(goes_on);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What went through the gateway and what did not, per topic: counted where it happens, read by whoever asks.

use crate::graph::Refused;
use hdrhistogram::Histogram;
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};
use tautline_transport::Gid;

/// Which way samples go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// From shared memory to the network.
    Out,
    /// From the network to shared memory.
    In,
}

/// Longest difference between two hosts' clocks for which the time between them is called a latency.
const CLOCKS_AGREE_NS: i64 = 10_000_000_000;
/// Publishers per topic whose sequence numbers are followed.
const MAX_FOLLOWED: usize = 256;

/// Counters of one topic in one direction.
#[derive(Debug)]
pub(crate) struct Counters {
    samples: AtomicU64,
    bytes: AtomicU64,
    lost: AtomicU64,
    skewed: AtomicU64,
    slow: Mutex<Slow>,
}

#[derive(Debug)]
struct Slow {
    dropped: BTreeMap<String, u64>,
    /// Microseconds, up to the ten seconds for which clocks agree.
    latency_us: Histogram<u64>,
    last_numbers: HashMap<Gid, i64>,
}

impl Counters {
    pub(crate) fn new() -> Self {
        // The bounds are constants that hdrhistogram accepts; `new` alone would grow without a bound.
        let histogram = Histogram::new_with_bounds(1, (CLOCKS_AGREE_NS / 1000) as u64, 2);
        let latency_us = histogram.unwrap_or_else(|_| unreachable!("1 to 10^7 in 2 digits"));
        let slow = Slow { dropped: BTreeMap::new(), latency_us, last_numbers: HashMap::new() };
        let zero = AtomicU64::default;
        Counters { samples: zero(), bytes: zero(), lost: zero(), skewed: zero(), slow: Mutex::new(slow) }
    }

    fn slow(&self) -> std::sync::MutexGuard<'_, Slow> {
        self.slow.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A sample of `bytes` went through, which was published at `source_ns` since 1970.
    pub(crate) fn passed(&self, bytes: usize, source_ns: i64) {
        self.samples.fetch_add(1, Ordering::Relaxed);
        self.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
        let latency_ns = unix_ns().saturating_sub(source_ns);
        if (0..CLOCKS_AGREE_NS).contains(&latency_ns) {
            self.slow().latency_us.saturating_record((latency_ns / 1000) as u64);
        } else {
            self.skewed.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Follows a publisher's numbers; a gap is what was lost on the way.
    pub(crate) fn follow(&self, gid: Gid, number: i64) {
        let mut slow = self.slow();
        if slow.last_numbers.len() >= MAX_FOLLOWED && !slow.last_numbers.contains_key(&gid) {
            // A hostile peer can write any gid: forget all rather than grow.
            slow.last_numbers.clear();
        }
        let last = slow.last_numbers.insert(gid, number);
        if let Some(missing) =
            last.and_then(|last| number.checked_sub(last)?.checked_sub(1)).filter(|n| *n > 0)
        {
            // A number can be anything; what is no plausible gap is none.
            if missing < 1 << 32 {
                self.lost.fetch_add(missing as u64, Ordering::Relaxed);
            }
        }
    }

    /// Samples were lost before they reached the gateway.
    pub(crate) fn lost(&self, samples: u64) {
        self.lost.fetch_add(samples, Ordering::Relaxed);
    }

    /// A sample did not go through. Reasons are few and fixed: errors without numbers or names in them.
    pub(crate) fn dropped(&self, reason: impl ToString) {
        *self.slow().dropped.entry(reason.to_string()).or_default() += 1;
    }

    /// What they say, with rates since `before`.
    pub(crate) fn read(&self, before: Option<(&TopicStats, Duration)>) -> Reading {
        let (samples, bytes) = (self.samples.load(Ordering::Relaxed), self.bytes.load(Ordering::Relaxed));
        let rate = |now: u64, then: fn(&TopicStats) -> u64| match before {
            Some((before, elapsed)) if !elapsed.is_zero() => {
                now.saturating_sub(then(before)) as f64 / elapsed.as_secs_f64()
            }
            _ => 0.0,
        };
        let slow = self.slow();
        let latency = &slow.latency_us;
        Reading {
            samples,
            bytes,
            samples_per_s: rate(samples, |before| before.reading.samples),
            bytes_per_s: rate(bytes, |before| before.reading.bytes),
            lost: self.lost.load(Ordering::Relaxed),
            dropped: slow.dropped.clone(),
            latency_us: (!latency.is_empty()).then(|| Latency {
                p50: latency.value_at_quantile(0.5),
                p99: latency.value_at_quantile(0.99),
                max: latency.max(),
            }),
            clocks_differ: self.skewed.load(Ordering::Relaxed),
        }
    }
}

/// Nanoseconds since 1970; 0 before that.
pub(crate) fn unix_ns() -> i64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}

/// What passed and what did not.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reading {
    /// Samples that went through.
    pub samples: u64,
    /// Their bodies.
    pub bytes: u64,
    /// Rate since the reading before.
    pub samples_per_s: f64,
    /// Rate since the reading before.
    pub bytes_per_s: f64,
    /// Gaps in the publishers' sequence numbers.
    pub lost: u64,
    /// Samples that came and were dropped here, by reason.
    pub dropped: BTreeMap<String, u64>,
    /// From the publisher's clock to this host's: what the way took, if the clocks agree. `None`: they do not, or nothing
    /// came.
    pub latency_us: Option<Latency>,
    /// Samples whose time stamp is in the future, or more than 10 s old: the clocks differ, or they were kept for late
    /// joiners.
    pub clocks_differ: u64,
}

/// Microseconds since the gateway started.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Latency {
    /// Half took less.
    pub p50: u64,
    /// 1 of 100 took more.
    pub p99: u64,
    /// The longest.
    pub max: u64,
}

/// One topic in one direction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TopicStats {
    /// The topic.
    pub topic: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Which way.
    pub direction: Direction,
    /// Whether it is mirrored now.
    pub active: bool,
    /// The numbers.
    #[serde(flatten)]
    pub reading: Reading,
}

/// The gateway at one moment.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stats {
    /// The domain on this host.
    pub domain: u32,
    /// The domain on the network.
    pub network_domain: u32,
    /// Zenoh's id of the session.
    pub zid: String,
    /// Since it started.
    pub uptime_s: f64,
    /// Zenoh peers and routers that are linked to.
    pub links: usize,
    /// Nodes of other hosts.
    pub remote_nodes: usize,
    /// Publishers and subscriptions of other hosts.
    pub remote_endpoints: usize,
    /// Tokens refused: over the limit, or malformed by reason.
    pub refused_tokens: BTreeMap<String, u64>,
    /// Topics of this host that cannot be mirrored, and why.
    pub not_mirrored: BTreeMap<String, String>,
    /// What access control refused in this process, if [`access_layer`](crate::access_layer) is installed, such as
    /// `Put (ingress) on /secret`.
    pub unauthorized: BTreeMap<String, u64>,
    /// How often the processor budget of the network's threads was used up.
    pub throttled: u64,
    /// Every topic that is or was mirrored.
    pub topics: Vec<TopicStats>,
}

impl Stats {
    pub(crate) fn new(domain: u32, network_domain: u32, zid: String) -> Self {
        Stats {
            domain,
            network_domain,
            zid,
            uptime_s: 0.0,
            links: 0,
            remote_nodes: 0,
            remote_endpoints: 0,
            refused_tokens: BTreeMap::new(),
            not_mirrored: BTreeMap::new(),
            unauthorized: BTreeMap::new(),
            throttled: 0,
            topics: Vec::new(),
        }
    }
}

pub(crate) fn refused_by_reason(refused: &Refused) -> BTreeMap<String, u64> {
    let mut reasons: BTreeMap<_, _> =
        refused.malformed.iter().map(|(reason, count)| (reason.to_string(), *count)).collect();
    if refused.full > 0 {
        reasons.insert("over the limit".into(), refused.full);
    }
    reasons
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_losses_and_nonsense_is_none() {
        let counters = Counters::new();
        let (a, b) = (Gid([1; 16]), Gid([2; 16]));
        for (gid, number) in
            [(a, 1), (a, 2), (b, 100), (a, 5), (b, 101), (a, 5), (a, 4), (b, i64::MAX), (b, i64::MIN)]
        {
            counters.follow(gid, number);
        }
        assert_eq!(counters.read(None).lost, 2);
        for n in 0..10_000u32 {
            let mut gid = Gid::default();
            gid.0[..4].copy_from_slice(&n.to_le_bytes());
            counters.follow(gid, 1);
        }
        assert!(counters.slow().last_numbers.len() <= MAX_FOLLOWED);
    }

    #[test]
    fn latency_where_clocks_allow() {
        let counters = Counters::new();
        let now = unix_ns();
        for source in [now + 3_600_000_000_000, 0, i64::MIN, i64::MAX] {
            counters.passed(10, source);
        }
        let reading = counters.read(None);
        assert_eq!((reading.samples, reading.bytes, reading.clocks_differ), (4, 40, 4));
        assert_eq!(reading.latency_us, None);
        counters.passed(10, now - 1_000_000_000);
        let latency = counters.read(None).latency_us.unwrap();
        assert!(latency.max >= 1_000_000 && latency.p50 >= 990_000, "{latency:?}");
    }

    #[test]
    fn rates_and_json() {
        let counters = Counters::new();
        let topic = |reading| TopicStats {
            topic: "/x".into(),
            type_name: "a/msg/B".into(),
            direction: Direction::In,
            active: true,
            reading,
        };
        counters.passed(100, 0);
        let before = topic(counters.read(None));
        counters.passed(100, 0);
        counters.passed(100, 0);
        counters.dropped("malformed attachment");
        let after = topic(counters.read(Some((&before, Duration::from_millis(500)))));
        assert_eq!((after.reading.samples_per_s, after.reading.bytes_per_s), (4.0, 400.0));
        let json = serde_json::to_value(&after).unwrap();
        assert_eq!(json["direction"], "in");
        assert_eq!(json["dropped"]["malformed attachment"], 1);
        assert_eq!(json["samples"], 3);
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! What went through the bridge and what did not, per topic: counted where it happens, read by whoever asks.

use crate::mirror::TopicKey;
use crate::rules::Direction;
use crate::services::ServiceStats;
use serde::Serialize;
use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tautline_transport::Gid;

/// Counters of one topic in one direction.
#[derive(Debug, Default)]
pub(crate) struct Counters {
    messages: AtomicU64,
    bytes: AtomicU64,
    lost: AtomicU64,
    dropped: Mutex<BTreeMap<String, u64>>,
}

impl Counters {
    /// A message with a body of `bytes` went through.
    pub(crate) fn passed(&self, bytes: usize) {
        self.messages.fetch_add(1, Ordering::Relaxed);
        self.bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// Messages that did not reach the bridge.
    pub(crate) fn lost(&self, messages: u64) {
        self.lost.fetch_add(messages, Ordering::Relaxed);
    }

    /// A message did not go through. Reasons are few and fixed: errors without numbers or names in them.
    pub(crate) fn dropped(&self, reason: impl ToString) {
        let mut dropped = self.dropped.lock().unwrap_or_else(PoisonError::into_inner);
        *dropped.entry(reason.to_string()).or_default() += 1;
    }

    fn read(&self, before: Option<&TopicStats>, elapsed: Duration) -> TopicNumbers {
        let (messages, bytes) = (self.messages.load(Ordering::Relaxed), self.bytes.load(Ordering::Relaxed));
        let rate = |now: u64, then: Option<u64>| match then {
            Some(then) if !elapsed.is_zero() => now.saturating_sub(then) as f64 / elapsed.as_secs_f64(),
            _ => 0.0,
        };
        TopicNumbers {
            messages,
            bytes,
            messages_per_s: rate(messages, before.map(|before| before.numbers.messages)),
            bytes_per_s: rate(bytes, before.map(|before| before.numbers.bytes)),
            lost: self.lost.load(Ordering::Relaxed),
            dropped: self.dropped.lock().unwrap_or_else(PoisonError::into_inner).clone(),
        }
    }
}

/// Follows the numbers of a topic's publishers: a gap is what was lost on the way.
#[derive(Debug, Default)]
pub(crate) struct Numbers(HashMap<Gid, u64>);

impl Numbers {
    /// Publishers whose numbers are followed; of more, all are forgotten.
    const MOST: usize = 1024;

    /// How many of this publisher's messages are missing before this one; `None` if it was there before.
    pub(crate) fn missing(&mut self, gid: Gid, number: u64) -> Option<u64> {
        if self.0.len() >= Self::MOST && !self.0.contains_key(&gid) {
            self.0.clear();
        }
        let Some(last) = self.0.get_mut(&gid) else {
            self.0.insert(gid, number);
            return Some(0);
        };
        let missing = number.checked_sub(*last)?.checked_sub(1)?;
        *last = number;
        Some(missing)
    }

    /// The publisher has gone.
    pub(crate) fn forget(&mut self, gone: impl Fn(&Gid) -> bool) {
        self.0.retain(|gid, _| !gone(gid));
    }
}

/// What passed and what did not.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TopicNumbers {
    /// Messages that went through.
    pub messages: u64,
    /// Their bodies.
    pub bytes: u64,
    /// In the second before.
    pub messages_per_s: f64,
    /// In the second before.
    pub bytes_per_s: f64,
    /// Messages that were lost before they reached the bridge.
    pub lost: u64,
    /// Messages that the bridge did not pass on, by reason.
    pub dropped: BTreeMap<String, u64>,
}

/// A topic in one direction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TopicStats {
    /// Tautline's name of it.
    pub topic: String,
    /// ROS's name of it.
    pub ros_topic: String,
    /// What it carries.
    pub type_name: String,
    /// Which way.
    pub direction: Direction,
    /// Whether messages are passed on now.
    pub active: bool,
    /// The numbers.
    #[serde(flatten)]
    pub numbers: TopicNumbers,
}

/// Ends that do not fit a bridge's, as ROS counts them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct IncompatibleQos {
    /// How many.
    pub count: u64,
    /// Why the last one does not.
    pub last_policy: String,
}

/// The bridge at one moment.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Stats {
    /// Tautline's domain.
    pub domain: u32,
    /// ROS's domain.
    pub ros_domain: u32,
    /// The RMW, such as `rmw_fastrtps_cpp`.
    pub rmw: String,
    /// Since it started.
    pub uptime_s: f64,
    /// How often the processor budget of the bridge's threads was used up.
    pub throttled: u64,
    /// Nodes in ROS.
    pub ros_nodes: usize,
    /// Publishers and subscriptions in ROS, but for bridges'.
    pub ros_endpoints: usize,
    /// Topics that cannot be bridged, and why.
    pub not_bridged: BTreeMap<String, String>,
    /// Topics with ends in ROS whose QoS does not fit.
    pub incompatible_qos: BTreeMap<String, IncompatibleQos>,
    /// Every topic that is or was bridged.
    pub topics: Vec<TopicStats>,
    /// Services that cannot be bridged, and why.
    pub services_not_bridged: BTreeMap<String, String>,
    /// Every service that is or was bridged.
    pub services: Vec<ServiceStats>,
}

/// The counters of all topics.
#[derive(Default)]
pub(crate) struct Book {
    counters: BTreeMap<(TopicKey, Direction), Arc<Counters>>,
}

impl Book {
    /// Topics that are counted; of more, those that are not bridged any more are forgotten.
    const MOST: usize = 4096;

    pub(crate) fn counters(
        &mut self,
        key: &TopicKey,
        direction: Direction,
        is_active: impl Fn(&TopicKey, Direction) -> bool,
    ) -> Arc<Counters> {
        if self.counters.len() >= Self::MOST {
            self.counters.retain(|(key, direction), _| is_active(key, *direction));
        }
        self.counters.entry((key.clone(), direction)).or_default().clone()
    }

    /// What they say, with rates since `before`.
    pub(crate) fn read(
        &self,
        before: &[TopicStats],
        elapsed: Duration,
        is_active: impl Fn(&TopicKey, Direction) -> bool,
    ) -> Vec<TopicStats> {
        let old: HashMap<_, _> = before
            .iter()
            .map(|topic| ((&*topic.topic, &*topic.ros_topic, &*topic.type_name, topic.direction), topic))
            .collect();
        let read = |((key, direction), counters): (&(TopicKey, Direction), &Arc<Counters>)| {
            let before = old.get(&(&*key.topic, &*key.ros_topic, &*key.type_name, *direction)).copied();
            TopicStats {
                topic: key.topic.clone(),
                ros_topic: key.ros_topic.clone(),
                type_name: key.type_name.clone(),
                direction: *direction,
                active: is_active(key, *direction),
                numbers: counters.read(before, elapsed),
            }
        };
        self.counters.iter().map(read).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_losses() {
        let mut numbers = Numbers::default();
        let (a, b) = (Gid([1; 16]), Gid([2; 16]));
        let all = [(a, 1), (a, 2), (b, 100), (a, 5), (b, 101), (a, 5), (a, 4), (a, 6)];
        let missing = all.map(|(gid, number)| numbers.missing(gid, number));
        assert_eq!(missing, [Some(0), Some(0), Some(0), Some(2), Some(0), None, None, Some(0)]);
        numbers.forget(|gid| *gid == a);
        assert_eq!(numbers.missing(a, 100), Some(0));
    }

    #[test]
    fn rates_and_json() {
        let mut book = Book::default();
        let key = TopicKey { topic: "/x".into(), ros_topic: "/y".into(), type_name: "a/msg/B".into() };
        let counters = book.counters(&key, Direction::ToRos, |_, _| true);
        counters.passed(100);
        let before = book.read(&[], Duration::ZERO, |_, _| true);
        counters.passed(100);
        counters.passed(100);
        counters.dropped("rate limit");
        let after = book.read(&before, Duration::from_millis(500), |_, _| false);
        let numbers = &after[0].numbers;
        assert_eq!((numbers.messages, numbers.messages_per_s, numbers.bytes_per_s), (3, 4.0, 400.0));
        let json = serde_json::to_value(&after[0]).unwrap();
        assert_eq!((&json["direction"], &json["dropped"]["rate limit"]), (&"to_ros".into(), &1.into()));
        assert_eq!((&json["ros_topic"], &json["active"]), (&"/y".into(), &false.into()));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The publishers in ROS that stand for those here: whether they have found somebody, and whom they do not fit.

use crate::mirror::TopicKey;
use crate::outgoing::Writer;
use crate::rcl::RosPublisher;
use crate::stats::IncompatibleQos;
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_transport::Gid;

/// How long it is looked often whether a publisher in ROS has found its subscriptions; afterwards, with each tick.
pub(super) const MATCH_TIME: Duration = Duration::from_secs(3);

/// By the publisher here that each stands for.
#[derive(Default)]
pub(super) struct Counterparts(HashMap<(TopicKey, Gid), Counterpart>);

struct Counterpart {
    writer: Writer,
    opened: Instant,
    /// Whether samples go through it.
    is_open: bool,
    incompatible: Option<Incompatible>,
}

/// Ends in ROS that do not fit a publisher's QoS.
#[derive(Clone, Copy)]
struct Incompatible {
    count: u64,
    last_policy: &'static str,
    since: Instant,
}

impl Counterparts {
    pub(super) fn insert(&mut self, key: &TopicKey, gid: Gid, publisher: RosPublisher) {
        let writer = Writer { publisher: Arc::new(publisher), last: Arc::default() };
        let counterpart = Counterpart { writer, opened: Instant::now(), is_open: false, incompatible: None };
        self.0.insert((key.clone(), gid), counterpart);
    }

    pub(super) fn remove(&mut self, key: &TopicKey, gid: Gid) {
        self.0.remove(&(key.clone(), gid));
    }

    /// The publishers here, each with the one in ROS that stands for it.
    pub(super) fn gids(&self) -> impl Iterator<Item = (Gid, Gid)> {
        self.0.iter().map(|((_, gid), counterpart)| (*gid, counterpart.writer.publisher.gid()))
    }

    /// The topic's samples are not taken any more.
    pub(super) fn close(&mut self, key: &TopicKey) {
        let of_topic = self.0.iter_mut().filter(|((topic, _), _)| topic == key);
        of_topic.for_each(|(_, counterpart)| counterpart.is_open = false);
    }

    /// Whether one of the topic's has somebody to send to.
    pub(super) fn is_matched(&self, key: &TopicKey) -> bool {
        self.0.iter().any(|((topic, _), counterpart)| topic == key && counterpart.is_matched())
    }

    /// Whether samples are to go through one soon, of topics that are taken.
    pub(super) fn is_opening(&self, is_taken: impl Fn(&TopicKey) -> bool) -> bool {
        self.0.iter().any(|((key, _), counterpart)| !counterpart.is_open && is_taken(key))
    }

    /// Opens those of topics that are taken once they have found somebody: what was sent before would be lost. One that finds
    /// nobody, while others do, does not keep its samples waiting for ever.
    pub(super) fn open_matched(
        &mut self,
        is_taken: impl Fn(&TopicKey) -> bool,
        mut open: impl FnMut(&TopicKey, Gid, Writer),
    ) {
        let now = Instant::now();
        for ((key, gid), counterpart) in &mut self.0 {
            let is_ready = || counterpart.is_matched() || now >= counterpart.opened + MATCH_TIME;
            if !counterpart.is_open && is_taken(key) && is_ready() {
                counterpart.is_open = true;
                open(key, *gid, counterpart.writer.clone());
            }
        }
    }

    /// As ROS does: an event for each end that does not fit, which is counted and said.
    pub(super) fn look_for_incompatible(&mut self) {
        for ((key, _), counterpart) in &mut self.0 {
            let Some((count, policy)) = counterpart.writer.publisher.incompatible() else { continue };
            tracing::warn!(
                "topic '{}': an end in ROS does not fit the QoS of one here (last policy: {policy}): no messages go between them; \
                 change one of them, or set qos.{policy} of the topic in the configuration",
                key.ros_topic
            );
            let since = Instant::now();
            counterpart.incompatible = Some(Incompatible { count, last_policy: policy, since });
        }
    }

    /// Those that do not fit, by topic.
    pub(super) fn incompatible(&self) -> BTreeMap<String, IncompatibleQos> {
        by_topic(self.0.iter().filter_map(|((key, _), end)| Some((&*key.topic, end.incompatible?))))
    }
}

impl Counterpart {
    fn is_matched(&self) -> bool {
        self.writer.publisher.subscription_count() > 0
    }
}

/// Those of all publishers of a topic that are there now.
fn by_topic<'t>(ends: impl Iterator<Item = (&'t str, Incompatible)>) -> BTreeMap<String, IncompatibleQos> {
    let mut topics: BTreeMap<&str, Incompatible> = BTreeMap::new();
    for (topic, end) in ends {
        let all = topics.entry(topic).or_insert(Incompatible { count: 0, ..end });
        let count = all.count + end.count;
        let last = if end.since > all.since { end } else { *all };
        *all = Incompatible { count, ..last };
    }
    let told = |(topic, all): (&str, Incompatible)| {
        (topic.to_owned(), IncompatibleQos { count: all.count, last_policy: all.last_policy.to_owned() })
    };
    topics.into_iter().map(told).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_that_do_not_fit_are_those_of_all_publishers_of_a_topic() {
        let start = Instant::now();
        let end = |count, last_policy, after_s| Incompatible {
            count,
            last_policy,
            since: start + Duration::from_secs(after_s),
        };
        let ends =
            [("/x", end(2, "reliability", 5)), ("/x", end(3, "deadline", 1)), ("/y", end(1, "deadline", 2))];
        let told = by_topic(ends.into_iter());
        let of = |topic: &str| (told[topic].count, &*told[topic].last_policy);
        assert_eq!((of("/x"), of("/y")), ((5, "reliability"), (1, "deadline")));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics per service.

use crate::mirror::TopicKey;
use crate::rules::Direction;
use crate::stats::SinceEnd;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tautline_rt::PiMutex;

/// Maximum of distinct reasons; further ones are counted together.
const MOST_REASONS: usize = 16;
/// Maximum of services; beyond it, those that have ended are forgotten.
const MOST_SERVICES: usize = 1024;

/// A mirrored service.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ServiceStats<N, D> {
    /// Its names.
    #[serde(flatten)]
    pub name: N,
    /// The direction in which the service is offered: `Out` for a service of the domain.
    pub direction: D,
    /// Whether the service is offered now.
    pub active: bool,
    /// Answered requests.
    pub answered: u64,
    /// Failed requests, by reason.
    pub failed: BTreeMap<String, u64>,
}

impl<N, D> ServiceStats<N, D> {
    /// Converts names and directions.
    pub fn named<M, E>(self, named: impl Fn(N) -> M, way: impl Fn(D) -> E) -> ServiceStats<M, E> {
        let ServiceStats { name, direction, active, answered, failed } = self;
        ServiceStats { name: named(name), direction: way(direction), active, answered, failed }
    }
}

/// Counters of one service, shared by the carrying thread and a reader of lower priority.
#[derive(Debug, Default)]
pub(super) struct ServiceCounters(PiMutex<Counts>);

#[derive(Clone, Debug, Default)]
struct Counts {
    active: bool,
    answered: u64,
    failed: BTreeMap<String, u64>,
}

impl ServiceCounters {
    pub(super) fn answered(&self) {
        self.0.lock().answered += 1;
    }

    pub(super) fn failed(&self, reason: impl ToString) {
        self.failed_times(1, reason);
    }

    pub(super) fn failed_times(&self, count: usize, reason: impl ToString) {
        if count == 0 {
            return;
        }
        let reason = reason.to_string();
        let failed = &mut self.0.lock().failed;
        let is_new = !failed.contains_key(&reason);
        let reason = if is_new && failed.len() >= MOST_REASONS { "other reasons".to_owned() } else { reason };
        *failed.entry(reason).or_default() += count as u64;
    }

    pub(super) fn set_active(&self, active: bool) {
        self.0.lock().active = active;
    }
}

#[derive(Debug, Default)]
pub(super) struct ServiceStatsTable(PiMutex<BTreeMap<(TopicKey, Direction), Counted>>);

#[derive(Debug, Default)]
struct Counted {
    counters: Arc<ServiceCounters>,
    since_end: SinceEnd,
}

impl Counted {
    fn is_used(&self) -> bool {
        Arc::strong_count(&self.counters) > 1
    }
}

impl ServiceStatsTable {
    pub(super) fn counters(&self, key: &TopicKey, direction: Direction) -> Arc<ServiceCounters> {
        let mut all = self.0.lock();
        if all.len() >= MOST_SERVICES {
            all.retain(|_, counted| counted.is_used());
        }
        all.entry((key.clone(), direction)).or_default().counters.clone()
    }

    /// Reads all counters, `elapsed` after the last call. A minute after its end a service is forgotten.
    pub(super) fn read(&self, elapsed: Duration) -> Vec<ServiceStats<TopicKey, Direction>> {
        let mut all = self.0.lock();
        all.retain(|_, counted| counted.since_end.is_kept(counted.is_used(), elapsed));
        let stats = |((key, direction), counted): (&(TopicKey, Direction), &Counted)| {
            let Counts { active, answered, failed } = counted.counters.0.lock().clone();
            ServiceStats { name: key.clone(), direction: *direction, active, answered, failed }
        };
        all.iter().map(stats).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counters_of(stats: &ServiceStatsTable, topic: impl Into<String>) -> Arc<ServiceCounters> {
        let (topic, far_topic, type_name) = (topic.into(), "/b".into(), "c/srv/D".into());
        stats.counters(&TopicKey { topic, far_topic, type_name, type_hash: None }, Direction::Out)
    }

    #[test]
    fn of_too_many_services_those_that_go_on_are_counted() {
        let stats = ServiceStatsTable::default();
        // It seeks its server.
        let goes_on = counters_of(&stats, "/a");
        (1..=MOST_SERVICES).for_each(|number| drop(counters_of(&stats, format!("/b{number}"))));
        goes_on.answered();
        let left = stats.read(Duration::ZERO);
        let left: Vec<_> = left.iter().map(|service| (&*service.name.topic, service.answered)).collect();
        assert_eq!(left, [("/a", 1), (&*format!("/b{MOST_SERVICES}"), 0)]);
    }

    #[test]
    fn reasons_do_not_grow_without_end() {
        let stats = ServiceStatsTable::default();
        let counters = counters_of(&stats, "/a");
        for index in 0..100 {
            counters.failed(index % 50);
        }
        counters.answered();
        let all = stats.read(Duration::ZERO);
        let ServiceStats { answered, failed, active, .. } = &all[0];
        assert_eq!((all.len(), *answered, *active, failed.len()), (1, 1, false, MOST_REASONS + 1));
        assert_eq!((failed["0"], failed.values().sum::<u64>()), (2, 100));
        let hour = Duration::from_secs(3600);
        assert_eq!(stats.read(hour).len(), 1);
        drop(counters);
        assert_eq!(stats.read(hour).len(), 0, "it has ended");
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Statistics per service.

use crate::mirror::TopicKey;
use crate::rules::Direction;
use crate::stats::StatsTable;
use serde::Serialize;
use std::collections::BTreeMap;
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
    fn read(&self, (key, direction): &(TopicKey, Direction)) -> ServiceStats<TopicKey, Direction> {
        let Counts { active, answered, failed } = self.0.lock().clone();
        ServiceStats { name: key.clone(), direction: *direction, active, answered, failed }
    }

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

pub(super) type ServiceStatsTable = StatsTable<(TopicKey, Direction), ServiceCounters, MOST_SERVICES>;

impl ServiceStatsTable {
    /// The statistics of all services, `elapsed` after the last call.
    pub(super) fn stats(&mut self, elapsed: Duration) -> Vec<ServiceStats<TopicKey, Direction>> {
        self.read(elapsed, |key, counters, _| counters.read(key))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_do_not_grow_without_end() {
        let mut stats = ServiceStatsTable::default();
        let (topic, far_topic, type_name) = ("/a".into(), "/b".into(), "c/srv/D".into());
        let key = TopicKey { topic, far_topic, type_name, type_hash: None };
        let counters = stats.counters((key, Direction::Out));
        for index in 0..100 {
            counters.failed(index % 50);
        }
        counters.answered();
        let all = stats.stats(Duration::ZERO);
        let ServiceStats { answered, failed, active, .. } = &all[0];
        assert_eq!((all.len(), *answered, *active, failed.len()), (1, 1, false, MOST_REASONS + 1));
        assert_eq!((failed["0"], failed.values().sum::<u64>()), (2, 100));
    }
}

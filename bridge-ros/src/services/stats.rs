// SPDX-License-Identifier: MIT OR Apache-2.0
//! What was answered through the bridge and what was not, per service.

use super::routes::ServiceKey;
use crate::stats::Direction;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Reasons that are told apart; of more, all are one.
const MOST_REASONS: usize = 16;
/// Services that are counted; of more, those that are not bridged any more are forgotten.
const MOST_SERVICES: usize = 1024;

/// A service, of which the bridge stands for the server.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ServiceStats {
    /// Tautline's name of it.
    pub service: String,
    /// ROS's name of it.
    pub ros_service: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// To whom it is offered: `to_ros` is a service of Tautline's.
    pub direction: Direction,
    /// Whether it is offered now.
    pub active: bool,
    /// Requests that were answered.
    pub answered: u64,
    /// Requests that were not, by reason.
    pub failed: BTreeMap<String, u64>,
}

/// Counters of one service.
#[derive(Debug, Default)]
pub(super) struct Counters {
    active: AtomicBool,
    answered: AtomicU64,
    failed: Mutex<BTreeMap<String, u64>>,
}

impl Counters {
    pub(super) fn answered(&self) {
        self.answered.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn failed(&self, reason: impl ToString) {
        self.failed_times(1, reason);
    }

    pub(super) fn failed_times(&self, count: usize, reason: impl ToString) {
        if count == 0 {
            return;
        }
        let mut failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        let reason = reason.to_string();
        let is_new = !failed.contains_key(&reason);
        let reason = if is_new && failed.len() >= MOST_REASONS { "other reasons".to_owned() } else { reason };
        *failed.entry(reason).or_default() += count as u64;
    }

    pub(super) fn set_active(&self, active: bool) {
        self.active.store(active, Ordering::Relaxed);
    }
}

/// The counters of all services.
#[derive(Debug, Default)]
pub(super) struct Book(Mutex<BTreeMap<(ServiceKey, Direction), Arc<Counters>>>);

impl Book {
    pub(super) fn counters(&self, key: &ServiceKey, direction: Direction) -> Arc<Counters> {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() >= MOST_SERVICES {
            all.retain(|_, counters| counters.active.load(Ordering::Relaxed));
        }
        all.entry((key.clone(), direction)).or_default().clone()
    }

    pub(super) fn read(&self) -> Vec<ServiceStats> {
        let all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let stats = |((key, direction), counters): (&(ServiceKey, Direction), &Arc<Counters>)| ServiceStats {
            service: key.service.clone(),
            ros_service: key.ros_service.clone(),
            type_name: key.type_name.clone(),
            direction: *direction,
            active: counters.active.load(Ordering::Relaxed),
            answered: counters.answered.load(Ordering::Relaxed),
            failed: counters.failed.lock().unwrap_or_else(PoisonError::into_inner).clone(),
        };
        all.iter().map(stats).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_do_not_grow_without_end() {
        let book = Book::default();
        let key = ServiceKey { service: "/a".into(), ros_service: "/b".into(), type_name: "c/srv/D".into() };
        let counters = book.counters(&key, Direction::ToRos);
        for index in 0..100 {
            counters.failed(index % 50);
        }
        counters.answered();
        let all = book.read();
        let ServiceStats { answered, failed, active, .. } = &all[0];
        assert_eq!((all.len(), *answered, *active, failed.len()), (1, 1, false, MOST_REASONS + 1));
        assert_eq!((failed["0"], failed.values().sum::<u64>()), (2, 100));
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Whether a publisher's offered QoS is compatible with a subscription's requested QoS: ROS 2's rules.

use crate::qos::{Durability, Liveliness, Qos, Reliability};
use std::time::Duration;

/// A part of the quality of service that a publisher and a subscription must agree on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum QosPolicyKind {
    /// A subscription that requests reliable needs a reliable publisher.
    Reliability,
    /// A subscription that requests transient local needs a transient-local publisher.
    Durability,
    /// The publisher's deadline must not be longer than the subscription's.
    Deadline,
    /// A subscription that requests manual liveliness needs a publisher that asserts it.
    Liveliness,
    /// The publisher's lease must not be longer than the subscription's.
    LivelinessLeaseDuration,
}

tautline_rt::names!(QosPolicyKind: Display {
    Reliability: "reliability", Durability: "durability", Deadline: "deadline", Liveliness: "liveliness",
    LivelinessLeaseDuration: "liveliness_lease_duration",
});

impl Qos {
    /// The first policy in which a publisher with this quality of service is incompatible with a subscription that
    /// requests `requested`; `None` if they are compatible. History, depth and lifespan are always compatible.
    ///
    /// ```
    /// use tautline_transport::{Qos, QosPolicyKind};
    /// let (reliable, best_effort) = (Qos::default(), Qos::default().best_effort());
    /// assert_eq!(reliable.incompatibility(&best_effort), None);
    /// assert_eq!(best_effort.incompatibility(&reliable), Some(QosPolicyKind::Reliability));
    /// ```
    pub fn incompatibility(&self, requested: &Qos) -> Option<QosPolicyKind> {
        self.incompatibilities(requested).next()
    }

    /// All policies of which [`incompatibility`](Self::incompatibility) returns the first.
    pub fn incompatibilities(&self, requested: &Qos) -> impl Iterator<Item = QosPolicyKind> + use<> {
        let longer = |offered: Option<Duration>, requested: Option<Duration>| {
            requested.is_some_and(|requested| offered.is_none_or(|offered| offered > requested))
        };
        let refused = [
            (
                QosPolicyKind::Reliability,
                requested.reliability == Reliability::Reliable && self.reliability == Reliability::BestEffort,
            ),
            (
                QosPolicyKind::Durability,
                requested.durability == Durability::TransientLocal && self.durability == Durability::Volatile,
            ),
            (QosPolicyKind::Deadline, longer(self.deadline, requested.deadline)),
            (
                QosPolicyKind::Liveliness,
                requested.liveliness == Liveliness::ManualByTopic && self.liveliness == Liveliness::Automatic,
            ),
            (
                QosPolicyKind::LivelinessLeaseDuration,
                longer(self.liveliness_lease_duration, requested.liveliness_lease_duration),
            ),
        ];
        refused.into_iter().filter_map(|(policy, refused)| refused.then_some(policy))
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use QosPolicyKind as Policy;

    #[test]
    fn every_rule_of_the_table() {
        let (none, short, long) = (None, Some(Duration::from_millis(10)), Some(Duration::from_millis(20)));
        let plain = Qos::default();
        let deadline = |deadline| Qos { deadline, ..plain };
        let lease = |liveliness_lease_duration| Qos { liveliness_lease_duration, ..plain };
        let manual = Qos { liveliness: Liveliness::ManualByTopic, ..plain };
        for (offered, requested, expected) in [
            (plain, plain, None),
            (plain, plain.best_effort(), None),
            (plain.best_effort(), plain.best_effort(), None),
            (plain.best_effort(), plain, Some(Policy::Reliability)),
            (plain.transient_local(), plain, None),
            (plain.transient_local(), plain.transient_local(), None),
            (plain, plain.transient_local(), Some(Policy::Durability)),
            (deadline(short), deadline(none), None),
            (deadline(short), deadline(short), None),
            (deadline(short), deadline(long), None),
            (deadline(long), deadline(short), Some(Policy::Deadline)),
            (deadline(none), deadline(long), Some(Policy::Deadline)),
            (manual, plain, None),
            (manual, manual, None),
            (plain, manual, Some(Policy::Liveliness)),
            (lease(short), lease(none), None),
            (lease(short), lease(long), None),
            (lease(long), lease(short), Some(Policy::LivelinessLeaseDuration)),
            (lease(none), lease(short), Some(Policy::LivelinessLeaseDuration)),
            (Qos::keep_last(1), Qos::keep_all(7), None),
            (Qos { lifespan: short, ..plain }, Qos { lifespan: long, ..plain }, None),
            (plain.best_effort(), manual.transient_local(), Some(Policy::Reliability)),
        ] {
            assert_eq!(offered.incompatibility(&requested), expected, "{offered:?} for {requested:?}");
        }
        let all = plain.best_effort().incompatibilities(&manual.transient_local());
        assert!(all.eq([Policy::Reliability, Policy::Durability, Policy::Liveliness]));
    }
}

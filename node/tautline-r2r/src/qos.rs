// SPDX-License-Identifier: MIT OR Apache-2.0
//! r2r's quality-of-service profile.

use std::time::Duration;
use tautline::{Durability, History, Liveliness, Qos, Reliability};

/// How many samples are kept for a slow subscription.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HistoryPolicy {
    /// Nothing is overwritten; `depth` bounds the queue (0: 100), and publishing to a full one is refused.
    KeepAll,
    /// The newest `depth`.
    KeepLast,
    /// As keep-last.
    SystemDefault,
}

/// What the network does about lost samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReliabilityPolicy {
    /// Nothing.
    BestEffort,
    /// It retransmits them.
    Reliable,
    /// As reliable.
    SystemDefault,
}

/// Whether late joiners get samples that were published before they joined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DurabilityPolicy {
    /// The last `depth` samples.
    TransientLocal,
    /// No earlier samples.
    Volatile,
    /// As volatile.
    SystemDefault,
}

/// How a publisher shows that it is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LivelinessPolicy {
    /// Automatically: it is alive as long as its process is.
    Automatic,
    /// By publishing, or by asserting it, at least once in each lease.
    ManualByTopic,
    /// As automatic.
    SystemDefault,
}

/// Quality of service of a publisher or a subscription, as in r2r: plain data and setters.
///
/// ```
/// use tautline_r2r::QosProfile;
/// let latched = QosProfile::default().keep_last(1).transient_local();
/// assert_eq!(latched.depth, 1);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use = "it returns the changed QosProfile"]
pub struct QosProfile {
    /// See [`HistoryPolicy`].
    pub history: HistoryPolicy,
    /// Queue length in samples; 0 is the system's default, 10.
    pub depth: usize,
    /// See [`ReliabilityPolicy`].
    pub reliability: ReliabilityPolicy,
    /// See [`DurabilityPolicy`].
    pub durability: DurabilityPolicy,
    /// Longest time between samples; 0 is none.
    pub deadline: Duration,
    /// Age at which samples expire; 0 means none. Only a publisher's value is used.
    pub lifespan: Duration,
    /// See [`LivelinessPolicy`].
    pub liveliness: LivelinessPolicy,
    /// Time after which a silent publisher whose liveliness is manual counts as dead; 0 is none.
    pub liveliness_lease_duration: Duration,
    /// Omits ROS's prefixes; Tautline has none.
    pub avoid_ros_namespace_conventions: bool,
}

/// The depth when the profile says 0: ROS 2's default, and for keep-all a bound.
const DEFAULT_DEPTH: usize = 10;
const DEFAULT_BOUND: usize = 100;

impl QosProfile {
    const fn common() -> Self {
        QosProfile {
            history: HistoryPolicy::KeepLast,
            depth: DEFAULT_DEPTH,
            reliability: ReliabilityPolicy::Reliable,
            durability: DurabilityPolicy::Volatile,
            deadline: Duration::ZERO,
            lifespan: Duration::ZERO,
            liveliness: LivelinessPolicy::SystemDefault,
            liveliness_lease_duration: Duration::ZERO,
            avoid_ros_namespace_conventions: false,
        }
    }

    /// Keep last 10, reliable, volatile.
    #[allow(clippy::should_implement_trait, reason = "const, as in r2r; the trait is implemented too")]
    pub const fn default() -> Self {
        Self::common()
    }

    /// For sensors: keep last 5, best effort, volatile.
    pub const fn sensor_data() -> Self {
        Self::common().keep_last(5).best_effort()
    }

    /// For parameters: keep last 1000, reliable, volatile.
    pub const fn parameters() -> Self {
        Self::common().keep_last(1000)
    }

    /// For services: keep last 10, reliable, volatile.
    pub const fn services_default() -> Self {
        Self::common()
    }

    /// For parameter events: keep last 1000, reliable, volatile.
    pub const fn parameter_events() -> Self {
        Self::common().keep_last(1000)
    }

    /// The system's default: keep last 10, reliable, volatile.
    pub const fn system_default() -> Self {
        QosProfile {
            history: HistoryPolicy::SystemDefault,
            depth: 0,
            reliability: ReliabilityPolicy::SystemDefault,
            durability: DurabilityPolicy::SystemDefault,
            ..Self::common()
        }
    }

    /// Sets the history policy.
    pub const fn history(self, history: HistoryPolicy) -> Self {
        QosProfile { history, ..self }
    }

    /// Keeps the newest `depth` samples.
    pub const fn keep_last(self, depth: usize) -> Self {
        QosProfile { depth, history: HistoryPolicy::KeepLast, ..self }
    }

    /// Keeps all samples, up to the bound of `depth`.
    pub const fn keep_all(self) -> Self {
        QosProfile { history: HistoryPolicy::KeepAll, depth: 0, ..self }
    }

    /// Sets the depth, or the bound of keep-all.
    pub const fn depth(self, depth: usize) -> Self {
        QosProfile { depth, ..self }
    }

    /// Sets the reliability policy.
    pub const fn reliability(self, reliability: ReliabilityPolicy) -> Self {
        QosProfile { reliability, ..self }
    }

    /// Lets the network retransmit lost samples.
    pub const fn reliable(self) -> Self {
        self.reliability(ReliabilityPolicy::Reliable)
    }

    /// Lets the network lose samples.
    pub const fn best_effort(self) -> Self {
        self.reliability(ReliabilityPolicy::BestEffort)
    }

    /// Sets the durability policy.
    pub const fn durability(self, durability: DurabilityPolicy) -> Self {
        QosProfile { durability, ..self }
    }

    /// Late joiners get only samples that are published later.
    pub const fn volatile(self) -> Self {
        self.durability(DurabilityPolicy::Volatile)
    }

    /// Late joiners get the last `depth` samples as well.
    pub const fn transient_local(self) -> Self {
        self.durability(DurabilityPolicy::TransientLocal)
    }

    /// Sets the deadline.
    pub const fn deadline(self, deadline: Duration) -> Self {
        QosProfile { deadline, ..self }
    }

    /// Sets the lifespan.
    pub const fn lifespan(self, lifespan: Duration) -> Self {
        QosProfile { lifespan, ..self }
    }

    /// Sets the liveliness policy.
    pub const fn liveliness(self, liveliness: LivelinessPolicy) -> Self {
        QosProfile { liveliness, ..self }
    }

    /// Sets the lease duration.
    pub const fn liveliness_lease_duration(self, liveliness_lease_duration: Duration) -> Self {
        QosProfile { liveliness_lease_duration, ..self }
    }

    /// Sets whether ROS's prefixes are omitted.
    pub const fn avoid_ros_namespace_conventions(self, avoid_ros_namespace_conventions: bool) -> Self {
        QosProfile { avoid_ros_namespace_conventions, ..self }
    }
}

impl From<QosProfile> for Qos {
    fn from(profile: QosProfile) -> Self {
        let set = |duration: Duration| (duration != Duration::ZERO).then_some(duration);
        let (history, default_depth) = match profile.history {
            HistoryPolicy::KeepAll => (History::KeepAll, DEFAULT_BOUND),
            HistoryPolicy::KeepLast | HistoryPolicy::SystemDefault => (History::KeepLast, DEFAULT_DEPTH),
        };
        Qos {
            history,
            depth: if profile.depth == 0 { default_depth } else { profile.depth },
            reliability: match profile.reliability {
                ReliabilityPolicy::BestEffort => Reliability::BestEffort,
                ReliabilityPolicy::Reliable | ReliabilityPolicy::SystemDefault => Reliability::Reliable,
            },
            durability: match profile.durability {
                DurabilityPolicy::TransientLocal => Durability::TransientLocal,
                DurabilityPolicy::Volatile | DurabilityPolicy::SystemDefault => Durability::Volatile,
            },
            deadline: set(profile.deadline),
            lifespan: set(profile.lifespan),
            liveliness: match profile.liveliness {
                LivelinessPolicy::ManualByTopic => Liveliness::ManualByTopic,
                LivelinessPolicy::Automatic | LivelinessPolicy::SystemDefault => Liveliness::Automatic,
            },
            liveliness_lease_duration: set(profile.liveliness_lease_duration),
        }
    }
}

impl From<Qos> for QosProfile {
    fn from(qos: Qos) -> Self {
        QosProfile {
            history: match qos.history {
                History::KeepAll => HistoryPolicy::KeepAll,
                History::KeepLast => HistoryPolicy::KeepLast,
            },
            depth: qos.depth,
            reliability: match qos.reliability {
                Reliability::BestEffort => ReliabilityPolicy::BestEffort,
                Reliability::Reliable => ReliabilityPolicy::Reliable,
            },
            durability: match qos.durability {
                Durability::TransientLocal => DurabilityPolicy::TransientLocal,
                Durability::Volatile => DurabilityPolicy::Volatile,
            },
            deadline: qos.deadline.unwrap_or_default(),
            lifespan: qos.lifespan.unwrap_or_default(),
            liveliness: match qos.liveliness {
                Liveliness::ManualByTopic => LivelinessPolicy::ManualByTopic,
                Liveliness::Automatic => LivelinessPolicy::SystemDefault,
            },
            liveliness_lease_duration: qos.liveliness_lease_duration.unwrap_or_default(),
            ..Self::common()
        }
    }
}

impl Default for QosProfile {
    fn default() -> Self {
        QosProfile::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_are_the_qos_that_they_say() {
        let ms = Duration::from_millis;
        for (profile, expected) in [
            (QosProfile::default(), Qos::default()),
            (QosProfile::system_default(), Qos::keep_last(10)),
            (QosProfile::sensor_data(), Qos::sensor_data()),
            (QosProfile::parameters(), Qos::parameters()),
            (QosProfile::parameter_events(), Qos::parameter_events()),
            (QosProfile::services_default(), Qos::services_default()),
            (QosProfile::default().keep_last(0), Qos::keep_last(10)),
            (QosProfile::default().keep_all(), Qos::keep_all(100)),
            (QosProfile::default().keep_all().depth(3), Qos::keep_all(3)),
            (
                QosProfile::default().transient_local().best_effort(),
                Qos::default().transient_local().best_effort(),
            ),
            (
                QosProfile::default().deadline(ms(1)).lifespan(ms(2)).liveliness_lease_duration(ms(3)),
                Qos::default().deadline(ms(1)).lifespan(ms(2)).liveliness_lease_duration(ms(3)),
            ),
            (
                QosProfile::default().liveliness(LivelinessPolicy::ManualByTopic),
                Qos::default().liveliness(Liveliness::ManualByTopic),
            ),
        ] {
            assert_eq!(Qos::from(profile), expected, "{profile:?}");
            assert_eq!(Qos::from(QosProfile::from(expected)), expected);
        }
    }
}

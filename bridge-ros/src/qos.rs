// SPDX-License-Identifier: MIT OR Apache-2.0
//! Converts QoS between Tautline and ROS.

use r2r_rcl::*;
use std::time::Duration;
use tautline_transport::{Durability, History, Liveliness, Qos, Reliability};

/// Depth for keep-all, and where the RMW does not know the depth.
pub const UNKNOWN_DEPTH: usize = 10;

/// Tautline's QoS as a ROS profile.
pub(crate) fn to_ros(qos: &Qos) -> rmw_qos_profile_t {
    use rmw_qos_durability_policy_e::*;
    use rmw_qos_history_policy_e::*;
    use rmw_qos_liveliness_policy_e::*;
    use rmw_qos_reliability_policy_e::*;
    rmw_qos_profile_t {
        history: match qos.history {
            History::KeepLast => RMW_QOS_POLICY_HISTORY_KEEP_LAST,
            History::KeepAll => RMW_QOS_POLICY_HISTORY_KEEP_ALL,
        },
        depth: qos.depth,
        reliability: match qos.reliability {
            Reliability::Reliable => RMW_QOS_POLICY_RELIABILITY_RELIABLE,
            Reliability::BestEffort => RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT,
        },
        durability: match qos.durability {
            Durability::TransientLocal => RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL,
            Durability::Volatile => RMW_QOS_POLICY_DURABILITY_VOLATILE,
        },
        deadline: time(qos.deadline),
        lifespan: time(qos.lifespan),
        liveliness: match qos.liveliness {
            Liveliness::Automatic => RMW_QOS_POLICY_LIVELINESS_AUTOMATIC,
            Liveliness::ManualByTopic => RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC,
        },
        liveliness_lease_duration: time(qos.liveliness_lease_duration),
        avoid_ros_namespace_conventions: false,
    }
}

/// A ROS profile as Tautline's QoS. A policy that the RMW does not know becomes the weakest one.
pub(crate) fn from_ros(profile: &rmw_qos_profile_t) -> Qos {
    use rmw_qos_durability_policy_e::RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL;
    use rmw_qos_history_policy_e::RMW_QOS_POLICY_HISTORY_KEEP_ALL;
    use rmw_qos_liveliness_policy_e::RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC;
    use rmw_qos_reliability_policy_e::RMW_QOS_POLICY_RELIABILITY_RELIABLE;
    Qos {
        history: match profile.history {
            RMW_QOS_POLICY_HISTORY_KEEP_ALL => History::KeepAll,
            _ => History::KeepLast,
        },
        depth: if profile.depth == 0 { UNKNOWN_DEPTH } else { profile.depth },
        reliability: match profile.reliability {
            RMW_QOS_POLICY_RELIABILITY_RELIABLE => Reliability::Reliable,
            _ => Reliability::BestEffort,
        },
        durability: match profile.durability {
            RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL => Durability::TransientLocal,
            _ => Durability::Volatile,
        },
        deadline: duration(profile.deadline),
        lifespan: duration(profile.lifespan),
        liveliness: match profile.liveliness {
            RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC => Liveliness::ManualByTopic,
            _ => Liveliness::Automatic,
        },
        liveliness_lease_duration: duration(profile.liveliness_lease_duration),
    }
}

/// Zero is ROS's value for unspecified.
fn time(duration: Option<Duration>) -> rmw_time_t {
    let (sec, nsec) = duration.map_or((0, 0), |time| (time.as_secs(), u64::from(time.subsec_nanos())));
    rmw_time_t { sec, nsec }
}

/// DDS represents no limit as an infinite time, which each RMW writes differently.
fn duration(time: rmw_time_t) -> Option<Duration> {
    const FOREVER_S: u64 = i32::MAX as u64;
    let duration = Duration::from_secs(time.sec).saturating_add(Duration::from_nanos(time.nsec));
    (!duration.is_zero() && duration.as_secs() < FOREVER_S).then_some(duration)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_and_back() {
        let second = Some(Duration::from_millis(1500));
        let profiles = [
            Qos::default(),
            Qos::keep_last(1000).best_effort(),
            Qos::keep_all(5).transient_local(),
            Qos { deadline: second, lifespan: second, ..Qos::keep_last(1) },
            Qos {
                liveliness: Liveliness::ManualByTopic,
                liveliness_lease_duration: second,
                ..Qos::default()
            },
        ];
        for qos in profiles {
            assert_eq!(from_ros(&to_ros(&qos)), qos);
        }
    }

    #[test]
    fn what_is_not_known_is_not_promised() {
        // SAFETY: plain numbers; zero is a valid value of each enum.
        let mut profile: rmw_qos_profile_t = unsafe { std::mem::zeroed() };
        profile.deadline = rmw_time_t { sec: 9_223_372_036, nsec: 854_775_807 };
        profile.lifespan = rmw_time_t { sec: 0x7fff_ffff, nsec: 0xffff_ffff };
        assert_eq!(from_ros(&profile), Qos::keep_last(UNKNOWN_DEPTH).best_effort());
    }
}

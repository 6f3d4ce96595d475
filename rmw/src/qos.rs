// SPDX-License-Identifier: MIT OR Apache-2.0
//! QoS: ROS's profile, with defaults for open policies, and Tautline's.

use crate::bindings::*;
#[cfg(humble)]
use crate::distro::*;
use crate::error::{Error, Result};
use crate::handle::exported;
use std::ffi::c_char;
use std::time::Duration;
use tautline_transport::{
    Durability, EndpointKind, History, Limits, Liveliness, Qos, QosPolicyKind, Reliability, TopicEndpoint,
};

/// `RMW_DURATION_INFINITE`, and `RMW_QOS_DEADLINE_BEST_AVAILABLE`, which has the same seconds.
const ENDLESS_SECONDS: u64 = 9_223_372_036;
const BEST_AVAILABLE_NANOSECONDS: u64 = 854_775_806;

/// Queue depth of a keep-all endpoint; Fast DDS has the same.
const ALL: usize = 5_000;

/// The kind of endpoint of a profile.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum EndpointRole {
    Publisher,
    Subscription,
    Service,
}

fn refuse<T>(policy: &str, value: u32) -> Result<T> {
    Err(Error::invalid(format!(
        "the QoS profile's {policy} is {value}, which is not supported: use another value of rmw/types.h"
    )))
}

fn duration(time: &rmw_time_s) -> Option<Duration> {
    let is_endless = time.sec >= ENDLESS_SECONDS;
    let length = Duration::from_secs(time.sec).saturating_add(Duration::from_nanos(time.nsec));
    (!is_endless && !length.is_zero()).then_some(length)
}

fn time(duration: Option<Duration>) -> rmw_time_s {
    // No limit is DDS's infinite time, because nodes compare it.
    duration.map_or(rmw_time_s { sec: ENDLESS_SECONDS, nsec: 854_775_807 }, |length| rmw_time_s {
        sec: length.as_secs(),
        nsec: length.subsec_nanos().into(),
    })
}

fn is_best_available(time: &rmw_time_s) -> bool {
    (time.sec, time.nsec) == (ENDLESS_SECONDS, BEST_AVAILABLE_NANOSECONDS)
}

/// Whether a policy depends on the topic's other endpoints.
pub(crate) fn has_best_available(profile: &rmw_qos_profile_t) -> bool {
    profile.reliability == RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE
        || profile.durability == RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE
        || profile.liveliness == RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE
        || is_best_available(&profile.deadline)
        || is_best_available(&profile.liveliness_lease_duration)
}

/// Tautline's QoS from ROS's. System defaults are reliable, volatile, keep last 1, as in Fast DDS. Best-available policies follow
/// from `others`, the topic's endpoints, as in rmw_dds_common.
pub(crate) fn from_ros<'e>(
    profile: &rmw_qos_profile_t,
    role: EndpointRole,
    others: impl Iterator<Item = &'e TopicEndpoint> + Clone,
) -> Result<Qos> {
    // A subscription requests what all publishers offer; a publisher offers what all subscriptions request, and the strongest policy if
    // policies are ordered; a service uses the service defaults.
    let others = others.filter(|end| match role {
        EndpointRole::Publisher => end.kind == EndpointKind::Subscription,
        EndpointRole::Subscription => end.kind == EndpointKind::Publisher,
        EndpointRole::Service => false,
    });
    let is_most =
        |fits: fn(&TopicEndpoint) -> bool| role != EndpointRole::Subscription || others.clone().all(fits);
    let reliability = match profile.reliability {
        RMW_QOS_POLICY_RELIABILITY_SYSTEM_DEFAULT | RMW_QOS_POLICY_RELIABILITY_RELIABLE => {
            Reliability::Reliable
        }
        RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT => Reliability::BestEffort,
        RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE
            if is_most(|end| end.qos.reliability == Reliability::Reliable) =>
        {
            Reliability::Reliable
        }
        RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE => Reliability::BestEffort,
        other => return refuse("reliability", other),
    };
    let durability = match profile.durability {
        RMW_QOS_POLICY_DURABILITY_SYSTEM_DEFAULT | RMW_QOS_POLICY_DURABILITY_VOLATILE => Durability::Volatile,
        RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL => Durability::TransientLocal,
        RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE if role == EndpointRole::Service => Durability::Volatile,
        RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE
            if is_most(|end| end.qos.durability == Durability::TransientLocal) =>
        {
            Durability::TransientLocal
        }
        RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE => Durability::Volatile,
        other => return refuse("durability", other),
    };
    let liveliness = match profile.liveliness {
        RMW_QOS_POLICY_LIVELINESS_SYSTEM_DEFAULT | RMW_QOS_POLICY_LIVELINESS_AUTOMATIC => {
            Liveliness::Automatic
        }
        RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC => Liveliness::ManualByTopic,
        RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE => {
            let mut manual = others.clone().map(|end| end.qos.liveliness == Liveliness::ManualByTopic);
            let is_manual = match role {
                EndpointRole::Publisher => manual.any(|is_manual| is_manual),
                EndpointRole::Subscription => manual.all(|is_manual| is_manual),
                EndpointRole::Service => false,
            };
            if is_manual { Liveliness::ManualByTopic } else { Liveliness::Automatic }
        }
        other => return refuse("liveliness", other),
    };
    let (history, depth) = match profile.history {
        RMW_QOS_POLICY_HISTORY_SYSTEM_DEFAULT | RMW_QOS_POLICY_HISTORY_KEEP_LAST => {
            (History::KeepLast, profile.depth.clamp(1, Limits::MAX_DEPTH))
        }
        RMW_QOS_POLICY_HISTORY_KEEP_ALL => (History::KeepAll, ALL),
        other => return refuse("history", other),
    };
    let available = |time: &rmw_time_s, of: fn(&TopicEndpoint) -> Option<Duration>| {
        let lengths = others.clone().filter_map(of);
        match role {
            _ if !is_best_available(time) => duration(time),
            EndpointRole::Subscription => lengths.max(),
            EndpointRole::Publisher | EndpointRole::Service => lengths.min(),
        }
    };
    Ok(Qos {
        history,
        depth,
        reliability,
        durability,
        deadline: available(&profile.deadline, |end| end.qos.deadline),
        lifespan: duration(&profile.lifespan),
        liveliness,
        liveliness_lease_duration: available(&profile.liveliness_lease_duration, |end| {
            end.qos.liveliness_lease_duration
        }),
    })
}

/// ROS's profile from Tautline's, with no open policy.
pub(crate) fn to_ros(qos: &Qos, avoid_ros_namespace_conventions: bool) -> rmw_qos_profile_t {
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
        avoid_ros_namespace_conventions,
    }
}

pub(crate) fn policy_to_ros(policy: QosPolicyKind) -> rmw_qos_policy_kind_t {
    match policy {
        QosPolicyKind::Reliability => RMW_QOS_POLICY_RELIABILITY,
        QosPolicyKind::Durability => RMW_QOS_POLICY_DURABILITY,
        QosPolicyKind::Deadline => RMW_QOS_POLICY_DEADLINE,
        // DDS has one policy for both.
        QosPolicyKind::Liveliness | QosPolicyKind::LivelinessLeaseDuration => RMW_QOS_POLICY_LIVELINESS,
    }
}

/// Open values of each policy: the system default, unknown, and best available.
const OPEN_RELIABILITY: [u32; 3] = [
    RMW_QOS_POLICY_RELIABILITY_SYSTEM_DEFAULT,
    RMW_QOS_POLICY_RELIABILITY_UNKNOWN,
    RMW_QOS_POLICY_RELIABILITY_BEST_AVAILABLE,
];
const OPEN_DURABILITY: [u32; 3] = [
    RMW_QOS_POLICY_DURABILITY_SYSTEM_DEFAULT,
    RMW_QOS_POLICY_DURABILITY_UNKNOWN,
    RMW_QOS_POLICY_DURABILITY_BEST_AVAILABLE,
];
const OPEN_LIVELINESS: [u32; 3] = [
    RMW_QOS_POLICY_LIVELINESS_SYSTEM_DEFAULT,
    RMW_QOS_POLICY_LIVELINESS_UNKNOWN,
    RMW_QOS_POLICY_LIVELINESS_BEST_AVAILABLE,
];

/// The policies that are a system default or unknown in one of the profiles, so that their compatibility is unknown.
fn undetermined(profiles: [&rmw_qos_profile_t; 2]) -> impl Iterator<Item = QosPolicyKind> {
    type Value = fn(&rmw_qos_profile_t) -> u32;
    let policies: [(QosPolicyKind, [u32; 3], Value); 3] = [
        (QosPolicyKind::Reliability, OPEN_RELIABILITY, |profile| profile.reliability),
        (QosPolicyKind::Durability, OPEN_DURABILITY, |profile| profile.durability),
        (QosPolicyKind::Liveliness, OPEN_LIVELINESS, |profile| profile.liveliness),
    ];
    policies.into_iter().filter_map(move |(policy, [system_default, unknown, _], value)| {
        profiles.iter().any(|profile| [system_default, unknown].contains(&value(profile))).then_some(policy)
    })
}

/// The profile, with open policies set to compatible values.
fn settled(profile: &rmw_qos_profile_t, other: &rmw_qos_profile_t) -> rmw_qos_profile_t {
    let pick = |value: u32, open: [u32; 3], other: u32, else_: u32| match open.contains(&value) {
        false => value,
        true if open.contains(&other) => else_,
        true => other,
    };
    rmw_qos_profile_t {
        history: RMW_QOS_POLICY_HISTORY_KEEP_LAST,
        reliability: pick(
            profile.reliability,
            OPEN_RELIABILITY,
            other.reliability,
            RMW_QOS_POLICY_RELIABILITY_RELIABLE,
        ),
        durability: pick(
            profile.durability,
            OPEN_DURABILITY,
            other.durability,
            RMW_QOS_POLICY_DURABILITY_VOLATILE,
        ),
        liveliness: pick(
            profile.liveliness,
            OPEN_LIVELINESS,
            other.liveliness,
            RMW_QOS_POLICY_LIVELINESS_AUTOMATIC,
        ),
        ..*profile
    }
}

exported! {
    fn rmw_qos_profile_check_compatible(
        publisher: rmw_qos_profile_t,
        subscription: rmw_qos_profile_t,
        compatibility: *mut rmw_qos_compatibility_type_t => place "compatibility",
        reason: *mut c_char,
        reason_size: usize,
    ) {
        if reason.is_null() && reason_size != 0 {
            return Err(Error::invalid("reason is null, and its size is not zero"));
        }
        let none = std::iter::empty();
        let offered = from_ros(&settled(&publisher, &subscription), EndpointRole::Publisher, none.clone())?;
        let requested = from_ros(&settled(&subscription, &publisher), EndpointRole::Subscription, none)?;
        let errors = offered.incompatibilities(&requested);
        let errors = errors.map(|policy| format!("ERROR: the offered {policy} does not meet the requested one;"));
        let warnings = undetermined([&publisher, &subscription]);
        let warnings = warnings.map(|policy| format!("WARNING: {policy} is a system default or unknown, and may be incompatible;"));
        let (errors, warnings) = (errors.collect::<Vec<_>>(), warnings.collect::<Vec<_>>());
        *compatibility = match (errors.is_empty(), warnings.is_empty()) {
            (false, _) => RMW_QOS_COMPATIBILITY_ERROR,
            (true, false) => RMW_QOS_COMPATIBILITY_WARNING,
            (true, true) => RMW_QOS_COMPATIBILITY_OK,
        };
        let text = [errors, warnings].concat().join(" ");
        if reason_size > 0 {
            let length = text.len().min(reason_size - 1);
            // SAFETY: rmw's contract: of this size.
            unsafe {
                reason.cast::<u8>().copy_from_nonoverlapping(text.as_ptr(), length);
                reason.add(length).write(0);
            }
        }
        Ok(())
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! The QoS-incompatible event of rcl.

use super::error::check;
use r2r_rcl::*;

/// Offered incompatible QoS. Must be dropped before its publisher.
pub(super) struct Incompatible {
    raw: Box<rcl_event_t>,
}

impl Incompatible {
    /// `None` if the RMW has no such event.
    ///
    /// # Safety
    /// The publisher is initialised, and lives longer than this.
    pub(super) unsafe fn of_publisher(publisher: *const rcl_publisher_t) -> Option<Self> {
        // SAFETY: rcl's protocol; the caller guarantees the rest.
        unsafe {
            let mut raw = Box::new(rcl_get_zero_initialized_event());
            let kind = rcl_publisher_event_type_e::RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS;
            check("watching", rcl_publisher_event_init(&mut *raw, publisher, kind)).ok()?;
            Some(Incompatible { raw })
        }
    }

    /// The total count and the last policy, if the count has grown.
    pub(super) fn take(&self) -> Option<(u64, &'static str)> {
        let mut status = rmw_qos_incompatible_event_status_t {
            total_count: 0,
            total_count_change: 0,
            last_policy_kind: rmw_qos_policy_kind_e::RMW_QOS_POLICY_INVALID,
        };
        // SAFETY: this is the event's status type.
        let code = unsafe { rcl_take_event(&*self.raw, (&raw mut status).cast()) };
        check("taking an event", code).ok()?;
        let total = u64::try_from(status.total_count).unwrap_or(0);
        (status.total_count_change > 0).then(|| (total, policy_name(status.last_policy_kind)))
    }
}

impl Drop for Incompatible {
    fn drop(&mut self) {
        // SAFETY: initialised and exclusive.
        let _ = unsafe { rcl_event_fini(&mut *self.raw) };
    }
}

fn policy_name(kind: rmw_qos_policy_kind_t) -> &'static str {
    use rmw_qos_policy_kind_e as Kind;
    match kind {
        Kind::RMW_QOS_POLICY_DURABILITY => "durability",
        Kind::RMW_QOS_POLICY_DEADLINE => "deadline",
        Kind::RMW_QOS_POLICY_LIVELINESS => "liveliness",
        Kind::RMW_QOS_POLICY_RELIABILITY => "reliability",
        Kind::RMW_QOS_POLICY_HISTORY => "history",
        Kind::RMW_QOS_POLICY_LIFESPAN => "lifespan",
        Kind::RMW_QOS_POLICY_LIVELINESS_LEASE_DURATION => "liveliness lease duration",
        _ => "an unknown policy",
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Takes serialized bytes from ROS.

use super::context::{Node, text};
use super::end::RclEntity;
use super::error::{RclError, taken};
use super::serialized::SerializedMessage;
use super::type_support::MessageSupport;
use crate::qos::to_ros;
use r2r_rcl::*;
use std::sync::Arc;
use tautline_transport::{Gid, Qos};

/// A subscription to bytes.
pub struct RosSubscription {
    end: RclEntity<rcl_subscription_t>,
    _support: MessageSupport,
}

/// The origin of a message, from the RMW.
#[derive(Clone, Copy, Debug, Default)]
pub struct RosMessageInfo {
    /// When it was published: nanoseconds since 1970.
    pub source_timestamp_ns: i64,
    /// The publisher's sequence number, from 1; `None` if the RMW has none.
    pub sequence_number: Option<u64>,
    /// Its publisher.
    pub gid: Gid,
    /// Whether the publisher is of the same context. (The RMW's own filter is not used: when rmw_fastrtps 8.4.3 takes serialized
    /// bytes, it loses the message behind a filtered one.)
    pub is_own: bool,
}

impl RosSubscription {
    /// A subscription to `topic`, a fully qualified name.
    ///
    /// # Errors
    /// [`RclError`]: an invalid name or QoS.
    pub fn new(node: &Arc<Node>, topic: &str, support: &MessageSupport, qos: &Qos) -> Result<Self, RclError> {
        let name = text(topic)?;
        // SAFETY: rcl's protocol; the type support lives as long as the subscription.
        unsafe {
            let mut options = rcl_subscription_get_default_options();
            options.qos = to_ros(qos);
            let init = |raw| rcl_subscription_init(raw, node.raw(), support.raw(), name.as_ptr(), &options);
            let zero = rcl_get_zero_initialized_subscription();
            let end = RclEntity::make("making a subscription", node, zero, init, rcl_subscription_fini);
            let _ = rcl_subscription_options_fini(&mut options);
            Ok(RosSubscription { end: end?, _support: support.clone() })
        }
    }

    /// Takes a message into `message`; `None` if there is none.
    pub fn take(&mut self, message: &mut SerializedMessage) -> Result<Option<RosMessageInfo>, RclError> {
        // SAFETY: all are initialised; rmw grows the message with its own allocator.
        let (code, info) = unsafe {
            let mut info = rmw_get_zero_initialized_message_info();
            let nothing = std::ptr::null_mut();
            (rcl_take_serialized_message(self.end.raw(), message.raw_mut(), &mut info, nothing), info)
        };
        if !taken("taking a message", code, RCL_RET_SUBSCRIPTION_TAKE_FAILED)? {
            return Ok(None);
        }
        let context = self.end.node().context();
        let gid = context.publisher(super::graph::gid(&info.publisher_gid.data));
        Ok(Some(RosMessageInfo {
            source_timestamp_ns: info.source_timestamp,
            sequence_number: Some(info.publication_sequence_number).filter(|number| *number != u64::MAX),
            gid,
            is_own: context.is_own(&gid),
        }))
    }

    pub(crate) fn raw(&self) -> *const rcl_subscription_t {
        self.end.raw()
    }
}

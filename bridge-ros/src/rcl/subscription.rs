// SPDX-License-Identifier: MIT OR Apache-2.0
//! Takes serialized bytes from ROS.

use super::context::{Node, text};
use super::error::{RclError, check};
use super::serialized::SerializedMessage;
use super::type_support::MessageSupport;
use crate::qos::to_ros;
use r2r_rcl::*;
use std::sync::Arc;
use tautline_transport::{Gid, Qos};

/// A subscription to bytes.
pub struct RosSubscription {
    raw: *mut rcl_subscription_t,
    node: Arc<Node>,
    _support: MessageSupport,
}

// SAFETY: it is used by one thread at a time, made and destroyed under the node's lock.
unsafe impl Send for RosSubscription {}

/// Where a message came from, as the RMW tells it.
#[derive(Clone, Copy, Debug, Default)]
pub struct RosMessageInfo {
    /// When it was published: nanoseconds since 1970.
    pub source_timestamp_ns: i64,
    /// Counts the publisher's messages, from 1; `None` if the RMW does not count.
    pub sequence_number: Option<u64>,
    /// Its publisher.
    pub gid: Gid,
    /// Whether that is of the same context. (The RMW's own filter is not used: as rmw_fastrtps 8.4.3 takes serialized bytes,
    /// the message behind one that is passed over is lost.)
    pub is_own: bool,
}

impl RosSubscription {
    /// A subscription to `topic`, a fully qualified name.
    ///
    /// # Errors
    /// [`RclError`]: a name or QoS that cannot be one.
    pub fn new(node: &Arc<Node>, topic: &str, support: &MessageSupport, qos: &Qos) -> Result<Self, RclError> {
        let name = text(topic)?;
        let _making = node.making();
        // SAFETY: rcl's protocol; the type support lives as long as the subscription; boxed, for wait sets keep its address.
        unsafe {
            let mut options = rcl_subscription_get_default_options();
            options.qos = to_ros(qos);
            let raw = Box::into_raw(Box::new(rcl_get_zero_initialized_subscription()));
            let made = rcl_subscription_init(raw, node.raw(), support.raw(), name.as_ptr(), &options);
            let made = check("making a subscription", made);
            let _ = rcl_subscription_options_fini(&mut options);
            if let Err(error) = made {
                drop(Box::from_raw(raw));
                return Err(error);
            }
            Ok(RosSubscription { raw, node: node.clone(), _support: support.clone() })
        }
    }

    /// Takes a message into `message`; `None` if there is none.
    ///
    /// # Errors
    /// [`RclError`].
    pub fn take(&mut self, message: &mut SerializedMessage) -> Result<Option<RosMessageInfo>, RclError> {
        const NOTHING: rcl_ret_t = RCL_RET_SUBSCRIPTION_TAKE_FAILED as rcl_ret_t;
        // SAFETY: all are initialised; rmw grows the message with its own allocator.
        let (code, info) = unsafe {
            let mut info = rmw_get_zero_initialized_message_info();
            let nothing = std::ptr::null_mut();
            (rcl_take_serialized_message(self.raw, message.raw_mut(), &mut info, nothing), info)
        };
        if code == NOTHING {
            // SAFETY: the message that belongs to the code, in this thread.
            unsafe { rcutils_reset_error() };
            return Ok(None);
        }
        check("taking a message", code)?;
        let gid = self.node.context().publisher(super::graph::gid(&info.publisher_gid.data));
        Ok(Some(RosMessageInfo {
            source_timestamp_ns: info.source_timestamp,
            sequence_number: Some(info.publication_sequence_number).filter(|number| *number != u64::MAX),
            gid,
            is_own: self.node.context().is_own(&gid),
        }))
    }

    pub(crate) fn raw(&self) -> *const rcl_subscription_t {
        self.raw
    }
}

impl Drop for RosSubscription {
    fn drop(&mut self) {
        let _making = self.node.making();
        // SAFETY: nobody else has it; its node lives.
        unsafe {
            let _ = rcl_subscription_fini(self.raw, self.node.raw());
            drop(Box::from_raw(self.raw));
        }
    }
}

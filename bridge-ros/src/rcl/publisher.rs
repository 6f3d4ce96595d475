// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishes serialized bytes in ROS.

use super::context::{Node, text};
use super::end::RclEntity;
use super::error::{RclError, check};
use super::events::Incompatible;
use super::type_support::MessageSupport;
use crate::qos::to_ros;
use r2r_rcl::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tautline_transport::{Gid, Qos, TracedSender};

/// A publisher of bytes.
pub struct RosPublisher {
    end: RclEntity<rcl_publisher_t>,
    gid: Gid,
    incompatible: Option<Incompatible>,
    traced: TracedSender,
    /// The sequence number of the last message through [`publish_from`](Self::publish_from), as counted by the RMW.
    sent: AtomicU64,
    _support: MessageSupport,
}

// SAFETY: like `RclEntity`, and so is its event.
unsafe impl Send for RosPublisher {}
// SAFETY: publishing is thread-safe.
unsafe impl Sync for RosPublisher {}

impl RosPublisher {
    /// A publisher of `topic`, a fully qualified name.
    ///
    /// # Errors
    /// [`RclError`]: an invalid name or QoS.
    pub fn new(node: &Arc<Node>, topic: &str, support: &MessageSupport, qos: &Qos) -> Result<Self, RclError> {
        let name = text(topic)?;
        // SAFETY: rcl's protocol; the type support lives as long as the publisher, and its event is dropped before it.
        unsafe {
            let mut options = rcl_publisher_get_default_options();
            options.qos = to_ros(qos);
            let init = |raw| rcl_publisher_init(raw, node.raw(), support.raw(), name.as_ptr(), &options);
            let zero = rcl_get_zero_initialized_publisher();
            let end = RclEntity::make("making a publisher", node, zero, init, rcl_publisher_fini)?;
            let mut gid = rmw_gid_t { implementation_identifier: std::ptr::null(), data: [0; 16] };
            let known = rmw_get_gid_for_publisher(rcl_publisher_get_rmw_handle(end.raw()), &mut gid);
            let gid = node.context().publisher(super::graph::gid(&gid.data));
            if check("reading a publisher's gid", known).is_ok() {
                node.context().learn_own(&gid);
            }
            let making = node.making();
            let incompatible = Incompatible::of_publisher(end.raw());
            drop(making);
            let (traced, sent) = (TracedSender::new(topic, gid), AtomicU64::new(0));
            Ok(RosPublisher { end, gid, incompatible, traced, sent, _support: support.clone() })
        }
    }

    /// The GID that others see.
    pub fn gid(&self) -> Gid {
        self.gid
    }

    /// Publishes a sample that came through a port of the domain with a number, and records this in traces. A publisher uses this
    /// for all messages or for none, one after another.
    pub fn publish_from(&self, from: (Gid, u64), message: &[u8]) -> Result<(), RclError> {
        let number = self.sent.load(Ordering::Relaxed) + 1;
        self.traced.sample(from, number).record();
        self.publish(message)?;
        // RMWs count accepted messages from 1.
        self.sent.store(number, Ordering::Relaxed);
        Ok(())
    }

    /// Publishes CDR behind its encapsulation.
    pub fn publish(&self, message: &[u8]) -> Result<(), RclError> {
        // SAFETY: a constant.
        let allocator = unsafe { rcutils_get_default_allocator() };
        let (buffer, len) = (message.as_ptr().cast_mut(), message.len());
        let message =
            rcl_serialized_message_t { buffer, buffer_length: len, buffer_capacity: len, allocator };
        // SAFETY: both are initialised; rcl reads the message; with a null allocation rmw makes its own.
        check("publishing", unsafe {
            rcl_publish_serialized_message(self.end.raw(), &message, std::ptr::null_mut())
        })
    }

    /// Matched subscriptions.
    pub fn subscription_count(&self) -> usize {
        let mut count = 0;
        // SAFETY: it is initialised until it is dropped.
        let code = unsafe { rcl_publisher_get_subscription_count(self.end.raw(), &mut count) };
        check("counting subscriptions", code).map_or(0, |()| count)
    }

    /// Whether every matched reliable subscription has acknowledged all messages; true if the RMW does not know.
    pub fn are_all_acknowledged(&self) -> bool {
        // SAFETY: it is initialised until it is dropped.
        let code = unsafe { rcl_publisher_wait_for_all_acked(self.end.raw(), 0) };
        let _ = check("waiting for acknowledgements", code);
        code != RCL_RET_TIMEOUT as rcl_ret_t
    }

    /// If QoS-incompatible subscriptions have appeared since the last call: the total count and the last policy.
    pub fn incompatible(&self) -> Option<(u64, &'static str)> {
        self.incompatible.as_ref()?.take()
    }
}

impl Drop for RosPublisher {
    fn drop(&mut self) {
        // Before its publisher.
        let _making = self.end.node().making();
        self.incompatible = None;
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Arguments for creating publishers and subscriptions.

use crate::bindings::*;
use crate::error::{Error, Result};
use crate::handle::{behind, endpoint_name, given};
use crate::node::Node;
use crate::qos::{self, EndpointRole};
use crate::types::MessageType;
use std::ffi::c_char;
use tautline_transport::Qos;

/// Checked arguments for creating a topic endpoint.
pub(crate) struct EndpointArgs<'a> {
    pub(crate) node: &'a Node,
    pub(crate) message_type: MessageType,
    pub(crate) name: &'a str,
    pub(crate) profile: &'a rmw_qos_profile_t,
}

impl EndpointArgs<'_> {
    /// # Safety
    /// As documented by rmw for both functions that create endpoints.
    pub(crate) unsafe fn new(
        node: *const rmw_node_t,
        support: *const rosidl_message_type_support_t,
        topic: *const c_char,
        profile: *const rmw_qos_profile_t,
        flows: rmw_unique_network_flow_endpoints_requirement_t,
    ) -> Result<Self> {
        // SAFETY: the caller's contract.
        let (node, message_type, profile, name) = unsafe {
            let (node, message_type) = (behind(node)?, MessageType::of(support)?);
            let profile = given(profile, "the QoS profile")?;
            (node, message_type, profile, endpoint_name(topic, "the topic's name", profile)?)
        };
        if flows == RMW_UNIQUE_NETWORK_FLOW_ENDPOINTS_STRICTLY_REQUIRED {
            return Err(Error::unsupported(
                "unique network flow endpoints: there is no network flow in shared memory",
            ));
        }
        Ok(EndpointArgs { node, message_type, name, profile })
    }

    /// The QoS, of which best-available policies follow from the topic's endpoints.
    pub(crate) fn qos(&self, role: EndpointRole) -> Result<Qos> {
        if !qos::has_best_available(self.profile) {
            return qos::from_ros(self.profile, role, std::iter::empty());
        }
        let graph = self.node.participant.graph()?;
        let of_topic = graph.endpoints.iter().filter(|end| end.topic == self.name).map(|end| &**end);
        qos::from_ros(self.profile, role, of_topic)
    }
}

// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads the ROS graph with rcl's functions, because r2r's function ends the process when a topic has two types (0.9.7).

use super::context::{Node, text};
use super::error::{RclError, check};
use crate::qos::from_ros;
use r2r_rcl::*;
use std::collections::BTreeMap;
use std::ffi::{CStr, c_char};
use tautline_transport::{EndpointKind, Gid, NodeName, Qos, ServiceKind};

/// Names of topics or services, each with all its types.
pub type RosTopics = BTreeMap<String, Vec<String>>;

/// A publisher or subscription.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RosEndpoint {
    /// Publisher or subscription.
    pub kind: EndpointKind,
    /// Its node; `None` if that is unknown, or it belongs to no ROS node.
    pub node: Option<NodeName>,
    /// Such as `std_msgs/msg/String`.
    pub type_name: String,
    /// `RIHS01_...`, if announced.
    pub type_hash: Option<String>,
    /// Its identifier.
    pub gid: Gid,
    /// As far as the RMW knows it: DDS does not announce the depth.
    pub qos: Qos,
}

/// Lists names and types of one kind at a node.
type ListNames = unsafe extern "C" fn(
    *const rcl_node_t,
    *mut rcl_allocator_t,
    *const c_char,
    *const c_char,
    *mut rcl_names_and_types_t,
) -> rcl_ret_t;

impl Node {
    /// All topics.
    pub fn topics(&self) -> Result<RosTopics, RclError> {
        // SAFETY: the node is initialised; the list starts zero, and `collect` ends it.
        unsafe {
            let mut allocator = rcutils_get_default_allocator();
            let mut list = rmw_get_zero_initialized_names_and_types();
            let code = rcl_get_topic_names_and_types(self.raw(), &mut allocator, false, &mut list);
            collect("listing topics", code, list)
        }
    }

    /// The services that a node offers or calls.
    ///
    /// # Errors
    /// [`RclError`]: the node has ended.
    pub fn services_of(&self, node: &NodeName, kind: ServiceKind) -> Result<RosTopics, RclError> {
        let (what, list_names): (_, ListNames) = match kind {
            ServiceKind::Server => ("listing a node's services", rcl_get_service_names_and_types_by_node),
            ServiceKind::Client => ("listing a node's clients", rcl_get_client_names_and_types_by_node),
        };
        let (name, namespace) = (text(&node.name)?, text(&node.namespace)?);
        // SAFETY: as in `topics`.
        unsafe {
            let mut allocator = rcutils_get_default_allocator();
            let mut list = rmw_get_zero_initialized_names_and_types();
            let (name, namespace) = (name.as_ptr(), namespace.as_ptr());
            let code = list_names(self.raw(), &mut allocator, name, namespace, &mut list);
            collect(what, code, list)
        }
    }

    /// All nodes with their enclaves; a name is listed once per node.
    pub fn nodes(&self) -> Result<Vec<(NodeName, String)>, RclError> {
        // SAFETY: the node is initialised; the lists start zero, get the same length, and end here.
        unsafe {
            let [mut names, mut namespaces, mut enclaves] =
                [(); 3].map(|()| rcutils_get_zero_initialized_string_array());
            let allocator = rcutils_get_default_allocator();
            let code = rcl_get_node_names_with_enclaves(
                self.raw(),
                allocator,
                &mut names,
                &mut namespaces,
                &mut enclaves,
            );
            let listed = check("listing nodes", code).map(|()| {
                let [names, namespaces, enclaves] =
                    [&names, &namespaces, &enclaves].map(|list| strings(list.data, list.size));
                let names = names.into_iter().zip(namespaces);
                names.map(|(name, namespace)| NodeName { name, namespace }).zip(enclaves).collect()
            });
            for list in [&mut names, &mut namespaces, &mut enclaves] {
                let _ = rcutils_string_array_fini(list);
            }
            listed
        }
    }

    /// The publishers or subscriptions of `topic`, a fully qualified name, of all types.
    pub fn endpoints(&self, topic: &str, kind: EndpointKind) -> Result<Vec<RosEndpoint>, RclError> {
        self.ends_of(topic, kind, false)
    }

    /// The servers of `service`, a fully qualified name, by their request endpoints. With DDS only: other RMWs list none.
    pub fn servers(&self, service: &str) -> Result<Vec<RosEndpoint>, RclError> {
        self.ends_of(&format!("rq{service}Request"), EndpointKind::Subscription, true)
    }

    /// The endpoints of a topic. `is_raw`: the name is the RMW's own.
    fn ends_of(&self, topic: &str, kind: EndpointKind, is_raw: bool) -> Result<Vec<RosEndpoint>, RclError> {
        let name = text(topic)?;
        // SAFETY: the node is initialised; the list starts zero and ends here, after its strings are copied.
        unsafe {
            let mut list = rmw_get_zero_initialized_topic_endpoint_info_array();
            let mut allocator = rcutils_get_default_allocator();
            let get = match kind {
                EndpointKind::Publisher => rcl_get_publishers_info_by_topic,
                EndpointKind::Subscription => rcl_get_subscriptions_info_by_topic,
            };
            let code = get(self.raw(), &mut allocator, name.as_ptr(), is_raw, &mut list);
            let listed = check("listing a topic's endpoints", code).map(|()| {
                let infos = match list.size {
                    0 => &[],
                    size => std::slice::from_raw_parts(list.info_array, size),
                };
                infos.iter().map(|info| endpoint(kind, info)).collect()
            });
            let _ = rmw_topic_endpoint_info_array_fini(&mut list, &mut allocator);
            listed
        }
    }
}

/// # Safety
/// `info` was written by rmw.
unsafe fn endpoint(kind: EndpointKind, info: &rmw_topic_endpoint_info_t) -> RosEndpoint {
    // SAFETY: rmw's strings are NUL-terminated or null.
    let (name, namespace, type_name) =
        unsafe { (string(info.node_name), string(info.node_namespace), string(info.topic_type)) };
    // rmw's placeholder for a name that is not announced yet.
    let is_known = !name.is_empty() && !name.contains("_UNKNOWN_");
    let hash = &info.topic_type_hash;
    RosEndpoint {
        kind,
        node: is_known.then_some(NodeName { name, namespace }),
        type_name,
        type_hash: hash_text(hash.version, &hash.value),
        gid: gid(&info.endpoint_gid),
        qos: from_ros(&info.qos_profile),
    }
}

/// `RIHS01_` and the digits; `None` if it is not set.
pub(super) fn hash_text(version: u8, value: &[u8; 32]) -> Option<String> {
    let digits = || value.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    (version == 1).then(|| format!("RIHS01_{}", digits()))
}

/// The first 16 bytes.
pub(super) fn gid(data: &[u8]) -> Gid {
    let mut gid = Gid::default();
    for (to, from) in gid.0.iter_mut().zip(data) {
        *to = *from;
    }
    gid
}

/// # Safety
/// The call that returned `code` wrote `list`.
unsafe fn collect(
    what: &'static str,
    code: rcl_ret_t,
    mut list: rcl_names_and_types_t,
) -> Result<RosTopics, RclError> {
    // SAFETY: rmw writes one list of types per name.
    unsafe {
        let listed = check(what, code).map(|()| {
            let names = strings(list.names.data, list.names.size);
            let types = |at| {
                let types: &rcutils_string_array_t = &*list.types.add(at);
                strings(types.data, types.size)
            };
            names.into_iter().enumerate().map(|(at, name)| (name, types(at))).collect()
        });
        let _ = rcl_names_and_types_fini(&mut list);
        listed
    }
}

/// # Safety
/// `size` NUL-terminated strings.
unsafe fn strings(data: *mut *mut c_char, size: usize) -> Vec<String> {
    // SAFETY: the caller guarantees it.
    (0..size).map(|at| unsafe { string(*data.add(at)) }).collect()
}

/// # Safety
/// A NUL-terminated string, or null.
unsafe fn string(text: *const c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: the caller guarantees it.
    unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned()
}
